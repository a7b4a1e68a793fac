# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Delay of the IMU's stamps relative to the odometer's, estimated while driving."""

from collections import deque

import numpy as np

from odocal_ros.apply.attitude import Vector
from odocal_ros.apply.errors import GRAVITY
from odocal_ros.data.arrays import Floats

# judgement: least and largest number of rows, one per second; s, correlation of residuals
LEAST_DELAY_ROWS, MOST_DELAY_ROWS, LAGS = 60, 300, 4
# judgement: least delay that is reported, s and sigmas. 168 simulated drives without a delay had
# up to 0.028 s and 2.5 sigmas at their ends; of 60 others none was reported at any second
LEAST_DELAY, DELAY_SIGMAS = 0.04, 4.0
# judgement: ratio of the change of acceleration within a second to the central difference over
# two, in simulated town drives
CHANGE_SMOOTHED = 1.2


class DelaySearch:
    """
    Regression of force minus acceleration on the change of acceleration, one row per second.

    If the IMU is tau s late, its velocity is that of tau s earlier: the change in a second differs
    by -tau times the change of acceleration. A constant (tilt, bias) is estimated too.

    span_s : averaging time of the odometer's speeds, which are late by half of it.   sigma_s :
    configured sigma of the delay, increased if a delay is found.   notes : list for the text.
    """

    def __init__(self, span_s: float, sigma_s: float, notes: list[str]) -> None:
        self.sigma_s, self._notes, self._own_s, self._found_s = sigma_s, notes, span_s / 2, 0.0
        self._last: deque[tuple[float, float]] = deque(maxlen=3)
        self._rows: deque[tuple[float, float]] = deque(maxlen=MOST_DELAY_ROWS)

    def take(self, forward_n: Vector, change_n: Floats | None, dv_n: Vector, T: float) -> bool:
        """
        Add a second of data; return True if ``sigma_s`` has increased.

        forward_n : forward axis.   change_n : (3,) m/s, change of velocity by the odometer, None
        if not usable.   dv_n : m/s, integral of the specific force.   T : s.
        """
        if change_n is None:
            self._last.clear()
            return False
        force_n = dv_n - np.array([0.0, 0.0, GRAVITY * T])
        self._last.append((float(forward_n @ change_n), float(forward_n @ force_n)))
        if len(self._last) < 3:
            return False
        (before, _), (own, by_force), (after, _) = self._last
        self._rows.append(((after - before) / 2, by_force - own))
        delay, sigma = self._delay()
        delay += self._own_s
        if abs(delay) < max(LEAST_DELAY, DELAY_SIGMAS * sigma, self._found_s):
            return False
        self._notes.append(f'IMU stamps are {abs(delay):.2f} s (± {sigma:.2f} s) '
                           f'{"late" if delay > 0 else "early"} relative to the odometer: add '
                           f'{-delay:+z.2f} to imu.time_offset; sigma increased')
        self._found_s = abs(delay) + 2 * sigma
        self.sigma_s = max(self.sigma_s, self._found_s)
        return True

    def _delay(self) -> tuple[float, float]:
        """Return the delay of the IMU, s, and its sigma, infinite while there are too few rows."""
        if len(self._rows) < LEAST_DELAY_ROWS:
            return 0.0, np.inf
        x, y = np.array(self._rows).T
        X = np.stack([x, np.ones_like(x)], 1)
        N = X.T @ X
        if np.linalg.cond(N) > 1e6:      # no acceleration changes
            return 0.0, np.inf
        fit = np.linalg.solve(N, X.T @ y)
        scores = X * (y - X @ fit)[:, None]
        # residuals are correlated: Newey-West covariance
        middle = scores.T @ scores
        for lag in range(1, LAGS):
            product = scores[lag:].T @ scores[:-lag] * (1 - lag / LAGS)
            middle += product + product.T
        C = np.linalg.inv(N)
        white = np.sum((y - X @ fit)**2) / (len(y) - 2) * C[0, 0]
        variance = max(white, (C @ middle @ C)[0, 0])
        return float(-fit[0]) / CHANGE_SMOOTHED, float(np.sqrt(variance)) / CHANGE_SMOOTHED
