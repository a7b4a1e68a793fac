# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A two-axle vehicle on uneven ground, simulated here: its frame is that of the contacts."""

import numpy as np
import pytest

from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.smoother import best_fit
from odocal_ros.estimator.state import LIFT, PITCH
from odocal_ros.nav.dead_reckoning import gravity_n, Origin
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import matrix_from_rpy, rotate, transpose
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.slow
WHEELBASE, MOUNTING = 2.8, 0.02    # m, pitch in rad
STEP = 0.0025   # s, of the truth: four per IMU sample


def by_time(x):
    return np.gradient(x, STEP, axis=0, edge_order=2)


def ground(east, north):
    """Return heights, m: waves of 126 m."""
    return 0.4 * np.sin(east / 20 + 1.5) + 0.4 * np.sin(north / 20)


def figures_of_eight():
    """Return a leg with loops of 18 m, without errors, and its mean roll to the right, rad."""
    t = np.arange(0.0, 260.0, STEP)
    pace = np.interp(t, [0, 20, 30, 240, 250, 260], [0, 0, 1, 1, 0, 0])
    pace = np.convolve(np.pad(pace, 400, mode='edge'), np.full(801, 1 / 801), 'valid')
    angle = 0.16 * STEP * np.cumsum(pace)
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
    C_nb = C_nv @ matrix_from_rpy([0.0, MOUNTING, 0.0])
    p_n, origin = np.column_stack([*axle, height]), Origin(0.8, 0.1, 300.0)
    v_n, earth = by_time(p_n), origin.earth_rate_n
    rate = transpose(C_nb) @ by_time(C_nb)
    w_b = np.stack([rate[:, 2, 1], rate[:, 0, 2], rate[:, 1, 0]], -1) + earth @ C_nb
    f_n = by_time(v_n) + 2 * np.cross(earth, v_n) - gravity_n(p_n, origin)
    speed = np.einsum('ki,ki->k', v_n, forward)
    path = STEP * (np.cumsum(speed) - speed / 2)
    imu, fixes = slice(0, None, 4), slice(40, None, 80)
    leg = SmootherLeg(
        origin, 0.0, t[-1] - 1.0, t[imu], w_b[imu], rotate(transpose(C_nb), f_n)[imu],
        Travel(t[imu], path[imu], 0.0), t[fixes], p_n[fixes],
        np.tile(0.01**2 * np.eye(3), (len(t[fixes]), 1, 1)),
        np.array([[0.0, 19.0], [251.5, t[-1]]]), 1.0)
    up_v = C_nv[:, 2].mean(axis=0)
    return leg, np.arctan2(up_v[1], up_v[2])


def test_ground_with_a_mean_roll_does_not_change_the_pitch():
    """IMU roll is the mean roll of the leg, here 0.3 deg wrong; pitch was wrong by 5.9 sigma."""
    leg, roll = figures_of_eight()
    assert abs(roll) > 0.005
    config = with_settings(Config(), {'imu.grade': 'tactical'})
    fit = best_fit(make_problem(leg, config), config)
    # without noise, except for the prior of the centre of pitch
    assert abs(fit.state.constants[PITCH] - MOUNTING) < 1.5 * np.sqrt(fit.covariance[PITCH, PITCH])
    assert fit.state.constants[LIFT] == pytest.approx(WHEELBASE / 2 * roll, rel=0.1)
