# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Residuals of each sensor after the fit, as details of the result, and wheel slip.

A slip is a run of intervals in which the path of the wheel is an outlier.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import blocks, Floats
from odocal_ros.estimator.chain import JointMarginals
from odocal_ros.estimator.equations import WeightedEquations
from odocal_ros.estimator.factors.gnss import Fixes
from odocal_ros.estimator.factors.interval_noise import ABSENT_VARIANCE, accelerating_and_turning
from odocal_ros.estimator.factors.motion import D
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import BA, BG, PHI, V
from odocal_ros.nav.rotations import transpose
from odocal_ros.nav.time_series import interpolated
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS

INTERVAL_SENSORS = ('odometer', 'gyro', 'accelerometer')
# variance factor of an interval above which it is a slip. Statistical: 3.7 sigmas, by chance once
# in 4200
SLIP_VARIANCE = 1.5
MIN_REPORTED_SLIP = 0.05    # m, judgement: a shorter slip is not reported
# judgement: least error of the distances between fixes, relative, and least share of their squared
# residuals that it explains. Explained are 0.87 and 0.96 of fixes 2 and 1.3 times as far apart, at
# most 0.06 in 17 simulated drives and three real ones
MIN_DISTANCE_ERROR, MIN_EXPLAINED_BY_RATIO = 0.1, 0.5
# redundancy above which a level is reported. Statistical: its root, with a sigma of root / sqrt(2
# redundancy), is then REMARK_SIGMAS above zero
LEVEL_ROWS = REMARK_SIGMAS**2 / 2
# judgement: sigmas of the noise above which its sum is unexplained. It is 3.0 if 3 % of the pulses
# are lost in the fastest 15 % of the time, at most 0.2 in 17 simulated drives, 1.7 in real ones
UNEXPLAINED_SIGMAS = 2.0


def bias_sigmas(marginals: JointMarginals, factor: float) -> Floats:
    """Return the bias sigmas times ``factor``: (2, N, 3), gyro first, rad/s, m/s^2."""
    variance = marginals.variances()
    return np.sqrt(np.stack([variance[:, BG], variance[:, BA]])) * factor


def stored_residuals(leg: SmootherLeg, problem: Problem, fit: Fit) -> dict[str, NDArray[Any]]:
    """
    Return the residuals of each sensor, fitted less measured, and the sigmas of its noise.

    Arrays by name, (n, 6): three residuals and their sigmas; NaN: no data. For each interval, at
    its end: ``residual_odometer`` forward, left, up, m; ``residual_gyro`` and
    ``residual_accelerometer``, means in b, rad/s and m/s^2. ``residual_fix``, for each used fix,
    at ``residual_fix_t``, s: east, north, up, m, without the time-correlated error. Single
    precision, to save memory.
    """
    residuals = {**_interval_residuals(fit), 'fix': _fix_residuals(fit)}
    return {f'residual_{name}': np.concatenate(pair, axis=1).astype(np.float32)
            for name, pair in residuals.items()
            } | {'residual_fix_t': leg.t_fix[problem.used_fixes]}


def correlation(t: Floats, residual: Floats) -> float:
    """Return the correlation of means over adjacent 2 s; t : (m,) s.   residual : (m, c)."""
    if len(t) < 4:
        return 0.0
    bins, first = np.unique(np.floor((t - t[0]) / 2.0).astype(int), return_index=True)
    count = np.diff(np.append(first, len(t)))
    mean = np.add.reduceat(residual, first, axis=0) / np.sqrt(count)[:, None]
    adjacent = np.flatnonzero(np.diff(bins) == 1)
    power = (mean**2).mean()
    if len(adjacent) < 5 or power == 0:
        return 0.0
    return float((mean[adjacent] * mean[adjacent + 1]).mean() / power)


def normalised_residuals(weighted: WeightedEquations) -> dict[str, dict[str, float]]:
    """Return rms, number and outlier share of whitened residuals, without weights, by sensor."""
    motion, fixes = weighted[MotionRows].r, weighted[Fixes]
    white = fixes.r / np.sqrt(fixes.weight / fixes.rows_per_independent)
    return {name: {'rms': float(np.sqrt((r**2).mean())), 'rows': r.size,
                   'beyond_3_sigma': float((np.abs(r) > 3).mean())}
            for name, r in (('gyro', motion[:, PHI]), ('accelerometer', motion[:, V]),
                            ('odometer', motion[:, D]), ('fixes, level', white[:, :2]))}


def _interval_residuals(fit: Fit) -> dict[str, tuple[Floats, Floats]]:
    """Return residuals and sigmas of odometer, gyro and accelerometer: (K, 3) each."""
    rows = fit.weighted[MotionRows]
    T, C, C_end = rows.motion.T, rows.motion.C, rows.motion.C_end
    out = {name: np.empty((2, len(rows.r), 3)) for name in INTERVAL_SENSORS}
    for chunk in blocks(len(rows.r)):
        root = np.linalg.inv(rows.whiten[chunk])
        raw, Q = root @ rows.r[chunk, :, None], root @ np.swapaxes(root, 1, 2)
        per_T = 1 / T[chunk, :, None]
        for name, row, axes in (('odometer', D, rows.noise.axes[chunk]),
                                ('gyro', PHI, transpose(C_end[chunk]) * per_T),
                                ('accelerometer', V, transpose(C[chunk]) * per_T)):
            variance = np.einsum('kij,kjl,kil->ki', axes, Q[:, row, row], axes)
            out[name][:, chunk] = (axes @ raw[:, row])[:, :, 0], np.sqrt(variance)
    absent = out['odometer'][1]**2 > ABSENT_VARIANCE / 2
    out['odometer'][:, absent] = np.nan
    return {name: (value, sigma) for name, (value, sigma) in out.items()}


def _fix_residuals(fit: Fit) -> tuple[Floats, Floats]:
    """Return residuals and sigmas of the fixes: (m, 3) each."""
    fixes = fit.weighted[Fixes]
    covariance_root = np.linalg.inv(fixes.whitening)
    factor = np.ones(3)
    for level, columns in fixes.level_columns.items():
        factor[columns] = np.sqrt(fixes.levels[level])
    scale = np.sqrt(fixes.weight / fixes.rows_per_independent) / factor
    value = -(covariance_root @ (fixes.r / scale)[:, :, None])[:, :, 0]
    sigma = np.sqrt(covariance_root**2 @ factor**2)
    exists = fixes.existing_components()
    return np.where(exists, value, np.nan), np.where(exists, sigma, np.nan)


@dataclass(frozen=True)
class Slip:
    """A run of intervals with slip."""

    t: float            # s since the start mark
    duration: float     # s
    metres: float       # travel of the wheel minus travel of the vehicle


def odometer_minus_ground_path(fit: Fit, marginals: JointMarginals) -> Floats:
    """Return odometer path minus ground path in each interval, m: (K,)."""
    rows = fit.weighted[MotionRows]
    estimate, _ = rows.road_noise(marginals)
    return -estimate[:, 0] * rows.along_sigma()


def find_slips(fit: Fit, slip_path: Floats, count_m: float) -> tuple[Slip, ...]:
    """Return the slips, largest first; slip_path : (K,) m.   count_m : size of a count, m."""
    t, limit = fit.state.t, max(MIN_REPORTED_SLIP, count_m)
    slipping = np.flatnonzero((fit.variance_factors[:, 0] > SLIP_VARIANCE)
                              | (np.abs(slip_path) > max(4 * np.sqrt(fit.levels['along']), limit)))
    if not len(slipping):
        return ()
    slips = []
    for run in np.split(slipping, np.flatnonzero(np.diff(slipping) > 2) + 1):   # at most 1 s apart
        begin, end, metres = run[0], run[-1] + 1, float(slip_path[run].sum())
        if abs(metres) >= max(4 * np.sqrt(fit.levels['along'] * (t[end] - t[begin])), limit):
            slips.append(Slip(float(t[begin]), float(t[end] - t[begin]), metres))
    return tuple(sorted(slips, key=lambda s: -abs(s.metres)))


def fix_distance_text(problem: Problem, fit: Fit) -> str:
    """Return the ratio of distances between fixes to those of the track as text, '' if 1."""
    leg, used = problem.leg, problem.used_fixes
    track, fixes = (x - x.mean(axis=0) for x in (
        interpolated(leg.t_fix[used], fit.state.t, fit.state.p_n[:, :2]), leg.fixes_n[used, :2]))
    # least squares: fixes = ratio times track
    size = max(float((track**2).sum()), 1e-9)
    ratio = float((track * fixes).sum()) / size
    explained = (ratio - 1)**2 * size / max(float(((fixes - track)**2).sum()), 1e-9)
    if abs(ratio - 1) < MIN_DISTANCE_ERROR or explained < MIN_EXPLAINED_BY_RATIO:
        return ''
    return (f'the fixes are {ratio:.2f} times as far apart as IMU and odometer measure (limit '
            f'{1 + MIN_DISTANCE_ERROR * np.sign(ratio - 1):.1f})')


def path_length(fit: Fit) -> float:
    """Return the path length of the odometer, m."""
    return float(np.linalg.norm(fit.weighted[MotionRows].motion.displacement, axis=1).sum())


class UnexplainedTravel(NamedTuple):
    """Travel that the fit explains by noise of one sign, docs/method.md (S31)."""

    metres: float       # travel of the vehicle minus travel of the odometer
    sigmas: float       # in sigmas of the sum of noise without a sign
    share: float        # of the path
    error: float        # its part beyond the noise, of the path: an error of ln K
    is_steady: bool     # mostly at constant speed, not while accelerating or braking

    def reason(self) -> Reason:
        """Return TRAVEL_MISSING or TRAVEL_EXCESS."""
        code, relation = (Code.TRAVEL_MISSING, 'less') if self.metres > 0 else (
            Code.TRAVEL_EXCESS, 'more')
        condition = 'at constant speed' if self.is_steady else 'while accelerating or braking'
        cause = ('a counter that loses pulses, or a limited speed value, at some speeds'
                 if self.metres > 0 else 'slip, or pulses that are counted twice')
        return Reason(code, (
            f'the odometer counts {abs(self.metres):.1f} m ({100 * abs(self.share):.2g} % of the '
            f'path) {relation} than the vehicle moves, mostly {condition}: {abs(self.sigmas):.1f} '
            f'sigma of its noise (limit {UNEXPLAINED_SIGMAS:g}). The scale is from the other '
            'seconds'),
            f'Likely cause: {cause}. Compare the odometer with the fixes at these speeds. The '
            'uncertainty was increased.')


def find_unexplained_travel(fit: Fit, slip_path: Floats) -> UnexplainedTravel | None:
    """Return the unexplained travel, None without; slip_path : ``odometer_minus_ground_path``."""
    # slips are outliers, and counted as such
    rows, has_no_slip = fit.weighted[MotionRows], fit.variance_factors[:, 0] <= SLIP_VARIANCE
    accelerating, _ = accelerating_and_turning(rows.motion)
    travel = np.where(has_no_slip, -slip_path, 0.0)
    metres, sigma = float(travel.sum()), float(np.linalg.norm(rows.along_sigma()[has_no_slip]))
    if abs(metres) <= UNEXPLAINED_SIGMAS * sigma:    # at rest, or if all slip, both are 0
        return None
    # 0 at the limit: without a step of the sigma of the scale
    error = np.sqrt(metres**2 - (UNEXPLAINED_SIGMAS * sigma)**2)
    steady = abs(travel[~accelerating].sum()) > abs(travel[accelerating].sum())
    return UnexplainedTravel(
        metres, metres / sigma, metres / path_length(fit), float(error / path_length(fit)),
        bool(steady))


def describe_slip_level(fit: Fit, marginals: JointMarginals, count_m: float) -> str:
    """Return the slip level while accelerating or braking as text, '' if small or unknown."""
    level = fit.levels.sigmas()
    # the noise of the difference of two readings, over a phase of 10 s
    rounding = count_m * np.sqrt(2 / 12) / np.sqrt(10.0)
    # a level without information keeps its initial value
    observed = {name for name, (_, redundancy) in fit.weighted[MotionRows].components(
        marginals).items() if redundancy > LEVEL_ROWS}
    # m/sqrt(s), and factor on the level at constant speed: without slip it is smaller
    if 'along_hard' not in observed or level['along_hard'] <= max(
            0.006, 3 * level['along'], rounding):
        return ''
    constant_speed = f', {1e3 * level["along"]:.1f} mm/√s at constant speed' * (
        'along' in observed)
    return ('slip while accelerating or braking is about '
            f'{1e3 * level["along_hard"]:.0f} mm/√s{constant_speed}')


def slip_reasons(slips: tuple[Slip, ...], level: str) -> list[Reason]:
    """Return WHEEL_SLIP with times and sizes; level : of ``describe_slip_level``."""
    texts, max_listed = [], 3
    if slips:
        sizes = [f'{s.metres:+z.2f} m at t = {s.t:.0f} s for {s.duration:.0f} s'
                 for s in slips[:max_listed]]
        more = f' and {len(slips) - max_listed} more' * (len(slips) > max_listed)
        texts.append('wheel slip, travel of the wheel minus travel of the vehicle: '
                     + ', '.join(sizes) + more)
    if level:
        texts.append(level)
    return [Reason(Code.WHEEL_SLIP, '; '.join(texts))] if texts else []
