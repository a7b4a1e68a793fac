# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Wheel slip: intervals in which the odometer travels farther, or less, than the IMU.

Over a few seconds the path is the integral of speed, and speed that of the specific force along
the forward axis minus gravity. With the speed set to the odometer's at both ends of the window, a
constant accelerometer bias and tilt cancel; slip within the window does not. A delayed odometer,
or one whose speed is low-pass filtered, differs from the IMU at every change of acceleration: the
delay at which the two agree best is estimated first.

``Slips`` are those of the mean of the wheels, ``WheelSlips`` those of single wheels, which
wheel_faults.py detects with the gyro.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from odocal_ros.calib.result import Source
from odocal_ros.data.arrays import Bools, Floats, Ints, map_rows, running_sum
from odocal_ros.nav.dead_reckoning import Track
from odocal_ros.nav.geodesy import gravity
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import arctan2
from odocal_ros.nav.time_series import integral_at, robust_sigma
from odocal_ros.reasons import Code, Reason

SLIP_WINDOW = 4.0    # s, longer than a slip, shorter than a hill: judgement
EXCESS_GRID = 0.2    # s between rows, a slip lasts longer: judgement
SPAN = round(SLIP_WINDOW / EXCESS_GRID)    # definition: rows of a window
END_STEPS = 2        # rows each side of an end over which its speed is averaged: judgement
# rad in a window: in larger turns the level error acts on another axis. Judgement
MAX_WINDOW_TURN = 0.1
# counts, possible rounding error of a window: 5, as the speed at an end may be wrong by 1 count in
# 0.8 s, for 4 s; 1 at the ends of the window; 2, a margin: judgement
WINDOW_ROUNDING_COUNTS = 8.0
# m/s^2: a sliding wheel brakes the vehicle by at least this, even on ice (friction 0.1). Physical
WEAKEST_BRAKING = 0.5
MAX_STOP_SPEED = 0.5  # m/s, a lower speed is a stop: judgement
BRAKE_SEARCH = 1.0   # s, a keyframe interval, before and after a slip: judgement
# s, delays of the odometer that are tested: judgement; a bus or a filter has less
TESTED_DELAYS = 0.05 * np.arange(-10, 21)
# s, judgement: between rows in the search for slips of one wheel, which last a second or more
SLIP_GRID = 0.1


class Slips(NamedTuple):
    """The k slips of the mean of the wheels, and the delay of the odometer."""

    t: Floats                                # (k,) s, middle of each slip
    size: Floats                             # (k,) m, > 0 if the wheel spun, < 0 if it slid
    delay: float = 0.0                       # s, of the odometer; 0 if it causes no apparent slip
    travel_error_sign: Ints = np.empty(0, int)    # (k,) by the function ``travel_error_sign``


def count_size(travel: Travel) -> float:
    """Return the size of a count, scale units; for coarse speeds, that of an equivalent count."""
    # their largest error over a window acts as WINDOW_ROUNDING_COUNTS of these counts
    coarse = travel.coarse
    return travel.quantum if coarse is None else (
        coarse.max_error * SLIP_WINDOW / WINDOW_ROUNDING_COUNTS)


def find_slips(t_imu: Floats, f_b: Floats, track: Track, f: Floats, latitude: float,
               quantum: float) -> Slips:
    """
    Return times and sizes of the slips of the odometer against the IMU, after its delay.

    t_imu, f_b : (n,), (n, 3) specific force, s, m/s^2.   track : attitude and travel.   f : (3,)
    m per scale unit, scale times forward axis in b.   latitude : rad.   quantum : size of an
    odometer count, scale units.
    """
    K = float(np.linalg.norm(f))
    grid = np.arange(max(track.t[0] - TESTED_DELAYS[0], t_imu[0]),
                     min(track.t[-1] - TESTED_DELAYS[-1], t_imu[-1]), EXCESS_GRID)
    if len(grid) < 2 * SPAN:
        return Slips(np.empty(0), np.empty(0))
    C_nb = track.C_nb_at(grid)
    yaw = np.unwrap(arctan2(C_nb[:, 1, 0], C_nb[:, 0, 0]))[END_STEPS:-END_STEPS]
    has_turn = np.ptp(sliding_window_view(yaw, SPAN + 1), axis=1) > MAX_WINDOW_TURN
    windows = _Windows(grid, acceleration(grid, t_imu, f_b, track, f / K, latitude), has_turn,
                       track, K, quantum)
    # a mean of absolute values: slips hardly affect it
    delay = float(TESTED_DELAYS[np.argmin([np.abs(windows.excess(delay)).mean()
                                           for delay in TESTED_DELAYS])])
    t, size = windows.slips(delay)
    delay_looks_like_slip = len(windows.slips(0.0)[0]) > len(t)
    speed = K * np.diff(np.interp(grid + delay, track.t, track.s)) / EXCESS_GRID
    mean_speed = np.convolve(speed, np.full(5, 0.2), 'valid')      # over a second
    signs = [travel_error_sign(middle - SLIP_WINDOW / 2, SLIP_WINDOW, metres, grid[:-5],
                               mean_speed) for middle, metres in zip(t, size, strict=True)]
    return Slips(t, size, delay if delay_looks_like_slip else 0.0, np.array(signs, int))


@dataclass(frozen=True, eq=False)
class _Windows:
    """The m windows of a drive, which begin at the rows of a grid."""

    grid: Floats         # (n,) s
    acceleration: Floats  # (n - 1,) m/s^2, forward, by the IMU
    has_turn: Bools      # (m,) windows that are excluded: the level error acts on another axis
    track: Track
    K: float             # scale, m per scale unit
    quantum: float       # size of a count, scale units

    def excess(self, delay: float) -> Floats:
        """Return odometer minus IMU path in each window, at an odometer delay, s: (m,) m."""
        path = self.K * np.interp(self.grid + delay, self.track.t, self.track.s)
        return np.where(self.has_turn, 0.0, excess_path(SPAN, self.acceleration, path))

    def slips(self, delay: float) -> tuple[Floats, Floats]:
        """Return time, s, and size, m, of each slip, at an odometer delay, s."""
        excess = self.excess(delay)
        # rough roads and soft suspensions cause a small excess everywhere: no slip
        noise = robust_sigma(excess[excess != 0.0]) if excess.any() else 0.0
        min_size = 0.45    # m, 3 sigmas: tilt drift gives 0.1 m/s^2 in a window, 0.15 m
        limit = max(min_size, WINDOW_ROUNDING_COUNTS * self.quantum * self.K, 6 * noise)
        middle = self.grid[END_STEPS:-SPAN - END_STEPS] + SLIP_WINDOW / 2
        # adjacent windows with a slip are one group; the window in its middle has all of the slip
        rows = np.flatnonzero(np.abs(excess) > limit)
        groups = np.split(rows, np.flatnonzero(np.diff(middle[rows]) > SLIP_WINDOW / 2) + 1)
        centres = [(group[0] + group[-1]) // 2 for group in groups if len(group)]
        windows = np.array([centre for centre in centres if abs(excess[centre]) > limit], int)
        return middle[windows], excess[windows]


def acceleration(grid: Floats, t_imu: Floats, f_b: Floats, track: Track, forward: Floats,
                 latitude: float) -> Floats:
    """Return the mean acceleration along the forward axis from each grid time to the next."""
    forward_force = map_rows(lambda f_b: f_b @ forward, f_b)
    force = np.diff(integral_at(grid, t_imu, forward_force)) / EXCESS_GRID
    rise = np.einsum('ni,i->n', track.C_nb_at((grid[:-1] + grid[1:]) / 2)[:, 2], forward)
    return np.asarray(force - gravity(latitude, 0.0) * rise)


def excess_path(span: int, a: Floats, path: Floats) -> Floats:
    """
    Return the odometer path over each window minus that by acceleration: (m,) m.

    The speed by acceleration is set to the odometer's at both ends by a straight line; both are
    means over the same few steps, so that a jump of acceleration there has no effect.

    span : steps of a window.   a : (n - 1,) m/s^2.   path : (n,) m, at the rows of the grid.
    """
    speed = running_sum(a) * EXCESS_GRID        # up to a constant
    difference = path - running_sum((speed[:-1] + speed[1:]) / 2) * EXCESS_GRID
    # odometer speed minus speed by acceleration, at the ends of windows
    speed_offset = (difference[2 * END_STEPS:] - difference[:-2 * END_STEPS]) / (
        2 * END_STEPS * EXCESS_GRID)
    difference = difference[END_STEPS:-END_STEPS]
    line_path = (speed_offset[:-span] + speed_offset[span:]) / 2 * span * EXCESS_GRID
    return difference[span:] - difference[:-span] - line_path


def travel_error_sign(t: float, duration: float, metres: float, t_speed: Floats,
                      speed: Floats) -> int:
    """
    Return -1 for missing travel of the odometer, 1 for excess travel, 0 for real slip.

    A wheel that slides travels less, and brakes the vehicle: less travel without braking is
    missing. Braking does not spin a wheel: more travel while braking to a stop is excess.

    t, duration : begin and duration of the slip, s.   metres : wheel travel minus vehicle travel.
    t_speed, speed : (n,) s, m/s, of the vehicle, < 0 backwards.
    """
    def speeds(margin: float) -> tuple[Floats, Floats]:
        """Return the speed, and the rate of its magnitude, from before to after the slip."""
        rows = slice(*np.searchsorted(t_speed, (t - margin, t + duration + margin + 1e-9)))
        return speed[rows], np.diff(np.abs(speed[rows])) / np.diff(t_speed[rows])

    v, rate = speeds(BRAKE_SEARCH)
    if metres * v.sum() < 0:      # less travel in the direction of motion
        return -int(len(rate) and rate.min() > -WEAKEST_BRAKING)
    v, rate = speeds(0.0)
    brakes = len(rate) and ((rate < -WEAKEST_BRAKING) | (np.abs(v[1:]) < MAX_STOP_SPEED)).all()
    return int(brakes and np.abs(v).min() < MAX_STOP_SPEED)


def travel_reasons(t: Floats, metres: Floats, sign: Ints) -> list[Reason]:
    """Return TRAVEL_MISSING and TRAVEL_EXCESS of slips (k,), s, m, with their error signs."""
    reasons = []
    for code, tested_sign, verb, circumstance in (
            (Code.TRAVEL_MISSING, -1, 'misses', 'without braking'),
            (Code.TRAVEL_EXCESS, 1, 'adds', 'while the vehicle brakes to a stop')):
        size, times = np.abs(metres[sign == tested_sign]), t[sign == tested_sign]
        several = len(times) > 1
        if len(times):
            reasons.append(Reason(
                code, f'the odometer {verb} {size.sum():.2f} m of travel at {len(times)} '
                f'place{"s" * several} ({circumstance}), {"the largest part " * several}'
                f'at t = {times[np.argmax(size)]:.0f} s'))
    return reasons


def slip_source(track: Track, f: Floats, gradient: Floats, t: Floats, size: Floats) -> Source:
    """
    Return all slips, (k,) s, m, as one source of error, since wheels spin in one direction.

    f : (3,) scale times forward axis, in b.   gradient : (p, 3) of the parameters by displacement
    in n.
    """
    along_n = track.C_nb_at(t) @ f / np.linalg.norm(f) * np.abs(size)[:, None]
    return Source('wheel_slip', gradient @ along_n.sum(axis=0)[:, None])


def slip_reasons(slips: Slips, time_offset: float) -> tuple[Reason, ...]:
    """Return the reasons for delay, slip and travel errors; time_offset : as configured, s."""
    reasons: tuple[Reason, ...] = ()
    is_slip = slips.travel_error_sign == 0
    t, size, delay = slips.t[is_slip], slips.size[is_slip], slips.delay
    if delay:
        reasons += (Reason(
            Code.DELAY_SEEN, f'odometer stamps are about {abs(delay):.2f} s '
            f'{"late" if delay > 0 else "early"} relative to the IMU, or the speed is low-pass '
            f'filtered; odometer.time_offset = {time_offset - delay:.2f} would remove a delay'),)
    if len(t):
        reasons += (Reason(
            Code.WHEEL_SLIP, f'odometer and IMU disagree by {np.abs(size).sum():.2f} m in total '
            f'at {len(t)} place{"s" * (len(t) > 1)}, first by {size[0]:+z.2f} m at t = {t[0]:.1f} '
            's. Likely cause: the wheel spun or slid'),)
    return (*reasons, *travel_reasons(slips.t, slips.size, slips.travel_error_sign))


@dataclass(frozen=True, eq=False)
class WheelSlips:
    """Slips of single wheels, in order of time: (k,)."""

    begin: Floats    # s
    end: Floats      # s
    size: Floats     # m, > 0: the wheel turned too far; unknown wheel: right minus left
    wheel: Ints      # -1 left, +1 right, 0 unknown
    # relative change of the ratio right / left, converted to one step at half the path
    change: float = 0.0
    count: int = 2         # number of wheels in the mean

    @property
    def t(self) -> Floats:
        """Return the middle of each slip, s."""
        return (self.begin + self.end) / 2

    def uncertain_travel(self) -> tuple[Floats, Floats]:
        """
        Return the times at which the mean of the wheels is uncertain, and its sigma: (d,) s, m.

        A slip of one of ``count`` wheels is 1 / ``count`` as large in the mean, distributed over
        its seconds.
        """
        seconds = np.maximum(np.ceil(self.end - self.begin), 1.0).astype(int)
        t = [begin + (end - begin) * (np.arange(n) + 0.5) / n
             for begin, end, n in zip(self.begin, self.end, seconds, strict=True)]
        sigma = np.repeat(np.abs(self.size) / self.count / np.sqrt(seconds), seconds)
        return np.concatenate([*t, []]), sigma


NO_SLIPS = WheelSlips(np.empty(0), np.empty(0), np.empty(0), np.empty(0, int))    # definition


def join_axles(axles: Sequence[WheelSlips], count: int) -> WheelSlips:
    """Return the slips of the wheels of several axles; count: number of wheels in the mean."""
    columns = {name: np.concatenate([getattr(slips, name) for slips in axles])
               for name in ('begin', 'end', 'size', 'wheel')}
    order = np.argsort(columns['begin'], kind='stable')
    return WheelSlips(**{name: column[order] for name, column in columns.items()},
                      change=math.hypot(*(slips.change for slips in axles)), count=count)


def wheel_slip_reason(slips: WheelSlips, names: tuple[str, ...]) -> tuple[Reason]:
    """Return the reason that names the wheel with the largest slip, its size and time."""
    n, worst = len(slips.size), int(np.argmax(np.abs(slips.size)))
    size, begin = slips.size[worst], slips.begin[worst]
    duration = max(slips.end[worst] - begin, SLIP_GRID)
    if slips.wheel[worst] == 0:
        event = (f'one of the wheels slips: their paths differ by {100 * abs(size):.0f} cm that '
                 'the gyro does not explain')
    else:
        event = (f'the {names[int(slips.wheel[worst] > 0)]} wheel '
                 f'{"spins" if size > 0 else "slides"}: {100 * abs(size):.0f} cm '
                 f'{"more" if size > 0 else "less"} than the other wheel and the gyro give')
    others = f'; {n} such places, {np.abs(slips.size).sum():.2f} m in total' if n > 1 else ''
    return (Reason(Code.WHEEL_SLIP, f'{event}, from t = {begin:.1f} s for {duration:.1f} '
                   f's{others}'),)
