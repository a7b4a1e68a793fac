# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The tables of the report as rows of text: values, methods, budget, unused data, origin."""

from collections import Counter
from contextlib import suppress
import math
from typing import Any

import numpy as np

from odocal_ros.calib import result
from odocal_ros.calib.number_text import significant
from odocal_ros.output import tables, value_text as texts
from odocal_ros.output.summary import DEG, DEG_PER_HOUR
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config, flat, SETTINGS

UNDETERMINED = 'not determined'
# reasons about the data of a leg
DATA_CODES = {Code.BAD_ROWS_DROPPED, Code.STAMPS_NOT_RISING, Code.IMU_GAP, Code.TOPIC_GAP,
              Code.COUNTER_RESET, Code.COUNTER_ROLLOVER, Code.FIXES_UNUSABLE, Code.BAG_TRUNCATED,
              Code.COVARIANCE_UNKNOWN, Code.WHEEL_SLIP, Code.NO_IMU, Code.NO_ODOMETER, Code.NO_FIX,
              Code.WHEEL_COUNTERS_DIFFER, Code.ODOMETER_CHOSEN, Code.DELAY_SEEN,
              Code.REVERSING_UNSIGNED}


def label(name: str, local: bool = False) -> str:
    """Return an estimate, method or error source in words; local : positions in a local frame."""
    if name in result.wheel_factors([name]):
        return f'scale factor, {name.removeprefix(result.WHEEL_PREFIX)} wheel'
    return tables.source_label(name, local)


def estimate_texts(name: str, estimate: result.Estimate) -> tuple[str, str, str]:
    """Return an estimate as text: in its main unit, in another one, and its relative sigma."""
    value, sigma, unit = estimate.value, estimate.sigma, estimate.unit
    if value is None:
        return UNDETERMINED, '', ''
    in_si = texts.with_sigma(value, sigma) + f' {unit}' * (unit not in ('', '1'))
    usual_units = {'rad': (DEG, 'deg'), 'rad/s': (DEG_PER_HOUR, 'deg/h'), 's': (1e3, 'ms')}
    if unit in usual_units:
        factor, usual_unit = usual_units[unit]
        return f'{texts.with_sigma(value, sigma, factor, signed=True)} {usual_unit}', in_si, ''
    if name.startswith('scale'):
        relative = texts.relative_text(sigma / abs(value)) if sigma and value else ''
        other = (texts.inverse_text(estimate) if unit in texts.COUNTS
                 else texts.deviation_text(value, sigma))
        return in_si, other, relative
    return in_si, '', ''


def value_rows(calibration: result.Calibration) -> list[dict[str, Any]]:
    """Return the rows of the result: name, value in both units, relative sigma, method, cause."""
    rows, local = [], result.has_local_fixes(calibration.legs)
    for name in calibration.estimates:
        estimate = texts.finite_estimate(calibration.estimates, name)
        if estimate.value is None:
            continue
        first, other, relative = estimate_texts(name, estimate)
        largest, share = tables.largest_source(calibration.methods.get(estimate.method), name)
        cause = f'{label(largest, local)} ({100 * share:.0f} %)' if largest else ''
        rows.append({'name': label(name, local), 'value': first, 'other': other,
                     'relative': relative, 'method': label(estimate.method), 'largest': cause})
    return rows


def headline(calibration: result.Calibration) -> list[tuple[str, str, str]]:
    """Return the most important values, up to four: name, value, a second line."""
    lines = []
    for name in texts.MAIN_VALUES:
        first, other, relative = estimate_texts(
            name, texts.finite_estimate(calibration.estimates, name))
        lines.append((name.removesuffix('_angle').replace('_', ' '), first,
                      f'± {relative}' if relative else other))
    for longest in tables.pooled_per_distance(calibration.legs)[-1:]:
        lines.append((f'track error in {texts.length_text(longest.length)}',
                      texts.length_text(longest.after),
                      f'{tables.before_label(calibration.legs)}: '
                      f'{texts.length_text(longest.before)}'))
    return lines


def undetermined(calibration: result.Calibration) -> list[str]:
    """Return the values that were not determined, axes of one quantity together."""
    axes: dict[str, list[str]] = {}      # by quantity
    for name in calibration.estimates:
        # the ratio requires a nominal scale, not another drive
        value = texts.finite_estimate(calibration.estimates, name).value
        if value is None and name != 'scale_ratio':
            has_axis = name[-2:] in ('_x', '_y', '_z')
            axes.setdefault(name[:-2] if has_axis else name, []).extend(name[-1] * has_axis)
    local = result.has_local_fixes(calibration.legs)
    return [f'{label(quantity, local)} {", ".join(names)}'.rstrip()
            for quantity, names in axes.items()]


def method_table(methods: dict[str, result.MethodResult],
                 legs: tuple[result.LegResult, ...]) -> dict[str, Any] | None:
    """Return a table of the methods of legs: heads, verdicts, rows (name, cells), reasons."""
    if not methods:
        return None
    names = dict.fromkeys(
        name for method in methods.values() for name in method.estimates if name != 'scale_ratio'
        or texts.finite_estimate(method.estimates, name).value is not None)
    rows = []
    for name in names:
        cells = []
        for method in methods.values():
            first, other, _ = estimate_texts(name, texts.finite_estimate(method.estimates, name))
            cells.append(('-', '') if name not in method.estimates else (first, other))
        rows.append((label(name, result.has_local_fixes(legs)), cells))
    return {'heads': [label(name) for name in methods], 'rows': rows,
            'verdicts': [tables.shown_verdict(method, legs) for method in methods.values()],
            'reasons': [(label(name), reason) for name, method in methods.items()
                        for reason in method.reasons]}


def budget_table(method: result.MethodResult, local: bool) -> dict[str, Any] | None:
    """
    Return a method's error budget: heads, rows (source, shared by all legs, cells), small sources.

    A cell is (sigma as text, share of the variance) or None below half a per cent.
    local : positions in a local frame.
    """
    table: dict[str, dict[str, Any]] = method.details.get('budget') or {}
    estimates = {name: texts.finite_estimate(method.estimates, name)
                 for row in table.values() for name in row if name != 'shared'}
    names = [name for name, estimate in estimates.items() if estimate.value is not None]
    columns = [_column(name, estimates[name]) for name in names]
    min_share = 0.005    # of a variance
    rows, small = tables.budget_rows(table, names, min_share, local)
    if not rows:
        return None
    return {'heads': [head for head, _ in columns], 'small': small, 'totals': [
        significant(math.sqrt(sum(row.get(name, 0.0)**2 for row in table.values())) * factor)
        for name, (_, factor) in zip(names, columns, strict=True)], 'rows': [
        (row.label, row.shared, [
            None if share < min_share else (significant(effect * factor), share)
            for effect, (_, factor), share in zip(row.effects, columns, row.shares, strict=True)])
        for row in rows]}


def _column(name: str, estimate: result.Estimate) -> tuple[str, float]:
    """Return the head of a budget's column, and the factor of its numbers."""
    if name.startswith('scale'):
        return f'{label(name)}, ppm', 1e6 / abs(estimate.value or 1.0)
    if estimate.unit == 'rad':
        return f'{label(name)}, deg', DEG
    smaller_units = {'m': (1e3, 'mm'), 's': (1e3, 'ms')}
    factor, unit = smaller_units.get(estimate.unit, (1.0, estimate.unit))
    return f'{label(name)}, {unit}', factor


def unused_data(leg: result.LegResult) -> tuple[list[tuple[str, str]], list[Reason]]:
    """Return the unused fixes, counted by reason, and the findings about the leg's data."""
    rows, evidence = [], leg.evidence
    if evidence is not None:
        for cause, listed in Counter(evidence.excluded_because).most_common():
            t = evidence.t_excluded[np.array(evidence.excluded_because) == cause]
            # the list is thinned
            count = round(listed * evidence.excluded / len(evidence.excluded_because))
            rows.append((f'{count} of {evidence.fixes + evidence.excluded} fixes',
                         f'{cause}; first at t = {min(t):.1f} s, last at t = {max(t):.1f} s'))
    elif leg.rejected_fixes:
        rows.append((f'{leg.rejected_fixes} fixes', 'see the reasons'))
    return rows, [reason for reason in leg.reasons if reason.code in DATA_CODES]


def changed_settings(config: Config) -> list[tuple[str, str, str]]:
    """Return the settings that are not at their default: name, value, default."""
    return [(name, value_text, default_text) for name, value in flat(config).items()
            if (value_text := _shown(value)) != (default_text := _shown(SETTINGS[name].default))]


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return f'[{", ".join(map(_shown, value))}]'
    if isinstance(value, bool):
        return str(value).lower()
    return repr(value) if isinstance(value, float) else str(value) or "''"


def full_digits(content: dict[str, Any]) -> list[tuple[str, str, str, str, str]]:
    """Return the numbers of the result in calibration.json: name, value, sigma, unit, method."""
    rows = []
    for name, entry in content['result'].items():
        if name in result.NOT_ESTIMATES:
            rows += [(f'{name} {key}'.replace('_', ' '), UNDETERMINED if numbers is None else
                      ', '.join(map(repr, np.atleast_1d(numbers).tolist())), '', '', '')
                     for key, numbers in entry.items() if key != 'unit']
        else:
            rows.append((name, *(UNDETERMINED if entry[key] is None else repr(entry[key])
                                 for key in ('value', 'sigma')),
                         entry['unit'] or '', entry['method'] or ''))
    return rows


def versions(software: str) -> list[tuple[str, str]]:
    """Return (name, version) of odocal_ros, Python and the installed packages it uses."""
    from importlib.metadata import PackageNotFoundError, version
    import platform
    installed = [('odocal_ros', software.rpartition(' ')[2]),
                 ('Python', platform.python_version())]
    for name in ('numpy', 'scipy', 'pyproj', 'rosbags', 'matplotlib', 'jinja2'):
        with suppress(PackageNotFoundError):
            installed.append((name, version(name)))
    return installed
