# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Travel of one wheel in a stream, with the variance of travel that is not measured.

In: rows (time, counter value or speed). Out: travel at any time. Rollovers are corrected; resets
and rows that no vehicle can cause are replaced by travel at the last speed. A stream has only
earlier rows, unlike a leg (``nav/odometer.py``), but its scale is known.
"""

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
import math

from odocal_ros.apply.row_times import RowTimes
from odocal_ros.data.samples import OdometerForm
from odocal_ros.settings.levels import FASTEST

# judgement: averaging time of the speed, s, least and largest; number of counts in this time
MIN_SPEED_TIME, MAX_SPEED_TIME, SPEED_COUNTS = 0.1, 0.5, 10.0
INTERVAL_SHARE = 0.1      # judgement: of a new interval in the mean interval between rows
# m/s^2; physical: half of g, hard braking; largest acceleration of a wheel that locks or spins
HARD_BRAKING, WHEEL_ACCELERATION = 5.0, 15.0
# judgement: longest burst of stamps, s; largest deviation of a row, in mean jitters of the stamps;
# averaging length of the jitter, rows
STAMP_BURST, DEVIATION_JITTERS, JITTER_ROWS = 0.25, 5.0, 50
# judgement: limit of the lateness of a row, mean jitters plus s: lost counts are not jitter
LATENESS_RATIO, LATENESS_OFFSET = 2.0, 1e-3
# judgement: least deviation of a counter that stops abruptly, mean jitters; held values have 3
HUNG_JITTERS = 2.0
# judgement: rows before the first test; number of consecutive rows that are refused, and their
# least duration, s, before one is accepted
FIRST_UNTESTED_ROWS, MAX_REFUSED_ROWS, MIN_REFUSED_TIME = 5, 2, 0.5
UNEXPLAINED_TIME = 1.0    # s; judgement: later, acceleration may explain a step of the speed
KEPT_TIME = 60.0    # s; judgement: older rows are dropped, also without IMU messages
MIN_TRAVEL_ERROR = 1e-3   # m; judgement: smaller ones between two speeds are below slip
MIN_ROW_GAP, ROW_GAP_INTERVALS = 0.5, 2.5    # judgement: least gap, s and mean intervals
# judgement: relative error of a speed interpolated over a gap: gap / GAP_ERROR_TIME (s); its limit
GAP_ERROR_TIME, MAX_GAP_ERROR = 50.0, 0.3


class Wheel:
    """Travel of a wheel at the times of its rows; scale: m per unit; notes: texts on faults."""

    def __init__(self, form: OdometerForm, scale: float, is_reversed: bool = False) -> None:
        self.form, self._is_speed = form, form.quantity == 'rate'
        self.scale = -scale if is_reversed else scale      # m per unit, signed
        self.quantum = 0.0             # m, size of a count, 0 if values are not counts
        self.speed = self.mean_interval = 0.0     # m/s, of the last rows; s between rows
        self.is_hung = False           # it stopped abruptly, and has not moved since
        self.notes: list[str] = []
        self.times: deque[float] = deque()        # s, of the rows
        self.travels: deque[float] = deque()      # m, since the first row
        # time, s, and variance, m^2, of each interval whose travel is not measured
        self._variances: deque[tuple[float, float]] = deque()
        self.row_times = RowTimes()
        self._arrival = -math.inf      # s, of the last row
        self._value: int | float | None = None
        self._row_count = self._refused_rows = 0      # of all rows; of consecutive refused ones
        self._refused_since = 0.0      # s, time of the first of these
        self._speed_step = 0.0         # m/s, between the last two published speeds
        # m, refused travel minus speed times time: of the last refused rows, and of all before
        self._refused_error = self._refused_travel = 0.0
        # s, mean jitter of the stamps; 0 for speeds, which do not depend on it
        self._jitter = 0.0 if self._is_speed else STAMP_BURST / DEVIATION_JITTERS
        # change of speed that acceleration does not explain, m/s, 0: none; its travel, m, and
        # duration, s, so far; the speed before it, m/s
        self._unexplained_speed = self._unexplained_travel = 0.0
        self._unexplained_time = self._speed_before = 0.0

    def feed(self, times: Sequence[float], values: Sequence[float]) -> None:
        """Add rows: times, s, and raw values. Repeated times and NaN are skipped."""
        for t, value in zip(times, values, strict=True):
            if math.isfinite(value) and t > self._arrival:
                self._arrival = t
                self._add_row(t, value)
        if self.times:
            self.forget(self.times[-1] - KEPT_TIME)

    def rescale(self, scale: float) -> None:
        """Set the scale, m per unit, also for earlier travel."""
        factor = scale / abs(self.scale)
        self.scale *= factor
        self.quantum *= factor
        self.speed *= factor
        self.travels = deque(travel * factor for travel in self.travels)

    def travel_at(self, t: float) -> float:
        """Return the travel at a time, linear between rows, constant outside."""
        after, times, travels = bisect_left(self.times, t), self.times, self.travels
        if not 0 < after < len(times):
            return travels[0] if after == 0 else travels[-1]
        t0, t1, s0, s1 = times[after - 1], times[after], travels[after - 1], travels[after]
        return s0 + (s1 - s0) * (t - t0) / (t1 - t0)

    def variance_between(self, t_from: float, t_to: float) -> float:
        """Return the variance of travel that is not measured (faults, gaps), m^2."""
        return sum((variance for t, variance in self._variances if t_from < t <= t_to), 0.0)

    def jitter_variance(self, t: float, T: float) -> float:
        """Return the variance by arrival jitter of the travel in the T s before t, m^2."""
        if self._is_speed:
            return 0.0
        travel = self.travel_at(t) - self.travel_at(t - T)
        deviation = self.row_times.error_s * travel / T
        share = min(1.0, T / self.mean_interval) if self.mean_interval else 1.0
        return 2.0 * deviation**2 * share**2 + (self.row_times.rate_error * travel)**2

    def interpolation_variance(self, t: float) -> float:
        """Return the variance by interpolation of the travel at a time, m^2."""
        after, times = bisect_left(self.times, t), self.times
        if not 0 < after < len(times):
            return 0.0
        # half of the deviation of a line from a parabola with this acceleration
        return (HARD_BRAKING / 2 * (t - times[after - 1]) * (times[after] - t) / 2)**2

    def forget(self, t: float) -> None:
        """Drop the rows before a time, s, except the last one."""
        while len(self.times) > 2 and self.times[1] < t:
            self.times.popleft()
            self.travels.popleft()
        while self._variances and self._variances[0][0] < t:
            self._variances.popleft()

    def _add_row(self, t: float, value: float) -> None:
        """Add a row: correct its time, test it, and update travel, speed and variance."""
        if self._value is None:
            self._value = value
            self.quantum = abs(self.scale) * (isinstance(value, int) and not self._is_speed)
            self.times.append(t)
            self.travels.append(0.0)
            return
        before = self._value
        t = self._sampling_time(t, value, before)
        dt = t - self.times[-1]
        self._row_count += 1
        step = self._raw_travel(value, before, dt) * self.scale      # m
        min_gap = max(MIN_ROW_GAP, ROW_GAP_INTERVALS * self.mean_interval)
        has_gap = dt > min_gap and self._row_count > FIRST_UNTESTED_ROWS
        if has_gap:
            step += self._travel_in_gap(dt, step)
        row_speed = value * self.scale if self._is_speed else step / dt     # m/s
        deviation = abs(row_speed - self.speed) * dt
        if self._is_implausible(t, dt, step, row_speed, deviation):
            step = self._interpolated_travel(dt, step, row_speed)
            value = before if self._is_speed else value
        else:
            self._update_speed(dt, step, row_speed, deviation)
            if self._refused_error:
                self._add_refused_variance()
        if self._is_speed:
            self._add_acceleration_variance((value - before) * self.scale, dt)
        if self._unexplained_speed:      # the speed used for refused rows may be false
            self._add_speed_variance(dt)
        self._value = value
        if not has_gap:
            share = INTERVAL_SHARE if self.mean_interval else 1.0
            self.mean_interval += (dt - self.mean_interval) * share
        self.times.append(t)
        self.travels.append(self.travels[-1] + step)

    def _sampling_time(self, t: float, value: float, before: float) -> float:
        """Return the time of a row without the jitter of its arrival t, s; for speeds, t."""
        if self._is_speed:      # speeds do not show lost rows
            self.row_times.next_time(t, min(max(value * self.scale, -FASTEST), FASTEST), 0.0, 0.0)
            return t
        limit = FASTEST * STAMP_BURST + self.quantum
        step = min(max(self._raw_travel(value, before, 0.0) * self.scale, -limit), limit)
        return self.row_times.next_time(t, self.travels[-1] + step, self.speed, self.quantum)

    def _interpolated_travel(self, dt: float, step: float, row_speed: float) -> float:
        """Return the travel, m, that replaces that of an implausible row; add its variance."""
        self.notes.append(f'the counter jumps by {step:+z.1f} m in {dt:.2f} s: a reset or an '
                          'invalid value, not motion; the travel is interpolated at '
                          f'{self.speed:.1f} m/s')
        if abs(row_speed * dt) <= self._step_limit(dt):      # else it is certainly not travel
            self._refused_error += row_speed * dt - self.speed * dt
        # uniform error up to the travel at this speed and acceleration
        lost = (abs(self.speed) + HARD_BRAKING * dt) * dt
        self._add_variance((lost**2 + self.quantum**2) / 3)
        return self.speed * dt

    def _is_implausible(self, t: float, dt: float, step: float, row_speed: float,
                        deviation: float) -> bool:
        """Return True if a row (step in m, speed in m/s, deviation in m) is not motion."""
        is_possible = abs(step) <= self._step_limit(dt) and (
            not self._is_speed or abs(row_speed) <= FASTEST)
        is_usual = (deviation <= self._deviation_limit(dt)
                    or self._row_count <= FIRST_UNTESTED_ROWS)
        if is_possible and is_usual:
            return False
        self._refused_rows += 1
        self._refused_since = t if self._refused_rows == 1 else self._refused_since
        return not is_possible or self._refused_rows <= MAX_REFUSED_ROWS or (
            t - self._refused_since < MIN_REFUSED_TIME)

    def _step_limit(self, dt: float) -> float:
        """Return the largest travel in dt s, m."""
        return FASTEST * max(dt, STAMP_BURST) + self.quantum

    def _stops_abruptly(self, dt: float, step: float) -> bool:
        """Return True if the counter stops faster than by hard braking."""
        return not step and not self._unexplained_speed and not self._is_speed and (
            abs(self.speed) * dt > self._deviation_limit(dt, HARD_BRAKING, HUNG_JITTERS))

    def _deviation_limit(self, dt: float, acceleration: float = WHEEL_ACCELERATION,
                         jitters: float = DEVIATION_JITTERS) -> float:
        """Return the largest plausible deviation of a row's travel from the speed, m."""
        T = max(dt, self.mean_interval)      # a row of a burst contains the travel of an interval
        return (acceleration * (T + self._speed_time()) * T + 3 * self.quantum
                + (jitters * self._jitter + T - dt) * abs(self.speed))

    def _speed_time(self) -> float:
        """Return the averaging time of the speed, s; longer for coarse counts."""
        counts = SPEED_COUNTS * self.quantum
        coarse = counts / max(abs(self.speed), counts) if counts else 0.0
        return min(MAX_SPEED_TIME, MIN_SPEED_TIME + coarse)

    def _update_speed(self, dt: float, step: float, row_speed: float, deviation: float) -> None:
        """Update the speed by an accepted row; add variance after a step of the speed."""
        stops_abruptly = self._stops_abruptly(dt, step)
        self.is_hung = not step and (self.is_hung or stops_abruptly or (
            self._refused_rows > 0 and deviation > self._deviation_limit(dt)))
        if self._refused_rows:
            if not self._unexplained_speed:      # else the speed is still unexplained
                self._speed_before, self._unexplained_travel = self.speed, 0.0
            change = abs(row_speed - self._speed_before)
            is_explained = change * dt <= self._deviation_limit(dt) and self._unexplained_speed > 0
            self._unexplained_speed = 0.0 if is_explained else change
            self._unexplained_time = 0.0
            self.speed = row_speed if deviation > self._deviation_limit(dt) else self.speed
        elif stops_abruptly:
            self.notes.append(f'the counter stops abruptly from {self.speed:.1f} m/s: it hangs, '
                              'or the wheel locks; the position sigma is increased')
            self._unexplained_speed, self._speed_before = abs(self.speed), self.speed
            self._unexplained_travel = self._unexplained_time = 0.0
        elif deviation > self._deviation_limit(dt, HARD_BRAKING):
            self._add_variance(deviation**2)
        self._refused_rows = 0
        if not self._is_speed:
            lateness = min(deviation / max(abs(self.speed), 1.0),
                           LATENESS_RATIO * self._jitter + LATENESS_OFFSET)
            self._jitter += (lateness - self._jitter) / JITTER_ROWS
        change = (step / dt - self.speed) * min(1.0, dt / self._speed_time())
        self.speed += min(max(change, -WHEEL_ACCELERATION * dt), WHEEL_ACCELERATION * dt)

    def _add_speed_variance(self, dt: float) -> None:
        """Add the variance of travel by the unexplained speed in the last dt s."""
        path_length = self._unexplained_travel + self._unexplained_speed * dt
        self._add_variance((path_length**2 - self._unexplained_travel**2) / 3)
        self._unexplained_travel = path_length
        self._unexplained_time += dt
        if self._unexplained_time > UNEXPLAINED_TIME:      # real acceleration explains more of it
            self._unexplained_speed = max(self._unexplained_speed - HARD_BRAKING * dt, 0.0)

    def _add_acceleration_variance(self, speed_step: float, dt: float) -> None:
        """Add the variance of travel by a change of acceleration; speed_step : m/s in dt s."""
        # the acceleration changes in the middle between two speeds
        error = abs(speed_step - self._speed_step) * dt / 4
        self._speed_step = speed_step
        if error > MIN_TRAVEL_ERROR:
            self._add_variance(error**2)

    def _add_refused_variance(self) -> None:
        """Add the variance of refused travel, which may be real: one common error."""
        before = self._refused_travel
        self._refused_travel, self._refused_error = before + self._refused_error, 0.0
        self._add_variance(max(self._refused_travel**2 - before**2, 0.0))

    def _add_variance(self, variance: float) -> None:
        """Add a variance, m^2, to the travel after the last row."""
        # 1e-6 s later, as ``variance_between`` excludes its first time
        self._variances.append((self.times[-1] + 1e-6, variance))

    def _raw_travel(self, value: float, before: float, dt: float) -> float:
        """Return the travel from a value to the next, in units of the odometer."""
        if self._is_speed:
            return (before + value) / 2 * dt
        if self.form.quantity == 'increment':
            return value
        step, modulus = value - before, self.form.modulus
        if isinstance(step, int) and modulus:
            step = (step + modulus // 2) % modulus - modulus // 2
        return step

    def _travel_in_gap(self, dt: float, step: float) -> float:
        """Return the travel, m, that ``step`` lacks for a gap of dt s; note it, add variance."""
        if self.form.quantity == 'cumulative':
            self.notes.append(f'no odometer message for {dt:.2f} s: the counts of this gap are '
                              'distributed evenly')
            return 0.0
        missing = dt - self.mean_interval     # s
        largest_speed = max(abs(self.speed), abs(step) / dt)
        error = min(missing / GAP_ERROR_TIME, MAX_GAP_ERROR)      # of a uniform distribution
        self._add_variance((error * largest_speed * missing)**2 / 3)
        self.notes.append(f'no odometer message for {dt:.2f} s: the travel is interpolated from '
                          'the adjacent speeds')
        return 0.0 if self._is_speed else self.speed * missing
