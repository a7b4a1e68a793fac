# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
The travel of one wheel as its rows come: rollover undone, resets bridged, what is lost doubted.

A leg is judged as a whole (``nav/odometer.py``, ``screening/odometer_care.py``); a stream has
only its past, and a scale that is known: what no vehicle does in the time is no travel.
"""

from collections import deque
import math

import numpy as np

from odocal_ros.data.arrays import FloatOrFloats, Floats, Values
from odocal_ros.data.samples import OdometerForm

SPEED_TIME = 0.5    # s; judgement: over which the speed beside a row is taken
# judgement: m/s that a speed may change by, s that a burst of stamps may hide
SPEED_CHANGE, STAMP_BURST = 5.0, 0.25
# judgement: rows before any is doubted; rows in turn that are refused, the next is believed
SURE_ROWS, MOST_REFUSED = 5, 2
MISSING_TIME, GAP_FACTOR = 0.5, 2.5    # s, usual intervals; judgement: messages are missing


class Wheel:
    """
    Travel of a wheel, m, at the times of its rows.

    scale : m per unit.   ``told`` takes sentences of what is found, until somebody takes them.
    """

    def __init__(self, form: OdometerForm, scale: float, reversed_counts: bool = False) -> None:
        self.form = form
        self.scale = -scale if reversed_counts else scale      # m per unit, signed
        self.speed = 0.0               # m/s, over the last rows
        self.usual = 0.0               # s between rows
        self.told: list[str] = []
        self.t: deque[float] = deque()
        self.s: deque[float] = deque()
        self.doubts: deque[tuple[float, float]] = deque()   # (t, m^2) of uncertain travel
        self._value: int | float | None = None
        self._rows = self._refused = 0

    @property
    def quantum(self) -> float:
        """Return the size of a count, m, 0 for values that are no counts."""
        whole = isinstance(self._value, int) and self.form.quantity != 'rate'
        return abs(self.scale) if whole else 0.0

    def feed(self, t: Floats, value: Values) -> None:
        """Take rows: times, s, and values as sent; what has no time or value is passed over."""
        for row in zip(t.tolist(), value.tolist(), strict=True):
            if math.isfinite(row[1]) and (not self.t or row[0] > self.t[-1]):
                self._take(*row)

    def rescale(self, scale: float) -> None:
        """Take another factor, m per unit, for what was rolled too."""
        factor = scale / abs(self.scale)
        self.scale *= factor
        self.speed *= factor
        self.s = deque(s * factor for s in self.s)

    def at(self, t: FloatOrFloats) -> FloatOrFloats:
        """Return the travel at times, linear between rows, constant outside."""
        travel: FloatOrFloats = np.interp(t, self.t, self.s)
        return travel

    def doubt(self, t_from: float, t_to: float) -> float:
        """Return the variance of the travel between two times, m^2, each doubt once."""
        return sum((variance for t, variance in self.doubts if t_from < t <= t_to), 0.0)

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
            self._add(t, 0.0)
            return
        dt, before = t - self.t[-1], self._value
        self._rows += 1
        step = self._step(value, before, dt) * self.scale
        allowed = (1.5 * abs(self.speed) + SPEED_CHANGE) * max(dt, STAMP_BURST) + 3 * self.quantum
        gap = dt > max(MISSING_TIME, GAP_FACTOR * self.usual) and self._rows > SURE_ROWS
        if gap and self.form.quantity != 'cumulative':
            step += self._bridged(t, dt, step)
        if abs(step) > allowed and self._rows > SURE_ROWS and self._refused < MOST_REFUSED:
            self._refused += 1
            self.told.append(f'the counter jumps by {step:+.1f} m in {dt:.2f} s: a reset or a '
                             f'false row, no motion; bridged at {self.speed:.1f} m/s')
            step = self.speed * dt
            self.doubts.append((t, (step**2 + self.quantum**2) / 3))
            value = before if self.form.quantity == 'rate' else value
        else:
            self._refused = 0
        self._value = value
        share = min(1.0, dt / SPEED_TIME)
        self.speed += (step / dt - self.speed) * share
        self.usual += (dt - self.usual) * (0.1 if self.usual and not gap else not gap)
        self._add(t, self.s[-1] + step)

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

    def _bridged(self, t: float, dt: float, step: float) -> float:
        """Return what to add to the travel of a gap in speeds or increments, m; doubt it."""
        missing = dt - self.usual
        lost = self.speed * missing if self.form.quantity == 'increment' else 0.0
        size = max(abs(self.speed), abs(step) / dt)
        self.doubts.append((t, (min(missing / 50, 0.3) * size * missing) ** 2 / 3))
        self.told.append(f'no odometer message for {dt:.2f} s: the travel is taken from the '
                         'speeds beside')
        return lost
