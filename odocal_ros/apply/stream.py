# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The IMU rows of a stream that dead reckoning still needs, without spikes and isolated outliers.

In: IMU messages. Out: rows in b, with the part of the turn rate that is implausible. A leg is
screened as a whole (``screening/glitches.py``). In a stream, a row is tested with earlier ones,
and later ones up to the longest duration of a spike; the limits are those of a leg. A block has
two or three rows, so numbers are faster than numpy arrays.
"""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Sequence
from itertools import pairwise
import math
from operator import itemgetter
from typing import NamedTuple

from odocal_ros.apply.attitude import rotate_vector, Vector, ZERO
from odocal_ros.data.samples import NO_FORCE, Reading
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.screening import glitches
from odocal_ros.settings.node_configs import ApplyConfig

INTERVAL_ROWS = 64      # judgement: rows of the median interval
IMU_GAP_INTERVALS = 2.5      # judgement: median intervals; in a longer gap a turn is not measured
# physical: twice the range of common gyros, 2000 deg/s; range of accelerometers for crashes, 200 g
MAX_TURN, MAX_FORCE = 70.0, 2000.0      # rad/s, m/s^2
MEAN_STEP_ROWS = 50       # judgement: averaging length of the mean step
FROZEN_TIME = 0.1         # s; judgement: rows that are equal for longer are frozen
TURN_CHANGE = 10.0        # rad/s^2; physical: limit for a vehicle, except over a stone
IMPLAUSIBLE_TIME = 1.0    # s; judgement: a longer turn after a step is real
ISOLATED_CHANGE = 2.5     # rad/s^2; judgement: least isolated step; turns start more slowly
OUTLIER_LIMITS = (glitches.SINGLE_RATE,) * 3 + (glitches.SINGLE_FORCE,) * 3
OUTLIER_ROWS = glitches.NEIGHBOUR_ROWS + 4      # definition: rows that ``is_outlier`` uses


class ImuRow(NamedTuple):
    """A row of the IMU."""

    t: float            # s since the first row
    stamp_ns: int
    w_b: Vector         # rad/s, turn rate
    f_b: Vector         # m/s^2, specific force; NO_FORCE: none is published
    implausible_rate: Vector = ZERO      # rad/s, part of ``w_b`` that no vehicle turns


row_time = itemgetter(0)      # definition: sort key of a row
Step = tuple[float, float]      # largest change of gyro and of force, in units of their limits


def is_possible(w_b: Vector, f_b: Vector) -> bool:
    """Return True if turn rate, rad/s, and force, m/s^2 or NO_FORCE, are in a sensor's range."""
    return _within(w_b, MAX_TURN) and (f_b is NO_FORCE or _within(f_b, MAX_FORCE))


def _within(a: Vector, limit: float) -> bool:
    """Return True if all elements of a vector are within ``limit``; False for NaN."""
    x, y, z = a
    return abs(x) <= limit and abs(y) <= limit and abs(z) <= limit


class SpikeScreen:
    """
    Selection of plausible rows.

    A row after a large step is held until later rows decide: if the values return, it is a spike
    and is dropped; otherwise it is motion or a permanent fault, and is kept.
    """

    def __init__(self) -> None:
        self._mean_steps = 0.0, 0.0         # mean ``Step`` from row to row
        self._equal_since = 0.0             # s, start of a run of equal rows
        self._last_rows: deque[ImuRow] = deque(maxlen=glitches.NEIGHBOUR_ROWS + 1)  # plausible
        self._has_dropped = False           # a row was dropped after these
        self._step_size = ZERO              # rad/s, implausible step of the gyro, ZERO: none
        self._rate_before = ZERO            # rad/s, rate before the step
        self._implausible_until = 0.0       # s, end of the implausible rates

    def screen(self, rows: Sequence[ImuRow]) -> tuple[list[ImuRow], list[ImuRow]]:
        """Return the rows to keep, with their implausible rates, and the rows to hold."""
        plausible_rows, k = [], 0
        while k < len(rows):
            row = rows[k]
            last = self._last_rows[-1] if self._last_rows else row
            step, isolated = _step(last, row), self._isolated_axes(rows[k:k + 2])
            spike_rows = None      # number of rows after this one until the values are back
            if any(self._exceeds_usual(step)) and not self._step_is_over(row):
                end = bisect_right(rows, last.t + glitches.SPIKE_TIME, key=row_time)
                spike_rows = self._rows_until_return(last, rows[k + 1:end], step)
                if spike_rows is None and end == len(rows):
                    break              # wait for later rows
            if any(isolated) and k + 1 == len(rows) and spike_rows is None:
                break                  # wait for the next row, which shows whether it is isolated
            self._update_usual_step(step)
            # a gyro with a dead band repeats 0
            if any(step) or not any(row.w_b) or not self._last_rows:
                self._equal_since = row.t
            self._has_dropped = spike_rows is not None or row.t - self._equal_since > FROZEN_TIME
            if not self._has_dropped:
                rate = self._implausible_rate(last, row, isolated)
                plausible_rows.append(row if rate is ZERO else row._replace(implausible_rate=rate))
                self._last_rows.append(row)
            k += 1 if spike_rows is None else 1 + spike_rows
        return plausible_rows, list(rows[k:])

    def _isolated_axes(self, rows: Sequence[ImuRow]) -> tuple[bool, ...]:
        """Return a mask of gyro axes with an isolated step; a turn starts over several rows."""
        last_rows = self._last_rows
        if self._has_dropped or len(last_rows) <= glitches.NEIGHBOUR_ROWS or (
                _largest(last_rows[-1].w_b, rows[0].w_b) <= glitches.SINGLE_RATE):
            return ()
        steps = [[abs(b - a) for a, b in zip(before.w_b, after.w_b, strict=True)]
                 for before, after in pairwise((*last_rows, *rows))]
        current_step = steps.pop(glitches.NEIGHBOUR_ROWS)
        limit = max(glitches.SINGLE_RATE, ISOLATED_CHANGE * (rows[0].t - last_rows[-1].t))
        return tuple(size > max(limit, glitches.SINGLE_RATIO * max(other_steps))
                     for size, *other_steps in zip(current_step, *steps, strict=True))

    def _step_is_over(self, row: ImuRow) -> bool:
        """Return True if the gyro is back at its value before an implausible step."""
        return self._step_size is not ZERO and (row.t > self._implausible_until or all(
            abs(w - before) <= glitches.RETURN_SHARE * size for w, before, size in zip(
                row.w_b, self._rate_before, self._step_size, strict=True) if size))

    def _implausible_rate(self, last: ImuRow, row: ImuRow, isolated: Sequence[bool]) -> Vector:
        """Return the implausible part of a rate, rad/s: the size of the step at its start."""
        if self._step_is_over(row):
            self._step_size = ZERO
        elif self._step_size is ZERO:
            limit = max(TURN_CHANGE * (row.t - last.t),
                        glitches.SPIKE_RATIO * glitches.SPIKE_RATE * self._mean_steps[0])
            if any(isolated) or _largest(last.w_b, row.w_b) > limit:
                steps = (abs(b - a) for a, b in zip(last.w_b, row.w_b, strict=True))
                x, y, z = (size if is_isolated or size > limit else 0.0
                           for size, is_isolated in zip(steps, isolated or ZERO, strict=True))
                self._step_size, self._rate_before = (x, y, z), last.w_b
                self._implausible_until = row.t + IMPLAUSIBLE_TIME
        return self._step_size

    def _exceeds_usual(self, step: Step) -> tuple[bool, ...]:
        """Return True for gyro and force if the step is implausible for a vehicle."""
        return tuple(size > max(1.0, glitches.SPIKE_RATIO * usual)
                     for size, usual in zip(step, self._mean_steps, strict=True))

    def _update_usual_step(self, step: Step) -> None:
        """Update the mean step; a single spike has little effect."""
        turn, force = (
            usual + (min(size, 4 * usual + 1 / glitches.SPIKE_RATIO) - usual) / MEAN_STEP_ROWS
            for size, usual in zip(step, self._mean_steps, strict=True))
        self._mean_steps = turn, force

    def _rows_until_return(self, last: ImuRow, rows: Sequence[ImuRow], step: Step) -> int | None:
        """Return the number of rows until the values are back after a step, None if never."""
        exceeds = self._exceeds_usual(step)
        for k, row in enumerate(rows):
            if all(change <= glitches.RETURN_SHARE * size for change, size, is_large in zip(
                    _step(last, row), step, exceeds, strict=True) if is_large):
                return k
        return None


def _largest(a: Vector, b: Vector) -> float:
    """Return the largest difference between elements of two vectors; NaN for NO_FORCE."""
    (x, y, z), (u, v, w) = a, b
    return max(abs(u - x), abs(v - y), abs(w - z))


def _step(last: ImuRow, row: ImuRow) -> Step:
    """Return the steps of gyro and force over SPIKE_RATE and SPIKE_FORCE; 0 for NO_FORCE."""
    force = _largest(last.f_b, row.f_b) / glitches.SPIKE_FORCE
    return _largest(last.w_b, row.w_b) / glitches.SPIKE_RATE, 0.0 if math.isnan(force) else force


def is_outlier(rows: Sequence[ImuRow]) -> bool:
    """
    Return True if the row before the last of OUTLIER_ROWS is an isolated outlier.

    As ``screening.glitches.isolated_outliers``, but only earlier rows give the usual deviation.
    """
    if len(rows) < OUTLIER_ROWS:
        return False
    before, row, after = rows[-3:]
    min_share = 1 - glitches.EQUAL_NEIGHBOURS / 2    # of the deviation: step to an outlier
    if not (_largest(before.w_b, row.w_b) > min_share * glitches.SINGLE_RATE
            or _largest(before.f_b, row.f_b) > min_share * glitches.SINGLE_FORCE):
        return False
    values = [(*imu_row.w_b, *imu_row.f_b) for imu_row in rows]      # six columns
    for k, (a, b, c, limit) in enumerate(zip(*values[-3:], OUTLIER_LIMITS, strict=True)):
        deviation = abs(b - (a + c) / 2)
        if deviation > limit and abs(c - a) < glitches.EQUAL_NEIGHBOURS * deviation:
            x = [row_values[k] for row_values in values[:-2]]
            if all(deviation > glitches.SINGLE_RATIO * abs(x[i] - (x[i - 1] + x[i + 1]) / 2)
                   for i in range(1, len(x) - 1)):
                return True
    return False


class ImuStream:
    """
    Usable rows of the IMU in order of time.

    path_row : number of the row that the path has reached.   zero_ns : stamp of t = 0, 0 before
    the first row.   median_interval : s.   notes : list to which texts on dropped rows are added.
    """

    def __init__(self, config: ApplyConfig, notes: list[str]) -> None:
        C_bi = matrix_from_rpy(config.imu.mounting_rpy)
        self._gyro = (config.imu.gyro_scale * C_bi).tolist()
        self._accel = (config.imu.accel_scale * C_bi).tolist()
        self._offset_ns = round(config.imu.time_offset * 1e9)
        self._notes = notes
        self._screen = SpikeScreen()
        self._waiting_rows: list[ImuRow] = []      # rows that may be spikes
        self.rows: list[ImuRow] = []
        self.zero_ns = 0
        self.path_row = 0
        self.median_interval = 0.0
        self._new_rows = 0        # since ``median_interval`` was computed

    def feed(self, readings: Sequence[Reading]) -> None:
        """Add rows with rising stamps; possible spikes are held until the next call."""
        rows, waiting_count = self._waiting_rows, len(self._waiting_rows)
        for stamp, _, w_i, f_i, *_ in readings:
            w_b, f_b = rotate_vector(self._gyro, w_i), rotate_vector(self._accel, f_i)
            if not any(f_i) or math.isnan(sum(f_b)):
                f_b = NO_FORCE
            if is_possible(w_b, f_b):
                self.zero_ns = self.zero_ns or stamp + self._offset_ns
                stamp += self._offset_ns
                rows.append(ImuRow((stamp - self.zero_ns) * 1e-9, stamp, w_b, f_b))
        self._note_dropped(waiting_count + len(readings) - len(rows),
                           f'hold NaN, or exceed {MAX_TURN:g} rad/s or {MAX_FORCE:g} m/s^2')
        plausible_rows, self._waiting_rows = self._screen.screen(rows)
        self._note_dropped(len(rows) - len(plausible_rows) - len(self._waiting_rows),
                           'jump and return, or repeat one value')
        for row in plausible_rows:
            self.rows.append(row)
            if len(self.rows) - 2 > self.path_row and is_outlier(self.rows[-OUTLIER_ROWS:]):
                self._note_dropped(1, 'are isolated outliers')
                del self.rows[-2]
        self._new_rows += len(plausible_rows)
        has_few = len(self.rows) < INTERVAL_ROWS
        if len(self.rows) > 1 and (has_few or self._new_rows > INTERVAL_ROWS // 4):
            steps = sorted(b.t - a.t for a, b in pairwise(self.rows[-INTERVAL_ROWS:]))
            self.median_interval, self._new_rows = steps[len(steps) // 2], 0

    def _note_dropped(self, rows: int, cause: str) -> None:
        if rows:
            self._notes.append(f'{rows} IMU messages dropped and interpolated: they {cause}')

    def forget(self, seconds: float) -> None:
        """Drop rows more than ``seconds`` older than the newest; for use before a path exists."""
        if self.rows and self.rows[-1].t - self.rows[0].t > 2 * seconds:
            self.drop(self.from_time(self.rows[-1].t - seconds))

    def from_time(self, t: float, low: int = 0) -> int:
        """Return the number of the first row at or after t, s, not before row ``low``."""
        return bisect_left(self.rows, t, low, key=row_time)

    def drop(self, row: int) -> None:
        """Drop the rows before a row; the current row must not be one of them."""
        del self.rows[:row]
        self.path_row = max(self.path_row - row, 0)
