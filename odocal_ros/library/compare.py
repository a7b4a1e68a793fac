# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Comparison of calibrations of one vehicle, to detect changes of tyres, mounting or sensors."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
import math
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

# values of one drive (turn-on bias; its heading, in older results), or derived from another value
NOT_COMPARED = {'scale_ratio', 'heading_error', 'gyro_bias_x', 'gyro_bias_y', 'gyro_bias_z'}
SHOWN_FIRST = ('scale_factor', 'scale_factor_left', 'scale_factor_right', 'track_width',
               'yaw_mounting_angle', 'pitch_mounting_angle')
CAUSES = {      # likely cause and action, by a word of the parameter's name
    'scale': f'{TYRE_CAUSE}; calibrate again to be sure, then use the newer value',
    'track': 'another rim or tyre; calibrate again to be sure',
    'yaw': 'the IMU was moved, or the heading comes from another source; calibrate again to be '
           'sure',
    'pitch': 'load, suspension, or the IMU was moved; calibrate again to be sure',
    'lever': 'a sensor was moved, or its lever arm is wrong; measure the lever arm',
    'delay': 'a driver, bus or receiver has other settings; compare them'}


@dataclass(frozen=True)
class Difference:
    """The change of one parameter from one calibration to a later one."""

    since: int                # index of the earlier calibration
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
    """A parameter in one calibration, with its change since earlier ones."""

    index: int                          # of the calibration
    estimate: Estimate
    to_first: Difference | None         # None: no earlier calibration is usable
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
    known = {name for calibration in stored for name, estimate in calibration.estimates.items()
             if estimate.value is not None}
    excluded = NOT_COMPARED.union(ANGLES if _differently_mounted(stored) else ())
    names = [name for name in SHOWN_FIRST if name in known - excluded]
    names += sorted(known - excluded - set(SHOWN_FIRST))
    changes = [_change(name, stored) for name in names]
    return [change for change in changes
            if sum(stored[entry.index].usable for entry in change.entries) > 1]


def comparability_notes(stored: list[Stored]) -> list[str]:
    """Return notes on calibrations that are not, or not fully, comparable."""
    texts = []
    for calibration in stored:
        if not calibration.usable:
            codes = ', '.join(dict.fromkeys(calibration.reasons[:3]))
            texts.append(f'{calibration.name} is rejected ({codes}): shown, but not compared')
    for first, second in combinations(stored, 2):
        if first.bags & second.bags or first.legs & second.legs:
            texts.append(f'{first.name} and {second.name} use the same drive: their errors are '
                         'correlated, so a change is more significant than shown')
    if _differently_mounted(stored):
        texts.append('imu.mounting_rpy differs: mounting angles are not compared')
    return texts


def _differently_mounted(stored: list[Stored]) -> bool:
    """Return True if the mounting angles refer to different nominal mountings."""
    return len({str(calibration.config.get('imu.mounting_rpy')) for calibration in stored}) > 1


def _change(name: str, stored: list[Stored]) -> Change:
    """Return a parameter in all calibrations that have it; raise BadUsage if units differ."""
    indices = [i for i, calibration in enumerate(stored) if calibration.value(name) is not None]
    unit = stored[indices[0]].estimates[name].unit
    entries = []
    first = previous = None      # indices of usable calibrations
    for i in indices:
        estimate = stored[i].estimates[name]
        if estimate.unit != unit:
            raise BadUsage(f'{stored[i].name}: {name} is in {estimate.unit}, in '
                           f'{stored[indices[0]].name} in {unit}; compare calibrations of the '
                           'same odometer and unit')
        entries.append(Entry(i, estimate, _difference(name, stored, first, i),
                             _difference(name, stored, previous, i)))
        if stored[i].usable:
            first, previous = i if first is None else first, i
    return Change(name, unit, tuple(entries))


def _difference(name: str, stored: list[Stored], since: int | None,
                index: int) -> Difference | None:
    """Return the difference between two calibrations by index, None without an earlier one."""
    if since is None:
        return None
    old, new = stored[since].estimates[name], stored[index].estimates[name]
    assert old.value is not None     # entries have a value
    assert new.value is not None
    change = new.value - old.value
    if name in ANGLES:      # of a backward IMU they are near +-pi
        change = float(wrap(change))
    if old.sigma is None or new.sigma is None:
        return Difference(since, change, None, None, None)
    sigma = math.hypot(old.sigma, new.sigma)
    shared = _shared_variance(stored[since].budget.get(name, {}),
                              stored[index].budget.get(name, {}))
    sigma_without_shared = math.sqrt(max(sigma**2 - shared, 0.0))
    return Difference(
        since, change, sigma, change / sigma if sigma > 0 else None,
        change / sigma_without_shared if shared and sigma_without_shared > 0 else None)


def _shared_variance(old: dict[str, tuple[float, bool]],
                     new: dict[str, tuple[float, bool]]) -> float:
    """Return the variance that cancels in a difference if shared errors are the same in both."""
    # effects a and b of one error: (a - b)^2 instead of a^2 + b^2
    return sum(2 * effect * new[source][0] for source, (effect, is_shared) in old.items()
               if is_shared and new.get(source, (0, False))[1])


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
        names = [calibration.name for calibration in self.stored]

        def as_dict(difference: Difference | None) -> dict[str, Any] | None:
            return None if difference is None else asdict(difference) | {
                'since': names[difference.since]}
        return {
            'schema': 1, 'changed': self.changed, 'sentence': self.sentence,
            'notes': list(self.notes),
            'calibrations': [{'file': one.name, 'created': one.created,
                              'verdict': one.verdict.value, 'legs': len(one.legs)}
                             for one in self.stored],
            'changes': [{'parameter': change.parameter, 'unit': change.unit, 'values': [
                {'file': names[entry.index], 'value': entry.estimate.value,
                 'sigma': entry.estimate.sigma, 'to_first': as_dict(entry.to_first),
                 'to_previous': as_dict(entry.to_previous)}
                for entry in change.entries]} for change in self.changes]}


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
    changes = find_changes(stored)
    sentences, changed = _summary(changes, stored)
    return Comparison(tuple(stored), tuple(changes), tuple(comparability_notes(stored)),
                      sentences, changed)


def _summary(changes: list[Change], stored: list[Stored]) -> tuple[tuple[str, ...], bool | None]:
    """Return summary sentences, and whether any change is significant; None: not comparable."""
    if not changes:
        return ('nothing to compare: no value exists in two calibrations that are not '
                'rejected',), None
    compared = [(abs(difference.sigmas), change, difference)
                for change in changes for entry in change.entries if stored[entry.index].usable
                for difference in (entry.to_first, entry.to_previous)
                if difference is not None and difference.sigmas is not None]
    significant: dict[str, tuple[float, Change, Difference]] = {}
    for size, change, difference in compared:
        if difference.is_significant and size > significant.get(change.parameter, (0.0,))[0]:
            significant[change.parameter] = size, change, difference
    if significant:
        return tuple(_change_sentence(change, difference, stored)
                     for _, change, difference in significant.values()), True
    if not compared:
        return ('nothing to compare: no sigma is known',), None
    size, change, _ = max(compared, key=lambda entry: entry[0])
    return (f'no change beyond {REMARK_SIGMAS:.0f} sigma; largest: {label_of(change.parameter)}, '
            f'{size:.1f} sigma',), False


def _change_sentence(change: Change, difference: Difference, stored: list[Stored]) -> str:
    """Return the sentence on a significant change, with its likely cause."""
    words = change.parameter.split('_')
    cause = next((text for word, text in CAUSES.items() if word in words),
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


def shared_error_notes(changes: Sequence[Change], stored: Sequence[Stored]) -> Iterator[str]:
    """Yield notes on changes that are significant only if shared errors are the same in both."""
    for change in changes:
        last = change.entries[-1]
        for difference in (last.to_first, last.to_previous):
            if difference is None or difference.is_significant or not stored[last.index].usable:
                continue
            sigmas = abs(difference.sigmas_if_shared_cancels or 0.0)
            if sigmas > REMARK_SIGMAS:
                yield (f'note: the change of the {label_of(change.parameter)} is {sigmas:.1f} '
                       'sigma if errors of heading source and lever arms are the same in both')
                break
