# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
TF as position reference: positions of a robot from the transforms on /tf and /tf_static.

In: transforms between any frames. Out: positions of the configured frame in its reference frame,
as fixes, each once all transforms between the two are known.
"""

from collections.abc import Callable, Container, Mapping, Sequence
import struct
from typing import Any, NamedTuple

import numpy as np

from odocal_ros.data.arrays import Ints
from odocal_ros.messages.cdr import LITTLE_ENDIAN
from odocal_ros.messages.decode import Deserialize, Reader
from odocal_ros.messages.message_fields import Pairs, SensorPlan, TRANSFORMS
from odocal_ros.nav.frame_chain import FrameChain
from odocal_ros.nav.geodesy import local_fixes
from odocal_ros.settings.config import Config

STATIC = '_static'      # suffix of the topic of static transforms
MAX_NAMES, MAX_LETTERS = 12, 40     # judgement: in a text: frames, and characters of each


class Transform(NamedTuple):
    """Pose of a child frame in its parent: x y z, m, quaternion x y z w."""

    child: str
    parent: str
    stamp_ns: int
    values: tuple[float, ...]


def transforms_of(raw: bytes, deserialize: Callable[[bytes], Any]) -> list[Transform]:
    """Return the transforms of a TFMessage; may raise any error."""
    if raw[:2] != LITTLE_ENDIAN:
        return [_transform_of(message) for message in deserialize(raw).transforms]
    # in CDR: 4 bytes of encoding, number of transforms, then stamp, two frames and 7 doubles each
    transforms, offset = [], 8
    for _ in range(struct.unpack_from('<I', raw, 4)[0]):
        second, nanosecond = struct.unpack_from('<iI', raw, offset)
        parent, offset = _read_frame(raw, offset + 8)
        child, offset = _read_frame(raw, offset)
        offset += (4 - offset) % 8      # doubles are aligned relative to byte 4
        transforms.append(Transform(child, parent, second * 10**9 + nanosecond,
                                    struct.unpack_from('<7d', raw, offset)))
        offset += 7 * 8
    return transforms


def _transform_of(message: Any) -> Transform:
    stamp, arm, q = message.header.stamp, message.transform.translation, message.transform.rotation
    return Transform(_name(message.child_frame_id), _name(message.header.frame_id),
                     stamp.sec * 10**9 + stamp.nanosec, (arm.x, arm.y, arm.z, q.x, q.y, q.z, q.w))


def _read_frame(raw: bytes, offset: int) -> tuple[str, int]:
    """Return the frame at an offset, and the offset after it."""
    offset += -offset % 4
    end = offset + 4 + int(struct.unpack_from('<I', raw, offset)[0])
    return _name(raw[offset + 4:end - 1].decode()), end + -end % 4


def _name(frame: str) -> str:
    """Return a frame without the leading slash of ROS 1."""
    return frame.removeprefix('/')


class TransformReader(Reader):
    """Reads /tf; ``static`` reads /tf_static into the same frames."""

    def __init__(self, config: Config) -> None:
        build = local_fixes(config.reference.latitude_deg)
        plan = SensorPlan('fix', (), build)
        super().__init__('fix', TRANSFORMS, plan)
        self._build = build
        self._chain = FrameChain(*map(_name, config.reference.frames))
        self._messages = self._damaged = 0
        self._has_position = False
        self.static = StaticReader(self, plan)

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Deserialize) -> Pairs:
        """Return the positions that can be computed with these messages."""
        self._messages += len(raws)
        for raw, received in zip(raws, np.asarray(received_ns, np.int64).tolist(), strict=True):
            for child, parent, stamp_ns, values in self._read(raw, deserialize):
                self._chain.add(child, parent, stamp_ns, received, values)
        return self.new_positions()

    def add_static(self, raws: Sequence[bytes], deserialize: Deserialize) -> None:
        for raw in raws:
            for child, parent, _, values in self._read(raw, deserialize):
                self._chain.add_static(child, parent, values)

    def new_positions(self) -> Pairs:
        """Return the positions that can be computed now."""
        stamps, received, position = self._chain.pop_positions()
        self._has_position |= len(stamps) > 0
        self.unreadable = self._damaged if self._has_position else self._messages
        self.error = 'damaged messages' if self._has_position else self._missing_reason()
        return [('fix', self._build(stamps, received, position))] if len(stamps) else []

    def _read(self, raw: bytes, deserialize: Deserialize) -> list[Transform]:
        try:
            return transforms_of(raw, deserialize)
        except Exception:       # rclpy and rosbags raise different exceptions
            self._damaged += 1
            return []

    def _missing_reason(self) -> str:
        """Return the reason why there is no position, as text."""
        chain = self._chain
        between_frames = f'from {chain.parent} to {chain.child}'
        if chain.top() != chain.parent:
            names = ', '.join(repr(name[:MAX_LETTERS]) for name in chain.frames[:MAX_NAMES])
            return (f'no transform {between_frames}: {chain.top()[:MAX_LETTERS]!r} has no parent '
                    f'frame (frames received: {names or "none"}); set reference.frames, or record '
                    'the static transforms')
        if not chain.is_moving():
            return (f'all transforms {between_frames} are static; set reference.frames to a robot '
                    'that moves')
        return (f'the transforms {between_frames} have no common time, or the one next to '
                f'{chain.parent} never changes: without corrections the positions are odometry '
                'alone')


class StaticReader(Reader):
    """Reads /tf_static into the frames of the reader of /tf, which reports all errors."""

    def __init__(self, moving: TransformReader, plan: SensorPlan) -> None:
        super().__init__('fix', TRANSFORMS, plan)
        self._moving = moving

    def rows(self, raws: Sequence[bytes], received_ns: Sequence[int] | Ints,
             deserialize: Deserialize) -> Pairs:
        """Return the positions that waited for these messages."""
        self._moving.add_static(raws, deserialize)
        return self._moving.new_positions()


def add_static_readers(readers: Mapping[str, Reader], topics: Container[str]) -> dict[str, Reader]:
    """Return topic -> reader, with readers of the static transforms of TF references."""
    return dict(readers) | {
        topic + STATIC: reader.static for topic, reader in readers.items()
        if isinstance(reader, TransformReader) and topic + STATIC in topics}
