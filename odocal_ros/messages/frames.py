# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages of one topic by their frame_id: of several IMUs on one topic, only one is used."""

from collections.abc import Callable, Sequence
from functools import lru_cache
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Bools, Ints
from odocal_ros.data.samples import FRAME_BYTES, OtherImuSamples
from odocal_ros.messages import cdr
from odocal_ros.messages.raws import Raws

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
        keep[first:] = self._alike(Raws.of(raws)[first:])
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

    def _alike(self, raws: Raws) -> Bools:
        """Return a mask of messages with the frame at its place in CDR, vectorised."""
        at, pattern = _pattern(self.frame)
        alike: Bools = raws.size > at[-1]
        data = np.frombuffer(raws.data, np.uint8)
        alike[alike] = (data[raws.start[alike][:, None] + at] == pattern).all(axis=1)
        return alike

    def _frame(self, raw: bytes, deserialize: Callable[[bytes], Any]) -> str | None:
        """Return the frame_id of one message, None where it cannot be read."""
        try:
            frame = cdr.frame_of(self._msgtype, raw)
            return str(deserialize(raw).header.frame_id) if frame is None else frame
        except Exception:       # rclpy and rosbags fail with exceptions of their own
            return None


@lru_cache(maxsize=1)
def _pattern(frame: str) -> tuple[Ints, NDArray[np.uint8]]:
    """Return the places in CDR, little endian, that determine the frame_id, and their bytes."""
    text = frame.encode() + b'\0'
    pattern = np.frombuffer(b'\0\1' + struct.pack('<I', len(text)) + text, np.uint8)
    return np.concatenate([[0, 1], np.arange(TEXT_AT, TEXT_AT + len(pattern) - 2)]), pattern


def _stamp_ns(raw: bytes) -> int:
    """Return the header stamp of a message in CDR, little endian; 0, its arrival, of any other."""
    if raw[:2] != b'\0\1':
        return 0
    second, nanosecond = struct.unpack_from('<iI', raw, 4)
    return int(second) * 10**9 + int(nanosecond)
