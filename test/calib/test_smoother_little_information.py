# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs with little information: too short for correlated errors, without turns, in circles."""

from dataclasses import replace
import re

from drives import off, settings
import numpy as np
import pytest
from reversing_drives import made as by_hand
from smoother_legs import made, reason_texts, truth

from odocal_ros.estimator import cramer_rao_bound, smooth
from odocal_ros.estimator.factors import interval_noise
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.nav.rotations import wrap
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.settings.config import with_settings
from odocal_ros.sim import routes
from odocal_ros.sim.profile import hold, ramp, turn
from odocal_ros.sim.real_effects import RealEffects

pytestmark = pytest.mark.slow
WINDOW, WINDOWS = 45.0, 6      # s, of one drive
TOWN = {'scenario': 'town', 'duration': 420.0, 'imu_grade': 'consumer', 'seed': 3}


@pytest.mark.parametrize('noise', ['correlated', 'white'])
def test_sigma_of_scale_and_pitch_includes_correlated_errors(noise):
    drive, config, leg = made(**TOWN, fix_noise=noise)
    found = [smooth(replace(leg, t_begin=begin, t_stop=begin + WINDOW), config)
             for begin in 20.0 + WINDOW * np.arange(WINDOWS)]
    for name in ('scale_factor', 'pitch_mounting_angle'):
        # chi2 of 6, 1 in 1000; if treated as white, each has an error of about 5 sigmas
        assert sum(off(one, drive, name)**2 for one in found) < 22.5
    for level in (r.details['noise'] for r in found if noise == 'white'):
        # of 450 values 3 sigmas of their rms; 45 s show little of the slow error: at most what
        # the receiver states
        assert level['fix'] == pytest.approx(1.0, abs=0.1)
        assert 0.0 < level['slow'] < 1.5
        assert level['correlation_time'] > 0


@pytest.mark.parametrize('stated', [0.5, 2.0])
def test_white_noise_level_is_that_of_the_fixes_for_any_stated_sigma(stated):
    _, config, leg = made(**TOWN, fix_noise='white')
    one, other = (smooth(replace(leg, t_begin=20.0, t_stop=20.0 + WINDOW,
                                 covariance_n=leg.covariance_n * by**2), config)
                  for by in (1.0, stated))
    white = [r.details['noise']['fix'] for r in (one, other)]
    assert white[1] * stated == pytest.approx(white[0], rel=0.05)
    # the initial level of the correlated error counts as one value, beside at most six 45 s apart
    assert other.estimates['scale_factor'].sigma == pytest.approx(
        one.estimates['scale_factor'].sigma, rel=0.25)


def test_scale_sigma_includes_a_correlated_error_too_small_to_be_detected():
    out = []
    for seed in range(1, 7):
        # 2 % of the variance of white fixes
        drive, config, leg = made(**TOWN | {'duration': 300.0, 'seed': seed},
                                  real=RealEffects(slow_errors=((0.21, 60.0),)))
        found = smooth(leg, config)
        assert found.details['noise']['correlation_time'] > 0
        out.append(off(found, drive))
    # chi2 of 6, 1 in 100 on either side; if treated as white it is 20.6
    assert 0.87 < np.square(out).sum() < 16.8


@pytest.mark.filterwarnings('error')
def test_fixes_without_imu_data_are_not_used():
    """Without fixes there is no median: numpy warned of it on the terminal of the node."""
    _, config, leg = made(**TOWN)
    imu, fix = leg.t_imu < 60.0, leg.t_fix > 100.0
    leg = replace(leg, t_begin=30.0, t_imu=leg.t_imu[imu], f_b=leg.f_b[imu], w_b=leg.w_b[imu],
                  t_fix=leg.t_fix[fix], fixes_n=leg.fixes_n[fix],
                  covariance_n=leg.covariance_n[fix])
    (reason,) = smooth(leg, config).reasons
    assert reason.text.startswith('0 fixes and ')
    assert re.search(r' (29\.9|30\.0) s of data; the smoother needs', reason.text)


def is_road_noise_assumed(method):
    """Return True if the result states that the noise of a road was assumed."""
    return any(r.code is Code.PARAMETER_NOT_DETERMINED and 'turns faster than 3 deg/s add up'
               in r.text and 'are assumed' in r.text for r in method.reasons)


def straight(**options):
    return made(scenario='straight', duration=300.0, imu_grade='industrial', **options)


@pytest.mark.parametrize('sway', [0.0, 0.05])
def test_straight_drive_states_the_bound_of_an_ordinary_road(sway):
    drive, config, leg = straight(sway=sway)
    method = smooth(leg, config)
    # road noise instead of the level from the residuals of the fit
    levels = Levels.from_sigmas(method.details['noise']).replaced(
        **dict.fromkeys(interval_noise.SIDEWAYS, 0.05**2 / 10.0))
    sigma = np.sqrt(cramer_rao_bound(leg, config, truth(drive, config, leg), levels)[1, 1])
    stated = method.estimates['yaw_mounting_angle'].sigma
    # linearised at the estimate and not at the truth, heavy tails: 3 %; sway of one second
    # has a level known to 5 % by sqrt(1 / 2 / 200 s)
    assert stated == pytest.approx(sigma, rel=0.03 + 0.05)
    assert stated > 0.97 * sigma
    if not sway:
        assert is_road_noise_assumed(method)


def test_leg_with_turns_determines_the_sideways_noise():
    _, config, leg = made(duration=200.0, imu_grade='industrial')
    method = smooth(leg, config)
    assert not is_road_noise_assumed(method)
    # wheels that never slide: far below the level of a road; up has the level of springs and road
    noise = method.details['noise']
    assert max(noise['side'], noise['side_turn']) < interval_noise.ORDINARY_ROAD / 10
    assert method.details['noise']['up'] == pytest.approx(interval_noise.MIN_VERTICAL_NOISE)


def test_total_turn_is_that_of_the_drive_for_any_gyro_bias():
    drive, config, leg = made(duration=200.0, imu_grade='industrial')
    problem = make_problem(leg, config)
    t = problem.imu.t_keyframes + (drive.truth.start_ns - drive.options.start_ns) * 1e-9
    yaw = np.abs(np.diff(drive.motion.at(t).yaw))
    # slower than TURNING between turns: less than that rate at all times
    turn = interval_noise.total_turn(leg, problem.imu)
    assert turn == pytest.approx(yaw[yaw > 0.05].sum(), rel=0.02)
    biased = replace(leg, w_b=leg.w_b + [0.0, 0.0, 0.06])
    assert make_problem(biased, config).total_turn == pytest.approx(problem.total_turn, rel=0.02)
    _, config, leg = straight()
    assert make_problem(leg, config).total_turn == 0.0


def test_lower_limit_falls_continuously_from_road_noise_to_that_of_turns():
    angles = np.deg2rad(np.arange(0.0, 270.0))
    least = np.array([interval_noise.min_sideslip(a) for a in angles])
    assert least[:90] == pytest.approx(interval_noise.ORDINARY_ROAD)
    assert least[181:] == pytest.approx(interval_noise.MIN_TURN_SIDESLIP)
    # a factor of 80 over 90 deg: 5 % per degree
    by_90 = np.log(interval_noise.ORDINARY_ROAD / interval_noise.MIN_TURN_SIDESLIP)
    assert np.abs(np.diff(np.log(least))).max() < by_90 / 90 * 1.001


def circles(duration, rng):
    """Return left circles on level ground: 9 m/s, a radius of 30 m after 60 m straight on."""
    speed = hold(20) + ramp(6, 9, 1.0) + hold(248) + ramp(6, -9, 1.0) + hold(10)
    return routes._route([(speed, hold(30) + turn(244, 0.3 * 244, 1.0) + hold(16))])


@pytest.mark.parametrize('yaw', [-1.6, 3.1])
def test_heading_in_circles_is_found_for_any_heading(yaw):
    drive = by_hand(circles, heading=np.pi / 2 - yaw, yaw=0.0, pitch=0.0, imu_grade='consumer',
                    imu_rate=100.0, fix_rate=1.0, fix_sigma=0.3, seed=1)
    method = calibrate(drive.leg(), with_settings(settings(drive, None), {
        'method': 'smoother'})).methods['smoother']
    forward = method.details['key_C_nb'][-1][:, 0]
    last = (drive.truth.start_ns - drive.options.start_ns) * 1e-9 + method.details['key_t'][-1]
    off = np.arctan2(forward[1], forward[0]) - drive.motion.at(np.array([last])).yaw[0]
    assert abs(wrap(off)) < 0.05      # rad; 0.3 m of a fix at 30 m are 0.01
    assert Code.FIXES_NOISIER_THAN_SAID not in reason_texts(method)
