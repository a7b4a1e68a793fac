# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Travel of a vehicle by one or two wheels in a stream, and the delay of the IMU relative to it.

In: odometer rows of one or two topics. Out: travel between any two times, with its variance. A
``Wheel`` tests the rows of one topic; ``DelaySearch`` compares the IMU's acceleration with them.
"""

from collections import deque
from collections.abc import Sequence
import math

import numpy as np

from odocal_ros.apply.attitude import Vector
from odocal_ros.apply.errors import GRAVITY
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.apply.wheel import Wheel
from odocal_ros.data.arrays import Floats
from odocal_ros.data.samples import OdometerForm, Reading
from odocal_ros.nav.standstill import REST_TRAVEL
from odocal_ros.settings.node_configs import ApplyConfig

STILL_COUNTS = 1.5    # physical: largest number of counts of a wheel at rest
SIDES = ('odometer', 'odometer_right')
Rows = tuple[str, Sequence[Reading], OdometerForm]
# judgement: least and largest number of rows of the regression, one per second; s, correlation of
# residuals
MIN_DELAY_ROWS, MAX_DELAY_ROWS, LAGS = 60, 300, 4
# judgement: least delay that is reported, s and sigmas. 168 simulated drives without a delay had
# up to 0.028 s and 2.5 sigmas at their ends; of 60 others none was reported at any second
MIN_DELAY, DELAY_SIGMAS = 0.04, 4.0
# judgement: ratio of the change of acceleration within a second to the central difference over
# two, in simulated town drives
CHANGE_RATIO = 1.2


class Wheels:
    """Travel of the vehicle, m: of its only wheel, or the mean of two, each with its scale."""

    def __init__(self, vehicle: Vehicle, config: ApplyConfig, notes: list[str]) -> None:
        self._vehicle, self._notes = vehicle, notes
        self._reversed = config.odometer.reversed
        self._offset_ns = round(config.odometer.time_offset * 1e9)
        self._has_two_topics = config.odometer.has_two_topics
        self._waiting: list[Rows] = []       # blocks from before the first IMU message
        self._wheels: dict[str, Wheel] = {}
        self.zero_ns = 0
        self.quantum = 0.0                   # m, size of a count of the travel

    def feed(self, slot: str, rows: Sequence[Reading], form: OdometerForm) -> None:
        """Add rows of a wheel."""
        self._waiting.append((slot, rows, form))
        if not self.zero_ns:
            self._waiting = self._waiting[-100:]
            return
        for slot, rows, form in self._waiting:
            self._feed(slot, rows, form)
        self._waiting = []

    def _feed(self, slot: str, rows: Sequence[Reading], form: OdometerForm) -> None:
        """Add rows after the first IMU message, whose stamp is t = 0."""
        if slot not in self._wheels:
            self._wheels[slot] = Wheel(form, self._vehicle.scale, self._reversed)
            self._set_scales(form)
        wheel = self._wheels[slot]
        since_ns = self._offset_ns - self.zero_ns
        wheel.feed([(stamp + since_ns) * 1e-9 for stamp, *_ in rows],
                   [value for _, _, value in rows])
        self._notes += wheel.notes
        wheel.notes.clear()
        wheels = self._wheels.values()
        self.quantum = math.hypot(*(one.quantum for one in wheels)) / len(wheels)

    def _set_scales(self, form: OdometerForm) -> None:
        """Set the scales of left and right wheel, if there are two and they are calibrated."""
        scales = self._vehicle.wheel_scales
        if len(self._wheels) == 2 and scales is not None and form.sides_known:
            for slot, scale in zip(SIDES, scales, strict=True):
                self._wheels[slot].rescale(scale)

    def are_complete(self) -> bool:
        """Return True if all expected wheels have rows."""
        return bool(self._wheels) and all(wheel.t for wheel in self._wheels.values()) and (
            not self._has_two_topics or len(self._wheels) == 2)

    def end_time(self) -> float:
        """Return the time up to which all wheels have rows, s."""
        return min(wheel.t[-1] for wheel in self._wheels.values())

    def begin_time(self) -> float:
        """Return the time from which all wheels have rows, s."""
        return max(wheel.t[0] for wheel in self._wheels.values())

    def travel_at(self, t: float) -> float:
        """Return the travel at a time, m."""
        return sum(wheel.travel_at(t) for wheel in self._wheels.values()) / len(self._wheels)

    def variance_between(self, t_from: float, t_to: float) -> float:
        """Return the variance of uncertain travel (faults, gaps) between two times, m^2."""
        wheels = self._wheels.values()
        return sum(wheel.variance_between(t_from, t_to) for wheel in wheels) / len(wheels)**2

    def variances(self, t: float, T: float) -> tuple[float, float]:
        """Return the variances of the travel at t, and of the travel in the T s before, m^2."""
        wheels, squared_count = self._wheels.values(), len(self._wheels)**2
        rounding = self.quantum**2 / 6
        jitter = sum(wheel.jitter_variance(t, T) for wheel in wheels) / squared_count
        interpolation = sum(wheel.interpolation_variance(t) for wheel in wheels) / squared_count
        return rounding + interpolation + jitter / 2, rounding + jitter

    @property
    def delay_s(self) -> float:
        """Return the sigma of the constant delay of the rows, s."""
        return max(wheel.delay_s for wheel in self._wheels.values())

    def are_still(self, t_from: float, t_to: float) -> bool:
        """Return True if no wheel turned between two times and no counter hangs."""
        return all(not wheel.is_hung and abs(wheel.travel_at(t_to) - wheel.travel_at(t_from))
                   <= REST_TRAVEL / 2 + STILL_COUNTS * wheel.quantum
                   for wheel in self._wheels.values())

    def forget(self, t: float) -> None:
        """Drop the rows before a time, s."""
        for wheel in self._wheels.values():
            wheel.forget(t)


class DelaySearch:
    """
    Regression of force minus acceleration on the change of acceleration, one row per second.

    If the IMU is tau s late, its velocity is that of tau s earlier: the change in a second differs
    by -tau times the change of acceleration. A constant (tilt, bias) is estimated too.

    span_s : averaging time of the odometer's speeds, which are late by half of it.   sigma_s :
    configured sigma of the delay, increased if a delay is found.   notes : list for the text.
    """

    def __init__(self, span_s: float, sigma_s: float, notes: list[str]) -> None:
        self.sigma_s, self._notes, self._speed_delay_s = sigma_s, notes, span_s / 2
        self._reported_s = 0.0      # magnitude of the largest reported delay, plus 2 sigma
        # changes of speed in each of the last three seconds, m/s, by odometer and by force
        self._recent_changes: deque[tuple[float, float]] = deque(maxlen=3)
        # rows of the regression: change of acceleration, difference of the changes of speed
        self._rows: deque[tuple[float, float]] = deque(maxlen=MAX_DELAY_ROWS)

    def add(self, forward_n: Vector, change_n: Floats | None, dv_n: Vector, T: float) -> bool:
        """
        Add a second of data; return True if ``sigma_s`` has increased.

        forward_n : forward axis.   change_n : (3,) m/s, change of velocity by the odometer, None
        if not usable.   dv_n : m/s, integral of the specific force.   T : s.
        """
        if change_n is None:
            self._recent_changes.clear()
            return False
        force_n = dv_n - np.array([0.0, 0.0, GRAVITY * T])
        self._recent_changes.append((float(forward_n @ change_n), float(forward_n @ force_n)))
        if len(self._recent_changes) < 3:
            return False
        (before, _), (by_odometer, by_force), (after, _) = self._recent_changes
        self._rows.append(((after - before) / 2, by_force - by_odometer))
        delay, sigma = self._delay()
        delay += self._speed_delay_s
        if abs(delay) < max(MIN_DELAY, DELAY_SIGMAS * sigma, self._reported_s):
            return False
        self._notes.append(f'IMU stamps are {abs(delay):.2f} s (± {sigma:.2f} s) '
                           f'{"late" if delay > 0 else "early"} relative to the odometer: add '
                           f'{-delay:+z.2f} to imu.time_offset; sigma increased')
        self._reported_s = abs(delay) + 2 * sigma
        self.sigma_s = max(self.sigma_s, self._reported_s)
        return True

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
        for lag in range(1, LAGS):
            lagged = scores[lag:].T @ scores[:-lag] * (1 - lag / LAGS)
            middle += lagged + lagged.T
        C = np.linalg.inv(N)
        white_variance = np.sum(residuals**2) / (len(y) - 2) * C[0, 0]
        variance = max(white_variance, (C @ middle @ C)[0, 0])
        return float(-fit[0]) / CHANGE_RATIO, float(np.sqrt(variance)) / CHANGE_RATIO
