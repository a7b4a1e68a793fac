# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Decoding of serialised messages to samples: the same readers for live topics and for bags.

Messages of one layout (``messages/cdr.py``) are read as columns in numpy; others are deserialised
one by one, with bitwise equal rows. A plan states which fields are read, and builds the samples.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
import struct
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Ints
from odocal_ros.data.inputs import INPUTS, WHEELS
from odocal_ros.data.samples import OdometerForm, Reading, readings_of, Samples
from odocal_ros.errors import OdocalError
from odocal_ros.messages import cdr
from odocal_ros.messages.message_fields import (
    MessageView,
    Pairs,
    sensor_plan,
    SensorPlan,
    TRANSFORMS,
)
from odocal_ros.messages.odometer_types import OdometerPlan
from odocal_ros.messages.raws import FrameFilter, RawMessages, SMALL_BLOCK, Table, tables
from odocal_ros.settings.config import Config

# judgement: unreadable messages after which messages without a layout are skipped
UNREADABLE_LIMIT = 20_000
Deserialize = Callable[[bytes], object]      # CDR to an object of rclpy or rosbags
Feed = Callable[[str, Samples], None]        # receives a slot and its samples


class RowReader(Protocol):
    """What a bag calls with the messages of a topic: a ``Reader``, or a collector."""

    unreadable: int
    error: str

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Deserialize) -> Pairs: ...


class Reader:
    """
    Reads the messages of one topic into samples; block sizes have no effect.

    ``unreadable`` counts messages without a row (damaged, or without the selected wheel);
    ``error`` is the reason for the last of them.
    """

    def __init__(self, slot: str, msgtype: str, plan: SensorPlan | OdometerPlan) -> None:
        self.slot = slot
        self.msgtype = msgtype
        self.unreadable = 0
        self.error = ''
        self.frames: FrameFilter | None = None      # of an IMU
        self.uses_arrival = False      # as stamps, in place of those of the messages
        self._plan = plan
        # of the last block that ``_read_small_block`` has read
        self._layout: cdr.Layout | None = None
        self._record_type: np.dtype[Any] | None = None      # of its messages
        self._unpackers: list[cdr.Unpacker] = []       # functions that read its plain numbers

    @property
    def form(self) -> OdometerForm | None:
        """Return the meaning of odometer values, final after one message; None for others."""
        return self._plan.form

    @property
    def frame(self) -> str:
        """Return the frame_id of the IMU in use, empty if it is not known."""
        return self.frames.frame if self.frames is not None else ''

    @property
    def wheels(self) -> tuple[str, ...]:
        """Return the keys (joints, indices) of the odometer values, in order."""
        return self._plan.wheel_keys if isinstance(self._plan, OdometerPlan) else ()

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Deserialize) -> Pairs:
        """
        Decode messages.

        raws : serialised messages (CDR), in order of arrival.   received_ns : their arrival times,
        also used as stamps of messages without one.   deserialize : converts one to an object.

        Returns (slot, block) pairs, one for each wheel of a message, none without a row. Raises
        BadData: the message type cannot have the value: no such field, not a number.
        """
        other_imu = None
        if len(raws) > SMALL_BLOCK:
            raws = RawMessages.joined(raws)
        if self.frames is not None and len(raws):
            keep, other_imu = self.frames.separate(raws, received_ns, deserialize)
            if other_imu is not None:
                raws = RawMessages.joined(raws).take(keep)
                received_ns = np.asarray(received_ns, np.int64)[keep]
        pairs = self._rows(raws, received_ns, deserialize)
        if self.uses_arrival:
            pairs = [(slot, replace(block, stamp_ns=block.received_ns)) for slot, block in pairs]
        return pairs if other_imu is None else [*pairs, ('imu_other', other_imu)]

    def readings(self, raws: Sequence[bytes], received_ns: Sequence[int],
                 deserialize: Deserialize) -> list[tuple[str, list[Reading]]]:
        """
        Decode as ``rows``, but to plain numbers: a few messages take a fraction of the time.

        A reading has stamp and arrival, ns, then the first columns of the samples.
        """
        if (self._layout and self._unpackers and not self.uses_arrival
                and all(map(self._layout.fits, raws))
                and (self.frames is None or all(map(self.frames.is_used, raws)))):
            return self._plan.readings(received_ns, [
                [unpack(raw) for unpack in self._unpackers] for raw in raws])
        return [(slot, readings_of(block))
                for slot, block in self.rows(raws, received_ns, deserialize)]

    def _rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
              deserialize: Deserialize) -> Pairs:
        plan = self._plan
        if isinstance(plan, OdometerPlan) and not plan.columns:
            first = self._complete_plan(plan, raws, deserialize)
            raws, received_ns = raws[first:], received_ns[first:]
        if not len(raws):
            return []
        if columns := self._read_small_block(raws):
            return plan.build(np.array(received_ns, np.int64), columns)
        columns = [np.empty((len(raws), column.width), column.dtype) for column in plan.columns]
        has_row = np.ones(len(raws), bool)
        for layout, rows, table in tables(self.msgtype, raws):
            if layout is None:
                for i in np.arange(len(raws))[rows].tolist():
                    row = self._read_row(raws[i], deserialize)
                    has_row[i] = bool(row)
                    for column, value in zip(columns, row, strict=False):      # [] if unreadable
                        column[i] = value
            elif not (values := self._columns_of(layout, table)):
                has_row[rows] = False
            elif isinstance(rows, slice):       # all messages: no copy
                columns = values
            else:
                for column, value in zip(columns, values, strict=True):
                    column[rows] = value
        received = np.array(received_ns, np.int64)
        if not has_row.all():
            columns, received = [column[has_row] for column in columns], received[has_row]
        return plan.build(received, columns) if len(received) else []

    def _read_small_block(self, raws: Sequence[bytes]) -> list[NDArray[Any]]:
        """Return the columns of a few messages of one layout; [] if they have several or none."""
        layout = cdr.layout_of(self.msgtype, raws[0])
        if len(raws) > SMALL_BLOCK or layout is None or not all(map(layout.fits, raws)):
            return []
        columns = self._plan.columns
        if layout is not self._layout:
            self._layout = layout
            paths = [column.find_paths(layout) for column in columns]
            self._record_type = record_type = layout.record_type(paths)
            self._unpackers = [] if record_type is None or not self._plan.has_readings else (
                cdr.unpackers_of(record_type))
        if self._record_type is None:
            return []
        table = np.frombuffer(b''.join([raw[:layout.size] for raw in raws]), self._record_type)
        return [table[name].astype(column.dtype) for name, column in zip(
            self._record_type.names or (), columns, strict=True)]

    def _columns_of(self, layout: cdr.Layout, table: Table) -> list[NDArray[Any]]:
        """Return the columns of messages of one layout; [] if one is missing."""
        values: list[NDArray[Any]] = []
        for column in self._plan.columns:
            paths = column.find_paths(layout)
            value = layout.columns(table, paths) if paths else None
            if value is None:
                self._count_unreadable(len(table), self._plan.missing_reason(layout))
                return []
            values.append(np.asarray(value, column.dtype))
        return values

    def _complete_plan(self, plan: OdometerPlan, raws: Sequence[bytes],
                       deserialize: Deserialize) -> int:
        """Pass messages to the plan until it is complete; return the number of skipped ones."""
        for k, raw in enumerate(raws):
            layout = cdr.layout_of(self.msgtype, raw) if plan.is_known_type else None
            view = layout or self._message_view(raw, deserialize)
            if view and plan.complete(view):
                self.unreadable += k
                return k
            if view:
                self.error = plan.missing_reason(view)
        self.unreadable += len(raws)
        return len(raws)

    def _message_view(self, raw: bytes, deserialize: Deserialize) -> MessageView | None:
        try:
            return MessageView(deserialize(raw))
        except OdocalError:
            raise
        except Exception as error:   # rclpy and rosbags raise different errors
            field = cdr.damaged_field(self.msgtype, raw)
            reason = f'too short or damaged from {field} on' if field else (
                'too short or damaged' if isinstance(error, struct.error | ValueError | IndexError)
                else ' '.join(str(error).split())[:200])
            self.error = (f'a message of {len(raw)} bytes cannot be read as {self.msgtype}: '
                          f'{reason}')
            return None

    def _read_row(self, raw: bytes, deserialize: Deserialize) -> list[Any]:
        """Return the values of one message by column; [] if it has no row."""
        # deserialising takes a hundred times as long as a layout
        view = None if self.unreadable > UNREADABLE_LIMIT else self._message_view(raw, deserialize)
        if view is None:
            self.unreadable += 1
            return []
        try:
            values = [column.values_of(view) for column in self._plan.columns]
        except (AttributeError, LookupError, TypeError, ValueError):
            values = [[]]
        if not all(values):
            self._count_unreadable(1, self._plan.missing_reason(view))
            return []
        return values

    def _count_unreadable(self, count: int, reason: str) -> None:
        self.unreadable += count
        self.error = reason


def make_reader(slot: str, msgtype: str, config: Config) -> Reader:
    """Return the reader of a type for a slot; raise BadData, BadConfig if it cannot be used."""
    msgtype = full_type(msgtype)
    if slot == 'fix' and msgtype == TRANSFORMS:
        from odocal_ros.messages.transforms import TransformReader
        return TransformReader(config)
    reader = Reader(slot, msgtype, OdometerPlan(slot, msgtype, config) if slot in WHEELS
                    else sensor_plan(slot, msgtype, config))
    if clock := INPUTS[slot].clock:
        reader.uses_arrival = getattr(config, clock).arrival_time
    if slot == 'imu':
        reader.frames = FrameFilter(msgtype, config.imu.frame_id)
    return reader


def full_type(msgtype: str) -> str:
    """Return 'pkg/msg/Type', also for 'pkg/Type'."""
    package, _, name = msgtype.rpartition('/')
    return f'{package}/msg/{name}' if package and '/' not in package else msgtype
