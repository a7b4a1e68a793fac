# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0


"""The velocity of a simulated receiver."""

from dataclasses import replace

import numpy as np
import pytest

from odocal_ros.sim import motion, sensors
from odocal_ros.sim.scenarios import SimOptions, simulate

TOWN = SimOptions(scenario='town', duration=100.0, imu_rate=20.0, velocity_sigma=0.0,
                  antenna_lever_arm=(0.5, -0.3, 1.2))


def true(drive, t):
    state = drive.motion.at(t)
    swing = np.cross(np.stack([0 * t, 0 * t, state.yaw_rate], -1), drive.options.antenna_lever_arm)
    return motion.velocity_n(state) + np.einsum('kij,kj->ki', motion.attitude(state), swing)


def times(drive):
    return sensors.stamps(drive.motion.duration, 10.0, sensors.PHASE['fix'])[1]


def test_it_is_that_of_the_antenna():
    drive = simulate(TOWN)
    # the height of the antenna, 51 m, over the Earth's radius: 1e-5 of 15 m/s, and rounding
    np.testing.assert_allclose(drive.velocity.velocity_n, true(drive, times(drive)), atol=5e-4)
    assert not len(simulate(replace(TOWN, velocity_sigma=None)).velocity.stamp_ns)


def test_delay_scale_and_smoothing():
    late = simulate(replace(TOWN, velocity_delay=0.2)).velocity
    assert (late.stamp_ns - simulate(TOWN).velocity.stamp_ns == 200_000_000).all()
    drive = simulate(TOWN)
    grown = simulate(replace(TOWN, velocity_scale_error=0.01)).velocity.velocity_n
    np.testing.assert_allclose(grown, 1.01 * drive.velocity.velocity_n, rtol=1e-12)
    smooth = simulate(replace(TOWN, velocity_lag=0.5)).velocity.velocity_n
    t = times(drive)
    # first order: v + tau dv/dt = what goes in; differences over 0.2 s, kinks of 1 m/s^3 left out
    rate = np.gradient(smooth, t, axis=0)
    off = smooth + 0.5 * rate - drive.velocity.velocity_n
    assert np.abs(off[5:-5]).max() < 0.05
    assert np.abs(smooth - drive.velocity.velocity_n).max() > 0.3


def test_errors_have_their_size_and_time():
    clean = simulate(TOWN).velocity.velocity_n
    for time, alike in ((0.0, 0.0), (0.5, np.exp(-0.2))):
        sent = simulate(replace(TOWN, velocity_sigma=0.1, velocity_correlation_time=time)).velocity
        error = sent.velocity_n - clean
        # 3000 draws, of 0.5 s a tenth of them
        assert error.std() == pytest.approx(0.1, rel=0.1 if time else 0.04)
        assert (error[1:] * error[:-1]).mean() / error.var() == pytest.approx(alike, abs=0.06)
        assert (sent.variance_n == pytest.approx(0.01))
    far = simulate(replace(TOWN, velocity_outliers=0.1)).velocity.velocity_n - clean
    assert (np.abs(far).max(axis=1) > 0).mean() == pytest.approx(0.1, abs=0.04)
