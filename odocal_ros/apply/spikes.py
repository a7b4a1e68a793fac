# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Implausible rows of the IMU, detected in a stream.

A leg is screened as a whole (``screening/glitches.py``); a stream has its past, and what follows
within the time that a spike may take. The limits are those of the leg.
"""

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
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
LARGEST = np.repeat([MOST_TURN, MOST_FORCE], 3)
IS_FORCE = np.repeat([False, True], 3)
LEAST_STEPS = np.array([TURN_STEP, FORCE_STEP])
SINGLES = np.repeat([SINGLE_TURN, SINGLE_FORCE], 3)


def beyond_sensor(x_b: Floats) -> Bools:
    """Return a mask of impossible rows: (n, 6) rad/s and m/s^2; a force of NaN is missing."""
    odd: Bools = (~(np.abs(x_b) <= LARGEST) & ~(np.isnan(x_b) & IS_FORCE)).any(axis=1)
    return odd


class SpikeScreen:
    """
    Selects rows by the rows before and after them.

    A row that leaves the last one by more than a vehicle does is held until it is known whether
    the values come back (a spike: dropped) or stay (motion, or a fault that stays: released).
    """

    def __init__(self) -> None:
        self._usual = np.zeros(2)           # of steps from row to row, in LEAST_STEPS: gyro, force
        self._since = 0.0                   # s, since when the rows are equal
        self._w: Floats = np.empty((0, 3))       # rad/s, of the rows before the last one
        self._strange = np.zeros(3)         # rad/s, step of the gyro that no vehicle makes
        self._before = np.zeros(3)          # rad/s, rate before it
        self._until = 0.0                   # s

    def sift(self, t: Floats, x: Floats) -> tuple[Bools, Floats, int]:
        """
        Return masks of rows to keep and to hold, and the implausible part of their rates.

        t : (n,) s, the first row is the last one kept.   x : (n, 6) rad/s and m/s^2.
        Returns (n,) bool, (n, 3) rad/s, 0 where the rate is plausible, and the
        index of the first row to hold, n for none.
        """
        alone = self._alone(t, x[:, :3])
        keep, strange, hold = self._sifted(t, x, alone)
        self._w = np.concatenate([self._w, x[:hold, :3][keep[:hold]]])[-ROWS_BESIDE - 1:-1]
        return keep, strange, hold

    def _sifted(self, t: Floats, x: Floats, alone: Bools) -> tuple[Bools, Floats, int]:
        keep, strange = np.ones(len(t), bool), np.zeros((len(t), 3))
        if not alone.any() and self._calm(t, x):
            return keep, strange, len(t)
        last, j = 0, 1
        while j < len(t):
            step = _size(x[j] - x[last])
            back = None
            if (step > self._allowed()).any() and not self._is_over(t[j], x[j, :3]):
                within = int(np.searchsorted(t, t[last] + GLITCH_TIME, side='right'))
                back = self._back(x[j + 1:within] - x[last], step)
                if back is None and within == len(t):
                    return keep, strange, j
            if alone[j].any() and j + 1 == len(t) and back is None:
                return keep, strange, j        # the next row shows whether it is alone
            self._learn(step[None])
            if back is not None:
                keep[j:j + 1 + back] = False
                j += 1 + back
                continue
            if step.any() or not x[j, :3].any():      # a gyro may have a dead band
                self._since = t[j]
            keep[j] = t[j] - self._since <= STUCK_TIME
            strange[j] = self._strange_of(t[j], x[j, :3], t[last], x[last, :3],
                                          alone[j] & (last == j - 1))
            last, j = (j, j + 1) if keep[j] else (last, j + 1)
        return keep, strange, len(t)

    def _is_over(self, t: float, w: Floats) -> bool:
        """Return True if the gyro is back at its value before an implausible step."""
        return bool(self._strange.any()) and (t > self._until or bool(
            (np.abs(w - self._before) <= BACK_SHARE * np.abs(self._strange)).all(
                where=self._strange != 0)))

    def _alone(self, t: Floats, w: Floats) -> Bools:
        """
        Return a mask of rates after a step that stands alone: (n, 3) rad/s to (n, 3) bool.

        A vehicle starts to turn over several rows; a sensor fault may start with one step.
        """
        rows = np.concatenate([self._w, w])
        size = np.abs(rows[1:] - rows[:-1])
        out = np.zeros(w.shape, bool)
        if len(size) <= ROWS_BESIDE or size.max() <= SINGLE_TURN:
            return out
        beside = np.zeros(size.shape)
        beside[:-1] = size[1:]
        for k in range(1, ROWS_BESIDE + 1):
            np.maximum(beside[k:], size[:-k], out=beside[k:])
        least = np.maximum(SINGLE_TURN, ALONE_CHANGE * np.diff(t)[:, None])
        new = slice(len(self._w), None)
        out[1:] = size[new] > np.maximum(least, SINGLE_TIMES * beside[new])
        out[:max(0, ROWS_BESIDE + 1 - len(self._w))] = False      # too few rows before
        return out

    def _strange_of(self, t: float, w: Floats, t_last: float, w_last: Floats,
                    alone: Bools) -> Floats:
        """
        Return the implausible part of a rate, (3,) rad/s, from the step where it started.

        alone : (3,) bool, the axes whose step stands alone.
        """
        if self._is_over(t, w):
            self._strange = np.zeros(3)
            return self._strange
        step = np.abs(w - w_last)
        most = max(TURN_CHANGE * (t - t_last), USUAL_STEPS * TURN_STEP * self._usual[0])
        odd = (step > most) | alone
        if not self._strange.any() and odd.any():
            self._strange, self._before = np.where(odd, step, 0.0), w_last
            self._until = t + STRANGE_TURN_TIME
        return self._strange

    def _calm(self, t: Floats, x: Floats) -> bool:
        """Return True if no row of a block needs a closer check."""
        if len(x) < 2:
            return True
        sizes = _size(x[1:] - x[:-1])
        turn, force = self._allowed().tolist()
        turn = min(turn, TURN_CHANGE / TURN_STEP * float((t[1:] - t[:-1]).min()))
        largest, force_largest = sizes.max(axis=0).tolist()
        calm = not (largest > turn or force_largest > force or self._strange.any()) and bool(
            sizes.any(axis=1).all())
        if calm:
            self._learn(sizes)
            self._since = t[-1]
        return calm

    def _allowed(self) -> Floats:
        return np.maximum(1.0, USUAL_STEPS * self._usual)

    def _learn(self, steps: Floats) -> None:
        most = 4 * self._usual + 1 / USUAL_STEPS       # one spike hardly changes the usual size
        share = 1 - (1 - 1 / USUAL_ROWS)**len(steps)
        mean = np.minimum(steps, most).sum(axis=0) / len(steps)
        self._usual = self._usual + (mean - self._usual) * share

    def _back(self, away: Floats, step: Floats) -> int | None:
        """Return at which of the rows after a step the values are back, None if at none."""
        bound = step > self._allowed()
        for k, row in enumerate(away):
            if (_size(row)[bound] <= BACK_SHARE * step[bound]).all():
                return k
        return None


def _size(step: Floats) -> Floats:
    """Return sizes of steps, (..., 6), of gyro and force in LEAST_STEPS, (..., 2); NaN is 0."""
    size: Floats = np.abs(step).reshape(*step.shape[:-1], 2, 3).max(axis=-1) / LEAST_STEPS
    return np.fmax(size, 0.0)


def single(x: Floats) -> Bools:
    """
    Return a mask of isolated outliers: (n, 6) to (n,) bool, never the last row.

    As ``screening.glitches.single`` has it, but by the rows before: those after are still to come.
    """
    off = np.zeros(len(x), bool)
    if len(x) < ROWS_BESIDE + 3:
        return off
    far = np.abs(x[1:-1] - (x[:-2] + x[2:]) / 2)       # of row k + 1
    if not (far[ROWS_BESIDE + 1:] > SINGLES).any():
        return off
    for k in range(ROWS_BESIDE + 1, len(far)):
        at = far[k]
        beside = far[k - ROWS_BESIDE - 1:k - 1].max(axis=0)
        apart = np.abs(x[k + 2] - x[k])
        off[k + 1] = ((at > np.maximum(SINGLES, SINGLE_TIMES * beside))
                      & (apart < EQUAL_NEIGHBOURS * at)).any()
    return off
