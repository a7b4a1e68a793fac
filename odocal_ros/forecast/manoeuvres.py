# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Manoeuvres to add to a planned drive; they determine what a straight run does not."""

from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.forecast.planned_drive import DRIVE_STEP, PlannedDrive, REST_SPEED

BRAKING = 1.5    # m/s^2, judgement: as in a town
QUARTER = np.pi / 2    # definition: rad
# judgement: a minute of town: still, up, cruise with a turn, down, still
TOWN_T = np.array([0.0, 5.0, 15.0, 40.0, 50.0, 60.0])
TOWN_SPEED = np.array([0.0, 0.0, 12.0, 12.0, 0.0, 0.0])
TOWN_SIDES = 1.0, 1.0, -1.0, -1.0    # two to the left, then two to the right


def stop_and_start(drive: PlannedDrive) -> PlannedDrive:
    """Return the drive with one more stop: braking, 5 s of standing, acceleration."""
    k = _amid(drive)
    v = drive.speed[k]
    ramp = abs(v) / BRAKING
    stop_time = 5.0    # s of a stop
    t = _grid(2 * ramp + stop_time, ramp, ramp + stop_time)
    return inserted(drive, k, t, np.interp(t, [0.0, ramp, ramp + stop_time, 2 * ramp + stop_time],
                                           [v, 0.0, 0.0, v]), np.zeros_like(t))


def left_and_right_turns(drive: PlannedDrive) -> PlannedDrive:
    """Return the drive with a turn of 90 deg to the left and, a little later, one to the right."""
    k = _amid(drive)
    v = drive.speed[k]
    turn_time, sideways_force = 8.0, 2.0    # s of 90 deg; m/s^2 to the side that make it longer
    turn = max(turn_time, QUARTER * abs(v) / sideways_force)
    turns_apart = 5.0    # s straight between the two turns
    whole = 2 * turn + turns_apart
    t = _grid(whole, turn, turn + turns_apart)
    return inserted(drive, k, t, np.full_like(t, v), np.interp(
        t, [0.0, turn, turn + turns_apart, whole], [0.0, QUARTER, QUARTER, 0.0]))


def town_driving(drive: PlannedDrive, minutes: int) -> PlannedDrive:
    """Return the drive with so many minutes of stop and go, with turns, before its last rest."""
    moving = int(np.flatnonzero(np.abs(drive.speed) > REST_SPEED)[-1])
    k = min(moving + 1, len(drive.t) - 1)
    v, yaw = drive.speed[k], 0.0
    t, speed, turned = [np.zeros(0)], [np.zeros(0)], [np.zeros(0)]
    brake = abs(v) / BRAKING
    if brake > DRIVE_STEP:          # it ends in motion
        own = _grid(brake)
        t, speed, turned = [own], [v * (1 - own / brake)], [np.zeros_like(own)]
    town_turn = 22.0, 30.0    # s, begin and end in the minute
    for minute in range(minutes):
        own = _grid(TOWN_T[-1], *TOWN_T[1:-1], *town_turn)
        angle = QUARTER * TOWN_SIDES[minute % len(TOWN_SIDES)]
        t.append(own + brake + minute * TOWN_T[-1])
        speed.append(np.interp(own, TOWN_T, TOWN_SPEED))
        turned.append(yaw + np.interp(own, town_turn, [0.0, angle]))
        yaw += angle
    return inserted(drive, k, *(np.concatenate(x) for x in (t, speed, turned)))


def inserted(drive: PlannedDrive, k: int, t: Floats, speed: Floats,
             turned: Floats) -> PlannedDrive:
    """
    Return the drive with a piece after row k; what follows comes later and turned.

    drive : as planned.   k : row between the marks.   t, speed, turned : (m,) s since row k, above
    0 and rising; m/s; rad turned to the left since row k.
    """
    return replace(
        drive, t=np.concatenate([drive.t[:k + 1], drive.t[k] + t, drive.t[k + 1:] + t[-1]]),
        speed=np.insert(drive.speed, k + 1, speed),
        slope=np.insert(drive.slope, k + 1, np.full(len(t), drive.slope[k])),
        yaw=np.concatenate([drive.yaw[:k + 1], drive.yaw[k] + turned,
                            drive.yaw[k + 1:] + turned[-1]]))


def _amid(drive: PlannedDrive) -> int:
    """Return the row nearest to the middle of the path among those near the greatest speed."""
    speed = np.where(drive.t >= 0, np.abs(drive.speed), 0.0)
    near_top = 0.9    # of the greatest speed: where there is room for a manoeuvre
    fast = np.flatnonzero(speed >= near_top * speed.max())
    path_length = np.cumsum(np.abs(np.diff(drive.travel, prepend=drive.travel[0])))
    return int(fast[np.argmin(np.abs(path_length[fast] - path_length[-1] / 2))])


def _grid(end: float, *knots: float) -> Floats:
    """Return times above 0 up to the end, at most DRIVE_STEP apart, with the knots among them."""
    t = np.linspace(0.0, end, max(2, int(np.ceil(end / DRIVE_STEP)) + 1))
    t = np.union1d(t, [x for x in knots if 0 < x < end])
    return t[np.diff(t, prepend=-1.0) > 1e-6][1:]
