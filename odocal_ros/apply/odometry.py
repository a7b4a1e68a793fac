# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Odometry of a stream: from samples, block by block, to poses with covariances.

The stamps are tested; the start gives attitude and gyro bias; dead reckoning continues from there.
If the path cannot be continued, it restarts at its origin, with a note.
"""

import math

import numpy as np

from odocal_ros.apply.odometry_start import find_start
from odocal_ros.apply.pose import Pose
from odocal_ros.apply.reckoning import DeadReckoning, ODOMETER_SILENCE
from odocal_ros.apply.stamp_screen import PERMANENT_ROWS, StampScreen, STEP_ROWS
from odocal_ros.apply.stream import ImuStream
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.apply.wheels import Wheels
from odocal_ros.data import samples
from odocal_ros.data.leg import COUNTER
from odocal_ros.settings.levels import CLOCK_DIFFERENCE_LIMIT
from odocal_ros.settings.node_configs import ApplyConfig
from odocal_ros.settings.nominal import grade_of

RESTARTS = 'odometry restarts'      # first words of the note on a restart


def stamp_difference_text(difference_s: float) -> str:
    """Return the text on a lead of the odometer stamps over the IMU stamps, s."""
    return (f'odometer stamps differ from IMU stamps by {difference_s:+.3g} s; the limit is '
            f'{CLOCK_DIFFERENCE_LIMIT:g} s. Likely cause: the drivers use different clocks. '
            'Synchronise the clocks, set odometer.arrival_time and imu.arrival_time to true, or '
            'set use_sim_time if a bag is played')


class Odometry:
    """
    Conversion of samples to poses.

    ``feed`` adds blocks in order of arrival. ``poses`` returns the poses up to the newest odometer
    row and the newest IMU row but one.
    """

    def __init__(self, vehicle: Vehicle, config: ApplyConfig) -> None:
        self.vehicle, self.config = vehicle, config
        self.grade = grade_of(config.imu)
        self.restarts = 0      # number so far
        self._first_lead_s: float | None = None      # ``_odometer_lead_s`` at the first start
        self._notes: list[str] = []
        self._reset()

    def take_notes(self) -> list[str]:
        """Return the notes since the last call, each once."""
        notes = list(dict.fromkeys(self._notes))
        self._notes.clear()
        return notes

    def clock_difference_s(self) -> float:
        """Return the lead of the odometer's clock over the IMU's, s, 0 if it may be a delay."""
        lead = self._odometer_lead_s()
        # a bag that is played fast has a coarser time of arrival
        rates = (screen.rate for screen in self._screens.values())
        limit = CLOCK_DIFFERENCE_LIMIT * max(1.0, *rates) if self._screens else math.inf
        return lead if abs(lead) > limit else 0.0

    def _odometer_lead_s(self) -> float:
        """Return the lead of the odometer's stamps over the IMU's, s, 0 if unknown."""
        imu = self._screens.get('imu')
        if imu is None or imu.lag_ns is None:
            return 0.0
        return max((imu.lag_ns - screen.lag_ns for screen in self._screens.values()
                    if screen.lag_ns is not None), key=abs) * 1e-9

    def restart(self, reason: str) -> None:
        """Restart from the origin, and add a note with the reason."""
        self.restarts += 1
        self._notes.append(f'{RESTARTS} from the origin: {reason}')
        self._reset()

    def _reset(self) -> None:
        self.wheels = Wheels(self.vehicle, self.config, self._notes)
        self.imu = ImuStream(self.config, self._notes)
        self._screens: dict[str, StampScreen] = {}
        self._path: DeadReckoning | None = None

    def feed(self, slot: str,
             block: samples.ImuSamples | samples.OdometerSamples | list[samples.Reading],
             form: samples.OdometerForm | None = None) -> None:
        """Add rows of 'imu', 'odometer' or 'odometer_right'; the latter two have a form."""
        if slot not in self._screens:
            self._screens[slot] = StampScreen()
        screen = self._screens[slot]
        rows = block if isinstance(block, list) else samples.readings_of(block)
        usable = screen.select_usable(rows)
        if screen.clock_jumped:
            self.restart(f'the {slot} stamps jump by {screen.excess_s:+.3g} s')
            rows = rows[screen.jump_row:]
            screen = self._screens[slot] = StampScreen()
            usable = screen.select_usable(rows)
        if screen.dropped:
            plural = 's' if screen.dropped > 1 else ''
            self._notes.append(f'{slot}: {screen.dropped} message{plural} dropped: '
                               f'{screen.drop_cause}')
        if slot == 'imu':
            self.imu.feed(usable)
        else:
            self.wheels.feed(slot, usable, form or COUNTER, self.imu.zero_ns)

    def missing_odometer_s(self) -> float:
        """Return the time from the newest odometer row to the next pose, s; inf without a path."""
        if self._path is None:
            return math.inf
        return self._path.next_pose_time() - self.wheels.end_time()

    def wait_s(self) -> float:
        """Return the time until the samples of the next pose arrive, s, if without delay."""
        return self.missing_odometer_s() + self.imu.median_interval

    def poses(self) -> list[Pose]:
        """Return the poses whose samples have arrived since the last call."""
        clock_difference_s = self.clock_difference_s()
        if clock_difference_s and self._path is not None:
            self.restart(stamp_difference_text(clock_difference_s))
        if self._path is None and not clock_difference_s:
            self._path = self._start_path()
        if self._path is None:
            self.imu.forget(ODOMETER_SILENCE)
            return []
        clock_step = max(screen.clock_step_s(STEP_ROWS) for screen in self._screens.values())
        permanent_step = max(screen.clock_step_s(PERMANENT_ROWS)
                             for screen in self._screens.values()) if clock_step else 0.0
        poses = self._path.poses(clock_step, permanent_step)
        if self._path.failed:
            self.restart(self._path.failed)
        return poses

    def _start_path(self) -> DeadReckoning | None:
        """Return the path from a start, None while there are too few samples."""
        start = find_start(self.imu, self.wheels, self.vehicle, self.config, self.grade)
        if start is None:
            return None
        lead = self._odometer_lead_s()
        if self._first_lead_s is None:
            self._first_lead_s = lead
        # after one clock was set, the stamps have an additional offset that is not calibrated
        delay = float(np.hypot(self.config.odometer.time_sigma, lead - self._first_lead_s))
        return DeadReckoning(start, self.imu, self.wheels, self.vehicle, self.config, self._notes,
                         delay)
