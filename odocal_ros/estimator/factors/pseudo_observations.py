# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Factors without a sensor: priors and standstills.

``PriorRows`` are the priors of the biases, the constants and the first keyframe, docs/method.md
(S21), and estimate the sizes of imperfections, (S28). ``StandstillRows`` state that the vehicle
has no velocity at a keyframe in a standstill, and does not turn between two of them, (S20).
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.estimator import state as layout
from odocal_ros.estimator.chain import JointMarginals, NormalEquations
from odocal_ros.estimator.factors import factor
from odocal_ros.estimator.factors.point_rows import TAIL_SIGMAS
from odocal_ros.estimator.levels import LevelRightHandSides, Levels
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import PHI, V
from odocal_ros.nav.rotations import rotvec, transpose

# sizes of imperfections, factors on their usual variances: names of the levels, and their prior
# median. Judgement: usual sizes are those of data sheets, which most sensors keep
SIZES, SIZE = tuple(f'size_{kind}' for kind in layout.KIND_SIZES), 0.5
# prior sigmas of the logarithms of sizes. Tuned: with 2, pitch is up to 5.2 sigma off in 113
# drives, with 1, 2.8 (docs/decisions/0016). Most receivers have no odometer, others one with an
# error of up to 2 %, which is 6 in the logarithm: with 1, the sigma of the scale is up to 2.8
# times as large in drives without one, with 3, 1.7 times (docs/decisions/0019)
SIZE_SPREADS = dict.fromkeys(SIZES, 1.0) | {'size_fix_error_by_motion': 3.0}
# definition: values of the logarithm of a size over which its posterior is integrated
LOG_SIZES = np.arange(np.log(1e-6), np.log(1e6), 0.05)
# priors of the first keyframe: m, m/s, rad about east, north, up. Judgement: far wider than any
# data
START_SIGMAS = ((layout.P, 1e4), (layout.V, 100.0), (layout.PHI, np.array([1.0, 1.0, 10.0])))
# definition: column of the height, and its prior, m, if no fix has a height; with 1e4 m the
# rounding error is too large
HEIGHT, HEIGHT_START_SIGMA = slice(layout.P.stop - 1, layout.P.stop), 1.0
# constants that all legs of a vehicle share, by source in the budget
SHARED: dict[str, slice | Ints] = {
    'odometer_lever_arm': layout.ODO_ARM, 'antenna_lever_arm': layout.GNSS_ARM,
    'odometer_delay': np.array([layout.ODO_DELAY, layout.ODO_CLOCK, layout.ODO_LAG2]),
    'fix_latency': np.array([layout.GNSS_DELAY, layout.GNSS_CLOCK]),
    'gyro_scale': layout.constants_from('gyro_scale_z', 'gyro_scale_y'),
    'gyro_axes': layout.constants_from('gyro_axis_xy', 'gyro_axis_zy'),
    'gyro_by_force': layout.constants_from('gyro_x_by_force_x', 'gyro_z_by_force_y'),
    'accelerometer_scale': layout.constants_from('accelerometer_scale_x', 'accelerometer_scale_z'),
    'accelerometer_axes': layout.constants_from('accelerometer_axis_xy', 'accelerometer_axis_yz'),
    'receiver_smoothing': np.array([layout.FIX_LAG2, layout.FIX_BY_MOTION,
                                    layout.FIX_MOTION_TIME]),
    'tyre_changes': layout.TYRES,
    'body_lean': layout.constants_from('scale_by_pitching', 'sway_by_force'),
    'speed_truncation': layout.constants_from('speed_offset'),
    'heading': layout.constants_from('heading_offset'), 'velocity': layout.VELOCITY}
# motion of a vehicle at rest, 1 sigma: m/s, and rad/sqrt(s) about east, north, up. Judgement:
# wind, an engine and people move it on its springs, and tilt it more than they turn it
STILL_SPEED, STILL_TURN = 0.005, np.array([1e-4, 1e-4, 2e-5])


class PriorRows(factor.Factor):
    """Rows of the priors: unknown minus prior mean."""

    name = 'priors'

    def __init__(self, problem: Problem, point: factor.LinearisationPoint) -> None:
        self.state, self.usual_priors = point.state, point.priors
        self.unshared = problem.unshared_constants | {
            'slow_fix_errors': layout.FIX_ERRORS, 'vertical_motion': layout.GROUND}
        self.no_heights = bool(np.isnan(problem.leg.fixes_n[:, 2]).all())
        self.shared = {name: indices for name, indices in SHARED.items()
                       if (problem.priors.sigma[indices] > layout.NO_ERROR).any()}

    @classmethod
    def initial_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        return dict.fromkeys(SIZES, SIZE), dict.fromkeys(SIZES, 1e-6)

    def weigh(self, levels: Levels) -> None:
        """Multiply the usual variances of the imperfections by their sizes, (S28)."""
        size = np.array([levels[name] for name in SIZES])[layout.KIND_OF]
        sigma = self.usual_priors.sigma.copy()
        sigma[layout.IMPERFECTIONS] *= np.sqrt(size)
        self.priors = replace(self.usual_priors, sigma=sigma)
        self.log_R = float(np.log(size).sum())

    def sizes(self, marginals: JointMarginals) -> dict[str, float]:
        """
        Return the size of each kind of imperfections, given all other unknowns, (S29).

        It is the mean of the posterior, or for a rare effect, with a wide prior, its maximum: the
        mean would be that of the few vehicles with this effect. An imperfection is weighted by the
        share of the drive in its information; otherwise model errors would change the size of an
        imperfection that is hardly observable.
        """
        rows = 2 * self.n + np.arange(layout.IMPERFECTIONS.start, layout.IMPERFECTIONS.stop)
        usual = self.usual_priors.sigma[layout.IMPERFECTIONS]**2
        weight = 1 / self.priors.sigma[layout.IMPERFECTIONS]**2
        # information in total and from the drive, and the share of the latter
        total = 1 / marginals[0][rows, rows]
        data = np.maximum(total - weight, 1e-9 * total)     # smaller differences are rounding
        share = data / (data + 1 / (SIZE * usual))
        z2 = (self._deviations()[layout.IMPERFECTIONS] * total / data)**2
        variance = np.exp(LOG_SIZES)[:, None] * usual + 1 / data
        kinds = np.eye(len(SIZES))[layout.KIND_OF]
        spread = np.array([SIZE_SPREADS[name] for name in SIZES])
        # -2 ln of the posterior density, for each value of LOG_SIZES and each kind
        cost = (share * (z2 / variance + np.log(variance))) @ kinds + (
            (LOG_SIZES[:, None] - np.log(SIZE)) / spread)**2
        most_likely = np.exp(LOG_SIZES[np.argmin(cost, axis=0)])
        mean = np.average(np.broadcast_to(np.exp(LOG_SIZES)[:, None], cost.shape), axis=0,
                          weights=np.exp((cost.min(axis=0) - cost) / 2))
        return dict(zip(SIZES, np.where(spread > 1, most_likely, mean).tolist(), strict=True))

    def add_levels(self, out: LevelRightHandSides) -> None:
        columns = out.columns(SIZES)
        deviation = self._deviations()[layout.IMPERFECTIONS]
        sigma = self.priors.sigma[layout.IMPERFECTIONS]
        kinds = np.eye(len(SIZES))[layout.KIND_OF]
        out.g_constants[layout.IMPERFECTIONS, columns] += kinds * (deviation / sigma**2)[:, None]
        out.q_products[columns, columns] += kinds.T @ (deviation / sigma)**2

    def _biases(self) -> Iterator[tuple[slice, Floats, Floats]]:
        """Yield columns, value and sigma of the biases at the first keyframe."""
        state, priors = self.state, self.priors
        yield layout.BG, state.gyro_bias[0], priors.gyro_bias_sigma
        yield layout.BA, state.accel_bias[0], priors.accel_bias_sigma

    def _deviations(self) -> Floats:
        """Return the constants minus their prior means: (M,)."""
        return self.state.constants - self.priors.mean

    def add(self, out: NormalEquations) -> None:
        # the first keyframe has a wide prior, with its value as mean
        for columns, sigma in START_SIGMAS:
            factor.add_prior(out, 0, columns, sigma**2, 0.0)
        if self.no_heights:
            factor.add_prior(out, 0, HEIGHT, HEIGHT_START_SIGMA**2, 0.0)
        for columns, value, sigma in self._biases():
            factor.add_prior(out, 0, columns, sigma**2, value)
        w, m = 1 / self.priors.sigma**2, self.m
        out.corner[range(m), range(m)] += w[:m]
        out.g_constants -= (w * self._deviations())[:m]
        out.unused_weights = w[m:]

    def cost(self) -> float:
        total = sum((value**2 / sigma**2).sum() for _, value, sigma in self._biases())
        return float(total + (self._deviations()**2 / self.priors.sigma**2).sum())

    def effects(self, marginals: JointMarginals) -> Iterator[tuple[str, Floats]]:
        first = self.parameter_covariances(marginals[0][None])[0]
        yield 'gyro_bias', first[:, layout.BG] / self.priors.gyro_bias_sigma
        yield 'accelerometer_bias', first[:, layout.BA] / self.priors.accel_bias_sigma
        for name, indices in self.unshared.items():
            if indices.stop <= self.m:
                yield name, first[:, 2 * self.n:][:, indices] / self.priors.sigma[indices]

    def shared_effects(self, covariance: Floats) -> Iterator[tuple[str, Floats]]:
        """Yield sources that all legs share, as ``effects``; covariance : (M, M) of constants."""
        for name, indices in self.shared.items():
            yield name, covariance[:factor.PARAMETER_COUNT, indices] / self.priors.sigma[indices]


class StandstillRows(factor.Factor):
    """Rows of the velocity of keyframes at rest, and of the turn of intervals at rest."""

    name = 'standstills'

    def __init__(self, problem: Problem, point: factor.LinearisationPoint) -> None:
        self.state, self.at_rest = point.state, problem.at_rest
        self.intervals_at_rest = self.at_rest[:-1] & self.at_rest[1:]
        variance = STILL_TURN**2 * point.intervals.T[:, None]
        z2 = (self.turn()**2 / variance).mean(axis=1, keepdims=True)
        self.turn_variance = variance * np.maximum(z2 / TAIL_SIGMAS**2, 1.0)

    def turn(self) -> Floats:
        """Return the rotation vector of each interval, in n: (K, 3) rad."""
        C = self.state.C_nb
        return rotvec(C[1:] @ transpose(C[:-1]))

    def add(self, out: NormalEquations) -> None:
        weight = self.at_rest[:, None] / STILL_SPEED**2
        factor.add_prior(out, slice(None), V, 1.0, self.state.v_n, weight)
        factor.add_process(out, PHI, 1.0, self.intervals_at_rest[:, None] / self.turn_variance,
                           self.turn())

    def cost(self) -> float:
        rest = self.intervals_at_rest
        return float((self.state.v_n[self.at_rest]**2).sum() / STILL_SPEED**2
                     + (self.turn()[rest]**2 / self.turn_variance[rest]).sum())
