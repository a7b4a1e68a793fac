# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Messages to samples: one set of readers for the wire and for bags.

A reader takes messages as they were serialised. Those of one layout are read as columns by
``messages.cdr``; any other goes through ``deserialize`` and gives the same row to the last bit.
"""

from collections.abc import Callable, Sequence
import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.samples import (
    FixSamples,
    HeadingSamples,
    ImuSamples,
    OdometerForm,
    Samples,
    VelocitySamples,
)
from odocal_ros.errors import BadData, OdocalError
from odocal_ros.messages import cdr
from odocal_ros.messages.fields import (
    array,
    Column,
    fixed,
    MessageView,
    STAMP,
    stamp_ns,
    View,
    xyz,
)
from odocal_ros.messages.odometer_types import OdometerPlan
from odocal_ros.settings.config import Config

HOPELESS = 20_000    # messages that gave nothing, after which odd ones are not looked at
RAD_PER_DEG = math.pi / 180
IMU = 'sensor_msgs/msg/Imu'
FIX = 'sensor_msgs/msg/NavSatFix'
VELOCITY = ('geometry_msgs/msg/TwistStamped', 'geometry_msgs/msg/TwistWithCovarianceStamped')
Pairs = list[tuple[str, Samples]]
Build = Callable[..., Samples]        # of stamps, arrivals and a slot's columns
Deserialize = Callable[[bytes], object]
Feed = Callable[[str, Samples], None]


class SensorPlan:
    """What to take from a stamped sensor message, and the samples it makes."""

    form: OdometerForm | None = None
    known = True         # its layout is all there is to learn of its type

    def __init__(self, slot: str, columns: Sequence[Column], build: Build) -> None:
        self.slot = slot
        self.columns = (*STAMP, *columns)
        self._build = build

    def ready(self, view: View) -> bool:
        """Return True: nothing is left to learn from the first message."""
        return True

    def missing(self, view: View) -> str:
        """Say why a message holds no value, for people."""
        return 'the fields of a message are not all there'

    def build(self, received_ns: Ints, columns: list[NDArray[Any]]) -> Pairs:
        """Return (slot, block) pairs."""
        stamps = stamp_ns(columns[0], columns[1])
        return [(self.slot, self._build(stamps, received_ns, *columns[2:]))]


class RowReader(Protocol):
    """What turns the messages of one topic into rows."""

    unreadable: int
    trouble: str

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Deserialize) -> Pairs:
        """Decode messages into (slot, rows)."""
        raise NotImplementedError


class Reader:
    """
    Reads the messages of one topic into samples; how they come chopped leaves no trace.

    ``unreadable`` counts messages that gave no row (damaged, or without the wheel asked for);
    ``trouble`` says why for the last of them.
    """

    def __init__(self, slot: str, msgtype: str, plan: SensorPlan | OdometerPlan) -> None:
        self.slot = slot
        self.msgtype = msgtype
        self.unreadable = 0
        self.trouble = ''
        self._plan = plan

    @property
    def form(self) -> OdometerForm | None:
        """Return what odometer values mean (certain once a message came); None for others."""
        return self._plan.form

    @property
    def wheels(self) -> tuple[str, ...]:
        """Return the keys (joints, indices) that odometer values are taken from, left first."""
        return self._plan.keys if isinstance(self._plan, OdometerPlan) else ()

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Deserialize) -> Pairs:
        """
        Decode messages.

        Parameters
        ----------
        raws : sequence of bytes
            Messages as serialised (CDR), in order of arrival.
        received_ns : sequence or array of int
            Their arrival; the stamp of messages that have none.
        deserialize : callable
            Turns one of them into an object with its fields; asked only where needed.

        Returns
        -------
        (slot, block) pairs, two for a message with two wheels, none without a row.

        Raises
        ------
        BadData
            The messages can never give what was asked: no such field, not a number.

        """
        plan = self._plan
        first = 0 if plan.columns else self._settled(raws, deserialize)
        raws, received_ns = raws[first:], received_ns[first:]
        n = len(raws)
        if not n:
            return []
        out: list[NDArray[Any]] = [np.empty((n, column.width), column.dtype)
                                   for column in plan.columns]
        good = np.ones(n, bool)
        for layout, rows, table in cdr.tables(self.msgtype, raws):
            if layout is None:
                for i in np.arange(n)[rows].tolist():
                    good[i] = self._one(out, i, raws[i], deserialize)
                continue
            for target, column in zip(out, plan.columns, strict=True):
                value = column.of_table(layout, table)
                if value is None:
                    good[rows] = False
                    self._lost(len(table), plan.missing(layout))
                    break
                target[rows] = value
        received = np.array(received_ns, np.int64)
        if not good.all():
            out, received = [values[good] for values in out], received[good]
        return plan.build(received, out) if len(received) else []

    def _settled(self, raws: Sequence[bytes], deserialize: Deserialize) -> int:
        """Let the plan see messages in order until it knows all; return how many told nothing."""
        for k, raw in enumerate(raws):
            view: View | None = cdr.layout_of(self.msgtype, raw) if self._plan.known else None
            if view is None:
                view = self._view(raw, deserialize)
            if view is not None and self._plan.ready(view):
                self.unreadable += k
                return k
            if view is not None:
                self.trouble = self._plan.missing(view)
        self.unreadable += len(raws)
        return len(raws)

    def _view(self, raw: bytes, deserialize: Deserialize) -> MessageView | None:
        """Return one message deserialised, None if that fails."""
        try:
            return MessageView(deserialize(raw))
        except OdocalError:
            raise
        except Exception as error:   # rclpy and rosbags each have their own way to fail
            why = ' '.join(str(error).split())[:200]
            self.trouble = f'cannot be deserialised as {self.msgtype}: {why}'
            return None

    def _one(self, out: list[NDArray[Any]], i: int, raw: bytes, deserialize: Deserialize) -> bool:
        """Read one message into row i; False: it gives none."""
        if self.unreadable > HOPELESS:      # trying costs a hundred times what reading does
            self.unreadable += 1
            return False
        view = self._view(raw, deserialize)
        if view is None:
            self.unreadable += 1
            return False
        try:
            values = [column.of_message(view) for column in self._plan.columns]
        except (AttributeError, LookupError, TypeError, ValueError):
            values = [None]
        if any(value is None for value in values):
            self._lost(1, self._plan.missing(view))
            return False
        for target, value in zip(out, values, strict=True):
            target[i] = value
        return True

    def _lost(self, count: int, why: str) -> None:
        self.unreadable += count
        self.trouble = why


def make_reader(slot: str, msgtype: str, config: Config) -> Reader:
    """
    Return the reader of a slot for messages of a type.

    Raises
    ------
    BadData, BadConfig
        The type cannot serve this slot, or not with these settings; the text says what would.

    """
    msgtype = full_type(msgtype)
    if slot in ('odometer', 'odometer_right'):
        return Reader(slot, msgtype, OdometerPlan(slot, msgtype, config))
    types = {'imu': (IMU,), 'heading': (IMU,), 'fix': (FIX,), 'fix_velocity': VELOCITY}[slot]
    if msgtype not in types:
        raise BadData(f'{slot}: messages of type {msgtype} cannot serve; give a topic of '
                      f'{" or ".join(types)}')
    return Reader(slot, msgtype, SensorPlan(slot, *_SENSORS[slot, msgtype]))


def full_type(msgtype: str) -> str:
    """Return 'pkg/msg/Type' for 'pkg/Type' too."""
    package, _, name = msgtype.rpartition('/')
    return f'{package}/msg/{name}' if package and '/' not in package else msgtype


def _imu(stamps: Ints, received: Ints, q_ni: Floats, covariance: Floats, w_i: Floats, f_i: Floats,
         of_force: Floats) -> ImuSamples:
    with np.errstate(invalid='ignore'):      # a NaN that signals
        f_i = np.where(of_force == -1, np.nan, f_i)       # REP-145: none is sent
    return ImuSamples(stamps, received, w_i, f_i, q_ni, _yaw_variance(q_ni, covariance))


def _heading(stamps: Ints, received: Ints, q_ni: Floats, covariance: Floats) -> HeadingSamples:
    return HeadingSamples(stamps, received, q_ni, _yaw_variance(q_ni, covariance))


def _yaw_variance(q_ni: Floats, covariance: Floats) -> Floats:
    """Return covariance[8], NaN where REP-145's -1 or an all-zero quaternion say 'none'."""
    none = (covariance[:, 0] == -1) | (q_ni == 0).all(axis=1)
    return np.where(none, np.nan, covariance[:, 1])


def _fix(stamps: Ints, received: Ints, position: Floats, covariance: Floats, known: Ints,
         status: Ints) -> FixSamples:
    with np.errstate(invalid='ignore'):      # a NaN that signals
        horizontal = position[:, :2] * RAD_PER_DEG
    return FixSamples(
        stamps, received, horizontal[:, 0], horizontal[:, 1],
        position[:, 2], covariance.reshape(-1, 3, 3), known[:, 0], status[:, 0])


def _velocity(stamps: Ints, received: Ints, velocity_n: Floats,
              *covariance: Floats) -> VelocitySamples:
    variance = covariance[0] if covariance else np.zeros_like(velocity_n)
    told = (variance > 0) & (variance < 1e12)       # else unknown
    return VelocitySamples(stamps, received, velocity_n, np.where(told, variance, 0.0))


_ORIENTATION = (xyz('orientation', 'xyzw'), array('orientation_covariance', 0, 8))
_SENSORS: dict[tuple[str, str], tuple[Sequence[Column], Build]] = {
    ('imu', IMU): ((*_ORIENTATION, xyz('angular_velocity'), xyz('linear_acceleration'),
                    array('linear_acceleration_covariance', 0)), _imu),
    ('heading', IMU): (_ORIENTATION, _heading),
    ('fix', FIX): ((fixed(np.float64, 'latitude', 'longitude', 'altitude'),
                    array('position_covariance', *range(9)),
                    fixed(np.int64, 'position_covariance_type'),
                    fixed(np.int64, 'status.status')), _fix),
    ('fix_velocity', VELOCITY[0]): ((xyz('twist.linear'),), _velocity),
    ('fix_velocity', VELOCITY[1]): (
        (xyz('twist.twist.linear'), array('twist.covariance', 0, 7, 14)), _velocity),
}
