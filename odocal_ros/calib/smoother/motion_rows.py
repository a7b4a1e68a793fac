"""The motion of the intervals as a part: Imu and odometer from each keyframe to the next."""

import numpy as np

from odocal_ros.calib.smoother.imu_noise import at_rest, sensor_noise
from odocal_ros.calib.smoother.motion import Motion
from odocal_ros.calib.smoother.noise import INTERVAL, interval_noise
from odocal_ros.calib.smoother.part import Part
from odocal_ros.calib.smoother.slide import least_slide, SIDEWAYS
from odocal_ros.calib.smoother.state import M

FIRST_ROAD = 0.01    # m/sqrt(s), what slip and slide are believed to be at first
LEAST_ROAD = 2e-4    # m/sqrt(s) along
ALONG = ('along', 'along_hard')
# sources in the budget
NAMES = {'gyro': 'gyro_noise', 'accel': 'accelerometer_noise', 'gyro_walk': 'gyro_bias_walk',
         'accel_walk': 'accelerometer_bias_walk', 'along': 'travel_noise',
         'along_hard': 'travel_noise', 'side': 'sideslip', 'side_turn': 'sideslip',
         'up': 'vertical_motion'}
ODOMETER_AXES = (ALONG, ('side', 'side_turn'), ('up',))


class MotionRows(Part):
    """Rows of ``Motion`` in the noise of ``IntervalNoise``; weighed: r (K, 18), J, whiten."""

    name = 'motion'

    def __init__(self, problem, here):
        change = here.gyro_change, here.odo_later
        self.motion = Motion(problem.leg, here.state, here.intervals, change, here.fitted)
        self.raw, self.jacobians = self.motion.residual, self.motion.jacobians
        self.noise = interval_noise(self.motion, problem.leg,
                                    problem.still[:-1] & problem.still[1:], here.spread)

    @classmethod
    def first_levels(cls, problem):
        """Return first levels and their least: of the Imu as it rests, of the road."""
        imu = {name: sigma**2 for name, sigma in sensor_noise(problem.grade).items()}
        imu |= at_rest(problem.imu, problem.leg, problem.still)
        slide = least_slide(problem.turned)**2
        return (imu | dict.fromkeys(ALONG, FIRST_ROAD**2)
                | dict.fromkeys(SIDEWAYS, max(FIRST_ROAD**2, slide)),
                imu | dict.fromkeys(ALONG, LEAST_ROAD**2) | dict.fromkeys(SIDEWAYS, slide))

    def weigh(self, levels):
        """Whiten the rows by the Cholesky root of their covariance."""
        Q = self.noise.covariance(levels)
        scale = 1 / np.sqrt(np.einsum('kii->ki', Q))
        root = np.linalg.cholesky(Q * scale[:, :, None] * scale[:, None, :])
        self.whiten = np.linalg.inv(root) * scale[:, None, :]
        self.log_R = -2 * np.log(np.einsum('kii->ki', self.whiten)).sum()
        self.J = self.whiten @ np.concatenate(self.jacobians(self.n), axis=2)
        self.r = np.einsum('kij,kj->ki', self.whiten, self.raw)

    def after(self, step, constants, reached):
        """Bring the residuals to where the step leads."""
        both = np.concatenate([step[:-1], step[1:],
                               np.broadcast_to(constants, (len(self.J), M))], axis=1)
        self.r = self.r + np.einsum('kij,kj->ki', self.J, both)

    def add(self, out):
        """Add the rows to normal equations."""
        n = self.n
        H = np.swapaxes(self.J, 1, 2) @ self.J
        g = -np.einsum('kij,ki->kj', self.J, self.r)
        out.diagonal[:-1] += H[:, :n, :n]
        out.diagonal[1:] += H[:, n:2 * n, n:2 * n]
        out.beside += H[:, :n, n:2 * n]
        out.border[:-1] += H[:, :n, 2 * n:]
        out.border[1:] += H[:, n:2 * n, 2 * n:]
        out.corner += H[:, 2 * n:, 2 * n:].sum(axis=0)
        out.g[:-1] += g[:, :n]
        out.g[1:] += g[:, n:2 * n]
        out.g_border += g[:, 2 * n:].sum(axis=0)

    def cost(self):
        """Return the sum of squares, in sigmas."""
        return (self.r**2).sum()

    def _units(self):
        """Return the whitened unit noises of the intervals, (K, 18, c), and J' of them."""
        A = self.whiten @ (self.noise.columns * self.roots())
        return A, np.swapaxes(self.J, 1, 2) @ A

    def roots(self):
        """Return the standard deviation of each unit noise, (c,), per root second."""
        return np.sqrt([self.levels[INTERVAL[i]] for i in self.noise.component])

    def of(self, *names):
        """Tell which unit noises are of these levels: (c,) bool."""
        return np.isin(self.noise.component, [INTERVAL.index(name) for name in names])

    def components(self, near):
        """Return for each level its quadratic sum and what is expected of it."""
        A, Y = self._units()
        quadratic = (np.einsum('kic,ki->kc', A, self.r)**2).sum(axis=0)
        expected = (A**2).sum(axis=(0, 1)) - (Y * (near @ Y)).sum(axis=(0, 1))
        return {name: (float(quadratic[self.of(name)].sum()), float(expected[self.of(name)].sum()))
                for name in INTERVAL}

    def effects(self, near):
        """Yield what the unit noises of each level do."""
        X = self.to_told(near) @ self._units()[1]
        for name in INTERVAL:
            yield NAMES[name], X[:, :, self.of(name)]

    def road_noise(self, near):
        """
        Return the odometer's noise of each interval, along, side, up: (K, 3) each.

        First the best estimate in its own sigmas, second the variance that it should have: of 1,
        what the data can see.
        """
        A, Y = self._units()
        estimate = np.einsum('kic,ki->kc', A, self.r)
        seen = (A**2).sum(axis=1) - (Y * (near @ Y)).sum(axis=1)
        columns = [self.of(*names) for names in ODOMETER_AXES]
        return (np.stack([estimate[:, c].sum(axis=1) for c in columns], -1),
                np.stack([seen[:, c].sum(axis=1) for c in columns], -1))
