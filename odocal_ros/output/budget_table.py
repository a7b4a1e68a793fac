# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The error budget as people read it: each source with its share of each parameter's variance."""

import math
import textwrap
from typing import Any

from odocal_ros.calib.result import MethodResult
from odocal_ros.output.figures import table_row, two_digits

COLUMNS = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')
LABELS = {'legs': 'errors of single legs', 'gyro_by_force': 'gyro g-sensitivity',
          'slow_fix_errors': 'correlated fix errors', 'body_lean': 'body motion'}
HEAD = ('error budget', 'scale, ppm', 'yaw, deg', 'pitch, deg')
WIDTHS = 24, 13, 15, 15      # judgement: with 'shared' within 80 columns


def largest_source(method: MethodResult | None, name: str) -> tuple[str, float]:
    """Return the largest source of an estimate's error, and its share of the variance; '' none."""
    if method is None or name not in method.parameters:
        return '', 0.0
    row = method.parameters.index(name)
    parts = {s.name: float((s.effects[row]**2).sum()) for s in method.sources}
    largest, whole = max(parts, key=lambda source: parts[source], default=''), sum(parts.values())
    return (largest, parts[largest] / whole) if whole else ('', 0.0)


def source_label(name: str) -> str:
    """Return the printed name of an error source."""
    return LABELS.get(name, name.replace('_', ' '))


def budget_lines(table: dict[str, dict[str, Any]] | None, scale: float, shown: float,
                 hidden: list[str] | set[str] | tuple[Any, ...] = (), width: int = 98,
                 small_too: bool = True) -> list[str]:
    """
    Return the lines of a budget, none without one.

    table : source to one-sigma share of each parameter, as calibration.json has it.   scale :
    scale factor that its scale column belongs to.   shown : share of the variance below which a
    source is but named.   hidden : parameters that are not determined: their column stays empty.
    width : columns of the screen.   small_too : name the small ones.
    """
    if not table:
        return []
    factor = {COLUMNS[0]: 1e6 / scale}
    wholes = [sum(row.get(p, 0.0)**2 for row in table.values()) for p in COLUMNS]
    lines = [table_row(HEAD, WIDTHS)]
    small = []
    shared = '   shared by all legs' if width > 90 else '  shared'
    for name, row in table.items():
        shares = [row.get(p, 0.0)**2 / whole if whole and p not in hidden else 0.0
                  for p, whole in zip(COLUMNS, wholes, strict=True)]
        if max(shares) < shown:
            small.append(source_label(name))
            continue
        cells = ['-' if share < shown else
                 f'{two_digits(row[p] * factor.get(p, math.degrees(1.0)))} {share:>4.0%}'
                 for p, share in zip(COLUMNS, shares, strict=True)]
        lines.append(table_row([source_label(name), *cells], WIDTHS)
                     + (shared if row.get('shared') else ''))
    if not (small and small_too):
        return lines
    rest = f'under {shown:.1%}: '.replace('.0%', '%').replace('%', ' %') + ', '.join(small)
    return lines + textwrap.wrap(rest, width, initial_indent='  ',
                                 subsequent_indent='    ')
