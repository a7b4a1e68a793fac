# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tables of legs, error budget and tracks, for terminal, report and spreadsheet."""

from collections.abc import Collection, Sequence
import csv
import io
import math
import textwrap
from typing import Any, NamedTuple

from odocal_ros.calib import result
from odocal_ros.calib.budget import PARAMETERS
from odocal_ros.calib.choice import leg_estimates
from odocal_ros.calib.number_text import significant
from odocal_ros.output import value_text as texts
from odocal_ros.pipeline.combination import overlapping_legs
from odocal_ros.reasons import rejecting, Verdict, verdict_of
from odocal_ros.safe_io.text_formats import for_table
from odocal_ros.settings.config import Config

LEGS = 'legs.csv'
SCALE_UNITS = {'scale_factor': '', 'scale_ratio': '1'}      # '': that of the calibration
LABELS = {'legs': 'errors of single legs', 'gyro_by_force': 'gyro g-sensitivity',
          'slow_fix_errors': 'correlated fix errors', 'body_lean': 'body motion',
          'fix_latency': 'fix delay', 'gnss_delay': 'fix delay',
          'receiver_smoothing': 'fix smoothing', 'scale_ratio': 'ratio to nominal',
          'scale_factor_as_sent': 'scale factor of the raw speed'}
BUDGET_HEAD = ('error budget', 'scale, ppm', 'yaw, deg', 'pitch, deg')
BUDGET_WIDTHS = 24, 13, 15, 15      # judgement: with 'shared' within 80 columns
CHECKS = 'before', 'after'      # fields of LegResult: before and after the calibration
CHECK_LABEL_WIDTH, CHECK_CELL_WIDTH = 22, 9      # judgement: columns


def leg_table(calibration: result.Calibration, config: Config,
              content: dict[str, Any]) -> dict[str, str]:
    """Return file name -> text of the table of legs, empty without legs."""
    if not calibration.legs:
        return {}
    return {LEGS: csv_text([_leg_row(n, leg, calibration) for n, leg in enumerate(
        calibration.legs, 1)])}


def csv_text(rows: list[dict[str, Any]]) -> str:
    """Return rows with equal keys, one or more, as a table for a spreadsheet."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator='\n')
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _leg_row(number: int, leg: result.LegResult,
             calibration: result.Calibration) -> dict[str, Any]:
    """Return a row; missing values of a leg are empty cells."""
    used = {estimate.method for estimate in calibration.estimates.values()
            if estimate.value is not None}
    reasons = [*leg.reasons, *(reason for method in leg.methods.values()
                               if method.name in used or not used for reason in method.reasons)]
    row = {'leg': number, 'bag': for_table(leg.bag), 'start [UTC]': texts.iso(leg.start_ns),
           'start [ns]': leg.start_ns, 'stop [ns]': leg.stop_ns,
           'duration [s]': leg.duration, 'distance [m]': leg.distance,
           'imu_samples': leg.imu_samples, 'pulses': leg.pulses, 'fixes': leg.fixes,
           'rejected_fixes': leg.rejected_fixes, 'verdict': leg.verdict.value,
           'reasons': ' '.join(dict.fromkeys(r.code.name for r in reasons))}
    wheels = dict.fromkeys(result.wheel_factors(calibration.estimates), '') | {
        name: 'm' for name in calibration.estimates if name.startswith('track_width')}
    for name, unit in (SCALE_UNITS | wheels | dict.fromkeys(texts.ANGLES, 'rad')).items():
        if name in calibration.estimates:
            unit = unit or calibration.estimates[name].unit
            estimate = _estimate(leg, calibration, name)
            row |= {f'{name} [{unit}]': estimate.value, f'{name}_sigma [{unit}]': estimate.sigma}
    for name in CHECKS:
        check = getattr(leg, name)
        row |= {f'{name}_{part} [m]': None if check is None else getattr(check, part)
                for part in ('rms', 'mean', 'max', 'end')}
    return row


def _estimate(leg: result.LegResult, calibration: result.Calibration,
              name: str) -> result.Estimate:
    """Return a leg's value by the method that gives the calibration's value, else by any."""
    method = leg.methods.get(calibration.estimates[name].method)
    return texts.finite_estimate(leg_estimates(leg) if method is None else method.estimates, name)


def search_lines(legs: tuple[result.LegResult, ...]) -> list[str]:
    """Return a table of each leg's search of two wheels (method patent), empty without one."""
    lines = []
    for k, leg in enumerate(legs, 1):
        search = next((method.details['search'] for method in leg.methods.values()
                       if method.details.get('search')), None)
        if not search:
            continue
        best, after = search['best_row'], search['after']
        rows = ((f'best of {search["array"]["rows"]} ({search["array"]["name"]})', best, best),
                ('response surface', search['response_surface'], after),
                ('least squares', search['least_squares'], None))
        lines += ['search by positions alone (CN104359492A), without sigmas'
                  + (f', leg {k}' if len(legs) > 1 else ''),
                  f'  {"":24}  {"left":>10}  {"right":>10}  turn, deg  mean, m   max, m']
        for name, values, fit in rows:
            distances = '' if fit is None else f'  {fit["mean"]:7.3f}  {fit["max"]:7.3f}'
            left, right = values['scale_left'], values['scale_right']
            lines.append(f'  {name:24}  {left:10.6g}  {right:10.6g}'
                         f'  {values["heading_deg"]:+9.4f}{distances}')
        if search['left_and_right_held_together']:
            lines.append('  the fixes do not separate left and right: the nominal ratio is kept')
    return lines


def shown_verdict(method: result.MethodResult, legs: tuple[result.LegResult, ...]) -> str:
    """
    Return the verdict of a method's values, followed by '(leg)' if it is that of the leg.

    legs : those of the values, whose reasons apply to each method; rejected ones count only if all
    are rejected.
    """
    overlapping = overlapping_legs([leg for leg in legs
                                    if verdict_of(leg.reasons) is not Verdict.REJECTED])
    leg_verdicts = [verdict_of(leg.reasons) for leg in legs if leg not in overlapping]
    used = [verdict for verdict in leg_verdicts if verdict is not Verdict.REJECTED] or leg_verdicts
    worst = Verdict.worst([method.verdict, *used])
    if worst is method.verdict:
        return worst.value
    return f'{worst.value} (leg{"s" * (len(legs) > 1)})'


def method_lines(calibration: result.Calibration) -> list[str]:
    """Return the lines of a table of methods, none for a single one."""
    methods = calibration.methods
    if len(methods) < 2:
        return []
    rows: list[tuple[str, ...]] = [('method', 'scale factor', 'yaw, deg', 'pitch, deg', 'verdict')]
    for name, method in methods.items():
        scale, *angles = (texts.finite_estimate(method.estimates, parameter)
                          for parameter in ('scale_factor', *texts.ANGLES))
        code = ''.join(f': {reason.code.name}' for reason in rejecting(method.reasons)[:1])
        rows.append((name, cell(scale),
                     *(cell(angle, math.degrees(1.0), signed=True) for angle in angles),
                     shown_verdict(method, calibration.legs) + code))
    return texts.table_lines(rows)


def cell(estimate: result.Estimate, factor: float = 1.0, signed: bool = False) -> str:
    """Return an estimate times ``factor`` with its sigma; '-' if it is not determined."""
    return '-' if estimate.value is None else texts.with_sigma(
        estimate.value, estimate.sigma, factor, signed)


def leg_verdicts(legs: tuple[result.LegResult, ...]) -> list[str]:
    """Return the verdict of each leg; 'not used' if an earlier good leg covers its time."""
    overlapping = overlapping_legs([leg for leg in legs if leg.verdict is not Verdict.REJECTED])
    return ['not used' if leg in overlapping else leg.verdict.value for leg in legs]


def largest_source(method: result.MethodResult | None, name: str) -> tuple[str, float]:
    """Return the largest source of an estimate's error ('' if none), and its share of variance."""
    if method is None or name not in method.parameters:
        return '', 0.0
    row = method.parameters.index(name)
    variances = {source.name: float((source.effects[row]**2).sum()) for source in method.sources}
    largest, total = max(variances, key=variances.__getitem__, default=''), sum(variances.values())
    return (largest, variances[largest] / total) if total else ('', 0.0)


def source_label(name: str, local: bool = False) -> str:
    """Return an error source or estimate in words; local : positions in a local frame."""
    return result.name_antenna(LABELS.get(name, name.replace('_', ' ')), local)


class BudgetRow(NamedTuple):
    """An error source in a budget."""

    label: str
    shared: bool               # the same error in all legs
    effects: list[float]       # one sigma, for each parameter
    shares: list[float]        # of the variance of each parameter


def budget_rows(table: dict[str, dict[str, Any]], parameters: Sequence[str], min_share: float,
                local: bool) -> tuple[list[BudgetRow], list[str]]:
    """
    Return the rows of a budget, and the labels of sources below ``min_share`` of all variances.

    table : source to one-sigma effect on each parameter, as in calibration.json.
    local : positions in a local frame.
    """
    variances = [sum(row.get(name, 0.0)**2 for row in table.values()) for name in parameters]
    rows, small = [], []
    for source, entry in table.items():
        effects = [entry.get(name, 0.0) for name in parameters]
        shares = [effect**2 / variance if variance else 0.0
                  for effect, variance in zip(effects, variances, strict=True)]
        label = source_label(source, local)
        if max(shares, default=0.0) < min_share:
            small.append(label)
        else:
            rows.append(BudgetRow(label, bool(entry.get('shared')), effects, shares))
    return rows, small


def budget_lines(table: dict[str, dict[str, Any]] | None, scale: float, min_share: float,
                 hidden: Collection[str] = (), width: int = texts.WIDTH, name_small: bool = True,
                 local: bool = False) -> list[str]:
    """
    Return the lines of a budget, none without one.

    table, min_share, local : as of ``budget_rows``.   scale : scale factor, m per unit of the
    odometer.   hidden : parameters that are not determined: their column stays empty.   width :
    columns of the screen.   name_small : list the sources below ``min_share``.
    """
    if not table:
        return []
    shown = {source: {name: effect for name, effect in row.items() if name not in hidden}
             for source, row in table.items()}
    rows, small = budget_rows(shown, PARAMETERS, min_share, local)
    factors = (1e6 / scale, math.degrees(1.0), math.degrees(1.0))
    lines = [texts.table_row(BUDGET_HEAD, BUDGET_WIDTHS)]
    shared = '   shared by all legs' if width > 90 else '  shared'
    for row in rows:
        cells = ['-' if share < min_share else f'{significant(effect * factor)} {share:>4.0%}'
                 for effect, factor, share in zip(row.effects, factors, row.shares, strict=True)]
        lines.append(texts.table_row([row.label, *cells], BUDGET_WIDTHS) + shared * row.shared)
    if small and name_small:
        lines += textwrap.wrap(f'under {100 * min_share:g} %: {", ".join(small)}', width,
                               initial_indent='  ', subsequent_indent='    ')
    return lines


def pooled_check(checks: list[tuple[result.TrackCheck | None, int]]) -> result.TrackCheck | None:
    """
    Return one check for many legs from (check, number of fixes) of each; None without checks.

    rms and mean are those of all fixes; maximum, end and percentage those of the worst leg.
    """
    known_checks = [(check, n) for check, n in checks if check is not None and n]
    if not known_checks:
        return None
    total = sum(n for _, n in known_checks)
    return result.TrackCheck(
        rms=math.sqrt(sum(n * check.rms**2 for check, n in known_checks) / total),
        mean=sum(n * check.mean for check, n in known_checks) / total,
        **{name: max(getattr(check, name) for check, _ in known_checks)
           for name in ('max', 'end', 'percent_of_distance')})


def pooled_per_distance(legs: Sequence[result.LegResult]) -> list[result.PerDistance]:
    """Return the error per distance driven of all legs, pooled over sections."""
    all_errors = [error for leg in legs for error in leg.per_distance]
    pooled = []
    for distance in sorted({error.length for error in all_errors}):
        errors = [error for error in all_errors if error.length == distance]
        count = sum(error.pieces for error in errors)
        before, after = (
            math.sqrt(sum(error.pieces * getattr(error, name)**2 for error in errors) / count)
            for name in CHECKS)
        pooled.append(result.PerDistance(distance, before, after, count))
    return pooled


def before_label(legs: Sequence[result.LegResult]) -> str:
    """Return the label of the track before calibration, by whether a nominal scale is set."""
    has_nominal = any(method.estimates.get('scale_ratio', texts.UNKNOWN).value is not None
                      for leg in legs for method in leg.methods.values())
    return 'as configured' if has_nominal else 'uncalibrated'


def check_table(
        legs: tuple[result.LegResult, ...]) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Return heads and rows (label, cells) of the distances between track and fixes."""
    per_distance = pooled_per_distance(legs)
    rows = []
    for label, name in zip((before_label(legs), 'as calibrated'), CHECKS, strict=True):
        check = pooled_check([(getattr(leg, name), leg.fixes) for leg in legs])
        if check is not None:
            share = check.percent_of_distance
            rows.append((label, [
                *(texts.length_text(distance) for distance in (
                    *(getattr(error, name) for error in per_distance),
                    check.rms, check.max, check.mean, check.end)),
                f'{share:.{3 if share < 100 else 0}f} %']))
    heads = [f'in {error.length:g} m' if error.length < 1000 else f'in {error.length / 1000:g} km'
             for error in per_distance]
    return [*heads, 'rms', 'max', 'mean', 'at end', 'end/path'], rows


def track_lines(legs: tuple[result.LegResult, ...], width: int) -> list[str]:
    """Return the table of dead reckoning against the fixes, limited to the width."""
    heads, rows = check_table(legs)
    if not rows:
        return []
    column_count = (width - CHECK_LABEL_WIDTH) // CHECK_CELL_WIDTH
    widths = [CHECK_LABEL_WIDTH - 2, *[CHECK_CELL_WIDTH] * len(heads[:column_count])]
    return [texts.table_row([label, *cells[:column_count]], widths)
            for label, cells in (('track against fixes', heads), *rows)]
