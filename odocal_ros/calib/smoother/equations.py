"""
The least squares of a leg at one state: all rows, their normal equations, their residual sums.

Rows: motion of each interval, fixes, standstills (no velocity, no turn), the odometer's rounding,
and what is believed beforehand of the biases and of the constants other than scale, yaw and pitch.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.smoother.chain import Normal
from odocal_ros.calib.smoother.fixes import Fixes, heavy, weights
from odocal_ros.calib.smoother.motion import Motion, rotvec
from odocal_ros.calib.smoother.noise import interval_noise, Levels, once_a_rest
from odocal_ros.calib.smoother.outside_rows import (
    add_rows,
    by_interval,
    outside_rows,
    WeightedRows,
)
from odocal_ros.calib.smoother.state import (
    BA,
    BARE,
    BG,
    E,
    M,
    PHI,
    SLOW,
    V,
    WITH_SLOW,
)
from odocal_ros.nav.rotations import transpose

STILL_SPEED = 0.005                           # m/s at each keyframe of a standstill
STILL_TURN = np.array([1e-4, 1e-4, 2e-5])     # rad/sqrt(s) about east, north, up
STILL_EDGE = 0.5                              # s cut off a standstill
ANYWHERE, ANY_SPEED, ANY_WAY = 1e4, 100.0, np.array([1.0, 1.0, 10.0])    # m, m/s, rad


@dataclass(frozen=True, eq=False)
class Priors:
    """What is believed beforehand, 1 sigma: (3,), (3,), (M,), inf where nothing is."""

    gyro_bias: np.ndarray
    accel_bias: np.ndarray
    constants: np.ndarray
    centre: np.ndarray           # (M,) of the constants


class Equations:
    """Normal equations and residual sums at one linearisation, for any levels."""

    def __init__(self, problem, state, sums, priors=None, spread=None, fitted=False):
        self.state, self.still = state, problem.still
        self.priors = priors or problem.priors
        self.travel_floor = problem.travel_floor       # variance of the odometer's rounding
        self.travel_weight = once_a_rest(problem.still)
        leg = problem.leg
        intervals, gyro_change, delay_change, fix_change = sums.near(state)
        self.motion = Motion(leg, state, intervals, (gyro_change, delay_change), fitted)
        self.noise = interval_noise(
            self.motion, leg, self.still[:-1] & self.still[1:], spread)
        self.fixes = Fixes(leg, state, sums.points, intervals, problem.use, fix_change)
        self.root = problem.root
        self.thin = problem.thin
        self.outside = outside_rows(problem, state, sums.outside, fix_change)
        self._jacobians = {}

    def jacobians(self, n):
        """Return [begin | end | constants] of motion, whitened ones of fixes; kept."""
        if n not in self._jacobians:
            a, b, c = self.motion.jacobians(n)
            J, Jc = self.fixes.jacobians(n)
            F = np.concatenate([self.root @ J, self.root @ Jc], axis=2)
            self._jacobians[n] = np.concatenate([a, b, c], axis=2), F
        return self._jacobians[n]

    def at(self, levels: Levels) -> 'Weighted':
        """Return the equations with these levels."""
        return Weighted(self, levels)


class Weighted:
    """Equations at given levels: normal equations, cost, shares of the variance components."""

    def __init__(self, equations: Equations, levels: Levels):
        self.eq, self.levels = equations, levels
        self.n = WITH_SLOW if levels.correlation_time else BARE
        eq = equations
        self.J, self.F = eq.jacobians(self.n)
        Q = eq.noise.covariance(levels)
        scale = 1 / np.sqrt(np.einsum('kii->ki', Q))
        root = np.linalg.cholesky(Q * scale[:, :, None] * scale[:, None, :])
        inverse = np.linalg.inv(root) * scale[:, None, :]       # whitens the rows
        self.whiten = inverse
        self.log_R = -2 * np.log(np.einsum('kii->ki', inverse)).sum()
        self.reached = eq.state
        self.WJ = inverse @ self.J
        self.wr = np.einsum('kij,kj->ki', inverse, eq.motion.residual)
        self._weigh_fixes()
        self.outside = [WeightedRows(rows, levels, eq.thin.get(rows.name, 1.0), self.n)
                        for rows in eq.outside]
        self.log_R += sum(rows.log_R for rows in self.outside)
        self._slow()

    def _weigh_fixes(self):
        level, eq = self.levels, self.eq
        factor = np.array([1.0, 1.0, 1.0])
        factor[:2] /= np.sqrt(level['fix'])
        factor[2] /= np.sqrt(level['fix_up'])
        self.factor = factor
        white = np.einsum('kij,kj->ki', eq.root, eq.fixes.raw) * factor
        self.fix_weight = weights(white)
        root = np.sqrt(self.fix_weight) * factor
        self.white_fix = white
        self.fix_r = np.sqrt(self.fix_weight) * white
        self.FJ = self.F * root[:, :, None]
        if self.n == WITH_SLOW:
            self.FJ_end = -(eq.root * root[:, :, None]) * eq.fixes.share[:, None, None]
        self.log_R -= 2 * np.log(np.tile(factor, (len(white), 1))).sum()

    def _slow(self):
        """Prepare the rows of the slow fix error: a Gauss-Markov process at the keyframes."""
        if self.n != WITH_SLOW:
            return
        T = self.eq.motion.T[:, 0]
        self.decay = np.exp(-T / self.levels.correlation_time)
        power = np.array([self.levels['slow'], self.levels['slow'], self.levels['slow_up']])
        self.slow_power = power
        self.slow_drive = np.multiply.outer(1 - self.decay**2, power)      # (K, 3)

    def slow_residual(self):
        """Return what the slow fix error does beyond its decay: (K, 3) m."""
        s = self.reached.slow_n
        return s[1:] - self.decay[:, None] * s[:-1]

    def after(self, solved) -> 'Weighted':
        """Bring the residuals to where the step leads, were all linear; returns itself."""
        x, c, n = solved.step, solved.step_border, self.n
        K = len(self.J)
        z = np.concatenate([x[:-1], x[1:], np.broadcast_to(c, (K, M))], axis=1)
        self.wr = self.wr + np.einsum('kij,kj->ki', self.WJ, z)
        k = self.eq.fixes.k
        own = np.concatenate([x[k], np.broadcast_to(c, (len(k), M))], axis=1)
        self.fix_r = self.fix_r + np.einsum('kij,kj->ki', self.FJ, own)
        if n == WITH_SLOW:
            self.fix_r = self.fix_r + np.einsum('kij,kj->ki', self.FJ_end, x[k + 1, SLOW])
        for rows in self.outside:
            rows.after(x, c)
        self.reached = self.eq.state.moved(x, c)
        return self

    def normal(self) -> Normal:
        """Return the normal equations of the step."""
        eq, n = self.eq, self.n
        state, K = eq.state, len(self.J)
        out = Normal.zeros(K + 1, n, M)
        H = np.swapaxes(self.WJ, 1, 2) @ self.WJ
        g = -np.einsum('kij,ki->kj', self.WJ, self.wr)
        self._add_pairs(out, H, g)
        self._add_fixes(out)
        for rows in self.outside:
            add_rows(out, rows.k, rows.J, rows.r)
        if n == WITH_SLOW:
            self._add_slow(out)
        self._add_stills(out)
        e = self.travel_variance
        out.diagonal[:, E, E] += eq.travel_weight / e
        out.g[:, E] -= eq.travel_weight * state.travel_error / e
        self._add_priors(out)
        return out

    @property
    def travel_variance(self):
        """Return the variance of the odometer's reading at a keyframe, scale units."""
        return max(self.eq.travel_floor, self.levels['travel'])

    def _add_pairs(self, out, H, g):
        n = self.n
        out.diagonal[:-1] += H[:, :n, :n]
        out.diagonal[1:] += H[:, n:2 * n, n:2 * n]
        out.beside += H[:, :n, n:2 * n]
        out.border[:-1] += H[:, :n, 2 * n:]
        out.border[1:] += H[:, n:2 * n, 2 * n:]
        out.corner += H[:, 2 * n:, 2 * n:].sum(axis=0)
        out.g[:-1] += g[:, :n]
        out.g[1:] += g[:, n:2 * n]
        out.g_border += g[:, 2 * n:].sum(axis=0)

    def _add_fixes(self, out):
        n, k = self.n, self.eq.fixes.k
        present, J, r = add_rows(out, k, self.FJ, self.fix_r)
        if n == WITH_SLOW:
            B = self.by_interval(self.FJ_end)
            X = np.swapaxes(J, 1, 2) @ B
            out.beside[present, :, SLOW] += X[:, :n]
            out.border[present + 1, SLOW] += np.swapaxes(X[:, n:], 1, 2)
            out.diagonal[present + 1, SLOW, SLOW] += np.swapaxes(B, 1, 2) @ B
            out.g[present + 1, SLOW] -= (np.swapaxes(B, 1, 2) @ r)[:, :, 0]

    def by_interval(self, rows):
        """Return the rows of fixes (m, 3, c) by interval, padded: (present, 3 most, c)."""
        return by_interval(self.eq.fixes.k, rows)

    def _add_slow(self, out):
        a, q = self.decay[:, None], 1 / self.slow_drive
        r = self.slow_residual()
        i = np.arange(SLOW.start, SLOW.stop)
        out.diagonal[:-1, i, i] += a**2 * q
        out.diagonal[1:, i, i] += q
        out.beside[:, i, i] -= a * q
        out.g[:-1, i] += a * q * r
        out.g[1:, i] -= q * r
        out.diagonal[0, i, i] += 1 / self.slow_power
        out.g[0, i] -= self.eq.state.slow_n[0] / self.slow_power

    def _add_stills(self, out):
        eq, state = self.eq, self.eq.state
        still = eq.still
        i = np.arange(3)
        w = still / STILL_SPEED**2
        out.diagonal[:, V.start + i, V.start + i] += w[:, None]
        out.g[:, V] -= w[:, None] * state.v_n
        pair = still[:-1] & still[1:]
        w = pair[:, None] / (STILL_TURN**2 * eq.motion.T)
        r = rotvec(state.C_nb[1:] @ transpose(state.C_nb[:-1]))
        j = PHI.start + i
        out.diagonal[:-1, j, j] += w
        out.diagonal[1:, j, j] += w
        out.beside[:, j, j] -= w
        out.g[:-1, j] += w * r
        out.g[1:, j] -= w * r

    def _add_priors(self, out):
        eq, state, i = self.eq, self.eq.state, np.arange(3)
        out.diagonal[0, i, i] += 1 / ANYWHERE**2
        out.diagonal[0, 3 + i, 3 + i] += 1 / ANY_SPEED**2
        out.diagonal[0, 6 + i, 6 + i] += 1 / ANY_WAY**2
        for where, value, sigma in ((BG, state.gyro_bias[0], eq.priors.gyro_bias),
                                    (BA, state.accel_bias[0], eq.priors.accel_bias)):
            out.diagonal[0, where.start + i, where.start + i] += 1 / sigma**2
            out.g[0, where] -= value / sigma**2
        w = 1 / eq.priors.constants**2
        out.corner[range(M), range(M)] += w
        out.g_border -= w * (state.constants - eq.priors.centre)

    def cost(self) -> float:
        """Return the weighted sum of squares of all rows, robust in the fixes."""
        eq, state = self.eq, self.reached
        total = (self.wr**2).sum() + heavy(self.fix_r / np.sqrt(self.fix_weight))
        total += (eq.travel_weight * state.travel_error**2).sum() / self.travel_variance
        total += sum(rows.cost() for rows in self.outside)
        total += (state.v_n[eq.still]**2).sum() / STILL_SPEED**2
        pair = eq.still[:-1] & eq.still[1:]
        r = rotvec(state.C_nb[1:] @ transpose(state.C_nb[:-1]))
        total += (r[pair]**2 / (STILL_TURN**2 * eq.motion.T[pair])).sum()
        total += (state.gyro_bias[0]**2 / eq.priors.gyro_bias**2).sum()
        total += (state.accel_bias[0]**2 / eq.priors.accel_bias**2).sum()
        total += ((state.constants - eq.priors.centre)**2 / eq.priors.constants**2).sum()
        if self.n == WITH_SLOW:
            total += (self.slow_residual()**2 / self.slow_drive).sum()
            total += (state.slow_n[0]**2 / self.slow_power).sum()
        return float(total)

    def log_R_total(self) -> float:
        """Return the log determinant of the covariance of all rows that the levels change."""
        total = self.log_R + self.eq.travel_weight.sum() * np.log(self.travel_variance)
        if self.n == WITH_SLOW:
            total += np.log(self.slow_drive).sum() + np.log(self.slow_power).sum()
        return float(total)
