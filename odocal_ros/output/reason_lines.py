# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reasons and acceptance for a person: the gravest first, what legs share said once."""

from dataclasses import replace
import json
import math
import re
from typing import Any

from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.output.figures import with_sigma, wrapped
from odocal_ros.pipeline.acceptance import Acceptance, Held
from odocal_ros.reasons import Reason, Verdict
from odocal_ros.settings.config import Config

OF_LEG = re.compile(r'leg (\d+): (.*)', re.DOTALL)


def shared(reasons: tuple[Reason, ...]) -> tuple[Reason, ...]:
    """Return reasons with those of several legs joined that differ in nothing but the leg."""
    joined: dict[tuple[Any, ...], list[str]] = {}
    for reason in reasons:
        match = OF_LEG.fullmatch(reason.text)
        number, text = match.groups() if match else ('', reason.text)
        joined.setdefault((replace(reason, text=text), bool(match)), []).append(number)
    of_code: dict[object, list[tuple[Reason, list[str]]]] = {}
    for (reason, of_leg), numbers in joined.items():
        of_code.setdefault(reason.code if of_leg else reason, []).append((reason, numbers))
    return tuple(line for found in of_code.values() for line in _of_legs(found))


def _of_legs(found: list[tuple[Reason, list[str]]]) -> list[Reason]:
    """Return the reasons of a code with their legs; of many that differ, the first one."""
    if not found[0][1][0]:
        return [found[0][0]]
    few = 2    # reasons of a code that differ from leg to leg, listed one by one
    if len(found) <= few:
        return [replace(reason, text=f'{_legs(numbers)}: {reason.text}')
                for reason, numbers in found]
    reason, first = found[0]
    every = sorted({int(n) for _, numbers in found for n in numbers})
    return [replace(reason, text=f'{_legs([str(n) for n in every])}; of leg {first[0]}: '
                                 f'{reason.text}')]


def _legs(numbers: list[str]) -> str:
    """Return leg numbers, rising, as people say them."""
    if len(numbers) == 1:
        return f'leg {numbers[0]}'
    runs: list[list[str]] = []
    for number in numbers:
        if runs and int(number) == int(runs[-1][-1]) + 1:
            runs[-1].append(number)
        else:
            runs.append([number])
    said = [word for run in runs for word in (
        run if len(run) < 3 else [f'{run[0]} to {run[-1]}'])]
    return f'legs {", ".join(said[:-1])} and {said[-1]}' if len(said) > 1 else f'legs {said[0]}'


def bag_lines(legs: tuple[LegResult, ...], width: int) -> list[str]:
    """Return the text that lists the legs of each bag, empty for a single bag."""
    of_bag: dict[str, list[str]] = {}
    for number, leg in enumerate(legs, 1):
        of_bag.setdefault(leg.bag, []).append(str(number))
    if len(of_bag) < 2:
        return []
    listed = '; '.join(f'{_legs(numbers)}: {bag}' for bag, numbers in of_bag.items())
    return wrapped(listed, '  ', '   ', width)


def reason_lines(reasons: tuple[Reason, ...], width: int, brief: bool = False) -> list[str]:
    """Return reasons with their remedies for a terminal; brief: of notes the codes alone."""
    lines = []
    for verdict, title in ((Verdict.REJECTED, 'rejected because'), (Verdict.CAUTION, 'warnings'),
                           (Verdict.ACCEPTED, 'notes')):
        found = [r for r in shared(reasons) if r.code.gravity is verdict]
        if brief and found and verdict is Verdict.ACCEPTED:
            codes = ', '.join(dict.fromkeys(r.code.name for r in found))
            lines += wrapped(f'notes, see the report: {codes}', '  ', '   ', width)
            continue
        for reason in found:
            lines += [f'  {title}'] if title else []
            title = ''
            lines += wrapped(f'{reason.code.name}: {reason.text}', '    ', '   ', width)
            lines += wrapped(f'-> {reason.remedy}', '      ', '   ', width)
    if any(re.search(r'\bt = ', line) for line in lines):
        lines.append('  t: seconds from the start of the leg')
    return lines


def accept_line(calibration: Calibration, acceptance: Acceptance, config: Config) -> str:
    """Return the decision on a vehicle as one line of JSON."""
    return json.dumps({'vehicle': config.vehicle, **acceptance.as_dict(),
                       'verdict': calibration.verdict.value,
                       'reasons': [r.code.name for r in calibration.reasons]}, allow_nan=False)


def accept_words(acceptance: Acceptance) -> list[str]:
    """Return the decision, a line on each value, and what to do where it is open."""
    lines = [acceptance.decision.value, *(f'  {_value(held)}' for held in acceptance.values)]
    if acceptance.why:
        lines.append(f'  {acceptance.why}')
    return lines + ([f'  -> {acceptance.do}'] if acceptance.do else [])


def _value(held: Held) -> str:
    e, angle = held.estimate, held.estimate.unit == 'rad'
    factor = math.degrees(1.0) if angle else 1.0
    unit = ' deg' if angle else f' {e.unit}' * (e.unit not in ('', '1'))
    name = held.name.replace('_', ' ')
    limits = ' to '.join('any' if math.isinf(x) else f'{x * factor:g}'
                         for x in (held.low, held.high))
    shown = 'not determined' if e.value is None else (
        f'{with_sigma(e.value, e.sigma, factor)}{unit}')
    return f'{held.decision.value:9} {name} {shown}, limits {limits}{unit}'
