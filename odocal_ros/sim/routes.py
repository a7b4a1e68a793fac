# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Named routes of simulated drives: speed and turn rate by time, with stops, ramps and turns.

In: a duration, s, and a random generator. Out: a ``Route``. A route is a chain of segments: pieces
of acceleration and of turn rate, which are integrated to speed and yaw.
"""

from dataclasses import dataclass, replace
import math
from typing import NamedTuple

import numpy as np

from odocal_ros.errors import BadUsage
from odocal_ros.sim.profile import chain, hold, Piece, Profile, ramp, turn

# judgement: for a run of a minute with a small robot
STILL = 5.0            # s at standstill, at the start and at the end
LONGEST_CYCLE = 19.0   # s of a cycle with the shortest straight
BLEND = 0.4            # s, rise time of an acceleration or a turn rate


class Segment(NamedTuple):
    """Pieces of a section of a route; both lists have the same duration."""

    acceleration: list[Piece]    # m/s^2
    yaw_rate: list[Piece]        # rad/s

    @property
    def duration(self) -> float:
        """Return the duration, s."""
        return round(sum(seconds for seconds, _ in self.acceleration), 9)


def _standstill(seconds: float) -> Segment:
    return Segment(hold(seconds), hold(seconds))


def _draw_times(rng: np.random.Generator, *ranges: tuple[float, float]) -> list[float]:
    """Return a random time in each range, s, rounded to 0.1 s."""
    return [_tenth(rng.uniform(*limits)) for limits in ranges]


def _draw_angle(rng: np.random.Generator, least: float, most: float) -> float:
    """Return a random angle of ``least`` to ``most`` deg to the left or right, rad."""
    return float(rng.choice([-1.0, 1.0]) * math.radians(rng.uniform(least, most)))


def _robot_segments(duration: float, rng: np.random.Generator, cycles: int = 1) -> list[Segment]:
    """
    Return cycles of a move and a turn on the spot, 5 s still before and after.

    A move of 2 to 8 s at 0.2 to 1.2 m/s is alternately straight or an arc of up to 90 deg. Turns
    on the spot are of 45 to 200 deg at 0.5 to 1.2 rad/s, alternately to the left and the right.
    """
    remaining = _remaining_time('indoor', duration, 2 * STILL,
                                least=math.ceil(cycles * LONGEST_CYCLE))
    segments, side = [_standstill(STILL)], rng.choice([-1.0, 1.0])
    while remaining >= LONGEST_CYCLE:
        segments.append(_robot_cycle(rng, side, len(segments) % 2 == 0, remaining))
        remaining, side = round(remaining - segments[-1].duration, 9), -side
    segments.append(_standstill(STILL + remaining))
    return segments


def _robot_cycle(rng: np.random.Generator, side: float, is_arc: bool, remaining: float) -> Segment:
    """Return a move and a turn on the spot to a side: 1 left, -1 right."""
    up, down, wait, pause = _draw_times(rng, (1.0, 1.5), (1.0, 1.5), (0.5, 2.0), (0.5, 2.0))
    top, cruise = rng.uniform(0.2, 1.2), _tenth(min(rng.uniform(2.0, 8.0), remaining - 15.0))
    arc_angle = is_arc * _draw_angle(rng, 30, 90)
    angle = side * math.radians(rng.uniform(45, 200))
    spot = _tenth(abs(angle) / rng.uniform(0.5, 1.2) + BLEND)
    return Segment(
        ramp(up, top, BLEND) + hold(cruise) + ramp(down, -top, BLEND) + hold(wait + spot + pause),
        hold(up) + turn(cruise, arc_angle, BLEND) + hold(down + wait) + turn(spot, angle, BLEND)
        + hold(pause))


@dataclass(frozen=True)
class Route:
    """Motion by time, s."""

    speed: Profile                  # m/s
    yaw_rate: Profile               # rad/s
    side: Profile | None = None     # m/s to the left; None: 0


def paper(duration: float, rng: np.random.Generator) -> Route:
    """Return the drive of the paper's section 3: 300 s still, 20 m/s for 520 s, 30 s still."""
    cruise = _remaining_time('paper', duration, 300 + 40 + 40 + 30)
    pieces = (hold(300) + ramp(40, 20, 0.0) + hold(cruise) + ramp(40, -20, 0.0) + hold(30))
    return _route([Segment(pieces, hold(duration))])


def straight(duration: float, rng: np.random.Generator) -> Route:
    """Return one straight run: 60 s still, 25 s up to 12 m/s, cruise, 25 s down, 60 s still."""
    cruise = _remaining_time('straight', duration, 60 + 25 + 25 + 60)
    pieces = hold(60) + ramp(25, 12) + hold(cruise) + ramp(25, -12) + hold(60)
    return _route([Segment(pieces, hold(duration))])


def out_and_back(duration: float, rng: np.random.Generator) -> Route:
    """Return a straight out, a stop of 30 s, a U turn at 4 m/s, the same straight back."""
    u_turn_s = 5 + 2 + 14 + 2 + 10
    cruise = _remaining_time('out_and_back', duration, 60 + 15 + 15 + 30 + u_turn_s + 15 + 60) / 2
    outbound = hold(60) + ramp(15, 15) + hold(cruise) + ramp(15, -15) + hold(30)
    u_turn = ramp(5, 4) + hold(2 + 14 + 2) + ramp(10, 11)
    inbound = hold(cruise) + ramp(15, -15) + hold(60)
    return _route([Segment(outbound, hold(60 + 15 + cruise + 15 + 30)),
                   Segment(u_turn, hold(7) + turn(14, math.pi, 2.0) + hold(12)),
                   Segment(inbound, hold(cruise + 75))])


def town(duration: float, rng: np.random.Generator) -> Route:
    """
    Return stop and go with a turn and a lane change between stops, all drawn from ``rng``.

    A cycle of a minute or so: 5 to 12 s up to 9 to 14 m/s, cruise, one turn of 60 to 110 deg in
    6 s or more, 6 to 12 s down, 4 to 15 s still. Turns keep the heading within 110 deg of the
    first, so that the end is well away from the start.
    """
    enough = 135.0    # s, enough for any drawn cycle
    remaining = _remaining_time('town', duration, 20 + 15, enough=enough)
    segments, heading_change = [_standstill(20)], 0.0
    while remaining >= 90.0 or not segments[1:]:
        cycle, heading_change = _town_cycle(rng, heading_change)
        if cycle.duration > remaining:
            break
        segments.append(cycle)
        remaining -= cycle.duration
    if not segments[1:]:
        raise BadUsage(f'scenario town: --duration {duration:g} s is too short for a stop-and-go '
                       f'cycle; give {enough:g} s or more')
    segments.append(_standstill(15 + remaining))
    return _route(segments)


def motorway(duration: float, rng: np.random.Generator) -> Route:
    """
    Return a ramp, a long section at 25 to 36 m/s with gentle curves and changes of speed, a ramp.

    Still for 40 s, up in 25 to 40 s with a curve at about 6 deg/s; then sections of
    15 to 45 s that change the speed by up to 6 m/s or turn at 0.2 to 1.2 deg/s; 30 s down, still.
    """
    up, down = _draw_times(rng, (25, 40), (25, 40))
    ramp_top, fast = 12.0, rng.uniform(25, 36)    # m/s
    slip_road = ramp(10, ramp_top) + hold(12)
    bend = turn(10, _draw_angle(rng, 30, 60), 2.0)
    remaining = _remaining_time('motorway', duration, 40 + 22 + up + down + 30)
    segments = [_standstill(40),
                Segment(slip_road + ramp(up, fast - ramp_top), hold(11) + bend + hold(1 + up))]
    while remaining >= 60:
        length = _tenth(rng.uniform(15, 45))
        new_speed = rng.uniform(max(25.0, fast - 6), min(36.0, fast + 6))
        angle = _draw_angle(rng, 0.2, 1.2) * (length - 6)
        change = _tenth(rng.uniform(8, 14))
        segments.append(Segment(ramp(change, new_speed - fast) + hold(length - change),
                                turn(length, angle, 6.0)))
        fast, remaining = new_speed, round(remaining - length, 9)
    segments.append(Segment(hold(remaining) + ramp(down, -fast) + hold(30),
                            hold(remaining + down + 30)))
    return _route(segments)


def oval(duration: float, rng: np.random.Generator) -> Route:
    """Return laps of an oval, left turns only: half circles and straights at 12 to 20 m/s."""
    fast, straight = rng.uniform(12, 20), _tenth(rng.uniform(6, 12))
    bend = _tenth(math.pi * fast / 4.0 + 3.0)     # at 4 m/s^2 to the side, with flanks of 3 s
    remaining = _remaining_time('oval', duration, 40 + 12 + 12 + 20,
                                least=math.ceil(2 * (straight + bend)))
    half_laps = int(remaining / (straight + bend))
    rest = round(remaining - half_laps * (straight + bend), 9)
    half_lap = Segment(hold(straight + bend), hold(straight) + turn(bend, math.pi, 3.0))
    return _route([Segment(hold(40) + ramp(12, fast), hold(52)), *[half_lap] * half_laps,
                   Segment(ramp(12, -fast) + hold(20 + rest), hold(32 + rest))])


def yard(duration: float, rng: np.random.Generator) -> Route:
    """
    Return slow work in a yard: moves of 5 to 20 s at 0.6 to 2.2 m/s, turns, a fifth backwards.

    In each move one turn of up to 120 deg at 10 to 40 deg/s; then 3 to 9 s still.
    """
    longest = 40.0    # s, duration of a move with the stop after it
    remaining = _remaining_time('yard', duration, 20 + 15, least=longest)
    segments = [_standstill(20)]
    while remaining >= longest:
        top = rng.uniform(0.6, 2.2) * rng.choice([-1.0, 1.0], p=[0.2, 0.8])
        up, down, before, after = _draw_times(rng, (2.0, 4.0), (2.0, 4.0), (0, 4), (0, 4))
        angle = _draw_angle(rng, 20, 120)
        turning = _tenth(abs(angle) / math.radians(rng.uniform(10, 40)) + 1.0)
        stop = _tenth(rng.uniform(3, 9))
        cruise = before + turning + after
        segments.append(Segment(
            ramp(up, top, 0.5) + hold(cruise) + ramp(down, -top, 0.5) + hold(stop),
            hold(up + before) + turn(turning, angle, 0.5) + hold(after + down + stop)))
        remaining = round(remaining - segments[-1].duration, 9)
    segments.append(_standstill(15 + remaining))
    return _route(segments)


def indoor(duration: float, rng: np.random.Generator) -> Route:
    """Return the moves and turns on the spot of a small robot, 5 s still before and after."""
    return _route(_robot_segments(duration, rng))


def square(duration: float, rng: np.random.Generator) -> Route:
    """
    Return a square of 4 m in both directions, as in UMBmark, with stops at the corners.

    10 s still; then eight times: 9 s of motion, 3 s still, a turn of 90 deg in 2 s, 3 s still.
    """
    rest = _remaining_time('square', duration, 10 + 8 * 17, least=5.0)
    # 4 m: a ramp of 1 s is as long as half a second at full speed
    move = ramp(1.0, 0.5, BLEND) + hold(7.0) + ramp(1.0, -0.5, BLEND) + hold(8.0)
    sides = [Segment(move, hold(12.0) + turn(2.0, side * math.pi / 2, BLEND) + hold(3.0))
             for side in [1.0] * 4 + [-1.0] * 4]
    return _route([_standstill(10.0), *sides, _standstill(rest)])


def with_sideways_moves(duration: float, rng: np.random.Generator) -> Route:
    """Return the moves of ``indoor``, every third one sideways."""
    forward, sideways = [], list[Piece]()
    for k, (acceleration, yaw_rate) in enumerate(_robot_segments(duration, rng, cycles=3)):
        rest = hold(sum(seconds for seconds, _ in acceleration))
        is_sideways = k % 3 == 2
        forward.append(Segment(rest if is_sideways else acceleration, yaw_rate))
        sideways += acceleration if is_sideways else rest
    return replace(_route(forward), side=_without_rounding(chain(sideways).integral()))


def _town_cycle(rng: np.random.Generator, heading_change: float) -> tuple[Segment, float]:
    """Return a cycle of ``town``, and the heading change after it since the start, rad."""
    up, top, down = _tenth(rng.uniform(5, 12)), rng.uniform(9, 14), _tenth(rng.uniform(6, 12))
    before, turning, between, weave, after, stop = _draw_times(
        rng, (1, 8), (6, 10), (2, 8), (4, 6), (1, 6), (4, 15))
    angle = _draw_angle(rng, 60, 110)
    side_limit, blend = 3.0, 1.5    # m/s^2 to the side; s, rise time of a turn rate
    turning = max(turning, _tenth(abs(angle) * top / side_limit + blend))
    if abs(heading_change + angle) > math.radians(110.0):    # so that the drive leads away
        angle = -angle
    lane_change = _draw_angle(rng, 4, 10)
    cruise = before + turning + between + 2 * weave + after
    return Segment(
        ramp(up, top) + hold(cruise) + ramp(down, -top) + hold(stop),
        hold(up + before) + turn(turning, angle, blend) + hold(between)
        + turn(weave, lane_change, blend) + turn(weave, -lane_change, blend)
        + hold(after + down + stop)), heading_change + angle


def _tenth(seconds: float) -> float:
    """Round to 0.1 s: kinks then fall on samples, where a trapezoid rule is exact."""
    return round(float(seconds), 1)


def _remaining_time(name: str, duration: float, fixed: float, least: float = 10.0,
                    enough: float | None = None) -> float:
    """Return the time besides the fixed parts, s; raise BadUsage if it is below ``least``."""
    if not math.isfinite(duration) or duration < fixed + least:
        raise BadUsage(f'scenario {name}: --duration {duration:g} s is too short, '
                       f'give {enough or fixed + least:g} s or more')
    return duration - fixed


def _route(segments: list[Segment]) -> Route:
    """Return the route of a chain of segments."""
    acceleration, yaw_rate = (
        chain([piece for pieces in lists for piece in pieces])
        for lists in zip(*segments, strict=True))
    return Route(_without_rounding(acceleration.integral()), yaw_rate)


def _without_rounding(speed: Profile) -> Profile:
    """Return a speed without rounding errors: a stop is exactly 0 m/s."""
    powers = speed.powers.copy()
    powers[:, 0] = np.round(powers[:, 0], 11)
    return Profile(speed.breaks, powers)


ROUTES = {route.__name__: route for route in (
    paper, straight, out_and_back, town, motorway, oval, yard, indoor, square)}
