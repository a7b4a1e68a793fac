# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The factor of time-correlated ('slow') fix errors, docs/method.md (S17): a Gauss-Markov process.

The error s of a keyframe is decay times that of the keyframe before, plus driving noise, which is
independent in each interval. The rows of the fixes (gnss.py) contain s.
"""

from collections.abc import Iterator

import numpy as np
from scipy.linalg import solveh_banded

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import JointMarginals, NormalEquations
from odocal_ros.estimator.factors import factor
from odocal_ros.estimator.levels import LevelRightHandSides, Levels
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import SLOW

# prior of the correlation time, log-normal: s, and sigma of the logarithm. Physical: errors of
# receivers in open terrain last for one or several minutes (docs/decisions/0009)
USUAL_TIME, TIME_SPREAD = 100.0, 0.6
WHITE_SHARE = 0.2       # judgement: initial white share of the variance; the slow share is 0.9


class SlowError(factor.Factor):
    """
    Rows of the driving noise of each interval, and of the first value.

    Levels slow (east, north), slow_up: the spectral density of the driving noise, m^2/s; the
    stationary variance is the density times half the correlation time. The time, s, is a level
    unless it is configured.
    """

    name = 'slow'

    def __init__(self, problem: Problem, point: factor.LinearisationPoint) -> None:
        self.state, self.T = point.state, problem.drift_time
        self.jump = 1.0 if point.variance_factors is None else point.variance_factors[:,
                                                                                      factor.JUMP:]
        self.time_is_fixed = not np.isnan(problem.correlation_time)
        # first intervals of runs whose last interval has a fix
        ends = np.bincount(point.points['fixes'].interval, minlength=len(self.T)) > 0
        self.runs = np.flatnonzero(np.append(True, ends[:-1] | ends[1:]))

    @classmethod
    def initial_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        density = 2 * problem.fix_sigma**2 / USUAL_TIME
        return {'slow': density, 'slow_up': 4 * density}, {
            **dict.fromkeys(('slow', 'slow_up'), 2 * problem.min_fix_sigma**2 / USUAL_TIME),
            'correlation_time': 5.0}      # s: shorter times are not separable from white noise

    def is_used(self, levels: Levels) -> bool:
        return levels.correlation_time > 0

    def weigh(self, levels: Levels) -> None:
        """Compute decay (K, 1), variances of driving noise (K, 3) and of the error (3,), m^2."""
        decay = np.exp(-self.T / levels.correlation_time)
        density = np.array([levels['slow'], levels['slow'], levels['slow_up']])
        self.variance = density * levels.correlation_time / 2
        self.noise_variance = np.multiply.outer(1 - decay**2, self.variance) * self.jump
        a = self.decay = decay[:, None]
        # derivatives of decay and of ln noise_variance by the logarithm of the correlation time
        self.decay_by_time = a * self.T[:, None] / levels.correlation_time
        self.log_variance_by_time = 1 - 2 * a * self.decay_by_time / (1 - a**2)
        self.log_R = np.log(self.noise_variance).sum() + np.log(self.variance).sum()

    def residual(self) -> Floats:
        """Return the driving noise of each interval: (K, 3) m."""
        s = self.state.slow_n
        return s[1:] - self.decay * s[:-1]

    def add(self, out: NormalEquations) -> None:
        factor.add_process(out, SLOW, self.decay, 1 / self.noise_variance, self.residual())
        factor.add_prior(out, 0, SLOW, self.variance, self.state.slow_n[0])

    def cost(self) -> float:
        first = (self.state.slow_n[0]**2 / self.variance).sum()
        return float((self.residual()**2 / self.noise_variance).sum() + first)

    def components(self, marginals: JointMarginals) -> dict[str, tuple[float, float]]:
        i, s = np.arange(SLOW.start, SLOW.stop), self.state.slow_n
        a, q, r = self.decay, self.noise_variance, self.residual()
        before, cross, variance = self._variances(marginals)
        square, redundancy = r**2 / q, 1 - variance / q
        first, first_variance = s[0]**2 / self.variance, marginals[0][i, i] / self.variance
        squares = square.sum(axis=0) + first
        expected = redundancy.sum(axis=0) + (1 - first_variance)
        components = {'slow': (float(squares[:2].sum()), float(expected[:2].sum())),
                      'slow_up': (float(squares[2]), float(expected[2]))}
        if not self.time_is_fixed:
            components['correlation_time'] = self._time_component(
                r * s[:-1] + cross - a * before, square - redundancy, first + first_variance - 1)
        return components

    def _variances(self, marginals: JointMarginals) -> tuple[Floats, Floats, Floats]:
        """
        Return variances (K, 3) of the error at the start of an interval and of its driving noise.

        Between them: the covariance of the errors at the start and the end.
        """
        variances, a = marginals.variances()[:, SLOW], self.decay
        before, after = variances[:-1], variances[1:]
        cross = marginals.next_covariances()[:, SLOW]
        return before, cross, after + a**2 * before - 2 * a * cross

    def jumps(self, marginals: JointMarginals) -> Floats:
        """
        Return the driving noise of each interval, on the axis where it is largest: (2, K, 1).

        The estimate in sigmas, and the observable share of its variance. Fixes determine only the
        sum over a run of intervals without fixes: it is used for all of them.
        """
        observed = 1 - self._variances(marginals)[2] / self.noise_variance
        observed, noise, variance = (np.add.reduceat(x, self.runs) for x in (
            observed, self.residual(), self.noise_variance))
        observed, z = np.clip(observed, 1e-12, None), noise / np.sqrt(variance)
        axis = np.argmax(np.abs(z) / np.sqrt(observed), axis=1)[:, None]
        length = np.diff(np.append(self.runs, len(self.T)))
        return np.stack([np.repeat(np.take_along_axis(x, axis, axis=1), length, axis=0)
                         for x in (z, observed)])

    def _time_component(self, product: Floats, excess: Floats,
                        begin: Floats) -> tuple[float, float]:
        """Return Q and E of the logarithm of the correlation time; Q - E is its score."""
        # the expected score of the complete data (Fisher's identity). Expected values: product,
        # driving noise times the error before; excess, begin: squares of noise and of the first
        # error, in sigmas, minus 1
        a, tau = self.decay, self.levels.correlation_time
        da, dq = self.decay_by_time, self.log_variance_by_time
        score = float((product * da / self.noise_variance + excess * dq / 2).sum()
                      + begin.sum() / 2 - np.log(tau / USUAL_TIME) / TIME_SPREAD**2)
        information = 3 * float((da**2 / (1 - a**2) + dq**2 / 2).sum() + 0.5) + TIME_SPREAD**-2
        return information + score, information

    def add_levels(self, out: LevelRightHandSides) -> None:
        # q of a density is the error s itself, as the covariance is proportional to it
        s = self.state.slow_n
        axes = {'slow': np.array([1.0, 1.0, 0.0]), 'slow_up': np.array([0.0, 0.0, 1.0])}
        g, q = ([x * axis for axis in axes.values()] for x in (self._weighted_error(), s))
        names = list(axes)
        if not self.time_is_fixed:
            by_time = self._weighted_error_by_time()
            g.append(by_time)
            q.append(self._covariance_product(by_time))
            names.append('correlation_time')
        columns = out.columns(names)
        for i, g_i in zip(columns, g, strict=True):
            out.g[:, SLOW, i] += g_i
        out.q_products[np.ix_(columns, columns)] += [[(a * b).sum() for b in g] for a in q]

    def _weighted_error(self) -> Floats:
        """Return the inverse covariance of the process times the error: (N, 3)."""
        s, noise = self.state.slow_n, self.residual() / self.noise_variance
        out = np.zeros_like(s)
        out[0] = s[0] / self.variance
        out[1:] += noise
        out[:-1] -= self.decay * noise
        return out

    def _weighted_error_by_time(self) -> Floats:
        """Return minus the derivative of ``_weighted_error`` by the log of the time: (N, 3)."""
        s, r = self.state.slow_n, self.residual()
        noise = (self.decay_by_time * s[:-1] + r * self.log_variance_by_time) / self.noise_variance
        out = np.zeros_like(s)
        out[0] = s[0] / self.variance
        out[1:] += noise
        out[:-1] += self.decay_by_time * r / self.noise_variance - self.decay * noise
        return out

    def _covariance_product(self, g: Floats) -> Floats:
        """Return the covariance of the process times (N, 3): it solves ``_weighted_error``."""
        N, out = len(g), np.empty_like(g)
        for axis in range(3):
            a, q = self.decay[:, 0], np.append(self.variance[axis], self.noise_variance[:, axis])
            bands = np.zeros((2, N))
            bands[1] = 1 / q + np.append(a**2 / q[1:], 0.0)
            bands[0, 1:] = -a / q[1:]
            out[:, axis] = solveh_banded(bands, g[:, axis])
        return out

    def effects(self, marginals: JointMarginals) -> Iterator[tuple[str, Floats]]:
        cross, n = self.all_parameter_covariances(marginals), self.n
        end = slice(n + SLOW.start, n + SLOW.stop)
        noise = cross[:, :, end] - self.decay[:, :, None] * cross[:, :, SLOW]
        yield 'slow_fix_errors', noise / np.sqrt(self.noise_variance)[:, None]
        yield 'slow_fix_errors', cross[0, :, SLOW] / np.sqrt(self.variance)
