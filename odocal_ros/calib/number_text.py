# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Numbers as text: significant digits, units of relative values, values beside their limits.

A relative sigma is in ppm, or in per cent from 1 % on; a value or a limit beside it has the same
unit. A relative change or difference is in per cent.
"""

import math

PER_CENT_FROM = 0.01    # definition: relative sigmas from this size are shown in per cent


def significant(x: float, digits: int = 2) -> str:
    """Return a number with significant digits, without an exponent if readable."""
    if not math.isfinite(x):
        return 'unknown'
    if x == 0 or not 1e-4 <= abs(x) < 1e7:
        return f'{x:.{digits}g}'
    places = digits - 1 - math.floor(math.log10(abs(x)))
    return f'{round(x, places):.{max(0, places)}f}'


def relative_unit(*values: float) -> tuple[float, str]:
    """Return factor and unit for a relative sigma and the values beside it."""
    return (100.0, '%') if max(map(abs, values)) >= PER_CENT_FROM else (1e6, 'ppm')


def format_change(change: float) -> str:
    """Return a relative change in per cent as text, with a sign."""
    return f'{round(100 * change, 4):+z.3g} %'


def differing(value: float, limit: float) -> str:
    """Return a value with two digits, or with those that show it differs from its limit."""
    texts, limits = ([significant(x, digits) for digits in range(2, 7)] for x in (value, limit))
    return next((text for text in texts if text not in limits), texts[-1])


def with_limit(value: float, limit: float, unit: str) -> str:
    """Return 'VALUE; the limit is LIMIT'."""
    return (f'{differing(value, limit)} {unit}; the limit is '
            f'{float(significant(limit, 3)):.7g} {unit}')


def relative_with_limit(relative: float, limit: float) -> str:
    """Return 'VALUE; the limit is LIMIT' of a relative sigma."""
    factor, unit = relative_unit(relative, limit)
    return with_limit(factor * relative, factor * limit, unit)
