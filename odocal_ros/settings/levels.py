"""
What several rooms ask alike: how many sigmas make a word, and what land vehicles do.

A level is one of two sides of the normal law; beside each, how often chance alone reaches it.
"""

REMARK_SIGMAS = 3.0     # to say that something is there: once in 370
FAULT_SIGMAS = 5.0      # to call a sensor or a setting wrong: once in 1.7 million
OUTLIER_SIGMAS = 5.0    # robust sigmas from which one value of many is not of them: the same
FASTEST = 100.0         # m/s that no land vehicle drives: a counter reset, or another unit
SWAY = 0.05             # m/s to the side and up, of a body on its springs, that no wheel feels
