# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Limits of several packages: sigmas for a remark, and motions of land vehicles.

The comment beside a level is the probability that chance exceeds it, on two sides.

Beside a number stands where it is from: physical, with its source; statistical, with how often
chance does so; tuned, with the benchmark that shows it; judgement, where nothing was measured;
format, of a specification; or definition: a unit, a layout, a quadrature, what a source has set.
"""

import math

REMARK_SIGMAS = 3.0     # statistical: to say that something is there: once in 370
FAULT_SIGMAS = 5.0      # statistical: to call a sensor or a setting wrong: once in 1.7 million
# statistical: robust sigmas from which one value of many is not of them: the same
OUTLIER_SIGMAS = 5.0
FASTEST = 100.0         # m/s, physical: no land vehicle is so fast: a counter reset, another unit
# physical: wear changes a tyre's radius by 2 %, pressure and load by 1 %, another make by 3 %
TYRE_SPREAD = 0.05      # relative, by which scales of one vehicle's wheels, or drives, may differ
SCALE_LIMIT = 0.05      # judgement: relative sigma, a scale no better is not known
# judgement: of a prior sigma; a posterior one below it says that the data determined the value,
# at half the data weigh three times the prior
INFORMED_SHARE = 0.5
# m/s, judgement: to the side and up, of a sprung body, not measured by wheels
SWAY = 0.05
# judgement: stamps further back, so many in turn, mean that time restarted
TIME_ANEW_NS, TIME_ANEW_ROWS = 10**9, 3
CLOCK_APART = 0.5      # s between the stamps of two topics, judgement: no driver is as late
# definition: units
DAY_NS = 86_400 * 10**9
RAD_PER_DEG = math.pi / 180
