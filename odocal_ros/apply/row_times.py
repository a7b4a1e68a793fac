# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Sampling times of the rows of a counter, without the jitter of their arrival.

Most counters have no stamp, or one of their arrival, but are sampled evenly. In: arrival time and
travel of each row. Out: its time on a line through (row number, time), if the travel is smoother
with it than with that of its arrival.
"""

from bisect import bisect_left
from collections import deque
import math
from typing import NamedTuple

from odocal_ros.screening.even_imu_times import MIN_STEP
from odocal_ros.screening.late_rows import MIN_JITTER

# judgement: rows before the line is used; rows that it is fitted to, a quartz is stable for longer
FIRST_ROWS, LINE_ROWS = 20, 1000
ROUGHNESS_ROWS = 100       # judgement: rows in motion, averaging length of the roughness
# judgement: ratio of the roughness on the line to that at arrival: the line is no longer used
# above the first, and used again below the second
ROUGHNESS_LIMIT, ROUGHNESS_REUSE_LIMIT = 1.0, 0.8
DELAY_SIGMA = 1.5          # judgement: sigma over mean of delays, 1 if exponential
DELAY_ROWS = 50            # judgement: averaging length of the mean delay, rows
# judgement: least counts per interval, and least speed, m/s, to detect lost rows by the travel
RELIABLE_COUNTS, RELIABLE_SPEED = 4.0, 0.5
LATE_INTERVALS = 0.5       # judgement: a row later than this, in intervals, may follow lost rows
# judgement: consecutive rows at rest that are late by LATE_INTERVALS, after which rows are assumed
# to be lost; rows after which this is no longer tested
LATE_REST_ROWS, TESTED_LOST_ROWS = 25, 100
LONG_GAP = 1.0             # s; judgement: gap with lost rows at a slow wheel
MAX_LOST_INTERVALS = 5     # judgement: largest gap, in intervals, over which the line continues


class TimedRow(NamedTuple):
    """A row with both of its times, s, and the travel up to it, m."""

    arrival: float
    line_time: float
    travel: float


class RowTimes:
    """
    Estimate of the sampling times of one counter, row by row.

    No row arrives before it is sampled: the line is the highest one below all arrivals, an edge of
    their lower convex hull, as in the estimation of the skew of two clocks. Roughness is the mean
    square deviation of a row's travel from its neighbours, interpolated in time, m^2: false times
    increase it. ``error_s`` is the sigma of the times by the roughness, s, without a constant
    delay.
    """

    def __init__(self) -> None:
        self._line_is_smoother = True           # roughness is not larger on the line
        self.error_s = 0.0
        self._t = -math.inf                     # s, returned for the last row
        self._rows: deque[TimedRow] = deque(maxlen=3)
        self._roughness = [0.0, 0.0]               # with arrival times; with those of the line
        self._rounding_variance = self._square_speed = 0.0      # means: m^2, of a count; (m/s)^2
        self._mean_rows = 0                     # number of rows in these means
        self._restart()

    def _restart(self) -> None:
        """Forget the line; the next row begins another one."""
        self._count = self._row = 0     # number of rows, without and with lost ones
        self._assumed_lost = 0          # rows lost at rest, if they are not only late
        self._line = 0.0                # s, time of the row on the line
        self._interval = 0.0            # s between rows, slope of the line
        self._mean_delay = 0.0          # s, from the line to arrival
        self._last_step = 0.0           # m, travel in the last interval
        self._hull: list[tuple[int, float]] = []      # rows and arrivals below all others
        self._late_at_rest: list[float] = []     # s, lateness of consecutive rows at rest
        # before the rows that are assumed lost: number and time, s, of the last row; interval, s
        self._row_before, self._t_before, self._interval_before = 0, 0.0, 1.0

    def next_time(self, t: float, travel: float, speed: float, quantum: float) -> float:
        """
        Return the sampling time of the next row, s.

        t : arrival, s.   travel : up to this row, m.   speed : m/s.   quantum : m, of a count.
        """
        expected = max(abs(speed) * self._interval, self._last_step) if speed else 0.0
        step = abs(travel - self._rows[-1].travel) if self._rows else 0.0
        is_reliable = expected > max(RELIABLE_COUNTS * quantum, RELIABLE_SPEED * self._interval)
        moves_slowly = 0 < step <= 2 * RELIABLE_COUNTS * quantum
        if not is_reliable and t - self._line > LONG_GAP and not moves_slowly:
            self._restart()      # lost rows; late ones arrive one after the other
        self._advance_line(t, step, expected if is_reliable else 0.0)
        self._rows.append(TimedRow(t, self._line if self._count else t, travel))
        if len(self._rows) == 3:
            self._compare_roughness(quantum)
        row_time = self._rows[-1].line_time if self._line_is_used() else t
        self._t = max(row_time, self._t + MIN_STEP, math.nextafter(self._t, math.inf))
        return self._t

    @property
    def delay_sigma_s(self) -> float:
        """Return the sigma of the delay that all times have in common, s."""
        return DELAY_SIGMA * self._mean_delay if self._line_is_used() else 0.0

    @property
    def rate_error(self) -> float:
        """Return the relative sigma of the interval between rows."""
        return (DELAY_SIGMA * self._mean_delay / (self._row - self._hull[0][0]) / self._interval
                if self._line_is_used() else 0.0)

    def _line_is_used(self) -> bool:
        return (self._line_is_smoother and self._mean_delay > MIN_JITTER
                and self._count > FIRST_ROWS)

    def _advance_line(self, t: float, step: float, expected: float) -> None:
        """
        Advance the line to the next row.

        t : s, arrival.   step : m, travel since the last row.   expected : m, travel in an
        interval, 0 if it is too small to detect lost rows.
        """
        lateness = t - self._line - self._interval
        intervals = 1
        if expected and lateness > LATE_INTERVALS * self._interval and self._count > FIRST_ROWS:
            intervals = max(1, round(step / expected))
        if intervals > MAX_LOST_INTERVALS:
            self._restart()
        self._last_step = step / intervals
        intervals += self._lost_at_rest(t, lateness, expected > 0)
        self._count += 1
        self._row += intervals
        self._fit_line(t)
        if self._count > 2:       # two rows determine a line
            delay = t - self._line
            self._mean_delay += (delay - self._mean_delay) / min(self._count - 2, DELAY_ROWS)

    def _lost_at_rest(self, t: float, lateness: float, moves: bool) -> int:
        """
        Return the number of rows lost at rest, which the travel does not show.

        If LATE_REST_ROWS rows are late, rows are assumed to be lost. If later rows are on time
        again, they were only late: then the number is negative.
        """
        if self._assumed_lost:
            received = self._row + 1 - self._assumed_lost - self._row_before
            min_lost = round((t - self._t_before) / self._interval_before) - received
            only_late = min(self._assumed_lost, max(self._assumed_lost - min_lost, 0))
            self._hull = [(row - only_late if row > self._row_before else row, arrival)
                          for row, arrival in self._hull]
            is_tested = self._row - self._row_before < TESTED_LOST_ROWS
            self._assumed_lost = self._assumed_lost - only_late if is_tested else 0
            if only_late:
                return -only_late
        if moves or lateness <= LATE_INTERVALS * self._interval or self._count <= FIRST_ROWS:
            self._late_at_rest.clear()
            return 0
        self._late_at_rest.append(lateness)
        if len(self._late_at_rest) < LATE_REST_ROWS:
            return 0
        lost = round(min(self._late_at_rest) / self._interval)
        self._late_at_rest.clear()
        if not self._assumed_lost:
            self._row_before, self._t_before = self._row, self._line
            self._interval_before = self._interval
        self._assumed_lost += lost
        return lost

    def _fit_line(self, t: float) -> None:
        """Add the row to the hull; the line is its edge at the middle of the rows."""
        hull, row = self._hull, self._row
        # drop points above the edge from the point before them to the new row (monotone chain)
        while len(hull) > 1 and (t - hull[-2][1]) * (hull[-1][0] - hull[-2][0]) <= (
                hull[-1][1] - hull[-2][1]) * (row - hull[-2][0]):
            hull.pop()
        hull.append((row, t))
        if len(hull) > 2 and row - hull[1][0] > LINE_ROWS:
            del hull[0]
        if len(hull) > 1:
            # the first point at or after the middle row ends the edge
            end = max(bisect_left(hull, ((row + hull[0][0]) / 2, 0.0)), 1)
            (row0, t0), (row1, t1) = hull[end - 1:end + 1]
            self._interval = (t1 - t0) / (row1 - row0)
        self._line = t if len(hull) == 1 else t1 + self._interval * (row - row1)

    def _compare_roughness(self, quantum: float) -> None:
        """Update the roughness of the travel at arrival and on the line, and ``error_s``."""
        (t0, p0, s0), (t1, p1, s1), (t2, p2, s2) = self._rows      # arrival, line, travel
        if self._count <= FIRST_ROWS or abs(s2 - s0) <= 2 * RELIABLE_COUNTS * quantum:
            return
        self._mean_rows += 1
        share = 1 / min(self._mean_rows, ROUGHNESS_ROWS)
        for k, (a, b, c) in enumerate(((t0, t1, t2), (p0, p1, p2))):
            linear = s0 + (s2 - s0) * (b - a) / (c - a) if c > a else s1
            self._roughness[k] += ((s1 - linear)**2 - self._roughness[k]) * share
        speed = (s2 - s0) / max(p2 - p0, MIN_STEP)
        self._square_speed += (speed**2 - self._square_speed) * share
        self._rounding_variance += (quantum**2 / 12 - self._rounding_variance) * share
        limit = ROUGHNESS_LIMIT if self._line_is_smoother else ROUGHNESS_REUSE_LIMIT
        is_known = self._mean_rows > FIRST_ROWS
        self._line_is_smoother = not is_known or (
            self._roughness[1] <= limit**2 * self._roughness[0])
        # roughness with the times in use; a time error sigma causes a deviation from the mean of
        # both neighbours of sqrt(1.5) sigma
        variance = max(self._roughness[self._line_is_used()] / 1.5 - self._rounding_variance, 0.0)
        self.error_s = math.sqrt(variance / max(self._square_speed, MIN_STEP))
        if not is_known:       # times of arrival may be correct
            self.error_s = max(self.error_s, DELAY_SIGMA * self._mean_delay)
