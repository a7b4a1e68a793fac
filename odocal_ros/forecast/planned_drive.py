# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A drive not yet driven, or only looked at: speed, direction and slope by time."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats
from odocal_ros.data.pieces import runs
from odocal_ros.errors import BadUsage
from odocal_ros.nav.integral import running_integral
from odocal_ros.nav.rotations import matrix_from_rpy

REST_SPEED = 1e-6     # m/s, judgement: below it a planned drive stands
DRIVE_STEP = 0.1      # s, judgement: of drives made here


@dataclass(frozen=True, eq=False)
class PlannedDrive:
    """
    A drive by time; the start mark is at 0, the stop mark at the last time.

    t : (m,) s, rising; what lies before 0 is for the alignment.
    speed : (m,) m/s of the odometer's point, negative backwards.
    yaw : (m,) rad, of the vehicle, ENU.    slope : (m,) rad, nose up.
    latitude, longitude, height : rad, rad, m of the start.
    """

    t: NDArray[np.float64]
    speed: NDArray[np.float64]
    yaw: NDArray[np.float64]
    slope: NDArray[np.float64]
    latitude: float = 0.7
    longitude: float = 0.0
    height: float = 0.0

    def __post_init__(self) -> None:
        rows = {name: np.array(getattr(self, name), dtype=float)
                for name in ('t', 'speed', 'yaw', 'slope')}
        if len({row.shape for row in rows.values()}) > 1 or rows['t'].ndim != 1:
            raise BadUsage('the planned drive needs one speed, yaw and slope for each time')
        if not all(np.isfinite(row).all() for row in rows.values()):
            raise BadUsage('the planned drive holds numbers that are not finite; check its source')
        if len(rows['t']) < 2 or not (np.diff(rows['t']) > 0).all():
            raise BadUsage('the planned drive needs two or more increasing times')
        for name, row in rows.items():
            row.setflags(write=False)
            object.__setattr__(self, name, row)
        least_motion = 1.0    # m: less is no drive
        if self.distance < least_motion:
            raise BadUsage(f'the planned drive never moves ({self.distance:.2f} m between the '
                           'marks); give it a speed and a distance')

    @property
    def C_nb(self) -> NDArray[np.float64]:
        """Return the attitude of an IMU that looks forward, (m, 3, 3)."""
        return matrix_from_rpy(np.stack([np.zeros_like(self.yaw), -self.slope, self.yaw], -1))

    @property
    def travel(self) -> NDArray[np.float64]:
        """Return the signed travel at each time, 0 at the start mark, (m,) m."""
        s = running_integral(self.t, self.speed)
        path_length: Floats = s - np.interp(0.0, self.t, s)
        return path_length

    @property
    def distance(self) -> float:
        """Return the metres driven between the marks, forwards and backwards."""
        inside = self.t >= 0.0
        return float(np.abs(np.diff(self.travel[inside])).sum())

    @property
    def duration(self) -> float:
        """Return the seconds between the marks."""
        return float(self.t[-1])

    def standstills(self, shortest: float) -> list[tuple[float, float]]:
        """Return begin and end of the stretches at rest that last ``shortest`` s or more."""
        rest = np.abs(self.speed) <= REST_SPEED
        spans = self.t[runs(rest) - [0, 1]]
        return [(float(a), float(b)) for a, b in spans if b - a >= shortest]

    def lengthened(self, metres: float) -> 'PlannedDrive':
        """Return the drive with so many metres more at its fastest moment, straight ahead."""
        k = int(np.argmax(np.where(self.t >= 0, np.abs(self.speed), -1.0)))
        return self._held(k, metres / abs(self.speed[k]))

    def standing_longer(self, seconds: float) -> 'PlannedDrive':
        """Return the drive with so much more rest before the start and at the stop mark."""
        return self._held(len(self.t) - 1, seconds, at_rest=True)._held(0, seconds, at_rest=True)

    def turned_around(self) -> 'PlannedDrive':
        """Return the same drive in the other direction."""
        return replace(self, yaw=self.yaw + np.pi)

    def until(self, t_stop: float, rest: float) -> 'PlannedDrive':
        """Return the drive up to a time and a stop of ``rest`` s there."""
        keep = self.t <= t_stop
        cut = replace(self, **{n: getattr(self, n)[keep]
                               for n in ('t', 'speed', 'yaw', 'slope')})
        return cut._held(len(cut.t) - 1, rest, at_rest=True)

    def _held(self, k: int, seconds: float, at_rest: bool = False) -> 'PlannedDrive':
        """Return the drive with the state of row k held for so long; before 0, all moves back."""
        hold = np.arange(DRIVE_STEP, seconds + DRIVE_STEP, max(DRIVE_STEP, seconds / 1000))
        hold = hold * (seconds / hold[-1])
        rows: dict[str, Any] = {
            name: np.insert(getattr(self, name), k + 1, np.full(len(hold), value))
            for name, value in (('speed', 0.0 if at_rest else self.speed[k]),
                                ('yaw', self.yaw[k]), ('slope', self.slope[k]))}
        t = np.concatenate([self.t[:k + 1], self.t[k] + hold, self.t[k + 1:] + seconds])
        if at_rest and k == 0:
            t, rows['speed'] = t - seconds, np.where(np.arange(len(t)) <= len(hold), 0.0,
                                                     rows['speed'])
        return replace(self, t=t, **rows)


def from_rates(t: Floats, speed: Floats, yaw_rate: Floats, heading: float = np.pi / 4,
               **more: Any) -> PlannedDrive:
    """
    Return the drive of a speed and a turn rate by time; marked where it first moves and ends.

    t, speed, yaw_rate : (m,) s, m/s, rad/s (left positive).   heading : of the vehicle at the
    start, clockwise from north, rad.   more : further fields of PlannedDrive; slope is 0 where
    it is not given.
    """
    t, speed, yaw_rate = (np.asarray(x, dtype=float) for x in (t, speed, yaw_rate))
    yaw = np.pi / 2 - heading + running_integral(t, yaw_rate)
    return marked(t, speed, yaw, more.pop('slope', np.zeros_like(t)),
                  **more)


def marked(t: Floats, speed: Floats, yaw: Floats, slope: Floats, **more: Any) -> PlannedDrive:
    """Return the drive with its start mark where it first moves, its stop mark at its end."""
    moving = np.flatnonzero(np.abs(speed) > REST_SPEED)
    first = max(int(moving[0]) - 1, 0) if len(moving) else 0
    return PlannedDrive(np.asarray(t) - t[first], speed, yaw, slope, **more)
