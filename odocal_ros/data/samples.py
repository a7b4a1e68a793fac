# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Samples of the sensors: blocks of rows as read-only arrays, one array for each column.

Rows are in order of arrival and unchanged, including NaN and stale stamps; ``screening/screen.py``
selects the usable ones. ``stamp_ns`` is the header stamp (arrival if a message has none),
``received_ns`` the arrival (bag time, or the middleware's source stamp), which is used to compare
clocks and never in a result.
"""

from collections.abc import Iterable
from dataclasses import dataclass, Field, field, fields
import math
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Floats, Ints, Values
from odocal_ros.errors import BadData

# a row as Python numbers: stamp and arrival, ns, then the values in the order of the columns
Reading = tuple[Any, ...]
NO_FORCE = (math.nan, math.nan, math.nan)      # definition: m/s^2, no force published
FRAME_BYTES = 48     # judgement: length of a stored frame_id
# format: status of a position in a local frame; outside of int8, the type in a NavSatFix
LOCAL_STATUS = 1000


def column(*shape: int, dtype: Any = np.float64) -> Any:
    """Declare a column of samples: shape of one row, () for a number, and type of its values."""
    return field(metadata={'shape': shape, 'dtype': np.dtype(dtype)})


@dataclass(frozen=True, eq=False)
class Samples:
    """Rows of one topic; all columns are read-only arrays of the same length n."""

    stamp_ns: Ints = column(dtype=np.int64)       # (n,)
    received_ns: Ints = column(dtype=np.int64)    # (n,)

    def __post_init__(self) -> None:
        """Copy each column to a read-only array; raise BadData for a wrong shape."""
        n = len(self.stamp_ns)
        for declared in fields(self):
            name, shape = declared.name, (n, *declared.metadata['shape'])
            array = np.array(getattr(self, name), dtype=self._dtype(declared), order='C')
            if array.shape != shape:
                raise BadData(f'{type(self).__name__}.{name}: required shape {shape}, found '
                              f'{array.shape}')
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    def _dtype(self, declared: Field[Any]) -> Any:
        return declared.metadata['dtype']

    @classmethod
    def empty(cls) -> Self:
        """Return samples without rows."""
        return cls(*(np.empty((0, *declared.metadata['shape']), declared.metadata['dtype'])
                     for declared in fields(cls)))


@dataclass(frozen=True, eq=False)
class ImuSamples(Samples):
    """IMU rows, in the sensor's own frame i (before the nominal mounting rotation)."""

    w_i: Floats = column(3)        # rad/s, turn rate relative to inertial space
    f_i: Floats = column(3)        # m/s^2, specific force
    q_ni: Floats = column(4)       # x y z w, published orientation, i to ENU
    yaw_variance: Floats = column()    # rad^2; 0 unknown, NaN no orientation


@dataclass(frozen=True, eq=False)
class OtherImuSamples(Samples):
    """Messages on the IMU topic whose frame_id is not that of the IMU in use."""

    frame: NDArray[np.bytes_] = column(dtype=f'S{FRAME_BYTES}')    # frame_id, its first bytes
    used: NDArray[np.bytes_] = column(dtype=f'S{FRAME_BYTES}')     # frame_id of the IMU in use


@dataclass(frozen=True, eq=False)
class OdometerSamples(Samples):
    """Raw odometer rows; ``OdometerForm`` defines the meaning of the values."""

    value: Values = column()       # int64 for counters (uint64 as its int64 bits), else float64

    def _dtype(self, declared: Field[Any]) -> Any:
        is_integer = declared.name == 'value' and np.issubdtype(
            np.asarray(self.value).dtype, np.integer)
        return np.int64 if is_integer else super()._dtype(declared)


@dataclass(frozen=True)
class OdometerForm:
    """
    Meaning of an odometer value.

    ``quantity`` is ``cumulative`` (a counter or angle), ``increment`` (since the row before) or
    ``rate`` (m/s, or rad/s of a joint). ``modulus`` is the counter's span in counts, 0 for values
    that do not roll over. ``scale_unit`` is the unit of the scale factor: ``m/pulse``, ``m/rad``
    or ``1``. ``sides_known`` is false if it is not known which of two values is the left wheel's:
    only their mean has a meaning. ``selection_text`` explains an automatic selection of wheels.
    """

    quantity: str
    modulus: int
    scale_unit: str
    sides_known: bool = True
    selection_text: str = ''


@dataclass(frozen=True, eq=False)
class FixSamples(Samples):
    """
    GNSS fixes, or positions in a local frame with the status LOCAL_STATUS.

    A local frame has a fictitious place on the Earth (``nav/geodesy.py``); y is not north.
    """

    latitude: Floats = column()                     # rad
    longitude: Floats = column()                    # rad
    height: Floats = column()                       # m, ellipsoidal
    covariance_n: Floats = column(3, 3)             # m^2, ENU
    covariance_type: Ints = column(dtype=np.int64)  # 0 unknown .. 3 known
    status: Ints = column(dtype=np.int64)           # NavSatStatus: -1 no fix .. 2; or LOCAL_STATUS


@dataclass(frozen=True, eq=False)
class VelocitySamples(Samples):
    """GNSS velocity, ENU."""

    velocity_n: Floats = column(3)   # m/s
    variance_n: Floats = column(3)   # (m/s)^2, 0 unknown


@dataclass(frozen=True, eq=False)
class ScalarSamples(Samples):
    """A sensor of one number."""

    value: Floats = column()       # in the unit of the message
    variance: Floats = column()    # 0 unknown


@dataclass(frozen=True, eq=False)
class HeadingSamples(Samples):
    """External heading of the IMU's x axis, as ENU yaw."""

    q_ni: Floats = column(4)           # x y z w, as published
    yaw_variance: Floats = column()    # rad^2; 0 unknown, NaN no orientation


SomeSamples = TypeVar('SomeSamples', bound=Samples)


def take(samples: SomeSamples, index: slice | Ints | Bools) -> SomeSamples:
    """Return the rows selected by a numpy index, as the same type."""
    return from_columns(type(samples), *(column[index] for column in columns_of(samples)))


def join(blocks: Iterable[SomeSamples]) -> SomeSamples:
    """Return many blocks of one type as one block, in the order given."""
    blocks = list(blocks)
    if len(blocks) == 1:
        return blocks[0]
    columns = zip(*map(columns_of, blocks), strict=True)
    return from_columns(type(blocks[0]), *map(np.concatenate, columns))


def columns_of(samples: Samples) -> list[NDArray[Any]]:
    """Return the columns of samples, in the order of their fields."""
    return list(vars(samples).values())


def readings_of(samples: Samples) -> list[Reading]:
    """Return the rows as Python numbers, each vector as a list."""
    return list(zip(*(column.tolist() for column in columns_of(samples)), strict=True))


def from_columns(kind: type[SomeSamples], *columns: NDArray[Any]) -> SomeSamples:
    """Return samples of valid columns, without copies: no other code may write to the arrays."""
    samples = object.__new__(kind)
    for array in columns:
        array.setflags(write=False)
    vars(samples).update(zip(kind.__dataclass_fields__, columns, strict=True))
    return samples
