# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""TF as a position reference: the transform between two frames, from /tf and /tf_static."""

from collections.abc import Callable, Container, Mapping, Sequence
import struct
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Ints
from odocal_ros.messages.decode import Deserialize, Reader
from odocal_ros.messages.message_fields import Pairs, SensorPlan, TRANSFORMS
from odocal_ros.nav.frame_chain import FrameChain
from odocal_ros.nav.local_frame import local_fixes
from odocal_ros.settings.config import Config

STATIC = '_static'      # suffix of the topic of static transforms
MOST_NAMES, MOST_LETTERS = 12, 40     # judgement: frames in a sentence, and letters of a frame
Transform = tuple[str, str, int, tuple[float, ...]]     # child, parent, stamp ns, values


def transforms_of(raw: bytes, deserialize: Callable[[bytes], Any]) -> list[Transform]:
    """
    Return the transforms of a TFMessage: x y z, m, and quaternion x y z w of child in parent.

    Raises an exception if the message is damaged.
    """
    if raw[:2] != b'\0\1':      # XCDR1, little endian
        return [(_name(one.child_frame_id), _name(one.header.frame_id),
                 one.header.stamp.sec * 10**9 + one.header.stamp.nanosec,
                 tuple(float(getattr(part, axis)) for part, axes in (
                     (one.transform.translation, 'xyz'), (one.transform.rotation, 'xyzw'))
                     for axis in axes)) for one in deserialize(raw).transforms]
    found, at = [], 8
    for _ in range(struct.unpack_from('<I', raw, 4)[0]):
        second, nanosecond = struct.unpack_from('<iI', raw, at)
        parent, at = _text(raw, at + 8)
        child, at = _text(raw, at)
        at += (4 - at) % 8      # counted from after the four bytes
        found.append((child, parent, second * 10**9 + nanosecond,
                      struct.unpack_from('<7d', raw, at)))
        at += 56
    return found


def _text(raw: bytes, at: int) -> tuple[str, int]:
    """Return the frame at an offset, and the offset after it."""
    at += -at % 4
    end = at + 4 + int(struct.unpack_from('<I', raw, at)[0])
    return _name(raw[at + 4:end - 1].decode()), end + -end % 4


def _name(frame: str) -> str:
    """Return a frame without the leading slash of ROS 1."""
    return frame.removeprefix('/')


def _shown(frame: str) -> str:
    """Return a frame of a message for texts, quoted and limited in length."""
    return repr(frame[:MOST_LETTERS])


class TransformReader(Reader):
    """Reads /tf; ``static`` reads /tf_static into the same frames."""

    def __init__(self, config: Config) -> None:
        build = local_fixes(config.reference.latitude_deg)
        plan = SensorPlan('fix', (), build)
        super().__init__('fix', TRANSFORMS, plan)
        self._build = build
        self._chain = FrameChain(*map(_name, config.reference.frames))
        self._messages = self._damaged = 0
        self._found = False
        self.static = StaticReader(self, plan)

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Deserialize) -> Pairs:
        """Return the positions that can be computed with these messages."""
        self._messages += len(raws)
        for raw, received in zip(raws, np.asarray(received_ns, np.int64).tolist(), strict=True):
            for child, parent, stamp_ns, values in self._read(raw, deserialize):
                self._chain.add(child, parent, stamp_ns, received, values)
        return self.known()

    def add_static(self, raws: Sequence[bytes], deserialize: Deserialize) -> None:
        for raw in raws:
            for child, parent, _, values in self._read(raw, deserialize):
                self._chain.add_static(child, parent, values)

    def known(self) -> Pairs:
        """Return the positions that can be computed now."""
        stamps, received, position = self._chain.take()
        self._found = self._found or len(stamps) > 0
        self.unreadable = self._damaged if self._found else self._messages
        self.trouble = 'damaged messages' if self._found else self._why()
        return [('fix', self._build(stamps, received, position))] if len(stamps) else []

    def _read(self, raw: bytes, deserialize: Deserialize) -> list[Transform]:
        try:
            return transforms_of(raw, deserialize)
        except Exception:       # rclpy and rosbags raise different exceptions
            self._damaged += 1
            return []

    def _why(self) -> str:
        """Return the reason why there is no position, as text."""
        chain = self._chain
        what = f'from {chain.parent} to {chain.child}'
        if chain.top() != chain.parent:
            names = ', '.join(_shown(name) for name in chain.frames[:MOST_NAMES]) or 'none'
            return (f'no transform {what}: {_shown(chain.top())} has no parent frame (frames '
                    f'received: {names}); set reference.frames, or record the static transforms')
        if not chain.moves():
            return f'all transforms {what} are static; set reference.frames to a robot that moves'
        return (f'the transforms {what} have no common time, or the one next to {chain.parent} '
                'never changes: without corrections the positions are odometry alone')


class StaticReader(Reader):
    """Reads /tf_static into the frames of the reader of /tf, which reports all errors."""

    def __init__(self, moving: TransformReader, plan: SensorPlan) -> None:
        super().__init__('fix', TRANSFORMS, plan)
        self._moving = moving

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Deserialize) -> Pairs:
        """Return the positions that waited for these messages."""
        self._moving.add_static(raws, deserialize)
        return self._moving.known()


def with_static(readers: Mapping[str, Reader], topics: Container[str]) -> dict[str, Reader]:
    """Return topic -> reader, with readers of the static transforms of TF references."""
    beside = {topic + STATIC: reader.static for topic, reader in readers.items()
              if isinstance(reader, TransformReader) and topic + STATIC in topics}
    return {**readers, **beside}
