# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A planned or recorded drive as speed, yaw and slope by time, and manoeuvres added to it."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats, running_sum, runs
from odocal_ros.errors import BadUsage
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.nav.time_series import running_integral

REST_SPEED = 1e-6     # m/s, judgement: below it a planned drive is at rest
SPOT_TURN = 0.05      # rad/s, judgement: a robot that turns on the spot is not at rest
DRIVE_STEP = 0.1      # s, judgement: time step of generated drives
BRAKING = 1.5         # m/s^2, judgement: as in a town
QUARTER = np.pi / 2   # definition: rad
# judgement: a minute of town, s and m/s: rest, acceleration, cruise with a turn, braking, rest
TOWN_T = np.array([0.0, 5.0, 15.0, 40.0, 50.0, 60.0])
TOWN_SPEED = np.array([0.0, 0.0, 12.0, 12.0, 0.0, 0.0])
TOWN_SIDES = 1.0, 1.0, -1.0, -1.0    # turns of four minutes: left, left, right, right


@dataclass(frozen=True, eq=False)
class PlannedDrive:
    """A drive by time; the start mark is at 0, the stop mark at the last time."""

    t: NDArray[np.float64]         # (m,) s, rising; times before 0 are for the alignment
    speed: NDArray[np.float64]     # (m,) m/s of the odometer's point, negative backwards
    yaw: NDArray[np.float64]       # (m,) rad, of the vehicle, ENU
    slope: NDArray[np.float64]     # (m,) rad, nose up
    latitude: float = 0.7          # rad, of the start, as the longitude
    longitude: float = 0.0
    height: float = 0.0            # m

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
        min_motion = 1.0    # m: less is no drive
        if self.distance < min_motion:
            raise BadUsage(f'the planned drive never moves ({self.distance:.2f} m between the '
                           'marks); give it a speed and a distance')

    @property
    def C_nb(self) -> NDArray[np.float64]:
        """Return the attitude of an IMU aligned with the vehicle, (m, 3, 3)."""
        return matrix_from_rpy(np.stack([np.zeros_like(self.yaw), -self.slope, self.yaw], -1))

    @property
    def travel(self) -> NDArray[np.float64]:
        """Return the signed travel at each time, 0 at the start mark, (m,) m."""
        s = running_integral(self.t, self.speed)
        return s - np.interp(0.0, self.t, s)

    @property
    def distance(self) -> float:
        """Return the path length between the marks, forwards and backwards, m."""
        return float(np.abs(np.diff(self.travel[self.t >= 0.0])).sum())

    @property
    def duration(self) -> float:
        """Return the time between the marks, s."""
        return float(self.t[-1])

    def standstills(self, shortest: float) -> list[tuple[float, float]]:
        """Return (begin, end) of the standstills of at least ``shortest`` s."""
        turning = np.abs(np.gradient(self.yaw, self.t)) > SPOT_TURN      # on the spot
        spans = self.t[runs((np.abs(self.speed) <= REST_SPEED) & ~turning) - [0, 1]]
        return [(float(a), float(b)) for a, b in spans if b - a >= shortest]

    def lengthen(self, metres: float) -> 'PlannedDrive':
        """Return the drive extended straight ahead by ``metres`` at its fastest moment."""
        fastest = int(np.argmax(np.where(self.t >= 0, np.abs(self.speed), -1.0)))
        return self._hold_row(fastest, metres / abs(self.speed[fastest]))

    def lengthen_rests(self, seconds: float) -> 'PlannedDrive':
        """Return the drive with ``seconds`` more rest before the start and at the stop mark."""
        return self._hold_row(len(self.t) - 1, seconds, at_rest=True)._hold_row(0, seconds,
                                                                                at_rest=True)

    def turn_around(self) -> 'PlannedDrive':
        """Return the drive in the opposite direction."""
        return replace(self, yaw=self.yaw + np.pi)

    def cut_at(self, t_stop: float, rest: float) -> 'PlannedDrive':
        """Return the drive up to a time and a stop of ``rest`` s there."""
        keep = self.t <= t_stop
        cut = replace(self, **{name: getattr(self, name)[keep]
                               for name in ('t', 'speed', 'yaw', 'slope')})
        return cut._hold_row(len(cut.t) - 1, rest, at_rest=True)

    def _hold_row(self, k: int, seconds: float, at_rest: bool = False) -> 'PlannedDrive':
        """Return the drive with row k held for ``seconds``; a rest at row 0 is added before it."""
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


def drive_from_rates(t: Floats, speed: Floats, yaw_rate: Floats, heading: float = np.pi / 4,
                     **more: Any) -> PlannedDrive:
    """
    Return a drive from speed and turn rate, with marks at its first motion and its end.

    t, speed, yaw_rate : (m,) s, m/s, rad/s (left positive).   heading : of the vehicle at the
    start, clockwise from north, rad.   more : further fields of PlannedDrive; slope is 0 where
    it is not given.
    """
    t, speed, yaw_rate = (np.asarray(x, dtype=float) for x in (t, speed, yaw_rate))
    yaw = np.pi / 2 - heading + running_integral(t, yaw_rate)
    return with_marks(t, speed, yaw, more.pop('slope', np.zeros_like(t)), **more)


def with_marks(t: Floats, speed: Floats, yaw: Floats, slope: Floats, **more: Any) -> PlannedDrive:
    """Return the drive with its start mark where it first moves, its stop mark at its end."""
    moving = np.flatnonzero(np.abs(speed) > REST_SPEED)
    first = max(int(moving[0]) - 1, 0) if len(moving) else 0
    return PlannedDrive(np.asarray(t) - t[first], speed, yaw, slope, **more)


def add_stop_and_start(drive: PlannedDrive) -> PlannedDrive:
    """Return the drive with one more stop: braking, 5 s of standing, acceleration."""
    row = _middle_row(drive)
    cruise = drive.speed[row]
    ramp = abs(cruise) / BRAKING
    stop_time = 5.0    # s of a stop
    t = _time_grid(2 * ramp + stop_time, ramp, ramp + stop_time)
    return insert_section(drive, row, t,
                          np.interp(t, [0.0, ramp, ramp + stop_time, 2 * ramp + stop_time],
                                    [cruise, 0.0, 0.0, cruise]), np.zeros_like(t))


def add_left_and_right_turns(drive: PlannedDrive) -> PlannedDrive:
    """Return the drive with a turn of 90 deg to the left and, a little later, one to the right."""
    row = _middle_row(drive)
    cruise = drive.speed[row]
    shortest_turn, sideways_limit = 8.0, 2.0    # s; m/s^2
    turn = max(shortest_turn, QUARTER * abs(cruise) / sideways_limit)
    between_turns = 5.0    # s straight between the two turns
    end = 2 * turn + between_turns
    t = _time_grid(end, turn, turn + between_turns)
    return insert_section(drive, row, t, np.full_like(t, cruise), np.interp(
        t, [0.0, turn, turn + between_turns, end], [0.0, QUARTER, QUARTER, 0.0]))


def add_town_driving(drive: PlannedDrive, minutes: int) -> PlannedDrive:
    """Return the drive with minutes of stop and go, with turns, before its last standstill."""
    moving = int(np.flatnonzero(np.abs(drive.speed) > REST_SPEED)[-1])
    row = min(moving + 1, len(drive.t) - 1)
    last_speed, yaw = drive.speed[row], 0.0
    t, speed, turn_angle = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    brake = abs(last_speed) / BRAKING      # s
    if brake > DRIVE_STEP:          # the drive ends in motion
        times = _time_grid(brake)
        t, speed, turn_angle = [times], [last_speed * (1 - times / brake)], [np.zeros_like(times)]
    town_turn = 22.0, 30.0    # s, begin and end in the minute
    for minute in range(minutes):
        times = _time_grid(TOWN_T[-1], *TOWN_T[1:-1], *town_turn)
        angle = QUARTER * TOWN_SIDES[minute % len(TOWN_SIDES)]
        t.append(times + brake + minute * TOWN_T[-1])
        speed.append(np.interp(times, TOWN_T, TOWN_SPEED))
        turn_angle.append(yaw + np.interp(times, town_turn, [0.0, angle]))
        yaw += angle
    return insert_section(drive, row, *map(np.concatenate, (t, speed, turn_angle)))


def insert_section(drive: PlannedDrive, row: int, t: Floats, speed: Floats,
                   turn_angle: Floats) -> PlannedDrive:
    """
    Return the drive with a section inserted after a row; later rows are delayed and rotated.

    row : its number, between the marks.   t, speed, turn_angle : of the section, (m,) s since the
    row, above 0 and rising; m/s; rad to the left since the row.
    """
    return replace(
        drive, t=np.concatenate([drive.t[:row + 1], drive.t[row] + t, drive.t[row + 1:] + t[-1]]),
        speed=np.insert(drive.speed, row + 1, speed),
        slope=np.insert(drive.slope, row + 1, np.full(len(t), drive.slope[row])),
        yaw=np.concatenate([drive.yaw[:row + 1], drive.yaw[row] + turn_angle,
                            drive.yaw[row + 1:] + turn_angle[-1]]))


def _middle_row(drive: PlannedDrive) -> int:
    """Return the row nearest to the middle of the path among those near the top speed."""
    speed = np.where(drive.t >= 0, np.abs(drive.speed), 0.0)
    fast_share = 0.9    # of the top speed: there is room for a manoeuvre
    fast = np.flatnonzero(speed >= fast_share * speed.max())
    path_length = running_sum(np.abs(np.diff(drive.travel)))
    return int(fast[np.argmin(np.abs(path_length[fast] - path_length[-1] / 2))])


def _time_grid(end: float, *knots: float) -> Floats:
    """Return times above 0 up to the end, at most DRIVE_STEP apart, with the knots among them."""
    t = np.linspace(0.0, end, max(2, int(np.ceil(end / DRIVE_STEP)) + 1))
    t = np.union1d(t, [x for x in knots if 0 < x < end])
    return t[np.diff(t, prepend=-1.0) > 1e-6][1:]
