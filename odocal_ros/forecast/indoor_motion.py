# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Motion of a small robot on a level floor: patterns with rests, and its wheels."""

from dataclasses import dataclass
import math

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.errors import BadUsage
from odocal_ros.nav.integral import running_integral
from odocal_ros.settings.config import HOLONOMIC

MOTION_STEP = 0.1                     # s, definition: time step of a motion
FULL_TURN = 2 * math.pi        # definition, rad
# judgement: of a small robot: m/s^2, rad/s, rad/s^2; s at rest after a move, and at either end
ACCELERATION, TURN_RATE, TURN_ACCELERATION = 0.5, 0.8, 2.0
REST, END_REST = 3.0, 5.0
PATTERNS = 'straight', 'square', 'figure_eight', 'spot'
Move = tuple[float, float, float]      # m forward, m to the left, rad to the left, at once


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """Motion of the centre of the wheels."""

    t: Floats           # (n + 1,) s
    speed: Floats       # (n + 1,) m/s forward
    side: Floats        # (n + 1,) m/s to the left
    rate: Floats        # (n + 1,) rad/s
    rests: Floats       # (r, 2) s, begin and end of the rests after moves

    @property
    def increments(self) -> Floats:
        """Return m forward, m to the left and rad in each interval: (n, 3)."""
        return np.diff([running_integral(self.t, x) for x in (
            self.speed, self.side, self.rate)], axis=1).T

    @property
    def moving(self) -> Bools:
        """Return True where it moves: (n + 1,)."""
        moving: Bools = (self.speed != 0) | (self.side != 0) | (self.rate != 0)
        return moving

    @property
    def distance(self) -> float:
        """Return the path length, m."""
        return float(np.hypot(*self.increments[:, :2].T).sum())


def pattern(name: str, size: float, rounds: int, drive: str, speed: float = 0.5) -> RobotMotion:
    """
    Return the motion of a pattern.

    name : of PATTERNS.   size : m, length of a straight.   rounds : how often it is driven.
    drive : as odometer.drive; a robot of HOLONOMIC also moves sideways by half of each straight.
    speed : m/s.

    Raises BadUsage: a value is out of range.
    """
    for flag, value in (('--size', size), ('--speed', speed), ('--rounds', rounds)):
        if not (math.isfinite(value) and value > 0):
            raise BadUsage(f'{flag} {value:g}: required: a number above 0')
    side = 1.0
    moves = []
    for move in _moves(name, size) * rounds:
        moves.append(move)
        if drive in HOLONOMIC and not move[2]:
            moves.append((0.0, side * size / 2, 0.0))
            side = -side
    most = 36_000.0 / len(moves)      # s, judgement: ten hours in all, as of other planned drives
    if size / speed > most:
        raise BadUsage(f'--size {size:g} at --speed {speed:g}: more than ten hours')
    return _driven(moves, speed)


def _driven(moves: list[Move], speed: float) -> RobotMotion:
    first, still = round(END_REST / MOTION_STEP), np.zeros((round(REST / MOTION_STEP), 3))
    velocity, rests = [np.zeros((first, 3))], [(first - len(still), first)]
    for forward, left, turn in moves:
        length = math.hypot(forward, left)
        shape = _trapezoid(length, speed, ACCELERATION) if length else _trapezoid(
            abs(turn), TURN_RATE, TURN_ACCELERATION)
        begin = sum(map(len, velocity)) + len(shape)
        velocity += [shape[:, None] * [forward, left, turn], still]
        rests.append((begin, begin + len(still)))
    velocity.append(np.zeros((round((END_REST - REST) / MOTION_STEP) + 1, 3)))
    rows = np.concatenate(velocity)
    t: Floats = MOTION_STEP * np.arange(len(rows), dtype=float)
    return RobotMotion(t, rows[:, 0], rows[:, 1], rows[:, 2], MOTION_STEP * np.array(rests))


def _trapezoid(length: float, top: float, acceleration: float) -> Floats:
    """Return the speed profile of a move as share of its length, 1/s: (n,)."""
    top = min(top, math.sqrt(length * acceleration))
    ramp, whole = top / acceleration, length / top + top / acceleration
    t = MOTION_STEP * np.arange(1, max(2, math.ceil(whole / MOTION_STEP)) + 1)
    shape = np.clip(np.minimum(t / ramp, (t[-1] + MOTION_STEP - t) / ramp), 0, 1)
    out: Floats = shape / (shape.sum() * MOTION_STEP)
    return out


def _moves(name: str, size: float) -> list[Move]:
    """Return the moves of one round of a pattern, of straights of ``size`` m."""
    if name == 'square':
        return [move for side in (1, -1) for _ in range(4)
                for move in ((size, 0, 0), (0, 0, side * math.pi / 2))]
    if name == 'figure_eight':
        radius = size / 4
        return [(FULL_TURN * radius, 0, side * FULL_TURN) for side in (1, -1)]
    turn = math.pi if name == 'straight' else FULL_TURN + math.pi
    return [(size, 0, 0), (0, 0, turn), (size, 0, 0), (0, 0, -turn)]
