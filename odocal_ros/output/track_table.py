"""Dead reckoning against the fixes, of all legs, for a terminal."""

import math

from odocal_ros.calib.result import TrackCheck
from odocal_ros.output.figures import length


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


def track_lines(legs) -> list[str]:
    """Return the table of dead reckoning against the fixes, none without fixes."""
    rows = []
    for label, name in (('as configured', 'before'), ('as calibrated', 'after')):
        check = overall([(getattr(leg, name), leg.fixes) for leg in legs])
        if check is not None:
            cells = (length(check.rms), length(check.mean), length(check.max), length(check.end),
                     f'{check.percent_of_distance:.3f} %')
            rows.append(f'  {label:<20}' + ''.join(f'{cell:>11}' for cell in cells))
    head = ('rms', 'mean', 'max', 'at the end', 'of the way')
    return [f'  {"track against fixes":<20}' + ''.join(f'{word:>11}' for word in head), *rows] \
        if rows else []
