# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Named drives and the route of a robot indoors: length, stops, turns, marks, references."""

from contextlib import suppress
from dataclasses import replace
import re

import numpy as np
import pytest

from odocal_ros.bagio.read import open_bag
from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.data.samples import LOCAL_STATUS
from odocal_ros.errors import BadUsage
from odocal_ros.library.read_bag import read_bag
from odocal_ros.sim.noise import reference_drift
from odocal_ros.sim.options import BY_SCENARIO, REFERENCES, resolve
from odocal_ros.sim.scenarios import motion_of, SCENARIOS, SimOptions, simulate

pytestmark = pytest.mark.core
LOCAL_KINDS = [kind for kind in REFERENCES if kind != 'fix']


def states(name, step=0.1, **options):
    options = resolve(SimOptions(scenario=name, **options))
    motion = motion_of(options)
    return motion, motion.at(np.arange(0, motion.duration + step / 2, step))


def chord(state):
    north = (state.latitude[-1] - state.latitude[0]) * 6.36e6
    east = (state.longitude[-1] - state.longitude[0]) * 6.386e6 * np.cos(state.latitude[0])
    return np.hypot(north, east)


def test_scenario_straight_is_the_straight_run_of_the_method():
    motion, state = states('straight')
    assert motion.duration == 720
    # 60 still, 25 up, 550 at 12 m/s, 25 down, 60 still
    assert motion.distance == pytest.approx(12 * (550 + 25))
    assert state.speed[[600, 850, 6350, 6600]] == pytest.approx([0, 12, 12, 0], abs=1e-12)
    assert (state.yaw_rate == 0).all()


def test_out_and_back_stops_at_the_far_end_and_returns():
    motion, state = states('out_and_back')
    assert chord(state) < 60 < motion.distance / 20
    assert state.yaw[-1] - state.yaw[0] == pytest.approx(np.pi)
    still = state.speed == 0
    stops = np.flatnonzero(still[1:] & ~still[:-1])
    assert len(stops) == 2
    half = state.travel[stops[0]]
    # the same straight back, and the metres of the U turn
    assert motion.distance - 2 * half == pytest.approx(0, abs=150)
    assert half > 2000


@pytest.mark.parametrize('seed', range(20))
def test_town_has_stops_and_turns_and_a_long_chord(seed):
    motion, state = states('town', seed=seed)
    assert motion.duration == 600
    assert chord(state) > 0.35 * motion.distance    # the two-point method requires a fifth
    assert (state.speed[:200] == 0).all()
    assert (state.speed[-150:] == 0).all()
    moves = state.speed > 0
    assert np.count_nonzero(moves[1:] & ~moves[:-1]) >= 6          # stop and go
    assert 0.1 < (~moves).mean() < 0.45
    assert state.speed.max() <= 14
    assert np.degrees(np.abs(state.yaw_rate)).max() > 8
    assert np.abs(state.speed * state.yaw_rate).max() < 3.3        # m/s^2 to the side
    assert state.speed.min() >= 0
    assert (np.abs(state.yaw_rate[~moves]) == 0).all()             # no turns on the spot


@pytest.mark.parametrize('name', SCENARIOS)
def test_marks_are_imu_stamps_at_rest(name):
    drive = simulate(SimOptions(scenario=name, imu_rate=20.0))
    for mark in (drive.truth.start_ns, drive.truth.stop_ns):
        assert mark in drive.imu.stamp_ns
        assert drive.motion.at([(mark - drive.options.start_ns) * 1e-9]).speed[0] < 1e-9
    after = drive.truth.start_ns + 200_000_000
    assert drive.motion.at([(after - drive.options.start_ns) * 1e-9]).speed[0] > 1e-9
    leg = drive.leg()
    assert (leg.start_ns, leg.stop_ns) == (drive.truth.start_ns, drive.truth.stop_ns)
    assert leg.form.scale_unit == 'm/pulse'
    assert leg.imu is drive.imu


def test_every_option_has_a_value():
    for name in SCENARIOS:
        options = resolve(SimOptions(scenario=name))
        for field in ('duration', 'imu_grade', 'yaw', 'pitch', 'scale', 'nominal_scale',
                      'fix_sigma'):
            assert getattr(options, field) is not BY_SCENARIO
    assert resolve(options) == options
    assert resolve(SimOptions(scenario='paper', scale=0.5)).nominal_scale == 0.6
    assert resolve(SimOptions(odometer='angle', nominal_scale=0.33)).nominal_scale == 0.33
    assert resolve(SimOptions(fix_noise='rtk')).fix_sigma == 0.02


@pytest.mark.parametrize(('change', 'message'), [
    ({'scenario': 'moon'}, '--scenario moon: required: one of paper, straight'),
    ({'scenario': 'twon'}, '--scenario twon: did you mean town'),
    ({'imu_grade': 'best'}, '--imu-grade best: required: one of consumer'),
    ({'fix_noise': 'pink'}, '--fix-noise pink: required: one of white'),
    ({'odometer': 'radar'}, '--odometer radar: required: one of counts'),
    ({'imu_rate': 0.0}, '--imu-rate 0: required: a number above 0'),
    ({'imu_rate': float('nan')}, '--imu-rate nan: required: a finite number'),
    ({'imu_rate': 20_000.0}, '--imu-rate 20000: the limit is 10000'),
    ({'seed': -1}, '--seed -1: required: 0 or more'),
    ({'fix_sigma': -1.0}, '--fix-sigma -1: required: 0 or more'),
    ({'orientation_sigma': -0.1}, '--orientation-sigma-deg -5.7'),
    ({'pitch': 1.0}, '--pitch-deg 57.2958: the limit is 45'),
    ({'antenna_lever_arm': (0.0, np.inf, 0.0)}, '--antenna-lever-arm inf: required: '),
    ({'outliers': 0.6}, '--outliers 0.6: the limit is 0.5'),
    ({'outages': ((5.0, 2.0),)}, '--outage 5:2: required: A:B'),
    ({'two_wheels': True, 'odometer': 'speed'}, '--wheels require'),
    ({'wheels': 4, 'odometer': 'speed'}, '--wheels require'),
    ({'wheels': 9}, '1 to 8'), ({'wheels': 0}, '1 to 8'),
    ({'scenario': 'town', 'drive': 'skid'}, '--drive skid: --scenario town: required: one of '
     'indoor'),
    ({'duration': 30_000.0, 'imu_rate': 1000.0}, 'more than 20,000,000 samples'),
    ({'duration': 100.0}, 'scenario straight: --duration 100 s is too short, give 180'),
    ({'scenario': 'paper', 'duration': 411.0}, 'scenario paper: .* give 420'),
    ({'scenario': 'out_and_back', 'duration': 200.0}, 'scenario out_and_back: .* too short'),
    ({'scenario': 'town', 'duration': 46.0}, 'scenario town: .* is too short for a stop-and-go '
     'cycle')])
def test_impossible_drives_are_refused_with_a_message(change, message):
    with pytest.raises(BadUsage, match=message):
        simulate(replace(SimOptions(), **change))


def test_sway_has_the_configured_size_and_is_not_in_the_wheel_travel():
    (motion, state), (bare, plain) = (states('town', sway=x) for x in (0.05, 0.0))
    fast = state.speed > 1.0
    # draws are at the 10 Hz of these states; 5 sigma of a variance
    n = 2 * fast.sum()
    assert state.sway[fast].var() / 0.05**2 == pytest.approx(1, rel=5 * np.sqrt(2 / n))
    assert (state.sway[state.speed == 0] == 0).all()
    assert (plain.sway == 0).all()
    assert np.array_equal(state.travel, plain.travel)
    # a tenth of a second each: 0.05 m/s sqrt(0.1 s t) of random walk, here with 5 sigma
    aside = (state.latitude - plain.latitude) * 6.36e6
    assert 0.0 < np.abs(aside).max() < 5 * 0.05 * np.sqrt(0.1 * motion.duration)


@pytest.mark.parametrize('seed', range(10))
def test_scenario_motorway_is_fast_long_and_has_gentle_turns(seed):
    motion, state = states('motorway', seed=seed)
    assert motion.duration == pytest.approx(600)
    assert state.speed[[0, -1]] == pytest.approx([0, 0], abs=1e-11)
    fast = state.speed > 24.9
    assert fast.mean() > 0.6
    assert state.speed.max() <= 36 + 1e-9
    assert np.degrees(np.abs(state.yaw_rate[fast])).max() < 1.5
    assert np.degrees(np.abs(state.yaw_rate)).max() > 3            # the slip road
    assert np.abs(state.acceleration).max() < 1.8
    assert np.abs(state.speed * state.yaw_rate).max() < 3


@pytest.mark.parametrize('seed', range(10))
def test_scenario_yard_is_slow_has_turns_and_reversing(seed):
    motion, state = states('yard', seed=seed)
    assert motion.duration == pytest.approx(600)
    assert np.abs(state.speed).max() < 2.3
    still = np.abs(state.speed) < 1e-9
    assert 0.2 < still.mean() < 0.5
    assert (state.speed < -0.3).any()
    assert np.degrees(np.abs(state.yaw_rate)).max() > 15
    moves = ~still
    assert np.count_nonzero(moves[1:] & ~moves[:-1]) > 20


@pytest.mark.parametrize('name', SCENARIOS)
def test_a_drive_that_is_too_short_is_refused_with_the_minimum(name):
    with pytest.raises(BadUsage, match='too short') as error:
        states(name, duration=20.0)
    enough = float(re.search(r'give (\d+) s', str(error.value))[1])
    for seed in range(5):
        motion, state = states(name, duration=enough, seed=seed)
        assert abs(motion.distance) > 1
        assert motion.duration == pytest.approx(enough)
        assert state.speed[-1] == pytest.approx(0, abs=1e-11)
        for duration in np.linspace(20.0, enough, 12)[1:-1]:
            with suppress(BadUsage):
                assert abs(states(name, duration=duration, seed=seed)[0].distance) > 1


def indoor(**options):
    return simulate(SimOptions(scenario='indoor', **{'imu_rate': 20.0} | options))


@pytest.mark.parametrize('seed', range(10))
@pytest.mark.parametrize('duration', [30.0, 180.0])
def test_a_robot_drives_straight_sections_arcs_and_turns_on_the_spot(seed, duration):
    motion = motion_of(resolve(SimOptions(scenario='indoor', seed=seed, duration=duration)))
    assert motion.duration == pytest.approx(duration)
    state = motion.at(np.arange(0.0, duration, 0.05))
    assert state.speed.min() >= 0.0
    assert state.speed.max() <= 1.2
    assert np.abs(state.yaw_rate).max() < 1.3
    still = (state.speed == 0.0) & (state.yaw_rate == 0.0)
    assert still[:100].all()            # 5 s before and after
    assert still[-100:].all()
    spot = (state.speed == 0.0) & (state.yaw_rate != 0.0)
    assert spot.any()
    assert ((state.speed > 0.1) & (state.yaw_rate == 0.0)).any()
    if duration > 100.0:
        assert {-1.0, 1.0} <= set(np.sign(state.yaw_rate[spot]))
        assert ((state.speed > 0.1) & (state.yaw_rate != 0.0)).any()


@pytest.mark.parametrize('kind', LOCAL_KINDS)
def test_a_bag_contains_the_positions_of_the_leg(kind, tmp_path):
    made = indoor(duration=40.0, reference=kind)
    leg, topic = made.leg(), REFERENCES[kind].topic
    bag = write_bag(tmp_path / 'bag', drive_topics(made))
    with open_bag(bag) as opened:
        assert topic in opened.topics
        assert {'/odometer/left', '/odometer/right'} <= set(opened.topics)
    fix = read_bag(bag, {'imu': '/imu/data', 'odometer': '/odometer/left',
                         'fix': topic}).samples('fix')
    assert (fix.status == LOCAL_STATUS).all()
    for name in ('stamp_ns', 'latitude', 'longitude', 'height', 'covariance_n', 'covariance_type'):
        np.testing.assert_array_equal(getattr(fix, name), getattr(leg.fix, name), name)
    if REFERENCES[kind].is_planar:
        assert (made.positions()[:, 2] == 0.0).all()
        assert np.isnan(fix.height).all()
        assert (fix.covariance_n[:, 2, 2] == 0.0).all()


@pytest.mark.parametrize(('kind', 'sigma'), [('mocap', 1e-3), ('total_station', 2e-3)])
def test_position_errors_have_the_size_of_the_kind_of_source(kind, sigma):
    exact = indoor(duration=180.0, reference=kind, fix_sigma=0.0).positions()
    error = indoor(duration=180.0, reference=kind).positions() - exact
    # 1800 rows or more: 5 sigma of a standard deviation are 9 %
    assert error[:, :2].std() == pytest.approx(sigma, rel=0.1)


def test_amcl_error_is_constant_at_rest_and_decorrelates_with_the_path():
    options = resolve(SimOptions(scenario='indoor', reference='amcl'))
    t = np.arange(0.0, 20_000.0, 1.0)
    travel = np.where(t < 10_000.0, 0.0, t - 10_000.0)
    error = reference_drift(t, travel, options)
    assert np.ptp(error[t < 10_000.0], axis=0) == pytest.approx(0.0)
    # sqrt(2 m / 2) of path; 5000 independent values
    assert error[t > 10_000.0, :2].std() == pytest.approx(0.05, rel=0.1)
    assert (error[:, 2] == 0.0).all()


def test_slam_drifts_with_the_path_and_jumps_back():
    t = np.arange(0.0, 3000.0, 0.1)
    free = resolve(SimOptions(scenario='indoor', closure_time=0.0))
    closing = resolve(SimOptions(scenario='indoor'))
    steps = np.diff(reference_drift(t, t, free)[:, :2], axis=0)       # at 1 m/s
    assert steps.std() == pytest.approx(0.01 * np.sqrt(0.1), rel=0.02)
    error = reference_drift(t, t, closing)[:, :2]
    # between loop closures 30 s apart on average: sqrt(30 m) of random walk
    assert 0.02 < np.abs(error).max() < 0.3
    jumps = np.hypot(*np.diff(error, axis=0).T) > 0.02
    assert 40 < jumps.sum() < 100       # of 100 loop closures, those with an error to correct


def test_wheels_slip_also_in_turns_on_the_spot():
    made, bare = (indoor(seed=4, duration=60.0, slip_walk=slip) for slip in (1e-3, 0.0))
    state = made.motion.at((made.odometer.stamp_ns - made.options.start_ns) * 1e-9)
    spot = (state.speed == 0.0) & (state.yaw_rate != 0.0)
    slip = np.diff(made.odometer.value - bare.odometer.value)
    assert slip[spot[1:]].any()
    assert not slip[(state.speed == 0.0)[1:] & (state.yaw_rate == 0.0)[1:]].any()
