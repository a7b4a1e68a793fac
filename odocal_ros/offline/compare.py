"""odocal compare: tell whether the vehicle has changed since earlier calibrations."""

import json
from pathlib import Path
import sys

from odocal_ros.calib.causes import ANOTHER, change_in_words, OTHER, TYRES
from odocal_ros.offline.say import say

CAUSES = {
    'scale': f'{TYRES}; calibrate again to be sure, then use the newer value',
    'track': 'another rim or tyre; calibrate again to be sure',
    'yaw': 'the IMU was moved, or the heading comes from another source; calibrate again to be '
           'sure',
    'pitch': 'load, suspension, or the IMU was moved; calibrate again to be sure',
    'lever': 'a mount was moved, or its measure is wrong',
    'delay': 'a driver, bus or receiver was set differently'}


def add_arguments(parser) -> None:
    """Declare the options."""
    parser.description = (
        'Show each value with its change since the first calibration and since the one before, '
        'in its unit and in sigmas. A change counts beyond 3 sigma. Exit code 0: no change that '
        'counts; 1: changed, or nothing to judge; 2: wrong use or an unreadable file.')
    parser.add_argument('files', nargs='+', metavar='CALIBRATION',
                        help='calibration.json or its folder, the oldest first; two or more')
    parser.add_argument('--json', action='store_true', help='print the changes as JSON')


def run(args) -> int:
    """Compare calibrations; return 0 unchanged, 1 changed or nothing to judge."""
    from odocal_ros.errors import BadUsage
    from odocal_ros.offline.changes import changes, notes
    from odocal_ros.offline.cli import OK, REJECTED
    from odocal_ros.output.stored import read_stored
    if len(args.files) < 2:
        raise BadUsage('compare: one calibration has nothing to be compared with; give two or '
                       'more, the oldest first')
    stored = [read_stored(Path(name)) for name in args.files]
    found = changes(stored)
    said = notes(stored)
    text, changed = verdict(found, stored)
    if args.json:
        json.dump(as_json(stored, found, said, text, changed), sys.stdout, indent=2,
                  allow_nan=False)
        say('')
    else:
        say('\n'.join(_screen(stored, found, said, text)))
    return OK if changed is False else REJECTED


def verdict(found, stored) -> tuple[str, bool | None]:
    """Return one sentence on all changes, and whether any counts; None: nothing to judge."""
    if not found:
        return ('nothing to judge: no value is in two calibrations that are not rejected', None)
    from odocal_ros.offline.changes import Change, CHANGED, Difference
    judged = [(abs(d.sigmas), c, d) for c in found for e in c.entries if stored[e.index].usable
              for d in (e.to_first, e.to_previous) if d is not None and d.sigmas is not None]
    beyond: dict[str, tuple[float, Change, Difference]] = {}
    for size, change, difference in judged:
        if difference.beyond and size > beyond.get(change.parameter, (0.0,))[0]:
            beyond[change.parameter] = size, change, difference
    if beyond:
        return '; '.join(_cause(c, d, stored) for _, c, d in beyond.values()), True
    if not judged:
        return 'nothing to judge: no sigma is known', None
    size, change, _ = max(judged, key=lambda one: one[0])
    return (f'no change beyond {CHANGED:.0f} sigma: the largest is that of the '
            f'{_label(change.parameter)}, {size:.1f} sigma'), False


def _cause(change, difference, stored):
    words = change.parameter.split('_')
    cause = next((text for key, text in CAUSES.items() if key in words), 'calibrate again')
    if 'scale' in words and abs(
            difference.change) > ANOTHER * stored[difference.since].value(change.parameter):
        cause = f'{OTHER}; compare calibrations of one odometer'
    return (f'{_label(change.parameter)} changed by {_amount(change, difference, stored)} '
            f'({abs(difference.sigmas):.1f} sigma) since {stored[difference.since].name}: {cause}')


def _label(parameter):
    return parameter.replace('_', ' ').replace(' angle', '')


def _amount(change, difference, stored):
    """Return a change as people read it: scales in per cent or ppm, angles in deg."""
    old = stored[difference.since].estimates[change.parameter].value
    if change.parameter.startswith('scale_'):
        return change_in_words(difference.change / old)
    if change.unit == 'rad':
        return f'{57.29577951308232 * difference.change:+.3g} deg'
    return f'{difference.change:+.3g} {change.unit}'


def _screen(stored, found, said, text) -> list[str]:
    from odocal_ros.output.worse import said as value_text
    width = max(len(s.name) for s in stored)
    lines = [f'{i:>3}  {s.name:<{width}}  {s.created}  {s.verdict.value}, {len(s.legs)} leg'
             f'{"s" * (len(s.legs) != 1)}' for i, s in enumerate(stored, 1)]
    for change in found:
        rows = [(str(e.index + 1), value_text(e.estimate), _cell(change, e.to_first, stored),
                 _cell(change, e.to_previous, stored)) for e in change.entries]
        rows.insert(0, ('', 'value', 'since the first', 'since the one before'))
        widths = [max(len(row[i]) for row in rows) for i in range(4)]
        lines += ['', _label(change.parameter)] + [
            f'{row[0]:>3}  ' + '  '.join(f'{cell:<{w}}' for cell, w in zip(
                row[1:], widths[1:], strict=True)).rstrip() for row in rows]
    return [*lines, '', *(f'note: {note}' for note in said), text, *_hint(found, stored)]


def _cell(change, difference, stored) -> str:
    if difference is None:
        return '-'
    sigmas = '' if difference.sigmas is None else f' ({difference.sigmas:+.1f} sigma)'
    return _amount(change, difference, stored) + sigmas


def _hint(found, stored):
    """Return what would count if the errors that the legs share were the same each time."""
    from odocal_ros.offline.changes import CHANGED
    for change in found:
        last = change.entries[-1]
        for d in (last.to_first, last.to_previous):
            if d is not None and stored[last.index].usable and not d.beyond \
                    and abs(d.sigmas_if_shared_cancels or 0.0) > CHANGED:
                yield (f'note: the change of the {_label(change.parameter)} would be '
                       f'{abs(d.sigmas_if_shared_cancels):.1f} sigma if the errors of heading '
                       'source, lever arm and the like were the same in both')
                break


def as_json(stored, found, said, text, changed) -> dict:
    """Return the comparison as plain dicts and lists."""
    def difference(d):
        return None if d is None else {
            'since': stored[d.since].name, 'change': d.change, 'sigma': d.sigma,
            'sigmas': d.sigmas, 'sigmas_if_shared_cancels': d.sigmas_if_shared_cancels}
    return {
        'schema': 1, 'changed': changed, 'sentence': text, 'notes': said,
        'calibrations': [{'file': s.name, 'created': s.created, 'verdict': s.verdict.value,
                          'legs': len(s.legs)} for s in stored],
        'changes': [{'parameter': c.parameter, 'unit': c.unit, 'values': [
            {'file': stored[e.index].name, 'value': e.estimate.value, 'sigma': e.estimate.sigma,
             'to_first': difference(e.to_first), 'to_previous': difference(e.to_previous)}
            for e in c.entries]} for c in found]}
