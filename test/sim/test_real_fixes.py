# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A receiver: noise, outliers, filters, bursts, stated sigmas, and its velocity."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.sim import motion, real_sensors, sensors
from odocal_ros.sim.motion import point_geodetic
from odocal_ros.sim.noise import PHASE, stamps
from odocal_ros.sim.options import resolve, SimOptions
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.scenarios import motion_of, simulate

pytestmark = pytest.mark.core
PAPER = SimOptions(scenario='paper', duration=600.0, imu_rate=20.0, heading=0.0)
ROAD = SimOptions(scenario='town', duration=200.0, imu_rate=20.0)
TAU = 0.8


def north(drive, times):
    """Return the antenna position from a receiver without noise, m north of the start."""
    options = resolve(drive)
    latitude, _, _ = real_sensors.positions(motion_of(options), np.asarray(times), options)
    return (latitude - options.latitude) * 6.36e6


@pytest.mark.parametrize(('receiver', 'behind', 'tolerance'), [
    # at 20 m/s the lag is tau; in the ramp of 0.5 m/s^2 since 300 s the filter is in steady state;
    # 3e-3: the metres of a radian of latitude here
    ({'receiver_lag': TAU}, {450.0: 20 * TAU, 330.0: 15 * TAU - 0.5 * TAU**2}, {'rel': 3e-3}),
    # no lag at constant speed; tau^2 of it at constant acceleration
    ({'receiver_tracking': TAU}, {450.0: 0.0, 330.0: 0.5 * TAU**2}, {'abs': 2e-3}),
    # at 20 m/s since 340 s: exp(-110 / 15) of it is missing
    ({'receiver_odometer': 0.02, 'receiver_odometer_time': 15.0}, {450.0: -0.02 * 20 * 15},
     {'rel': 3e-3})], ids=['lag', 'tracking', 'odometer'])
def test_lag_of_a_receiver_filter_is_the_closed_form(receiver, behind, tolerance):
    filtered = replace(PAPER, real=RealEffects(**receiver))
    for t, want in behind.items():
        late = (north(PAPER, [t]) - north(filtered, [t]))[0]
        assert late == pytest.approx(want, **tolerance)
    # round-off of 4.5e6 m
    assert north(filtered, [0.3])[0] == pytest.approx(0, abs=1e-8)


def test_satellite_errors_are_smoothed_by_an_odometer_in_the_receiver():
    t, options = np.arange(0.0, 4000.0), replace(PAPER, real=RealEffects(receiver_odometer=0.01))
    white = np.random.default_rng(1).standard_normal((len(t), 3))
    left = real_sensors.fused_errors(t, white, options)
    a = np.exp(-1 / 20)
    # 4000 / 40 independent draws an axis
    assert left[200:].var() == pytest.approx((1 - a) / (1 + a), rel=5 * np.sqrt(2 / 300))
    assert real_sensors.fused_errors(t, white, PAPER) is white


def test_slow_errors_have_their_size_and_are_in_the_covariance():
    slow = ((1.2, 5.0), (0.9, 20.0))
    options = replace(PAPER, fix_sigma=0.3, fix_rate=10.0, real=RealEffects(
        slow_errors=slow, stated_sigma_ratio=0.5))
    drive = simulate(options)
    want = 0.3**2 + 1.2**2 + 0.9**2
    assert_allclose(drive.fix.covariance_n[0], 0.25 * np.diag([want, want, 4 * want]), rtol=1e-12)
    made = np.array([real_sensors.position_errors(np.arange(0.0, 600, 1.0), replace(
        resolve(options), seed=s)) for s in range(60)])
    # 60 drives of 600 s hold 60 * 600 / (2 * 20) independent draws of the slower one, each axis
    n = 60 * 600 / 40
    for axis, up in ((0, 1), (1, 1), (2, 4)):
        assert made[..., axis].var() / (1.2**2 + 0.9**2) / up == pytest.approx(
            1, rel=5 * np.sqrt(2 / n))


def test_bursts_come_and_go_smoothly():
    t = np.arange(0.0, 3600.0, 0.2)
    options = replace(resolve(PAPER), real=RealEffects(bursts=10.0, burst_size=10.0))
    error = real_sensors.burst_errors(t, options)
    size = np.hypot(error[:, 0], error[:, 1])
    assert size.max() > 5
    assert (size == 0).mean() > 0.8
    # 3 x^2 - 2 x^3 rises by at most 1.5 of the size in an onset of a second
    assert np.abs(np.diff(size)).max() <= 1.5 * size.max() * 0.2 / real_sensors.ONSET_RANGE[0]


def test_the_antenna_moves_with_the_roll_of_the_body():
    options = resolve(SimOptions(scenario='town', duration=200.0, antenna_lever_arm=(0, 0, 2.0),
                                  real=RealEffects(body_roll=0.01)))
    motion, t = motion_of(options), np.arange(20.0, 190.0, 0.5)
    leaning = real_sensors.positions(motion, t, options)
    stiff = point_geodetic(motion.at(t), options.antenna_lever_arm)
    aside = np.hypot(leaning[0] - stiff[0],
                     (leaning[1] - stiff[1]) * np.cos(options.latitude)) * 6.37e6
    state = motion.at(t)
    most = np.abs(state.speed * state.yaw_rate).max()
    # 2 m times 0.01 rad per m/s^2; the springs overshoot by 37 % of a step at most
    assert 0.5 < aside.max() / (2 * 0.01 * most) < 1.4


def test_fixes_are_dropped_at_random_and_stamped_late():
    plain, real = (simulate(replace(PAPER, fix_delay=0.1, real=RealEffects(**figures)))
                   for figures in ({}, {'drops': 0.2, 'fix_jitter': 0.01}))
    n, kept = len(plain.fix.stamp_ns), len(real.fix.stamp_ns)
    assert kept == pytest.approx(0.8 * n, abs=5 * np.sqrt(n * 0.16))
    assert (np.diff(real.fix.stamp_ns) > 0).all()


def test_a_receiver_in_a_tunnel_uses_its_odometer_and_is_right_afterwards():
    tunnel, quiet = ((400.0, 60.0),), {'fix_sigma': 0.0, 'fix_rate': 1.0}
    wrong, right = (simulate(replace(PAPER, real=RealEffects(tunnels=tunnel, tunnel_odometer=x,
                                                             tunnel_heading=y), **quiet))
                    for x, y in ((0.02, 0.01), (0.0, 0.0)))
    north_m, east_m = (6.36e6 * (getattr(wrong.fix, name) - getattr(right.fix, name))
                       for name in ('latitude', 'longitude'))
    t = (wrong.fix.stamp_ns - wrong.imu.stamp_ns[0]) * 1e-9
    inside = (t >= 400) & (t < 460)
    since = t[inside] - t[inside][0]
    # to the north at 20 m/s; heading error grows by 0.01 rad a minute; 3e-3: metres of a radian
    assert_allclose(north_m[inside], 0.02 * 20 * since, rtol=3e-3, atol=1e-6)
    # 1: the heading of a step is that of its end
    assert_allclose(-east_m[inside] * np.cos(wrong.options.latitude),
                    20 * 0.01 / 60 * since**2 / 2, rtol=5e-3, atol=0.01 / 60 * 20 * 60)
    assert not north_m[~inside].any()
    assert not east_m[~inside].any()


TOWN = SimOptions(scenario='town', duration=100.0, imu_rate=20.0, velocity_sigma=0.0,
                  antenna_lever_arm=(0.5, -0.3, 1.2))


def true(drive, t):
    state = drive.motion.at(t)
    swing = np.cross(np.stack([0 * t, 0 * t, state.yaw_rate], -1), drive.options.antenna_lever_arm)
    return motion.velocity_n(state) + np.einsum('kij,kj->ki', motion.attitude(state), swing)


def times(drive):
    return stamps(drive.motion.duration, 10.0, PHASE['fix'])[1]


def test_velocity_is_that_of_the_antenna():
    drive = simulate(TOWN)
    # the height of the antenna, 51 m, over the Earth's radius: 1e-5 of 15 m/s, and rounding
    np.testing.assert_allclose(drive.velocity.velocity_n, true(drive, times(drive)), atol=5e-4)
    assert not len(simulate(replace(TOWN, velocity_sigma=None)).velocity.stamp_ns)


def test_velocity_has_its_delay_scale_and_smoothing():
    late = simulate(replace(TOWN, velocity_delay=0.2)).velocity
    assert (late.stamp_ns - simulate(TOWN).velocity.stamp_ns == 200_000_000).all()
    drive = simulate(TOWN)
    grown = simulate(replace(TOWN, velocity_scale_error=0.01)).velocity.velocity_n
    np.testing.assert_allclose(grown, 1.01 * drive.velocity.velocity_n, rtol=1e-12)
    smooth = simulate(replace(TOWN, velocity_lag=0.5)).velocity.velocity_n
    t = times(drive)
    # first order: v + tau dv/dt = input; differences over 0.2 s, without kinks of 1 m/s^3
    rate = np.gradient(smooth, t, axis=0)
    off = smooth + 0.5 * rate - drive.velocity.velocity_n
    assert np.abs(off[5:-5]).max() < 0.05
    assert np.abs(smooth - drive.velocity.velocity_n).max() > 0.3


def test_velocity_errors_have_their_size_and_correlation_time():
    clean = simulate(TOWN).velocity.velocity_n
    for time, expected in ((0.0, 0.0), (0.5, np.exp(-0.2))):
        sent = simulate(replace(TOWN, velocity_sigma=0.1, velocity_correlation_time=time)).velocity
        error = sent.velocity_n - clean
        # 3000 draws, of 0.5 s a tenth of them
        assert error.std() == pytest.approx(0.1, rel=0.1 if time else 0.04)
        assert (error[1:] * error[:-1]).mean() / error.var() == pytest.approx(expected, abs=0.06)
        assert (sent.variance_n == pytest.approx(0.01))
    far = simulate(replace(TOWN, velocity_outliers=0.1)).velocity.velocity_n - clean
    assert (np.abs(far).max(axis=1) > 0).mean() == pytest.approx(0.1, abs=0.04)


@pytest.mark.parametrize(('noise', 'sigma'), [('white', 1.5), ('rtk', 0.02), ('white', 0.7)])
def test_fix_errors_agree_with_the_covariance(noise, sigma):
    options = resolve(replace(ROAD, fix_noise=noise, fix_sigma=sigma))
    errors = sensors.fix_errors(np.arange(20_000) * 0.2, options)
    stated = simulate(options).fix
    for axis in range(3):
        assert errors[:, axis].var() == pytest.approx(
            stated.covariance_n[0, axis, axis], rel=5 * np.sqrt(2 / 20_000))
    assert stated.covariance_n[0, 0, 0] == pytest.approx(sigma**2)
    assert stated.covariance_n[0, 2, 2] == pytest.approx(4 * sigma**2)
    assert set(stated.status.tolist()) == {2 if noise == 'rtk' else 0}


def test_fix_errors_are_applied_east_north_and_up():
    noisy, bare = (simulate(replace(ROAD, fix_sigma=sigma)) for sigma in (5.0, 0.0))
    t = (bare.fix.stamp_ns - bare.options.start_ns) * 1e-9
    errors = sensors.fix_errors(t, noisy.options)
    east = (noisy.fix.longitude - bare.fix.longitude) * np.cos(bare.fix.latitude)
    north = noisy.fix.latitude - bare.fix.latitude
    # radii of WGS 84 at 40 deg, to the 20 m that height and latitude change them, of 20 m
    assert_allclose(east * 6_386_976, errors[:, 0], atol=2e-3)
    assert_allclose(north * 6_361_816, errors[:, 1], atol=2e-3)
    assert_allclose(noisy.fix.height - bare.fix.height, errors[:, 2], atol=1e-8)


def test_correlated_fix_errors_have_their_variance_and_correlation_time():
    options = resolve(replace(ROAD, fix_noise='correlated', fix_correlation_time=10.0))
    t = np.arange(100_000) * 0.2
    errors = sensors.fix_errors(t, options)[:, :2]
    spread = 5 * np.sqrt(2 * 10.0 / t[-1] / 2)
    total = simulate(options).fix.covariance_n[0, 0, 0]
    assert errors.var() == pytest.approx(total, rel=spread)
    together = (errors[50:] * errors[:-50]).mean()     # 10 s apart: the white part is gone
    assert together == pytest.approx(1.5**2 * np.exp(-1), abs=1.5**2 * spread)


def test_fixes_are_positions_of_the_antenna():
    drive = simulate(replace(ROAD, fix_sigma=0.0, antenna_lever_arm=(2.0, 0.5, 1.5)))
    bare = simulate(replace(ROAD, fix_sigma=0.0))
    assert_allclose(drive.fix.height - bare.fix.height, 1.5, atol=1e-6)
    north = (drive.fix.latitude - bare.fix.latitude)[0] * 6.36e6
    east = (drive.fix.longitude - bare.fix.longitude)[0] * 6.386e6 * np.cos(np.radians(40))
    # heading 45 deg: forward 2 and left 0.5; radii to 0.2 %
    assert [east, north] == pytest.approx([1.5 / np.sqrt(2), 2.5 / np.sqrt(2)], rel=2e-3)
    assert drive.fix.covariance_n[0, 0, 0] == sensors.SIGMA_FLOOR**2   # no receiver states zero


def test_outliers_have_the_configured_share_and_size():
    options = resolve(replace(ROAD, outliers=0.1, fix_sigma=0.0))
    far = np.hypot(*sensors.fix_errors(np.arange(20_000) * 0.2, options)[:, :2].T)
    # 5 sigma of a binomial share
    assert (far > 0).mean() == pytest.approx(0.1, abs=5 * np.sqrt(0.1 * 0.9 / 20_000))
    assert far[far > 0].min() >= 10
    assert far.max() <= 30


def test_an_outage_has_no_fixes():
    drive = simulate(replace(ROAD, outages=((50.0, 60.0), (100.0, 101.0))))
    t = (drive.fix.stamp_ns - drive.options.start_ns) * 1e-9
    assert not ((t >= 50) & (t < 60)).any()
    assert not ((t >= 100) & (t < 101)).any()
    assert len(t) == len(simulate(ROAD).fix.stamp_ns) - 55
