# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An IMU that changes during the leg: gravity or forward turns, or its unit or range changes."""

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.pieces import medians
from odocal_ros.nav.rotations import wrap
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.facing import Accelerations, facing_of
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.nominal import G

# judgement, deg: least turn, larger than by slopes, bends and noise; largest scatter on one side
LEAST_TURN, SIDE = 45.0, 20.0
SAME_SIZE = 1.15    # judgement: ratio of gravity on both sides; 1.4 in a bend at 45 deg
# judgement, deg: a larger turn is by reversing with an unsigned counter (180 deg)
MOST_YAW = 135.0
YAW_SIGMAS = 5.0    # statistical: of the two sides, beyond LEAST_TURN
DO = 'Mount the IMU firmly, or mark a leg on one side of this with --leg.'
TENTHS, TENTH_ROWS = 10, 20       # judgement: of a leg; rows of one
# judgement: limits of measured gravity over the Earth's. Units and ranges differ by a factor of 2
# at least; in a continuous bend at 1.2 g the force is 1.56 times gravity
LEAST_RATIO, MOST_RATIO = 0.6, 1.6


def _tenths(inputs: Inputs) -> tuple[Ints, Floats]:
    """Return the edges of the tenths of the rows, (11,), their median force, (10, 3), or none."""
    edges = np.linspace(0, len(inputs.t_imu), TENTHS + 1).astype(int)
    if not inputs.has_accelerometer or edges[1] < TENTH_ROWS:
        return edges[:0], np.empty((0, 3))
    return edges, np.array([medians(inputs.f_b[a:b])
                            for a, b in zip(edges[:-1], edges[1:], strict=True)])


def unit_changes(inputs: Inputs) -> tuple[Reason, ...]:
    """Return IMU_UNITS if gravity in a tenth of the leg differs from the Earth's."""
    edges, force = _tenths(inputs)
    size = [float(np.linalg.norm(one)) for one in force]
    odd = [k for k, one in enumerate(size) if not LEAST_RATIO * G < one < MOST_RATIO * G]
    if not odd or len(odd) == len(size):      # all tenths: the unit of the whole leg
        return ()
    begin, end = inputs.t_imu[edges[odd[0]]], inputs.t_imu[edges[odd[-1] + 1] - 1]
    return (Reason(Code.IMU_UNITS, f'from t = {begin:.0f} to {end:.0f} s the IMU measures a '
                   f'gravity of {size[odd[0]]:.3g} m/s^2 instead of 9.8 m/s^2', 'Check the IMU '
                   'driver for a change of unit or range during the drive, or mark a leg on one '
                   'side of it with --leg.'),)


def turned_over(inputs: Inputs) -> tuple[Reason, ...]:
    """Return IMU_AXES if the direction of gravity changes between two tenths of the leg."""
    edges, force = _tenths(inputs)
    for k in range(1, len(force) - 1):
        sides = force[:k], force[k + 1:]
        before, after = (side.mean(axis=0) for side in sides)
        # a bend, or another unit, also changes the size
        size = np.linalg.norm(after) / max(float(np.linalg.norm(before)), 1e-9)
        if (_apart(before, after) > LEAST_TURN and 1 / SAME_SIZE < size < SAME_SIZE
                and all(_apart(one, mean) < SIDE for side, mean in zip(
                    sides, (before, after), strict=True) for one in side)):
            begin, end = inputs.t_imu[edges[k]], inputs.t_imu[edges[k + 1] - 1]
            return (_moved(f'gravity turns by {_apart(before, after):.0f} deg', float(begin),
                           float(end)),)
    return ()


def turned_about(found: Accelerations | None) -> tuple[Reason, ...]:
    """Return IMU_AXES if the forward direction changes between two tenths of the leg."""
    if found is None:
        return ()
    edges = np.linspace(0, len(found.t), 11).astype(int)
    seen = []
    for a, b in zip(edges[1:-2], edges[2:-1], strict=True):
        sides = facing_of(found[:a]), facing_of(found[b:])
        if sides[0] is None or sides[1] is None:
            continue
        apart = float(np.rad2deg(wrap(sides[1].yaw - sides[0].yaw)))
        sigma = float(np.rad2deg(np.hypot(sides[0].sigma, sides[1].sigma)))
        if LEAST_TURN + YAW_SIGMAS * sigma < abs(apart) < MOST_YAW:
            seen.append((sigma, -apart, float(found.t[a]), float(found.t[b])))
    if not seen:
        return ()
    sigma, apart, begin, end = min(seen)
    return (_moved(f'the forward direction turns by {apart:+z.0f} ± {max(sigma, 1.0):.0f} deg',
                   begin, end),)


def _moved(what: str, begin: float, end: float) -> Reason:
    return Reason(Code.IMU_AXES, f'{what} in the IMU frame at about t = {begin:.0f} to '
                  f'{end:.0f} s: the IMU was moved in the vehicle', DO)


def _apart(one: Floats, other: Floats) -> float:
    """Return the angle between two vectors, (3,), deg; 0 if one is zero."""
    sine, cosine = np.linalg.norm(np.cross(one, other)), float(one @ other)
    return float(np.rad2deg(np.arctan2(sine, cosine)))
