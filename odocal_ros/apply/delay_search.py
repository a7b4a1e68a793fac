# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Estimate of the delay of the IMU relative to the odometer, by accelerations in a stream."""

from collections import deque

import numpy as np

from odocal_ros.apply.attitude import Vector
from odocal_ros.apply.errors import GRAVITY
from odocal_ros.data.arrays import Floats

# judgement: least and largest number of rows of the regression, one per second; rows over which
# residuals are correlated
MIN_DELAY_ROWS, MAX_DELAY_ROWS, CORRELATED_ROWS = 60, 300, 4
# judgement: least delay that is reported, s and sigmas. 168 simulated drives without a delay had
# up to 0.028 s and 2.5 sigmas at their ends; none of 60 others reported one in any second
MIN_DELAY, DELAY_SIGMAS = 0.04, 4.0
# judgement: ratio of the change of acceleration within a second to the central difference over
# two, in simulated town drives
CHANGE_RATIO = 1.2


class DelaySearch:
    """
    Estimates the delay of the IMU, by one row of a regression per second.

    The change of speed by force minus that by the odometer is regressed on the change of
    acceleration: if the IMU is tau s late, they differ by -tau times it. A constant (tilt, bias)
    is estimated too.

    span_s : averaging time of the odometer's speeds, which are late by half of it.   sigma_s :
    configured sigma of the delay, increased if a delay is found.
    """

    def __init__(self, span_s: float, sigma_s: float) -> None:
        self.sigma_s, self._speed_delay_s = sigma_s, span_s / 2
        self._reported_s = 0.0      # magnitude of the largest reported delay, plus 2 sigma
        # changes of speed in each of the last three seconds, m/s, by odometer and by force
        self._recent_changes: deque[tuple[float, float]] = deque(maxlen=3)
        # rows of the regression: change of acceleration, difference of the changes of speed
        self._rows: deque[tuple[float, float]] = deque(maxlen=MAX_DELAY_ROWS)

    def add(self, forward_n: Vector, change_n: Floats | None, dv_n: Vector, T: float) -> str:
        """
        Add a second of data; return a note if ``sigma_s`` has increased, else ''.

        forward_n : (3,) forward axis.   change_n : (3,) m/s, change of velocity by the odometer,
        None if not usable.   dv_n : (3,) m/s, integral of the specific force.   T : s.
        """
        if change_n is None:
            self._recent_changes.clear()
            return ''
        force_n = dv_n - np.array([0.0, 0.0, GRAVITY * T])
        self._recent_changes.append((float(forward_n @ change_n), float(forward_n @ force_n)))
        if len(self._recent_changes) < 3:
            return ''
        (before, _), (by_odometer, by_force), (after, _) = self._recent_changes
        self._rows.append(((after - before) / 2, by_force - by_odometer))
        delay, sigma = self._delay()
        delay += self._speed_delay_s
        if abs(delay) < max(MIN_DELAY, DELAY_SIGMAS * sigma, self._reported_s):
            return ''
        self._reported_s = abs(delay) + 2 * sigma
        self.sigma_s = max(self.sigma_s, self._reported_s)
        return (f'IMU stamps are {abs(delay):.2f} s (± {sigma:.2f} s) '
                f'{"late" if delay > 0 else "early"} relative to the odometer: add '
                f'{-delay:+z.2f} s to imu.time_offset; the uncertainty of the delay is increased')

    def _delay(self) -> tuple[float, float]:
        """Return the delay of the IMU, s, and its sigma, infinite while there are too few rows."""
        if len(self._rows) < MIN_DELAY_ROWS:
            return 0.0, np.inf
        x, y = np.array(self._rows).T
        X = np.stack([x, np.ones_like(x)], 1)
        N = X.T @ X
        if np.linalg.cond(N) > 1e6:      # no acceleration changes
            return 0.0, np.inf
        fit = np.linalg.solve(N, X.T @ y)
        residuals = y - X @ fit
        scores = X * residuals[:, None]
        # residuals are correlated: Newey-West covariance
        middle = scores.T @ scores
        for lag in range(1, CORRELATED_ROWS):
            lagged = scores[lag:].T @ scores[:-lag] * (1 - lag / CORRELATED_ROWS)
            middle += lagged + lagged.T
        C = np.linalg.inv(N)
        white_variance = np.sum(residuals**2) / (len(y) - 2) * C[0, 0]
        variance = max(white_variance, (C @ middle @ C)[0, 0])
        return float(-fit[0]) / CHANGE_RATIO, float(np.sqrt(variance)) / CHANGE_RATIO
