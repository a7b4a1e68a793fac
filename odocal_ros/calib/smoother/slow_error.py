"""Slow errors of fixes as a part: a Gauss-Markov process at the keyframes."""

import numpy as np

from odocal_ros.calib.smoother.part import hold, link, Part
from odocal_ros.calib.smoother.state import SLOW

LEAST = 0.005     # m

class SlowError(Part):
    """
    Rows of what the slow fix error does beyond its decay, and of its first value.

    Levels slow, slow_up: its variance, m^2; the fixes tie it to the track (fixes.py).
    """

    name = 'slow'

    def __init__(self, problem, here):
        self.state, self.T = here.state, here.intervals.T

    @classmethod
    def first_levels(cls, problem):
        """Return first levels by what the fixes state, and their least."""
        sigma = problem.fix_sigma
        first = {'slow': sigma**2, 'slow_up': 4 * sigma**2}
        return first, dict.fromkeys(first, LEAST**2)

    def in_use(self, levels):
        """Tell whether slow errors are estimated."""
        return levels.correlation_time > 0

    def weigh(self, levels):
        """Set decay (K, 1), variances of what drives it (K, 3) and of its values (3,), m^2."""
        decay = np.exp(-self.T / levels.correlation_time)
        self.power = np.array([levels['slow'], levels['slow'], levels['slow_up']])
        self.drive = np.multiply.outer(1 - decay**2, self.power)
        self.decay = decay[:, None]
        self.log_R = np.log(self.drive).sum() + np.log(self.power).sum()

    def residual(self):
        """Return what it does beyond its decay: (K, 3) m."""
        s = self.state.slow_n
        return s[1:] - self.decay * s[:-1]

    def add(self, out):
        """Add the rows to normal equations."""
        link(out, SLOW, self.decay, 1 / self.drive, self.residual())
        hold(out, 0, SLOW, self.power, self.state.slow_n[0])

    def cost(self):
        """Return the sum of squares, in sigmas."""
        first = (self.state.slow_n[0]**2 / self.power).sum()
        return (self.residual()**2 / self.drive).sum() + first

    def components(self, near):
        """Return of each level its quadratic sum and what is expected of it."""
        i, n = np.arange(SLOW.start, SLOW.stop), self.n
        a, q = self.decay, self.drive
        var = near.entries(n + i, n + i) + a**2 * near.entries(i, i) \
            - 2 * a * near.entries(i, n + i)
        num = (self.residual()**2 / q).sum(axis=0) + self.state.slow_n[0]**2 / self.power
        den = (1 - var / q).sum(axis=0) + (1 - near[0][i, i] / self.power)
        return {'slow': (float(num[:2].sum()), float(den[:2].sum())),
                'slow_up': (float(num[2]), float(den[2]))}

    def effects(self, near):
        """Yield what unit errors of what drives it, and of its first value, do."""
        told, n = self.all_told(near), self.n
        end = slice(n + SLOW.start, n + SLOW.stop)
        push = told[:, :, end] - self.decay[:, :, None] * told[:, :, SLOW]
        yield 'slow_fix_errors', push / np.sqrt(self.drive)[:, None]
        yield 'slow_fix_errors', told[0, :, SLOW] / np.sqrt(self.power)
