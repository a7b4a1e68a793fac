# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A two-axle vehicle on uneven ground, simulated here: its frame is that of the contacts."""

import numpy as np
import pytest

from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.prepare import make_problem, MEAN_ROLL_SIGMA
from odocal_ros.estimator.smoother import best_fit
from odocal_ros.estimator.state import CONSTANTS, LIFT, MEAN_ROLL, PITCH, YAW
from odocal_ros.nav.dead_reckoning import gravity_n, Origin
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import matrix_from_rpy, rotate, transpose
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.slow
WHEELBASE, MOUNTING = 2.8, 0.02    # m, pitch in rad
STEP = 0.0025   # s, of the truth: four per IMU sample
STANDSTILLS = np.array([[0.0, 19.0], [251.5, 260.0]])   # s
CONFIG = with_settings(Config(), {'imu.grade': 'tactical'})


def by_time(x):
    return np.gradient(x, STEP, axis=0, edge_order=2)


def pace(t):
    """Return 0 at rest and 1 in motion."""
    steps = np.interp(t, [0, 20, 30, 240, 250, 260], [0, 0, 1, 1, 0, 0])
    return np.convolve(np.pad(steps, 400, mode='edge'), np.full(801, 1 / 801), 'valid')


def ground(east, north):
    """Return heights, m: waves of 126 m."""
    return 0.4 * np.sin(east / 20 + 1.5) + 0.4 * np.sin(north / 20)


def made(t, axle, C_nv):
    """Return a leg without errors; axle : (n, 3) m.   C_nv : (n, 3, 3), of the body."""
    C_nb = C_nv @ matrix_from_rpy([0.0, MOUNTING, 0.0])
    origin = Origin(0.8, 0.1, 300.0)
    v_n, earth = by_time(axle), origin.earth_rate_n
    rate = transpose(C_nb) @ by_time(C_nb)
    w_b = np.stack([rate[:, 2, 1], rate[:, 0, 2], rate[:, 1, 0]], -1) + earth @ C_nb
    f_n = by_time(v_n) + 2 * np.cross(earth, v_n) - gravity_n(axle, origin)
    speed = np.linalg.norm(v_n, axis=1)
    path = STEP * (np.cumsum(speed) - speed / 2)
    imu, fixes = slice(0, None, 4), slice(40, None, 80)
    return SmootherLeg(
        origin, 0.0, t[-1] - 1.0, t[imu], w_b[imu], rotate(transpose(C_nb), f_n)[imu],
        Travel(t[imu], path[imu], 0.0), t[fixes], axle[fixes],
        np.tile(0.01**2 * np.eye(3), (len(t[fixes]), 1, 1)), STANDSTILLS, 1.0)


def figures_of_eight():
    """Return a leg with loops of 18 m, and its mean roll, left side up, rad."""
    t = np.arange(0.0, 260.0, STEP)
    angle = 0.16 * STEP * np.cumsum(pace(t))
    axle = np.stack([18 * np.sin(2 * angle), 36 * np.sin(angle)])
    ahead = np.stack([36 * np.cos(2 * angle), 36 * np.cos(angle)])
    ahead /= np.linalg.norm(ahead, axis=0)
    aside = np.stack([-ahead[1], ahead[0]])
    height = ground(*axle)
    forward = np.column_stack([*ahead, (ground(*axle + WHEELBASE * ahead) - height) / WHEELBASE])
    forward /= np.linalg.norm(forward, axis=1)[:, None]
    left = np.column_stack([*aside, (ground(*axle + aside) - ground(*axle - aside)) / 2])
    left -= forward * np.einsum('ki,ki->k', forward, left)[:, None]
    left /= np.linalg.norm(left, axis=1)[:, None]
    C_nv = np.stack([forward, left, np.cross(forward, left)], -1)
    up_v = C_nv[:, 2].mean(axis=0)
    return made(t, np.column_stack([*axle, height]), C_nv), np.arctan2(up_v[1], up_v[2])


def bumpy_road(crossfall):
    """Return a leg along a winding road, left side up; the body pitches on bumps."""
    t = np.arange(0.0, 260.0, STEP)
    path = 15.0 * STEP * np.cumsum(pace(t))
    heading = 0.4 * np.sin(2 * np.pi * path / 300)
    ahead = np.column_stack([np.cos(heading), np.sin(heading), 0 * t])
    C_road = matrix_from_rpy(np.column_stack([0 * t, 0 * t, heading])) @ matrix_from_rpy(
        [np.arctan(crossfall), 0.0, 0.0])
    noise = np.random.default_rng(3).standard_normal(len(t))
    window = np.hanning(200)        # bumps of 0.25 s
    bumps = np.convolve(noise, window / np.linalg.norm(window), 'same')
    pitch = 5e-3 * bumps * pace(t)
    C_nv = C_road @ matrix_from_rpy(np.column_stack([0 * t, pitch, 0 * t]))
    axle = np.cumsum(np.gradient(path)[:, None] * ahead, axis=0)
    return made(t, axle, C_nv)


def test_ground_with_a_mean_roll_does_not_change_the_pitch():
    """IMU roll is the mean roll of the leg, here 0.3 deg wrong; pitch was wrong by 5.9 sigma."""
    leg, roll = figures_of_eight()
    assert abs(roll) > 0.005
    fit = best_fit(make_problem(leg, CONFIG), CONFIG)
    # without noise, except for the prior of the centre of pitch
    assert abs(fit.state.constants[PITCH] - MOUNTING) < 1.5 * np.sqrt(fit.covariance[PITCH, PITCH])
    assert fit.state.constants[LIFT] == pytest.approx(WHEELBASE / 2 * roll, rel=0.1)


def test_bumps_determine_the_mean_roll_of_a_road():
    """The body pitches about its own left axis: else ``gyro_axis_zy`` was 0.020, 35 sigma."""
    fit = best_fit(make_problem(bumpy_road(0.02), CONFIG), CONFIG)
    c, sigma = fit.state.constants, np.sqrt(np.diag(fit.covariance))
    assert sigma[MEAN_ROLL] < MEAN_ROLL_SIGMA / 5     # from the drive, not the prior
    for i, true in ((MEAN_ROLL, np.arctan(0.02)), (YAW, 0.0), (PITCH, MOUNTING),
                    (CONSTANTS.index('gyro_axis_zy'), 0.0)):
        assert abs(c[i] - true) < 3 * sigma[i]
