# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""IMU orientation in the vehicle, an IMU that is moved during a leg, and short reversing."""

from dataclasses import replace
import re

import drives
from drives import drive, off, reason_texts, rejecting, settings, shifted, with_columns
import numpy as np
import pytest
from reversing_drives import made, there_and_back, three_point_turn, without_direction

from odocal_ros.nav.dead_reckoning import forward_b, mounting_from_forward
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import matrix_from_rpy, wrap
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code, Verdict
from odocal_ros.screening.imu_faults import forward_turn_reasons, gravity_turn_reasons
from odocal_ros.screening.imu_orientation import (
    accelerations,
    corrected_forward_axis,
    estimate_orientation,
    ImuOrientation,
    orientation_reasons,
)
from odocal_ros.screening.inputs import ImuRows
from odocal_ros.screening.reversing import reversed_starts, sections_slipped_twice
from odocal_ros.screening.screen import screen

pytestmark = pytest.mark.slow
DEG = np.pi / 180
TOWN = {'scenario': 'town', 'duration': 400.0, 'imu_grade': 'consumer', 'seed': 3}
# m/s and s at that speed: 3 m, 10 m and 72 m backwards
ROUTES = {'3 m': there_and_back(0.8, 0.0), '10 m': there_and_back(1.5, 3.0),
          '72 m': there_and_back(3.0, 20.0), 'three point turn': three_point_turn}
METRES = {'3 m': 3.2, '10 m': 10.5, '72 m': 72.0, 'three point turn': 71.2}
BACK_AT = {'3 m': 85.0, '10 m': 85.0, '72 m': 85.0, 'three point turn': 90.0}    # s in the bag


def town(yaw, **options):
    return drive(**{'scenario': 'town', 'duration': 200.0, 'imu_grade': 'consumer',
                    'yaw': yaw * DEG, 'seed': 3} | options)


def seen(made, leg=None, **scale):
    inputs, _ = screen(leg or made.leg(), settings(made))
    inputs = replace(inputs, w_b=inputs.w_b * scale.get('gyro', 1.0))
    return estimate_orientation(inputs, made.options.nominal_scale)


@pytest.mark.parametrize('yaw', [1.0, 40.0, 90.0, -170.0])
@pytest.mark.parametrize('options', [{}, {'slope': 0.08}, {'scenario': 'straight'}])
def test_imu_orientation_is_found_in_town_on_hills_and_on_a_straight_road(yaw, options):
    found = seen(town(yaw, **options))
    assert abs(wrap(found.yaw - yaw * DEG)) < 3 * found.sigma
    assert found.sigma < 3 * DEG


def test_a_gyro_with_the_wrong_sign_does_not_change_the_orientation():
    made = town(1.0)
    found = seen(made, gyro=-1.0)
    assert abs(wrap(found.yaw - 1.0 * DEG)) < 3 * found.sigma
    assert found.sigma < 3 * DEG


def test_imu_orientation_is_not_found_without_accelerations():
    made = town(1.0)
    rng = np.random.default_rng(1)
    for noise in (0.0, 3.0):        # m/s^2: zero, and far above accelerations of driving
        still = [0.0, 0.0, 9.81] + noise * rng.standard_normal(made.imu.f_i.shape)
        assert seen(made, with_columns(made.leg(), 'imu', f_i=(slice(None), still))) is None


def test_a_large_orientation_error_is_reported_with_side_and_size():
    assert orientation_reasons(None, np.nan) == ()
    for yaw in (0.0, 60.0, -60.0, 75.0):
        assert orientation_reasons(ImuOrientation(yaw * DEG, 1 * DEG), np.nan) == ()
    left, = orientation_reasons(ImuOrientation(-90 * DEG, 1 * DEG), np.nan)
    assert left.code is Code.IMU_AXES
    assert 'to the left in the IMU frame (yaw mounting -90 deg, ± 1)' in left.text
    right, = orientation_reasons(ImuOrientation(90 * DEG, 1 * DEG), np.nan)
    assert 'to the right' in right.text
    back, = orientation_reasons(ImuOrientation(-179 * DEG, 1 * DEG), np.nan)
    assert back.code is Code.ODOMETER_REVERSED
    # as configured
    assert orientation_reasons(ImuOrientation(-179 * DEG, 1 * DEG), np.pi) == ()
    # reported as observed, for any nominal value
    ahead, = orientation_reasons(ImuOrientation(0.0, 1 * DEG), np.pi)
    assert ahead.code is Code.ODOMETER_REVERSED
    assert 'forwards in the IMU frame (yaw mounting +0 deg, ± 1, nominal +180 deg)' in ahead.text
    ahead, = orientation_reasons(ImuOrientation(0.0, 1 * DEG), 90 * DEG)
    assert ahead.code is Code.IMU_AXES
    assert 'accelerations of the vehicle point forwards' in ahead.text


def test_only_a_large_error_of_the_forward_axis_is_corrected():
    f = 0.02 * forward_b(0.02, 0.01)
    assert corrected_forward_axis(None, f) is f
    assert corrected_forward_axis(ImuOrientation(5 * DEG, 1 * DEG), f) is f
    yaw, pitch = mounting_from_forward(
        corrected_forward_axis(ImuOrientation(40 * DEG, 1 * DEG), f))
    # the vertical component remains, and is divided by another cosine
    assert [yaw, np.sin(pitch) * np.cos(yaw)] == pytest.approx(
        [40 * DEG, f[2] / 0.02 * np.cos(40 * DEG) / np.cos(0.02)], rel=1e-9)


@pytest.mark.parametrize(('yaw', 'code'), [(90.0, Code.IMU_AXES), (-90.0, Code.IMU_AXES),
                                           (180.0, Code.ODOMETER_REVERSED)])
def test_a_leg_reports_the_orientation_and_no_slip(yaw, code):
    made = town(yaw)
    result = calibrate(made.leg(), settings(made, heading_sigma=None, method='auto'))
    assert code in {r.code for r in result.reasons}
    assert code in rejecting(result)
    assert Code.WHEEL_SLIP not in reason_texts(result)


def test_an_imu_with_a_configured_rotation_is_calibrated_without_slip():
    made = town(40.0)
    result = calibrate(made.leg(), settings(made, heading_sigma=None, method='auto'))
    texts = reason_texts(result)
    assert Code.WHEEL_SLIP not in texts
    assert Code.YAW_FAR_FROM_NOMINAL in texts
    assert off(result.methods['smoother'], made, 'yaw_mounting_angle') < 4
    # an IMU that points backwards and is configured so
    made = town(180.0)
    result = calibrate(made.leg(), settings(made, heading_sigma=None, method='auto',
                                            imu__nominal_yaw=np.pi))
    assert not {Code.WHEEL_SLIP, Code.ODOMETER_REVERSED} & set(reason_texts(result))
    yaw = result.methods['smoother'].estimates['yaw_mounting_angle']
    assert abs(wrap(yaw.value - np.pi)) < 4 * yaw.sigma


def test_a_whole_leg_driven_backwards_is_not_a_reversed_odometer():
    made = town(180.0)
    backwards = with_columns(made.leg(), 'odometer', value=lambda n: 20_000 - n)
    result = calibrate(backwards, settings(made, heading_sigma=None, method='auto'))
    assert Code.ODOMETER_REVERSED not in reason_texts(result)


def moved(made, rpy_deg, share=0.5):
    """Return the leg with the IMU rotated after a share of its rows."""
    C = matrix_from_rpy(np.multiply(rpy_deg, DEG))
    begin = int(share * len(made.imu.stamp_ns))

    def turn(x):
        return np.concatenate([x[:begin], x[begin:] @ C.T])
    return with_columns(made.leg(), 'imu', w_i=turn, f_i=turn)


@pytest.mark.parametrize('share', [0.3, 0.45, 0.7])
@pytest.mark.parametrize(('rpy_deg', 'text'), [
    ((180, 0, 0), 'gravity turns by 180 deg'), ((0, -90, 0), 'gravity turns by 90 deg'),
    ((0, 0, 90), 'the forward direction turns by +90 ± '),
    ((0, 0, -100), 'the forward direction turns by -100 ± ')])
def test_a_moved_imu_rejects_the_leg_with_the_time(rpy_deg, text, share):
    made = drive(**TOWN)
    leg = moved(made, rpy_deg, share)
    result = calibrate(leg, settings(made))
    assert rejecting(result) == {Code.IMU_AXES}
    reason_text = reason_texts(result)[Code.IMU_AXES]
    begin, end = (float(x) for x in reason_text.split('t = ')[1].split(' s:')[0].split(' to '))
    at = (leg.imu.stamp_ns[int(share * len(leg.imu.stamp_ns))] - leg.start_ns) * 1e-9
    angle = float(reason_text.split('turns by ')[1].split()[0])
    assert abs(angle - float(text.split('turns by ')[1].split()[0])) < 10.0
    assert reason_text.startswith(text.split(' by ')[0])
    tenth = (leg.stop_ns - leg.start_ns) * 1e-10
    assert begin - tenth < at < end + tenth


@pytest.mark.parametrize('options', [
    {}, {'slope': 0.08}, {'scenario': 'yard', 'seed': 4}, {'scenario': 'straight'},
    {'yaw': 170.0 * DEG}])
def test_slopes_and_turns_are_not_a_moved_imu(options):
    made = drive(**TOWN | options)
    inputs, _ = screen(made.leg(), settings(made))
    assert gravity_turn_reasons(inputs) == ()
    assert forward_turn_reasons(accelerations(inputs, made.options.nominal_scale)) == ()


def test_a_curve_of_one_g_is_not_a_moved_imu():
    made = drive(**TOWN)
    inputs, _ = screen(made.leg(), settings(made))
    force = inputs.f_b.copy()
    force[len(force) // 2:] += [0.0, 11.0, 0.0]
    assert gravity_turn_reasons(replace(inputs, f_b=force)) == ()


def reasons_of(leg, config):
    return {r.code: r.text for r in screen(leg, config)[1]}


@pytest.mark.parametrize('route', ROUTES)
@pytest.mark.parametrize('kind', [
    {}, {'two_wheels': True}, {'odometer': 'speed', 'speed_noise': 0.05},
    {'slope': 0.05, 'imu_grade': 'consumer'}, {'yaw': np.pi, 'imu_grade': 'consumer'}],
    ids=['counts', 'two wheels', 'speed', 'hills', 'IMU facing back'])
def test_a_counter_that_counts_up_in_reverse_is_found_at_the_stop(route, kind):
    drive_ = made(ROUTES[route], **kind)
    leg = drive_.leg()
    assert Code.REVERSING_UNSIGNED not in reasons_of(leg, settings(drive_))
    text = reasons_of(without_direction(leg), settings(drive_))[Code.REVERSING_UNSIGNED]
    times = '2 times' if route == 'three point turn' else '1 time'
    assert text.startswith(f'{times} the acceleration has the opposite sign')
    # distance: to 10 %, by the rough scale and the uncertainty of the ends
    metres = sum(float(m) for m in re.findall(r', ([\d.]+) m', text))
    assert metres == pytest.approx(METRES[route], rel=0.1, abs=0.5)
    # time: the stop before the section ends as in the route, within the detection of the stop
    at = float(text.split('t = ')[1].split(' s')[0])
    start = (drive_.truth.start_ns - drive_.options.start_ns) * 1e-9
    assert at + start == pytest.approx(BACK_AT[route], abs=2.0)


@pytest.mark.parametrize('route', ['10 m', 'three point turn'])
def test_corrected_reversing_gives_the_true_values_and_no_slip(route):
    drive_ = made(ROUTES[route], two_wheels=True)
    for config in (settings(drive_), settings(drive_, method='smoother', heading_sigma=None)):
        result = calibrate(without_direction(drive_.leg()), config)
        assert result.verdict is Verdict.CAUTION
        assert not rejecting(result)
        assert not {Code.WHEELS_SWAPPED, Code.WHEEL_SLIP} & set(reason_texts(result))
        errors = drives.errors_in_sigmas(result, drive_.truth)
        assert max(map(abs, errors.values())) < 3.5


def test_a_section_with_slip_of_twice_its_path_length_was_reversed():
    """The second of three sections of 10 s, up to 8 m/s and 40 m, has a slip of 76 m."""
    travel, *_ = starts([8.0, 8.0, 8.0])
    def slip(metres):
        return [{'t': 19.0, 'duration': 8.0, 'metres': metres}]
    ((begin, end),) = sections_slipped_twice(slip(76.0), travel, 1.0)
    assert (begin, end) == (pytest.approx(18.0, abs=1.5), pytest.approx(28.0, abs=1.5))
    # a wheel that spins on the spot
    assert len(sections_slipped_twice(slip(40.0), travel, 1.0)) == 0
    assert len(sections_slipped_twice([], travel, 1.0)) == 0
    back = travel.mirrored(np.array([[begin, end]]))
    # 3 runs of 40 m (sin^2 of 8 m/s for 10 s), of which one is driven back
    assert (travel.s[-1], back.s[-1]) == (pytest.approx(120.0, rel=1e-3),
                                          pytest.approx(40.0, rel=1e-3))


@pytest.mark.parametrize('route', ROUTES)
def test_signed_counters_give_the_true_values_with_reversing(route):
    drive_ = made(ROUTES[route])
    result = calibrate(drive_.leg(), settings(drive_))
    assert result.verdict is Verdict.ACCEPTED
    errors = drives.errors_in_sigmas(result, drive_.truth)
    assert len(errors) == 3
    assert max(map(abs, errors.values())) < 3.5      # 12 draws: p = 0.006 with a correct sigma


@pytest.mark.parametrize('seed', range(6))
@pytest.mark.parametrize('scenario', ['town', 'out_and_back'])
def test_forward_driving_is_not_detected_as_reversing(scenario, seed):
    clean = drive(scenario=scenario, seed=seed, slope=0.08, imu_grade='consumer', sway=0.05)
    assert Code.REVERSING_UNSIGNED not in reasons_of(clean.leg(), settings(clean))


def starts(speeds, nose=None, noise=0.0):
    """
    Return travel, IMU times, turn rates and forces of runs of 10 s with stops of 4 s between.

    speeds : peak of each, m/s.   nose : gravity along x by pitch of the body, as a share of the
    acceleration.
    """
    t = np.arange(0.0, 14.0 * len(speeds) + 4.0, 0.02)
    v, theta = np.zeros(len(t)), np.zeros(len(t))
    for k, top in enumerate(speeds):
        run = top * np.sin(np.pi * np.clip((t - 14.0 * k - 4.0) / 10.0, 0.0, 1.0))**2
        v += run
        theta += np.arcsin((nose[k] if nose else 0.0) * np.gradient(run, t) / 9.81)
    zero = np.zeros(len(t))
    rng = np.random.default_rng(1)
    f = np.gradient(v, t) + 9.81 * np.sin(theta) + noise * rng.standard_normal(len(t))
    s = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2 * 0.02)])
    return Travel(t, s, 0.0), ImuRows(t, np.stack([zero, -np.gradient(theta, t), zero], -1),
                                      np.stack([f, zero, 9.81 * np.cos(theta)], -1))


def test_pitch_of_the_body_and_gentle_starts_are_not_reversing():
    # gravity by the pitch subtracts twice the acceleration from the specific force
    travel, imu = starts([8.0, 1.0, 8.0], [0.0, -2.0, 0.0])
    assert not len(reversed_starts(travel, imu, 50.0))
    assert len(reversed_starts(travel, imu._replace(w_b=0 * imu.w_b), 50.0))    # without the gyro
    # 0.06 m/s^2 in 2 m/s^2 of white noise at 50 Hz: by chance half of 60 have the wrong sign
    assert not len(reversed_starts(*starts([12.0] + [0.2] * 60, noise=2.0), 1000.0))


def test_reversing_before_the_leg_has_no_effect():
    drive_ = made(ROUTES['10 m'])
    leg = without_direction(drive_.leg())
    late = shifted(leg, start=75.0)
    assert Code.REVERSING_UNSIGNED not in reasons_of(late, settings(drive_))
