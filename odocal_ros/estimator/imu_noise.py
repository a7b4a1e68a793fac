# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""White noise and random walks of an IMU by its grade, its standstills and its samples."""

from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.data.pieces import by_step, median
from odocal_ros.estimator.imu_steps import ImuSteps
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.levels import LEAST
from odocal_ros.screening.leg_kind import TILT_SIGMA
from odocal_ros.settings.nominal import G, Grade

# m/s^2/sqrt(Hz) minimum, and m/s^2/sqrt(s): accelerations of the vehicle, 1.5 m/s^2 for some
# seconds, and slopes of a few per cent over a minute. Judgement
UNFELT_NOISE, UNFELT_WALK = 5.0, 0.01
CHI2_3_MEDIAN = 2.366       # statistical: median of chi2 with 3 degrees of freedom
CHI2_3_QUARTILE = 1.213     # statistical: its lower quartile


def sensor_noise(grade: Grade) -> dict[str, float]:
    """Return sigmas of white noise and random walks by the grade of the IMU, SI."""
    stated = {'gyro': grade.gyro_noise, 'accel': grade.accel_noise,
              'gyro_walk': grade.gyro_bias_walk, 'accel_walk': grade.accel_bias_walk}
    return {name: max(sigma, LEAST.imu[name]) for name, sigma in stated.items()}


def without_accelerometer(grade: Grade) -> Grade:
    """Return the grade of an IMU without an accelerometer: its specific force is gravity."""
    return replace(grade, accel_noise=UNFELT_NOISE, accel_bias=TILT_SIGMA * G,
                   accel_bias_walk=UNFELT_WALK, accel_scale_error=0.0, gyro_by_force=0.0)


def at_rest(imu: ImuSteps, leg: SmootherLeg, still: Bools) -> dict[str, float]:
    """Return white noise levels of gyro and accelerometer from standstills; lower limits."""
    turn, force = np.split(imu.over_intervals(imu.signals), 2, axis=1)
    T = np.diff(imu.t[imu.key])[:, None]
    inside = still[:-1] & still[1:]
    rest = np.flatnonzero(inside)
    runs = np.split(rest, np.flatnonzero(np.diff(rest) > 1) + 1)
    # second differences contain no bias and no drift; their variance is six times as large
    squares = [[(np.diff((x / T)[run], n=2, axis=0)**2).sum(axis=1) * T[run][1:-1, 0] / 6
                for x in (turn, force)] for run in runs if len(run) > 2]
    both = np.concatenate([np.zeros((2, 0)), *squares], axis=1)
    if both.shape[1] < 15:      # of three axes each: with fewer, a variance has a sigma above 30 %
        return {}
    # people may get in and out, or load, during most of a stop: use the quarter with least motion
    found = {name: max(min(np.median(x) / CHI2_3_MEDIAN, np.quantile(x, 0.25) / CHI2_3_QUARTILE),
                       LEAST.imu[name]**2)
             for name, x in zip(('gyro', 'accel'), both, strict=True)}
    return found if leg.has_accelerometer else {'gyro': found['gyro']}


def of_samples(leg: SmootherLeg, rows: slice | Ints) -> dict[str, float]:
    """Return the noise of differences of adjacent samples, as white noise, SI per sqrt(Hz)."""
    def jumps(x: Floats) -> Floats:
        out: Floats = (np.diff(x, axis=0)**2).sum(axis=1)
        return out

    usual = median(by_step(np.diff, leg.t_imu[rows]))
    return {name: float(np.sqrt(median(by_step(jumps, x[rows])) / CHI2_3_MEDIAN / 2 * usual))
            for name, x in (('gyro', leg.w_b), ('accel', leg.f_b))}
