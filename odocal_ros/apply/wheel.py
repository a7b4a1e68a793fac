# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Travel of one wheel: rollovers corrected, resets interpolated, lost travel with its variance.

A leg is judged as a whole (``nav/odometer.py``, ``screening/odometer_care.py``); a stream has
only its past, and a scale that is known: what no vehicle does in the time is no travel.
"""

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence
import math

from odocal_ros.apply.arrivals import Rhythm
from odocal_ros.data.samples import OdometerForm
from odocal_ros.settings.levels import FASTEST

# s, counts; judgement: over which the speed beside a row is taken, at least and at most
LEAST_TIME, SPEED_TIME, SPEED_COUNTS = 0.1, 0.5, 10.0
# m/s^2; physical: half of g is hard braking; what a wheel that locks or spins shows at most
SPEED_CHANGE, WHEEL_CHANGE = 5.0, 15.0
# judgement: s that a burst of stamps may hide; usual jitters of stamps that a row may be off by;
# rows that determine them
STAMP_BURST, JITTERS, JITTER_ROWS = 0.25, 5.0, 50
# judgement: usual jitters, and s, that one row counts as at most: one that lost its counts is not
# late
LATEST_ROW, LATE_FLOOR = 2.0, 1e-3
HUNG_JITTERS = 2.0    # judgement: of a counter that stops at once; one that is held shows 3
# judgement: rows before any is tested; rows in turn, and s, that are refused at least before one
# is accepted
SURE_ROWS, MOST_REFUSED, REFUSED_TIME = 5, 2, 0.5
STRANGE_TIME = 1.0    # s; judgement: after it motion may explain a jump of speed
KEPT_TIME = 60.0    # s; judgement: of rows without a message of the IMU
HIDDEN = 1e-3    # m; judgement: of travel between two speeds, less is below any road's slip
MISSING_TIME, GAP_FACTOR = 0.5, 2.5    # s, usual intervals; judgement: messages are missing


class Wheel:
    """
    Travel of a wheel, m, at the times of its rows.

    scale : m per unit.   ``notes`` collects sentences on the findings.
    """

    def __init__(self, form: OdometerForm, scale: float, reversed_counts: bool = False) -> None:
        self.form = form
        self.scale = -scale if reversed_counts else scale      # m per unit, signed
        self.quantum = 0.0             # m, size of a count, 0 for values that are no counts
        self.speed = 0.0               # m/s, over the last rows
        self.usual = 0.0               # s between rows
        self.hung = False              # it stopped at once, and has not moved since
        self.notes: list[str] = []
        self.t: deque[float] = deque()
        self.s: deque[float] = deque()
        self.doubts: deque[tuple[float, float]] = deque()   # (t, m^2) of uncertain travel
        self._rhythm = Rhythm()
        self._arrival = -math.inf      # s, of the last row
        self._value: int | float | None = None
        self._rows = self._refused = 0
        self._refused_since = 0.0
        self._change = 0.0             # m/s, between the last two speeds
        # m by which rows in turn that were refused differ from the speed, and all before them
        self._owed = self._refused_travel = 0.0
        # s, of the stamps, as the rows show it; it does not change a speed
        self._jitter = STAMP_BURST / JITTERS if form.quantity != 'rate' else 0.0
        # after rows that were refused: m/s that nothing explains yet, m it may have misled by, for
        # s, m/s before it
        self._strange = self._strange_travel = self._strange_time = self._sure_speed = 0.0

    def feed(self, t: Sequence[float], value: Sequence[float]) -> None:
        """Take rows: times, s, and values as sent; what has no time or value is passed over."""
        for row in zip(t, value, strict=True):
            if math.isfinite(row[1]) and row[0] > self._arrival:
                self._arrival = row[0]
                self._take(*row)
        if self.t:
            self.forget(self.t[-1] - KEPT_TIME)

    def rescale(self, scale: float) -> None:
        """Take another factor, m per unit, for what was rolled too."""
        factor = scale / abs(self.scale)
        self.scale *= factor
        self.quantum *= factor
        self.speed *= factor
        self.s = deque(s * factor for s in self.s)

    def at(self, t: float) -> float:
        """Return the travel at a time, linear between rows, constant outside."""
        after = bisect_left(self.t, t)
        if not 0 < after < len(self.t):
            return self.s[0] if after == 0 else self.s[-1]
        t0, t1, s0, s1 = self.t[after - 1], self.t[after], self.s[after - 1], self.s[after]
        return s0 + (s1 - s0) * (t - t0) / (t1 - t0)

    def doubt(self, t_from: float, t_to: float) -> float:
        """Return the variance of the travel between two times, m^2, each uncertainty once."""
        return sum((variance for t, variance in self.doubts if t_from < t <= t_to), 0.0)

    def jitter(self, t: float, T: float) -> float:
        """Return the variance, m^2, of the travel in the T s up to a time by arrival jitter."""
        if self.form.quantity == 'rate':
            return 0.0
        off = self._rhythm.error_s * (self.at(t) - self.at(t - T)) / T
        return 2.0 * off**2 * min(1.0, T / self.usual if self.usual else 1.0)**2

    @property
    def delay_s(self) -> float:
        """Return the sigma of the delay of the rows by their arrival, s."""
        return self._rhythm.delay_s

    def between(self, t: float) -> float:
        """Return the variance, m^2, of the travel at a time because rows lie only beside it."""
        after = bisect_left(self.t, t)
        if not 0 < after < len(self.t):
            return 0.0
        sag = SPEED_CHANGE / 2 * (t - self.t[after - 1]) * (self.t[after] - t) / 2
        return sag**2

    def forget(self, t: float) -> None:
        """Drop rows that nobody asks for again."""
        while len(self.t) > 2 and self.t[1] < t:
            self.t.popleft()
            self.s.popleft()
        while self.doubts and self.doubts[0][0] < t:
            self.doubts.popleft()

    def _take(self, t: float, value: float) -> None:
        if self._value is None:
            self._value = value
            whole = isinstance(value, int) and self.form.quantity != 'rate'
            self.quantum = abs(self.scale) if whole else 0.0
            self._add(t, 0.0)
            return
        before = self._value
        if self.form.quantity == 'rate':      # its value does not show which rows are missing
            self._rhythm.place(t, min(max(value * self.scale, -FASTEST), FASTEST), 0.0, 0.0)
        else:
            most = FASTEST * STAMP_BURST + self.quantum
            step = min(max(self._step(value, before, 0.0) * self.scale, -most), most)
            t = self._rhythm.place(t, self.s[-1] + step, self.speed, self.quantum)
        dt = t - self.t[-1]
        self._rows += 1
        step = self._step(value, before, dt) * self.scale
        gap = dt > max(MISSING_TIME, GAP_FACTOR * self.usual) and self._rows > SURE_ROWS
        if gap:
            step += self._bridged(dt, step)
        shown = value * self.scale if self.form.quantity == 'rate' else step / dt     # m/s
        off = abs(shown - self.speed) * dt
        if self._is_false(t, dt, step, shown, off):
            self.notes.append(f'the counter jumps by {step:+.1f} m in {dt:.2f} s: a reset or an '
                             f'invalid value, not motion; interpolated at {self.speed:.1f} m/s')
            if abs(shown * dt) <= self._most(dt):      # else it is no travel at all
                self._owed += shown * dt - self.speed * dt
            step = self.speed * dt
            lost = (abs(self.speed) + SPEED_CHANGE * dt) * dt
            self._doubt((lost**2 + self.quantum**2) / 3)
            value = before if self.form.quantity == 'rate' else value
        else:
            self._follow(dt, step, shown, off)
            if self._owed:
                self._doubt_refused()
        if self.form.quantity == 'rate':
            self._doubt_between((value - before) * self.scale, dt)
        if self._strange:      # refused rows are interpolated at a speed that may be false
            self._doubt_speed(dt)
        self._value = value
        self.usual += (dt - self.usual) * (0.1 if self.usual and not gap else not gap)
        self._add(t, self.s[-1] + step)

    def _is_false(self, t: float, dt: float, step: float, shown: float, off: float) -> bool:
        """
        Return True if a row is not motion: a step, m, with this deviation, m, from the speed.

        shown : m/s, of the row.   What stays for a while and is possible at all is accepted.
        """
        possible = abs(step) <= self._most(dt) and (
            self.form.quantity != 'rate' or abs(shown) <= FASTEST)
        usual = off <= self._limit(dt) or self._rows <= SURE_ROWS
        if possible and usual:
            return False
        self._refused += 1
        self._refused_since = t if self._refused == 1 else self._refused_since
        return not possible or self._refused <= MOST_REFUSED or (
            t - self._refused_since < REFUSED_TIME)

    def _most(self, dt: float) -> float:
        """Return the most that a vehicle travels between rows, m."""
        return FASTEST * max(dt, STAMP_BURST) + self.quantum

    def _hangs(self, dt: float, step: float) -> bool:
        """Return True if a counter stops at once: it hangs, or the wheel locks."""
        return not step and not self._strange and self.form.quantity != 'rate' and (
            abs(self.speed) * dt > self._limit(dt, SPEED_CHANGE, HUNG_JITTERS))

    def _limit(self, dt: float, change: float = WHEEL_CHANGE, jitters: float = JITTERS) -> float:
        """Return the limit for the deviation of a row from the previous speed, m."""
        T = max(dt, self.usual)      # a row of a burst holds the motion of an interval
        return (change * (T + self._lag()) * T + 3 * self.quantum
                + (jitters * self._jitter + T - dt) * abs(self.speed))

    def _lag(self) -> float:
        """Return the time, s, that the speed is taken over: coarse counts want more."""
        counts = SPEED_COUNTS * self.quantum
        coarse = counts / max(abs(self.speed), counts) if counts else 0.0
        return min(SPEED_TIME, LEAST_TIME + coarse)

    def _follow(self, dt: float, step: float, shown: float, off: float) -> None:
        """Use the speed of an accepted row; add variance after a jump of speed."""
        hangs = self._hangs(dt, step)
        self.hung = not step and (self.hung or hangs or (
            self._refused > 0 and off > self._limit(dt)))
        if self._refused:
            if not self._strange:      # else the speed itself is not explained
                self._sure_speed, self._strange_travel = self.speed, 0.0
            back = abs(shown - self._sure_speed) * dt <= self._limit(dt) and self._strange > 0
            self._strange = 0.0 if back else abs(shown - self._sure_speed)
            self._strange_time = 0.0
            self.speed = shown if off > self._limit(dt) else self.speed
        elif hangs:
            self.notes.append(f'the counter stops at once from {self.speed:.1f} m/s: it hangs, or '
                              'the wheel locks; sigma increased')
            self._strange, self._sure_speed = abs(self.speed), self.speed
            self._strange_travel = self._strange_time = 0.0
        elif off > self._limit(dt, SPEED_CHANGE):
            self._doubt(off**2)
        self._refused = 0
        if self.form.quantity != 'rate':
            late = min(off / max(abs(self.speed), 1.0), LATEST_ROW * self._jitter + LATE_FLOOR)
            self._jitter += (late - self._jitter) / JITTER_ROWS
        change, most = (step / dt - self.speed) * min(1.0, dt / self._lag()), WHEEL_CHANGE * dt
        self.speed += min(max(change, -most), most)

    def _doubt_speed(self, dt: float) -> None:
        """Add variance of the travel in dt s at a speed that nothing explains."""
        path_length = self._strange_travel + self._strange * dt
        self._doubt((path_length**2 - self._strange_travel**2) / 3)
        self._strange_travel = path_length
        self._strange_time += dt
        if self._strange_time > STRANGE_TIME:      # motion itself may explain it
            self._strange = max(self._strange - SPEED_CHANGE * dt, 0.0)

    def _doubt_between(self, change: float, dt: float) -> None:
        """Add variance of the travel between two speeds that differ by m/s, dt s apart."""
        # a corner of the speed in the middle of the rows
        hidden, self._change = abs(change - self._change) * dt / 4, change
        if hidden > HIDDEN:
            self._doubt(hidden**2)

    def _doubt_refused(self) -> None:
        """Add variance of the travel of refused rows, which may be true: all of one cause."""
        before, self._refused_travel = self._refused_travel, self._refused_travel + self._owed
        self._owed = 0.0
        self._doubt(max(self._refused_travel**2 - before**2, 0.0))

    def _doubt(self, variance: float) -> None:
        """Add variance of the travel, m^2, from the last row on."""
        self.doubts.append((self.t[-1] + 1e-6, variance))

    def _add(self, t: float, s: float) -> None:
        self.t.append(t)
        self.s.append(s)

    def _step(self, value: float, before: float, dt: float) -> float:
        """Return the units rolled between two rows."""
        if self.form.quantity == 'rate':
            return (before + value) / 2 * dt
        if self.form.quantity == 'increment':
            return value
        step, modulus = value - before, self.form.modulus
        if isinstance(step, int) and modulus:
            step = (step + modulus // 2) % modulus - modulus // 2
        return step

    def _bridged(self, dt: float, step: float) -> float:
        """Return the travel to add for a gap, m; increase the sigma of speeds or increments."""
        if self.form.quantity == 'cumulative':
            self.notes.append(f'no odometer message for {dt:.2f} s: the counts of this gap are '
                             'distributed evenly')
            return 0.0
        missing = dt - self.usual
        lost = self.speed * missing if self.form.quantity == 'increment' else 0.0
        size = max(abs(self.speed), abs(step) / dt)
        self._doubt((min(missing / 50, 0.3) * size * missing) ** 2 / 3)
        self.notes.append(f'no odometer message for {dt:.2f} s: the travel is interpolated from '
                         'the adjacent speeds')
        return lost
