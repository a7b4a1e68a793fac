# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks of positions in a local frame: their z axis is up, and their unit is the metre."""

import math

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.geodesy import MIN_LOCAL_MOTION
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.inputs import Inputs, LocatedFixes
from odocal_ros.settings.config import HOLONOMIC

# physical: mean slope of a drive on wheels, rad; with y up, heights vary as much as x
STEEPEST_DRIVE = math.radians(30.0)
# judgement: ratio of positions to the odometer with its nominal scale. In cm it is 100; a nominal
# scale in degrees for radians, 57, is wrong too
LARGEST_RATIO = 20.0
PARTS = 50      # judgement: of a run of some minutes, each of some seconds


def local_frame_reasons(inputs: Inputs, located: LocatedFixes, drive: str) -> tuple[Reason, ...]:
    """
    Return the reason if positions in a local frame are not in metres, or not with z up.

    drive : as odometer.drive.
    """
    if not inputs.is_local or len(inputs.t_fix) < 2:
        return ()
    if axis_reason := _axis_reason(located.fixes_n):
        return (axis_reason,)
    # sideways motion of these wheels is not in their mean
    if not located.nominal_scale or drive in HOLONOMIC:
        return ()
    ratio = located.rough_scale / located.nominal_scale
    if 1 / LARGEST_RATIO < ratio < LARGEST_RATIO:
        return ()
    return (Reason(
        Code.FIXES_UNUSABLE, f'positions move {ratio:.3g} times as far as the odometer with its '
        f'nominal scale; the limit is a factor of {LARGEST_RATIO:g}. Likely cause: one of them in '
        'mm or cm, or a wrong odometer.nominal_scale',
        f'Publish positions in m. If they are, set odometer.nominal_scale to about '
        f'{located.rough_scale:.2g}.'),)


def _axis_reason(fixes_n: Floats) -> Reason | None:
    """Return the reason if the heights of positions, (k, 3) m, are those of no drive on wheels."""
    with_height = fixes_n[~np.isnan(fixes_n[:, 2])]
    if len(with_height) <= len(fixes_n) / 2:
        return None
    # means over parts of the run, without white noise
    parts = np.array_split(with_height, min(PARTS, len(with_height)))
    x, y, height = np.ptp([part.mean(axis=0) for part in parts], axis=0).tolist()
    level = math.hypot(x, y)
    if height <= max(MIN_LOCAL_MOTION, math.tan(STEEPEST_DRIVE) * level):
        return None
    return Reason(
        Code.FIXES_UNUSABLE, f'heights of the positions vary by {height:.3g} m, x and y by '
        f'{level:.3g} m: steeper than {math.degrees(STEEPEST_DRIVE):.0f} deg. Likely cause: '
        'their z axis is not up',
        'Publish positions with z up. If y is up, these are x, -z and y. Send a z of 0 if it is '
        'not measured.')
