# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Dead reckoning against the fixes, of all legs, for a terminal."""

import math

from odocal_ros.calib.result import LegResult, PerDistance, TrackCheck
from odocal_ros.output.figures import length, table_row

SIDES = 'before', 'after'
LABEL, CELL = 22, 9      # judgement: columns


def overall(checks: list[tuple[TrackCheck | None, int]]) -> TrackCheck | None:
    """
    Return one check for many legs, each (check, fixes), None if there is none.

    rms and mean are pooled over fixes; max, end and percent are those of the worst leg.
    """
    have = [(check, n) for check, n in checks if check is not None and n]
    if not have:
        return None
    total = sum(n for _, n in have)
    return TrackCheck(
        rms=math.sqrt(sum(n * check.rms**2 for check, n in have) / total),
        mean=sum(n * check.mean for check, n in have) / total,
        **{name: max(getattr(check, name) for check, _ in have)
           for name in ('max', 'end', 'percent_of_distance')})


def in_pieces(legs: list[LegResult] | tuple[LegResult, ...]) -> list[PerDistance]:
    """Return the error per distance driven of all legs, pooled over pieces."""
    found: dict[float, list[PerDistance]] = {}
    for one in (x for leg in legs for x in leg.per_distance):
        found.setdefault(one.length, []).append(one)
    return [_pooled(length, parts) for length, parts in sorted(found.items())]


def _pooled(length: float, parts: list[PerDistance]) -> PerDistance:
    whole = sum(x.pieces for x in parts)
    return PerDistance(length, math.sqrt(sum(x.pieces * x.before**2 for x in parts) / whole),
                       math.sqrt(sum(x.pieces * x.after**2 for x in parts) / whole), whole)


def before_label(legs: list[LegResult] | tuple[LegResult, ...]) -> str:
    """Return the label of the track before calibration."""
    configured = any('scale_ratio' in m.estimates and m.estimates['scale_ratio'].value is not None
                     for leg in legs for m in leg.methods.values())
    return 'as configured' if configured else 'uncalibrated'


def check_table(legs: tuple[LegResult, ...]) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Return heads and rows (label, cells) of dead reckoning against the fixes, none without."""
    pieces = in_pieces(legs)
    rows = []
    for label, name in zip((before_label(legs), 'as calibrated'), SIDES, strict=True):
        check = overall([(getattr(leg, name), leg.fixes) for leg in legs])
        if check is not None:
            rows.append((label, [
                *(length(getattr(x, name)) for x in pieces), length(check.rms),
                length(check.max), length(check.mean), length(check.end),
                f'{check.percent_of_distance:.3f} %']))
    heads = [f'in {x.length:g} m' if x.length < 1000 else f'in {x.length / 1000:g} km'
             for x in pieces]
    return [*heads, 'rms', 'max', 'mean', 'at end', 'of path'], rows


def track_lines(legs: tuple[LegResult, ...], width: int) -> list[str]:
    """Return the table of dead reckoning against the fixes, as wide as there is room."""
    heads, rows = check_table(legs)
    if not rows:
        return []
    most = (width - LABEL) // CELL
    return [table_row([label, *cells[:most]], [LABEL - 2, *[CELL] * len(cells[:most])])
            for label, cells in (('track against fixes', heads), *rows)]
