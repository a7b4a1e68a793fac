# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The motion factor: IMU and odometer between adjacent keyframes.

Rows and derivatives are those of ``Motion`` (motion.py), their noise that of ``IntervalNoise``.
"""

from collections.abc import Iterator
from weakref import ref

import numpy as np

from odocal_ros.data.arrays import blocks, Bools, Floats, work_array
from odocal_ros.estimator.chain import JointMarginals, NormalEquations
from odocal_ros.estimator.factors.factor import Factor, IMU, LinearisationPoint
from odocal_ros.estimator.factors.interval_noise import ALONG, INTERVAL, motion_noise, road_levels
from odocal_ros.estimator.factors.motion import D, Motion, ROWS
from odocal_ros.estimator.factors.odometer import SpeedSteps
from odocal_ros.estimator.factors.signals import Signals
from odocal_ros.estimator.imu import sensor_noise, white_noise_at_rest
from odocal_ros.estimator.levels import LevelRightHandSides, Levels
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import ACCEL, BG, GYRO, MEAN_ROLL, P, State, V

BUDGET_SOURCES = {      # names of the error sources, by level
    'gyro': 'gyro_noise', 'accel': 'accelerometer_noise', 'gyro_walk': 'gyro_bias_walk',
    'accel_walk': 'accelerometer_bias_walk', 'along': 'travel_noise', 'along_hard': 'travel_noise',
    'side': 'sideslip', 'side_turn': 'sideslip', 'up': 'vertical_motion',
    'pitching': 'vertical_motion'}
ODOMETER_AXES = (ALONG, ('side', 'side_turn'), ('up', 'pitching'))


class MotionRows(Factor):
    """
    Rows of the K intervals; a weighted copy has r (K, 18), J (K, 18, 2n + m), whiten (K, 18, 18).

    r : residuals, J : derivatives, both multiplied by whiten. Unit noises are recomputed when
    needed, some intervals at a time: stored, they would take a third of the memory of J.
    """

    name = 'motion'

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        self.motion = Motion(problem, point.state, point.intervals, point.fitted)
        self.raw, self.jacobians = self.motion.residual, self.motion.jacobians
        self.signals = Signals(self.motion)
        intervals_at_rest = problem.at_rest[:-1] & problem.at_rest[1:]
        self.noise = motion_noise(self.motion, problem.leg, intervals_at_rest,
                                  point.variance_factors)

    @classmethod
    def initial_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        imu = {name: sigma**2 for name, sigma in sensor_noise(problem.grade).items()}
        imu |= white_noise_at_rest(problem.imu, problem.leg, problem.at_rest)
        initial, minimum = road_levels(problem.total_turn)
        return imu | initial, imu | minimum

    def weigh(self, levels: Levels) -> None:
        """Whiten rows and derivatives by the inverse Cholesky factor of their covariance."""
        self._noise_estimates: tuple[ref[JointMarginals], Floats, Floats] | None = None
        self.whiten = work_array(len(self.raw), ROWS, ROWS)
        self.J = work_array(*self.raw.shape, 2 * self.n + self.m)
        self.r, log_sum = np.empty_like(self.raw), 0.0
        for rows in blocks(len(self.raw)):
            units = self.noise.columns(rows) * self.level_sigmas()
            Q = self.noise.covariance(units, rows)
            scale = 1 / np.sqrt(np.einsum('kii->ki', Q))
            root = np.linalg.cholesky(Q * scale[:, :, None] * scale[:, None, :])
            self.whiten[rows] = np.linalg.inv(root) * scale[:, None, :]
            diagonal = np.einsum('kii->ki', self.whiten[rows]).copy()      # see arctan2
            log_sum += np.log(diagonal).sum()
            self.r[rows] = np.einsum('kij,kj->ki', self.whiten[rows], self.raw[rows])
            self.J[rows] = self.whiten[rows] @ np.concatenate(
                self.derivatives(rows, units), axis=2)[:, :, :self.J.shape[2]]
        self.log_R = -2 * float(log_sum)

    def apply_step(self, step: Floats, constants: Floats, new_state: State) -> None:
        r, n = self.r.copy(), self.n
        for rows in blocks(len(r)):
            J, ends = self.J[rows], slice(rows.start + 1, rows.stop + 1)
            r[rows] += np.einsum('kij,kj->ki', J[:, :, :n], step[rows]) + np.einsum(
                'kij,kj->ki', J[:, :, n:2 * n], step[ends]) + J[:, :, 2 * n:] @ constants[:self.m]
        self.r = r

    def derivatives(self, rows: slice, units: Floats) -> tuple[Floats, Floats, Floats]:
        """Return ``Motion.jacobians`` of some intervals, with fitted signals."""
        begin, end, constants = self.motion.take(rows).jacobians(self.n)
        gyro = units[:, :, self.noise_mask('gyro')]
        constants[:, :, GYRO] += self.signals.gyro_corrections(rows, begin[:, :, BG], gyro)
        if self.motion.fitted:
            estimates = np.einsum('kic,ki->kc', self.whiten[rows] @ gyro, self.r[rows])
            by_velocity, by_position = self.signals.accel_corrections(rows, gyro, estimates)
            constants[:, V, ACCEL] += by_velocity
            constants[:, P, ACCEL] += by_position
            constants[:, D, MEAN_ROLL] += self.derivative_by_roll(rows, units)
        return begin, end, constants

    def derivative_by_roll(self, rows: slice, units: Floats) -> Floats:
        """
        Return derivatives by the mean roll that turns the axes of road noise: (k, 3) m.

        With a wrong roll, the vertical motion of bumps is in part lateral, (S12). The lateral or
        vertical row, whichever has less noise, has the derivative: the residual of the other one.
        """
        side, up = ((units[:, D, self.noise_mask(*names)]**2).sum(axis=(1, 2))
                    for names in ODOMETER_AXES[1:])
        weighted = np.einsum('kij,ki->kj', self.whiten[rows], self.r[rows])[:, D]
        axes = self.noise.axes[rows, 1:]       # left, up
        axes = np.where((side < up)[:, None, None], axes, axes[:, ::-1])
        other = (up - side) * np.einsum('ki,ki->k', axes[:, 1], weighted)
        out: Floats = axes[:, 0] * other[:, None]
        return out

    def add(self, out: NormalEquations) -> None:
        for rows in blocks(len(self.r)):
            self._add_block(out, rows)

    def _add_block(self, out: NormalEquations, rows: slice) -> None:
        """Add the rows of some intervals; its arrays are freed before those of the next ones."""
        n, ends, J = self.n, slice(rows.start + 1, rows.stop + 1), self.J[rows]
        J_T = np.swapaxes(J, 1, 2)
        begin, end = J_T[:, :n] @ J, J_T[:, n:2 * n] @ J[:, :, n:]
        by_constants = np.ascontiguousarray(J[:, :, 2 * n:]).reshape(-1, self.m)
        g = -np.einsum('kij,ki->kj', J, self.r[rows])
        out.diagonal[rows] += begin[:, :, :n]
        out.diagonal[ends] += end[:, :, :n]
        out.upper[rows] += begin[:, :, n:2 * n]
        out.coupling[rows] += begin[:, :, 2 * n:]
        out.coupling[ends] += end[:, :, n:]
        out.corner += by_constants.T @ by_constants
        out.g[rows] += g[:, :n]
        out.g[ends] += g[:, n:2 * n]
        out.g_constants += g[:, 2 * n:].sum(axis=0)

    def cost(self) -> float:
        return float((self.r**2).sum())

    def units(self, rows: slice) -> Floats:
        """Return the whitened unit noises of some intervals: (k, 18, c)."""
        return self.whiten[rows] @ (self.noise.columns(rows) * self.level_sigmas())

    def level_sigmas(self) -> Floats:
        """Return the root of the level of each unit noise: (c,)."""
        return np.sqrt([self.levels[INTERVAL[i]] for i in self.noise.component])

    def noise_mask(self, *names: str) -> Bools:
        """Return a mask of the unit noises of these levels: (c,) bool."""
        return np.isin(self.noise.component, [INTERVAL.index(name) for name in names])

    def components(self, marginals: JointMarginals) -> dict[str, tuple[float, float]]:
        estimates, observed = self._noises(marginals)
        quadratic, expected = np.einsum('kc,kc->c', estimates, estimates), observed.sum(axis=0)
        masks = {name: self.noise_mask(name) for name in INTERVAL}
        return {name: (float(quadratic[mask].sum()), float(expected[mask].sum()))
                for name, mask in masks.items()}

    def add_levels(self, out: LevelRightHandSides) -> None:
        n, columns = self.n, out.columns(INTERVAL)
        level_selector = np.eye(len(INTERVAL))[self.noise.component]     # (c, levels) 0 or 1
        for rows in blocks(len(self.r)):
            ends = slice(rows.start + 1, rows.stop + 1)
            A = self.units(rows)
            q = (A * np.einsum('kic,ki->kc', A, self.r[rows])[:, None]) @ level_selector
            g = np.swapaxes(self.J[rows], 1, 2) @ q
            out.g[rows, :, columns] += g[:, :n]
            out.g[ends, :, columns] += g[:, n:2 * n]
            out.g_constants[:, columns] += g[:, 2 * n:].sum(axis=0)
            out.q_products[np.ix_(columns, columns)] += (np.swapaxes(q, 1, 2) @ q).sum(axis=0)

    def _noises(self, marginals: JointMarginals) -> tuple[Floats, Floats]:
        """Return estimates of the unit noises, in sigmas, and their variances: (K, c) each."""
        # stored for one ``marginals``: levels and variance factors both use them
        if self._noise_estimates is None or self._noise_estimates[0]() is not marginals:
            estimates, variances = np.empty((2, len(self.r), len(self.noise.component)))
            for rows in blocks(len(self.r)):
                estimates[rows], variances[rows] = self._block_noises(rows, marginals)
            self._noise_estimates = ref(marginals), estimates, variances
        return self._noise_estimates[1:]

    def _block_noises(self, rows: slice, marginals: JointMarginals) -> tuple[Floats, Floats]:
        """Return ``_noises`` of some intervals; their arrays are freed before the next ones."""
        fitted = marginals.covariance_form(rows, self.J[rows])
        A = self.units(rows)
        return (np.einsum('kic,ki->kc', A, self.r[rows]),
                (A * (A - fitted @ A)).sum(axis=1))

    def effects(self, marginals: JointMarginals) -> Iterator[tuple[str, Floats]]:
        by_unit, by_known = [], []
        for rows, block in zip(blocks(len(self.r)), marginals.blocks(), strict=True):
            by_rows = self.parameter_covariances(block) @ np.swapaxes(self.J[rows], 1, 2)
            by_unit.append(by_rows @ self.units(rows))
            by_known.append(by_rows @ (self.whiten[rows] @ self.noise.known_columns[rows]))
        effects = np.concatenate(by_unit)
        for name in INTERVAL:
            yield BUDGET_SOURCES[name], effects[:, :, self.noise_mask(name)]
        if self.noise.known_columns.shape[2]:
            yield SpeedSteps.source, np.concatenate(by_known)

    def road_noise(self, marginals: JointMarginals) -> tuple[Floats, Floats]:
        """Return odometer noise forward, left, up, in sigmas, and its variances: (K, 3) each."""
        estimate, observed = self._noises(marginals)
        masks = [self.noise_mask(*names) for names in ODOMETER_AXES]
        return (np.stack([estimate[:, mask].sum(axis=1) for mask in masks], -1),
                np.stack([observed[:, mask].sum(axis=1) for mask in masks], -1))

    def imu_noise(self, marginals: JointMarginals) -> tuple[Floats, Floats]:
        """Return norms of the noises IMU, in sigmas, and their largest variances: (K, 4) each."""
        estimate, observed = self._noises(marginals)
        masks = [self.noise_mask(name) for name in IMU]
        return (np.stack([np.linalg.norm(estimate[:, mask], axis=1) for mask in masks], -1),
                np.stack([observed[:, mask].max(axis=1) for mask in masks], -1))

    def along_sigma(self) -> Floats:
        """Return the sigma of the noise along the path in each interval: (K,) m."""
        mask = self.noise_mask(*ALONG)
        return np.concatenate([
            np.linalg.norm(self.noise.columns(rows)[:, D, mask] * self.level_sigmas()[mask],
                           axis=1).sum(axis=1) for rows in blocks(len(self.r))])
