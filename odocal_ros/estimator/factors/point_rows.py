# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Factors of sensors that measure at single times, such as fixes; ``PointRows`` is the base class.

A row at a time between two keyframes depends on the keyframe before it, on the constants and, for
fixes, on the time-correlated error of the keyframe after it. Outliers have less weight, (S25).

``ExternalRows`` is the base class of other sensors, with a sigma for each measured component. A
new sensor is one subclass of it, listed in ``equations.FACTORS``.
"""

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, ClassVar

import numpy as np

from odocal_ros.data.arrays import blocks, Bools, Floats, Ints, work_array
from odocal_ros.estimator.chain import JointMarginals, NormalEquations
from odocal_ros.estimator.factors.factor import Factor, LinearisationPoint
from odocal_ros.estimator.leg import ExternalSamples, SmootherLeg
from odocal_ros.estimator.levels import LevelRightHandSides, Levels
from odocal_ros.estimator.preintegrate import Points
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import CONSTANTS, SIZE_WITH_SLOW, SIZE_WITHOUT_SLOW, SLOW, State
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.time_series import NORMAL_MEDIAN
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import Config

# sigmas above which a row or the slip of an interval has less weight. Statistical: 1 row in 370
TAIL_SIGMAS = 3.0
MIN_ROWS = 5    # judgement: with fewer, outliers and levels are not estimated
# groups rows by interval: (m, d, c) to (intervals, d times the largest number of rows of one, c)
Gather = Callable[[Floats], Floats]


class PointRows(Factor):
    """
    m measurements of d components each, such as fixes.

    A subclass sets raw, and share if its rows contain the correlated fix error. ``weigh`` sets r,
    (m, d), the whitened residuals, and their derivatives: J, (m, d, n + M), by the keyframe before
    and the first M constants, those in use; J_end, (m, 3, 3), by the correlated fix error of the
    keyframe after, or None.
    """

    level_columns: ClassVar[dict[str, slice]]     # components whose variances a level multiplies
    source: ClassVar[str]                         # name in the budget
    k: Ints                         # (m,) indices of the keyframes before the rows
    raw: Floats                     # (m, d) residuals
    share: Floats | None = None     # (m,) weight of the correlated error of the keyframe after

    def __init__(self, problem: Problem, points: Points) -> None:
        self.k = points.interval
        self.rows_per_independent = problem.rows_per_independent.get(self.name, 1.0)

    @classmethod
    def times(cls, problem: Problem, constants: Floats) -> Floats:
        """Return the times of the measurements, after their delays: (m,) s."""
        raise NotImplementedError

    def jacobians(self, n: int) -> tuple[Floats, Floats]:
        """Return derivatives by the keyframe before and by constants: (m, d, n), (m, d, M)."""
        raise NotImplementedError

    def whiten(self, x: Floats, rows: slice = slice(None)) -> Floats:
        """Return values x of some rows, (k, d, c), divided by the stated sigmas of these rows."""
        raise NotImplementedError

    def existing_components(self) -> Bools | bool:
        """Return a mask of the components that exist: (m, d) bool or one for all."""
        return True

    def weigh(self, levels: Levels) -> None:
        """Compute r, J and J_end with the weights of outliers."""
        white = self.whiten(self.raw[:, :, None])[:, :, 0]
        factor = np.ones(white.shape[1])
        for level, columns in self.level_columns.items():
            factor[columns] /= np.sqrt(levels[level])
        white = white * factor
        self.weight = self._weights(white)
        root_weight = np.sqrt(self.weight / self.rows_per_independent)
        self.r = root_weight * white
        root = (root_weight * factor)[:, :, None]
        by_keyframe, by_constants = self.jacobians(self.n)
        self.J = work_array(*self.raw.shape, self.n + self.m)
        for rows in blocks(len(self.J)):
            self.J[rows, :, :self.n] = self.whiten(by_keyframe[rows], rows)
            self.J[rows, :, self.n:] = self.whiten(by_constants[rows, :, :self.m], rows)
            self.J[rows] *= root[rows]
        self.J_end = None
        if self.n == SIZE_WITH_SLOW and self.share is not None:
            identity = np.broadcast_to(np.eye(3), (len(white), 3, 3))
            self.J_end = -self.whiten(identity) * root * self.share[:, None, None]
        logs = np.log(np.tile(factor, (len(white), 1)))
        self.log_R = -2 * logs.sum() / self.rows_per_independent

    def _norms(self, white: Floats) -> Iterator[tuple[slice, Floats]]:
        """Yield the components of each level, and the norms of their residuals, in sigmas."""
        for columns in self.level_columns.values():
            yield columns, np.abs(np.hypot.reduce(white[:, columns], axis=1))

    def _weights(self, white: Floats) -> Floats:
        """Return weights of whitened residuals, (m, d), equal for the components of a level."""
        weight = np.ones_like(white)
        for columns, norm in self._norms(white) if len(white) >= MIN_ROWS else ():
            weight[:, columns] = np.minimum(1.0, TAIL_SIGMAS / np.maximum(norm, 1e-12))[:, None]**2
        return weight

    def cost(self) -> float:
        """Return the robust loss of the weights: squares, logarithms beyond TAIL_SIGMAS."""
        total = 0.0
        for _, norm in self._norms(self.r / np.sqrt(self.weight / self.rows_per_independent)):
            excess = np.maximum(norm / TAIL_SIGMAS, 1.0)
            total += float((np.minimum(norm, TAIL_SIGMAS)**2
                            + 2 * TAIL_SIGMAS**2 * np.log(excess)).sum())
        return total / self.rows_per_independent

    def apply_step(self, step: Floats, constants: Floats, new_state: State) -> None:
        steps = np.concatenate([step[self.k], np.broadcast_to(
            constants[:self.m], (len(self.k), self.m))], axis=1)
        self.r = self.r + np.einsum('kij,kj->ki', self.J, steps)
        if self.J_end is not None:
            self.r = self.r + np.einsum('kij,kj->ki', self.J_end, step[self.k + 1, SLOW])

    def add(self, out: NormalEquations) -> None:
        n = self.n
        for present, gather in self._intervals():
            J, r = gather(self.J), gather(self.r[:, :, None])
            J_T = np.swapaxes(J, 1, 2)
            H, g = J_T[:, :n] @ J, -(J_T @ r)[:, :, 0]
            by_constants = np.ascontiguousarray(J[:, :, n:]).reshape(-1, self.m)
            out.diagonal[present] += H[:, :, :n]
            out.coupling[present] += H[:, :, n:]
            out.corner += by_constants.T @ by_constants
            out.g[present] += g[:, :n]
            out.g_constants += g[:, n:].sum(axis=0)
            if self.J_end is None:
                continue
            B = gather(self.J_end)
            X = J_T @ B
            out.upper[present, :, SLOW] += X[:, :n]
            out.coupling[present + 1, SLOW] += np.swapaxes(X[:, n:], 1, 2)
            out.diagonal[present + 1, SLOW, SLOW] += np.swapaxes(B, 1, 2) @ B
            out.g[present + 1, SLOW] -= (np.swapaxes(B, 1, 2) @ r)[:, :, 0]

    def _intervals(self) -> Iterator[tuple[Ints, Gather]]:
        """Yield intervals with rows, some at a time, and the function that groups their rows."""
        present, first, count = np.unique(self.k, return_index=True, return_counts=True)
        for chunk in blocks(len(present)):
            counts = count[chunk]
            rows = slice(first[chunk.start], first[chunk.start] + counts.sum())
            # of each row: the interval, and the place among the rows of this interval
            interval = np.repeat(np.arange(len(counts)), counts)
            place = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
            yield present[chunk], partial(_gather, rows, interval, place,
                                          (len(counts), int(count.max())))

    def components(self, marginals: JointMarginals) -> dict[str, tuple[float, float]]:
        if len(self.k) < MIN_ROWS:
            return {}
        fitted = np.concatenate([self._fitted_variances(marginals, present, gather)
                                 for present, gather in self._intervals()])
        exists = np.broadcast_to(self.existing_components(), self.r.shape)
        r2 = np.where(exists, self.r, 0.0)**2 * self.rows_per_independent
        return {level: (float(r2[:, columns].sum()),
                        float(exists[:, columns].sum() - fitted[:, :, columns].sum()))
                for level, columns in self.level_columns.items()}

    def add_levels(self, out: LevelRightHandSides) -> None:
        if len(self.k) < MIN_ROWS:
            return
        columns = out.columns(self.level_columns)
        q = np.zeros((*self.r.shape, len(columns)))
        for i, components in enumerate(self.level_columns.values()):
            q[:, components, i] = self.r[:, components]
        for present, gather in self._intervals():
            q_i = gather(q)
            g = np.swapaxes(gather(self.J), 1, 2) @ q_i
            out.g[present[:, None], :, columns] += np.moveaxis(g[:, :self.n], 2, 1)
            out.g_constants[:, columns] += g[:, self.n:].sum(axis=0)
            if self.J_end is not None:
                end = np.swapaxes(gather(self.J_end), 1, 2) @ q_i
                out.g[present[:, None] + 1, SLOW, columns] += np.moveaxis(end, 2, 1)
        out.q_products[columns, columns] += np.einsum('kdi,kdi->i', q, q)

    def _fitted_variances(self, marginals: JointMarginals, present: Ints,
                          gather: Gather) -> Floats:
        """Return the part of the row variances that the unknowns fit: (intervals, rows, d)."""
        J = np.swapaxes(gather(self.J), 1, 2)
        end = None if self.J_end is None else np.swapaxes(gather(self.J_end), 1, 2)
        variances = marginals.variances_of(present, J[:, :self.n], J[:, self.n:], end, SLOW)
        return variances.reshape(len(present), -1, self.r.shape[1])

    def effects(self, marginals: JointMarginals) -> Iterator[tuple[str, Floats]]:
        # covariances of the stated parameters with the predictions of the rows
        n, effects = self.n, []     # columns of J and of J_end in the joint marginals
        columns, end = np.r_[0:n, 2 * n:2 * n + self.m], np.arange(n + SLOW.start, n + SLOW.stop)
        for present, gather in self._intervals():
            cross = np.ascontiguousarray(
                self.parameter_covariances(marginals.covariances(present)))
            X = cross[:, :, columns] @ np.swapaxes(gather(self.J), 1, 2)
            if self.J_end is not None:
                X = X + cross[:, :, end] @ np.swapaxes(gather(self.J_end), 1, 2)
            effects.append(X)
        yield self.source, np.concatenate(effects)


def _gather(rows: slice, interval: Ints, place: Ints, shape: tuple[int, int], x: Floats) -> Floats:
    """Return rows of x, (m, d, c), by interval and place in it; zeros where there is no row."""
    out = np.zeros((*shape, *x.shape[1:]))
    out[interval, place] = x[rows]
    return out.reshape(shape[0], -1, x.shape[2])


def rows_per_independent(rows: PointRows) -> float:
    """Return the number of adjacent rows that share one error, by the scatter of their means."""
    r = rows.r / np.sqrt(rows.weight)
    r = (r - np.median(r, axis=0))[:, :2]       # horizontal: these determine scale and yaw
    scale = np.median(np.abs(r), axis=0) / NORMAL_MEDIAN
    r = np.clip(r, -TAIL_SIGMAS * scale, TAIL_SIGMAS * scale)
    r = r - r.mean(axis=0)
    power, count, length = (r**2).mean(), 1.0, 2
    while len(r) >= 12 * length and power > 0:      # 12 bins of 2 axes: variance +- 29 %
        bins = r[:len(r) // length * length].reshape(-1, length, r.shape[1])
        count = max(count, float(length * (bins.mean(axis=1)**2).mean() / power))
        length *= 2
    return count


class ExternalRows(PointRows):
    """The factor of a sensor of ``problem.external``, with constants of its own."""

    constants: ClassVar[slice]      # its indices in state.CONSTANTS
    min_sigma: ClassVar[float]      # lower limit of the noise of a sample

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        samples, points = problem.external[self.name], point.points[self.name]
        super().__init__(problem, points)
        self.raw, self._J, self._J_constants = self.rows(samples, points, point, problem.leg)
        self._inverse_sigma = 1 / samples.sigma.reshape(self.raw.shape)

    @classmethod
    def prepared(cls, inputs: Inputs, config: Config, origin: Origin) -> ExternalSamples | None:
        """Return the samples of the sensor in frame n; None if there are none or it is unused."""
        raise NotImplementedError

    @staticmethod
    def prior_sigmas(samples: Any, config: Config) -> Floats | float:
        """Return the prior sigmas of its constants."""
        raise NotImplementedError

    @classmethod
    def details(cls, samples: Any, constants: Floats, sigma: Floats) -> dict[str, Any]:
        """Return its details of a result: by default its constants, with sigmas."""
        return {CONSTANTS[i]: {'value': float(constants[i]), 'sigma': float(sigma[i])}
                for i in range(*cls.constants.indices(len(CONSTANTS)))}

    def rows(self, samples: Any, points: Points, point: LinearisationPoint,
             leg: SmootherLeg) -> tuple[Floats, Floats, Floats]:
        """
        Return residuals, (m, d), and derivatives by keyframes before and by constants.

        They have the shapes (m, d, SIZE_WITHOUT_SLOW) and (m, d, M).
        """
        raise NotImplementedError

    @classmethod
    def is_present(cls, problem: Problem) -> bool:
        return cls.name in problem.external

    @classmethod
    def times(cls, problem: Problem, constants: Floats) -> Floats:
        return problem.external[cls.name].t

    @classmethod
    def initial_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        minimum = (cls.min_sigma / float(np.median(problem.external[cls.name].sigma)))**2
        return dict.fromkeys(cls.level_columns, 1.0), dict.fromkeys(cls.level_columns, minimum)

    def jacobians(self, n: int) -> tuple[Floats, Floats]:
        columns = 0, n - SIZE_WITHOUT_SLOW
        return np.pad(self._J, ((0, 0), (0, 0), columns)), self._J_constants

    def whiten(self, x: Floats, rows: slice = slice(None)) -> Floats:
        out: Floats = x * self._inverse_sigma[rows, :, None]
        return out
