# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Positions of one TF frame in another, through the frames between them, as tf2 computes them.

``FrameChain`` takes transforms in order of arrival, and returns stamped positions once all
transforms of the chain are known.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, Ints

# judgement: longest interval of interpolation. At 0.5 m/s and 1 rad/s a straight line between the
# positions is up to v w T^2 / 8 = 16 mm off the path
MAX_INTERPOLATION_NS = 500_000_000
RESTART_NS = 10**9        # judgement: a larger backward step of the stamps is a restart
MAX_WAITING = 10_000     # judgement: transforms of a frame kept while another one is missing
StampedPositions = tuple[Ints, Ints, Floats]      # stamps, arrivals, positions
Transform = Sequence[float]      # of a child in its parent: x y z, m, and quaternion x y z w


@dataclass(eq=False)
class _MovingFrame:
    """Transforms of a child frame in its parent, in order of their stamps."""

    parent: str
    newest_ns: int = -1
    stamps: list[int] = field(default_factory=list)      # ns
    received: list[int] = field(default_factory=list)    # ns, arrivals
    values: list[Transform] = field(default_factory=list)

    def add(self, stamp_ns: int, received_ns: int, values: Transform) -> None:
        if stamp_ns <= self.newest_ns:
            return      # repeated or late
        self.newest_ns = stamp_ns
        self.stamps.append(stamp_ns)
        self.received.append(received_ns)
        self.values.append(values)

    def drop_oldest(self, count: int) -> None:
        count = max(count, 0)
        for column in (self.stamps, self.received, self.values):
            del column[:count]


class FrameChain:
    """
    Transforms from ``child`` up to ``parent``; other frames are dropped once these are known.

    A position has the stamp of a transform of the moving frame next to ``parent``, which SLAM
    corrects. Other transforms are interpolated to this stamp. A correction that is repeated
    unchanged gives no position: it would be the previous one plus wheel odometry. Block sizes and
    the arrival of static transforms have no effect.
    """

    def __init__(self, parent: str, child: str) -> None:
        self.parent, self.child = parent, child
        self._moving: dict[str, _MovingFrame] = {}
        self._static: dict[str, tuple[str, Transform]] = {}      # parent and transform, by child
        self._path: list[str] | None = None      # children, from the parent downwards
        self._last_correction: Transform | None = None    # of the moving frame next to the parent
        self._computed: list[StampedPositions] = []    # not yet popped

    def add(self, child: str, parent: str, stamp_ns: int, received_ns: int, values: Transform
            ) -> None:
        """Add a transform with a stamp; the first parent of a child applies."""
        if self._path is None or child in self._path:
            frame = self._moving.setdefault(child, _MovingFrame(parent))
            if frame.parent != parent:
                return
            if stamp_ns < frame.newest_ns - RESTART_NS:
                self._computed.append(self._compute_positions())
                for other in self._moving.values():
                    other.drop_oldest(len(other.stamps))
                    other.newest_ns = -1
            if len(frame.stamps) == MAX_WAITING:
                self._computed.append(self._compute_positions())
                frame.drop_oldest(len(frame.stamps) - MAX_WAITING + 1)
            frame.add(stamp_ns, received_ns, values)

    def add_static(self, child: str, parent: str, values: Transform) -> None:
        """Add a static transform; the first one of a child applies."""
        self._static.setdefault(child, (parent, values))

    @property
    def frames(self) -> list[str]:
        """Return the names of all known frames, sorted."""
        parents = {frame.parent for frame in self._moving.values()} | {
            parent for parent, _ in self._static.values()}
        return sorted(parents | set(self._moving) | set(self._static))

    def top(self) -> str:
        """Return the topmost known frame above the child."""
        return self._find_path()[0]

    def is_moving(self) -> bool:
        """Return True if one of the transforms has stamps."""
        return any(name in self._moving for name in self._find_path()[1])

    def _find_path(self) -> tuple[str, list[str]]:
        """Return the topmost known frame above the child, and the children from it downwards."""
        frame, path = self.child, list[str]()
        while frame != self.parent and frame not in path:
            if frame not in self._moving and frame not in self._static:
                break
            path.insert(0, frame)
            frame = self._moving[frame].parent if frame in self._moving else self._static[frame][0]
        return frame, path

    def pop_positions(self) -> StampedPositions:
        """Return stamps and arrivals, ns, and positions (n, 3), m, new since the last call."""
        parts, self._computed = [*self._computed, self._compute_positions()], []
        stamps, received, position = (np.concatenate(x) for x in zip(*parts, strict=True))
        return stamps, received, position

    def _compute_positions(self) -> StampedPositions:
        """Return the new positions since the last restart of the stamps."""
        empty = np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 3))
        if self._path is None:
            top, path = self._find_path()
            if top != self.parent or not self.is_moving():
                return empty
            self._path = path
            self._moving = {name: x for name, x in self._moving.items() if name in path}
        # the moving frame next to the parent; its rows up to the newest stamp of all others
        corrected, *others = (self._moving[name] for name in self._path if name in self._moving)
        end_ns = min((frame.newest_ns for frame in others), default=corrected.newest_ns)
        n = int(np.searchsorted(corrected.stamps, end_ns, side='right'))
        if not n:
            return empty
        stamps, received = np.array(corrected.stamps[:n]), np.array(corrected.received[:n])
        position, is_usable = np.zeros((n, 3)), np.ones(n, bool)
        if others:      # a repeated correction gives no position
            last = corrected.values[0] if self._last_correction is None else self._last_correction
            is_usable = np.array([a != b for a, b in zip(
                [last, *corrected.values], corrected.values[:n], strict=False)])
            self._last_correction = corrected.values[n - 1]
        for name in reversed(self._path):
            if name not in self._moving:
                values = np.array([self._static[name][1]])
            elif self._moving[name] is corrected:
                values = np.array(corrected.values[:n])
            else:
                values, is_near = _interpolate(self._moving[name], stamps)
                is_usable &= is_near
            position = _to_parent_frame(values, position)
        corrected.drop_oldest(n)
        for frame in others:     # the previous transform is needed for later positions
            frame.drop_oldest(int(np.searchsorted(frame.stamps, stamps[-1], side='right')) - 1)
        return stamps[is_usable], received[is_usable], position[is_usable]


def _interpolate(frame: _MovingFrame, stamps: Ints) -> tuple[Floats, Bools]:
    """Return the transforms of a frame at stamps, (n, 7), and a mask of usable ones, (n,)."""
    t, values = np.array(frame.stamps), np.array(frame.values)
    before = np.searchsorted(t, stamps, side='right') - 1
    is_usable = before >= 0
    before = np.maximum(before, 0)
    after = np.minimum(before + 1, len(t) - 1)
    step, elapsed = t[after] - t[before], stamps - t[before]
    is_usable &= (elapsed == 0) | (step <= MAX_INTERPOLATION_NS) & (elapsed <= step)
    share = (elapsed / np.maximum(step, 1))[:, None]
    a, b = values[before], values[after].copy()
    # q and -q are the same rotation. Not slerp: the direction differs by less than angle^3 / 100
    is_opposite = a[:, 3] * b[:, 3] + a[:, 4] * b[:, 4] + a[:, 5] * b[:, 5] + a[:, 6] * b[:, 6] < 0
    b[is_opposite, 3:] = -b[is_opposite, 3:]
    return a + share * (b - a), is_usable


def _to_parent_frame(values: Floats, position: Floats) -> Floats:
    """
    Convert positions (n, 3) from the child frame to the parent frame.

    values : (n, 7) or (1, 7). By products of columns: the last bits of a matrix product depend on
    the number of rows, so replay would differ.
    """
    # position p, quaternion (u, w): p + 2 u x r / |q|^2, with r = u x p + w p
    x, y, z, w = values[:, 3:].T
    px, py, pz = position.T
    with np.errstate(invalid='ignore', divide='ignore'):     # a quaternion of zeros: NaN
        twice = 2 / (x * x + y * y + z * z + w * w)
        rx, ry, rz = y * pz - z * py + w * px, z * px - x * pz + w * py, x * py - y * px + w * pz
        rotated: Floats = np.stack([px + twice * (y * rz - z * ry), py + twice * (z * rx - x * rz),
                                    pz + twice * (x * ry - y * rx)], -1)
    return values[:, :3] + rotated
