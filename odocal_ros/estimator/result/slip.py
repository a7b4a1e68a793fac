# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Places where a wheel turned more or less than the vehicle moved, detected by odometer noise."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.fit import Fit
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS

# factor on the variance of an interval that is a slip. Statistical: 3.7 sigmas, by chance once in
# 4200
SLIP_VARIANCE = 1.5
LEAST_SLIP = 0.05    # m: a shorter slip is not reported. Judgement
# effective rows of a level that is reported. Statistical: its root, with a sigma of root / sqrt(2
# rows), is then REMARK_SIGMAS above zero
LEVEL_ROWS = REMARK_SIGMAS**2 / 2


@dataclass(frozen=True)
class Slip:
    """A run of slip: s since the start mark, duration s, wheel travel minus vehicle travel m."""

    t: float
    duration: float
    metres: float


def along(fit: Fit, marginals: JointMarginals) -> Floats:
    """Return odometer path minus ground path in each interval, m: (K,)."""
    rows = fit.weighted[MotionRows]
    estimate, _ = rows.road_noise(marginals)
    return -estimate[:, 0] * rows.along_size()


def find_slips(fit: Fit, turned: Floats, count: float) -> tuple[Slip, ...]:
    """Return the runs with outliers of ``along`` beyond a count, m, largest first."""
    t = fit.state.t
    least = max(4 * float(np.sqrt(fit.levels['along'])), LEAST_SLIP, count)    # sigmas of a second
    far = np.flatnonzero((fit.spread[:, 0] > SLIP_VARIANCE) | (np.abs(turned) > least))
    if not len(far):
        return ()
    slips = []
    for run in np.split(far, np.flatnonzero(np.diff(far) > 2) + 1):    # a second between
        begin, end, metres = run[0], run[-1] + 1, float(turned[run].sum())
        if abs(metres) >= max(4 * np.sqrt(fit.levels['along'] * (t[end] - t[begin])), LEAST_SLIP,
                              count):
            slips.append(Slip(float(t[begin]), float(t[end] - t[begin]), metres))
    return tuple(sorted(slips, key=lambda s: -abs(s.metres)))


def level_when_changing(fit: Fit, marginals: JointMarginals, count: float) -> str:
    """Return the slip level at changes of speed as text, '' if it is not observable."""
    level = fit.levels.roots()
    # the noise of the difference of two readings, over a phase of 10 s
    rounding = count * np.sqrt(2 / 12) / np.sqrt(10.0)
    # a level without information keeps its initial value
    known = {name for name, (_, rows) in fit.weighted[MotionRows].components(marginals).items()
             if rows > LEVEL_ROWS}
    # m/sqrt(s), times that at constant speed: without slip it is smaller
    if 'along_hard' not in known or level['along_hard'] <= max(
            0.006, 3 * level['along'], rounding):
        return ''
    beside = (f', {1e3 * level["along"]:.1f} mm/√s at constant '
              'speed') if 'along' in known else ''
    return ('slip while accelerating or braking is about '
            f'{1e3 * level["along_hard"]:.0f} mm/√s{beside}')


def slip_reasons(slips: tuple[Slip, ...], level: str) -> list[Reason]:
    """Return WHEEL_SLIP with places and sizes; level : of slip as the speed changes, as text."""
    said, most = [], 3      # runs listed singly
    if slips:
        one = [f'{s.metres:+z.2f} m at t = {s.t:.0f} s ({s.duration:.0f} s)'
               for s in slips[:most]]
        more = f' and {len(slips) - most} more' if len(slips) > most else ''
        said.append('wheel slip, travel of the wheel minus travel of the vehicle: '
                    + ', '.join(one) + more)
    if level:
        said.append(level)
    return [Reason(Code.WHEEL_SLIP, '; '.join(said))] if said else []
