# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Implausible rows of the IMU, detected in a stream, in plain numbers: a block has two or three.

A leg is screened as a whole (``screening/glitches.py``); a stream has its past, and what follows
within the time that a spike may take. The limits are those of the leg.
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
import math
from operator import itemgetter
from typing import NamedTuple

from odocal_ros.apply.attitude import Vector, ZERO
from odocal_ros.screening.glitches import (
    BACK_SHARE,
    EQUAL_NEIGHBOURS,
    FORCE_STEP,
    GLITCH_TIME,
    ROWS_BESIDE,
    SINGLE_FORCE,
    SINGLE_TIMES,
    SINGLE_TURN,
    TURN_STEP,
    USUAL_STEPS,
)

# physical: twice the range of common gyros, 2000 deg/s; range of accelerometers for crashes, 200 g
MOST_TURN, MOST_FORCE = 70.0, 2000.0      # rad/s, m/s^2
USUAL_ROWS = 50           # judgement: rows over which the usual step is taken
STUCK_TIME = 0.1          # s; judgement: of rows equal in every bit, after which the sensor hangs
TURN_CHANGE = 10.0        # rad/s^2; physical: no vehicle starts to turn faster, but over a stone
STRANGE_TURN_TIME = 1.0        # s; judgement: after which a turn that began so is one
ALONE_CHANGE = 2.5        # rad/s^2; judgement: of a step that stands alone: turns begin slower
SINGLES = (SINGLE_TURN,) * 3 + (SINGLE_FORCE,) * 3
SINGLE_ROWS = ROWS_BESIDE + 4      # definition: rows that ``is_single`` looks at
MISSING = (math.nan, math.nan, math.nan)      # definition: m/s^2, where no force is sent


class Row(NamedTuple):
    """
    A row of the IMU.

    t : s since the first.   w_b, f_b : rad/s, m/s^2, MISSING: no force is sent.
    strange : rad/s, size of an implausible turn rate.
    """

    t: float
    stamp_ns: int
    w_b: Vector
    f_b: Vector
    strange: Vector = ZERO


time_of = itemgetter(0)      # definition: of a row, to search by
Pair = tuple[float, float]


def is_possible(w_b: Vector, f_b: Vector) -> bool:
    """Return True if a sensor can show a turn rate, rad/s, and a force, m/s^2 or MISSING."""
    return _within(w_b, MOST_TURN) and (f_b is MISSING or _within(f_b, MOST_FORCE))


def _within(a: Vector, most: float) -> bool:
    """Return True if no element of a vector is larger; False of NaN."""
    x, y, z = a
    return abs(x) <= most and abs(y) <= most and abs(z) <= most


class SpikeScreen:
    """
    Selects rows by the rows before and after them.

    A row that leaves the last one by more than a vehicle does is held until it is known whether
    the values come back (a spike: dropped) or stay (motion, or a fault that stays: released).
    """

    def __init__(self) -> None:
        self._usual = 0.0, 0.0              # of steps from row to row, as ``_step`` has them
        self._since = 0.0                   # s, since when the rows are equal
        self._kept: deque[Row] = deque(maxlen=ROWS_BESIDE + 1)
        self._dropped = False               # a row since the last one kept
        self._strange = ZERO                # rad/s, step of the gyro that no vehicle makes
        self._before = ZERO                 # rad/s, rate before it
        self._until = 0.0                   # s

    def sift(self, rows: Sequence[Row]) -> tuple[list[Row], list[Row]]:
        """Return the rows to keep, with their implausible rates, and the rows to hold."""
        kept, k = [], 0
        while k < len(rows):
            row, last = rows[k], self._kept[-1] if self._kept else rows[k]
            step, alone, back = _step(last, row), self._alone(rows[k:k + 2]), None
            if any(self._leaves(step)) and not self._is_over(row):
                within = bisect_right(rows, last.t + GLITCH_TIME, key=time_of)
                back = self._back(last, rows[k + 1:within], step)
                if back is None and within == len(rows):
                    break
            if any(alone) and k + 1 == len(rows) and back is None:
                break                  # the next row shows whether it is alone
            self._learn(step)
            if any(step) or not any(row.w_b) or not self._kept:      # a gyro may have a dead band
                self._since = row.t
            self._dropped = back is not None or row.t - self._since > STUCK_TIME
            if not self._dropped:
                strange = self._strange_of(last, row, alone)
                kept.append(row if strange is ZERO else row._replace(strange=strange))
                self._kept.append(row)
            k += 1 + (back or 0)
        return kept, list(rows[k:])

    def _alone(self, rows: Sequence[Row]) -> tuple[bool, ...]:
        """
        Return a mask of the rates of the first of two rows that follow a step which stands alone.

        A vehicle starts to turn over several rows; a sensor fault may start with one step.
        """
        kept = self._kept
        if self._dropped or len(kept) <= ROWS_BESIDE or (
                _largest(kept[-1].w_b, rows[0].w_b) <= SINGLE_TURN):
            return ()
        steps = [[abs(b - a) for a, b in zip(one.w_b, other.w_b, strict=True)]
                 for one, other in pairwise((*kept, *rows))]
        own = steps.pop(ROWS_BESIDE)
        least = max(SINGLE_TURN, ALONE_CHANGE * (rows[0].t - kept[-1].t))
        return tuple(size > max(least, SINGLE_TIMES * max(beside))
                     for size, *beside in zip(own, *steps, strict=True))

    def _is_over(self, row: Row) -> bool:
        """Return True if the gyro is back at its value before an implausible step."""
        return self._strange is not ZERO and (row.t > self._until or all(
            abs(w - before) <= BACK_SHARE * size for w, before, size in zip(
                row.w_b, self._before, self._strange, strict=True) if size))

    def _strange_of(self, last: Row, row: Row, alone: Sequence[bool]) -> Vector:
        """Return the implausible part of a rate, rad/s, from the step where it started."""
        if self._is_over(row):
            self._strange = ZERO
        elif self._strange is ZERO:
            most = max(TURN_CHANGE * (row.t - last.t), USUAL_STEPS * TURN_STEP * self._usual[0])
            if any(alone) or _largest(last.w_b, row.w_b) > most:
                steps = (abs(b - a) for a, b in zip(last.w_b, row.w_b, strict=True))
                x, y, z = (size if odd or size > most else 0.0
                           for size, odd in zip(steps, alone or ZERO, strict=True))
                self._strange, self._before = (x, y, z), last.w_b
                self._until = row.t + STRANGE_TURN_TIME
        return self._strange

    def _leaves(self, step: Pair) -> tuple[bool, bool]:
        """Return a mask of gyro and force: the step is larger than a vehicle's."""
        (turn, force), (usual_turn, usual_force) = step, self._usual
        return (turn > max(1.0, USUAL_STEPS * usual_turn),
                force > max(1.0, USUAL_STEPS * usual_force))

    def _learn(self, step: Pair) -> None:
        """Let the usual step follow; one spike hardly changes it."""
        (turn, force), (usual_turn, usual_force) = step, self._usual
        self._usual = (
            usual_turn + (min(turn, 4 * usual_turn + 1 / USUAL_STEPS) - usual_turn) / USUAL_ROWS,
            usual_force + (min(force, 4 * usual_force + 1 / USUAL_STEPS) - usual_force)
            / USUAL_ROWS)

    def _back(self, last: Row, rows: Sequence[Row], step: Pair) -> int | None:
        """Return at which of the rows after a step the values are back, None if at none."""
        leaves = self._leaves(step)
        for k, row in enumerate(rows):
            if all(left <= BACK_SHARE * size for left, size, bound in zip(
                    _step(last, row), step, leaves, strict=True) if bound):
                return k
        return None


def _largest(a: Vector, b: Vector) -> float:
    """Return the largest difference of two vectors, NaN of MISSING."""
    (x, y, z), (u, v, w) = a, b
    return max(abs(u - x), abs(v - y), abs(w - z))


def _step(last: Row, row: Row) -> Pair:
    """Return the steps of gyro and force, 1 where a vehicle hardly makes it; 0 of MISSING."""
    force = _largest(last.f_b, row.f_b) / FORCE_STEP
    return _largest(last.w_b, row.w_b) / TURN_STEP, force if force == force else 0.0


def is_single(rows: Sequence[Row]) -> bool:
    """
    Return True if the row before the last of SINGLE_ROWS is an isolated outlier.

    As ``screening.glitches.single`` has it, but by the rows before: those after are still to come.
    """
    if len(rows) < SINGLE_ROWS:
        return False
    values = [(*row.w_b, *row.f_b) for row in rows[-3:]]
    for k, (a, b, c, least) in enumerate(zip(*values, SINGLES, strict=True)):
        far = abs(b - (a + c) / 2)
        if far > least and abs(c - a) < EQUAL_NEIGHBOURS * far:
            x = [(*row.w_b, *row.f_b)[k] for row in rows[:-2]]
            if all(far > SINGLE_TIMES * abs(x[i] - (x[i - 1] + x[i + 1]) / 2)
                   for i in range(1, len(x) - 1)):
                return True
    return False
