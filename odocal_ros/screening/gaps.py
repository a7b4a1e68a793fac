# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Gaps of a topic: in its own rhythm, and of the IMU beyond a limit."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.inputs import INPUTS
from odocal_ros.data.pieces import by_step
from odocal_ros.nav.statistics import gaps_in_rhythm
from odocal_ros.reasons import Code, Reason


def topic_gap(slot: str, t: Floats) -> tuple[Reason, ...]:
    """Return TOPIC_GAP for the longest gap of a topic far beyond its own rhythm."""
    gaps = gaps_in_rhythm(t)
    if not len(gaps):
        return ()
    begin, end = gaps[np.argmax(gaps[:, 1] - gaps[:, 0])]
    return (Reason(Code.TOPIC_GAP, f'{INPUTS[slot].label} gap of {end - begin:.2f} s at '
                   f't = {begin:.2f} s (median interval {np.median(np.diff(t)):.3f} s)'),)


def imu_gap(t_imu: Floats, t_from: float, t_stop: float, limit: float) -> tuple[Reason, ...]:
    """Return IMU_GAP where the IMU misses more than ``limit`` s between t_from and t_stop."""
    t = t_imu[np.searchsorted(t_imu, t_from - 1e-9):
              np.searchsorted(t_imu, t_stop + 1e-9, side='right')]
    long = np.flatnonzero(by_step(lambda t: np.diff(t) > limit, t))
    ends = [(t_from, t[0]), *zip(t[long], t[long + 1], strict=True), (t[-1], t_stop)] \
        if len(t) else [(t_from, t_stop)]
    gaps = [(float(b - a), float(a)) for a, b in ends if b - a > limit]
    if not gaps:
        return ()
    length, at = max(gaps)
    return (Reason(Code.IMU_GAP, f'no IMU data for {length:.2f} s at t = {at:.2f} s ({len(gaps)} '
                   f'gap{"s" * (len(gaps) > 1)}; the limit is {limit:g} s)'),)
