# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A leg: the samples between two marks, and the recorder that collects them live and in replay."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np

from odocal_ros.data import samples
from odocal_ros.data.arrays import Ints, map_rows, runs
from odocal_ros.data.inputs import EXTERNAL_SLOTS, INPUTS, WHEELS
from odocal_ros.data.spool import Rows
from odocal_ros.errors import BadData

MAX_DAYS = 7          # judgement: of a leg
# slot -> function that returns samples without rows
MAKE_EMPTY: dict[str, Callable[[], samples.Samples]] = {
    'imu_other': samples.OtherImuSamples.empty,
    **{slot: getattr(samples, source.sample_class).empty for slot, source in INPUTS.items()}}
SLOTS = tuple(MAKE_EMPTY)
OTHER_SLOTS = (*WHEELS[2:], *EXTERNAL_SLOTS)      # definition: slots without a field in ``Leg``
COUNTER = samples.OdometerForm('cumulative', 2**64, 'm/pulse')    # definition: 64 bit


@dataclass(frozen=True, eq=False)
class Leg:
    """
    The samples between two marks, with the pre-roll before the first.

    Each topic has the rows from ``start_ns`` minus the pre-roll to the first row after
    ``stop_ns``, unchanged, in order of arrival. ``odometer`` is the only wheel or the first of
    several; ``form`` is the meaning of its values, ``form_right`` that of the values of
    ``odometer_right`` (None: as ``form``).
    """

    start_ns: int
    stop_ns: int
    imu: samples.ImuSamples = field(default_factory=samples.ImuSamples.empty)
    imu_other: samples.OtherImuSamples = field(default_factory=samples.OtherImuSamples.empty)
    odometer: samples.OdometerSamples = field(default_factory=samples.OdometerSamples.empty)
    odometer_right: samples.OdometerSamples = field(default_factory=samples.OdometerSamples.empty)
    fix: samples.FixSamples = field(default_factory=samples.FixSamples.empty)
    others: Mapping[str, samples.Samples] = field(default_factory=dict)   # of OTHER_SLOTS, by slot
    form: samples.OdometerForm = COUNTER
    form_right: samples.OdometerForm | None = None

    @property
    def wheel_slots(self) -> tuple[str, ...]:
        """Return the slots of the wheels with messages, and in any case the first."""
        return (WHEELS[0], *(slot for slot in WHEELS[1:] if len(self.rows(slot).stamp_ns)))

    def rows(self, slot: str) -> Any:
        """Return the samples of a slot."""
        rows = self.others.get(slot) if slot in OTHER_SLOTS else getattr(self, slot)
        return MAKE_EMPTY[slot]() if rows is None else rows

    def with_rows(self, **rows: samples.Samples) -> 'Leg':
        """Return the leg with other samples in some slots."""
        others = {slot: rows.pop(slot) for slot in OTHER_SLOTS if slot in rows}
        changed: dict[str, Any] = {'others': {**self.others, **others}, **rows}
        return replace(self, **changed)

    def form_of(self, slot: str) -> samples.OdometerForm:
        """Return the meaning of the values of a wheel."""
        return self.form_right or self.form if slot == WHEELS[1] else self.form


@final
class LegRecorder:
    """Collects blocks of rows until a leg ends; the leg does not depend on the sizes of blocks."""

    def __init__(self) -> None:
        self._rows = {slot: Rows(make_empty) for slot, make_empty in MAKE_EMPTY.items()}
        self.form = COUNTER
        self.form_right: samples.OdometerForm | None = None

    def feed(self, slot: str, block: samples.Samples) -> None:
        """Append a block (one row or many) to a slot of SLOTS."""
        if len(block.stamp_ns):
            self._rows[slot].feed(block)

    def adopt(self, slot: str, other: 'LegRecorder', other_slot: str) -> None:
        """Use the rows of a slot of another recorder for a slot of this one, if there are any."""
        if len(other.rows(other_slot).stamp_ns):
            self._rows[slot] = other._rows[other_slot].snapshot()

    def newest_ns(self, slot: str) -> int:
        """Return the stamp of the last row fed, 0 before the first."""
        return self._rows[slot].newest_ns

    def rows(self, slot: str) -> Any:
        """Return all rows of a slot as one block, in order of arrival."""
        return self._rows[slot].all()

    def snapshot(self) -> 'LegRecorder':
        """Return a copy of the rows so far, for another thread; this one continues unchanged."""
        copy = LegRecorder()
        copy.form, copy.form_right = self.form, self.form_right
        copy._rows = {slot: rows.snapshot() for slot, rows in self._rows.items()}
        return copy

    def forget_before(self, stamp_ns: int, slots: Iterable[str] = SLOTS) -> None:
        """Drop blocks that are completely before a stamp, to limit memory."""
        for slot in slots:
            self._rows[slot].forget(
                lambda block: _stamp_or_arrival(block.stamp_ns, block.received_ns) < stamp_ns)

    def clear(self) -> None:
        """Drop all rows, as after a jump of time."""
        self.__init__()

    def close(self, start_ns: int, stop_ns: int, preroll: float = 600.0) -> Leg:
        """
        Return the leg between two marks, with ``preroll`` seconds before the first.

        Each topic has its rows up to the first one after ``stop_ns``, so that values can be
        interpolated at the mark.

        Raises BadData: the marks are more than MAX_DAYS apart, too long for a computation.
        """
        days = (stop_ns - start_ns) / 86400e9
        if days > MAX_DAYS:
            raise BadData(f'the leg lasts {days:.0f} days according to its stamps (limit '
                          f'{MAX_DAYS}): a clock was set during recording, or the stamps are '
                          'damaged; mark a section with --leg A:B')
        first_ns = start_ns - round(preroll * 1e9)
        rows = {slot: _cut(self.rows(slot), first_ns, stop_ns) for slot in SLOTS}
        return Leg(start_ns=start_ns, stop_ns=stop_ns, form=self.form,
                   form_right=self.form_right).with_rows(**rows)


def part_of(leg: Leg, start_ns: int, stop_ns: int, first_ns: int | None) -> Leg:
    """Return the part of a leg between two stamps, without IMU rows before ``first_ns``."""
    first_ns = first_ns or 0
    # odometer and fixes begin earlier, to be interpolated at the first row of the IMU
    lead_ns = 10**9
    rows = {slot: _cut(leg.rows(slot), first_ns - lead_ns, stop_ns) for slot in SLOTS}
    imu = rows['imu']
    rows['imu'] = samples.take(imu, (imu.stamp_ns >= first_ns) & (imu.stamp_ns <= stop_ns))
    return replace(leg, start_ns=start_ns, stop_ns=stop_ns).with_rows(**rows)


def _stamp_or_arrival(stamp_ns: Ints, received_ns: Ints) -> Ints:
    """Return the stamps, and the arrival of rows without one: (n,) ns."""
    return np.where(stamp_ns > 0, stamp_ns, received_ns)


def _cut(rows: samples.SomeSamples, first_ns: int, stop_ns: int) -> samples.SomeSamples:
    """Return the rows between two stamps, and up to the first one after them."""
    time_ns = map_rows(_stamp_or_arrival, rows.stamp_ns, rows.received_ns)
    max_ns = stop_ns + 600 * 10**9    # later rows have no information on the mark
    next_ns = time_ns[(time_ns > stop_ns) & (time_ns <= max_ns)]
    last_ns = next_ns.min() if len(next_ns) else stop_ns
    keep = (time_ns >= first_ns) & (time_ns <= last_ns)
    if keep.all():
        return rows
    spans = runs(keep)      # one if rows are in order of time: a slice is then a view, not a copy
    return samples.take(rows, slice(*spans[0]) if len(spans) == 1 else keep)
