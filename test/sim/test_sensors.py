# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sensors: noise of the stated density, bounded pulses, independent random streams."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.nav.rotations import heading_from_yaw, matrix_from_quat, matrix_from_rpy, wrap
from odocal_ros.settings.nominal import Grade, GRADES
from odocal_ros.sim import sensors
from odocal_ros.sim.motion import attitude, Motion, rigid_imu_output, Start
from odocal_ros.sim.noise import gauss_markov, make_rng, PHASE, stamps, white
from odocal_ros.sim.options import resolve, SimOptions
from odocal_ros.sim.profile import chain, hold, ramp
from odocal_ros.sim.scenarios import motion_of, simulate

TOWN = SimOptions(scenario='town', duration=200.0, imu_rate=50.0)
MANY = 60_000


def sure(n):
    """
    Return 5 sigma of the relative error of a variance from n independent draws.

    Tiny variances are compared as ratios: approx tolerates 1e-12 for any ``rel``.
    """
    return 5 * np.sqrt(2 / n)


def motion(speed=5.0, seconds=20.0):
    """Return a drive on the level that starts and ends at rest, backwards if speed < 0."""
    pieces = hold(2) + ramp(4, speed, 1.0) + hold(seconds) + ramp(4, -speed, 1.0) + hold(2)
    acceleration = chain(pieces)
    return Motion(acceleration.integral(), chain(hold(acceleration.end)),
                  Start(0.7, 0.2, 0.0, 0.3))


def test_grades_have_the_figures_of_the_method():
    industrial = GRADES['industrial']
    # 0.15 deg/sqrt(h) at 1 Hz: 0.15 deg of random walk after an hour
    assert np.degrees(industrial.gyro_noise) * 60 == pytest.approx(0.15)
    assert np.degrees(industrial.gyro_bias) * 3600 == pytest.approx(20)
    # 5 deg/h per sqrt(h): after an hour the bias has changed by 5 deg/h
    assert np.degrees(industrial.gyro_bias_walk) * 3600 * 60 == pytest.approx(5)
    assert industrial.accel_noise * 60 == pytest.approx(0.03)
    assert industrial.accel_bias == 0.02
    assert industrial.accel_bias_walk * 60 == pytest.approx(1e-3)


@pytest.mark.parametrize('rate', [50.0, 400.0])
def test_white_noise_has_its_density_at_any_rate(rate):
    noise = white(make_rng(3, 'test'), 0.02, rate, (MANY, 3))
    assert noise.var() / rate == pytest.approx(0.02**2, rel=sure(3 * MANY))
    # white: adjacent samples are uncorrelated, 5 / sqrt(n)
    together = (noise[1:] * noise[:-1]).mean() / noise.var()
    assert abs(together) < 5 / np.sqrt(3 * MANY)


def test_gauss_markov_is_stationary_with_its_correlation_time():
    tau, sigma, dt = 20.0, 1.5, 0.2
    t = np.arange(MANY) * dt
    x = gauss_markov(make_rng(3, 'test'), sigma, tau, t)
    decay = np.exp(-dt / tau)
    push = x[1:] - decay * x[:-1]
    assert push.var() == pytest.approx(sigma**2 * (1 - decay**2), rel=sure(3 * MANY))
    # a variance of correlated draws: relative sigma sqrt(2 tau / T), three axes
    spread = np.sqrt(2 * tau / t[-1] / 3)
    assert x.var() == pytest.approx(sigma**2, rel=5 * spread)
    lag = round(tau / dt)
    together = (x[lag:] * x[:-lag]).mean() / x.var()
    assert together == pytest.approx(np.exp(-1), abs=5 * spread)
    firsts = np.array([gauss_markov(make_rng(s, 'first'), sigma, tau, t[:1]) for s in range(1000)])
    assert firsts.var() == pytest.approx(sigma**2, rel=sure(3000))


@pytest.mark.parametrize('grade', list(GRADES))
def test_imu_errors_have_the_size_of_the_grade(grade):
    options = resolve(replace(TOWN, imu_grade=grade))
    figures = GRADES[grade]
    gyro, accel = sensors.imu_errors(options, 30_000)
    for errors, noise, walk in ((gyro, figures.gyro_noise, figures.gyro_bias_walk),
                                (accel, figures.accel_noise, figures.accel_bias_walk)):
        steps = np.diff(errors, axis=0)   # without bias: twice the white variance, and the walk's
        wanted = 2 * noise**2 * options.imu_rate + walk**2 / options.imu_rate
        # adjacent differences share a draw: correlation -1/2 increases the variance 1.5 times
        assert steps.var() / wanted == pytest.approx(1, rel=sure(90_000 / 1.5))
    starts = [sensors.turn_on_biases(replace(options, seed=s)) for s in range(500)]
    for k, sigma in enumerate((figures.gyro_bias, figures.accel_bias)):
        assert np.std([s[k] for s in starts]) / sigma == pytest.approx(1, rel=sure(1500) / 2)


def test_biases_have_the_random_walk_of_the_grade(monkeypatch):
    monkeypatch.setitem(sensors.SIM_GRADES, 'perfect', Grade(0, 0, 2e-6, 0, 0, 3e-5))
    options = resolve(replace(TOWN, imu_grade='perfect'))
    for errors, walk in zip(sensors.imu_errors(options, 10_000), (2e-6, 3e-5), strict=True):
        steps = np.diff(errors, axis=0)
        assert steps.var() / walk**2 * options.imu_rate == pytest.approx(1, rel=sure(3 * 9_999))
        assert (errors[0] == 0).all()


def test_a_perfect_imu_measures_the_motion_in_its_mounted_axes():
    options = resolve(replace(TOWN, imu_grade='perfect', yaw=0.3, pitch=-0.1, roll=0.05,
                               mounting_rpy=(np.pi, 0.0, 0.0), imu_lever_arm=(1.0, 0.5, 0.2)))
    drive = simulate(options)
    t = (drive.imu.stamp_ns - options.start_ns) * 1e-9
    w_v, f_v = rigid_imu_output(drive.motion.at(t), options.imu_lever_arm)
    C_vi = matrix_from_rpy([0.05, -0.1, 0.3]) @ np.diag([1.0, -1.0, -1.0])
    # rounding of 10 m/s^2
    assert_allclose(drive.imu.f_i @ C_vi.T, f_v, atol=1e-14)
    assert_allclose(drive.imu.w_i @ C_vi.T, w_v, atol=1e-15)
    assert drive.imu.f_i[0, 2] < -9.6     # z down at rest reads -g
    assert np.isnan(drive.imu.yaw_variance).all()


def test_orientation_and_heading_have_one_error_for_the_drive():
    errors = []
    for seed in range(60):
        drive = simulate(replace(TOWN, duration=140.0, imu_rate=10.0, seed=seed,
                                 orientation_sigma=0.02, heading_sigma=0.005))
        for sent in (drive.imu, drive.heading):
            t = (sent.stamp_ns - drive.options.start_ns) * 1e-9
            C_ni = attitude(drive.motion.at(t)) @ matrix_from_rpy(
                [0, drive.options.pitch, drive.options.yaw])
            E = matrix_from_quat(sent.q_ni) @ np.swapaxes(C_ni, -1, -2)
            error = np.arctan2(E[:, 1, 0], E[:, 0, 0])
            assert np.ptp(error) < 1e-12
            errors.append(error[0] / np.sqrt(sent.yaw_variance[0]))
    assert drive.imu.yaw_variance[0] == 0.02**2
    assert np.var(errors) == pytest.approx(1, rel=sure(120))


@pytest.mark.parametrize('speed', [5.0, -5.0])
def test_pulses_are_behind_the_travel_by_less_than_one(speed):
    drive, options = motion(speed), resolve(TOWN)
    (sent,) = sensors.odometers(drive, options)
    t = (sent.stamp_ns - options.start_ns) * 1e-9
    left = drive.at(t).travel / options.scale - (sent.value - sent.value[0])
    assert sent.value.dtype == np.int64
    assert np.ptp(left) < 1              # floor of travel + phase
    assert np.ptp(left) > 0.9            # and whole pulses
    steps = np.diff(sent.value) * np.sign(speed)
    assert steps.min() == 0
    assert steps.sum() == pytest.approx(abs(drive.distance) / options.scale, abs=1)


def test_an_angle_is_not_quantised_and_a_speed_is_the_true_one_over_scale():
    drive = motion()
    options = resolve(replace(TOWN, odometer='angle'))
    (sent,) = sensors.odometers(drive, options)
    t = (sent.stamp_ns - options.start_ns) * 1e-9
    assert_allclose((sent.value - sent.value[0]) * options.scale, drive.at(t).travel, atol=1e-12)
    options = resolve(replace(TOWN, odometer='speed'))
    (sent,) = sensors.odometers(drive, options)
    assert_allclose(sent.value * options.scale, drive.at(t).speed, atol=1e-14)
    noisy = sensors.odometers(drive, replace(options, speed_noise=0.05))[0].value
    assert ((noisy - sent.value) * options.scale).var() == pytest.approx(
        0.05**2, rel=sure(len(noisy)))


def test_late_stamps_change_no_value():
    plain = simulate(TOWN)
    late = simulate(replace(TOWN, odometer_delay=0.05, fix_delay=0.1))
    assert (late.odometer.stamp_ns - plain.odometer.stamp_ns == 50_000_000).all()
    assert np.array_equal(late.odometer.value, plain.odometer.value)
    assert (late.fix.stamp_ns - plain.fix.stamp_ns == 100_000_000).all()
    assert np.array_equal(late.fix.latitude, plain.fix.latitude)


def test_slip_occurs_only_in_motion_with_the_configured_size():
    options = resolve(replace(TOWN, slip_walk=0.01, odometer_rate=200.0))
    drive = motion(seconds=200.0)
    _, t = stamps(drive.duration, 200.0)
    state = drive.at(t)
    steps = np.diff(sensors.slip(state, options))
    moving = state.speed[1:] > sensors.MOTION_LIMIT
    assert (steps[~moving] == 0).all()
    assert steps[moving].var() * 200 / 0.01**2 == pytest.approx(1, rel=sure(moving.sum()))
    spins = resolve(replace(TOWN, slip_events=300.0, slip_size=0.2))
    spun = sensors.slip(state, spins)
    # whole events; 300 / h * 208 s = 17.3 expected, 5 sigma of Poisson: 21
    events = spun[-1] / 0.2
    assert events == pytest.approx(round(events), abs=1e-9)
    assert 1 <= events <= 38
    assert np.diff(spun).min() >= 0


def test_a_wheel_slips_after_each_start_and_not_elsewhere():
    options = resolve(replace(TOWN, start_slip=0.005, start_slip_time=5.0))
    drive = motion_of(options)
    _, t = stamps(drive.duration, 50.0, PHASE['odometer'])
    state = drive.at(t)
    spun = sensors.slip(state, options)
    moving = state.speed > sensors.MOTION_LIMIT
    starts = t[1:][moving[1:] & ~moving[:-1]]
    assert len(starts) > 1
    for start in starts:
        at = np.searchsorted(t, start) - 1       # the last sample at rest; 5 s are 250 samples
        path, slipped = (x[at + 250] - x[at] for x in (state.travel, spun))
        assert slipped == pytest.approx(0.005 * path, rel=1e-9)
        stop = at + 251 + np.flatnonzero(~moving[at + 251:])[0]
        assert np.ptp(spun[at + 250:stop]) == 0.0
    assert spun[0] == 0.0


def same(a, b):
    return all(np.array_equal(getattr(a, n), getattr(b, n), equal_nan=True)
               for n in a.__dataclass_fields__)


def test_a_seed_determines_the_drive_and_sensors_are_independent():
    drive = simulate(TOWN)
    again = simulate(TOWN)
    assert same(drive.imu, again.imu)
    assert same(drive.fix, again.fix)
    assert same(drive.odometer, again.odometer)
    other = simulate(replace(TOWN, seed=2))
    assert other.truth.distance != drive.truth.distance
    changed = simulate(replace(TOWN, fix_rate=1.0, fix_noise='correlated', outliers=0.1,
                               slip_walk=0.1, heading_sigma=0.1))
    assert same(changed.imu, drive.imu)
    assert not same(changed.odometer, drive.odometer)
    changed = simulate(replace(TOWN, imu_grade='tactical', imu_rate=20.0, odometer_rate=10.0))
    assert same(changed.fix, drive.fix)


def test_topics_are_not_sampled_together():
    drive = simulate(TOWN)
    assert not set(drive.imu.stamp_ns.tolist()) & set(drive.odometer.stamp_ns.tolist())
    assert not set(drive.odometer.stamp_ns.tolist()) & set(drive.fix.stamp_ns.tolist())


def test_heading_topic_is_of_the_body_and_orientation_of_the_imu_axes():
    sideways = (np.pi / 2, 0.0, -np.pi / 2)
    drive = simulate(SimOptions(scenario='straight', duration=200.0, imu_rate=20.0,
                                mounting_rpy=sideways, heading_sigma=1e-9, orientation_sigma=1e-9))

    def yaw(q):
        C = matrix_from_quat(q)
        return np.arctan2(C[0, 1, 0], C[0, 0, 0])

    assert heading_from_yaw(yaw(drive.heading.q_ni)) == pytest.approx(drive.truth.heading)
    # the x axis of the sensor points to the side
    off = wrap(yaw(drive.imu.q_ni) - yaw(drive.heading.q_ni))
    assert abs(off) > 1.0


def test_a_gyro_scale_error_is_on_all_rates():
    options = resolve(replace(TOWN, imu_grade='perfect'))
    right, wrong = (simulate(o).imu.w_i for o in (options, replace(options,
                                                                   gyro_scale_error=0.01)))
    assert_allclose(wrong, 1.01 * right, rtol=1e-12)
