# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The two-point method on simulated drives: results and refusals."""

from dataclasses import replace

import drives
import numpy as np
import pytest

from odocal_ros.data.samples import take
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code

pytestmark = pytest.mark.core
CLEAN = {'imu_grade': 'perfect', 'fix_sigma': 0.0, 'odometer': 'angle', 'imu_rate': 100.0,
         'odometer_rate': 50.0}
DEG = np.pi / 180


def found(made, config=None, leg=None):
    e = drives.two_point(leg or made.leg(), config or drives.settings(made)).estimates
    return e['scale_factor'].value, e['yaw_mounting_angle'].value, e['pitch_mounting_angle'].value


@pytest.mark.parametrize('options', [
    {'scenario': 'straight', 'duration': 200.0},
    {'scenario': 'straight', 'duration': 200.0, 'yaw': -3.0 * DEG, 'pitch': 2.0 * DEG},
    {'scenario': 'town', 'duration': 200.0, 'seed': 2},
    {'scenario': 'town', 'duration': 200.0, 'seed': 2, 'antenna_lever_arm': (2.0, 0.5, 1.5)},
    {'scenario': 'town', 'duration': 200.0, 'seed': 2, 'odometer_lever_arm': (0.0, 0.8, -0.3)},
    {'scenario': 'town', 'duration': 200.0, 'seed': 2, 'mounting_rpy': (np.pi, 0.0, 1.0)},
    {'scenario': 'straight', 'duration': 200.0, 'two_wheels': True},
    {'scenario': 'straight', 'duration': 200.0, 'latitude': -60 * DEG, 'longitude': 179.999 * DEG,
     'heading': 80 * DEG, 'height': 2500.0},
    *({'scenario': 'paper', 'yaw': DEG, 'odometer': o} for o in ('counts', 'angle', 'speed')),
], ids=['straight', 'angles', 'town', 'antenna', 'wheel', 'axes', 'wheels', 'antimeridian',
        'paper, counts', 'paper, angle', 'paper, speed'])
def test_error_free_data_give_the_truth(options):
    """
    The remaining error is the trapezoid rule of attitude and travel in turns, 20 ms a step.

    A turn of w rad/s changes a step by w^2 dt^2 / 12 of itself: at 0.3 rad/s 3e-6, in the
    quarter of the path length in turns; the same for yaw and pitch.
    """
    made = drives.drive(**CLEAN | options)
    scale, yaw, pitch = found(made)
    assert scale == pytest.approx(made.truth.scale, rel=1e-6)
    assert yaw == pytest.approx(made.truth.yaw, abs=3e-6)
    assert pitch == pytest.approx(made.truth.pitch, abs=1e-5)


def test_ratio_refers_to_the_nominal_scale_and_is_unknown_without_one():
    made = drives.drive(**CLEAN, scenario='straight', duration=200.0)
    e = drives.two_point(made.leg(), drives.settings(made)).estimates['scale_ratio']
    assert e.value == pytest.approx(made.truth.scale_ratio, rel=1e-6)
    e = drives.two_point(made.leg(), drives.settings(made, odometer__nominal_scale=0.0)).estimates
    assert e['scale_ratio'].value is None
    assert e['scale_factor'].value == pytest.approx(made.truth.scale, rel=1e-6)


def surveyed(fix, k):
    """Return a fix as a surveyed point, accurate to 1 cm."""
    return tuple(map(float, (np.rad2deg(fix.latitude[k]), np.rad2deg(fix.longitude[k]),
                             fix.height[k], 0.01)))


def test_surveyed_points_replace_fixes():
    made = drives.drive(**CLEAN, scenario='straight', duration=200.0)
    leg, fix = made.leg(), made.fix
    ends = [surveyed(fix, k) for k in (0, -1)]
    # fix errors of 50 m, common except for the last part: only the survey is correct
    off = drives.changed(fix, latitude=lambda a: a + 1e-6 * np.linspace(0, 8, len(a)))
    config = drives.settings(made, reference__start=ends[0], reference__end=ends[1])
    scale, yaw, _ = found(made, config, replace(leg, fix=off))
    assert scale == pytest.approx(made.truth.scale, rel=1e-6)
    assert yaw == pytest.approx(made.truth.yaw, abs=1e-5)
    sources = {s.name: s for s in drives.two_point(replace(leg, fix=off), config).sources}
    track_n = calibrate(leg, config).track_n
    length = np.hypot(*(track_n[-1][:2] - track_n[0][:2]))
    # 1 cm at each end; residuals of the wrong fixes may widen it
    assert sources['fix_end'].effects[0] @ sources['fix_end'].effects[0] >= (0.009 / length)**2


def test_surveyed_end_is_not_used_as_the_end_of_a_holdout():
    made = drives.drive(**CLEAN, scenario='straight', duration=200.0)
    config = drives.settings(made, reference__end=surveyed(made.fix, -1))
    result = calibrate(made.leg(), config, holdout=True)
    scale = result.methods['two_point'].estimates['scale_factor'].value
    assert scale == pytest.approx(made.truth.scale, rel=1e-5)


def test_marks_in_motion_are_fitted_and_their_time_errors_are_budgeted():
    made = drives.drive(scenario='straight', duration=200.0, imu_grade='tactical', seed=8)
    moving = drives.shifted(made.leg(), start=30.0, stop=-90.0)       # both at 12 m/s
    result = calibrate(moving, drives.settings(made))
    assert all(abs(z) < 4 for z in drives.errors_in_sigmas(result, made.truth).values())
    # only the stop mark is in motion now: 12 m/s times 0.05 s over the chord
    half = calibrate(drives.shifted(made.leg(), stop=-90.0), drives.settings(made))
    latency = half.methods['two_point'].details['budget']['fix_latency']
    length = np.hypot(*(half.track_n[-1] - half.track_n[0])[:2])
    assert latency['scale_factor'] / made.truth.scale == pytest.approx(0.6 / length, rel=0.05)
    # the same speed at both ends: the chord is late by the same distance at both ends
    both = result.methods['two_point'].details['budget']['fix_latency']
    assert both['scale_factor'] < 0.1 * latency['scale_factor']


def test_without_heights_the_scale_is_given_and_the_pitch_is_refused():
    made = drives.drive(scenario='straight', duration=200.0, imu_grade='tactical', pitch=0.4 * DEG)
    flat = replace(made.leg(), fix=drives.changed(made.fix, height=lambda a: a * np.nan))
    result = calibrate(flat, drives.settings(made))
    e = result.methods['two_point'].estimates
    assert e['pitch_mounting_angle'].value is None
    assert Code.PITCH_NOT_DETERMINED in drives.reason_texts(result)
    assert abs(drives.errors_in_sigmas(result, made.truth)['scale_factor']) < 4
    # an unknown pitch adds half its square to the scale (152 ppm per degree), and an unknown
    # height above the ellipsoid is 800 m of the Earth's radius
    budget = result.methods['two_point'].details['budget']
    assert budget['height']['scale_factor'] / made.truth.scale == pytest.approx(1.254e-4, rel=0.01)
    assert e['scale_factor'].sigma / made.truth.scale > 5e-4


def test_deviation_of_fixes_is_stated_in_metres_with_both_causes():
    made = drives.drive(scenario='town', duration=300.0, imu_grade='tactical',
                        fix_noise='correlated')
    reason, = (r for r in drives.two_point(made.leg(), drives.settings(made)).reasons
               if r.code is Code.FIXES_NOISIER_THAN_SAID)
    assert reason.text.startswith('the fixes are 2.9 m (rms) from the dead-reckoned track')
    assert 'time-correlated fix errors, or gyro errors' in reason.text


def test_heights_that_give_a_pitch_beyond_the_limit_reject_the_method():
    made = drives.drive(scenario='straight', duration=200.0, imu_grade='tactical', pitch=20 * DEG)
    result = calibrate(made.leg(), drives.settings(made))
    why, = (r for r in result.methods['two_point'].reasons if r.code is Code.TRACK_MISMATCH)
    assert why.text == 'the heights of the marks give a pitch of +20 deg; the limit is 15 deg'


def test_closed_loop_is_refused_with_the_action():
    made = drives.drive(scenario='out_and_back', duration=300.0, imu_grade='industrial')
    result = calibrate(made.leg(), drives.settings(made))
    texts = drives.reason_texts(result)
    assert 'less than a fifth of the' in texts[Code.CHORD_TOO_SHORT]
    assert '--leg' in Code.CHORD_TOO_SHORT.remedy
    assert all(e.value is None for e in result.methods['two_point'].estimates.values())
    assert result.verdict.value == 'rejected'
    # the outward path alone is a leg
    t = drives.seconds(made.leg(), made.imu)
    stop = float(t[-1]) / 2 - 20.0
    part = replace(made.leg(), stop_ns=made.truth.start_ns + round(stop * 1e9))
    result = calibrate(part, drives.settings(made))
    assert abs(drives.errors_in_sigmas(result, made.truth)['scale_factor']) < 4


def test_track_that_loops_where_the_fixes_do_not_is_refused():
    made = drives.drive(scenario='straight', duration=200.0, imu_grade='tactical')
    spun = drives.changed(made.imu, w_i=lambda a: a + [0.0, 0.0, 0.5] * (
        drives.seconds(made.leg(), made.imu) > 5.0)[:, None])
    texts = drives.reason_texts(calibrate(replace(made.leg(), imu=spun), drives.settings(made)))
    assert 'dead-reckoned track' in texts[Code.CHORD_TOO_SHORT]


@pytest.mark.parametrize(('sigma', 'given'), [(0.05, False), (0.004, True)])
def test_heading_less_accurate_than_the_required_yaw_refuses_only_the_yaw(sigma, given):
    made = drives.drive(scenario='straight', duration=200.0, imu_grade='tactical')
    result = calibrate(made.leg(), drives.settings(made, heading_sigma=sigma,
                                                   verdict__max_yaw_sigma=0.0087))
    e = result.methods['two_point'].estimates
    assert (e['yaw_mounting_angle'].value is not None) == given
    assert (Code.YAW_NOT_SEPARABLE in drives.reason_texts(result)) != given
    assert e['scale_factor'].value == pytest.approx(made.truth.scale, rel=2e-3)


def test_course_is_not_used_as_the_heading_for_the_yaw():
    made = drives.drive(scenario='straight', duration=200.0, imu_grade='consumer')
    result = calibrate(made.leg(), drives.settings(made, heading_sigma=None))
    assert 'course' in drives.reason_texts(result)[Code.YAW_NOT_SEPARABLE]
    e = result.methods['two_point'].estimates
    assert e['yaw_mounting_angle'].value is None
    assert abs(drives.errors_in_sigmas(result, made.truth)['scale_factor']) < 4
    assert combine([result], drives.settings(made)).imu_rotation_xyzw is None


def test_mark_between_rare_fixes_uses_one_of_them():
    made = drives.drive(scenario='straight', duration=200.0, imu_grade='tactical', fix_rate=0.2)
    for every in (1, 3):
        few = take(made.fix, np.arange(len(made.fix.stamp_ns)) % every == 0)
        result = calibrate(replace(made.leg(), fix=few), drives.settings(made))
        assert all(abs(z) < 4 for z in drives.errors_in_sigmas(result, made.truth).values())
