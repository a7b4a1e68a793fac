# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Comparison of calibrations of one vehicle, to detect changes of tyres, mounting or sensors.

In: calibrations, the oldest first. Out: the change of each value since the first and the previous
one, in sigmas, and the likely cause of a significant one.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
import math
from operator import itemgetter
from pathlib import Path
from typing import Any

from odocal_ros.calib.number_text import format_change
from odocal_ros.calib.result import Estimate
from odocal_ros.calib.value_limits import OTHER_CAUSE, TYRE_CAUSE, TYRE_CHANGE_LIMIT
from odocal_ros.errors import BadUsage
from odocal_ros.library.calibration import Calibration
from odocal_ros.nav.rotations import wrap
from odocal_ros.output.stored import read_stored, Stored, stored_from
from odocal_ros.output.value_text import ANGLES
from odocal_ros.settings.levels import REMARK_SIGMAS

# values of one drive (turn-on bias, its heading), or derived from another value
NOT_COMPARED = {'scale_ratio', 'heading_error', 'gyro_bias_x', 'gyro_bias_y', 'gyro_bias_z'}
ORDER = ('scale_factor', 'scale_factor_left', 'scale_factor_right', 'track_width',
         'yaw_mounting_angle', 'pitch_mounting_angle')
CAUSES = {
    'scale': f'{TYRE_CAUSE}; calibrate again to be sure, then use the newer value',
    'track': 'another rim or tyre; calibrate again to be sure',
    'yaw': 'the IMU was moved, or the heading comes from another source; calibrate again to be '
           'sure',
    'pitch': 'load, suspension, or the IMU was moved; calibrate again to be sure',
    'lever': 'a sensor was moved, or its lever arm is wrong; measure the lever arm',
    'delay': 'a driver, bus or receiver has other settings; compare them'}


@dataclass(frozen=True)
class Difference:
    """A change of one parameter from one calibration to a later one."""

    since: int                # index of the earlier one
    change: float             # in the parameter's unit
    sigma: float | None       # of the change
    sigmas: float | None      # change over sigma, None if a sigma is unknown or zero
    sigmas_if_shared_cancels: float | None    # change over its sigma without shared errors

    @property
    def is_significant(self) -> bool:
        """Return True if the change is larger than its errors explain."""
        return self.sigmas is not None and abs(self.sigmas) > REMARK_SIGMAS


@dataclass(frozen=True)
class Entry:
    """A parameter in one calibration, with its change since the first and the one before."""

    index: int                          # of the calibration
    estimate: Estimate
    to_first: Difference | None         # None: there is no earlier usable one
    to_previous: Difference | None


@dataclass(frozen=True)
class Change:
    """A parameter over all calibrations."""

    parameter: str
    unit: str
    entries: tuple[Entry, ...]    # of the calibrations that have it, in order


def find_changes(stored: list[Stored]) -> list[Change]:
    """
    Return each parameter of two or more usable calibrations, over all that have it.

    A rejected calibration shows its change, but is no reference for later ones.

    Raises BadUsage: the units of a parameter differ: these are different odometers.
    """
    names = sorted({n for s in stored for n, e in s.estimates.items()
                    if e.value is not None} - NOT_COMPARED,
                   key=lambda n: (ORDER.index(n) if n in ORDER else len(ORDER), n))
    if _differently_mounted(stored):
        names = [n for n in names if n not in ANGLES]
    return [c for c in (_change(name, stored) for name in names)
            if sum(stored[e.index].usable for e in c.entries) > 1]


def comparability_notes(stored: list[Stored]) -> list[str]:
    """Return notes on calibrations that are not, or not fully, comparable."""
    texts = []
    for s in stored:
        if not s.usable:
            codes = ', '.join(dict.fromkeys(s.reasons[:3]))
            texts.append(f'{s.name} is rejected ({codes}): shown, but not compared')
    for i, a in enumerate(stored):
        for b in stored[i + 1:]:
            if a.bags & b.bags or a.legs & b.legs:
                texts.append(f'{a.name} and {b.name} use the same drive: their errors are '
                             'correlated, so a change is more significant than shown')
    if _differently_mounted(stored):
        texts.append('imu.mounting_rpy differs: mounting angles are not compared')
    return texts


def _differently_mounted(stored: list[Stored]) -> bool:
    """Return True if the mounting angles refer to different nominal mountings."""
    return len({str(s.config.get('imu.mounting_rpy')) for s in stored}) > 1


def _change(name: str, stored: list[Stored]) -> Change:
    """Return a parameter in all calibrations that have it; raise BadUsage if units differ."""
    indices = [i for i, s in enumerate(stored) if s.value(name) is not None]
    unit = stored[indices[0]].estimates[name].unit
    entries = []
    first = previous = None
    for i in indices:
        if stored[i].estimates[name].unit != unit:
            raise BadUsage(f'{stored[i].name}: {name} is in {stored[i].estimates[name].unit}, in '
                           f'{stored[indices[0]].name} in {unit}; compare calibrations of the '
                           'same odometer and unit')
        entries.append(Entry(i, stored[i].estimates[name], _difference(name, stored, first, i),
                             _difference(name, stored, previous, i)))
        if stored[i].usable:
            first, previous = i if first is None else first, i
    return Change(name, unit, tuple(entries))


def _difference(name: str, stored: list[Stored], since: int | None,
                index: int) -> Difference | None:
    """Return the difference between two calibrations by index, None without an earlier one."""
    if since is None:
        return None
    a, b = stored[since], stored[index]
    old, new = a.estimates[name], b.estimates[name]
    assert old.value is not None     # entries have a value
    assert new.value is not None
    change = new.value - old.value
    if name in ANGLES:      # of a backward IMU they are near +-pi
        change = float(wrap(change))
    if old.sigma is None or new.sigma is None:
        return Difference(since, change, None, None, None)
    sigma = math.hypot(old.sigma, new.sigma)
    # an error that is the same in both, effects a and b, adds (a - b)^2 instead of a^2 + b^2
    shared = sum(2 * effect * b.budget[name][source][0]
                 for source, (effect, is_shared) in a.budget.get(name, {}).items()
                 if is_shared and b.budget.get(name, {}).get(source, (0, False))[1])
    smallest = math.sqrt(max(sigma**2 - shared, 0.0))
    return Difference(since, change, sigma, change / sigma if sigma > 0 else None,
                      change / smallest if shared and smallest > 0 else None)


@dataclass(frozen=True, eq=False)
class Comparison:
    """Changes of values over calibrations, the oldest first."""

    stored: tuple[Stored, ...]       # compared calibrations
    changes: tuple[Change, ...]      # of each parameter
    notes: tuple[str, ...]           # on calibrations
    sentences: tuple[str, ...]       # summary: one for each value that changed, or one of all
    changed: bool | None             # any change is significant; None: nothing to compare

    @property
    def sentence(self) -> str:
        """Return the summary as one text."""
        return '; '.join(self.sentences)

    def to_dict(self) -> dict[str, Any]:
        """Return the content for JSON."""
        names = [s.name for s in self.stored]

        def difference(d: Difference | None) -> dict[str, Any] | None:
            return None if d is None else asdict(d) | {'since': names[d.since]}
        return {
            'schema': 1, 'changed': self.changed, 'sentence': self.sentence,
            'notes': list(self.notes),
            'calibrations': [{'file': s.name, 'created': s.created, 'verdict': s.verdict.value,
                              'legs': len(s.legs)} for s in self.stored],
            'changes': [{'parameter': c.parameter, 'unit': c.unit, 'values': [
                {'file': names[e.index], 'value': e.estimate.value, 'sigma': e.estimate.sigma,
                 'to_first': difference(e.to_first), 'to_previous': difference(e.to_previous)}
                for e in c.entries]} for c in self.changes]}


def compare(*calibrations: Calibration | Path | str) -> Comparison:
    """
    Compare calibrations of one vehicle, the oldest first, two or more.

    Each is a Calibration, a calibration.json or its folder.

    Raises BadUsage: there are fewer than two, a file cannot be read, or they are of different
    odometers.
    """
    if len(calibrations) < 2:
        raise BadUsage('compare: only one calibration; give two or more, the oldest first')
    stored = [stored_from(calibration.to_dict(), f'calibration {number}')
              if isinstance(calibration, Calibration) else read_stored(Path(calibration))
              for number, calibration in enumerate(calibrations, 1)]
    all_changes = find_changes(stored)
    return Comparison(tuple(stored), tuple(all_changes), tuple(comparability_notes(stored)),
                      *_verdict(all_changes, stored))


def _verdict(all_changes: list[Change],
             stored: list[Stored]) -> tuple[tuple[str, ...], bool | None]:
    """Return summary sentences, and whether any change is significant; None: not comparable."""
    if not all_changes:
        return ('nothing to compare: no value exists in two calibrations that are not '
                'rejected',), None
    compared = [(abs(d.sigmas), c, d) for c in all_changes for e in c.entries
                if stored[e.index].usable for d in (e.to_first, e.to_previous)
                if d is not None and d.sigmas is not None]
    significant: dict[str, tuple[float, Change, Difference]] = {}
    for size, change, difference in compared:
        if difference.is_significant and size > significant.get(change.parameter, (0.0,))[0]:
            significant[change.parameter] = size, change, difference
    if significant:
        return tuple(_cause(c, d, stored) for _, c, d in significant.values()), True
    if not compared:
        return ('nothing to compare: no sigma is known',), None
    size, change, _ = max(compared, key=itemgetter(0))
    return (f'no change beyond {REMARK_SIGMAS:.0f} sigma; largest: {label_of(change.parameter)}, '
            f'{size:.1f} sigma',), False


def _cause(change: Change, difference: Difference, stored: list[Stored]) -> str:
    """Return the sentence on a significant change, with its likely cause."""
    words = change.parameter.split('_')
    cause = next((text for key, text in CAUSES.items() if key in words),
                 'unknown; calibrate again')
    old_value = stored[difference.since].value(change.parameter) or 0.0
    if 'scale' in words and abs(difference.change) > TYRE_CHANGE_LIMIT * old_value:
        cause = f'{OTHER_CAUSE}; compare calibrations of the same odometer'
    return (f'{label_of(change.parameter)} changed by {change_text(change, difference, stored)} '
            f'({abs(difference.sigmas or 0.0):.1f} sigma) since '
            f'{stored[difference.since].name}; likely cause: {cause}')


def label_of(parameter: str) -> str:
    """Return the name of a parameter for people."""
    return parameter.replace('gnss', 'fix').replace('_', ' ').replace(' angle', '')


def change_text(change: Change, difference: Difference, stored: Sequence[Stored]) -> str:
    """Return a change as text: scales in per cent, angles in deg."""
    if change.parameter.startswith('scale_'):
        old_value = stored[difference.since].value(change.parameter)
        assert old_value is not None      # entries have a value
        return format_change(difference.change / old_value)
    if change.unit == 'rad':
        return f'{math.degrees(1.0) * difference.change:+.3g} deg'
    return f'{difference.change:+.3g} {change.unit}'


def shared_error_notes(all_changes: Sequence[Change], stored: Sequence[Stored]) -> Iterator[str]:
    """Yield notes on changes that are significant only if shared errors are the same in both."""
    for change in all_changes:
        last = change.entries[-1]
        for d in (last.to_first, last.to_previous):
            sigmas = abs(d.sigmas_if_shared_cancels or 0.0) if d is not None else 0.0
            if d is not None and stored[last.index].usable and not d.is_significant \
                    and sigmas > REMARK_SIGMAS:
                yield (f'note: the change of the {label_of(change.parameter)} is {sigmas:.1f} '
                       'sigma if errors of heading source and lever arms are the same in both')
                break
