# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Fields of messages by path, and the conversion of messages to samples, except of the odometer.

A message is read as bytes (``cdr.Layout``) or as an object (``MessageView``). A path is dotted,
with [i] or [name] for an element of a list: ``pose.covariance[0]``, ``position[left_wheel]``.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data import samples
from odocal_ros.data.arrays import Floats, Ints, reduce_columns
from odocal_ros.data.inputs import WHEELS
from odocal_ros.errors import BadData
from odocal_ros.messages.cdr import Layout
from odocal_ros.nav.geodesy import local_fixes
from odocal_ros.settings.config import Config, OdometerConfig
from odocal_ros.settings.levels import RAD_PER_DEG

PATH_PART = re.compile(r'\.?([^.\[\]]+)|\[([^\]]+)\]')


class MessageView:
    """A deserialised message, of rosbags or rclpy."""

    def __init__(self, message: object) -> None:
        self.message = message

    @property
    def names(self) -> list[str]:
        """Return the list ``name`` (of joints), empty if there is none."""
        return list(getattr(self.message, 'name', ()))

    def count(self, path: str) -> int:
        """Return the length of a list, 0 if it is missing."""
        try:
            return len(self.value(path))
        except (AttributeError, LookupError, TypeError):
            return 0

    def value(self, path: str) -> Any:
        """Return the value at a path; AttributeError, LookupError, TypeError if it is missing."""
        value: Any = self.message
        owner = value      # message that contains ``value``
        for name, key in path_parts(path):
            if name:
                value, owner = getattr(value, name), value
                continue
            names = list(getattr(owner, 'name', ()))      # beside the list, of its elements
            if key not in names and not key.isdigit():
                raise LookupError(f'no {key!r} among {", ".join(map(str, names)) or "no names"}')
            value = value[names.index(key) if key in names else int(key)]
        return value

    def fields(self) -> list[str]:
        """Return the names of the message's fields, for error messages."""
        field_names = getattr(type(self.message), '__dataclass_fields__', None)
        if field_names is None and hasattr(self.message, 'get_fields_and_field_types'):
            field_names = self.message.get_fields_and_field_types()
        return [name for name in (field_names or ()) if not name.startswith('__')]


View = Layout | MessageView


@lru_cache
def path_parts(path: str) -> tuple[tuple[str, str], ...]:
    """Return a path as (name, '') and ('', key) pairs; () if it is not a path."""
    pairs = tuple(PATH_PART.findall(path))
    rebuilt = ''.join(f'[{key}]' if key else f'.{name}' for name, key in pairs)
    return pairs if rebuilt.lstrip('.') == path else ()


@dataclass(frozen=True)
class Column:
    """Values to read from every message: one column of samples, or several."""

    dtype: type
    width: int      # number of values
    find_paths: Callable[[View], Sequence[str] | None]      # in a message; None: they are missing

    def values_of(self, view: MessageView) -> list[Any]:
        """Return the values of an object; [] if they are missing."""
        values = [view.value(path) for path in self.find_paths(view) or ()]
        if self.dtype is np.int64:
            values = [(int(v) + 2**63) % 2**64 - 2**63 for v in values]   # uint64 as int64 bits
        return values


def fixed_column(dtype: type, *paths: str) -> Column:
    """Return a column whose values have the same paths in every message."""
    return Column(dtype, len(paths), lambda view: paths)


def vector_column(prefix: str, names: str = 'xyz') -> Column:
    return fixed_column(np.float64, *(f'{prefix}.{name}' for name in names))


def array_column(path: str, *indices: int) -> Column:
    return fixed_column(np.float64, *(f'{path}[{i}]' for i in indices))


STAMP = (fixed_column(np.int64, 'header.stamp.sec'),
         fixed_column(np.int64, 'header.stamp.nanosec'))


def stamp_ns(sec: Ints, nanosec: Ints) -> Ints:
    """Return header stamps in nanoseconds from the two columns of STAMP."""
    return sec[:, 0] * 10**9 + nanosec[:, 0]


IMU = 'sensor_msgs/msg/Imu'
FIX = 'sensor_msgs/msg/NavSatFix'
GPS_FIXES = ('gps_msgs/msg/GPSFix', 'gps_common/msg/GPSFix')    # of ROS 2 and ROS 1
GEODETIC = (FIX, *GPS_FIXES)
# format: status of a GPSFix with satellite corrections; others above 2: base station, as 2
WAAS_FIX = 33
MAX_VARIANCE = 1e12    # (m/s)^2; judgement: for unknown, drivers send 0 or more
TRANSFORMS = 'tf2_msgs/msg/TFMessage'
Pairs = list[tuple[str, samples.Samples]]      # slot and samples
# function of stamps and arrivals, (n,) ns, and the columns of a sensor, (n, width) each
Build = Callable[..., samples.Samples]
# format: bits of -1 (REP-145), which are compared without a warning of a signalling NaN
NOT_SENT_BITS = np.float64(-1).view(np.int64)
# format: block of the position in a 6 x 6 covariance, row by row
_COVARIANCE = array_column('pose.covariance', 0, 1, 2, 6, 7, 8, 12, 13, 14)
# columns of each type: position, and its covariance if the type has one
LOCAL_TYPES: dict[str, Sequence[Column]] = {
    'geometry_msgs/msg/PoseStamped': (vector_column('pose.position'),),
    'geometry_msgs/msg/PoseWithCovarianceStamped': (vector_column('pose.pose.position'),
                                                    _COVARIANCE),
    'geometry_msgs/msg/PointStamped': (vector_column('point'),),
    'geometry_msgs/msg/TransformStamped': (vector_column('transform.translation'),),
    'nav_msgs/msg/Odometry': (vector_column('pose.pose.position'), _COVARIANCE),
}


class SensorPlan:
    """Fields to read from a stamped sensor message, and the function that builds samples."""

    form: samples.OdometerForm | None = None

    def __init__(self, slot: str, columns: Sequence[Column], build: Build) -> None:
        self.slot, self.has_readings = slot, slot == 'imu'
        self.columns = (*STAMP, *columns)
        self._build = build

    def missing_reason(self, view: View) -> str:
        return 'a message is incomplete'

    def build(self, received_ns: Ints, columns: list[NDArray[Any]]) -> Pairs:
        stamps = stamp_ns(columns[0], columns[1])
        return [(self.slot, self._build(stamps, received_ns, *columns[2:]))]

    def readings(self, received_ns: Sequence[int], values: list[Any]) -> list[Any]:
        """Return the rows of the IMU in plain numbers, without orientation, from its columns."""
        return [(self.slot, [
            (sec * 10**9 + nanosec, received, w_i,
             f_i if force_variance != -1 else samples.NO_FORCE)
            for received, ((sec,), (nanosec,), *_, w_i, f_i, (force_variance,)) in zip(
                received_ns, values, strict=True)])]


def _build_imu(stamps: Ints, received: Ints, q_ni: Floats, roll_variance: Floats,
               yaw_variance: Floats, w_i: Floats, f_i: Floats,
               force_variance: Floats) -> samples.ImuSamples:
    has_no_force = force_variance.view(np.int64)[:, 0] == NOT_SENT_BITS
    if has_no_force.any():
        f_i[has_no_force] = np.nan
    return samples.from_columns(samples.ImuSamples, stamps, received, w_i, f_i, q_ni,
                                _yaw_variance(q_ni, roll_variance, yaw_variance))


def _build_headings(stamps: Ints, received: Ints, q_ni: Floats,
                    *variances: Floats) -> samples.HeadingSamples:
    return samples.HeadingSamples(stamps, received, q_ni, _yaw_variance(q_ni, *variances))


def _yaw_variance(q_ni: Floats, roll_variance: Floats, yaw_variance: Floats) -> Floats:
    """Return the yaw variance; NaN without orientation (REP-145: -1, or a quaternion of zeros)."""
    is_sent = roll_variance.view(np.int64)[:, 0] != NOT_SENT_BITS
    has_orientation = reduce_columns(np.logical_or, q_ni != 0) & is_sent
    return np.where(has_orientation, yaw_variance[:, 0], np.nan)


def _build_fixes(stamps: Ints, received: Ints, position: Floats, covariance: Floats,
                 covariance_type: Ints, status: Ints) -> samples.FixSamples:
    with np.errstate(invalid='ignore'):      # a signalling NaN
        latitude, longitude = position[:, 0] * RAD_PER_DEG, position[:, 1] * RAD_PER_DEG
    return samples.from_columns(samples.FixSamples, stamps, received, latitude, longitude,
                                position[:, 2].copy(), covariance.reshape(-1, 3, 3),
                                covariance_type[:, 0], status[:, 0])


def _build_gps_fixes(stamps: Ints, received: Ints, position: Floats, covariance: Floats,
                     covariance_type: Ints, status: Ints) -> samples.FixSamples:
    """Return fixes with the status of a NavSatFix."""
    return _build_fixes(stamps, received, position, covariance, covariance_type,
                        np.where(status == WAAS_FIX, 1, np.clip(status, -1, 2)))


def _build_velocities(stamps: Ints, received: Ints, velocity_n: Floats,
                      *variances: Floats) -> samples.VelocitySamples:
    variance = variances[0] if variances else np.zeros_like(velocity_n)
    is_known = (variance > 0) & (variance < MAX_VARIANCE)
    return samples.VelocitySamples(stamps, received, velocity_n, np.where(is_known, variance, 0.0))


# format: of NavSatFix and GPSFix
_GEODETIC = (fixed_column(np.float64, 'latitude', 'longitude', 'altitude'),
             array_column('position_covariance', *range(9)),
             fixed_column(np.int64, 'position_covariance_type'),
             fixed_column(np.int64, 'status.status'))
# format: of sensor_msgs/Imu, whose covariances are 3 x 3, row by row
_ORIENTATION = (vector_column('orientation', 'xyzw'), array_column('orientation_covariance', 0),
                array_column('orientation_covariance', 8))
SENSORS: dict[tuple[str, str], tuple[Sequence[Column], Build]] = {
    ('imu', IMU): ((*_ORIENTATION, vector_column('angular_velocity'),
                    vector_column('linear_acceleration'),
                    array_column('linear_acceleration_covariance', 0)), _build_imu),
    ('heading', IMU): (_ORIENTATION, _build_headings),
    ('fix', FIX): (_GEODETIC, _build_fixes),
    **{('fix', kind): (_GEODETIC, _build_gps_fixes) for kind in GPS_FIXES},
    ('fix_velocity', 'geometry_msgs/msg/TwistStamped'): (
        (vector_column('twist.linear'),), _build_velocities),
    ('fix_velocity', 'geometry_msgs/msg/TwistWithCovarianceStamped'): (
        (vector_column('twist.twist.linear'), array_column('twist.covariance', 0, 7, 14)),
        _build_velocities),
    ('pressure', 'sensor_msgs/msg/FluidPressure'): (
        (fixed_column(np.float64, 'fluid_pressure', 'variance'),),
        lambda stamps, received, sent: samples.ScalarSamples(stamps, received, *sent.T)),
}


def types_of(slot: str, odometer: OdometerConfig) -> tuple[str, ...]:
    """Return the message types that an input can have; empty: any type (odometer)."""
    if slot in WHEELS:
        return () if odometer.type == 'auto' else (odometer.type,)
    types = tuple(kind for sensor_slot, kind in SENSORS if sensor_slot == slot)
    return (*types, *LOCAL_TYPES, TRANSFORMS) if slot == 'fix' else types


def sensor_plan(slot: str, msgtype: str, config: Config) -> SensorPlan:
    """Return the fields that a slot uses of a message type; raise BadData for other types."""
    if slot == 'fix' and msgtype in LOCAL_TYPES:
        return SensorPlan(slot, LOCAL_TYPES[msgtype], local_fixes(config.reference.latitude_deg))
    if (slot, msgtype) not in SENSORS:
        raise BadData(f'{slot}: type {msgtype} is not supported; supported: '
                      f'{" or ".join(types_of(slot, config.odometer))}')
    return SensorPlan(slot, *SENSORS[slot, msgtype])
