# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Samples: what the sensors said, as frozen arrays, one row or a million.

Rows stand in order of arrival and hold what was sent, NaN and stale stamps included;
``screening/screen.py`` decides what is usable. ``stamp_ns`` is the header stamp (arrival where a
message has none), ``received_ns`` the arrival (bag time, or the middleware's source stamp): it
is used to compare clocks and never enters a result.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Floats, Ints, Values
from odocal_ros.errors import BadData

Stamps = Ints
# definition: of no rows
NO_STAMPS = np.empty(0, np.int64)
FRAME_BYTES = 48     # judgement: of a frame_id that is shown
FRAME = f'S{FRAME_BYTES}'
# format: status of a position in a local frame; that of a NavSatFix is an int8
LOCAL = 1000
NONE, NONE_OF_3, NONE_OF_4 = np.empty(0), np.empty((0, 3)), np.empty((0, 4))


@dataclass(frozen=True, eq=False)
class ImuSamples:
    """IMU rows, in the sensor's own frame i (before the nominal mounting rotation)."""

    stamp_ns: Stamps      # (n,)
    received_ns: Stamps   # (n,)
    w_i: Floats           # (n, 3) rad/s, turn rate against inertial space
    f_i: Floats           # (n, 3) m/s^2, specific force
    q_ni: Floats          # (n, 4) x y z w, orientation as sent: takes i to ENU
    yaw_variance: Floats  # (n,)   rad^2, orientation_covariance[8]; 0 unknown, NaN no orientation

    def __post_init__(self) -> None:
        freeze(self, w_i=(3,), f_i=(3,), q_ni=(4,), yaw_variance=())


@dataclass(frozen=True, eq=False)
class OtherImuSamples:
    """Messages on the IMU topic that are of another frame_id than the IMU in use."""

    stamp_ns: Stamps      # (n,)
    received_ns: Stamps   # (n,)
    frame: NDArray[np.bytes_]     # (n,) frame_id as sent, the first FRAME_BYTES
    used: NDArray[np.bytes_]      # (n,) frame_id of the IMU in use

    def __post_init__(self) -> None:
        freeze(self, frame=((), FRAME), used=((), FRAME))


@dataclass(frozen=True, eq=False)
class OdometerSamples:
    """Odometer rows as sent; ``OdometerForm`` says what the value means."""

    stamp_ns: Stamps     # (n,)
    received_ns: Stamps  # (n,)
    value: Values        # (n,) int64 for counters (uint64 as its int64 bits), else float64

    def __post_init__(self) -> None:
        whole = np.issubdtype(np.asarray(self.value).dtype, np.integer)
        freeze(self, value=((), np.int64 if whole else np.float64))


@dataclass(frozen=True)
class OdometerForm:
    """
    What an odometer value means.

    ``quantity`` is ``cumulative`` (a counter or angle), ``increment`` (since the row before) or
    ``rate`` (m/s, or rad/s of a joint). ``modulus`` is the counter's span in counts, 0 for values
    that do not roll over. ``scale_unit`` is the unit of the scale factor: ``m/pulse``, ``m/rad``
    or ``1``. ``sides`` is false for two values with unknown sides (left or right wheel):
    only their mean has a meaning. ``chosen`` says what the reader took of a message, unasked.
    """

    quantity: str
    modulus: int
    scale_unit: str
    sides: bool = True
    chosen: str = ''


@dataclass(frozen=True, eq=False)
class FixSamples:
    """
    GNSS fixes, or positions in a local frame: those have the status LOCAL.

    A local frame is placed on the Earth where no vehicle is (``nav/local_frame.py``): x, y
    and z are then east, north and up, but its y axis does not point to north.
    """

    stamp_ns: Stamps           # (n,)
    received_ns: Stamps        # (n,)
    latitude: Floats           # (n,) rad
    longitude: Floats          # (n,) rad
    height: Floats             # (n,) m, ellipsoidal
    covariance_n: Floats       # (n, 3, 3) m^2, ENU
    covariance_type: Ints      # (n,) 0 unknown .. 3 known
    status: Ints               # (n,) NavSatStatus: -1 no fix .. 2; or LOCAL

    def __post_init__(self) -> None:
        freeze(self, latitude=(), longitude=(), height=(), covariance_n=(3, 3),
               covariance_type=((), np.int64), status=((), np.int64))


@dataclass(frozen=True, eq=False)
class VelocitySamples:
    """GNSS velocity, ENU."""

    stamp_ns: Stamps     # (n,)
    received_ns: Stamps  # (n,)
    velocity_n: Floats   # (n, 3) m/s
    variance_n: Floats   # (n, 3) (m/s)^2, 0 unknown

    def __post_init__(self) -> None:
        freeze(self, velocity_n=(3,), variance_n=(3,))


@dataclass(frozen=True, eq=False)
class HeadingSamples:
    """Outside heading of the IMU's x axis, as ENU yaw."""

    stamp_ns: Stamps      # (n,)
    received_ns: Stamps   # (n,)
    q_ni: Floats          # (n, 4) x y z w, as sent
    yaw_variance: Floats  # (n,) rad^2; 0 unknown, NaN no orientation

    def __post_init__(self) -> None:
        freeze(self, q_ni=(4,), yaw_variance=())


Samples = (ImuSamples | OtherImuSamples | OdometerSamples | FixSamples | VelocitySamples
           | HeadingSamples)
SomeSamples = TypeVar('SomeSamples', bound=Samples)
Index = slice | Ints | Bools      # of rows


def freeze(owner: Samples, **rows: Any) -> None:
    """Swap each field for a read-only array; rows give the shape after n, or (shape, dtype)."""
    n = len(owner.stamp_ns)
    wanted = {'stamp_ns': ((), np.int64), 'received_ns': ((), np.int64)} | rows
    for name, row in wanted.items():
        shape, dtype = row if row and isinstance(row[0], tuple) else (row, np.float64)
        given = np.asarray(getattr(owner, name))
        array = np.array(given, dtype=dtype, order='C')
        if array.shape != (n, *shape):
            raise BadData(f'{type(owner).__name__}.{name}: required shape {(n, *shape)}, found '
                          f'{array.shape}')
        array.setflags(write=False)
        object.__setattr__(owner, name, array)


def take(samples: SomeSamples, index: Index) -> SomeSamples:
    """Return the rows that a numpy index picks, as the same type."""
    return of_columns(type(samples), *(column[index] for column in columns_of(samples)))


def join(blocks: Iterable[SomeSamples]) -> SomeSamples:
    """Return many blocks of one type as one block, in the order given."""
    blocks = list(blocks)
    if len(blocks) == 1:
        return blocks[0]
    return of_columns(type(blocks[0]), *map(np.concatenate, zip(*map(columns_of, blocks),
                                                                strict=True)))


def columns_of(samples: Samples) -> list[NDArray[Any]]:
    """Return the columns of samples, in the order of their fields."""
    return list(vars(samples).values())


def of_columns(kind: type[SomeSamples], *columns: NDArray[Any]) -> SomeSamples:
    """Return samples of arrays that were checked before and that nobody else holds: no copy."""
    samples = object.__new__(kind)
    for name, array in zip(kind.__dataclass_fields__, columns, strict=True):
        array.setflags(write=False)
        object.__setattr__(samples, name, array)
    return samples


def no_imu() -> ImuSamples:
    """Return an empty block."""
    return ImuSamples(NO_STAMPS, NO_STAMPS, NONE_OF_3, NONE_OF_3, NONE_OF_4, NONE)


def no_other_imu() -> OtherImuSamples:
    """Return an empty block."""
    return OtherImuSamples(NO_STAMPS, NO_STAMPS, np.empty(0, FRAME), np.empty(0, FRAME))


def no_odometer() -> OdometerSamples:
    """Return an empty block."""
    return OdometerSamples(NO_STAMPS, NO_STAMPS, NONE)


def no_fix() -> FixSamples:
    """Return an empty block."""
    return FixSamples(NO_STAMPS, NO_STAMPS, NONE, NONE, NONE, np.empty((0, 3, 3)), NO_STAMPS,
                      NO_STAMPS)


def no_velocity() -> VelocitySamples:
    """Return an empty block."""
    return VelocitySamples(NO_STAMPS, NO_STAMPS, NONE_OF_3, NONE_OF_3)


def no_heading() -> HeadingSamples:
    """Return an empty block."""
    return HeadingSamples(NO_STAMPS, NO_STAMPS, NONE_OF_4, NONE)
