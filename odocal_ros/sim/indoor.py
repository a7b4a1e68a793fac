# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Speed and turn rate of a small robot in a room: straights, arcs, turns on the spot."""

import math

import numpy as np

from odocal_ros.sim.profile import hold, Piece, ramp, turn

# judgement: of a run of a minute with a small robot
STILL = 5.0         # s at standstill, at the start and at the end
LONGEST = 19.0      # s of a cycle with the shortest straight
BLEND = 0.4         # s in which an acceleration or a turn rate sets in

Stretch = tuple[list[Piece], list[Piece]]     # accelerations and turn rates of equal duration


def stretches(duration: float, rng: np.random.Generator) -> list[Stretch]:
    """
    Return cycles of a move and a turn on the spot, 5 s still before and after.

    A move of 2 to 8 s at 0.2 to 1.2 m/s is straight or an arc of up to 90 deg by turns. Turns on
    the spot are of 45 to 200 deg at 0.5 to 1.2 rad/s, to the left and to the right by turns.
    """
    found, left, side = [(hold(STILL), hold(STILL))], duration - 2 * STILL, rng.choice([-1.0, 1.0])
    k = 0
    while left >= LONGEST:
        speed, rate, length = _cycle(rng, side, bool(k % 2), left)
        found.append((speed, rate))
        left, side, k = round(left - length, 9), -side, k + 1
    found.append((hold(STILL + left), hold(STILL + left)))
    return found


def sideways(found: list[Stretch]) -> list[tuple[list[Piece], list[Piece], list[Piece]]]:
    """Return stretches with every third move to the left, and its turns."""
    return [(hold(sum(d for d, _ in speed)), rate, speed) if k % 3 == 2 else
            (speed, rate, hold(sum(d for d, _ in speed))) for k, (speed, rate) in enumerate(found)]


def square() -> list[Stretch]:
    """
    Return a square of 4 m to the left, and one to the right, with stops at the corners.

    10 s still; then eight times: 9 s of motion, 3 s still, a turn of 90 deg in 2 s, 3 s still.
    """
    found = [(hold(10.0), hold(10.0))]
    for side in [1.0] * 4 + [-1.0] * 4:
        # 4 m: a ramp of 1 s with such flanks is half a second of the speed
        speed = ramp(1.0, 0.5, BLEND) + hold(7.0) + ramp(1.0, -0.5, BLEND)
        found.append((speed + hold(8.0), hold(12.0) + turn(2.0, side * math.pi / 2, BLEND)
                      + hold(3.0)))
    return found


def _cycle(rng: np.random.Generator, side: float, arc: bool,
           left: float) -> tuple[list[Piece], list[Piece], float]:
    """Return accelerations, turn rates and duration of a move and a turn to a side."""
    up, down, wait, pause = (round(float(rng.uniform(*r)), 1) for r in (
        (1.0, 1.5), (1.0, 1.5), (0.5, 2.0), (0.5, 2.0)))
    top, cruise = rng.uniform(0.2, 1.2), round(min(rng.uniform(2.0, 8.0), left - 15.0), 1)
    bend = arc * rng.choice([-1.0, 1.0]) * math.radians(rng.uniform(30, 90))
    angle = side * math.radians(rng.uniform(45, 200))
    spot = round(abs(angle) / rng.uniform(0.5, 1.2) + BLEND, 1)
    speed = ramp(up, top, BLEND) + hold(cruise) + ramp(down, -top, BLEND)
    rate = hold(up) + turn(cruise, bend, BLEND) + hold(down)
    return (speed + hold(wait + spot + pause), rate + hold(wait) + turn(spot, angle, BLEND)
            + hold(pause), round(up + cruise + down + wait + spot + pause, 9))
