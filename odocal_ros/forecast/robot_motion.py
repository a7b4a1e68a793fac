# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Motion of a small robot in a planned run: a pattern of moves and rests on a level floor."""

from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.errors import BadUsage
from odocal_ros.nav.time_series import running_integral
from odocal_ros.settings.config import HOLONOMIC

MOTION_STEP = 0.1              # s, definition: time step of a motion
FULL_TURN = 2 * math.pi        # definition, rad
# judgement: of a small robot: m/s^2, rad/s, rad/s^2; s at rest after a move, and at the start and
# the end
ACCELERATION, TURN_RATE, TURN_ACCELERATION = 0.5, 0.8, 2.0
REST, END_REST = 3.0, 5.0
PATTERNS = 'straight', 'square', 'figure_eight', 'spot'


class Move(NamedTuple):
    """A move from rest to rest, with simultaneous translation and turn."""

    forward: float    # m
    left: float       # m
    turn: float       # rad to the left


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """Motion of the centre of the wheels."""

    t: Floats           # (n + 1,) s
    speed: Floats       # (n + 1,) m/s forward
    side_speed: Floats  # (n + 1,) m/s to the left
    yaw_rate: Floats    # (n + 1,) rad/s
    rests: Floats       # (r, 2) s, begin and end of the rests before the first move and after each

    @property
    def increments(self) -> Floats:
        """Return m forward, m to the left and rad in each interval: (n, 3)."""
        return np.diff([running_integral(self.t, rate) for rate in (
            self.speed, self.side_speed, self.yaw_rate)], axis=1).T

    @property
    def moving(self) -> Bools:
        """Return True where the robot moves: (n + 1,)."""
        return np.asarray(np.any([self.speed, self.side_speed, self.yaw_rate], axis=0))

    @property
    def distance(self) -> float:
        """Return the path length, m."""
        return float(np.hypot(*self.increments[:, :2].T).sum())


def pattern_motion(name: str, size: float, rounds: int, drive: str,
                   speed: float = 0.5) -> RobotMotion:
    """
    Return the motion of a pattern.

    name : one of PATTERNS.   size : m, length of a straight.   rounds : number of repetitions.
    drive : as odometer.drive; a robot of HOLONOMIC also moves sideways by half of each straight.
    speed : m/s, largest.

    Raises BadUsage: a value is out of range.
    """
    for flag, value in (('--size', size), ('--speed', speed), ('--rounds', rounds)):
        if not (math.isfinite(value) and value > 0):
            raise BadUsage(f'{flag} {value:g}: required: a number above 0')
    side = 1.0
    moves = []
    for move in _pattern_moves(name, size) * rounds:
        moves.append(move)
        if drive in HOLONOMIC and not move.turn:
            moves.append(Move(0.0, side * size / 2, 0.0))
            side = -side
    longest_move = 36_000.0 / len(moves)      # s, judgement: ten hours, as in other planned drives
    if size / speed > longest_move:
        raise BadUsage(f'--size {size:g} at --speed {speed:g}: more than ten hours')
    return _drive_moves(moves, speed)


def _drive_moves(moves: list[Move], speed: float) -> RobotMotion:
    """Return the motion of moves, with rests; speed: largest, m/s."""
    first, rest = round(END_REST / MOTION_STEP), np.zeros((round(REST / MOTION_STEP), 3))
    velocity, rests = [np.zeros((first, 3))], [(first - len(rest), first)]
    for forward, left, turn in moves:
        length = math.hypot(forward, left)
        profile = _speed_profile(length, speed, ACCELERATION) if length else _speed_profile(
            abs(turn), TURN_RATE, TURN_ACCELERATION)
        begin = sum(map(len, velocity)) + len(profile)
        velocity += [profile[:, None] * [forward, left, turn], rest]
        rests.append((begin, begin + len(rest)))
    velocity.append(np.zeros((round((END_REST - REST) / MOTION_STEP) + 1, 3)))
    speed_ahead, side_speed, yaw_rate = np.concatenate(velocity).T
    t: Floats = MOTION_STEP * np.arange(len(yaw_rate), dtype=float)
    return RobotMotion(t, speed_ahead, side_speed, yaw_rate, MOTION_STEP * np.array(rests))


def _speed_profile(length: float, speed: float, acceleration: float) -> Floats:
    """Return the trapezoidal speed of a move as share of its length, 1/s: (n,)."""
    speed = min(speed, math.sqrt(length * acceleration))
    ramp, duration = speed / acceleration, length / speed + speed / acceleration      # s
    t = MOTION_STEP * np.arange(1, max(2, math.ceil(duration / MOTION_STEP)) + 1)
    speed_share = np.clip(np.minimum(t / ramp, (t[-1] + MOTION_STEP - t) / ramp), 0, 1)
    return np.asarray(speed_share / (speed_share.sum() * MOTION_STEP))


def _pattern_moves(name: str, size: float) -> list[Move]:
    """Return the moves of one round of a pattern with straights of ``size`` m."""
    straight = Move(size, 0, 0)
    if name == 'square':
        return [move for side in (1, -1) for _ in range(4)
                for move in (straight, Move(0, 0, side * math.pi / 2))]
    if name == 'figure_eight':
        radius = size / 4
        return [Move(FULL_TURN * radius, 0, side * FULL_TURN) for side in (1, -1)]
    turn = math.pi if name == 'straight' else FULL_TURN + math.pi
    return [straight, Move(0, 0, turn), straight, Move(0, 0, -turn)]
