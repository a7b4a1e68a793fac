# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Odometry of a stream: screened samples, a start, and the path from there.

If the path cannot be continued, it restarts at its origin, with a note.
"""

import math

import numpy as np

from odocal_ros.apply.arrivals import Arrivals, MOVED_ROWS, STAYS_ROWS
from odocal_ros.apply.odometry_start import begin
from odocal_ros.apply.pose import Pose
from odocal_ros.apply.reckoning import ODOMETER_SILENCE, Reckoning
from odocal_ros.apply.stream import ImuStream
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.apply.wheels import Wheels
from odocal_ros.data.leg import COUNTER
from odocal_ros.data.samples import (
    ImuSamples,
    OdometerForm,
    OdometerSamples,
    Reading,
    readings_of,
)
from odocal_ros.settings.levels import CLOCK_APART
from odocal_ros.settings.node_configs import ApplyConfig
from odocal_ros.settings.nominal import grade_of

RESTARTS = 'odometry restarts'      # begin of the note on a restart


class Odometry:
    """
    Conversion of samples to poses.

    ``feed`` adds blocks in order of arrival. ``poses`` returns the poses up to the newest odometer
    row and the newest IMU row but one.
    """

    def __init__(self, vehicle: Vehicle, config: ApplyConfig) -> None:
        self.vehicle, self.config = vehicle, config
        self.grade = grade_of(config.imu)
        self.restarts = 0
        self._first_ahead: float | None = None
        self._notes: list[str] = []
        self._reset()

    def take_notes(self) -> list[str]:
        """Return the notes since the last call, each once."""
        notes = list(dict.fromkeys(self._notes))
        self._notes.clear()
        return notes

    def apart(self) -> float:
        """Return the lead of the odometer's clock over the IMU's, s, 0 if it may be a delay."""
        ahead = self._ahead()
        # a bag that is played fast has a coarser time of arrival
        return ahead if abs(ahead) > CLOCK_APART and abs(ahead) > CLOCK_APART * max(
            one.rate for one in self._arrivals.values()) else 0.0

    def _ahead(self) -> float:
        """Return the lead of the odometer's stamps over the IMU's, s, 0 if unknown."""
        imu = self._arrivals.get('imu')
        if imu is None or imu.lag_ns is None:
            return 0.0
        return max((imu.lag_ns - one.lag_ns for one in self._arrivals.values()
                    if one.lag_ns is not None), key=abs) * 1e-9

    def restart(self, why: str) -> None:
        self.restarts += 1
        self._notes.append(f'{RESTARTS} from the origin: {why}')
        self._reset()

    def _reset(self) -> None:
        self.wheels = Wheels(self.vehicle, self.config, self._notes)
        self.imu = ImuStream(self.config, self._notes)
        self._arrivals: dict[str, Arrivals] = {}
        self._path: Reckoning | None = None

    def feed(self, slot: str, block: ImuSamples | OdometerSamples | list[Reading],
             form: OdometerForm | None = None) -> None:
        """Add rows of 'imu', 'odometer' or 'odometer_right'; the latter two have a form."""
        if slot not in self._arrivals:
            self._arrivals[slot] = Arrivals()
        arrivals = self._arrivals[slot]
        rows = block if isinstance(block, list) else readings_of(block)
        usable = arrivals.usable(rows)
        if arrivals.jumped:
            self.restart(f'the {slot} stamps jump by {arrivals.off_s:+.3g} s')
            rows = rows[arrivals.jump_row:]
            arrivals = self._arrivals[slot] = Arrivals()
            usable = arrivals.usable(rows)
        if arrivals.dropped:
            self._notes.append(f'{slot}: {arrivals.dropped} messages dropped: their stamps differ '
                              f'from their arrival times by {arrivals.off_s:+.3g} s')
        if slot == 'imu':
            self.imu.feed(usable)
        else:
            self.wheels.feed(slot, usable, form or COUNTER)
        self.wheels.zero_ns = self.imu.zero_ns

    def lacking_s(self) -> float:
        """Return the time from the newest odometer row to the next pose, s; inf without a path."""
        return math.inf if self._path is None else self._path.due() - self.wheels.newest()

    def wait_s(self) -> float:
        """Return the time until the samples of the next pose arrive, s, if without delay."""
        return self.lacking_s() + self.imu.usual

    def poses(self) -> list[Pose]:
        apart = self.apart()
        if apart and self._path is not None:
            self.restart(f'odometer stamps differ from IMU stamps by {apart:+.3g} s')
        if self._path is None and not apart:
            self._path = self._begin()
        if self._path is None:
            self.imu.forget(ODOMETER_SILENCE)
            return []
        moved = max(one.moved_s(MOVED_ROWS) for one in self._arrivals.values())
        stays = max(one.moved_s(STAYS_ROWS) for one in self._arrivals.values()) if moved else 0.0
        out = self._path.poses(moved, stays)
        if self._path.failed:
            self.restart(self._path.failed)
        return out

    def _begin(self) -> Reckoning | None:
        start = begin(self.imu, self.wheels, self.vehicle, self.config, self.grade)
        if start is None:
            return None
        ahead = self._ahead()
        if self._first_ahead is None:
            self._first_ahead = ahead
        # after one clock was set, the stamps have an additional offset that is not calibrated
        delay = float(np.hypot(self.config.odometer.time_sigma, ahead - self._first_ahead))
        return Reckoning(start, self.imu, self.wheels, self.vehicle, self.config, self._notes,
                         delay)
