# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Routes inside a rectangle: straights and quarter circles."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

from odocal_ros.errors import BadConfig
from odocal_ros.settings.pattern_config import PatternConfig

HALF_TURN = 3.0       # rad. Judgement: from here the robot may turn to either side
LEAST_SIDE = 0.5      # m of the pattern. Judgement: below, a robot of 0.3 m turns more than drives
Point = tuple[float, float]
Rectangle = tuple[float, float, float, float]      # x and y, least and largest


@dataclass(frozen=True)
class Piece:
    """
    A line or an arc of less than half a circle.

    heading : at its start, rad from the x axis, counter-clockwise.   curvature : 1/m, positive to
    the left.   rests : the robot stops at its end.   side : of a half turn before it, 1: left.
    """

    x: float
    y: float
    heading: float
    length: float
    curvature: float = 0.0
    rests: bool = True
    side: int = 1

    def located(self, x: float, y: float) -> tuple[float, float]:
        """Return the distance along the piece, m, and the distance to the left of it, m."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        along, left = c * (x - self.x) + s * (y - self.y), c * (y - self.y) - s * (x - self.x)
        if not self.curvature:
            return along, left
        radius, side = 1 / abs(self.curvature), math.copysign(1.0, self.curvature)
        inwards = radius - side * left       # from the centre outwards
        return radius * math.atan2(along, inwards), side * (radius - math.hypot(along, inwards))


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

    start : position of the robot inside the rectangle, m.

    Raises
    ------
    BadConfig
        The rectangle is too small.

    """
    left, low, right, high = rectangle_of(config)
    inner = left + config.margin, low + config.margin, right - config.margin, high - config.margin
    side = min(inner[2] - inner[0], inner[3] - inner[1])
    if side < LEAST_SIDE:
        raise BadConfig(f'rectangle: the pattern has {max(side, 0):.2f} m, required: '
                        f'{LEAST_SIDE:g} m; enlarge the rectangle or lower margin')
    once = {'straight': _straight, 'square': _square, 'figure_eight': _figure_eight}[
        config.pattern](inner)
    first = (once[0].x, once[0].y)
    return tuple(_alternating([*_lines([start, first]), *(once * config.rounds)]))


def _alternating(pieces: list[Piece]) -> list[Piece]:
    """Return pieces with half turns to the left and right by turns, as the track width needs."""
    found, side = pieces[:1], 1
    for before, piece in zip(pieces, pieces[1:], strict=False):
        turn = piece.heading - before.heading - before.curvature * before.length
        found.append(replace(piece, side=side))
        if abs(math.remainder(turn, 2 * math.pi)) > HALF_TURN:
            side = -side
    return found


def _lines(points: Sequence[Point]) -> list[Piece]:
    """Return the straights from point to point."""
    return [Piece(*a, math.atan2(b[1] - a[1], b[0] - a[0]), math.dist(a, b))
            for a, b in zip(points, points[1:], strict=False) if a != b]


def _straight(inner: Rectangle) -> list[Piece]:
    x, y, right, high = inner
    if right - x >= high - y:
        a, b = (x, (y + high) / 2), (right, (y + high) / 2)
    else:
        a, b = ((x + right) / 2, y), ((x + right) / 2, high)
    return _lines([a, b, a])


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
            turned = heading + side * quarter * math.pi / 2
            # from the middle to the centre of the circle, and from there to the start
            pieces.append(Piece(
                centre[0] + side * radius * (math.sin(turned) - math.sin(heading)),
                centre[1] + side * radius * (math.cos(heading) - math.cos(turned)),
                turned, radius * math.pi / 2, side / radius, rests=side < 0 and quarter == 3))
    return pieces
