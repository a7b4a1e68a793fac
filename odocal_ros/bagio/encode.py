# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Encoding of samples as ROS 2 messages (CDR, little endian), many at once in numpy.

Messages of one topic all have the same length (one frame_id, one set of joint names), so a block
of them is one structured array; no message objects are created.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats
from odocal_ros.data.samples import (
    FixSamples,
    HeadingSamples,
    ImuSamples,
    OdometerSamples,
    Samples,
    ScalarSamples,
    VelocitySamples,
)

VECTOR, SQUARE = ('<f8', 3), ('<f8', 9)    # format: of sensor_msgs and geometry_msgs


@dataclass(frozen=True, eq=False)
class Topic:
    """
    A topic to be written.

    time_ns : (n,) int64 bag times, in the order to be written.
    pack    : returns the serialised messages of a slice of rows as a structured array.
    """

    name: str
    msgtype: str
    time_ns: np.ndarray
    pack: Callable[[slice], np.ndarray]


class _Layout:
    """Collects the fields of a message, with the padding of CDR before them."""

    def __init__(self) -> None:
        self._fields: list[tuple[Any, ...]] = [('cdr', 'u1', 4)]
        self._size = 0
        self._texts: dict[str, bytes] = {}

    def add(self, name: str, kind: str | tuple[str, int], align: int | None = None) -> '_Layout':
        """Add a number, or a (number, count) array."""
        base, count = kind if isinstance(kind, tuple) else (kind, 1)
        item = np.dtype(base).itemsize
        gap = -self._size % (align or item)
        if gap:
            self._fields.append((f'gap {self._size}', 'u1', (gap,)))
        self._fields.append((name, base, (count,)) if count > 1 else (name, base))
        self._size += gap + item * count
        return self

    def text(self, name: str, text: str) -> '_Layout':
        """Add a string that is the same in every message."""
        raw = text.encode() + b'\0'
        self.add(f'{name} length', '<u4')
        self._fields.append((name, f'S{len(raw)}'))
        self._size += len(raw)
        self._texts[name] = raw
        return self

    def header(self, frame: str) -> '_Layout':
        return self.add('sec', '<i4').add('nanosec', '<u4').text('frame', frame)

    def packer(self, fill: Callable[[NDArray[Any], slice], None],
               n: int) -> Callable[[slice], NDArray[Any]]:
        """Return a function that packs a slice of n rows; ``fill`` sets the fields."""
        dtype, texts = np.dtype(self._fields), self._texts

        def pack(rows: slice) -> NDArray[Any]:
            out = np.zeros(len(range(*rows.indices(n))), dtype)
            out['cdr'] = (0, 1, 0, 0)      # little-endian
            for name, raw in texts.items():
                out[name], out[f'{name} length'] = raw, len(raw)
            fill(out, rows)
            return out
        return pack

    def topic(self, name: str, msgtype: str, samples: Samples,
              fill: Callable[[NDArray[Any], slice], None]) -> Topic:
        """Return the topic of stamped samples; ``fill`` sets the fields except the stamp."""
        def stamped(out: NDArray[Any], rows: slice) -> None:
            out['sec'], out['nanosec'] = np.divmod(samples.stamp_ns[rows], 10**9)
            fill(out, rows)
        return Topic(name, msgtype, samples.received_ns,
                     self.packer(stamped, len(samples.stamp_ns)))


def _imu_layout(frame: str) -> _Layout:
    layout = _Layout().header(frame)
    for field, kind in (('q', ('<f8', 4)), ('q_cov', SQUARE), ('w', VECTOR), ('w_cov', SQUARE),
                        ('f', VECTOR), ('f_cov', SQUARE)):
        layout.add(field, kind)
    return layout


def imu(name: str, samples: ImuSamples, frame: str = 'imu_link', w_variance: Floats | None = None,
        f_variance: Floats | None = None) -> Topic:
    """
    Return sensor_msgs/Imu of ImuSamples; without orientation if the yaw variance is NaN.

    w_variance, f_variance : (n, 3), optional, of turn rates and forces; default zeros: unknown.
    """
    def fill(out: NDArray[Any], rows: slice) -> None:
        out['w'], out['f'] = samples.w_i[rows], samples.f_i[rows]
        for field, variance in (('w_cov', w_variance), ('f_cov', f_variance)):
            if variance is not None:
                out[field][:, ::4] = variance[rows]
        _orientation(out, samples.q_ni[rows], samples.yaw_variance[rows])
    return _imu_layout(frame).topic(name, 'sensor_msgs/msg/Imu', samples, fill)


def heading(name: str, samples: HeadingSamples, frame: str = 'imu_link') -> Topic:
    """Return sensor_msgs/Imu of HeadingSamples: an orientation, no rates (covariance -1)."""
    def fill(out: NDArray[Any], rows: slice) -> None:
        out['w_cov'][:, 0] = out['f_cov'][:, 0] = -1.0
        _orientation(out, samples.q_ni[rows], samples.yaw_variance[rows])
    return _imu_layout(frame).topic(name, 'sensor_msgs/msg/Imu', samples, fill)


def _orientation(out: NDArray[Any], q_ni: Floats, variance: Floats) -> None:
    out['q'] = q_ni
    out['q_cov'][:, ::4] = np.where(np.isnan(variance), 0.0, variance)[:, None]
    out['q_cov'][np.isnan(variance), 0] = -1.0


def counter(name: str, samples: OdometerSamples) -> Topic:
    """Return std_msgs/Int64 of OdometerSamples: no header, so the bag time is the stamp."""
    def fill(out: NDArray[Any], rows: slice) -> None:
        out['data'] = samples.value[rows]
    return Topic(name, 'std_msgs/msg/Int64', samples.stamp_ns,
                 _Layout().add('data', '<i8').packer(fill, len(samples.stamp_ns)))


def twist(name: str, samples: OdometerSamples, frame: str = 'base_link') -> Topic:
    """Return geometry_msgs/TwistStamped of OdometerSamples: forward speed, the rest zero."""
    layout = _Layout().header(frame).add('linear', VECTOR).add('angular', VECTOR)

    def fill(out: NDArray[Any], rows: slice) -> None:
        out['linear'][:, 0] = samples.value[rows]
    return layout.topic(name, 'geometry_msgs/msg/TwistStamped', samples, fill)


def joints(name: str, wheels: dict[str, OdometerSamples], frame: str = '',
           rates: bool = False) -> Topic:
    """Return sensor_msgs/JointState of OdometerSamples by joint: positions, or rates, only."""
    first = next(iter(wheels.values()))
    layout = _Layout().header(frame).add('names', '<u4')
    for joint in wheels:
        layout.text(f'joint {joint}', joint)
    given = 'velocities' if rates else 'positions'
    for field in ('positions', 'velocities', 'efforts'):
        layout.add(field, '<u4')
        for joint in wheels if field == given else ():
            layout.add(joint, '<f8')

    def fill(out: NDArray[Any], rows: slice) -> None:
        out['names'] = out[given] = len(wheels)
        for joint, samples in wheels.items():
            out[joint] = samples.value[rows]
    return layout.topic(name, 'sensor_msgs/msg/JointState', first, fill)


def fix(name: str, samples: FixSamples, frame: str = 'gnss') -> Topic:
    layout = (_Layout().header(frame).add('status', 'i1').add('service', '<u2')
              .add('place', VECTOR).add('cov', SQUARE).add('cov_type', 'u1'))

    def fill(out: NDArray[Any], rows: slice) -> None:
        out['status'], out['service'] = samples.status[rows], 1
        out['place'][:, 0] = np.degrees(samples.latitude[rows])
        out['place'][:, 1] = np.degrees(samples.longitude[rows])
        out['place'][:, 2] = samples.height[rows]
        out['cov'] = samples.covariance_n[rows].reshape(-1, 9)
        out['cov_type'] = samples.covariance_type[rows]
    return layout.topic(name, 'sensor_msgs/msg/NavSatFix', samples, fill)


def point(name: str, samples: FixSamples, position: Floats, frame: str = 'map') -> Topic:
    """Return geometry_msgs/PointStamped of positions, (n, 3) m, at the times of FixSamples."""
    return _positions(name, 'PointStamped', samples, position,
                      _Layout().header(frame).add('place', VECTOR))


def pose(name: str, samples: FixSamples, position: Floats, frame: str = 'map') -> Topic:
    """Return geometry_msgs/PoseStamped of such positions, without a rotation."""
    return _positions(name, 'PoseStamped', samples, position,
                      _Layout().header(frame).add('place', VECTOR).add('q', ('<f8', 4)))


def pose_with_covariance(name: str, samples: FixSamples, position: Floats,
                         frame: str = 'map') -> Topic:
    return _positions(name, 'PoseWithCovarianceStamped', samples, position,
                      _Layout().header(frame).add('place', VECTOR).add('q', ('<f8', 4)).add(
                          'cov', ('<f8', 36)))


def _positions(name: str, kind: str, samples: FixSamples, position: Floats,
               layout: _Layout) -> Topic:
    """Return a topic of positions, with rotation and covariance if the layout has them."""
    def fill(out: NDArray[Any], rows: slice) -> None:
        fields = out.dtype.names or ()
        out['place'] = position[rows]
        if 'q' in fields:
            out['q'][:, 3] = 1.0
        if 'cov' in fields:
            square = out['cov'].reshape(-1, 6, 6)
            square[:, :3, :3] = samples.covariance_n[rows]
            out['cov'] = square.reshape(-1, 36)
    return layout.topic(name, f'geometry_msgs/msg/{kind}', samples, fill)


def velocity(name: str, samples: VelocitySamples, frame: str = 'gnss') -> Topic:
    """Return geometry_msgs/TwistWithCovarianceStamped of VelocitySamples; no angular rates."""
    layout = _Layout().header(frame).add('linear', VECTOR).add('angular', VECTOR).add(
        'cov', ('<f8', 36))

    def fill(out: NDArray[Any], rows: slice) -> None:
        out['linear'] = samples.velocity_n[rows]
        out['cov'][:, :15:7] = samples.variance_n[rows]
    return layout.topic(name, 'geometry_msgs/msg/TwistWithCovarianceStamped', samples, fill)


def pressure(name: str, samples: ScalarSamples, frame: str = 'imu') -> Topic:
    layout = _Layout().header(frame).add('values', ('<f8', 2))

    def fill(out: NDArray[Any], rows: slice) -> None:
        out['values'][:, 0], out['values'][:, 1] = samples.value[rows], samples.variance[rows]
    return layout.topic(name, 'sensor_msgs/msg/FluidPressure', samples, fill)


def camera(name: str, times_ns: Sequence[int], size: int, rng: np.random.Generator) -> Topic:
    """Return sensor_msgs/CompressedImage of ``size`` random bytes each, for a large bag."""
    time_ns = np.asarray(times_ns, dtype=np.int64)
    layout = (_Layout().header('camera').text('format', 'jpeg').add('bytes', '<u4')
              .add('data', ('u1', size)))

    def fill(out: NDArray[Any], rows: slice) -> None:
        out['sec'], out['nanosec'] = np.divmod(time_ns[rows], 10**9)
        out['bytes'] = size
        out['data'] = np.frombuffer(rng.bytes(out['data'].size), np.uint8).reshape(-1, size)
    return Topic(name, 'sensor_msgs/msg/CompressedImage', time_ns,
                 layout.packer(fill, len(time_ns)))
