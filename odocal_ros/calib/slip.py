# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Wheel slip: where the odometer runs farther than the IMU's acceleration allows.

Over a few seconds the path is the integral of speed, and speed that of the specific force along
the forward axis less gravity. With the speed pinned to the odometer's at both ends of the window,
a steady accelerometer bias and a tilt drop out; what a wheel spun in between does not. An odometer
that is late, or whose speed is low-pass filtered, departs from the IMU at every change of
acceleration: the lateness at which the two agree best is estimated first.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from odocal_ros.calib.result import Source
from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.data.pieces import by_row
from odocal_ros.nav.angles import arctan2
from odocal_ros.nav.dead_reckoning import Track
from odocal_ros.nav.earth import gravity
from odocal_ros.nav.integral import integral_at
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.statistics import robust_sigma
from odocal_ros.reasons import Code, Reason

SPIN_WINDOW = 4.0    # s, longer than a spin, shorter than a hill: judgement
SPIN_GRID = 0.2      # s between rows, a spin lasts longer: judgement
SPAN = round(SPIN_WINDOW / SPIN_GRID)      # definition: rows of a window
PIN_STEPS = 2        # rows each side that the speed at an end is taken over: judgement
# rad in a window: in more of a turn the level's error is another axis'. Judgement
SPIN_TURN = 0.1
# odometer counts that rounding may make of a window: one over the 0.8 s of a pin is 5 over the
# window, its own ends 1 more; the rest is margin: judgement
PIN_COUNTS = 8.0
# s by which the odometer may be late, looked at: judgement; a bus or a filter takes less
LATE = 0.05 * np.arange(-10, 21)


class Slips(NamedTuple):
    """
    Where the wheels spun or slid.

    t : (k,) s, middle of each slip.   size : (k,) m, > 0 where the wheel spun, < 0 where it slid.
    late : s by which the odometer is late against the IMU, where it would look like slip, else 0.
    """

    t: Floats
    size: Floats
    late: float = 0.0


def rounding(travel: Travel) -> float:
    """Return the size of a count, scale units, or that of one as coarse as steps of a speed."""
    coarse = travel.coarse
    # speeds at both ends of a window, and within it, err by up to that
    return travel.quantum if coarse is None else coarse.most * SPIN_WINDOW / PIN_COUNTS


def find_slips(t_imu: Floats, f_b: Floats, track: Track, f: Floats, latitude: float,
               quantum: float) -> Slips:
    """
    Return times and sizes of the slips of the odometer against the IMU, after its delay.

    t_imu, f_b : (n,), (n, 3) specific force, s, m/s^2.   track : attitude and travel.   f : (3,)
    scale times forward axis.   latitude : rad.   quantum : size of an odometer count, scale units.
    """
    K = float(np.linalg.norm(f))
    grid = np.arange(max(track.t[0] - LATE[0], t_imu[0]), min(track.t[-1] - LATE[-1], t_imu[-1]),
                     SPIN_GRID)
    if len(grid) < 2 * SPAN:
        return Slips(np.empty(0), np.empty(0))
    a = acceleration(grid, t_imu, f_b, track, f / K, latitude)
    # in a turn the level error comes to bear on another axis: no window is judged there
    C = track.C_nb_at(grid)
    yaw = np.unwrap(arctan2(C[:, 1, 0], C[:, 0, 0]))[PIN_STEPS:-PIN_STEPS]
    turns = np.ptp(sliding_window_view(yaw, SPAN + 1), axis=1) > SPIN_TURN
    windows = _Windows(grid, a, turns, track, K, quantum)
    # a mean of sizes: slips hardly move it
    late = float(LATE[np.argmin([np.abs(windows.excess(late)).mean() for late in LATE])])
    t, size = windows.events(late)
    hidden = len(windows.events(0.0)[0]) > len(t)
    return Slips(t, size, late if hidden else 0.0)


@dataclass(frozen=True, eq=False)
class _Windows:
    """
    The windows of a drive, from each of grid, (n,) s, on.

    a : (n - 1,) m/s^2 along by the IMU.   turns : (m,) bool, windows that are not judged.
    track, K, quantum : Track, its scale, size of a count in scale units.
    """

    grid: Floats
    a: Floats
    turns: Bools
    track: Track
    K: float
    quantum: float

    def excess(self, late: float) -> Floats:
        """Return by how much the odometer exceeds the IMU in each window if so late, s: (m,) m."""
        way = self.K * np.interp(self.grid + late, self.track.t, self.track.s)
        return np.where(self.turns, 0.0, excess_way(SPAN, self.a, way))

    def events(self, late: float) -> tuple[Floats, Floats]:
        """Return time, s, and size, m, of each slip if the odometer is so late, s."""
        excess = self.excess(late)
        # what the drive as a whole does (rough road, soft suspension) is no event
        usual = robust_sigma(excess[excess != 0.0]) if excess.any() else 0.0
        least = 0.45    # m, 3 sigmas: a tilt that drifts makes 0.1 m/s^2 of a window, 0.15 m
        limit = max(least, PIN_COUNTS * self.quantum * self.K, 6 * usual)
        return _events(self.grid[PIN_STEPS:-SPAN - PIN_STEPS] + SPIN_WINDOW / 2, excess, limit)


def acceleration(grid: Floats, t_imu: Floats, f_b: Floats, track: Track, forward: Floats,
                 latitude: float) -> Floats:
    """Return the mean acceleration along the forward axis from each grid time to the next."""
    along = by_row(lambda f_b: f_b @ forward, f_b)
    force = np.diff(integral_at(grid, t_imu, along)) / SPIN_GRID
    rise = np.einsum('ni,i->n', track.C_nb_at((grid[:-1] + grid[1:]) / 2)[:, 2], forward)
    out: Floats = force - gravity(latitude, 0.0) * rise
    return out


def excess_way(span: int, a: Floats, way: Floats) -> Floats:
    """
    Return the odometer's path over each window less that by acceleration: (m,) m.

    The speed by acceleration is set to the odometer's at both ends by a straight line; both are
    taken as means over the same few steps, so that a jump of acceleration there does no harm.
    """
    u = np.concatenate([[0.0], np.cumsum(a) * SPIN_GRID])        # speed but for a constant
    x = np.concatenate([[0.0], np.cumsum((u[:-1] + u[1:]) / 2) * SPIN_GRID])
    ahead = way - x                 # its slope is what the speed by acceleration lacks
    lacks = (ahead[2 * PIN_STEPS:] - ahead[:-2 * PIN_STEPS]) / (2 * PIN_STEPS * SPIN_GRID)
    ahead = ahead[PIN_STEPS:-PIN_STEPS]
    lacked = (lacks[:-span] + lacks[span:]) / 2 * span * SPIN_GRID
    excess: Floats = ahead[span:] - ahead[:-span] - lacked
    return excess


def _events(middle: Floats, excess: Floats, limit: float) -> tuple[Floats, Floats]:
    """
    Return time and size of each event.

    An event is seen by every window that holds it, from both flanks on: the windows beyond the
    limit are one group, and in its middle stand those that hold the event whole.
    """
    far = np.flatnonzero(np.abs(excess) > limit)
    groups = np.split(far, np.flatnonzero(np.diff(middle[far]) > SPIN_WINDOW / 2) + 1)
    centres = [(g[0] + g[-1]) // 2 for g in groups if len(g)]
    k = np.array([c for c in centres if abs(excess[c]) > limit], int)
    return middle[k], excess[k]


def slip_source(track: Track, f: Floats, gradient: Floats, t: Floats, size: Floats) -> Source:
    """Return slips as a source of error: one for all, since wheels spin in one direction."""
    along_n = track.C_nb_at(t) @ f / np.linalg.norm(f) * np.abs(size)[:, None]
    return Source('wheel_slip', gradient @ along_n.sum(axis=0)[:, None])


def slip_reasons(slips: Slips, time_offset: float) -> tuple[Reason, ...]:
    """
    Return DELAY_SEEN and WHEEL_SLIP with what was seen, empty where nothing was.

    slips : Slips.   time_offset : odometer.time_offset as set, s.
    """
    found: tuple[Reason, ...] = ()
    t, size, late = slips
    if late:
        found += (Reason(
            Code.DELAY_SEEN, f'odometer stamps are about {abs(late):.2f} s '
            f'{"late" if late > 0 else "early"} relative to the IMU, or the speed is low-pass '
            f'filtered; odometer.time_offset = {time_offset - late:.2f} would remove a delay'),)
    if len(t):
        found += (Reason(
            Code.WHEEL_SLIP, f'odometer and IMU disagree by {np.abs(size).sum():.2f} m in total '
            f'at {len(t)} place{"s" * (len(t) > 1)}, first by {size[0]:+.2f} m at t = {t[0]:.1f} '
            's: the wheel spun or slid'),)
    return found
