# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Travel of a vehicle by the counter of one wheel or of two."""

from collections.abc import Sequence
import math

from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.apply.wheel import Wheel
from odocal_ros.data.samples import OdometerForm, Reading
from odocal_ros.nav.standstill import REST_TRAVEL
from odocal_ros.settings.node_configs import ApplyConfig

STILL_COUNTS = 1.5    # physical: largest number of counts of a wheel at rest
SIDES = ('odometer', 'odometer_right')
Rows = tuple[str, Sequence[Reading], OdometerForm]


class Wheels:
    """
    Travel of the vehicle, m: of its only wheel, or the mean of two.

    Each of two wheels has its own scale if the calibration has both.
    """

    def __init__(self, vehicle: Vehicle, config: ApplyConfig, notes: list[str]) -> None:
        self._vehicle, self._notes = vehicle, notes
        self._reversed = config.odometer.reversed
        self._offset_ns = round(config.odometer.time_offset * 1e9)
        self._two = config.odometer.own_topics
        self._waiting: list[Rows] = []       # blocks from before the first IMU message
        self._wheels: dict[str, Wheel] = {}
        self.zero_ns = 0
        self.quantum = 0.0                   # m, size of a count of the travel

    def feed(self, slot: str, rows: Sequence[Reading], form: OdometerForm) -> None:
        self._waiting.append((slot, rows, form))
        if not self.zero_ns:
            self._waiting = self._waiting[-100:]
            return
        for slot, rows, form in self._waiting:
            self._feed(slot, rows, form)
        self._waiting = []

    def _feed(self, slot: str, rows: Sequence[Reading], form: OdometerForm) -> None:
        if slot not in self._wheels:
            self._wheels[slot] = Wheel(form, self._vehicle.scale, self._reversed)
            self._scale(form)
        wheel = self._wheels[slot]
        since_ns = self._offset_ns - self.zero_ns
        wheel.feed([(stamp + since_ns) * 1e-9 for stamp, *_ in rows],
                   [value for _, _, value in rows])
        self._notes += wheel.notes
        wheel.notes.clear()
        self.quantum = math.hypot(*(w.quantum for w in self._wheels.values())) / len(self._wheels)

    def _scale(self, form: OdometerForm) -> None:
        scales = self._vehicle.wheel_scales
        if len(self._wheels) == 2 and scales is not None and form.sides:
            for slot, scale in zip(SIDES, scales, strict=True):
                self._wheels[slot].rescale(scale)

    def ready(self) -> bool:
        return bool(self._wheels) and all(w.t for w in self._wheels.values()) and (
            not self._two or len(self._wheels) == 2)

    def newest(self) -> float:
        return min(w.t[-1] for w in self._wheels.values())

    def oldest(self) -> float:
        return max(w.t[0] for w in self._wheels.values())

    def at(self, t: float) -> float:
        """Return the travel at a time, m."""
        return sum(wheel.at(t) for wheel in self._wheels.values()) / len(self._wheels)

    def variance_between(self, t_from: float, t_to: float) -> float:
        """Return the variance of uncertain travel (faults, gaps) between two times, m^2."""
        wheels = self._wheels.values()
        return sum(w.variance_between(t_from, t_to) for w in wheels) / len(wheels)**2

    def variances(self, t: float, T: float) -> tuple[float, float]:
        """Return the variances of the travel at t, and of the travel in the T s before, m^2."""
        wheels, n = self._wheels.values(), len(self._wheels)**2
        rounding = self.quantum**2 / 6
        jitter = sum(w.jitter_variance(t, T) for w in wheels) / n
        interpolation = sum(w.interpolation_variance(t) for w in wheels) / n
        return rounding + interpolation + jitter / 2, rounding + jitter

    @property
    def delay_s(self) -> float:
        return max(w.delay_s for w in self._wheels.values())

    def still(self, t_from: float, t_to: float) -> bool:
        """Return True if no wheel turned between two times and no counter hangs."""
        return all(not w.hung and abs(w.at(t_to) - w.at(t_from))
                   <= REST_TRAVEL / 2 + STILL_COUNTS * w.quantum for w in self._wheels.values())

    def forget(self, t: float) -> None:
        for wheel in self._wheels.values():
            wheel.forget(t)
