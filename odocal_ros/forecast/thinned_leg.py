# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A leg in few rows, kept while it is recorded: for forecasts, never for a result.

Rows are collected into cells of time, one row each. IMU values and speeds are averaged, since
every tenth row alone would change vibration into rotation; counts and other values are the last
ones in a cell. If there are too many cells their width is doubled, so that memory and work do not
grow with the leg.
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

# judgement: a tenth of the time between keyframes; cells of a topic, 26 minutes of this width, so
# that the time of an update is bounded
FIRST_CELL_NS = 100_000_000
MAX_CELLS = 16_000
FINAL_AGE_NS = round(ON_TIME_WINDOW * 1e9)    # definition: later rows have no effect
INTERVAL_SPAN_NS = 3 * FINAL_AGE_NS    # judgement: earlier rows that determine the interval
UNROLLED = data.OdometerForm('cumulative', 0, '')     # definition: a count that never rolls over


class ThinnedLeg:
    """Cells of each topic; ``feed`` takes blocks in order of arrival."""

    def __init__(self, form: data.OdometerForm | None = None) -> None:
        self.form = form or COUNTER
        # by slot
        self._cells: dict[str, Any] = {}               # rows of finished cells
        self._unfinished: dict[str, Any] = {}          # samples of the unfinished cell
        self._width_ns: dict[str, int] = {}            # of the cells
        self._recent: dict[str, RecentCounts] = {}     # newest counts
        # last count as received, (1,), and without rollovers
        self._last: dict[str, tuple[Values, int | float]] = {}
        self._fix_steps: list[Ints] = []               # ns between fixes

    def feed(self, slot: str, samples: data.Samples) -> None:
        """Take a block of a topic."""
        samples = _usable_rows(samples)
        if not len(samples.stamp_ns):
            return
        if slot == 'fix':
            before = self._unfinished.get('fix', data.take(samples, slice(0, 0))).stamp_ns[-1:]
            self._fix_steps.append(np.diff(np.append(before, samples.stamp_ns)))
        if isinstance(samples, data.OdometerSamples) and self.form.quantity != 'rate':
            recent = self._recent.setdefault(slot, RecentCounts())
            samples = recent.feed(self._unroll(slot, samples))
            if not len(samples.stamp_ns):
                return
        rows = samples if slot not in self._unfinished else data.join(
            [self._unfinished[slot], samples])
        width_ns = self._width_ns.setdefault(slot, FIRST_CELL_NS)
        cell = rows.stamp_ns // width_ns
        changes = np.flatnonzero(np.diff(cell)) + 1
        first_open = int(changes[-1]) if len(changes) else 0
        self._unfinished[slot] = data.take(rows, slice(first_open, None))
        if not first_open:
            return
        mean_columns = self._mean_columns(slot)
        cells = _cell_rows(data.take(rows, slice(first_open)), cell[:first_open], mean_columns)
        if slot in self._cells:
            cells = data.join([self._cells[slot], cells])
        while len(cells.stamp_ns) > MAX_CELLS:
            width_ns *= 2
            cells = _cell_rows(cells, cells.stamp_ns // width_ns, mean_columns)
        self._cells[slot], self._width_ns[slot] = cells, width_ns

    def leg(self, start_ns: int) -> Leg:
        """Return the samples so far as a leg, up to the last cell of IMU, or else odometer."""
        form, cells = self.form, self._cells | {slot: self._counts(slot) for slot in self._recent}
        if form.quantity != 'rate':
            is_integer = np.issubdtype(cells['odometer'].value.dtype, np.integer) \
                if 'odometer' in cells else True
            form = replace(COUNTER if is_integer else UNROLLED, scale_unit=form.scale_unit,
                           sides_known=form.sides_known)
        leading = cells.get('imu', cells.get('odometer'))
        stop_ns = start_ns if leading is None else int(leading.stamp_ns[-1])
        return Leg(start_ns=start_ns, stop_ns=stop_ns, form=form).with_rows(**cells)

    def _counts(self, slot: str) -> data.OdometerSamples:
        """Return the cells of a counter, also of rows whose times are not final."""
        rows = self._recent[slot].remaining_rows()
        if slot in self._unfinished:
            rows = data.join([self._unfinished[slot], rows])
        width_ns = self._width_ns.get(slot, FIRST_CELL_NS)
        cells = _cell_rows(rows, rows.stamp_ns // width_ns, ())
        finished: data.OdometerSamples | None = self._cells.get(slot)
        return cells if finished is None else data.join([finished, cells])

    def fix_rate(self) -> float:
        """Return the fix rate by the median interval, Hz; NaN with too few fixes."""
        steps = np.concatenate([np.empty(0, np.int64), *self._fix_steps])
        self._fix_steps = [steps[-MAX_CELLS:]]
        rising = steps[steps > 0]
        return 1e9 / float(np.median(rising)) if len(rising) else float('nan')

    def _mean_columns(self, slot: str) -> tuple[str, ...]:
        """Return the names of the columns of a topic that are averaged in a cell."""
        rates = ('value',) if self.form.quantity == 'rate' else ()
        return {'imu': ('w_i', 'f_i'), **dict.fromkeys(WHEELS, rates)}.get(slot, ())

    def _unroll(self, slot: str, samples: data.OdometerSamples) -> data.OdometerSamples:
        """Return counts or increments as a running count that never rolls over."""
        last, count = self._last.get(slot, (samples.value[:1], 0))
        value = samples.value
        if self.form.quantity == 'increment':
            step = value.copy()
        else:
            step = without_rollover(np.diff(value, prepend=last), self.form.modulus)
        total: Values = count + np.cumsum(step)  # type: ignore[assignment]
        self._last[slot] = value[-1:], total[-1]
        return replace(samples, value=total)


def _usable_rows(samples: data.SomeSamples) -> data.SomeSamples:
    """Return the rows with a stamp, and with finite values where a mean is computed."""
    keep = samples.stamp_ns > 0
    if isinstance(samples, data.ImuSamples):
        keep &= np.isfinite(samples.w_i).all(axis=1) & np.isfinite(samples.f_i).all(axis=1)
    elif isinstance(samples, data.OdometerSamples):
        keep &= np.isfinite(samples.value)
    return samples if keep.all() else data.take(samples, keep)


def _cell_rows(rows: data.SomeSamples, cell: Ints,
               mean_columns: tuple[str, ...]) -> data.SomeSamples:
    """Return one row for each run of equal ``cell``: the last one, with means of some columns."""
    first = np.flatnonzero(np.diff(cell, prepend=cell[0] - 1))
    count = np.diff(np.append(first, len(cell)))
    last = data.take(rows, first + count - 1)
    if not mean_columns:
        return last

    def mean(values: Floats | Ints) -> Floats:
        return (np.add.reduceat(values, first).T / count).T      # sums of the runs

    columns: dict[str, Any] = {name: mean(getattr(rows, name)) for name in mean_columns}
    since_ns = rows.stamp_ns - np.repeat(rows.stamp_ns[first], count)
    return replace(last, stamp_ns=rows.stamp_ns[first] + mean(since_ns).astype(np.int64),
                   **columns)


class RecentCounts:
    """The newest rows of a counter that never rolls over; late rows are moved as in results."""

    def __init__(self) -> None:
        self._rows: data.OdometerSamples | None = None
        self._returned = 0             # number of these rows that ``feed`` has returned

    def feed(self, rows: data.OdometerSamples) -> data.OdometerSamples:
        """Take rows, and return those whose times are final."""
        rows = rows if self._rows is None else data.join([self._rows, rows])
        final_count = max(self._returned, int(np.searchsorted(
            rows.stamp_ns, rows.stamp_ns[-1] - FINAL_AGE_NS)))
        final = data.take(_at_sampling_times(rows), slice(self._returned, final_count))
        first = int(np.searchsorted(rows.stamp_ns, rows.stamp_ns[final_count] - INTERVAL_SPAN_NS))
        self._rows, self._returned = data.take(rows, slice(first, None)), final_count - first
        return final

    def remaining_rows(self) -> data.OdometerSamples:
        """Return the rows not returned yet at their estimated times; after ``feed`` only."""
        assert self._rows is not None
        return data.take(_at_sampling_times(self._rows), slice(self._returned, None))


def _at_sampling_times(rows: data.OdometerSamples) -> data.OdometerSamples:
    """Return rows with rising stamps at their estimated sampling times."""
    sampled_s, _ = sampling_times(rows, (rows.stamp_ns - rows.stamp_ns[0]) * 1e-9, UNROLLED)
    sampled_ns = rows.stamp_ns[0] + np.rint(sampled_s * 1e9).astype(np.int64)
    return replace(rows, stamp_ns=np.maximum.accumulate(sampled_ns))
