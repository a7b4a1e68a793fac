# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Patterns of straights and quarter circles in a rectangle, and the control that follows one."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
import math

from odocal_ros.errors import BadConfig
from odocal_ros.settings.node_configs import PatternConfig

MIN_HALF_TURN = 3.0       # rad. Judgement: from here the robot may turn to either side
MIN_SIDE = 0.5      # m of the pattern. Judgement: below, a robot of 0.3 m turns more than drives
Point = tuple[float, float]
Rectangle = tuple[float, float, float, float]      # x and y, least and largest
# m within which an error of the path is corrected. Judgement: at 0.5 m/s with commands that are
# 0.1 and 0.2 s late, robots leave the pattern by 0.9 and 2.5 cm with any value from 0.2 to 0.8
CORRECTION_LENGTH = 0.4
MAX_HEADING_ERROR = 0.2             # rad. Judgement: beyond it the robot turns on the spot
ALIGNED_ERROR = 0.02                      # rad. Judgement: heading error at which this turn ends
TURN_GAIN, TURN_RESERVE = 1.5, 1.5  # 1/s, turn rate per error; limit over turn rate. Judgement
MIN_SPEED, MIN_TURN_RATE = 0.03, 0.1   # m/s, rad/s. Judgement: slower, many wheels stick
MIN_MOTION, MIN_ROTATION = 0.01, 0.02      # m, rad. Judgement: at the slowest within a second
MAX_POSE_AGE = 0.5                  # s, judgement: the robot stops without a newer pose
Pose = tuple[float, float, float]   # x, y, m, and heading, rad


@dataclass(frozen=True)
class Piece:
    """A line or an arc of less than half a circle."""

    x: float                  # m, of its start
    y: float
    heading: float            # at its start, rad from the x axis, counter-clockwise
    length: float             # m
    curvature: float = 0.0    # 1/m, positive to the left
    stops: bool = True        # the robot stops at its end
    side: int = 1             # of a half turn before it, 1: left

    def along_and_left(self, x: float, y: float) -> tuple[float, float]:
        """Return the path length along the piece to a point, and its distance to the left, m."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        along = cos * (x - self.x) + sin * (y - self.y)
        left = cos * (y - self.y) - sin * (x - self.x)
        if not self.curvature:
            return along, left
        radius, side = 1 / abs(self.curvature), math.copysign(1.0, self.curvature)
        outwards = radius - side * left       # from the centre of the circle
        return radius * math.atan2(along, outwards), side * (radius - math.hypot(along, outwards))


def rectangle_of(config: PatternConfig) -> Rectangle:
    """Return the free area, or raise BadConfig."""
    if len(config.rectangle) != 4:
        raise BadConfig(f'rectangle has {len(config.rectangle)} values; required: x and y of one '
                        'corner, x and y of the opposite one, m')
    x, y, other_x, other_y = config.rectangle
    return min(x, other_x), min(y, other_y), max(x, other_x), max(y, other_y)


def route_of(config: PatternConfig, start: Point) -> tuple[Piece, ...]:
    """
    Return the straight to a pattern, and the pattern.

    start : position of the robot, m. Raises BadConfig: the rectangle is too small.
    """
    left, low, right, high = rectangle_of(config)
    margin = config.margin
    side = min(right - left, high - low) - 2 * margin
    if side < MIN_SIDE:
        raise BadConfig(f'rectangle: the pattern has {max(side, 0):.2f} m, required: '
                        f'{MIN_SIDE:g} m; enlarge the rectangle or lower margin')
    pattern_pieces = {'straight': _straight, 'square': _square, 'figure_eight': _figure_eight}[
        config.pattern]((left + margin, low + margin, right - margin, high - margin))
    first = (pattern_pieces[0].x, pattern_pieces[0].y)
    return tuple(_alternating([*_lines([start, first]), *(pattern_pieces * config.rounds)]))


def _alternating(pieces: list[Piece]) -> list[Piece]:
    """Return pieces with half turns to the left and right by turns, as the track width needs."""
    alternating, side = pieces[:1], 1
    for before, piece in pairwise(pieces):
        alternating.append(replace(piece, side=side))
        if abs(_angle(piece.heading - before.heading - before.curvature * before.length)
               ) > MIN_HALF_TURN:
            side = -side
    return alternating


def _lines(points: Sequence[Point]) -> list[Piece]:
    """Return the straights from point to point."""
    return [Piece(x, y, math.atan2(next_y - y, next_x - x), math.dist((x, y), (next_x, next_y)))
            for (x, y), (next_x, next_y) in pairwise(points) if (x, y) != (next_x, next_y)]


def _straight(inner: Rectangle) -> list[Piece]:
    """Return a line back and forth in the middle, along the longer side."""
    x, y, right, high = inner
    middle_x, middle_y = (x + right) / 2, (y + high) / 2
    begin, end = ((x, middle_y), (right, middle_y)) if right - x >= high - y else (
        (middle_x, y), (middle_x, high))
    return _lines([begin, end, begin])


def _square(inner: Rectangle) -> list[Piece]:
    x, y, right, high = inner
    side = min(right - x, high - y)
    corners = [(x, y), (x + side, y), (x + side, y + side), (x, y + side), (x, y)]
    return _lines(corners) + _lines(corners[::-1])


def _figure_eight(inner: Rectangle) -> list[Piece]:
    """Return two circles side by side along the longer side; it begins between them."""
    x, y, right, high = inner
    wide, tall = right - x, high - y
    radius = min(max(wide, tall) / 4, min(wide, tall) / 2)
    heading = math.pi / 2 if wide >= tall else 0.0      # across the longer side
    centre = (x + right) / 2, (y + high) / 2
    pieces = []
    for side in (1, -1):
        for quarter in range(4):
            piece_yaw = heading + side * quarter * math.pi / 2
            # from the middle to the centre of the circle, and from there to the start
            pieces.append(Piece(
                centre[0] + side * radius * (math.sin(piece_yaw) - math.sin(heading)),
                centre[1] + side * radius * (math.cos(heading) - math.cos(piece_yaw)),
                piece_yaw, radius * math.pi / 2, side / radius, stops=side < 0 and quarter == 3))
    return pieces


@dataclass(frozen=True)
class Progress:
    """Progress on a route."""

    piece: int = 0                    # index of the piece, the length of the route at its end
    turning: bool = True              # on the spot
    rest_until: float = -math.inf     # s, end of a rest between pieces
    t: float = math.nan               # s, of the last command, and its speed, m/s
    speed: float = 0.0


def command(route: Sequence[Piece], progress: Progress, pose: Pose, t: float,
            config: PatternConfig) -> tuple[float, float, Progress]:
    """Return speed, m/s, and turn rate, rad/s, at a time t, s, and the progress after it."""
    step_s = 0.0 if math.isnan(progress.t) else max(t - progress.t, 0.0)
    progress = replace(progress, t=t)
    if progress.piece == len(route) or t < progress.rest_until:
        return 0.0, 0.0, replace(progress, speed=0.0)
    piece, (x, y, heading) = route[progress.piece], pose
    along, left = piece.along_and_left(x, y)
    heading_error = _angle(heading - piece.heading - piece.curvature * along)
    if abs(heading_error) > MIN_HALF_TURN:
        heading_error = math.copysign(heading_error, -piece.side)
    if progress.turning and abs(heading_error) > ALIGNED_ERROR:
        rate = max(min(TURN_GAIN * abs(heading_error), config.turn_rate), MIN_TURN_RATE)
        return 0.0, -math.copysign(rate, heading_error), replace(progress, speed=0.0)
    length_left = piece.length - along      # m
    if length_left <= 0:
        progress = replace(progress, piece=progress.piece + 1, turning=piece.stops)
        if piece.stops:
            progress = replace(progress, speed=0.0, rest_until=t + config.rest)
        return command(route, progress, pose, t, config)
    if abs(heading_error) > MAX_HEADING_ERROR:
        return 0.0, 0.0, replace(progress, turning=True, speed=0.0)
    limit = min(config.speed, config.turn_rate / abs(piece.curvature or 1e-9) / TURN_RESERVE,
                progress.speed + config.acceleration * step_s)
    if piece.stops:
        limit = min(limit, math.sqrt(2 * config.acceleration * length_left))
    speed = min(max(limit, MIN_SPEED), config.speed)
    # critically damped: with d = CORRECTION_LENGTH and derivatives by path length,
    # left'' = -left / d^2 - 2 left' / d, where left' is the heading error
    curvature = (piece.curvature - left / CORRECTION_LENGTH**2
                 - 2 * heading_error / CORRECTION_LENGTH)
    rate = max(-config.turn_rate, min(speed * curvature, config.turn_rate))
    return speed, rate, replace(progress, turning=False, speed=speed)


def has_moved(before: Pose, after: Pose) -> bool:
    """Return True if a robot surely moves between two poses."""
    return (math.dist(before[:2], after[:2]) > MIN_MOTION
            or abs(_angle(after[2] - before[2])) > MIN_ROTATION)


def stop_cause(pose: Pose | None, age_s: float, rectangle: Rectangle, bumped: bool,
               driven_s: float, timeout_s: float) -> str:
    """Return the cause to stop at once, '' without one; driven_s : time since the start."""
    if bumped:
        return 'the bumper is pressed'
    if pose is None or not age_s <= MAX_POSE_AGE:
        return f'no pose for {MAX_POSE_AGE:g} s'
    (x, y, heading), (left, low, right, high) = pose, rectangle
    if not (left <= x <= right and low <= y <= high):
        return f'the robot is outside the rectangle, at x {x:.2f} m, y {y:.2f} m'
    if not math.isfinite(heading):
        return 'the pose has no heading'
    return f'timeout of {timeout_s:g} s' if driven_s > timeout_s else ''


def _angle(angle: float) -> float:
    """Return an angle within half a turn."""
    return math.remainder(angle, 2 * math.pi)
