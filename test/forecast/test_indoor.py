# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Indoor runs: the forecast against closed forms and simulated runs; the running estimate."""

import math

from drives import robot_motion, thinned
import numpy as np
import pytest

from odocal_ros.errors import BadData, BadUsage
from odocal_ros.forecast.forecast import LegEnded
from odocal_ros.forecast.planned_indoor import predict_robot, Robot
from odocal_ros.forecast.robot_motion import pattern_motion, PATTERNS
from odocal_ros.forecast.smoother_forecast import planar_forecast
from odocal_ros.library.plan_indoor import plan_indoor, ratio_sigma, robot_of
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

SLIP = 1e-3      # m/sqrt(s)
CONFIG = with_settings(Config(), {'odometer.left': 'topic', 'odometer.right': 'topic'})


@pytest.mark.parametrize('drive', ['differential', 'mecanum'])
@pytest.mark.parametrize('name', PATTERNS)
def test_a_pattern_ends_at_the_end_of_its_moves(name, drive):
    """Out and back: both turn directions are equal, a round ends at the heading of its start."""
    d = pattern_motion(name, 3.0, 1, drive).increments
    assert abs(d[:, 2].sum()) < 1e-9
    forward = {'straight': 6.0, 'square': 24.0, 'figure_eight': 3 * math.pi, 'spot': 6.0}[name]
    assert d[:, 0].sum() == pytest.approx(forward, rel=1e-9)
    assert bool(np.abs(d[:, 1]).sum() > 0) is (drive == 'mecanum' and name != 'figure_eight')


def test_the_scale_of_exact_positions_is_limited_by_the_slip():
    """Of two wheels: slip sqrt(T / 2) over the path, T s in motion straight ahead."""
    motion = pattern_motion('straight', 4.0, 3, 'differential')
    robot = Robot(drive='differential', imu=False, width=0.3, slip=SLIP, position_sigma=1e-5)
    found = predict_robot(motion, robot, Config())
    moving = (motion.speed > 0).sum() * 0.1
    closed = SLIP * math.sqrt(moving / 2) / motion.distance
    # the level per metre is that of the mean speed: the weight of ramps is too large
    assert found.estimates['scale_factor'].sigma == pytest.approx(closed, rel=0.15)
    assert ratio_sigma(found) == pytest.approx(2 * closed, rel=0.15)


@pytest.mark.parametrize(('drive', 'imu', 'values'), [
    ('differential', False, {'scale_factor': 1.5, 'track_width': 1.6}),
    ('differential', True, {'yaw_mounting_angle': 1.5, 'track_width': 1.6}),
    ('skid', False, {'scale_factor': 1.5, 'track_width_arc': 1.3})])
def test_the_forecast_is_near_the_sigma_of_a_simulated_run(drive, imu, values):
    """The run estimates its noise levels: benchmarks/indoor_bound.py gives their scatter."""
    made = simulate(SimOptions(
        scenario='indoor', duration=150.0, drive=drive, imu=imu, reference='total_station',
        slip_walk=SLIP, odometer='angle', imu_grade='industrial', seed=5))
    config = with_settings(Config(), {
        'odometer.left': 'left', 'odometer.right': 'right', 'odometer.drive': drive,
        'imu.grade': 'industrial'})
    method = calibrate(made.leg(), config).methods['smoother' if imu else 'planar']
    found = predict_robot(robot_motion(made.options), robot_of(made.options), config)
    for name, most in values.items():
        then, now = method.estimates[name], found.estimates[name]
        size = 1.0 if now.unit == 'rad' else then.value / now.value
        assert 1 / most < then.sigma / (now.sigma * size) < most, name


def test_marks_determine_the_width_by_squares_and_not_by_an_eight():
    square, eight = (plan_indoor(run, reference='marks', imu=False)[0]
                     for run in ('square', 'figure_eight'))
    assert square.sigma('track_width') < 0.01
    assert eight.sigma('scale_factor') is None


def test_a_run_whose_positions_do_not_determine_its_motion_gives_a_reason():
    """All rests of an eight are at one place: the normal equations of a small one are singular."""
    eight, = plan_indoor('figure_eight', reference='marks', imu=False, size=2.0)
    assert set(eight.to_dict()['sigmas'].values()) == {None}
    assert [reason.code.name for reason in eight.method.reasons] == ['SCALE_NOT_DETERMINED']


@pytest.mark.parametrize(('options', 'message'), [
    ({'run': 'circle'}, '--indoor circle: required: one of all, straight'),
    ({'reference': 'gps'}, '--reference gps: required: one of mocap'),
    ({'size': 0.0}, '--size 0: required: a number above 0'),
    ({'size': 1e9}, 'more than ten hours'),
    ({'track_width': 0.0}, '--track-width')])
def test_invalid_options_are_refused(options, message):
    with pytest.raises(BadUsage, match=message):
        plan_indoor(**options)


@pytest.fixture(scope='module')
def leg():
    return simulate(SimOptions(scenario='indoor', duration=110.0, imu=False, reference='mocap',
                               fix_rate=10.0, slip_walk=5e-4, seed=3)).leg()


def forecast(leg, seconds, is_needed=lambda: True):
    return planar_forecast(thinned(leg, seconds).leg(leg.start_ns), CONFIG, is_needed)


def test_the_last_update_agrees_with_the_result(leg):
    """Its samples are cells of 0.1 s, within which the speed changes: measured, 0.75 sigma."""
    found, result = forecast(leg, 1e9), calibrate(leg, CONFIG)
    for name in ('scale_factor', 'scale_factor_left', 'track_width'):
        now, then = found.estimates[name], result.methods['planar'].estimates[name]
        assert abs(now.value - then.value) < then.sigma
        assert now.sigma == pytest.approx(then.sigma, rel=0.15)
    assert found.scale.remaining_m == 0.0
    assert found.is_complete
    assert not found.faults
    assert 'yaw: not estimated on this robot' in found.as_text()


def test_remaining_distance_follows_from_sigma_over_root_of_path(leg):
    """Nine times the variance that is required: eight times the path more."""
    result = calibrate(leg, CONFIG)
    scale = result.methods['planar'].estimates['scale_factor']
    strict = with_settings(CONFIG, {'verdict.max_scale_sigma': scale.sigma / scale.value / 3})
    found = planar_forecast(leg, strict, lambda: True)
    assert found.scale.remaining_m == pytest.approx(8 * result.distance, rel=1e-6)


def test_no_forecast_is_made_before_the_first_motion_or_if_not_needed(leg):
    with pytest.raises(BadData, match='positions while the wheels have data'):
        forecast(leg, 0.0)
    with pytest.raises(LegEnded):
        forecast(leg, 1e9, lambda: False)
