# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

import os

# the matrices here have some 20 rows: more threads of BLAS make them slower, on a busy machine a
# hundred times, and change last digits
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
