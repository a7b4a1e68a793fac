# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A leg in few rows, kept while it is recorded: for forecasts, never for a result.

Rows are gathered into cells of time. Turn rates are averaged, since every tenth row alone would
turn vibration into rotation; counts are those at the end of a cell. When there are too many cells
their width is doubled, so that memory and work do not grow with the leg.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from odocal_ros.data import samples as data
from odocal_ros.data.arrays import Floats, Ints, Values
from odocal_ros.data.inputs import WHEELS
from odocal_ros.data.leg import COUNTER, Leg
from odocal_ros.nav.odometer import without_rollover
from odocal_ros.screening.late_rows import ON_TIME_WINDOW, sampling_times

# judgement: a tenth of the time between keyframes; per topic 26 minutes of them with pre-roll, so
# that the time of an update is bounded
FIRST_CELL_NS = 100_000_000
MOST_CELLS = 16_000
SETTLED_NS = round(ON_TIME_WINDOW * 1e9)    # definition: after it later rows have no effect
RHYTHM_NS = 3 * SETTLED_NS       # judgement: earlier rows, which determine the rhythm
UNROLLED = data.OdometerForm('cumulative', 0, '')     # definition: a count that never rolls over


class ThinnedLeg:
    """Cells of each topic; ``feed`` takes blocks in order of arrival."""

    def __init__(self, form: data.OdometerForm | None = None) -> None:
        self.form = form or COUNTER
        self._cells: dict[str, Any] = {}       # slot -> rows, one a cell
        self._open: dict[str, Any] = {}        # slot -> rows of the unfinished cell
        self._width_ns: dict[str, int] = {}
        self._late: dict[str, LateSoFar] = {}        # slot -> the newest counts
        # slot -> last count as received, (1,), and as unrolled
        self._last: dict[str, tuple[Values, int | float]] = {}
        self._fix_steps: list[Ints] = []

    def feed(self, slot: str, samples: data.Samples) -> None:
        samples = _usable(samples)
        if not len(samples.stamp_ns):
            return
        if slot == 'fix':
            before = self._open.get('fix', data.take(samples, slice(0, 0))).stamp_ns[-1:]
            self._fix_steps.append(np.diff(np.append(before, samples.stamp_ns)))
        if isinstance(samples, data.OdometerSamples) and self.form.quantity != 'rate':
            samples = self._late.setdefault(slot, LateSoFar()).feed(self._unrolled(slot, samples))
            if not len(samples.stamp_ns):
                return
        rows = data.join([self._open[slot], samples]) if slot in self._open else samples
        width_ns = self._width_ns.setdefault(slot, FIRST_CELL_NS)
        cell = rows.stamp_ns // width_ns
        over = int(np.flatnonzero(np.diff(cell))[-1]) + 1 if (np.diff(cell) != 0).any() else 0
        self._open[slot] = data.take(rows, slice(over, None))
        if not over:
            return
        done = _gathered(data.take(rows, slice(None, over)), cell[:over], self._averaged(slot))
        cells = data.join([self._cells[slot], done]) if slot in self._cells else done
        while len(cells.stamp_ns) > MOST_CELLS:
            width_ns *= 2
            cells = _gathered(cells, cells.stamp_ns // width_ns, self._averaged(slot))
        self._cells[slot], self._width_ns[slot] = cells, width_ns

    def leg(self, start_ns: int) -> Leg:
        """Return the samples so far as a leg, up to the last cell of IMU, or else odometer."""
        form, cells = self.form, self._cells | {slot: self._newest(slot) for slot in self._late}
        if form.quantity != 'rate':
            whole = np.issubdtype(cells['odometer'].value.dtype, np.integer) \
                if 'odometer' in cells else True
            form = replace(COUNTER if whole else UNROLLED, scale_unit=form.scale_unit,
                           sides=form.sides)
        leading = cells.get('imu', cells.get('odometer'))
        stop_ns = start_ns if leading is None else int(leading.stamp_ns[-1])
        return Leg(start_ns=start_ns, stop_ns=stop_ns, form=form).with_rows(**cells)

    def _newest(self, slot: str) -> data.OdometerSamples:
        """Return the cells of a counter with rows whose times are not final."""
        rows = self._late[slot].rest()
        if slot in self._open:
            rows = data.join([self._open[slot], rows])
        width_ns = self._width_ns.get(slot, FIRST_CELL_NS)
        cells = _gathered(rows, rows.stamp_ns // width_ns, ())
        before: data.OdometerSamples | None = self._cells.get(slot)
        return cells if before is None else data.join([before, cells])

    def fix_rate(self) -> float:
        """Return the fix rate by the median interval, Hz; NaN with too few fixes."""
        steps = np.concatenate([np.empty(0, np.int64), *self._fix_steps])
        self._fix_steps = [steps[-MOST_CELLS:]]
        rising = steps[steps > 0]
        return 1e9 / float(np.median(rising)) if len(rising) else float('nan')

    def _averaged(self, slot: str) -> tuple[str, ...]:
        rates = ('value',) if self.form.quantity == 'rate' else ()
        return {'imu': ('w_i', 'f_i'), **dict.fromkeys(WHEELS, rates)}.get(slot, ())

    def _unrolled(self, slot: str, samples: data.OdometerSamples) -> data.OdometerSamples:
        """Return counts or increments as a running count that never rolls over."""
        sent, count = self._last.get(slot, (None, 0))
        value = samples.value
        if self.form.quantity == 'increment':
            step = value.copy()
        else:
            step = without_rollover(np.diff(value, prepend=value[:1] if sent is None else sent),
                                    self.form.modulus)
        total: Values = count + np.cumsum(step)  # type: ignore[assignment]
        self._last[slot] = value[-1:], total[-1]
        return replace(samples, value=total)


def _usable(samples: data.SomeSamples) -> data.SomeSamples:
    """Return the rows with a stamp, and with finite values where a mean is computed."""
    keep = samples.stamp_ns > 0
    if isinstance(samples, data.ImuSamples):
        keep &= np.isfinite(samples.w_i).all(axis=1) & np.isfinite(samples.f_i).all(axis=1)
    elif isinstance(samples, data.OdometerSamples):
        keep &= np.isfinite(samples.value)
    return samples if keep.all() else data.take(samples, keep)


def _gathered(rows: data.SomeSamples, cell: Ints, averaged: tuple[str, ...]) -> data.SomeSamples:
    """Return the last row of each run of equal ``cell``, with the means of ``averaged``."""
    first = np.flatnonzero(np.diff(cell, prepend=cell[0] - 1))
    count = np.diff(np.append(first, len(cell)))
    last = data.take(rows, first + count - 1)
    if not averaged:
        return last

    def mean(values: Floats | Ints) -> Floats:
        return (np.add.reduceat(values, first).T / count).T

    columns: dict[str, Any] = {name: mean(getattr(rows, name)) for name in averaged}
    since_ns = rows.stamp_ns - np.repeat(rows.stamp_ns[first], count)
    return replace(last, stamp_ns=rows.stamp_ns[first] + mean(since_ns).astype(np.int64),
                   **columns)


class LateSoFar:
    """The newest rows of a counter that never rolls over; late rows are moved as in results."""

    def __init__(self) -> None:
        self._rows: data.OdometerSamples | None = None
        self._given = 0             # number of these already returned

    def feed(self, rows: data.OdometerSamples) -> data.OdometerSamples:
        """Take rows, and return those whose times are final."""
        rows = rows if self._rows is None else data.join([self._rows, rows])
        settled = int(np.searchsorted(rows.stamp_ns, rows.stamp_ns[-1] - SETTLED_NS))
        settled = max(settled, self._given)
        out = data.take(_on_time(rows), slice(self._given, settled))
        first = int(np.searchsorted(rows.stamp_ns, rows.stamp_ns[settled] - RHYTHM_NS))
        self._rows, self._given = data.take(rows, slice(first, None)), settled - first
        return out

    def rest(self) -> data.OdometerSamples:
        """Return the remaining rows at their estimated times; ``feed`` came before."""
        assert self._rows is not None
        return data.take(_on_time(self._rows), slice(self._given, None))


def _on_time(rows: data.OdometerSamples) -> data.OdometerSamples:
    true_s = sampling_times(rows, (rows.stamp_ns - rows.stamp_ns[0]) * 1e-9, UNROLLED, [])
    true_ns = rows.stamp_ns[0] + np.rint(true_s * 1e9).astype(np.int64)
    return replace(rows, stamp_ns=np.maximum.accumulate(true_ns))
