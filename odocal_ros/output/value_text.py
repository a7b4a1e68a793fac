# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Numbers, reasons and decisions as text, by the same rules in terminal, report and answers."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, UTC
import json
import math
import re
import textwrap

from odocal_ros.calib.number_text import relative_unit, significant
from odocal_ros.calib.result import Calibration, Estimate, LegResult
from odocal_ros.pipeline.acceptance import Acceptance, ValueDecision
from odocal_ros.reasons import Reason, Verdict
from odocal_ros.settings.config import Config

WIDTH = 98    # judgement: columns
UNKNOWN = Estimate(None, None, '')
# short names of the main values, in the order of ``calib.budget.PARAMETERS``
ANGLES = {'yaw_mounting_angle': 'yaw', 'pitch_mounting_angle': 'pitch'}
MAIN_VALUES = {'scale_factor': 'scale', **ANGLES}
COUNTS = {'m/pulse': 'pulses/m', 'm/rad': 'rad/m'}
# definition: spaces that no line break replaces: before a unit, after ±, and in 't = 5'
BEFORE_UNIT = re.compile(r'(?<=\d) (?=%|(?:deg|ppm|Hz|[ckm]?m|m?s|m/s)(?!\w))|(?<=±) '
                         r'|(?<=\bt) (?== )|(?<=\bt =) ')
LEG_PREFIX = re.compile(r'leg (\d+): (.*)', re.DOTALL)


def with_sigma(value: float | None, sigma: float | None, factor: float = 1.0,
               signed: bool = False) -> str:
    """Return value ± sigma times ``factor``, with two digits of sigma: '-32000 ± 15000'."""
    if value is None or not math.isfinite(value):
        return 'unknown'
    value *= factor
    if sigma is None or not math.isfinite(sigma):
        return f'{value:+.6g}' if signed else f'{value:.6g}'
    sigma *= factor
    places = 1 - math.floor(math.log10(sigma)) if 0 < sigma < math.inf else 6
    if sigma >= 100:      # negative places: round digits before the point
        value, sigma = round(value, places), round(sigma, places)
    places = max(0, min(12, places))
    return f'{value:{"+" if signed else ""}z.{places}f} ± {sigma:.{places}f}'


def deviation_text(ratio: float, sigma: float | None) -> str:
    """Return a ratio minus 1 as text, in ppm or per cent."""
    factor, unit = relative_unit(ratio - 1, sigma or 0.0)
    return f'{with_sigma(ratio - 1, sigma, factor, signed=True)} {unit}'


def relative_text(relative: float) -> str:
    """Return a relative sigma as text: two digits, in ppm or per cent."""
    factor, unit = relative_unit(relative)
    return f'{significant(factor * relative)} {unit}'


def length_text(metres: float) -> str:
    """Return a length with a sensible unit and number of digits."""
    if not math.isfinite(metres):
        return 'unknown'
    if abs(metres) >= 1e4:
        return f'{metres / 1000:.2f} km'
    if abs(metres) >= 100:
        return f'{metres:.0f} m'
    if abs(metres) >= 0.1:
        return f'{metres:.2f} m'
    return f'{metres * 1000:.3g} mm' if metres else '0 m'


def duration_text(seconds: float) -> str:
    """Return a duration with a sensible unit."""
    if seconds < 120:
        return f'{seconds:.1f} s'
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f'{hours} h {minutes:02d} min' if hours else f'{minutes} min {rest:02d} s'


def iso(stamp_ns: int) -> str:
    """Return a time as ISO 8601, UTC, whole seconds."""
    return f'{datetime.fromtimestamp(stamp_ns // 10**9, UTC):%Y-%m-%dT%H:%M:%SZ}'


def counted(number: int, noun: str) -> str:
    """Return a number of things, '1 leg' or '3 legs'."""
    return f'{number} {noun}{"s" * (number != 1)}'


def wrapped(text: str, indent: str = '  ', hanging: str = '  ', width: int = WIDTH) -> list[str]:
    """Return a text as lines, all but the first with ``hanging``; units stay at their numbers."""
    lines = textwrap.wrap(BEFORE_UNIT.sub('\xa0', text), width, initial_indent=indent,
                          subsequent_indent=indent + hanging, break_long_words=False,
                          break_on_hyphens=False)
    return [line.replace('\xa0', ' ') for line in lines]


def finite_estimate(estimates: dict[str, Estimate], name: str) -> Estimate:
    """Return an estimate by name, with None for missing or non-finite numbers."""
    estimate = estimates.get(name, UNKNOWN)
    value, sigma = (x if x is not None and math.isfinite(x) else None
                    for x in (estimate.value, estimate.sigma))
    return replace(estimate, value=value, sigma=sigma)


def angle_text(angle: Estimate) -> str:
    """Return an angle, rad, as 'value ± sigma deg', or 'not determined'."""
    return 'not determined' if angle.value is None else (
        f'{with_sigma(angle.value, angle.sigma, math.degrees(1.0), signed=True)} deg')


def with_unit(estimate: Estimate) -> str:
    """Return 'value ± sigma unit'."""
    unit = '' if estimate.unit == '1' else f' {estimate.unit}'
    return with_sigma(estimate.value, estimate.sigma) + unit


def inverse_text(scale: Estimate) -> str:
    """Return the inverse scale: pulses (or rad) per metre with sigma."""
    if not scale.value:
        return ''
    sigma = None if scale.sigma is None else scale.sigma / scale.value**2
    return f'{with_sigma(1 / scale.value, sigma)} {COUNTS[scale.unit]}'


def table_lines(rows: Sequence[Sequence[str]], indent: str = '  ') -> list[str]:
    """Return a table with columns as wide as their widest cell, left-aligned."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [indent + '  '.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)
                               ).rstrip() for row in rows]


def table_row(cells: Sequence[str], widths: Sequence[int]) -> str:
    """Return a line of a table of fixed widths: name left-aligned, numbers right-aligned."""
    numbers = ''.join(map(str.rjust, cells[1:], widths[1:]))
    return f'  {cells[0]:<{widths[0]}}{numbers}'


def join_same_reasons(reasons: tuple[Reason, ...]) -> tuple[Reason, ...]:
    """Return reasons; those of several legs that differ only in the leg are joined."""
    # (reason without the leg in its text, True if it is of a leg) -> numbers of its legs
    legs_by_reason: dict[tuple[Reason, bool], list[int]] = {}
    for reason in reasons:
        if match := LEG_PREFIX.fullmatch(reason.text):
            legs_by_reason.setdefault((replace(reason, text=match[2]), True), []).append(
                int(match[1]))
        else:
            legs_by_reason[reason, False] = []
    by_code: dict[object, list[tuple[Reason, list[int]]]] = {}
    for (reason, _), legs in legs_by_reason.items():
        by_code.setdefault(reason.code if legs else reason, []).append((reason, legs))
    return tuple(reason for group in by_code.values() for reason in _name_legs(group))


def _name_legs(group: list[tuple[Reason, list[int]]]) -> list[Reason]:
    """Return reasons of one code, (reason, leg numbers), with the legs in their texts."""
    first_reason, first_legs = group[0]
    if not first_legs:
        return [first_reason]
    max_texts = 2    # different texts of a code; if there are more, the first one is shown
    if len(group) <= max_texts:
        return [replace(reason, text=f'{_legs_text(legs)}: {reason.text}')
                for reason, legs in group]
    all_legs = sorted({number for _, legs in group for number in legs})
    return [replace(first_reason, text=f'{_legs_text(all_legs)}; of leg {first_legs[0]}: '
                                       f'{first_reason.text}')]


def _legs_text(numbers: Sequence[int]) -> str:
    """Return increasing leg numbers as text, such as 'legs 1 to 3 and 5'."""
    ranges: list[list[int]] = []
    for number in numbers:
        if ranges and number == ranges[-1][-1] + 1:
            ranges[-1].append(number)
        else:
            ranges.append([number])
    words = [word for group in ranges for word in (
        map(str, group) if len(group) < 3 else [f'{group[0]} to {group[-1]}'])]
    before_last = f'{", ".join(words[:-1])} and ' * (len(words) > 1)
    return f'leg{"s" * (len(numbers) > 1)} {before_last}{words[-1]}'


def lines_of_bags(legs: tuple[LegResult, ...], width: int) -> list[str]:
    """Return the text that lists the legs of each bag, empty for a single bag."""
    legs_by_bag: dict[str, list[int]] = {}
    for number, leg in enumerate(legs, 1):
        legs_by_bag.setdefault(leg.bag, []).append(number)
    if len(legs_by_bag) < 2:
        return []
    listed = '; '.join(f'{_legs_text(numbers)}: {bag}' for bag, numbers in legs_by_bag.items())
    return wrapped(listed, '  ', '   ', width)


def reason_groups(reasons: tuple[Reason, ...]) -> list[tuple[Verdict, str, list[Reason]]]:
    """Return reasons by severity, the most severe first: (verdict, title, reasons)."""
    joined = join_same_reasons(reasons)
    return [(verdict, title, group) for verdict, title in (
        (Verdict.REJECTED, 'rejected because'), (Verdict.CAUTION, 'warnings'),
        (Verdict.ACCEPTED, 'notes'))
        if (group := [reason for reason in joined if reason.code.severity is verdict])]


def reason_lines(reasons: tuple[Reason, ...], width: int, brief: bool) -> list[str]:
    """Return reasons with their remedies for a terminal; brief: only the codes of notes."""
    lines = []
    for verdict, title, group in reason_groups(reasons):
        if brief and verdict is Verdict.ACCEPTED:
            codes = ', '.join(dict.fromkeys(reason.code.name for reason in group))
            lines += wrapped(f'notes, see the report: {codes}', '  ', '   ', width)
            continue
        lines.append(f'  {title}')
        for reason in group:
            lines += wrapped(str(reason), '    ', '   ', width)
            lines += wrapped(f'-> {reason.remedy}', '      ', '   ', width)
    if any(re.search(r'\bt = ', line) for line in lines):
        lines.append('  t: seconds from the start of the leg')
    return lines


def accept_line(calibration: Calibration, acceptance: Acceptance, config: Config) -> str:
    """Return the decision on a vehicle as one line of JSON."""
    return json.dumps({'vehicle': config.vehicle, **acceptance.as_dict(),
                       'verdict': calibration.verdict.value,
                       'reasons': list(dict.fromkeys(r.code.name for r in calibration.reasons))},
                      allow_nan=False)


def accept_words(acceptance: Acceptance) -> list[str]:
    """Return the decision, a line on each value, the cause and the action."""
    lines = [acceptance.decision.value]
    lines += [f'  {_decision_text(entry)}' for entry in acceptance.values]
    if acceptance.why:
        lines.append(f'  {acceptance.why}')
    return lines + ([f'  -> {acceptance.remedy}'] if acceptance.remedy else [])


def _decision_text(entry: ValueDecision) -> str:
    estimate, is_angle = entry.estimate, entry.estimate.unit == 'rad'
    factor = math.degrees(1.0) if is_angle else 1.0
    unit = ' deg' if is_angle else f' {estimate.unit}' * (estimate.unit not in ('', '1'))
    name = entry.name.replace('_', ' ')
    limits = ' to '.join('any' if math.isinf(limit) else f'{limit * factor:g}'
                         for limit in (entry.low, entry.high))
    shown = 'not determined' if estimate.value is None else (
        f'{with_sigma(estimate.value, estimate.sigma, factor)}{unit}')
    return f'{entry.decision.value:9} {name} {shown}, limits {limits}{unit}'
