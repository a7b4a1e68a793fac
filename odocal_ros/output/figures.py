# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Numbers as people read them: digits cut to the sigma, units converted at this rim only."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime, UTC
import math
import textwrap

from odocal_ros.calib.result import Estimate

WIDTH = 98    # judgement: columns
NONE = Estimate(None, None, '')
COUNTS = {'m/pulse': 'pulses/m', 'm/rad': 'rad/m'}


def decimals(sigma: float) -> int:
    """Return the decimal places that show a sigma with two digits."""
    if not (math.isfinite(sigma) and sigma > 0):
        return 6
    return max(0, min(12, 1 - math.floor(math.log10(sigma))))


def with_sigma(value: float | None, sigma: float | None, factor: float = 1.0,
               signed: bool = False) -> str:
    """
    Return 'value ± sigma', both times ``factor``, with the digits that the sigma leaves.

    Of a sigma of 100 or more two digits count too: -32000 ± 15000.
    """
    if value is None or not math.isfinite(value):
        return 'unknown'
    value *= factor
    if sigma is None or not math.isfinite(sigma):
        return f'{value:+.6g}' if signed else f'{value:.6g}'
    sigma *= factor
    places = decimals(sigma)
    if sigma >= 100:
        whole = 1 - math.floor(math.log10(sigma))
        value, sigma = round(value, whole), round(sigma, whole)
    return f'{value:{"+" if signed else ""}.{places}f} ± {sigma:.{places}f}'


def two_digits(x: float) -> str:
    """Return a number with two digits that count, without an exponent where it is readable."""
    if not math.isfinite(x):
        return 'unknown'
    if x == 0 or not 1e-4 <= abs(x) < 1e7:
        return f'{x:.2g}'
    places = 1 - math.floor(math.log10(abs(x)))
    return f'{round(x, places):.{max(0, places)}f}'


def beyond_one(ratio: float, sigma: float | None) -> str:
    """Return by how much a ratio differs from 1: ppm, or per cent where the sigma is 1 % or so."""
    coarse = sigma is not None and math.isfinite(sigma) and sigma >= 0.01
    factor, unit = (100.0, '%') if coarse else (1e6, 'ppm')
    return f'{with_sigma(ratio - 1, sigma, factor, signed=True)} {unit}'


def share(relative: float) -> str:
    """Return a relative sigma as people say it: ppm, or per cent from one on."""
    return f'{two_digits(100 * relative)} %' if relative >= 0.01 else (
        f'{two_digits(1e6 * relative)} ppm')


def length(metres: float) -> str:
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


def time_span(seconds: float) -> str:
    """Return a duration as people say it."""
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


def wrapped(text: str, indent: str = '  ', more: str = '  ', width: int = WIDTH) -> list[str]:
    """Return a text in lines, all but the first indented by ``more``; words stay whole."""
    return textwrap.wrap(text, width, initial_indent=indent, subsequent_indent=indent + more,
                         break_long_words=False, break_on_hyphens=False)


def known(estimates: dict[str, Estimate], name: str) -> Estimate:
    """Return an estimate by name, with None in place of what is missing or no number."""
    found = estimates.get(name, NONE)
    value, sigma = (x if x is not None and math.isfinite(x) else None
                    for x in (found.value, found.sigma))
    return replace(found, value=value, sigma=sigma)


def with_unit(estimate: Estimate) -> str:
    """Return value and sigma with their unit."""
    unit = '' if estimate.unit == '1' else f' {estimate.unit}'
    return with_sigma(estimate.value, estimate.sigma) + unit


def inverse(scale: Estimate) -> str:
    """Return the inverse scale: pulses (or rad) per metre with sigma."""
    if not scale.value:
        return ''
    sigma = None if scale.sigma is None else scale.sigma / scale.value**2
    return f'{with_sigma(1 / scale.value, sigma)} {COUNTS[scale.unit]}'


def columns(rows: Sequence[Sequence[str]], indent: str = '  ') -> list[str]:
    """Return a table with columns as wide as their widest cell, all cells to the left."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [indent + '  '.join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)
                               ).rstrip() for row in rows]


def table_row(cells: Sequence[str], widths: Sequence[int]) -> str:
    """Return a line of a table of fixed widths: the name to the left, numbers to the right."""
    name, *numbers = (f'{cell:{"<" if not k else ">"}{width}}' for k, (cell, width) in enumerate(
        zip(cells, widths, strict=True)))
    return f'  {name}{"".join(numbers)}'
