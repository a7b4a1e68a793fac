# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Serialised messages of a topic in one buffer, grouped by equal layout.

Messages of one layout form a table with a message in each row, so that numpy reads a field of all
of them at once. ``FrameFilter`` separates the IMUs that share a topic.
"""

from collections.abc import Callable, Iterator, Sequence
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Ints
from odocal_ros.data.samples import FRAME_BYTES, OtherImuSamples
from odocal_ros.messages import cdr

Bytes = bytes | bytearray | memoryview
Rows = Ints | Bools | slice      # selected messages: numbers, mask or slice
Table = NDArray[np.uint8]      # (n, size): a message in each row
# judgement: layouts per message length; messages of further ones are read one by one
MAX_LAYOUTS = 16
# judgement: up to this number of messages, reading each one takes less time than a table
SMALL_BLOCK = 8
FRAME_MESSAGES = 3     # judgement: messages that determine the frame; one may be damaged
TEXT_OFFSET = cdr.FRAME_OFFSET - 4      # format: offset of the length of the frame_id


class RawMessages(Sequence[bytes]):
    """Messages: ``data``, and offset and length of each message in it: (n,) bytes."""

    def __init__(self, data: Bytes, start: Ints, size: Ints) -> None:
        self.data, self.start, self.size = data, start, size

    @classmethod
    def joined(cls, raws: Sequence[bytes]) -> 'RawMessages':
        """Return RawMessages of separate messages, copied to one buffer."""
        if isinstance(raws, RawMessages):
            return raws
        size = np.fromiter(map(len, raws), np.int64, len(raws))
        return cls(b''.join(raws), np.cumsum(size) - size, size)

    def __len__(self) -> int:
        return len(self.start)

    def __getitem__(self, selection: Any) -> Any:
        """Return one message as bytes, or those of a slice as RawMessages."""
        if isinstance(selection, slice):
            return self.take(selection)
        start = int(self.start[selection])
        return bytes(self.data[start:start + int(self.size[selection])])

    def take(self, rows: Rows) -> 'RawMessages':
        """Return the messages of some rows, without a copy of their bytes."""
        return RawMessages(self.data, self.start[rows], self.size[rows])

    def table(self, rows: Ints) -> Table:
        """Return a copy of the messages of some rows, of equal length: (n, size) bytes."""
        start = self.start if len(rows) == len(self) else self.start[rows]
        size = int(self.size[rows[0]]) if len(rows) else 0
        if not size:
            return np.empty((len(rows), 0), np.uint8)
        # a view with a message at every offset of the buffer; only the selected rows are read
        views = np.ndarray((len(self.data) - size + 1,), f'V{size}', self.data, 0, (1,))
        return views[start].view(np.uint8).reshape(-1, size)

    def packed(self) -> 'RawMessages':
        """Return a copy whose buffer has only these messages, grouped by length."""
        data, start, offset = [], np.empty(len(self), np.int64), 0
        for rows in self.by_size():
            data.append(self.table(rows).tobytes())
            start[rows] = offset + np.arange(len(rows)) * int(self.size[rows[0]])
            offset += len(data[-1])
        return RawMessages(b''.join(data), start, self.size)

    def by_size(self) -> list[Ints]:
        """Return the rows of messages of one length, for each length."""
        if not len(self):
            return []
        if (self.size == self.size[0]).all():
            return [np.arange(len(self))]
        order = np.argsort(self.size, kind='stable')
        # split where the sorted length changes
        return np.split(order, np.flatnonzero(np.diff(self.size[order])) + 1)


def tables(msgtype: str, raws: Sequence[bytes]) -> Iterator[tuple[cdr.Layout | None, Rows, Table]]:
    """
    Yield each layout, its rows (numbers, or a slice: all of them) and messages, (n, size) bytes.

    Rows without a layout are last, with None and no messages.
    """
    raws = RawMessages.joined(raws)
    without_layout: list[Ints] = []
    for rows in raws.by_size():
        table = raws.table(rows)
        for _ in range(MAX_LAYOUTS):
            layout = cdr.layout_of(msgtype, table[0].tobytes())
            ranges = layout.common_ranges if layout else [(0, table.shape[1])]
            matches = _same_layout(table, ranges)
            all_match = bool(matches.all())
            if layout is None:
                without_layout.append(rows[matches])
            elif all_match:
                yield layout, slice(None) if len(rows) == len(raws) else rows, table
            else:
                yield layout, rows[matches], table[matches]
            if all_match:
                break
            rows, table = rows[~matches], table[~matches]
        else:
            without_layout.append(rows)
    if without_layout:
        yield None, np.sort(np.concatenate(without_layout)), np.empty((0, 0), np.uint8)


def _same_layout(table: Table, common_ranges: Sequence[tuple[int, int]]) -> Bools:
    """Return a mask of messages of one length whose layout bytes equal those of the first."""
    matches = np.ones(len(table), bool)
    for start, stop in common_ranges:
        part = table[:, start:stop]
        if stop - start in (2, 4, 8):      # faster as one number
            number = part.view(f'u{stop - start}')[:, 0]
            matches &= number == number[0]
        else:
            matches &= (part == part[0]).all(axis=1)
    return matches


class FrameFilter:
    """
    Keeps messages of one IMU on a topic that carries several.

    The frame_id is the configured one, else the first one that FRAME_MESSAGES messages have. Until
    it is determined all messages are kept, so that block sizes have no effect.
    """

    def __init__(self, msgtype: str, configured_frame: str) -> None:
        self.frame = configured_frame
        self.other_frame = ''      # the last frame that was not used
        self._is_determined = bool(configured_frame)
        self._prefix = self._frame_prefix()
        self._msgtype = msgtype
        self._frame_counts: dict[str, int] = {}

    def separate(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
                 deserialize: Callable[[bytes], Any]) -> tuple[Bools, OtherImuSamples | None]:
        """Return a mask of the messages to use, and the samples of other IMUs, None if none."""
        keep = np.ones(len(raws), bool)
        first = 0
        while not self._is_determined and first < len(raws):
            self._count_frame(self._frame(raws[first], deserialize))
            first += 1
        keep[first:] = self._have_frame(raws[first:])
        if keep.all():
            return keep, None
        other_frames, stamps = [], []
        for i in np.flatnonzero(~keep).tolist():
            frame = self._frame(raws[i], deserialize)
            # damaged, of another layout, or with or without the leading slash of ROS 1
            if frame is None or frame.removeprefix('/') == self.frame.removeprefix('/'):
                keep[i] = True
            else:
                other_frames.append(frame.encode()[:FRAME_BYTES])
                stamps.append(_stamp_ns(raws[i]))
        if not other_frames:
            return keep, None
        self.other_frame = other_frames[-1].decode(errors='replace')
        received = np.asarray(received_ns, np.int64)[~keep]
        return keep, OtherImuSamples(np.array(stamps), received, np.array(other_frames),
                                     np.full(len(other_frames), self.frame.encode()[:FRAME_BYTES]))

    def is_used(self, raw: bytes) -> bool:
        """Return True if the frame is determined and that of a message."""
        return self._is_determined and self._has_frame(raw)

    def _has_frame(self, raw: bytes) -> bool:
        return raw[:2] + raw[TEXT_OFFSET:TEXT_OFFSET + len(self._prefix) - 2] == self._prefix

    def _count_frame(self, frame: str | None) -> None:
        """Count the frame of a message; determine the one to use once it has enough."""
        if frame is None:
            return
        self._frame_counts[frame] = self._frame_counts.get(frame, 0) + 1
        if self._frame_counts[frame] >= FRAME_MESSAGES:
            self.frame, self._is_determined = frame, True
            self._prefix = self._frame_prefix()

    def _frame_prefix(self) -> bytes:
        """Return the first bytes of a message (CDR, little endian), and its frame_id."""
        text = self.frame.encode() + b'\0'
        return cdr.LITTLE_ENDIAN + struct.pack('<I', len(text)) + text

    def _have_frame(self, raws: Sequence[bytes]) -> Bools:
        """Return a mask of messages with the frame at its place in CDR, little endian."""
        if len(raws) <= SMALL_BLOCK:
            return np.array([self._has_frame(raw) for raw in raws], bool)
        joined = RawMessages.joined(raws)
        # compared bytes of each message: of the encoding, then length and text of the frame_id
        offsets = np.concatenate([[0, 1], TEXT_OFFSET + np.arange(len(self._prefix) - 2)])
        data = np.frombuffer(joined.data, np.uint8)
        expected = np.frombuffer(self._prefix, np.uint8)
        matches: Bools = joined.size > offsets[-1]
        matches[matches] = (data[joined.start[matches][:, None] + offsets] == expected).all(axis=1)
        return matches

    def _frame(self, raw: bytes, deserialize: Callable[[bytes], Any]) -> str | None:
        """Return the frame_id of a message, None if it is damaged."""
        try:
            frame = cdr.frame_of(self._msgtype, raw)
            return str(deserialize(raw).header.frame_id) if frame is None else frame
        except Exception:       # rclpy and rosbags raise different exceptions
            return None


def _stamp_ns(raw: bytes) -> int:
    """Return the header stamp of a message in little-endian CDR, ns; 0 (no stamp) for others."""
    if raw[:2] != cdr.LITTLE_ENDIAN:
        return 0
    second, nanosecond = struct.unpack_from('<iI', raw, 4)
    return int(second) * 10**9 + int(nanosecond)
