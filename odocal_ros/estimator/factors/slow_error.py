# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The factor of time-correlated fix errors, docs/method.md (S17): a Gauss-Markov process."""

from collections.abc import Iterator

import numpy as np
from scipy.linalg import solveh_banded

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.chain import JointMarginals, Normal
from odocal_ros.estimator.factors import factor
from odocal_ros.estimator.levels import LevelRightHandSides, Levels
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import SLOW

# prior of the correlation time, log-normal: s, and sigma of the logarithm. Physical: errors of
# receivers over open land stay for a minute or several (docs/decisions/0009)
USUAL_TIME, TIME_SPREAD = 100.0, 0.6
WHITE_SHARE = 0.2       # initial white share of the variance; the slow share is 0.9: judgement


class SlowError(factor.Factor):
    """
    Rows of the driving noise of the correlated fix error, and of its first value.

    Levels slow, slow_up: the spectral density of the driving noise, m^2/s; the stationary variance
    is the density times half the correlation time. The time, s, is a level unless configured.
    The rows of the fixes contain the error (gnss.py).
    """

    name = 'slow'

    def __init__(self, problem: Problem, point: factor.LinearisationPoint) -> None:
        self.state, self.T = point.state, problem.drift_time
        self.jump = 1.0 if point.variance_factors is None else point.variance_factors[:,
                                                                                      factor.JUMP:]
        self.time_given = not np.isnan(problem.correlation_time)
        # start of runs of intervals without fixes: a fix ends a run
        ends = np.bincount(point.points['fixes'].interval, minlength=len(self.T)) > 0
        self.runs = np.flatnonzero(np.append(True, ends[:-1] | ends[1:]))

    @classmethod
    def initial_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        gain = 2 * problem.fix_sigma**2 / USUAL_TIME
        return {'slow': gain, 'slow_up': 4 * gain}, {
            **dict.fromkeys(('slow', 'slow_up'), 2 * problem.min_fix_sigma**2 / USUAL_TIME),
            'correlation_time': 5.0}      # s: shorter times are not separable from white noise

    def is_used(self, levels: Levels) -> bool:
        return levels.correlation_time > 0

    def weigh(self, levels: Levels) -> None:
        """Compute decay (K, 1), variances of driving noise (K, 3) and error (3,), m^2."""
        decay = np.exp(-self.T / levels.correlation_time)
        gain = np.array([levels['slow'], levels['slow'], levels['slow_up']])
        self.power = gain * levels.correlation_time / 2
        self.drive = np.multiply.outer(1 - decay**2, self.power) * self.jump
        a = self.decay = decay[:, None]
        # derivatives of decay and of ln drive by ln correlation time
        self.da = a * self.T[:, None] / levels.correlation_time
        self.dq = 1 - 2 * a * self.da / (1 - a**2)
        self.log_R = np.log(self.drive).sum() + np.log(self.power).sum()

    def residual(self) -> Floats:
        """Return the driving noise of each interval: (K, 3) m."""
        s = self.state.slow_n
        return s[1:] - self.decay * s[:-1]

    def add(self, out: Normal) -> None:
        factor.add_process(out, SLOW, self.decay, 1 / self.drive, self.residual())
        factor.add_prior(out, 0, SLOW, self.power, self.state.slow_n[0])

    def cost(self) -> float:
        first = (self.state.slow_n[0]**2 / self.power).sum()
        out: float = (self.residual()**2 / self.drive).sum() + first
        return out

    def components(self, marginals: JointMarginals) -> dict[str, tuple[float, float]]:
        i, s = np.arange(SLOW.start, SLOW.stop), self.state.slow_n
        a, q, r = self.decay, self.drive, self.residual()
        before, both, var = self._variances(marginals)
        num, den = r**2 / q, 1 - var / q
        begin, begin_var = s[0]**2 / self.power, marginals[0][i, i] / self.power
        level = num.sum(axis=0) + begin, den.sum(axis=0) + (1 - begin_var)
        q_sum, expected = level
        found = {'slow': (float(q_sum[:2].sum()), float(expected[:2].sum())),
                 'slow_up': (float(q_sum[2]), float(expected[2]))}
        if not self.time_given:
            found['correlation_time'] = self._time(
                r * s[:-1] + both - a * before, num - den, begin + begin_var - 1)
        return found

    def _variances(self, marginals: JointMarginals) -> tuple[Floats, Floats, Floats]:
        """Return covariances: of the value before, with that after, of driving noise: (K, 3)."""
        variances, a = marginals.variances()[:, SLOW], self.decay
        before, after = variances[:-1], variances[1:]
        both = marginals.next_covariances()[:, SLOW]
        return before, both, after + a**2 * before - 2 * a * both

    def jumps(self, marginals: JointMarginals) -> Floats:
        """
        Return the driving noise of each interval, on the axis with the largest: (2, K, 1).

        The estimate in its own sigmas and its expected variance. Intervals without fixes between
        them determine only their sum, which is used for all of them.
        """
        seen = 1 - self._variances(marginals)[2] / self.drive
        seen, push, drive = (np.add.reduceat(x, self.runs) for x in (
            seen, self.residual(), self.drive))
        seen, z = np.clip(seen, 1e-12, None), push / np.sqrt(drive)
        most = np.argmax(np.abs(z) / np.sqrt(seen), axis=1)[:, None]
        length = np.diff(np.append(self.runs, len(self.T)))
        return np.stack([np.repeat(np.take_along_axis(x, most, axis=1), length, axis=0)
                         for x in (z, seen)])

    def _time(self, product: Floats, excess: Floats, begin: Floats) -> tuple[float, float]:
        """Return the score of the logarithm of the correlation time and its information."""
        # by Fisher's identity the expected score of the complete data. Expected: product, driving
        # noise times the value before; excess, begin: squares of noise and first value, less 1
        a, tau, da, dq = self.decay, self.levels.correlation_time, self.da, self.dq
        score = float((product * da / self.drive + excess * dq / 2).sum() + begin.sum() / 2
                      - np.log(tau / USUAL_TIME) / TIME_SPREAD**2)
        information = 3 * float((da**2 / (1 - a**2) + dq**2 / 2).sum() + 0.5) + TIME_SPREAD**-2
        return information + score, information

    def add_levels(self, out: LevelRightHandSides) -> None:
        """Add the right-hand sides of its levels; for a power, q is the error itself."""
        s = self.state.slow_n
        axes = {'slow': np.array([1.0, 1.0, 0.0]), 'slow_up': np.array([0.0, 0.0, 1.0])}
        g, q = ([x * one for one in axes.values()] for x in (self._precision(), s))
        names = list(axes)
        if not self.time_given:
            by_time = self._by_time()
            g.append(by_time)
            q.append(self._process(by_time))
            names.append('correlation_time')
        columns = out.columns(names)
        for i, own in zip(columns, g, strict=True):
            out.g[:, SLOW, i] += own
        out.square[np.ix_(columns, columns)] += [[(a * b).sum() for b in g] for a in q]

    def _precision(self) -> Floats:
        """Return the inverse covariance of the process times the error: (N, 3)."""
        s, push = self.state.slow_n, self.residual() / self.drive
        out = np.zeros_like(s)
        out[0] = s[0] / self.power
        out[1:] += push
        out[:-1] -= self.decay * push
        return out

    def _by_time(self) -> Floats:
        """Return minus the derivative of ``_precision`` by the log correlation time: (N, 3)."""
        s, r = self.state.slow_n, self.residual()
        push = (self.da * s[:-1] + r * self.dq) / self.drive
        out = np.zeros_like(s)
        out[0] = s[0] / self.power
        out[1:] += push
        out[:-1] += self.da * r / self.drive - self.decay * push
        return out

    def _process(self, g: Floats) -> Floats:
        """Return the covariance of the process times (N, 3): it solves ``_precision``."""
        N, out = len(g), np.empty_like(g)
        for axis in range(3):
            a, q = self.decay[:, 0], np.append(self.power[axis], self.drive[:, axis])
            bands = np.zeros((2, N))
            bands[1] = 1 / q + np.append(a**2 / q[1:], 0.0)
            bands[0, 1:] = -a / q[1:]
            out[:, axis] = solveh_banded(bands, g[:, axis])
        return out

    def effects(self, marginals: JointMarginals) -> Iterator[tuple[str, Floats]]:
        cross, n = self.all_parameter_covariances(marginals), self.n
        end = slice(n + SLOW.start, n + SLOW.stop)
        push = cross[:, :, end] - self.decay[:, :, None] * cross[:, :, SLOW]
        yield 'slow_fix_errors', push / np.sqrt(self.drive)[:, None]
        yield 'slow_fix_errors', cross[0, :, SLOW] / np.sqrt(self.power)
