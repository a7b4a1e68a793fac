import os

# the matrices here have some 20 rows: more threads of BLAS make them slower, on a busy machine a
# hundred times, and change last digits
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
