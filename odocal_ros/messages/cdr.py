# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Decode many serialised messages at once with numpy, without a ROS or rosbags import.

Messages whose variable parts (strings, lists) have the same lengths have their fields at the
same bytes: one message tells the layout, the others are read as columns. What has no such layout
(big endian, unknown type, damaged) is left to the caller.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Ints
from odocal_ros.messages.raws import Raws, Rows

MAX_LAYOUTS = 16   # per call; a stream with more is odd enough to be read message by message
KINDS = {'int8': '<i1', 'uint8': '<u1', 'int16': '<i2', 'uint16': '<u2', 'int32': '<i4',
         'uint32': '<u4', 'int64': '<i8', 'uint64': '<u8', 'float32': '<f4', 'float64': '<f8'}
INDEXED = re.compile(r'(.+)\[(\d+)\]')


def _each(kind: str, prefix: str, names: str) -> tuple[str, ...]:
    return tuple(f'{kind} {prefix}.{name}' for name in names)


def _twist(prefix: str) -> tuple[str, ...]:
    return (_each('float64', f'{prefix}.linear', 'xyz')
            + _each('float64', f'{prefix}.angular', 'xyz'))


_HEADER = ('int32 header.stamp.sec', 'uint32 header.stamp.nanosec', 'string header.frame_id')
FRAME_AT = 16       # where the text of _HEADER stands
_LAYOUT = ('dim[] layout.dim', 'uint32 layout.data_offset')
_DIM = ('string label', 'uint32 size', 'uint32 stride')

# 'kind path', in order; kind[n] is an array, kind[] a list
SCHEMAS: dict[str, tuple[str, ...]] = {
    'sensor_msgs/msg/Imu': (
        *_HEADER, *_each('float64', 'orientation', 'xyzw'), 'float64[9] orientation_covariance',
        *_each('float64', 'angular_velocity', 'xyz'), 'float64[9] angular_velocity_covariance',
        *_each('float64', 'linear_acceleration', 'xyz'),
        'float64[9] linear_acceleration_covariance'),
    'sensor_msgs/msg/NavSatFix': (
        *_HEADER, 'int8 status.status', 'uint16 status.service', 'float64 latitude',
        'float64 longitude', 'float64 altitude', 'float64[9] position_covariance',
        'uint8 position_covariance_type'),
    'sensor_msgs/msg/JointState': (
        *_HEADER, 'string[] name', 'float64[] position', 'float64[] velocity', 'float64[] effort'),
    'geometry_msgs/msg/Twist': (
        *_each('float64', 'linear', 'xyz'), *_each('float64', 'angular', 'xyz')),
    'geometry_msgs/msg/TwistStamped': (*_HEADER, *_twist('twist')),
    'geometry_msgs/msg/TwistWithCovarianceStamped': (
        *_HEADER, *_twist('twist.twist'), 'float64[36] twist.covariance'),
    'nav_msgs/msg/Odometry': (
        *_HEADER, 'string child_frame_id', *_each('float64', 'pose.pose.position', 'xyz'),
        *_each('float64', 'pose.pose.orientation', 'xyzw'), 'float64[36] pose.covariance',
        *_twist('twist.twist'), 'float64[36] twist.covariance'),
    'std_msgs/msg/Int32MultiArray': (*_LAYOUT, 'int32[] data'),
    'std_msgs/msg/Int64MultiArray': (*_LAYOUT, 'int64[] data'),
} | {f'std_msgs/msg/{name}': (f'{name.lower()} data',) for name in (
    'Int16', 'UInt16', 'Int32', 'UInt32', 'Int64', 'UInt64', 'Float32', 'Float64')}


@dataclass
class Layout:
    """Where the fields of one message lie, and which bytes all messages like it share."""

    places: dict[str, tuple[int, str]] = field(default_factory=dict)       # offset, dtype
    lists: dict[str, tuple[int, str, int]] = field(default_factory=dict)   # and how many values
    texts: dict[str, list[str]] = field(default_factory=dict)              # lists of strings
    fixed: list[tuple[int, int]] = field(default_factory=lambda: [(0, 2)])
    size: int = 4

    @property
    def names(self) -> list[str]:
        """Return the list ``name`` (of joints), empty where there is none."""
        return self.texts.get('name', [])

    def count(self, path: str) -> int:
        """Return how many values a list has, 0 if it is not there."""
        return self.lists[path][2] if path in self.lists else 0

    def find(self, path: str) -> tuple[int, str] | None:
        """Return offset and dtype of a value, ``path[i]`` in a list; None if it is not there."""
        if path in self.places:
            return self.places[path]
        match = INDEXED.fullmatch(path)
        if match and int(match[2]) < self.count(match[1]):
            offset, dtype, _ = self.lists[match[1]]
            return offset + int(match[2]) * np.dtype(dtype).itemsize, dtype
        return None


def layout_of(msgtype: str, raw: bytes) -> Layout | None:
    """Return the layout of one message; None where it cannot be read as columns."""
    if msgtype not in SCHEMAS or raw[:2] != b'\x00\x01':    # XCDR1, little endian
        return None
    walk = _Walk(raw)
    layout = walk.layout
    try:
        walk.fields(SCHEMAS[msgtype], '')
    except (struct.error, ValueError):
        return None
    # longer is common: rclpy's serialize_message leaves whatever lay behind the message
    return layout if layout.size <= len(raw) else None


def frame_of(msgtype: str, raw: bytes) -> str | None:
    """Return the frame_id of one message; None where a layout does not tell it."""
    if SCHEMAS.get(msgtype, ())[:3] != _HEADER or layout_of(msgtype, raw) is None:
        return None
    at, length = FRAME_AT, int.from_bytes(raw[FRAME_AT - 4:FRAME_AT], 'little')
    return raw[at:at + max(length - 1, 0)].decode()


class _Walk:
    """Walks over one message and notes where everything lies."""

    def __init__(self, raw: bytes) -> None:
        self.raw = raw
        self.layout = Layout()

    def fields(self, schema: Sequence[str], prefix: str) -> None:
        for line in schema:
            kind, path = line.split()
            base, _, size = kind.partition('[')
            if not size:
                self.value(base, prefix + path, 1)
            elif size == ']':
                self.value(base, prefix + path, self.length(), listed=True)
            else:
                self.value(base, prefix + path, int(size[:-1]), listed=True)

    def value(self, kind: str, path: str, count: int, listed: bool = False) -> None:
        layout = self.layout
        if kind == 'string':
            texts = [self.text(listed) for _ in range(count)]
            if listed:
                layout.texts[path] = texts
        elif kind == 'dim':
            for i in range(count):
                self.fields(_DIM, f'{path}[{i}].')
        else:
            size = np.dtype(KINDS[kind]).itemsize
            if count:
                self.align(size)
            if listed:
                layout.lists[path] = (layout.size, KINDS[kind], count)
            else:
                layout.places[path] = (layout.size, KINDS[kind])
            layout.size += size * count
            if layout.size > len(self.raw):
                raise ValueError(path)

    def align(self, size: int) -> None:
        self.layout.size += (4 - self.layout.size) % size   # counted from after the four bytes

    def length(self) -> int:
        self.align(4)
        at = self.layout.size
        length: int = struct.unpack_from('<I', self.raw, at)[0]
        if length > len(self.raw):
            raise ValueError('length')
        self.layout.fixed.append((at, at + 4))
        self.layout.size += 4
        return length

    def text(self, keep: bool) -> str:
        """Pass a string; ``keep``: it is part of what all messages of this layout share."""
        length = self.length()
        at = self.layout.size
        self.layout.size += length
        if self.layout.size > len(self.raw):
            raise ValueError('string')
        if keep:
            self.layout.fixed.append((at, at + length))
        return self.raw[at:at + length - 1].decode() if keep and length else ''


def tables(msgtype: str, raws: Sequence[bytes]) -> Iterator[tuple[Layout | None, Rows, Raws]]:
    """
    Sort messages by layout.

    Yields
    ------
    Layout, where its rows stand (numbers, or a slice: all of them) and the messages. Rows that
    have no layout come last, with None and no messages.

    """
    raws = Raws.of(raws)
    odd: list[Ints] = []
    for same in raws.by_size():
        rows, table = same, raws.take(same)
        for _ in range(MAX_LAYOUTS):
            layout = layout_of(msgtype, table[0])
            alike = _alike(table, layout.fixed if layout else [(0, len(table[0]))])
            whole = bool(alike.all())
            if layout is None:
                odd.append(rows[alike])
            elif whole and len(rows) == len(raws):
                yield layout, slice(None), raws
            else:
                yield layout, rows[alike], table.take(alike)
            if whole:
                break
            rows, table = rows[~alike], table.take(~alike)
        else:
            odd.append(rows)
    if odd:
        yield None, np.sort(np.concatenate(odd)), Raws.of([])


def _alike(table: Raws, fixed: Sequence[tuple[int, int]]) -> Bools:
    """Tell which messages of one length equal the first one in the bytes that make a layout."""
    alike = np.ones(len(table), bool)
    for start, stop in fixed:
        size = stop - start
        part = table.column(start, *((f'u{size}', 1) if size in (2, 4, 8) else ('u1', size)))
        alike &= (part == part[0]).all(axis=1)
    return alike


def columns(layout: Layout, table: Raws, paths: Sequence[str]) -> NDArray[Any] | None:
    """
    Return the values at some paths.

    Returns
    -------
    (n, len(paths)) array of the first path's dtype; None where a path is not in the layout.

    """
    places = [place for place in map(layout.find, paths) if place]
    if len(places) < len(paths):
        return None
    offset, dtype = places[0]
    item = np.dtype(dtype).itemsize
    if places == [(offset + i * item, dtype) for i in range(len(paths))]:
        return table.column(offset, dtype, len(paths))
    return np.concatenate([table.column(offset, dtype, 1) for offset, dtype in places], axis=1)
