# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Settings of position references other than GNSS fixes."""

from dataclasses import dataclass
import math

from odocal_ros.settings.setting import setting

NAN = math.nan


@dataclass(frozen=True, kw_only=True)
class ReferenceConfig:
    start: tuple[float, ...] = setting((), 'deg, deg, m, m', about='Surveyed antenna position at '
                                       'the start mark: latitude, longitude, ellipsoidal height, '
                                       'sigma; empty: from fixes.')
    end: tuple[float, ...] = setting((), 'deg, deg, m, m', about='The same at the end mark.')
    latitude_deg: float = setting(NAN, 'deg', -85.0, 85.0, ro=True, about=(
        'Latitude of the site, for positions in a local frame (poses instead of GNSS fixes). It '
        'gives gravity and the vertical Earth rate. NaN: gravity of 45 deg; the Earth rate, up to '
        '15 deg/h, is estimated as gyro bias.'))
    default_sigma: float = setting(0.05, 'm', 1e-4, 1e4, about='Horizontal 1 sigma of '
                                   'positions in a local frame without a covariance: the first '
                                   'value of the estimate.')
    frames: tuple[str, ...] = setting(('map', 'base_link'), item=str, ro=True, about=(
        'With TF as position reference: the fixed frame, and the frame of the tracked point on '
        'the robot.'))
    points: tuple[float, ...] = setting((), 'm', -1e4, 1e4, ro=True, many=True, about=(
        'Points on the floor where the robot stands at the marks: x and y of each, in the order '
        'of the marks; after the last point the list starts again. The node then uses ~/mark '
        'instead of the topic fix.'))
    points_sigma: float = setting(0.005, 'm', 1e-4, 1.0, about='Uncertainty of points and of '
                                  'the robot on them, each axis.')
    marks: tuple[float, ...] = setting((), 's', 0.0, 1e6, many=True, about=(
        'Times at which the robot stands on the points, from the first message of the bag; they '
        'replace fixes and poses. The same as --mark.'))
    min_distance: float = setting(2.0, 'm', 0.1, 1e5, about='leg.min_distance with positions in a '
                                  'local frame; the smaller of both applies.')
    min_speed: float = setting(0.1, 'm/s', 0.01, 50.0, about='leg.min_speed with positions in a '
                               'local frame; the smaller of both applies.')
