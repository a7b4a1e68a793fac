# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages of one topic by their frame_id: of several IMUs on one topic, only one is used."""

from collections.abc import Callable, Sequence
import struct
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Bools, Ints
from odocal_ros.data.samples import FRAME_BYTES, OtherImuSamples
from odocal_ros.messages import cdr
from odocal_ros.messages.raws import FEW_ROWS, Raws

SETTLED = 3     # judgement: messages that decide the frame; a damaged one does not
TEXT_AT = cdr.FRAME_AT - 4      # format: where the length of the text stands


class FrameFilter:
    """
    Keeps messages of one frame_id: the configured one, else the first that SETTLED messages have.

    Until then all messages are kept, so how a stream is chopped leaves no trace.
    """

    def __init__(self, msgtype: str, wanted: str) -> None:
        self.frame = wanted
        self.other = ''         # the last frame that was not used
        self._settled = bool(wanted)
        self._msgtype = msgtype
        self._seen: dict[str, int] = {}

    def sort(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Callable[[bytes], Any]) -> tuple[Bools, OtherImuSamples | None]:
        """Return a mask of the messages to use, and the samples of the others."""
        keep = np.ones(len(raws), bool)
        first = 0
        while not self._settled and first < len(raws):
            self._count(self._frame(raws[first], deserialize))
            first += 1
        keep[first:] = self._alike(raws[first:])
        if keep.all():
            return keep, None
        other, stamps = [], []
        for i in np.flatnonzero(~keep).tolist():
            frame = self._frame(raws[i], deserialize)
            if frame is None or frame == self.frame:        # damaged, or of another layout
                keep[i] = True
            else:
                other.append(frame.encode()[:FRAME_BYTES])
                stamps.append(_stamp_ns(raws[i]))
        if not other:
            return keep, None
        self.other = other[-1].decode(errors='replace')
        received = np.asarray(received_ns, np.int64)[~keep]
        return keep, OtherImuSamples(np.array(stamps), received, np.array(other),
                                     np.full(len(other), self.frame.encode()[:FRAME_BYTES]))

    def _count(self, frame: str | None) -> None:
        """Count the frame of one of the first messages."""
        if frame is None:
            return
        self._seen[frame] = self._seen.get(frame, 0) + 1
        if self._seen[frame] >= SETTLED:
            self.frame, self._settled = frame, True

    def _alike(self, raws: Sequence[bytes]) -> Bools:
        """Return a mask of messages with the frame at its place in CDR, little endian."""
        text = self.frame.encode() + b'\0'
        pattern = b'\0\1' + struct.pack('<I', len(text)) + text
        end = TEXT_AT + len(pattern) - 2
        if len(raws) <= FEW_ROWS:
            return np.array([raw[:2] + raw[TEXT_AT:end] == pattern for raw in raws], bool)
        packed = Raws.of(raws)
        at = np.concatenate([[0, 1], np.arange(TEXT_AT, end)])
        alike: Bools = packed.size > at[-1]
        data, shown = (np.frombuffer(x, np.uint8) for x in (packed.data, pattern))
        alike[alike] = (data[packed.start[alike][:, None] + at] == shown).all(axis=1)
        return alike

    def _frame(self, raw: bytes, deserialize: Callable[[bytes], Any]) -> str | None:
        """Return the frame_id of one message, None where it cannot be read."""
        try:
            frame = cdr.frame_of(self._msgtype, raw)
            return str(deserialize(raw).header.frame_id) if frame is None else frame
        except Exception:       # rclpy and rosbags fail with exceptions of their own
            return None


def _stamp_ns(raw: bytes) -> int:
    """Return the header stamp of a message in CDR, little endian; 0, its arrival, of any other."""
    if raw[:2] != b'\0\1':
        return 0
    second, nanosecond = struct.unpack_from('<iI', raw, 4)
    return int(second) * 10**9 + int(nanosecond)
