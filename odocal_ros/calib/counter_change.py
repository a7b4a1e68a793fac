# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Change of the odometer scale during a drive, by a change of decoding, unit or gear."""

import numpy as np

from odocal_ros.calib.sections import Sections
from odocal_ros.data.arrays import Floats
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS, TYRE_SPREAD

SIDE_SCATTER = 0.25    # judgement: share of the change by which sections on one side may differ


def counter_change(parts: Sections, t_fix: Floats, fix_distance: Floats) -> tuple[Reason, ...]:
    """
    Return TRACK_MISMATCH if the scale of sections changes once and is constant otherwise.

    parts : scale by section.   t_fix, fix_distance : (k,) times of the fixes, s, and path length
    there, m. The section with the change may have any scale.
    """
    known = np.flatnonzero(np.isfinite(parts.ratio) & (parts.ratio > 0))
    log, sigma = np.log(parts.ratio[known]), parts.sigma[known]
    found = []
    for k in range(1, len(known) - 1):
        sides = [log[:k], log[k + 1:]]
        before, after = (np.median(side) for side in sides)
        apart = max(np.ptp(side) for side in sides)
        doubt = np.hypot(*(sigma[rows].max() for rows in (slice(k), slice(k + 1, None))))
        if abs(after - before) > max(TYRE_SPREAD, REMARK_SIGMAS * doubt, apart / SIDE_SCATTER):
            found.append((apart / abs(after - before), k, float(np.exp(before - after))))
    if not found:
        return ()
    _, k, factor = min(found)
    begin, end = np.interp([parts.begin[known[k]], parts.end[known[k]]], fix_distance, t_fix)
    return (Reason(Code.TRACK_MISMATCH, 'the odometer scale changes: it counts '
                   f'{factor:.2f} times as much per metre after t = {begin:.0f} to {end:.0f} s as '
                   'before', 'Check the driver for a change of decoding (x1, x2, x4), unit or '
                   'gear. Mark a leg on one side of the change with --leg.'),)
