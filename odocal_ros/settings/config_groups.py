# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Groups of settings: position references, output, acceptance limits and their short form."""

from dataclasses import dataclass
import math
from typing import Any

from odocal_ros.errors import BadConfig, BadUsage
from odocal_ros.settings.setting import setting

NAN = math.nan
FORMATS = ('params', 'autoware', 'transform', 'ros2_control', 'devices', 'covariance', 'imu',
           'track', 'legs', 'report')
# results that can have limits
ACCEPTED = ('scale_factor', 'scale_ratio', 'yaw_mounting_angle', 'pitch_mounting_angle')
ACCEPT_FORM = ('--accept NAME=LOW:HIGH, such as --accept scale_ratio=0.995:1.005; either limit '
               'can be omitted')
DEG = '_deg'


@dataclass(frozen=True, kw_only=True)
class ReferenceConfig:
    start: tuple[float, ...] = setting((), 'deg, deg, m, m', about='Surveyed antenna position at '
                                       'the start mark: latitude, longitude, ellipsoidal height, '
                                       'sigma; empty: from fixes.')
    end: tuple[float, ...] = setting((), 'deg, deg, m, m', about='As reference.start, at the end '
                                     'mark.')
    latitude_deg: float = setting(NAN, 'deg', -85.0, 85.0, read_only=True, about=(
        'Latitude of the site, for positions in a local frame (poses instead of GNSS fixes). It '
        'gives gravity and the vertical Earth rate. NaN: gravity of 45 deg; the Earth rate, up to '
        '15 deg/h, is estimated as gyro bias.'))
    default_sigma: float = setting(0.05, 'm', 1e-4, 1e4, about='Horizontal 1 sigma of '
                                   'positions in a local frame without a covariance: the first '
                                   'value of the estimate.')
    frames: tuple[str, ...] = setting(('map', 'base_link'), item=str, read_only=True, about=(
        'With TF as position reference: the fixed frame, and the frame of the tracked point on '
        'the robot.'))
    points: tuple[float, ...] = setting((), 'm', -1e4, 1e4, any_length=True, about=(
        'Points on the floor where the robot stands at the marks: x and y of each, in the '
        'order of the marks; after the last point the list starts again. The node then uses '
        '~/mark instead of the topic fix.'), read_only=True)
    points_sigma: float = setting(0.005, 'm', 1e-4, 1.0, about='Uncertainty of points and of '
                                  'the robot on them, each axis.')
    marks: tuple[float, ...] = setting((), 's', 0.0, 1e6, any_length=True, about=(
        'Times at which the robot stands on the points, from the first message of the bag; they '
        'replace fixes and poses. The same as --mark.'))
    min_distance: float = setting(2.0, 'm', 0.1, 1e5, about='leg.min_distance with positions in a '
                                  'local frame; the smaller of both applies.')
    min_speed: float = setting(0.1, 'm/s', 0.01, 50.0, about='leg.min_speed with positions in a '
                               'local frame; the smaller of both applies.')


@dataclass(frozen=True, kw_only=True)
class OutputConfig:
    directory: str = setting('', about='Folder of the results; empty: odocal/ and the full node '
                             'name in $ROS_HOME (~/.ros/odocal/calibrator).')
    autosave: bool = setting(True, about='Write the result files after every leg that is not '
                             'rejected.')
    automatic_kept: int = setting(100, '', 0, 10**6, about='Number of result folders kept with '
                                  'leg.automatic; the oldest are deleted first, but never the '
                                  'one that latest points to and the newest good one. 0: all.')
    formats: tuple[str, ...] = setting(FORMATS, choices=FORMATS, item=str, about=(
        'Files written in addition to calibration.json.'))


@dataclass(frozen=True, kw_only=True)
class JournalConfig:
    max_bytes: int = setting(10 * 2**30, 'bytes', 0, 2**62, about='Disk space for the journals '
                             'of legs (journal/ in output.directory); the oldest are deleted '
                             'first. 0: no journal.')


@dataclass(frozen=True, kw_only=True)
class PublishConfig:
    rate: float = setting(2.0, 'Hz', 0.1, 20.0, read_only=True,
                          about='Rate of the status message.')


@dataclass(frozen=True, kw_only=True)
class FramesConfig:
    base: str = setting('base_link', read_only=True, frame=True,
                        about='Vehicle frame in the result files.')
    imu: str = setting('', read_only=True, frame=True,
                       about='IMU frame; empty: frame of the IMU messages.')
    local: str = setting('odocal_enu', read_only=True, frame=True, about=(
        'Frame of the published paths.'))


@dataclass(frozen=True, kw_only=True)
class UpdaterConfig:
    period: float = setting(1.0, 's', 0.1, 60.0, read_only=True, about='Period of /diagnostics.')
    use_fqn: bool = setting(False, read_only=True, about='Use the full node name in /diagnostics.')


def _lower_limit(value: str, unit: str) -> Any:
    return setting(NAN, unit, about=f'Lower acceptance limit of {value}: value minus 2 sigma must '
                   'not be below it. NaN: no limit.')


def _upper_limit(value: str, unit: str) -> Any:
    return setting(NAN, unit, about=f'Upper acceptance limit of {value}: value plus 2 sigma must '
                   'not be above it. NaN: no limit.')


@dataclass(frozen=True, kw_only=True)
class AcceptConfig:
    scale_factor_min: float = _lower_limit('the scale factor', 'm/pulse, m/rad or 1')
    scale_factor_max: float = _upper_limit('the scale factor', 'm/pulse, m/rad or 1')
    scale_ratio_min: float = _lower_limit('scale factor over nominal scale factor', '1')
    scale_ratio_max: float = _upper_limit('scale factor over nominal scale factor', '1')
    yaw_mounting_angle_min: float = _lower_limit('the yaw mounting angle', 'rad')
    yaw_mounting_angle_max: float = _upper_limit('the yaw mounting angle', 'rad')
    pitch_mounting_angle_min: float = _lower_limit('the pitch mounting angle', 'rad')
    pitch_mounting_angle_max: float = _upper_limit('the pitch mounting angle', 'rad')
    strict: bool = setting(False, about='A result with a caution does not pass; it is undecided.')

    def __post_init__(self) -> None:
        for name, (low, high) in self.limits.items():
            if not low < high:
                unit = ' rad' * name.endswith('angle')
                raise BadConfig(f'accept.{name}_min = {low:g}{unit} is not below '
                                f'accept.{name}_max = {high:g}{unit}')

    @property
    def limits(self) -> dict[str, tuple[float, float]]:
        """Return (lower, upper) limit by result, for results with any; a missing one is inf."""
        pairs = {name: (getattr(self, f'{name}_min'), getattr(self, f'{name}_max'))
                 for name in ACCEPTED}
        return {name: (-math.inf if math.isnan(low) else low,
                       math.inf if math.isnan(high) else high)
                for name, (low, high) in pairs.items()
                if not (math.isnan(low) and math.isnan(high))}


def parse_accept(text: str) -> dict[str, float]:
    """
    Return the settings of one ``NAME=LOW:HIGH``; the limits of ``NAME_deg`` are in degrees.

    Raises BadUsage: another form, or a result that cannot have limits.
    """
    name, equals, limits = (part.strip() for part in text.partition('='))
    low, colon, high = limits.partition(':')
    parameter, factor = name, 1.0
    if name.endswith(f'angle{DEG}'):
        parameter, factor = name.removesuffix(DEG), math.radians(1.0)
    if parameter not in ACCEPTED:
        raise BadUsage(f'--accept {text}: required: one of '
                       + ', '.join(n + f' (or {n}{DEG})' * n.endswith('angle') for n in ACCEPTED))
    if not (equals and colon and limits != ':'):
        raise BadUsage(f'--accept {text}: required: {ACCEPT_FORM}')
    try:
        settings = {f'accept.{parameter}_{side}': float(value) * factor
                    for side, value in (('min', low), ('max', high)) if value.strip()}
        if any(map(math.isnan, settings.values())):
            raise ValueError
        return settings
    except ValueError:
        raise BadUsage(f'--accept {text}: {limits} are not two numbers; required: '
                       f'{ACCEPT_FORM}') from None


@dataclass(frozen=True, kw_only=True)
class VerdictConfig:
    max_scale_sigma: float = setting(0.001, '1', 0.0, 1.0, about='Required relative sigma of the '
                                     'scale factor.')
    max_yaw_sigma: float = setting(0.0087, 'rad', 0.0, 3.2, about='Required sigma of the yaw '
                                   'mounting angle.')
    min_legs: int = setting(1, '', 1, 100, about='Required number of legs; fewer are a caution.')
    scale_drift_per_day: float = setting(1e-4, '1/sqrt(day)', 0.0, 1.0, about='Random walk of '
                                         'the scale factor between legs, relative, 1 sigma '
                                         '(tyres).')
