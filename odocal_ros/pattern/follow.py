# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""From a pose to a command: follow a route, and when to stop."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from odocal_ros.pattern.route import HALF_TURN, Piece, Rectangle
from odocal_ros.settings.pattern_config import PatternConfig

# m within which an error of the path is corrected. Judgement: at 0.5 m/s with commands that are
# 0.1 and 0.2 s late, robots leave the pattern by 0.9 and 2.5 cm with any value from 0.2 to 0.8
REACH = 0.4
TURN_FROM, TURN_TO = 0.2, 0.02      # rad off the path: turn on the spot; aligned. Judgement
SLOWEST, SLOWEST_TURN = 0.03, 0.1   # m/s, rad/s. Judgement: slower, many wheels stick
MOVED, MOVED_TURN = 0.01, 0.02      # m, rad. Judgement: at the slowest within a second
POSE_LOST_S = 0.5                   # judgement: without a pose
Pose = tuple[float, float, float]   # x, y, m, and heading, rad


@dataclass(frozen=True)
class Progress:
    """Progress on a route: piece, turning on the spot, end of the rest, last command."""

    piece: int = 0
    turning: bool = True
    rest_until: float = -math.inf
    t: float = math.nan
    speed: float = 0.0


def command(route: Sequence[Piece], now: Progress, pose: Pose, t: float,
            config: PatternConfig) -> tuple[float, float, Progress]:
    """
    Return speed, m/s, turn rate, rad/s, and the progress after it.

    t : s.   The route is driven when ``piece`` of the progress is its length.
    """
    step = 0.0 if math.isnan(now.t) else max(t - now.t, 0.0)
    now = replace(now, t=t)
    if now.piece == len(route) or t < now.rest_until:
        return 0.0, 0.0, replace(now, speed=0.0)
    piece = route[now.piece]
    along, left = piece.located(*pose[:2])
    off = _angle(pose[2] - piece.heading - piece.curvature * along)
    if abs(off) > HALF_TURN:
        off = math.copysign(off, -piece.side)
    if now.turning and abs(off) > TURN_TO:
        rate = max(min(1.5 * abs(off), config.turn_rate), SLOWEST_TURN)
        return 0.0, -math.copysign(rate, off), replace(now, speed=0.0)
    to_go = piece.length - along
    if to_go <= 0:
        rests = piece.rests
        after = replace(
            now, piece=now.piece + 1, turning=rests, speed=0.0 if rests else now.speed,
            rest_until=t + config.rest if rests else now.rest_until)
        return command(route, after, pose, t, config)
    if abs(off) > TURN_FROM:
        return 0.0, 0.0, replace(now, turning=True, speed=0.0)
    limit = min(config.speed, config.turn_rate / abs(piece.curvature or 1e-9) / 1.5,
                now.speed + config.acceleration * step)
    if piece.rests:
        limit = min(limit, math.sqrt(2 * config.acceleration * to_go))
    speed = min(max(limit, SLOWEST), config.speed)
    # across'' = -across / REACH^2 - 2 across' / REACH, by distance: critically damped
    bend = piece.curvature - left / REACH**2 - 2 * off / REACH
    rate = max(-config.turn_rate, min(speed * bend, config.turn_rate))
    return speed, rate, replace(now, turning=False, speed=speed)


def moved(before: Pose, after: Pose) -> bool:
    """Return True if a robot surely moves between two poses."""
    return (math.dist(before[:2], after[:2]) > MOVED
            or abs(_angle(after[2] - before[2])) > MOVED_TURN)


def why_stop(pose: Pose | None, age_s: float, rectangle: Rectangle, bumped: bool,
             driven_s: float, timeout_s: float) -> str:
    """
    Return the cause to stop at once, empty without one.

    pose : the newest, and its age.   driven_s : time since the start.
    """
    if bumped:
        return 'the bumper is pressed'
    if pose is None or not age_s <= POSE_LOST_S:
        return f'no pose for {POSE_LOST_S:g} s'
    x, y, _ = pose
    if not (rectangle[0] <= x <= rectangle[2] and rectangle[1] <= y <= rectangle[3]):
        return f'the robot is outside the rectangle, at x {x:.2f} m, y {y:.2f} m'
    if not math.isfinite(pose[2]):
        return 'the pose has no heading'
    return f'timeout of {timeout_s:g} s' if driven_s > timeout_s else ''


def _angle(angle: float) -> float:
    """Return an angle within half a turn."""
    return math.remainder(angle, 2 * math.pi)
