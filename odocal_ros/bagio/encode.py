# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Samples as serialised messages (CDR), for bags of simulated drives.

In: samples as arrays. Out: a ``Topic``: all its messages have one length, so that numpy writes
the fields of all of them at once.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data import samples as data
from odocal_ros.data.arrays import Floats
from odocal_ros.messages import cdr

SCHEMAS = cdr.SCHEMAS | {      # types that are written, but not read as columns
    'sensor_msgs/msg/FluidPressure': (
        *cdr.HEADER, 'float64 fluid_pressure', 'float64 variance')}
# a column of all messages, or a function that returns the values of a slice of them
Values = Mapping[str, NDArray[Any] | Callable[[slice], Any]]


@dataclass(frozen=True, eq=False)
class Topic:
    """A topic to be written."""

    name: str
    msgtype: str
    time_ns: np.ndarray                    # (n,) int64 bag times, in the order to be written
    pack: Callable[[slice], np.ndarray]    # serialised messages of rows, as a structured array


def _message_template(msgtype: str, variable_parts: Mapping[str, Any]
                      ) -> tuple[bytes, dict[str, tuple[Any, ...]]]:
    """
    Return a message of zeros, and (type, shape), offset of each number by path.

    variable_parts : texts, lists of texts, and lengths of lists of numbers, by path; default ''
    and 0.
    """
    raw, places = bytearray((0, 1, 0, 0)), {}      # XCDR1, little-endian

    def add(alignment: int, content: bytes) -> int:
        """Add content, aligned relative to byte 4; return its offset."""
        raw.extend(bytes((4 - len(raw)) % alignment) + content)
        return len(raw) - len(content)
    for kind, path in map(str.split, SCHEMAS[msgtype]):
        base, _, size = kind.partition('[')
        part = variable_parts.get(path, '' if base == 'string' else 0)
        if size == ']':
            add(4, struct.pack('<I', part if base in cdr.NUMPY_TYPES else len(part)))
        if base == 'string':
            for text in part if size else [part]:
                add(4, struct.pack('<I', len(text.encode()) + 1))
                add(1, text.encode() + b'\0')
        else:
            count = 1 if not size else part if size == ']' else int(size[:-1])
            item = np.dtype(cdr.NUMPY_TYPES[base]).itemsize
            offset = add(item if count else 1, bytes(item * count))
            places[path] = (cdr.NUMPY_TYPES[base], (count,) if size else ()), offset
    return bytes(raw), places


def _topic(name: str, msgtype: str, time_ns: NDArray[np.int64], values: Values,
           variable_parts: Mapping[str, Any]) -> Topic:
    """Return a topic; x, y, z (and w) together have the path of their parent in ``values``."""
    raw, places = _message_template(msgtype, variable_parts)
    formats, offsets = [], []
    for path in values:
        numbers = [place for number_path, place in places.items()
                   if f'{number_path}.'.startswith(f'{path}.')]
        (number_type, shape), offset = numbers[0]
        formats.append((number_type, shape if len(numbers) == 1 else (len(numbers),)))
        offsets.append(offset)
    # the field of all bytes is copied with the others, so that bytes without a value are, too
    dtype = np.dtype({'names': [*values, 'message'], 'formats': [*formats, f'V{len(raw)}'],
                      'offsets': [*offsets, 0]})

    def pack(rows: slice) -> NDArray[Any]:
        table = np.empty((len(range(*rows.indices(len(time_ns)))), len(raw)), np.uint8)
        table[:] = np.frombuffer(raw, np.uint8)
        out: NDArray[Any] = table.view(dtype)[:, 0]
        for path, value in values.items():
            out[path] = value(rows) if callable(value) else value[rows]
        return out
    return Topic(name, msgtype, time_ns, pack)


def _stamped_topic(name: str, msgtype: str, samples: data.Samples, frame: str, values: Values,
                   variable_parts: Mapping[str, Any] | None = None) -> Topic:
    """Return a topic of samples whose messages have a header."""
    stamps = {'header.stamp.sec': lambda rows: samples.stamp_ns[rows] // 10**9,
              'header.stamp.nanosec': lambda rows: samples.stamp_ns[rows] % 10**9}
    return _topic(name, msgtype, samples.received_ns, {**stamps, **values},
                  {'header.frame_id': frame, **(variable_parts or {})})


def _diagonal(variance: Floats, size: int = 3) -> Callable[[slice], Floats]:
    """Return a function for square covariances, row by row, of variances (n, 3) or (n, 1)."""
    def covariance(rows: slice) -> Floats:
        out = np.zeros((len(variance[rows]), size, size))
        out[:, range(3), range(3)] = variance[rows]
        return out.reshape(-1, size**2)
    return covariance


def imu(name: str, samples: data.ImuSamples, frame: str = 'imu_link',
        w_variance: Floats | None = None, f_variance: Floats | None = None) -> Topic:
    """Return sensor_msgs/Imu, without orientation if its variance is NaN; variances : (n, 3)."""
    covariances = {f'{field}_covariance': _diagonal(variance) for field, variance in (
        ('angular_velocity', w_variance), ('linear_acceleration', f_variance))
        if variance is not None}
    return _stamped_topic(name, 'sensor_msgs/msg/Imu', samples, frame, {
        **_orientation(samples), 'angular_velocity': samples.w_i,
        'linear_acceleration': samples.f_i, **covariances})


def heading(name: str, samples: data.HeadingSamples) -> Topic:
    """Return sensor_msgs/Imu of HeadingSamples: an orientation, no rates (covariance -1)."""
    return _stamped_topic(name, 'sensor_msgs/msg/Imu', samples, 'imu_link', {
        **_orientation(samples), 'angular_velocity_covariance': _not_sent,
        'linear_acceleration_covariance': _not_sent})


def _not_sent(_rows: slice) -> Floats:
    """Return the covariance of a value that is not sent (REP-145)."""
    return np.array([-1.0, *[0.0] * 8])


def _orientation(samples: data.ImuSamples | data.HeadingSamples) -> Values:
    not_sent = np.isnan(samples.yaw_variance)
    diagonal = _diagonal(np.where(not_sent, 0.0, samples.yaw_variance)[:, None])

    def covariance(rows: slice) -> Floats:
        out = diagonal(rows)
        out[not_sent[rows], 0] = -1.0      # REP-145
        return out
    return {'orientation': samples.q_ni, 'orientation_covariance': covariance}


def counter(name: str, samples: data.OdometerSamples) -> Topic:
    """Return std_msgs/Int64 of OdometerSamples: no header, so the bag time is the stamp."""
    return _topic(name, 'std_msgs/msg/Int64', samples.stamp_ns, {'data': samples.value}, {})


def twist(name: str, samples: data.OdometerSamples, frame: str = 'base_link') -> Topic:
    """Return geometry_msgs/TwistStamped of OdometerSamples: forward speed, the rest zero."""
    return _stamped_topic(name, 'geometry_msgs/msg/TwistStamped', samples, frame,
                          {'twist.linear.x': samples.value})


def joints(name: str, wheels: dict[str, data.OdometerSamples], frame: str = '',
           rates: bool = False) -> Topic:
    """Return sensor_msgs/JointState of OdometerSamples by joint: positions, or rates, only."""
    first, *_ = columns = list(wheels.values())
    quantity = 'velocity' if rates else 'position'
    return _stamped_topic(
        name, 'sensor_msgs/msg/JointState', first, frame,
        {quantity: lambda rows: np.column_stack([wheel.value[rows] for wheel in columns])},
        {'name': list(wheels), quantity: len(columns)})


def fix(name: str, samples: data.FixSamples, frame: str = 'gnss') -> Topic:
    return _stamped_topic(name, 'sensor_msgs/msg/NavSatFix', samples, frame, {
        'status.status': samples.status, 'status.service': lambda rows: 1,
        'latitude': lambda rows: np.degrees(samples.latitude[rows]),
        'longitude': lambda rows: np.degrees(samples.longitude[rows]), 'altitude': samples.height,
        'position_covariance': samples.covariance_n.reshape(-1, 9),
        'position_covariance_type': samples.covariance_type})


def point(name: str, samples: data.FixSamples, position: Floats) -> Topic:
    """Return geometry_msgs/PointStamped of positions, (n, 3) m, at the times of FixSamples."""
    return _stamped_topic(name, 'geometry_msgs/msg/PointStamped', samples, 'map',
                          {'point': position})


def pose(name: str, samples: data.FixSamples, position: Floats, frame: str = 'map') -> Topic:
    """Return geometry_msgs/PoseStamped of positions, (n, 3) m, without a rotation."""
    return _stamped_topic(name, 'geometry_msgs/msg/PoseStamped', samples, frame, {
        'pose.position': position, 'pose.orientation.w': lambda rows: 1.0})


def pose_with_covariance(name: str, samples: data.FixSamples, position: Floats) -> Topic:
    def covariance(rows: slice) -> Floats:
        return np.pad(samples.covariance_n[rows], ((0, 0), (0, 3), (0, 3))).reshape(-1, 36)
    return _stamped_topic(name, 'geometry_msgs/msg/PoseWithCovarianceStamped', samples, 'map', {
        'pose.pose.position': position, 'pose.pose.orientation.w': lambda rows: 1.0,
        'pose.covariance': covariance})


def velocity(name: str, samples: data.VelocitySamples) -> Topic:
    """Return geometry_msgs/TwistWithCovarianceStamped of VelocitySamples; no angular rates."""
    return _stamped_topic(name, 'geometry_msgs/msg/TwistWithCovarianceStamped', samples, 'gnss', {
        'twist.twist.linear': samples.velocity_n,
        'twist.covariance': _diagonal(samples.variance_n, 6)})


def pressure(name: str, samples: data.ScalarSamples) -> Topic:
    return _stamped_topic(name, 'sensor_msgs/msg/FluidPressure', samples, 'imu', {
        'fluid_pressure': samples.value, 'variance': samples.variance})
