# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Track width of a vehicle: first value, prior sigmas and limits."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TrackWidth:
    """
    Track widths and their prior sigmas, m; shares are of the width itself.

    Physical: cars have 1.3 to 1.8 m, small robots 0.2 m, mining trucks 7 m.
    """

    of_a_car: float = 1.6       # first value, if not configured
    least: float = 0.1          # smaller values are not a track width
    any_sigma: float = 10.0     # of any vehicle, if the drive determines it
    first_sigma: float = 3.0    # of any vehicle, if only wheels and gyro are compared
    taped_share: float = 0.02   # 1 sigma of a configured one: by tape, between wide tyres
    determined_share: float = 0.05    # largest sigma of a determined width: judgement


TRACK_WIDTH = TrackWidth()
