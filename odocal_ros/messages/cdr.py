# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Layout of serialised messages (CDR): type and offset of each field, without ROS or rosbags.

In: a message and its type. Out: its ``Layout``, which reads fields of many messages as columns.
Messages whose variable parts (strings, lists) have the same lengths have one layout.
"""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import product
import re
import struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# format: numpy types by field types; then struct types by numpy types (uint64 is read as int64)
NUMPY_TYPES = {f'{kind}{8 * size}': f'<{kind[0]}{size}' for kind, size in (
    *product(('int', 'uint'), (1, 2, 4, 8)), ('float', 4), ('float', 8))}
STRUCT_FORMATS = {'i1': 'b', 'u1': 'B', 'i2': 'h', 'u2': 'H', 'i4': 'i', 'u4': 'I', 'i8': 'q',
                  'u8': 'q', 'f4': 'f', 'f8': 'd'}
NUMBER_TYPES = ('Int16', 'UInt16', 'Int32', 'UInt32', 'Int64', 'UInt64', 'Float32', 'Float64')
Unpacker = Callable[[bytes], tuple[Any, ...]]      # returns adjacent values of a message
LITTLE_ENDIAN = b'\x00\x01'       # format: first bytes of a message in XCDR1, little endian
ELEMENT_PATH = re.compile(r'(.+)\[(\d+)\]')


def _vector_fields(prefix: str, names: str = 'xyz') -> tuple[str, ...]:
    return tuple(f'float64 {prefix}.{name}' for name in names)


def _twist(prefix: str) -> tuple[str, ...]:
    return _vector_fields(f'{prefix}.linear') + _vector_fields(f'{prefix}.angular')


def _pose(prefix: str) -> tuple[str, ...]:
    return _vector_fields(f'{prefix}.position') + _vector_fields(f'{prefix}.orientation', 'xyzw')


HEADER = ('int32 header.stamp.sec', 'uint32 header.stamp.nanosec', 'string header.frame_id')
_GPS_FIX = (      # format: of gps_msgs; the status has its own header and lists of satellites
    *HEADER, 'int32 status.header.stamp.sec', 'uint32 status.header.stamp.nanosec',
    'string status.header.frame_id', 'uint16 status.satellites_used',
    'int32[] status.satellite_used_prn', 'uint16 status.satellites_visible',
    *(f'int32[] status.satellite_visible_{name}' for name in ('prn', 'z', 'azimuth', 'snr')),
    'int16 status.status', 'uint16 status.motion_source', 'uint16 status.orientation_source',
    'uint16 status.position_source', 'float64 latitude', 'float64 longitude', 'float64 altitude',
    *(f'float64 {name}' for name in (
        'track', 'speed', 'climb', 'pitch', 'roll', 'dip', 'time', 'gdop', 'pdop', 'hdop', 'vdop',
        'tdop', 'err', 'err_horz', 'err_vert', 'err_track', 'err_speed', 'err_climb', 'err_time',
        'err_pitch', 'err_roll', 'err_dip')),
    'float64[9] position_covariance', 'uint8 position_covariance_type')
_VELOCITY_REPORT = (*HEADER, 'float32 longitudinal_velocity', 'float32 lateral_velocity',
                    'float32 heading_rate')
FRAME_OFFSET = 16       # format: offset of the text of header.frame_id in CDR
_LAYOUT = ('dim[] layout.dim', 'uint32 layout.data_offset')
_DIM = ('string label', 'uint32 size', 'uint32 stride')

# fields in order, each 'type path'; type[n] is an array, type[] a list
SCHEMAS: dict[str, tuple[str, ...]] = {
    'sensor_msgs/msg/Imu': (
        *HEADER, *_vector_fields('orientation', 'xyzw'), 'float64[9] orientation_covariance',
        *_vector_fields('angular_velocity'), 'float64[9] angular_velocity_covariance',
        *_vector_fields('linear_acceleration'), 'float64[9] linear_acceleration_covariance'),
    'sensor_msgs/msg/NavSatFix': (
        *HEADER, 'int8 status.status', 'uint16 status.service', 'float64 latitude',
        'float64 longitude', 'float64 altitude', 'float64[9] position_covariance',
        'uint8 position_covariance_type'),
    'gps_msgs/msg/GPSFix': _GPS_FIX,
    'gps_common/msg/GPSFix': _GPS_FIX,
    'sensor_msgs/msg/JointState': (
        *HEADER, 'string[] name', 'float64[] position', 'float64[] velocity', 'float64[] effort'),
    'geometry_msgs/msg/Twist': _vector_fields('linear') + _vector_fields('angular'),
    'geometry_msgs/msg/TwistStamped': (*HEADER, *_twist('twist')),
    'geometry_msgs/msg/TwistWithCovarianceStamped': (
        *HEADER, *_twist('twist.twist'), 'float64[36] twist.covariance'),
    'geometry_msgs/msg/PointStamped': (*HEADER, *_vector_fields('point')),
    'geometry_msgs/msg/PoseStamped': (*HEADER, *_pose('pose')),
    'geometry_msgs/msg/PoseWithCovarianceStamped': (
        *HEADER, *_pose('pose.pose'), 'float64[36] pose.covariance'),
    'geometry_msgs/msg/TransformStamped': (
        *HEADER, 'string child_frame_id', *_vector_fields('transform.translation'),
        *_vector_fields('transform.rotation', 'xyzw')),
    'nav_msgs/msg/Odometry': (
        *HEADER, 'string child_frame_id', *_pose('pose.pose'), 'float64[36] pose.covariance',
        *_twist('twist.twist'), 'float64[36] twist.covariance'),
    'autoware_vehicle_msgs/msg/VelocityReport': _VELOCITY_REPORT,
    'autoware_auto_vehicle_msgs/msg/VelocityReport': _VELOCITY_REPORT,    # of Autoware until 2024
    'std_msgs/msg/Int32MultiArray': (*_LAYOUT, 'int32[] data'),
    'std_msgs/msg/Int64MultiArray': (*_LAYOUT, 'int64[] data'),
} | {f'std_msgs/msg/{name}': (f'{name.lower()} data',) for name in NUMBER_TYPES}


class Place(NamedTuple):
    """Place of a value in a message, or of adjacent values of one type, such as a list."""

    offset: int      # bytes
    dtype: str       # of numpy
    length: int = 1  # number of values


@dataclass
class Layout:
    """Offsets of the fields of a message, and the bytes common to all messages of this layout."""

    # by path: single values, lists of numbers, and the content of lists of strings
    values: dict[str, Place] = field(default_factory=dict)
    lists: dict[str, Place] = field(default_factory=dict)
    texts: dict[str, list[str]] = field(default_factory=dict)
    # first byte and end of each range of common bytes (encoding, lengths, texts), and its content
    common_ranges: list[tuple[int, int]] = field(default_factory=lambda: [(0, 2)])
    common_bytes: list[bytes] = field(default_factory=list)
    size: int = 4       # bytes of a message
    _places: dict[tuple[str, ...], list[Place] | None] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Return the names of joints, empty if the type has none."""
        return self.texts.get('name', [])

    def count(self, path: str) -> int:
        """Return the length of a list, 0 if it is missing."""
        return self.lists[path].length if path in self.lists else 0

    def find(self, path: str) -> Place | None:
        """Return the place of a value, ``path[i]`` in a list; None if it is missing."""
        if path in self.values:
            return self.values[path]
        match = ELEMENT_PATH.fullmatch(path)
        if match and int(match[2]) < self.count(match[1]):
            first = self.lists[match[1]]
            offset = first.offset + int(match[2]) * np.dtype(first.dtype).itemsize
            return Place(offset, first.dtype)
        return None

    def _find_joined(self, paths: tuple[str, ...]) -> list[Place] | None:
        """Return the places of values, adjacent ones joined; None if one is missing."""
        if paths not in self._places:
            self._places[paths] = _join_adjacent([self.find(path) for path in paths])
        return self._places[paths]

    def columns(self, table: NDArray[np.uint8], paths: Sequence[str]) -> NDArray[Any] | None:
        """Return values of messages, (n, size) bytes: (n, paths); None if a path is missing."""
        places, arrays = self._find_joined(tuple(paths)), []
        if places is None:
            return None
        for offset, dtype, length in places:
            size = length * np.dtype(dtype).itemsize
            # adjacent values are copied at once, as one item
            items = table[:, offset:offset + size].view(f'V{size}').copy()
            arrays.append(items.view(dtype).reshape(-1, length))
        return arrays[0] if len(arrays) == 1 else np.concatenate(arrays, axis=1)

    def record_type(self, columns: Sequence[Sequence[str] | None]) -> np.dtype[Any] | None:
        """Return a structured type with a field for each column; None if one is not adjacent."""
        places = [self._find_joined(tuple(paths)) if paths else None for paths in columns]
        fields = [joined[0] for joined in places if joined is not None and len(joined) == 1]
        return None if len(fields) < len(places) else np.dtype({
            'names': [str(k) for k in range(len(fields))], 'itemsize': self.size,
            'formats': [(place.dtype, (place.length,)) for place in fields],
            'offsets': [place.offset for place in fields]})

    def fits(self, raw: bytes) -> bool:
        """Return True if a message has this layout."""
        return self.size <= len(raw) and all(
            raw[start:stop] == expected for (start, stop), expected in zip(
                self.common_ranges, self.common_bytes, strict=True))


_latest_layouts: dict[str, Layout] = {}      # by message type: most topics have only one


def unpackers_of(record_type: np.dtype[Any]) -> list[Unpacker]:
    """Return a function for each field of a ``record_type`` that returns its values."""
    # such as '<3d' for three doubles
    return [partial(struct.Struct(
        f'<{dtype.shape[0]}{STRUCT_FORMATS[dtype.base.str[1:]]}').unpack_from,
        offset=offset) for dtype, offset, *_ in (record_type.fields or {}).values()]


def _join_adjacent(places: Sequence[Place | None]) -> list[Place] | None:
    """Return places of single values, adjacent ones of a type joined; None if one is missing."""
    joined: list[Place] = []
    for place in places:
        if place is None:
            return None
        last, size = joined[-1] if joined else Place(0, ''), np.dtype(place.dtype).itemsize
        if last.dtype == place.dtype and last.offset + last.length * size == place.offset:
            joined[-1] = last._replace(length=last.length + 1)
        else:
            joined.append(place)
    return joined


def layout_of(msgtype: str, raw: bytes) -> Layout | None:
    """Return the layout of one message, which may be longer; None if it has none."""
    if msgtype not in SCHEMAS or raw[:2] != LITTLE_ENDIAN:
        return None
    latest = _latest_layouts.get(msgtype)
    if latest and latest.fits(raw):
        return latest
    scan = _LayoutScan(raw, SCHEMAS[msgtype])
    if scan.path:
        return None
    layout = scan.layout
    layout.common_bytes = [raw[start:stop] for start, stop in layout.common_ranges]
    _latest_layouts[msgtype] = layout
    return layout


def frame_of(msgtype: str, raw: bytes) -> str | None:
    """Return the frame_id of one message; None if it has no layout with a header."""
    if SCHEMAS.get(msgtype, ())[:3] != HEADER or layout_of(msgtype, raw) is None:
        return None
    length = int.from_bytes(raw[FRAME_OFFSET - 4:FRAME_OFFSET], 'little')
    return raw[FRAME_OFFSET:FRAME_OFFSET + max(length - 1, 0)].decode()


def damaged_field(msgtype: str, raw: bytes) -> str:
    """Return the field in which a message ends or has an impossible length; '' if unknown."""
    return _LayoutScan(raw, SCHEMAS.get(msgtype, ())).path if raw[:2] == LITTLE_ENDIAN else ''


class _LayoutScan:
    """
    Sequential scan of one message that stores the offsets of all fields.

    path : of the field in which the message ends or has an impossible length; '' without one.
    """

    def __init__(self, raw: bytes, schema: Sequence[str]) -> None:
        self.raw, self.path, self.layout = raw, '', Layout()
        with suppress(struct.error, ValueError):
            self.scan_fields(schema)
            self.path = ''

    def scan_fields(self, schema: Sequence[str], prefix: str = '') -> None:
        for line in schema:
            kind, path = line.split()
            self.path = prefix + path
            base, _, size = kind.partition('[')      # size: '' of one value, ']' of a list, 'n]'
            count = self.read_length() if size == ']' else int(size[:-1] or 1)
            self.scan_values(base, self.path, count, is_list=bool(size))

    def scan_values(self, kind: str, path: str, count: int, is_list: bool) -> None:
        layout = self.layout
        if kind == 'string':
            texts = [self.scan_text(is_stored=is_list) for _ in range(count)]
            if is_list:
                layout.texts[path] = texts
        elif kind == 'dim':
            for i in range(count):
                self.scan_fields(_DIM, f'{path}[{i}].')
        else:
            size = np.dtype(NUMPY_TYPES[kind]).itemsize
            if count:
                self.align(size)
            offset = self.advance(size * count)
            places = layout.lists if is_list else layout.values
            places[path] = Place(offset, NUMPY_TYPES[kind], count)

    def advance(self, count: int) -> int:
        """Move on by a number of bytes; return the offset before."""
        offset = self.layout.size
        self.layout.size += count
        if self.layout.size > len(self.raw):
            raise ValueError(self.path)
        return offset

    def align(self, size: int) -> None:
        self.layout.size += (4 - self.layout.size) % size      # relative to byte 4

    def read_length(self) -> int:
        self.align(4)
        offset = self.advance(4)
        length: int = struct.unpack_from('<I', self.raw, offset)[0]
        if length > len(self.raw):
            raise ValueError(self.path)
        self.layout.common_ranges.append((offset, offset + 4))
        return length

    def scan_text(self, is_stored: bool) -> str:
        """Skip a string; return it if the layout includes its content, else ''."""
        length = self.read_length()
        begin = self.advance(length)
        if not is_stored:
            return ''
        self.layout.common_ranges.append((begin, begin + length))
        return self.raw[begin:begin + max(length - 1, 0)].decode()
