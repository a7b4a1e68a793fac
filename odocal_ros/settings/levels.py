# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Limits that several packages use: sigmas of reasons, and motions of land vehicles.

The comment on a number states its origin: physical, with its source; statistical, with its
two-sided frequency by chance; tuned, with the benchmark; judgement, if nothing was measured;
format, of a specification; or definition: a unit, a layout, a convention of a source.
"""

from dataclasses import dataclass
import math

REMARK_SIGMAS = 3.0     # statistical: for a reason: once in 370
FAULT_SIGMAS = 5.0      # statistical: for a fault of a sensor or a setting: once in 1.7 million
# statistical: robust sigmas of an outlier among many values: the same
OUTLIER_SIGMAS = 5.0
FASTEST = 100.0         # m/s, physical: beyond any land vehicle: a counter reset or a wrong unit
# physical: wear changes a tyre's radius by 2 %, pressure and load by 1 %, another make by 3 %
TYRE_SPREAD = 0.05      # relative, largest difference of scales of one vehicle's wheels, or drives
# judgement: real over stated sigma of fixes, worth a note: receivers state their errors no better
FIX_NOISE_LIMIT = 1.5
SCALE_LIMIT = 0.05      # judgement: relative sigma, above it a scale is not determined
# judgement: ratio of posterior to prior sigma below which the data determined the value: at half,
# the data have three times the weight of the prior
INFORMED_SHARE = 0.5
# m/s, judgement: to the side and up, of a sprung body, not measured by wheels
SWAY = 0.05
# judgement: a larger backward step, of this number of stamps in sequence, is a restart of time
TIME_RESTART_NS, TIME_RESTART_ROWS = 10**9, 3
# s between the stamps of two topics, judgement: drivers have smaller delays
CLOCK_DIFFERENCE_LIMIT = 0.5
# definition: units
DAY_NS = 86_400 * 10**9
RAD_PER_DEG = math.pi / 180


@dataclass(frozen=True)
class TrackWidth:
    """
    Track widths and their prior sigmas, m; shares are of the width itself.

    Physical: cars have 1.3 to 1.8 m, small robots 0.2 m, mining trucks 7 m.
    """

    typical: float = 1.6              # of a car: first value, if not configured
    minimum: float = 0.1              # smaller values are not a track width
    unknown_sigma: float = 10.0       # of an unknown width, in a fit of all samples
    comparison_sigma: float = 3.0     # of an unknown width, if only wheels and gyro are compared
    tape_share: float = 0.02          # 1 sigma of a configured one: by tape, between wide tyres
    max_sigma_share: float = 0.05     # largest sigma of a determined width: judgement


TRACK_WIDTH = TrackWidth()
