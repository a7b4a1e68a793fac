# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Stamps of a stream: selection of usable ones, and sampling times without arrival jitter."""

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
import math

from odocal_ros.data.samples import Reading
from odocal_ros.screening.even_imu_times import LEAST_STEP
from odocal_ros.screening.late_rows import LEAST_JITTER

# judgement: limits of a stamp: lag below the least one, and age relative to the newest stamp, ns;
# number of consecutive rows beyond a limit after which the clock was set
STAMP_LIMIT_NS, CLOCK_SET_ROWS = 200_000_000, 10
LATEST_NS = (2**31 - 5) * 10**9    # format: 32-bit seconds of a header, minus a time_offset
FAST_PLAY = 1.5      # judgement: least speed of a played bag, times real time
LAG_ROWS = 1000      # judgement: accepted rows over which the least lag increases again
# judgement: consecutive rows, and least shift, s, of a clock step; rows of a permanent one; ns per
# row, largest change of the median lag; lags are not used if a bag is played faster or slower by
# this share
STEP_ROWS, LEAST_STEP_S, PERMANENT_ROWS, LAG_CHANGE_NS, PLAYBACK_SHARE = 3, 0.03, 50, 1e4, 0.05
# judgement: rows before the line is used; rows of its memory, crystals are stable for longer
FIRST_ROWS, LINE_ROWS = 20, 1000
ROUGHNESS_ROWS = 100       # judgement: rows in motion of the mean roughness
# judgement: ratio of the roughness on the line to that at arrival: the line is no longer used
# above the first, and used again below the second
ROUGHNESS_LIMIT, ROUGHNESS_REUSE_LIMIT = 1.0, 0.8
LATE_SIGMA = 1.5           # judgement: sigma over mean of delays, 1 if exponential
LATE_ROWS = 50             # judgement: rows of the mean delay
# judgement: least counts per interval, and least speed, m/s, to detect lost rows by the travel
RELIABLE_COUNTS, RELIABLE_SPEED = 4.0, 0.5
LATE_INTERVALS = 0.5       # judgement: least lateness of lost rows, intervals
# judgement: consecutive rows at rest that are late by LATE_INTERVALS, after which rows are assumed
# to be lost; rows after which this is no longer tested
LATE_REST_ROWS, TESTED_LOST_ROWS = 25, 100
LONG_GAP = 1.0             # s; judgement: gap with lost rows at a slow wheel
MOST_LOST = 5              # judgement: largest gap, intervals, without a new line


class StampScreen:
    """
    Test of the stamps of one topic against their arrival.

    Lag is arrival minus stamp. A stamp whose lag is far below the least lag so far is false, or
    the clock was set. ``clock_jumped`` is True after CLOCK_SET_ROWS consecutive stamps beyond a
    limit; ``jump_row`` is then the first of them in the last block.
    """

    def __init__(self) -> None:
        self.clock_jumped = False
        self.jump_row = 0
        self.excess_s = 0.0           # how far the last refused stamp is ahead; negative: behind
        self.dropped = 0              # rows of the last block
        self.rate = 1.0               # stamps over arrival time; 1 below FAST_PLAY
        self.lag_ns: float | None = None      # the least one
        self._refused_rows = 0        # consecutive ones
        self._newest_ns = 0           # newest usable stamp
        self._first: tuple[int, int] | None = None      # stamp and arrival, ns
        self._real_time = True        # False: a bag is played faster or slower
        self._median_lag_ns = 0.0     # running median of the lags
        self._lags: deque[int] = deque(maxlen=PERMANENT_ROWS)

    def clock_step_s(self, rows: int) -> float:
        """Return the shift of the lag of the last rows, s; 0 if any is within LEAST_STEP_S."""
        if len(self._lags) < rows or not self._real_time or (
                abs(self._lags[-1] - self._median_lag_ns) * 1e-9 <= LEAST_STEP_S):
            return 0.0
        last = list(self._lags)[-rows:]
        smallest_shift = max(min(last) - self._median_lag_ns,
                             self._median_lag_ns - max(last)) * 1e-9
        shift = abs(sum(last) / rows - self._median_lag_ns) * 1e-9
        return shift if smallest_shift > LEAST_STEP_S else 0.0

    def select_usable(self, rows: Sequence[Reading]) -> list[Reading]:
        """Return the rows of the next block with a usable stamp."""
        accepted: list[Reading] = []
        self.jump_row = self.dropped = 0
        for k, row in enumerate(rows):
            stamp, received = row[:2]
            if not 0 < stamp < LATEST_NS:
                self.dropped += 1
                continue
            lag = received - stamp
            ahead = 0.0 if self.lag_ns is None else self.lag_ns - lag
            behind = self._newest_ns - stamp
            if ahead > STAMP_LIMIT_NS * self.rate or behind > STAMP_LIMIT_NS:
                self.jump_row = k if not self._refused_rows else self.jump_row
                self._refused_rows += 1
                self.dropped += behind != 0
                self.excess_s = (-behind if behind > STAMP_LIMIT_NS else ahead) * 1e-9
                self.clock_jumped |= self._refused_rows >= CLOCK_SET_ROWS
            elif behind < 0:
                self._refused_rows, self._newest_ns = 0, stamp
                accepted.append(row)
                if self.lag_ns is None or ahead > 0:
                    self.lag_ns = lag
                else:
                    self.lag_ns -= ahead / LAG_ROWS
            else:
                self.dropped += behind > 0      # a row may come twice
            if not self._refused_rows:
                self._update_lag(lag)
        self._update_rate(rows[-1][1] if rows else 0)
        return accepted

    def _update_lag(self, lag: int) -> None:
        """Update the median lag by a lag, ns; it changes slowly, as two clocks drift."""
        self._median_lag_ns = self._median_lag_ns if self._lags else float(lag)
        self._median_lag_ns += min(max(lag - self._median_lag_ns, -LAG_CHANGE_NS), LAG_CHANGE_NS)
        self._lags.append(lag)

    def _update_rate(self, received_ns: int) -> None:
        """Update the rate of the stamps since the first block: the speed of a played bag."""
        if self._first is None:
            self._first = (self._newest_ns, received_ns) if self._newest_ns else None
        elif received_ns > self._first[1]:
            rate = (self._newest_ns - self._first[0]) / (received_ns - self._first[1])
            self._real_time = abs(rate - 1) < PLAYBACK_SHARE
            self.rate = rate if rate > FAST_PLAY else 1.0


class RowTimes:
    """
    Sampling times of a counter, without arrival jitter.

    A counter is sampled evenly, and no row arrives before it is sampled: the highest line below
    all arrivals (row number to time) gives better times if the travel on it is smoother. It is an
    edge of the lower convex hull, as in the estimation of the skew of two clocks. ``error_s`` is
    the sigma of the times, s, by the roughness of the travel, without a constant delay.
    """

    def __init__(self) -> None:
        self._line_is_smoother = True      # travel is not rougher on the line
        self.error_s = 0.0
        self._t = -math.inf                     # s, time of the last row
        self._rows: deque[tuple[float, float, float]] = deque(maxlen=3)  # arrival, line, travel
        self._roughness = [0.0, 0.0]               # m^2, roughness at arrival, on the line
        self._rounding = self._moved = 0.0      # m^2, of a count; (m/s)^2, mean square speed
        self._tested = 0                        # number of rows in the means
        self._restart()

    def _restart(self) -> None:
        """Forget the line; the next row begins another one."""
        self._count = self._row = 0     # number of rows, without and with lost ones
        self._assumed = 0               # lost rows at rest, which may only have been late
        self._line = 0.0                # s, time of the row on the line
        self._interval = 0.0            # s between rows, slope of the line
        self._late = 0.0                # s, mean delay
        self._step = 0.0                # m, travel in the last interval
        self._hull: list[tuple[int, float]] = []      # rows and arrivals below all others
        self._late_at_rest: list[float] = []     # s, lateness of consecutive rows at rest
        self._before = (0, 0.0, 1.0)    # row, time, interval before the assumed lost rows

    def next_time(self, t: float, travel: float, speed: float, quantum: float) -> float:
        """Return the time of the next row, s; t: arrival, s; travel: m, up to it; quantum: m."""
        expected = max(abs(speed) * self._interval, self._step) if speed else 0.0
        step = abs(travel - self._rows[-1][2]) if self._rows else 0.0
        is_reliable = expected > max(RELIABLE_COUNTS * quantum, RELIABLE_SPEED * self._interval)
        moves = 0 < step <= 2 * RELIABLE_COUNTS * quantum
        if not is_reliable and t - self._line > LONG_GAP and not moves:
            self._restart()      # lost rows; late ones arrive one after the other
        self._advance_line(t, step, expected if is_reliable else 0.0)
        self._rows.append((t, self._line if self._count else t, travel))
        if len(self._rows) == 3:
            self._compare_roughness(quantum)
        row_time = self._rows[-1][1] if self._in_use() else t
        self._t = max(row_time, self._t + LEAST_STEP, math.nextafter(self._t, math.inf))
        return self._t

    @property
    def delay_s(self) -> float:
        """Return the sigma of the constant delay of the times, s."""
        return LATE_SIGMA * self._late if self._in_use() else 0.0

    @property
    def rate_error(self) -> float:
        """Return the relative sigma of the interval between rows."""
        if not self._in_use():
            return 0.0
        return LATE_SIGMA * self._late / (self._row - self._hull[0][0]) / self._interval

    def _in_use(self) -> bool:
        return self._line_is_smoother and self._late > LEAST_JITTER and self._count > FIRST_ROWS

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
        if intervals > MOST_LOST:
            self._restart()
        self._step = step / intervals
        intervals += self._lost_at_rest(t, lateness, expected > 0)
        self._count += 1
        self._row += intervals
        self._fit_line(t)
        if self._count > 2:       # two rows determine a line
            self._late += (t - self._line - self._late) / min(self._count - 2, LATE_ROWS)

    def _lost_at_rest(self, t: float, lateness: float, moves: bool) -> int:
        """Return lost rows that the travel does not show, less those that were only late."""
        if self._assumed:
            row, t_before, interval = self._before
            least_lost = round((t - t_before) / interval) - (self._row + 1 - self._assumed - row)
            only_late = min(self._assumed, max(self._assumed - least_lost, 0))
            self._hull = [(r - only_late if r > row else r, s) for r, s in self._hull]
            self._assumed = self._assumed - only_late if self._row - row < TESTED_LOST_ROWS else 0
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
        if not self._assumed:
            self._before = self._row, self._line, self._interval
        self._assumed += lost
        return lost

    def _fit_line(self, t: float) -> None:
        """Add the row to the hull; the line is its edge at the middle of the rows."""
        hull, row = self._hull, self._row
        while len(hull) > 1 and (t - hull[-2][1]) * (hull[-1][0] - hull[-2][0]) <= (
                hull[-1][1] - hull[-2][1]) * (row - hull[-2][0]):
            hull.pop()
        hull.append((row, t))
        if len(hull) > 2 and row - hull[1][0] > LINE_ROWS:
            del hull[0]
        if len(hull) > 1:
            end = max(bisect_left(hull, ((row + hull[0][0]) / 2, 0.0)), 1)
            (row0, t0), (row1, t1) = hull[end - 1:end + 1]
            self._interval = (t1 - t0) / (row1 - row0)
        self._line = t if len(hull) == 1 else t1 + self._interval * (row - row1)

    def _compare_roughness(self, quantum: float) -> None:
        """Update the roughness of the travel at arrival and on the line, and ``error_s``."""
        (t0, p0, s0), (t1, p1, s1), (t2, p2, s2) = self._rows
        if self._count <= FIRST_ROWS or abs(s2 - s0) <= 2 * RELIABLE_COUNTS * quantum:
            return
        self._tested += 1
        share = 1 / min(self._tested, ROUGHNESS_ROWS)
        for k, (a, b, c) in enumerate(((t0, t1, t2), (p0, p1, p2))):
            linear = s0 + (s2 - s0) * (b - a) / (c - a) if c > a else s1
            self._roughness[k] += ((s1 - linear)**2 - self._roughness[k]) * share
        self._moved += (((s2 - s0) / max(p2 - p0, LEAST_STEP))**2 - self._moved) * share
        self._rounding += (quantum**2 / 12 - self._rounding) * share
        limit = ROUGHNESS_LIMIT if self._line_is_smoother else ROUGHNESS_REUSE_LIMIT
        is_known = self._tested > FIRST_ROWS
        self._line_is_smoother = not is_known or (
            self._roughness[1] <= limit**2 * self._roughness[0])
        # a time error sigma causes a deviation from the mean of both neighbours of sqrt(1.5) sigma
        variance = max(self._roughness[self._in_use()] / 1.5 - self._rounding, 0.0)
        self.error_s = math.sqrt(variance / max(self._moved, LEAST_STEP))
        if not is_known:       # times of arrival may be correct
            self.error_s = max(self.error_s, LATE_SIGMA * self._late)
