# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Travel of a vehicle in a stream: of its only wheel, or the mean of two."""

from collections.abc import Sequence
import math

from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.apply.wheel import Wheel
from odocal_ros.data.samples import OdometerForm, Reading
from odocal_ros.nav.standstill import REST_TRAVEL
from odocal_ros.settings.node_configs import ApplyConfig

STILL_COUNTS = 1.5    # physical: largest number of counts of a wheel at rest
SIDES = ('odometer', 'odometer_right')
MAX_WAITING_BLOCKS = 100       # judgement: blocks of rows kept before the first IMU message


class Wheels:
    """The wheels that are measured, one or two, each with its scale."""

    def __init__(self, vehicle: Vehicle, config: ApplyConfig, notes: list[str]) -> None:
        self._vehicle, self._notes = vehicle, notes
        self._is_reversed = config.odometer.reversed
        self._offset_ns = round(config.odometer.time_offset * 1e9)
        self._has_two_topics = config.odometer.has_two_topics
        # slot and rows of blocks from before the first IMU message
        self._waiting: list[tuple[str, Sequence[Reading]]] = []
        self._forms: dict[str, OdometerForm] = {}
        self._wheels: dict[str, Wheel] = {}
        self.quantum = 0.0                   # m, size of a count of the travel

    def feed(self, slot: str, rows: Sequence[Reading], form: OdometerForm, zero_ns: int) -> None:
        """
        Add rows of a wheel, or keep them until the first IMU message.

        slot : one of SIDES.   zero_ns : stamp of t = 0; 0: not known yet.
        """
        self._waiting.append((slot, rows))
        self._forms[slot] = form
        if not zero_ns:
            self._waiting = self._waiting[-MAX_WAITING_BLOCKS:]
            return
        offset_ns = self._offset_ns - zero_ns      # from stamps to t
        for waiting_slot, waiting_rows in self._waiting:
            wheel = self._wheel(waiting_slot)
            wheel.feed([(stamp + offset_ns) * 1e-9 for stamp, *_ in waiting_rows],
                       [value for _, _, value in waiting_rows])
            self._notes += wheel.notes
            wheel.notes.clear()
        self._waiting = []
        wheels = self._wheels.values()
        self.quantum = math.hypot(*(wheel.quantum for wheel in wheels)) / len(wheels)

    def _wheel(self, slot: str) -> Wheel:
        """Return the wheel of a slot; with the second one, both get their calibrated scales."""
        if slot not in self._wheels:
            form, scales = self._forms[slot], self._vehicle.wheel_scales
            self._wheels[slot] = Wheel(form, self._vehicle.scale, self._is_reversed)
            if len(self._wheels) == 2 and scales is not None and form.sides_known:
                for side, scale in zip(SIDES, scales, strict=True):
                    self._wheels[side].rescale(scale)
        return self._wheels[slot]

    def are_complete(self) -> bool:
        """Return True if all expected wheels have rows."""
        return bool(self._wheels) and all(wheel.times for wheel in self._wheels.values()) and (
            not self._has_two_topics or len(self._wheels) == 2)

    def end_time(self) -> float:
        """Return the time up to which all wheels have rows, s."""
        return min(wheel.times[-1] for wheel in self._wheels.values())

    def begin_time(self) -> float:
        """Return the time from which all wheels have rows, s."""
        return max(wheel.times[0] for wheel in self._wheels.values())

    def travel_at(self, t: float) -> float:
        """Return the travel at a time, m."""
        return sum(wheel.travel_at(t) for wheel in self._wheels.values()) / len(self._wheels)

    def variance_between(self, t_from: float, t_to: float) -> float:
        """Return the variance of travel that is not measured (faults, gaps), m^2."""
        wheels = self._wheels.values()
        return sum(wheel.variance_between(t_from, t_to) for wheel in wheels) / len(wheels)**2

    def variances(self, t: float, T: float) -> tuple[float, float]:
        """Return the variances, m^2, of the travel until t, and from t - T to t."""
        wheels, squared_count = self._wheels.values(), len(self._wheels)**2
        # travel is a difference of two readings: it has the rounding, quantum^2 / 12, and the
        # jitter of both ends
        rounding = self.quantum**2 / 6
        jitter = sum(wheel.jitter_variance(t, T) for wheel in wheels) / squared_count
        interpolation = sum(wheel.interpolation_variance(t) for wheel in wheels) / squared_count
        return rounding + interpolation + jitter / 2, rounding + jitter

    @property
    def delay_sigma_s(self) -> float:
        """Return the sigma of the constant delay of the rows, s."""
        return max(wheel.row_times.delay_sigma_s for wheel in self._wheels.values())

    def are_still(self, t_from: float, t_to: float) -> bool:
        """Return True if no wheel turned between two times and no counter is stuck."""
        return all(not wheel.is_hung and abs(wheel.travel_at(t_to) - wheel.travel_at(t_from))
                   <= REST_TRAVEL / 2 + STILL_COUNTS * wheel.quantum
                   for wheel in self._wheels.values())

    def forget(self, t: float) -> None:
        """Drop the rows before a time, s."""
        for wheel in self._wheels.values():
            wheel.forget(t)
