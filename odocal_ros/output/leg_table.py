# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The legs as a table for a spreadsheet, their verdicts as shown, and their searches as lines."""

import csv
import io
from typing import Any

from odocal_ros.calib.choice import leg_estimates
from odocal_ros.calib.result import Calibration, Estimate, LegResult, MethodResult, wheel_factors
from odocal_ros.output.figures import iso, known
from odocal_ros.outside.names import for_table
from odocal_ros.pipeline.combination import driven_twice
from odocal_ros.reasons import Verdict, verdict_of
from odocal_ros.settings.config import Config

LEGS = 'legs.csv'
SHOWN = {'scale_factor': '', 'scale_ratio': '1'}
ANGLES = {'yaw_mounting_angle': 'rad', 'pitch_mounting_angle': 'rad'}


def leg_table(calibration: Calibration, config: Config, content: dict[str, Any]) -> dict[str, str]:
    """Return the file by name, nothing without legs."""
    if not calibration.legs:
        return {}
    rows = [_row(n, leg, calibration) for n, leg in enumerate(calibration.legs, 1)]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator='\n')
    writer.writeheader()
    writer.writerows(rows)
    return {LEGS: text.getvalue()}


def _row(number: int, leg: LegResult, calibration: Calibration) -> dict[str, Any]:
    """Return a row; what a leg does not know is an empty cell."""
    giving = {e.method for e in calibration.estimates.values() if e.value is not None}
    reasons = [*leg.reasons, *(r for m in leg.methods.values() for r in m.reasons
                               if m.name in giving or not giving)]
    row = {'leg': number, 'bag': for_table(leg.bag), 'start [UTC]': iso(leg.start_ns),
           'start [ns]': leg.start_ns, 'stop [ns]': leg.stop_ns,
           'duration [s]': leg.duration, 'distance [m]': leg.distance,
           'imu_samples': leg.imu_samples, 'pulses': leg.pulses, 'fixes': leg.fixes,
           'rejected_fixes': leg.rejected_fixes, 'verdict': leg.verdict.value,
           'reasons': ' '.join(dict.fromkeys(r.code.name for r in reasons))}
    wheels = dict.fromkeys(wheel_factors(calibration.estimates), '') | {
        name: 'm' for name in calibration.estimates if name.startswith('track_width')}
    for name, unit in (SHOWN | wheels | ANGLES).items():
        if name in calibration.estimates:
            unit = unit or calibration.estimates[name].unit
            found = _estimate(leg, calibration, name)
            row |= {f'{name} [{unit}]': found.value, f'{name}_sigma [{unit}]': found.sigma}
    for name in ('before', 'after'):
        check = getattr(leg, name)
        row |= {f'{name}_{part} [m]': None if check is None else getattr(check, part)
                for part in ('rms', 'mean', 'max', 'end')}
    return row


def _estimate(leg: LegResult, calibration: Calibration, name: str) -> Estimate:
    """Return a leg's value by the method whose value the calibration gives, else by its own."""
    method = leg.methods.get(calibration.estimates[name].method)
    return known(leg_estimates(leg) if method is None else method.estimates, name)


def search_lines(legs: tuple[LegResult, ...]) -> list[str]:
    """Return a table of each leg's search, empty where there was none."""
    lines = []
    for k, leg in enumerate(legs, 1):
        found = next((m.details['search'] for m in leg.methods.values()
                      if m.details.get('search')), None)
        if not found:
            continue
        best, after = found['best_row'], found['after']
        rows = ((f'best of {found["array"]["rows"]} ({found["array"]["name"]})', best, best),
                ('response surface', found['response_surface'], after),
                ('least squares', found['least_squares'], None))
        lines += ['search by positions alone (CN104359492A), without sigmas'
                  + (f', leg {k}' if len(legs) > 1 else ''),
                  f'  {"":24}  {"left":>10}  {"right":>10}  turn, deg  mean, m   max, m']
        for name, values, fit in rows:
            how = '' if fit is None else f'  {fit["mean"]:7.3f}  {fit["max"]:7.3f}'
            lines.append(f'  {name:24}  {values["scale_left"]:10.6g}  '
                         f'{values["scale_right"]:10.6g}  {values["heading_deg"]:+9.4f}{how}')
        if found['left_and_right_held_together']:
            lines.append('  the fixes do not separate left and right: their ratio is kept')
    return lines


def shown_verdict(method: MethodResult, legs: tuple[LegResult, ...]) -> str:
    """
    Return the verdict of a method's figures, '(leg)' behind it where it is that of the leg.

    What is wrong with a leg's data is no method's reason, but touches each of them: a method that
    found nothing to say of a dead wheel is no way round it.

    legs : those the figures rest on; of several that are good in part, the good ones count.
    """
    twice = driven_twice([leg for leg in legs if verdict_of(leg.reasons) is not Verdict.REJECTED])
    of_data = [verdict_of(leg.reasons) for leg in legs if leg not in twice]
    used = [v for v in of_data if v is not Verdict.REJECTED] or of_data
    worst = Verdict.worst([method.verdict, *used])
    if worst is method.verdict:
        return worst.value
    return f'{worst.value} (leg{"s" * (len(legs) > 1)})'


def leg_verdicts(legs: tuple[LegResult, ...]) -> list[str]:
    """Return the verdict of each leg, 'not used' where it is good and an earlier one is used."""
    twice = driven_twice([leg for leg in legs if leg.verdict is not Verdict.REJECTED])
    return ['not used' if leg in twice else leg.verdict.value for leg in legs]
