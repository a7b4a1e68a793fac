# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Where the IMU faces, and an IMU that is moved in the vehicle during the leg."""

from dataclasses import replace

from drives import changed, drive, everything_said, rejecting, settings
import numpy as np
import pytest

from odocal_ros.nav.angles import wrap
from odocal_ros.nav.dead_reckoning import forward_b, mounting_from_forward
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.screening.facing import accelerations, axes_reasons, Facing, facing, toward
from odocal_ros.screening.moved_imu import turned_about, turned_over
from odocal_ros.screening.screen import screen

pytestmark = pytest.mark.slow
DEG = np.pi / 180
TOWN = {'scenario': 'town', 'duration': 400.0, 'imu_grade': 'consumer', 'seed': 3}


def town(yaw, **options):
    return drive(**{'scenario': 'town', 'duration': 200.0, 'imu_grade': 'consumer',
                    'yaw': yaw * DEG, 'seed': 3} | options)


def seen(made, leg=None, **scale):
    inputs, _ = screen(leg or made.leg(), settings(made))
    inputs = replace(inputs, w_b=inputs.w_b * scale.get('gyro', 1.0))
    return facing(inputs, made.options.nominal_scale)


@pytest.mark.parametrize('yaw', [1.0, 40.0, 90.0, -170.0])
@pytest.mark.parametrize('options', [{}, {'slope': 0.08}, {'scenario': 'straight'}])
def test_it_is_seen_in_town_on_hills_and_on_a_straight_road(yaw, options):
    found = seen(town(yaw, **options))
    assert abs(wrap(found.yaw - yaw * DEG)) < 3 * found.sigma
    assert found.sigma < 3 * DEG


def test_a_gyro_of_the_wrong_sign_does_not_turn_it():
    made = town(1.0)
    found = seen(made, gyro=-1.0)
    assert abs(wrap(found.yaw - 1.0 * DEG)) < 3 * found.sigma
    assert found.sigma < 3 * DEG


def test_nothing_is_seen_where_nothing_pushes():
    made = town(1.0)
    rng = np.random.default_rng(1)
    for noise in (0.0, 3.0):        # m/s^2: none at all, and far above what driving does
        leg = made.leg()
        still = np.tile([0.0, 0.0, 9.81], (len(leg.imu.stamp_ns), 1))
        still += noise * rng.standard_normal(still.shape)
        flat = replace(leg, imu=changed(leg.imu, f_i=lambda f, x=still: x))
        assert seen(made, flat) is None


def test_what_is_far_off_is_said_by_its_side_and_size():
    assert axes_reasons(None, np.nan) == ()
    for yaw in (0.0, 60.0, -60.0, 75.0):
        assert axes_reasons(Facing(yaw * DEG, 1 * DEG), np.nan) == ()
    left, = axes_reasons(Facing(-90 * DEG, 1 * DEG), np.nan)
    assert left.code is Code.IMU_AXES
    assert 'to the left in the IMU frame (yaw mounting -90 deg, ± 1)' in left.text
    right, = axes_reasons(Facing(90 * DEG, 1 * DEG), np.nan)
    assert 'to the right' in right.text
    back, = axes_reasons(Facing(-179 * DEG, 1 * DEG), np.nan)
    assert back.code is Code.ODOMETER_REVERSED
    assert axes_reasons(Facing(-179 * DEG, 1 * DEG), np.pi) == ()      # as the settings have it
    # said as it is seen, whatever the nominal
    ahead, = axes_reasons(Facing(0.0, 1 * DEG), np.pi)
    assert ahead.code is Code.ODOMETER_REVERSED
    assert 'forwards in the IMU frame (yaw mounting +0 deg, ± 1, nominal +180)' in ahead.text
    ahead, = axes_reasons(Facing(0.0, 1 * DEG), 90 * DEG)
    assert ahead.code is Code.IMU_AXES
    assert 'accelerations point forwards' in ahead.text


def test_only_a_far_forward_axis_is_turned():
    f = 0.02 * forward_b(0.02, 0.01)
    assert toward(None, f) is f
    assert toward(Facing(5 * DEG, 1 * DEG), f) is f
    yaw, pitch = mounting_from_forward(toward(Facing(40 * DEG, 1 * DEG), f))
    # the vertical share stays, and is divided by another cosine
    assert [yaw, np.sin(pitch) * np.cos(yaw)] == pytest.approx(
        [40 * DEG, f[2] / 0.02 * np.cos(40 * DEG) / np.cos(0.02)], rel=1e-9)


@pytest.mark.parametrize(('yaw', 'code'), [(90.0, Code.IMU_AXES), (-90.0, Code.IMU_AXES),
                                           (180.0, Code.ODOMETER_REVERSED)])
def test_a_leg_says_so_and_knows_of_no_slip(yaw, code):
    made = town(yaw)
    result = calibrate(made.leg(), settings(made, heading_sigma=None, method='auto'))
    assert code in {r.code for r in result.reasons}
    assert code in rejecting(result)
    assert Code.WHEEL_SLIP not in everything_said(result)


def test_an_imu_turned_on_purpose_is_calibrated_and_no_wheel_slips():
    made = town(40.0)
    result = calibrate(made.leg(), settings(made, heading_sigma=None, method='auto'))
    said = everything_said(result)
    assert Code.WHEEL_SLIP not in said
    assert Code.YAW_FAR_FROM_NOMINAL in said
    yaw = result.methods['smoother'].estimates['yaw_mounting_angle']
    assert abs(yaw.value - made.truth.yaw) < 4 * yaw.sigma
    # an IMU that faces backwards, and is said to
    made = town(180.0)
    result = calibrate(made.leg(), settings(made, heading_sigma=None, method='auto',
                                            imu__nominal_yaw=np.pi))
    assert not {Code.WHEEL_SLIP, Code.ODOMETER_REVERSED} & set(everything_said(result))
    yaw = result.methods['smoother'].estimates['yaw_mounting_angle']
    assert abs(wrap(yaw.value - np.pi)) < 4 * yaw.sigma


def test_driven_backwards_all_along_by_a_counter_that_counts_down():
    """The counter of a vehicle that reverses, IMU turned half: it is pushed as the counts say."""
    made = town(180.0)
    leg = made.leg()
    backwards = replace(leg, odometer=changed(leg.odometer, value=lambda n: 20_000 - n))
    result = calibrate(backwards, settings(made, heading_sigma=None, method='auto'))
    assert Code.ODOMETER_REVERSED not in everything_said(result)


def moved(made, rpy_deg, share=0.5):
    """Return the leg with the IMU turned from a share of its rows on."""
    C = matrix_from_rpy(np.multiply(rpy_deg, DEG))
    begin = int(share * len(made.imu.stamp_ns))

    def turn(x):
        return np.concatenate([x[:begin], x[begin:] @ C.T])
    return replace(made.leg(), imu=changed(made.imu, w_i=turn, f_i=turn))


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
    said = everything_said(result)[Code.IMU_AXES]
    begin, end = (float(x) for x in said.split('t = ')[1].split(' s:')[0].split(' to '))
    at = (leg.imu.stamp_ns[int(share * len(leg.imu.stamp_ns))] - leg.start_ns) * 1e-9
    angle = float(said.split('turns by ')[1].split()[0])
    assert abs(angle - float(text.split('turns by ')[1].split()[0])) < 10.0
    assert said.startswith(text.split(' by ')[0])
    tenth = (leg.stop_ns - leg.start_ns) * 1e-10
    assert begin - tenth < at < end + tenth


@pytest.mark.parametrize('options', [
    {}, {'slope': 0.08}, {'scenario': 'yard', 'seed': 4}, {'scenario': 'straight'},
    {'yaw': 170.0 * DEG}])
def test_slopes_and_turns_move_no_imu(options):
    made = drive(**TOWN | options)
    inputs, _ = screen(made.leg(), settings(made))
    assert turned_over(inputs) == ()
    assert turned_about(accelerations(inputs, made.options.nominal_scale)) == ()


def test_a_bend_of_one_g_moves_no_imu():
    made = drive(**TOWN)
    inputs, _ = screen(made.leg(), settings(made))
    force = inputs.f_b.copy()
    force[len(force) // 2:] += [0.0, 11.0, 0.0]
    assert turned_over(replace(inputs, f_b=force)) == ()
