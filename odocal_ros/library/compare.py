# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibrations of one vehicle beside one another, to see whether it has changed."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math
from pathlib import Path
from typing import Any

from odocal_ros.calib.causes import ANOTHER_SCALE, change_in_words, OTHER, TYRES
from odocal_ros.errors import BadUsage
from odocal_ros.library.calibration import Calibration
from odocal_ros.library.changes import Change, changes, Difference, notes
from odocal_ros.output.stored import read_stored, Stored, stored_from
from odocal_ros.settings.levels import REMARK_SIGMAS

CAUSES = {
    'scale': f'{TYRES}; calibrate again to be sure, then use the newer value',
    'track': 'another rim or tyre; calibrate again to be sure',
    'yaw': 'the IMU was moved, or the heading comes from another source; calibrate again to be '
           'sure',
    'pitch': 'load, suspension, or the IMU was moved; calibrate again to be sure',
    'lever': 'a sensor was moved, or its lever arm is wrong',
    'delay': 'a driver, bus or receiver has other settings'}


@dataclass(frozen=True, eq=False)
class Comparison:
    """
    How values changed over calibrations, the oldest first.

    stored : what was compared.   changes : of each parameter.   notes : what to know of them.
    sentence : on all of it.   changed : whether any change counts; None: nothing to judge.
    """

    stored: tuple[Stored, ...]
    changes: tuple[Change, ...]
    notes: tuple[str, ...]
    sentence: str
    changed: bool | None

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as plain dicts and lists."""
        names = [s.name for s in self.stored]

        def difference(d: Difference | None) -> dict[str, Any] | None:
            return None if d is None else {
                'since': names[d.since], 'change': d.change, 'sigma': d.sigma,
                'sigmas': d.sigmas, 'sigmas_if_shared_cancels': d.sigmas_if_shared_cancels}
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

    Raises
    ------
    BadUsage
        There are fewer than two, a file cannot be read, or they are of different odometers.

    """
    if len(calibrations) < 2:
        raise BadUsage('compare: only one calibration; give two or more, the oldest first')
    stored = [stored_from(one.to_dict(), f'calibration {number}')
              if isinstance(one, Calibration) else read_stored(Path(one))
              for number, one in enumerate(calibrations, 1)]
    found = changes(stored)
    return Comparison(tuple(stored), tuple(found), tuple(notes(stored)), *_verdict(found, stored))


def _verdict(found: list[Change], stored: list[Stored]) -> tuple[str, bool | None]:
    """Return one sentence on all changes, and whether any counts; None: nothing to judge."""
    if not found:
        return ('nothing to compare: no value exists in two calibrations that are not '
                'rejected', None)
    judged = [(abs(d.sigmas), c, d) for c in found for e in c.entries if stored[e.index].usable
              for d in (e.to_first, e.to_previous) if d is not None and d.sigmas is not None]
    beyond: dict[str, tuple[float, Change, Difference]] = {}
    for size, change, difference in judged:
        if difference.beyond and size > beyond.get(change.parameter, (0.0,))[0]:
            beyond[change.parameter] = size, change, difference
    if beyond:
        return '; '.join(_cause(c, d, stored) for _, c, d in beyond.values()), True
    if not judged:
        return 'nothing to compare: no sigma is known', None
    size, change, _ = max(judged, key=lambda one: one[0])
    return (f'no change beyond {REMARK_SIGMAS:.0f} sigma; largest: {label(change.parameter)}, '
            f'{size:.1f} sigma'), False


def _cause(change: Change, difference: Difference, stored: list[Stored]) -> str:
    words = change.parameter.split('_')
    cause = next((text for key, text in CAUSES.items() if key in words), 'calibrate again')
    if 'scale' in words and abs(difference.change) > ANOTHER_SCALE * _value_before(
            change, difference, stored):
        cause = f'{OTHER}; compare calibrations of the same odometer'
    return (f'{label(change.parameter)} changed by {amount(change, difference, stored)} '
            f'({abs(difference.sigmas or 0.0):.1f} sigma) since '
            f'{stored[difference.since].name}: {cause}')


def _value_before(change: Change, difference: Difference, stored: Sequence[Stored]) -> float:
    value = stored[difference.since].value(change.parameter)
    assert value is not None      # what has none is no entry
    return value


def label(parameter: str) -> str:
    """Return a parameter as people call it."""
    return parameter.replace('_', ' ').replace(' angle', '')


def amount(change: Change, difference: Difference, stored: Sequence[Stored]) -> str:
    """Return a change as people read it: scales in per cent or ppm, angles in deg."""
    if change.parameter.startswith('scale_'):
        return change_in_words(difference.change / _value_before(change, difference, stored))
    if change.unit == 'rad':
        return f'{math.degrees(1.0) * difference.change:+.3g} deg'
    return f'{difference.change:+.3g} {change.unit}'


def hints(found: Sequence[Change], stored: Sequence[Stored]) -> Iterator[str]:
    """Yield what would count if the errors that the legs share were the same each time."""
    for change in found:
        last = change.entries[-1]
        for d in (last.to_first, last.to_previous):
            sigmas = abs(d.sigmas_if_shared_cancels or 0.0) if d is not None else 0.0
            if d is not None and stored[last.index].usable and not d.beyond \
                    and sigmas > REMARK_SIGMAS:
                yield (f'note: the change of the {label(change.parameter)} is {sigmas:.1f} sigma '
                       'if errors of heading source and lever arms are the same in both')
                break
