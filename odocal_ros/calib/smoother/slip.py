# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Where a wheel turned more, or less, than the vehicle moved: what the odometer's noise shows."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.smoother.chain import Neighbours
from odocal_ros.calib.smoother.estimate import Fit
from odocal_ros.calib.smoother.motion_rows import MotionRows
from odocal_ros.calib.smoother.noise import ROAD
from odocal_ros.data.arrays import Floats
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS

# factor on the variance of an interval from which it is a slip. Statistical: it lies 3.7 sigmas
# off, once in 4200 by chance
SLIP_VARIANCE = 1.5
ROAD_NAMES = tuple(ROAD)
# rows that a level must be worth to be reported. Statistical: its root, with a sigma of
# root / sqrt(2 rows), then lies REMARK_SIGMAS above zero
LEVEL_ROWS = REMARK_SIGMAS**2 / 2


@dataclass(frozen=True)
class Slip:
    """A run of slip: s since the start mark, s, m the wheel turned beyond the ground."""

    t: float
    duration: float
    metres: float


def along(fit: Fit, neighbours: Neighbours) -> Floats:
    """Return what the odometer turned beyond the ground in each interval, m: (K,)."""
    rows = fit.weighted[MotionRows]
    estimate, _ = rows.road_noise(neighbours)
    out: Floats = -estimate[:, 0] * rows.along_size()
    return out


def left_when_changing(fit: Fit, turned: Floats, rest: Floats) -> float:
    """Return the share of the rms of ``turned`` that ``rest`` is where speeds change, (K,) m."""
    hard = fit.weighted[MotionRows].noise.road[:, ROAD_NAMES.index('along_hard')] > 0
    power = float((turned[hard]**2).sum())
    return float(np.sqrt((rest[hard]**2).sum() / power)) if power else 1.0


def find_slips(fit: Fit, turned: Floats, count: float = 0.0) -> tuple[Slip, ...]:
    """
    Return the runs that lie far out along, by more than a count, m; largest first.

    turned : (K,) m, as ``along`` has it, without what a filter of the speed does.
    """
    t = fit.state.t
    noise, worth = 4 * float(np.sqrt(fit.levels['along'])), 0.05    # sigmas of a second; m
    least = max(worth, noise, count)
    far = np.flatnonzero((fit.spread[:, 0] > SLIP_VARIANCE) | (np.abs(turned) > least))
    if not len(far):
        return ()
    runs = np.split(far, np.flatnonzero(np.diff(far) > 2) + 1)    # a second between
    slips = [Slip(float(t[run[0]]), float(t[run[-1] + 1] - t[run[0]]), float(turned[run].sum()))
             for run in runs]
    return tuple(sorted((s for s in slips if abs(s.metres)
                         >= max(worth, noise * np.sqrt(s.duration), count)),
                        key=lambda s: -abs(s.metres)))


def slip_reasons(fit: Fit, neighbours: Neighbours, slips: tuple[Slip, ...], count: float = 0.0,
                 left: float = 1.0) -> list[Reason]:
    """
    Return WHEEL_SLIP with where the wheels slipped and how much, empty where they did not.

    One by one, or whenever the speed changes: by a level, where the drive determines it.
    left : of the ways when the speed changes, without what a filter of the speed does.
    """
    level = fit.levels.roots()
    level['along_hard'] *= left
    # two readings differ by that whatever the wheel does, over the 10 s that a spell of it lasts
    rounding = count * np.sqrt(2 / 12) / np.sqrt(10.0)
    # one that no row determines stays where the fit began
    known = {name for name, (_, rows) in fit.weighted[MotionRows].components(neighbours).items()
             if rows > LEVEL_ROWS}
    said, most = [], 3      # runs said one by one
    if slips:
        one = [f'{s.metres:+.2f} m at t = {s.t:.0f} s ({s.duration:.0f} s)'
               for s in slips[:most]]
        more = f' and {len(slips) - most} more' if len(slips) > most else ''
        said.append('wheel slip, travel of the wheel minus travel of the vehicle: '
                    + ', '.join(one) + more)
    # m/sqrt(s), times even driving: no wheel without slip has so much when speeds change
    if 'along_hard' in known and level['along_hard'] > max(0.006, 3 * level['along'], rounding):
        beside = (f', {1e3 * level["along"]:.1f} mm/√s at constant '
                  'speed') if 'along' in known else ''
        said.append('slip while accelerating or braking is about '
                    f'{1e3 * level["along_hard"]:.0f} mm/√s{beside}')
    return [Reason(Code.WHEEL_SLIP, '; '.join(said))] if said else []
