# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Regression of the right wheel's path on the left one's, turn and load, over the whole drive.

The right wheel's path is that of the left one, plus track width times turn, plus small terms.
This detects over the whole drive: swapped wheels, one counter published twice, different counters,
a ratio that changes during the drive.
"""

from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats, running_sum, runs
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.wheel_faults import robust_fit, WheelPair
from odocal_ros.settings.levels import TRACK_WIDTH

# statistical: sigmas of a significant difference of wheels: by chance once in 500 million windows;
# a leg has tens of thousands, whose noise is not quite normal
WHOLE_DRIVE_SIGMAS = 6.0
# s, shortest standstill that gives the gyro bias: judgement, its sigma is then 0.01 deg/s
BIAS_REST = 5.0
# rad/s: a faster turn at rest is that of a ferry or a turntable. Physical: consumer IMUs drift by
# 0.5 to 1.3 deg/s
MOST_DRIFT = np.deg2rad(2.0)
MEAN_STEPS = 10     # steps over which speed, turn rate and the ends of a window are averaged: 1 s


def without_gyro_drift(two: WheelPair) -> WheelPair:
    """Return the wheels with the turn rate of standstills, the gyro bias, removed in between."""
    still = two.known & (np.diff(two.left) == 0) & (np.diff(two.right) == 0)
    # half a second after a stop and before a start the body rocks
    rests = [(a + MEAN_STEPS // 2, b - MEAN_STEPS // 2) for a, b in runs(still)
             if (b - a) * two.step >= BIAS_REST]
    if not rests:
        return two
    a, b = np.transpose(rests)
    rate = (two.turn[b] - two.turn[a]) / (two.t[b] - two.t[a])
    own = np.abs(rate - np.median(rate)) < MOST_DRIFT
    bias = np.interp(two.t[:-1], ((two.t[a] + two.t[b]) / 2)[own], rate[own])
    return replace(two, turn=two.turn - running_sum(bias * two.step))


def regressors(two: WheelPair, metres_per_unit: float) -> Floats:
    """
    Return the regressors of the right path, at the edges of the cells: (n, 6).

    The left path, turn and time (gyro bias); speed (delay between the wheels), turn rate (delay to
    the IMU) and the load that sideways acceleration moves from tyre to tyre.
    """
    half = MEAN_STEPS // 2
    mean = (two.left + two.right) / 2
    speed = _smooth(np.gradient(mean, two.step), half)
    rate = _smooth(np.gradient(two.turn, two.step), half)
    load = running_sum(metres_per_unit * (speed**2 * rate)[1:] * two.step)
    return np.stack([two.left, two.turn, two.t - two.t[0], speed, rate, load], -1)


def _smooth(x: Floats, reach: int) -> Floats:
    padded = np.pad(x, reach, mode='edge')
    return np.convolve(padded, np.full(2 * reach + 1, 1 / (2 * reach + 1)), mode='valid')


def fit_signals(two: WheelPair, signals: Floats, metres_per_unit: float,
                ) -> tuple[Floats, Floats] | tuple[None, None]:
    """Return the coefficients of the signals, fitted to cells of a second, and covariance."""
    at = np.arange(0, len(two.t), MEAN_STEPS)
    A, y = np.diff(signals[at], axis=0), np.diff(two.right[at])
    keep = np.logical_and.reduceat(two.known, at[:-1])[:len(y)]
    keep &= np.abs(A[:, 0]) + np.abs(y) > 2 * two.quantum
    if keep.sum() < 20:
        return None, None
    width = TRACK_WIDTH.first_sigma / metres_per_unit
    late = 0.05     # s, sigma of the delay between the wheels, and of wheels to IMU
    load = 2e-3     # s^2/m, of the change of rolling radius by sideways acceleration
    prior = np.array([np.inf, width, np.inf, late, late * 1.5 / metres_per_unit, load])
    prior = np.append(prior, np.full(signals.shape[1] - len(prior), np.inf))
    floor = 0.4 * two.quantum + 1e-3 / metres_per_unit
    x, covariance, _ = robust_fit(A[keep], y[keep], floor, prior)
    return x, covariance


def side_reasons(two: WheelPair, width: float, sigma: float,
                 track_width: float) -> tuple[Reason, ...]:
    if abs(width) + WHOLE_DRIVE_SIGMAS * sigma < max(TRACK_WIDTH.least,
                                                     track_width / 2):
        return (Reason(Code.WHEEL_DEAD, 'both wheels count the same in turns: the track width '
                       f'would be {width:.3f} m, ± {sigma:.2g} m. Likely cause: one counter is '
                       'sent twice'),)
    if width - WHOLE_DRIVE_SIGMAS * sigma <= 0 < width + WHOLE_DRIVE_SIGMAS * sigma:
        return (Reason(Code.ODOMETER_CHOSEN, 'too few turns to test whether left and right wheel '
                       f'are swapped (track width from turns {width:.2f} ± {sigma:.2g} m): the '
                       'configured sides are used'),)
    if width > -TRACK_WIDTH.least:
        return ()
    return (Reason(Code.WHEELS_SWAPPED, f'the {two.names[0]} wheel travels farther in left turns '
                   f'(track width {width:.2f} m, ± {sigma:.2g} m)'),)


def find_ratio_change(two: WheelPair, signals: Floats, metres_per_unit: float,
                      count: int) -> tuple[tuple[Reason, ...], float]:
    """
    Return a reason if the wheels' ratio differs before and after a place of the path, and by what.

    The change at half the path, that sigmas must include, 0 for none.   count : number of wheels
    in the mean.
    """
    path = running_sum(np.abs(np.diff(two.left)))
    best = (0.0, 0.0, 0.0, 0)
    for share in np.arange(1, 8) / 8:       # of the path
        at = int(np.searchsorted(path, share * path[-1]))
        late = np.where(np.arange(len(path)) > at, two.left - two.left[at], 0.0)
        x, covariance = fit_signals(two, np.column_stack([signals, late]), metres_per_unit)
        if x is None or covariance is None or x[0] <= 0:
            continue
        change, sigma = x[-1] / x[0], np.sqrt(covariance[-1, -1]) / x[0]
        least = max(2e-3, WHOLE_DRIVE_SIGMAS * sigma)       # tyres warm up equally within it
        if abs(change) > least and abs(change) / sigma > best[0]:
            best = (abs(change) / sigma, float(change), share, at)
    odds, change, share, at = best
    if not change:
        return (), 0.0
    # correct before or after: the fit is between, (1 - share) of the change from that before
    held = float(change * np.sqrt(2 * (share**2 + (1 - share)**2)))
    left, right = two.names
    return (Reason(Code.WHEEL_SLIP, f'from t = {two.t[at]:.0f} s on, after about '
                   f'{100 * share:.0f} % of the path, the {right} wheel counts '
                   f'{100 * abs(change):.2f} % (± {100 * abs(change) / odds:.2f}) '
                   f'{"more" if change > 0 else "less"} relative to the {left} wheel and the '
                   'gyro. Likely cause: continuous slip or a tyre that loses pressure. Which '
                   'section is correct cannot be decided from the data: '
                   f'{50 / count * abs(held):.2f} % is added to the uncertainty of the scale, '
                   f'{50 * abs(held):.2f} % to that of each wheel'),), held


def counter_reasons(two: WheelPair, ratio: float, width: float,
                    limit: float) -> tuple[Reason, ...]:
    """Return a reason if one wheel counts far more: the mean is not at the axle's middle."""
    if max(ratio, 1 / ratio) <= 1 + limit:
        return ()
    # the mean count weights each wheel by its counts per metre
    off = (ratio / (1 + ratio) - 0.5) * width
    left, right = two.names
    return (Reason(Code.WHEEL_COUNTERS_DIFFER, f'the {right} wheel counts {ratio:.3f} times as '
                   f'much as the {left} wheel: the scale refers to the mean count, at a point '
                   f'{abs(off):.2f} m {"right" if off > 0 else "left"} of the axle centre'),)
