"""Reasons and bags of legs for a person: the gravest first, what legs share said once."""

from dataclasses import replace
import re
import textwrap

from odocal_ros.reasons import Reason, Verdict

OF_LEG = re.compile(r'leg (\d+): (.*)', re.DOTALL)


def shared(reasons: tuple[Reason, ...]) -> tuple[Reason, ...]:
    """Return reasons with those of several legs joined that differ in nothing but the leg."""
    joined: dict[tuple, list[str]] = {}
    for reason in reasons:
        match = OF_LEG.fullmatch(reason.text)
        number, text = match.groups() if match else ('', reason.text)
        joined.setdefault((replace(reason, text=text), bool(match)), []).append(number)
    return tuple(replace(reason, text=f'{_legs(numbers)}: {reason.text}') if of_leg else reason
                 for (reason, of_leg), numbers in joined.items())


def _legs(numbers):
    if len(numbers) == 1:
        return f'leg {numbers[0]}'
    return f'legs {", ".join(numbers[:-1])} and {numbers[-1]}'


def bag_lines(legs, width: int) -> list[str]:
    """Return which legs are from which bag, nothing where there is but one."""
    of_bag: dict[str, list[str]] = {}
    for number, leg in enumerate(legs, 1):
        of_bag.setdefault(leg.bag, []).append(str(number))
    if len(of_bag) < 2:
        return []
    told = '; '.join(f'{_legs(numbers)}: {bag}' for bag, numbers in of_bag.items())
    return _wrapped(told, '  ', width)


def reason_lines(reasons: tuple[Reason, ...], width: int, brief: bool = False) -> list[str]:
    """Return reasons with their remedies for a terminal; brief: of notes the codes alone."""
    lines = []
    for verdict, title in ((Verdict.REJECTED, 'rejected because'), (Verdict.CAUTION, 'take care'),
                           (Verdict.ACCEPTED, 'notes')):
        found = [r for r in shared(reasons) if r.code.gravity is verdict]
        if brief and found and verdict is Verdict.ACCEPTED:
            codes = ', '.join(dict.fromkeys(r.code.name for r in found))
            lines += _wrapped(f'notes, see the report: {codes}', '  ', width)
            continue
        for reason in found:
            lines += [f'  {title}'] if title else []
            title = ''
            lines += _wrapped(f'{reason.code.name}: {reason.text}', '    ', width)
            lines += _wrapped(f'-> {reason.remedy}', '      ', width)
    return lines


def _wrapped(text, indent, width):
    return textwrap.wrap(text, width, initial_indent=indent, subsequent_indent=indent + '   ',
                         break_long_words=False, break_on_hyphens=False)
