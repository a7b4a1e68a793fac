# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Prior of a track width: of cars, of one that was measured, of any."""

from dataclasses import dataclass


@dataclass(frozen=True)
class TrackWidth:
    """
    Track widths and their prior sigmas, m; shares are of the width itself.

    Physical: cars have 1.3 to 1.8 m, small robots 0.2 m, mining trucks 7 m.
    """

    of_a_car: float = 1.6       # where nothing is known yet
    least: float = 0.1          # a track of less is none
    car_sigma: float = 0.8      # of a vehicle that is most likely a car
    any_sigma: float = 10.0     # of any vehicle, where the drive determines it
    first_sigma: float = 3.0    # of any vehicle, where wheels and gyro alone are compared
    taped_share: float = 0.02   # 1 sigma of one that is given: taped, and tyres are wide
    determined_share: float = 0.05    # sigma from which a width found says nothing: judgement


TRACK_WIDTH = TrackWidth()
