# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Wheels of a simulated vehicle or robot against closed forms; growth, slip and coarse speeds."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.errors import BadUsage
from odocal_ros.library.read_bag import read_bag
from odocal_ros.sim import wheels
from odocal_ros.sim.options import resolve, SimOptions
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.scenarios import motion_of, simulate

pytestmark = pytest.mark.core


def robot(**options):
    return simulate(SimOptions(scenario='indoor', duration=100.0, odometer='angle', **options))


def paths(made):
    """Return states in small steps, and the rolled path of each wheel by its name, m."""
    state = made.motion.at(np.arange(0.0, made.motion.duration, 0.01))
    return state, {one.name: wheels.robot_path(state, made.options, one)
                   for one in wheels.wheels_of(made.options)}


def test_skid_wheels_turn_by_the_effective_width_on_the_spot():
    made = robot(drive='skid', wheels=2)
    state, rolled = paths(made)
    spot = (state.speed == 0.0) & (state.yaw_rate != 0.0)
    difference = np.diff(rolled['right_wheel_joint'] - rolled['left_wheel_joint'])
    turns = np.diff(state.turn_angle)
    assert wheels.effective_width(made.options) == pytest.approx(wheels.SPOT_RATIO * 0.3)
    both = spot[:-1] & spot[1:]
    assert_allclose(difference[both], wheels.SPOT_RATIO * 0.3 * turns[both], rtol=1e-9, atol=1e-12)
    wide = wheels.effective_width(made.options, 1e9)
    assert wide == pytest.approx(wheels.STRAIGHT_RATIO * 0.3)


def test_mecanum_wheels_obey_their_kinematics_and_move_sideways():
    made = robot(drive='mecanum')
    state, rolled = paths(made)
    fl, fr, rl, rr = (rolled[f'{a}_{b}'] for a in ('front', 'rear') for b in ('left', 'right'))
    lateral = np.append(0.0, np.cumsum(0.01 * (state.sway[1:, 0] + state.sway[:-1, 0]) / 2))
    assert lateral.max() > 1.0
    assert_allclose((fl + fr + rl + rr) / 4, state.travel, atol=1e-9)
    assert_allclose((-fl + fr + rl - rr) / 4, lateral / wheels.LATERAL_RATIO, atol=1e-9)
    assert_allclose((-fl + fr - rl + rr) / 4,
                    wheels.effective_width(made.options) / 2 * state.turn_angle, atol=1e-9)
    made = robot(drive='mecanum', reference='mocap')
    path = np.linalg.norm(np.diff(made.positions()[:, :2][::10], axis=0), axis=1).sum()
    assert path > 1.2 * made.truth.distance


@pytest.mark.parametrize('count', [3, 4])
def test_omni_wheels_obey_their_kinematics(count):
    made = robot(drive='omni', wheels=count)      # its radius is 0.15 m
    state, rolled = paths(made)
    angle = 2 * np.pi * np.arange(count) / count
    rows = np.stack([np.sin(angle), -np.cos(angle), -0.15 * np.ones(count)], -1)
    motion, *_ = np.linalg.lstsq(rows, np.stack(list(rolled.values())), rcond=None)
    lateral = np.append(0.0, np.cumsum(0.01 * (state.sway[1:, 0] + state.sway[:-1, 0]) / 2))
    assert_allclose(motion, [state.travel, lateral, state.turn_angle], atol=1e-9)
    assert np.ptp(lateral) > 1.0


def test_a_robot_without_an_imu_has_a_readable_bag_without_imu(tmp_path):
    made = robot(imu=False)
    assert not len(made.leg().imu.stamp_ns)
    bag = write_bag(tmp_path / 'bag', drive_topics(made))
    two = {'odometer.left': 'left_wheel_joint', 'odometer.right': 'right_wheel_joint'}
    found = read_bag(bag, config=two)
    assert 'imu' not in found.topics
    assert len(found.samples('odometer').stamp_ns)
    with pytest.raises(BadUsage, match='no IMU'):
        read_bag(bag)       # wheels of unknown sides: the IMU is required


TOWN = SimOptions(scenario='town', duration=200.0, imu_rate=20.0, wheels=4, seed=5)


@pytest.mark.parametrize('count', [1, 2, 3, 4, 6, 7, 8])
def test_the_mean_count_times_the_scale_is_the_path(count):
    options = resolve(replace(TOWN, wheels=count))
    fixed = [wheel for wheel in wheels.wheels_of(options) if not wheel.steered]
    assert np.mean([1 / wheel.scale for wheel in fixed]) == pytest.approx(1 / options.scale)
    names = [wheel.name for wheel in wheels.wheels_of(options)]
    assert len(names) == len(set(names)) == count


@pytest.mark.parametrize('count', [1, 2, 4])
def test_wheels_without_steering_differ_by_the_turn_and_their_scale(count):
    drive = simulate(replace(TOWN, front_steers=False, wheels=count, odometer='angle',
                             odometer_lever_arm=(0.0, 0.7, 0.0)))
    assert len(drive.wheels) == count
    assert drive.truth.scale == drive.options.scale
    if count == 2:
        left, right = drive.truth.wheel_scales
        assert right / left == pytest.approx(1 + drive.options.wheel_difference)
    state = drive.motion.at((drive.odometer.stamp_ns - drive.options.start_ns) * 1e-9)
    for wheel, samples in zip(wheels.wheels_of(drive.options), drive.wheels, strict=True):
        rolled = (samples.value - samples.value[0]) * wheel.scale
        turn = state.turn_angle - state.turn_angle[0]
        np.testing.assert_allclose(rolled, state.travel - wheel.arm[1] * turn, atol=1e-9)


def test_a_steered_wheel_rolls_along_its_own_curve():
    drive = simulate(replace(TOWN, odometer_rate=200.0, latitude=0.0, heading=np.pi / 2))
    t = np.arange(0.0, drive.options.duration, 0.001)
    state = drive.motion.at(t)
    wheel = wheels.wheels_of(drive.options)[0]
    along, turn = np.gradient(state.travel, t), np.gradient(state.turn_angle, t)
    speed = np.hypot(along - wheel.arm[1] * turn, wheel.arm[0] * turn)
    path = np.append(0.0, np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(t)))
    sent = drive.wheels[0]
    rolled = (sent.value - sent.value[0]) * wheel.scale
    at = (sent.stamp_ns - drive.options.start_ns) * 1e-9
    assert np.ptp(state.turn_angle) > 1.0
    # derivatives by differences over 1 ms have errors of some ppm
    np.testing.assert_allclose(rolled, np.interp(at, t, path), atol=0.01)
    assert rolled[-1] - state.travel[-1] > 0.5        # m: far above that


RUN = {'scenario': 'straight', 'duration': 400.0, 'imu_rate': 20.0}


def run(**figures):
    motion = motion_of(resolve(SimOptions(**RUN)))
    return motion, motion.at(np.arange(0, 400, 0.02)), RealEffects(**figures)


def test_a_tyre_grows_with_the_square_of_the_speed_and_as_it_warms():
    _, state, real = run(speed_law=0.003, warming=0.002, warming_time=100.0)
    cruise = state.t == 250.0                        # 12 m/s since 85 s, rolling since 60 s
    want = 0.003 / 9 + 0.002 * (1 - np.exp(-190 / 100))
    # one step of 0.02 s more or less of warming
    assert wheels.tyre_growth(state, real)[cruise] == pytest.approx(want, abs=0.002 * 3e-4)


def test_tyre_slip_is_proportional_to_force_over_load():
    _, state, real = run(tyre_slip=1 / 30)
    spun = wheels.tyre_slip(state, real)
    a, b = (np.flatnonzero(state.t == x)[0] for x in (65.0, 80.0))
    push = 12 / 24                                    # m/s^2 between the blends of its ramp
    path = state.travel[b] - state.travel[a]
    air = wheels.AIR_DRAG * (state.speed[a:b + 1]**2 * np.gradient(state.travel[a:b + 1])).sum()
    want = 2 / 30 * ((push / 9.81 + wheels.ROLLING_RESISTANCE) * path + air)
    assert spun[b] - spun[a] == pytest.approx(want, rel=2e-3)      # at the ends of the sum
    braked = wheels.tyre_slip(state, RealEffects(tyre_slip=1 / 30, driven=False))
    assert braked[b] == 0
    assert braked[-1] < 0


def test_tyre_slip_uphill_is_proportional_to_the_slope():
    _, level, real = run(tyre_slip=1 / 30)
    up = replace(level, slope=np.full(len(level.t), 0.05))
    pulls = level.acceleration > 0.1
    more = wheels.slip_share(up, real) - wheels.slip_share(level, real)
    assert more[pulls] == pytest.approx(2 / 30 * 0.05)


@pytest.mark.parametrize('odometer', ['counts', 'speed', 'angle'])
def test_the_true_scale_is_metres_over_counts_between_the_marks(odometer):
    real = RealEffects(speed_law=0.01, warming=0.01, warming_time=50.0, tyre_slip=1 / 30)
    drive = simulate(SimOptions(**RUN, odometer=odometer, real=real, start_slip=0.01))
    t, value = (drive.odometer.stamp_ns - drive.options.start_ns) * 1e-9, drive.odometer.value
    path = ((value[1:] + value[:-1]) / 2 * np.diff(t)).sum()
    counted = path if odometer == 'speed' else value[-1] - value[0]
    # a pulse of 2 cm at either end; the sums of speeds at 50 Hz and of the truth's own steps
    at = 2 * 0.0213 / drive.truth.distance if odometer == 'counts' else 1e-6
    assert drive.truth.scale == pytest.approx(drive.truth.distance / counted, rel=at)
    assert drive.truth.scale_ratio == drive.truth.scale / drive.options.nominal_scale
    assert drive.truth.scale / drive.options.scale != pytest.approx(1, abs=1e-3)


def test_speed_quantisation_is_symmetric_in_both_directions():
    v = np.array([0.0, 0.2, 0.3, 0.99, -0.99, 1.6])
    floor, near = (RealEffects(speed_step=0.5, speed_rounding=r) for r in ('floor', 'round'))
    assert_allclose(wheels.published_speed(v, floor), [0, 0, 0, 0.5, -0.5, 1.5])
    assert_allclose(wheels.published_speed(v, near), [0, 0, 0.5, 1.0, -1.0, 1.5])
    assert_allclose(wheels.published_speed(v, RealEffects(dead_band=0.5)),
                    [0, 0, 0, 0.99, -0.99, 1.6])


def test_a_filtered_speed_lags_a_ramp_by_its_time_constant():
    t = np.arange(0.0, 20.0, 0.05)
    sent = wheels.low_pass_speed(1.5 * t, t, 0.4)
    # steps of first order: the input of a step counts as its end, half a step early
    assert sent[-1] == pytest.approx(1.5 * (t[-1] - 0.4 + 0.025), abs=1.5 * 0.05**2 / 0.4)
    assert wheels.low_pass_speed(t, t, 0.0) is t
