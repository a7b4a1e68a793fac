# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The smoother in a local frame: robots, whose runs are short and slow."""

from dataclasses import replace

import drives
from drives import off
import numpy as np
import pytest

from odocal_ros.calib.drive import motion_reasons
from odocal_ros.calib.gyro_axes import turn_ratio
from odocal_ros.estimator.leg import drift_time, SmootherLeg
from odocal_ros.nav.dead_reckoning import Origin, rough_scale
from odocal_ros.nav.geodesy import MIN_GNSS_MOTION, MIN_LOCAL_MOTION, rate_without_north
from odocal_ros.nav.odometer import Travel
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code, Verdict
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow


# SLAM: with its z of 0 as a height, IMU noise looked like a growing delay. Motion capture:
# derivatives of its positions by accelerometer errors contained noise
@pytest.mark.parametrize('options', [{'seed': 2, 'fix_noise': 'rtk'},
                                     {'seed': 4, 'reference': 'mocap'}], ids=['slam', 'mocap'])
def test_a_robot_that_stands_for_minutes_converges(options):
    made = simulate(SimOptions(scenario='square', duration=600.0, imu_rate=100.0,
                               imu_grade='consumer', odometer='angle', **options))
    smoother = calibrate(made.leg(), drives.configured(made)).methods['smoother']
    assert smoother.details['iterations'] < 20
    assert off(smoother.estimates, made, 'scale_factor', 'yaw_mounting_angle') < 3


@pytest.mark.parametrize(('rate', 'used'), [(100.0, 20.0), (10.0, 10.0)])
def test_positions_of_motion_capture_are_thinned_to_20_per_second(rate, used):
    made = simulate(SimOptions(scenario='indoor', duration=60.0, seed=3, imu_rate=50.0,
                               reference='mocap', fix_rate=rate))
    smoother = calibrate(made.leg(), drives.configured(made)).methods['smoother']
    assert smoother.details['residuals']['fixes'] == pytest.approx(60.0 * used, rel=0.1)


@pytest.mark.parametrize(('reference', 'limit', 'noise'), [
    ('mocap', 1e-3, 1e-3), ('total_station', 1e-3, 2e-3), ('slam', 5e-3, None),
    ('amcl', 1e-2, None)])
def test_two_minutes_give_radius_ratio_width_and_yaw(reference, limit, noise):
    """An IMU mounted nose down, with which a wrong derivative gave a yaw error of 5 sigma."""
    made = simulate(SimOptions(scenario='indoor', duration=120.0, seed=3, imu_rate=50.0,
                               reference=reference, pitch=-0.04, roll=0.01))
    config = with_settings(drives.configured(made), {'odometer.track_width': 0.0,
                                                     'verdict.max_scale_sigma': 0.02})
    result = calibrate(made.leg(), config)
    assert not {Code.LEG_TOO_SHORT, Code.SPEED_TOO_LOW} & {r.code for r in result.reasons}
    assert all(r.code.severity is Verdict.ACCEPTED for r in result.reasons), result.reasons
    smoother = result.methods['smoother']
    assert smoother.details['iterations'] < 20
    found = smoother.estimates
    assert found['scale_factor'].sigma < limit * made.truth.scale
    if noise:       # of 1200 and more positions, whose level is known to 3 %; none is stated
        stated = config.in_local_frame().gnss.default_sigma
        assert smoother.details['noise']['fix'] * stated == pytest.approx(noise, rel=0.1)
    assert off(found, made, 'scale_factor', 'yaw_mounting_angle', 'track_width',
               'scale_factor_left', 'scale_factor_right') < 3


def test_a_robot_on_a_lawn_of_a_few_metres_has_a_result_with_rtk():
    """Its fixes stay within 20 m, which a receiver without corrections does at rest."""
    made = simulate(SimOptions(scenario='indoor', duration=120.0, seed=3, imu_rate=50.0,
                               reference='total_station'))
    leg, variance = made.leg(), 0.014**2
    config = with_settings(drives.configured(made), {'leg.min_distance': 2.0,
                                                     'leg.min_speed': 0.1})
    count = len(leg.fix.status)
    fix = replace(leg.fix, status=np.full(count, 2), covariance_type=np.full(count, 3),
                  covariance_n=np.full((count, 1, 1), variance) * np.eye(3))
    result = calibrate(replace(leg, fix=fix), config)
    assert not {r.code for r in result.reasons} & {Code.LEG_TOO_SHORT, Code.SPEED_TOO_LOW}
    assert off(result.methods['smoother'].estimates, made, 'scale_factor', 'track_width') < 3
    # fixes that may move as far at rest
    fix = replace(fix, covariance_n=np.full((count, 1, 1), 2.5**2) * np.eye(3))
    reason, = calibrate(replace(leg, fix=fix), config).reasons
    assert 'the fixes do not move' in reason.text


def test_limits_are_the_smaller_of_the_setting_and_that_of_the_frame():
    config = with_settings(Config(), {'leg.min_distance': 50.0, 'reference.min_speed': 5.0})
    local = config.in_local_frame()
    assert (local.leg.min_distance, local.leg.min_speed) == (2.0, 2.78)
    assert local.gnss.default_sigma == 0.05
    assert config.gnss.default_sigma == 2.5


def origin(local):
    """Return an origin on the equator, of a local frame or not."""
    return Origin(0.0, 0.0, 0.0, rate_without_north(0.7) if local else None)


def room(rng):
    """Return times, fixes and travel of a robot that drives sides of 2 m and turns between."""
    t = np.arange(0.0, 200.0, 0.1)
    moves = t % 10.0 < 5.0                      # 0.4 m/s, then 5 s on the spot
    faces = np.cumsum(np.where(moves, 0.0, 2.0 / 5.0 * (-1.0) ** (t // 30.0))) * 0.1
    step = 0.04 * moves[:, None] * np.stack([np.cos(faces), np.sin(faces)], -1)
    fixes = np.cumsum(step, axis=0) + 0.01 * rng.standard_normal((len(t), 2))
    return t, fixes, np.cumsum(0.04 * moves), faces


def test_rough_scale_in_a_room_is_that_of_its_straight_sections():
    t, fixes, route, _ = room(np.random.default_rng(1))
    travel = Travel(t, route / 1e-4, 1.0)
    assert rough_scale(travel, t, fixes, 0.01, MIN_LOCAL_MOTION) == pytest.approx(1e-4, rel=0.05)
    assert not motion_reasons(travel, t, fixes, 0.01, 200.0, MIN_LOCAL_MOTION)
    assert motion_reasons(travel, t, fixes, 0.01, 200.0, MIN_GNSS_MOTION)
    # a reference that states a metre, and shows a centimetre
    assert not motion_reasons(travel, t, fixes, 1.0, 200.0, MIN_LOCAL_MOTION)


def test_turns_on_the_spot_do_not_count_as_changes_of_course():
    t, fixes, _, faces = room(np.random.default_rng(2))
    rate = np.gradient(faces, t)
    for unit in (1.0, 57.3):
        ratio = turn_ratio(t, unit * rate, t, fixes, 0.01, MIN_LOCAL_MOTION)
        assert ratio == pytest.approx(unit, rel=0.1)


def test_errors_in_a_local_frame_change_with_the_path_of_the_wheels():
    t = np.arange(0.0, 11.0)
    route = np.interp(t, [0.0, 4.0, 6.0, 10.0], [0.0, 0.0, 3.0, 3.0])
    leg = object.__new__(SmootherLeg)
    turning = Travel(t, np.interp(t, [0.0, 6.0, 8.0, 10.0], [0.0, 0.0, 1.0, 1.0]), 0.0)
    for name, value in {'travel': Travel(t, route, 0.0),
                        'wheels': (Travel(t, route, 0.0), turning),
                        'origin': origin(True), 'rough_scale': 1.0}.items():
        object.__setattr__(leg, name, value)
    # 3 m, then 1 m of one wheel; at rest a hundredth
    expected = np.where((t[:-1] >= 4) & (t[:-1] < 6), 10 * 1.5 / 4, np.where(
        (t[:-1] >= 6) & (t[:-1] < 8), 10 * 0.5 / 4, 0.01))
    assert drift_time(leg, t) == pytest.approx(expected)
    object.__setattr__(leg, 'rough_scale', 4.0)      # 6 m/s: a car
    assert (drift_time(leg, t) == 1.0).all()
    object.__setattr__(leg, 'rough_scale', 1.0)
    object.__setattr__(leg, 'origin', origin(False))
    assert (drift_time(leg, t) == 1.0).all()
