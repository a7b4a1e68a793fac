# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Regression of the right wheel's path on the left wheel's path, the turn and the load.

The right path is the ratio of the counters times the left path, plus track width times turn, plus
small terms. Over the whole drive it shows swapped wheels, one counter that is published twice,
different counters, and a ratio that changes.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from odocal_ros.data.arrays import Floats, running_sum, runs
from odocal_ros.nav.time_series import running_mean
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.robust_fit import robust_fit
from odocal_ros.screening.wheel_faults import SENT_TWICE_REMEDY, WheelPair
from odocal_ros.settings.levels import TRACK_WIDTH

# statistical: sigmas of a significant difference of wheels: by chance once in 500 million windows;
# a leg has tens of thousands, whose noise is not quite normal
WHOLE_DRIVE_SIGMAS = 6.0
# s, shortest standstill that gives the gyro bias: judgement, its sigma is then 0.01 deg/s
BIAS_REST = 5.0
# rad/s: a faster turn at rest is that of a ferry or a turntable. Physical: consumer IMUs drift by
# 0.5 to 1.3 deg/s
MAX_DRIFT = np.deg2rad(2.0)
# judgement: steps of the pair, 0.1 s each, over which speed and turn rate are averaged; also a
# cell of the fit
MEAN_STEPS = 10
MIN_FIT_CELLS = 20      # judgement: least number of cells of a fit
# priors of the fit: s, sigma of the delay between the wheels, and of wheels to IMU, by drivers'
# delays; s^2/m, sigma of the change of rolling radius by sideways acceleration. Physical
PAIR_DELAY_SIGMA, LOAD_SIGMA = 0.05, 2e-3
PAIR_DELAY_WIDTH = 1.5       # m, judgement: a delay to the IMU acts as this track width times it
# least sigma of the travel in a cell, counts and m: judgement, rounding of one edge, and a bump
MIN_TRAVEL_SIGMA = 0.4, 1e-3


def without_gyro_drift(pair: WheelPair) -> WheelPair:
    """Return the wheels with the gyro bias, measured at standstills, removed from the turn."""
    still = pair.is_complete & (np.diff(pair.left) == 0) & (np.diff(pair.right) == 0)
    # half a second after a stop and before a start the body rocks
    rests = [(begin + MEAN_STEPS // 2, end - MEAN_STEPS // 2) for begin, end in runs(still)
             if (end - begin) * pair.cell_s >= BIAS_REST]
    if not rests:
        return pair
    begin, end = np.transpose(rests)
    rate = (pair.turn[end] - pair.turn[begin]) / (pair.t[end] - pair.t[begin])
    is_bias = np.abs(rate - np.median(rate)) < MAX_DRIFT
    middle = (pair.t[begin] + pair.t[end]) / 2
    bias = np.interp(pair.t[:-1], middle[is_bias], rate[is_bias])
    return replace(pair, turn=pair.turn - running_sum(bias * pair.cell_s))


def right_path_regressors(pair: WheelPair, metres_per_unit: float) -> Floats:
    """
    Return the regressors of the right path, at the edges of the cells: (n, 6).

    The left path (coefficient: ratio), turn (track width in scale units) and time (gyro bias);
    speed (delay between the wheels), turn rate (delay to the IMU) and the load that sideways
    acceleration moves from tyre to tyre.
    """
    mean = (pair.left + pair.right) / 2
    speed, rate = (running_mean(np.gradient(x, pair.cell_s), MEAN_STEPS // 2)
                   for x in (mean, pair.turn))
    load = running_sum(metres_per_unit * (speed**2 * rate)[1:] * pair.cell_s)
    return np.stack([pair.left, pair.turn, pair.t - pair.t[0], speed, rate, load], -1)


def fit_right_path(pair: WheelPair, regressors: Floats, metres_per_unit: float,
                   ) -> tuple[Floats, Floats] | None:
    """
    Return coefficients, (k,), and their covariance; None with few cells or a ratio below 0.

    regressors : (n, k) those of ``right_path_regressors`` first.
    """
    edges = np.arange(0, len(pair.t), MEAN_STEPS)      # of cells of a second
    design, y = np.diff(regressors[edges], axis=0), np.diff(pair.right[edges])
    keep = np.logical_and.reduceat(pair.is_complete, edges[:-1])[:len(y)]
    keep &= np.abs(design[:, 0]) + np.abs(y) > 2 * pair.quantum
    if keep.sum() < MIN_FIT_CELLS:
        return None
    width_sigma = TRACK_WIDTH.comparison_sigma / metres_per_unit
    prior = np.array([np.inf, width_sigma, np.inf, PAIR_DELAY_SIGMA,
                      PAIR_DELAY_SIGMA * PAIR_DELAY_WIDTH / metres_per_unit, LOAD_SIGMA])
    prior = np.append(prior, np.full(regressors.shape[1] - len(prior), np.inf))
    counts, metres = MIN_TRAVEL_SIGMA
    min_sigma = counts * pair.quantum + metres / metres_per_unit
    x, covariance, _ = robust_fit(design[keep], y[keep], min_sigma, prior)
    return (x, covariance) if x[0] > 0 else None


def side_reasons(pair: WheelPair, width: float, sigma: float,
                 track_width: float) -> tuple[Reason, ...]:
    """
    Return WHEEL_DEAD, WHEELS_SWAPPED or ODOMETER_CHOSEN, else ().

    width, sigma : track width by the regression, m; negative if the sides are swapped.
    track_width : m, as configured; 0 unknown.
    """
    if abs(width) + WHOLE_DRIVE_SIGMAS * sigma < max(TRACK_WIDTH.minimum, track_width / 2):
        return (Reason(Code.WHEEL_DEAD, 'both wheels count the same in turns: the track width '
                       f'would be {width:.3f} ± {sigma:.2g} m. Likely cause: one counter is '
                       'sent twice', SENT_TWICE_REMEDY),)
    if width - WHOLE_DRIVE_SIGMAS * sigma <= 0 < width + WHOLE_DRIVE_SIGMAS * sigma:
        return (Reason(Code.ODOMETER_CHOSEN, 'too few turns to test whether left and right wheel '
                       f'are swapped (track width from turns {width:.2f} ± {sigma:.2g} m): the '
                       'configured sides are used'),)
    if width > 0:
        return ()
    return (Reason(Code.WHEELS_SWAPPED, f'the {pair.names[0]} wheel travels farther in left turns '
                   f'(track width {width:.2f} ± {sigma:.2g} m)'),)


class RatioChange(NamedTuple):
    """A change of the ratio of the wheels at a place of the path."""

    sigmas: float      # size of the change in sigmas
    change: float      # relative
    share: float       # of the path that is before the change
    row: int           # of the pair, at the change


def find_ratio_change(pair: WheelPair, regressors: Floats, metres_per_unit: float,
                      wheel_count: int) -> tuple[tuple[Reason, ...], float]:
    """
    Return a reason if the ratio of the wheels changes at a place of the path, and the change.

    The change is converted to one at half the path, which sigmas must include; 0 for none.
    wheel_count : number of wheels in the mean.
    """
    path = running_sum(np.abs(np.diff(pair.left)))
    best: RatioChange | None = None
    for share in np.arange(1, 8) / 8:       # tested places, shares of the path
        row = int(np.searchsorted(path, share * path[-1]))
        left_after = np.where(np.arange(len(path)) > row, pair.left - pair.left[row], 0.0)
        fit = fit_right_path(pair, np.column_stack([regressors, left_after]), metres_per_unit)
        if fit is None:
            continue
        x, covariance = fit
        change, sigma = x[-1] / x[0], np.sqrt(covariance[-1, -1]) / x[0]
        # 2e-3: tyres that warm up differently change the ratio by less
        limit = max(2e-3, WHOLE_DRIVE_SIGMAS * sigma)
        if abs(change) > limit and (best is None or abs(change) / sigma > best.sigmas):
            best = RatioChange(abs(change) / sigma, float(change), share, row)
    if best is None:
        return (), 0.0
    sigmas, change, share, row = best
    # if the change is at ``share`` of the path, the mean ratio is wrong by (1 - share) of it (the
    # ratio before is correct) or by share of it: rms of both, scaled to 1 at a share of half
    at_half = float(change * np.sqrt(2 * (share**2 + (1 - share)**2)))
    half = 50 * abs(at_half)      # %, of the change
    left, right = pair.names
    return (Reason(Code.WHEEL_SLIP, f'from t = {pair.t[row]:.0f} s on, after about '
                   f'{100 * share:.0f} % of the path, the {right} wheel counts '
                   f'{100 * abs(change):.2f} ± {100 * abs(change) / sigmas:.2f} % '
                   f'{"more" if change > 0 else "less"} relative to the {left} wheel and the '
                   'gyro. Likely cause: continuous slip or a tyre that loses pressure. Which '
                   'section is correct cannot be decided from the data: '
                   f'{half / wheel_count:.2f} % is added to the uncertainty of the scale, '
                   f'{half:.2f} % to that of each wheel'),), at_half


def counter_reasons(pair: WheelPair, ratio: float, width: float,
                    limit: float) -> tuple[Reason, ...]:
    """Return a reason if one wheel counts far more: the mean is not at the axle's middle."""
    if max(ratio, 1 / ratio) <= 1 + limit:
        return ()
    # the mean count weights each wheel by its counts per metre
    offset = (ratio / (1 + ratio) - 0.5) * width
    left, right = pair.names
    return (Reason(Code.WHEEL_COUNTERS_DIFFER, f'the {right} wheel counts {ratio:.3f} times as '
                   f'much as the {left} wheel: the scale refers to the mean count, at a point '
                   f'{abs(offset):.2f} m {"right" if offset > 0 else "left"} of the axle centre',
                   'Check the counts per revolution and the tyre size of both wheels.'),)
