# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Systematic IMU errors are estimated from the drive and included in the sigma."""

from dataclasses import replace
import re

from drives import ANGLES, configured, off, settings
import numpy as np
import pytest
from smoother_legs import leg_of, made, reason_texts

from odocal_ros.estimator import smooth
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.result import remarks
from odocal_ros.estimator.state import CONSTANTS, FAST_SPEED
from odocal_ros.nav.rotations import matrix_from_rpy, rotate, transpose
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.settings.nominal import GRADES, TURN_ON, with_grade_by_noise
from odocal_ros.sim.draw import draw_vehicle
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.scenarios import simulate

pytestmark = pytest.mark.slow
TOWN = {'scenario': 'town', 'duration': 250.0, 'imu_grade': 'industrial', 'sway': 0.05}


def of_grade(config, *names):
    return with_settings(config, {f'imu.{name}_sigma': np.nan for name in names})


@pytest.mark.parametrize(('grade', 'noise', 'seconds', 'error', 'size'), [
    # errors of the grade, ten times as large as such fixes determine
    ('tactical', 'rtk', 250.0, 5e-4, 5e-4),
    # a quarter of the grade's error, not determined by correlated fixes: common size of the axes
    ('consumer', 'correlated', 200.0, 0.01 / 4, 0.01)])
def test_accelerometer_scale_error_is_within_its_sigma(grade, noise, seconds, error, size):
    drive, config, leg = made(scenario='town', duration=seconds, imu_grade=grade,
                              fix_noise=noise, accel_scale_error=error, seed=4)
    result = smooth(leg, of_grade(config, 'accel_scale'))
    assert off(result, drive) < 3.0
    for name in ('accelerometer_scale_x', 'accelerometer_scale_y'):
        found = result.details[name]
        assert abs(found['value'] - error) < 3.0 * found['sigma']
        assert found['sigma'] < size / 2
        # reported relative to the grade, for any size
        assert result.details['posterior_to_prior'][name] == pytest.approx(
            found['sigma'] / size, rel=0.01)


@pytest.mark.parametrize('hertz', [0.3, 0.5, 0.7, 1.0])
def test_body_sway_on_a_flat_path_does_not_change_the_scale(hertz):
    """Sway of 3 deg, as of an agricultural robot: the path along its axis is 700 ppm shorter."""
    drive = simulate(SimOptions(scenario='out_and_back', duration=300.0, imu_rate=100.0, seed=4,
                                imu_grade='industrial', fix_noise='rtk'))
    imu = drive.imu
    t = (imu.stamp_ns - imu.stamp_ns[0]) * 1e-9
    sent = drive.leg()
    grows = np.convolve(drive.motion.speed(t) > 1.0, np.ones(200) / 200, 'same')
    angle = np.radians(3.0) * np.sin(2 * np.pi * hertz * t) * grows
    C_bi = matrix_from_rpy(np.stack([0 * t, angle, 0 * t], -1))     # about the y axis of the IMU
    w_i = rotate(transpose(C_bi), imu.w_i)
    w_i[:, 1] += np.gradient(angle, t)
    swaying = replace(sent, imu=replace(imu, w_i=w_i, f_i=rotate(transpose(C_bi), imu.f_i)))
    config = settings(drive, None)
    scale = smooth(leg_of(swaying, config), config).estimates['scale_factor']
    assert abs(scale.value - drive.truth.scale) < 3.0 * scale.sigma
    assert scale.sigma < 7e-4 * drive.truth.scale


@pytest.mark.parametrize('hertz', [0.4, 0.6])
def test_body_bounce_on_a_flat_path_does_not_change_the_scale(hertz):
    """Bounce of 20 cm at 10 m/s, as 2 cm at a walk: the IMU path is 400 ppm longer."""
    drive = simulate(SimOptions(scenario='out_and_back', duration=300.0, imu_rate=100.0, seed=4,
                                imu_grade='industrial', fix_noise='rtk'))
    imu, sent = drive.imu, drive.leg()
    first = imu.stamp_ns[0]
    t, t_fix = ((topic.stamp_ns - first) * 1e-9 for topic in (imu, sent.fix))
    grows = np.convolve(drive.motion.speed(t) > 3.0, np.ones(200) / 200, 'same')
    height = 0.2 * np.sin(2 * np.pi * hertz * t) * grows
    f_i = imu.f_i + np.gradient(np.gradient(height, t), t)[:, None] * [0.0, 0.0, 1.0]
    bouncing = replace(sent, imu=replace(imu, f_i=f_i), fix=replace(
        sent.fix, height=sent.fix.height + np.interp(t_fix, t, height)))
    config = settings(drive, None)
    scale = smooth(leg_of(bouncing, config), config).estimates['scale_factor']
    assert abs(scale.value - drive.truth.scale) < 3.0 * scale.sigma
    assert scale.sigma < 3e-5 * drive.truth.scale


SKEW = np.deg2rad(0.5)
# gyro: z into x; accelerometer: x into y and x into z
GYRO = (0.0, 0.0, SKEW, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
ACCEL = (0.0, 0.0, 0.0, SKEW, 0.0, 0.0, SKEW, 0.0, 0.0)


def test_mounting_angles_refer_to_the_measuring_axes_of_the_imu():
    drive, config, leg = made(scenario='town', duration=250.0, imu_grade='consumer', seed=4,
                              fix_noise='rtk', yaw=0.02, pitch=0.01,
                              real=RealEffects(gyro_matrix=GYRO, accel_matrix=ACCEL))
    truth, found = drive.truth, smooth(leg, of_grade(config, 'misalignment'))
    assert abs(truth.yaw - truth.yaw_housing) == pytest.approx(SKEW, rel=0.05)
    for name, true, housing in (('yaw', truth.yaw, truth.yaw_housing),
                                ('pitch', truth.pitch, truth.pitch_housing)):
        e = found.estimates[f'{name}_mounting_angle']
        assert abs(e.value - true) < 3.0 * e.sigma
        assert abs(e.value - housing) > 5.0 * e.sigma        # sigma 20 to 50 mdeg, error 500
        beside = found.details['beside'][f'{name}_mounting_angle_housing_sigma']['value']
        assert abs(e.value - housing) < 3.0 * beside
    # a fit without misaligned axes is wrong
    assert off(smooth(leg, config), drive, *ANGLES) > 5.0


@pytest.mark.parametrize('skew', [SKEW, 0.0])
def test_yaw_sigma_includes_the_misalignment_of_y_and_z_with_a_pitched_imu(skew):
    # with a pitched IMU, z measures a part of the forward acceleration and y a part of z; the
    # other two axes determine whether axes are misaligned
    drive, config, leg = made(scenario='town', duration=300.0, imu_grade='consumer', seed=4,
                              fix_noise='rtk', yaw=0.02, pitch=0.12,
                              real=RealEffects(accel_matrix=(0.0, 0.0, 0.0, skew, 0.0, skew,
                                                             skew, 0.0, 0.0)))
    found = smooth(leg, of_grade(config, 'misalignment'))
    e = found.estimates['yaw_mounting_angle']
    assert abs(e.value - drive.truth.yaw) < 1.96 * e.sigma     # 61 of 52 mdeg, no skew: 6 of 31
    # with skew the size is that of the other axes; without skew two fifths of the usual sigma,
    # sqrt(2) times that of an axis; the yaw sigma includes it
    held = found.details['accelerometer_axis_yz']['sigma']
    usual = np.sqrt(2) * GRADES['consumer'].misalignment_sigma
    # seeds 4 to 7 have 0.65 to 0.69, and 0.38 to 0.43 without skew (sizes are means): the limits
    # are their means plus three times their scatter
    assert 0.15 * usual < held < (0.72 if skew else 0.46) * usual
    assert e.sigma > 0.9 * 0.12 * held
    if skew:    # a fit without misaligned axes is wrong
        assert off(smooth(leg, config), drive, 'yaw_mounting_angle') > 3.0


def test_straight_drive_does_not_pull_the_yaw_to_zero():
    # derivatives by the measured force with its noise give 0.15 +- 0.22 deg; the truth is 1.7
    drive, config, leg = made(scenario='straight', duration=400.0, imu_grade='consumer', seed=4,
                              yaw=np.deg2rad(1.7))
    found = smooth(leg, of_grade(config, 'accel_scale', 'misalignment'))
    assert off(found, drive, 'yaw_mounting_angle') < 3.0
    assert abs(found.details['accelerometer_scale_y']['value']) < 0.005     # not observable


@pytest.mark.parametrize(('changes', 'accel'), [
    ({'imu.grade': 'consumer'}, TURN_ON['consumer'][1]),
    ({'imu.grade': 'industrial'}, TURN_ON['consumer'][1]), ({'imu.accel_bias': 0.04}, 0.04)])
def test_imu_has_the_turn_on_bias_of_its_grade(changes, accel):
    """Otherwise a bias looks like a misaligned axis: docs/decisions/0016."""
    _, config, leg = made(imu_grade='consumer', duration=135.0)
    priors = make_problem(leg, with_settings(config, changes)).priors
    assert priors.accel_bias_sigma[:2] == pytest.approx(accel)
    assert priors.gyro_bias_sigma == pytest.approx(TURN_ON['consumer'][0])


def test_imu_gets_the_grade_nearest_to_its_noise_but_not_a_better_one():
    imu = Config().imu
    grade = GRADES['tactical']
    tactical = {'gyro': grade.gyro_noise**2, 'accel': grade.accel_noise**2}
    vibrating = {name: 100.0 * value for name, value in tactical.items()}
    for given, noise, seen in (
            ('navigation', tactical, 'tactical'), ('tactical', tactical, 'tactical'),
            ('consumer', tactical, 'consumer'), ('tactical', vibrating, 'consumer'),
            ('navigation', {}, 'navigation')):
        assert with_grade_by_noise(replace(imu, grade=given), noise).grade == seen


@pytest.mark.parametrize(('set_to', 'found', 'ratio', 'text', 'do'), [
    ((0.0, 0.0, 1.5), 0.7, 0.1, 'z: set to +1.50 m, estimated +2.20 ± 0.05 m. The other values',
     r'Measure .* \(z\) again'),
    ((0.0, 0.0, 0.0), -0.73, 0.1, 'z: not set, estimated -0.73 ± 0.05 m. The other values',
     r'Measure .* \(z\) and set it'),
    # result and report have no value for it
    ((0.0, 0.0, 0.0), -0.73, 0.5, 'z: not set, estimated -0.73 ± 0.05 m (too uncertain for a '
     'result). The other', r'Measure .* \(z\) and set it'),
    ((0.0, 0.0, 0.0), 9.39, 0.1, 'z: +9.39 ± 0.05 m is larger than a vehicle, so not plausible',
     'Ignore the estimate')])
def test_configured_lever_arm_only_is_to_be_measured_again(set_to, found, ratio, text, do):
    value, sigma = np.zeros(len(CONSTANTS)), np.full(len(CONSTANTS), 0.05)
    value[CONSTANTS.index('antenna_lever_arm_z')] = found
    reason, = remarks._lever_arm_reasons(value, sigma, np.full(len(CONSTANTS), ratio),
                                         with_settings(Config(), {'gnss.lever_arm': set_to}))
    assert f'gnss.lever_arm {text}' in reason.text
    remedy = reason.special_remedy
    assert re.search(do, remedy)
    assert ('easure' in remedy) != ('larger' in text)
    for cause in 'Body roll on soft springs', 'mast that bends':
        assert (cause in remedy) == ('easure' in remedy)
    assert 'Slip in turns' not in remedy


@pytest.mark.parametrize(('imu_arm', 'part'), [
    ((0.0, 0.0, 0.0), 'imu.lever_arm that is not set'),
    ((1.0, 0.0, 0.0), 'A wrong imu.lever_arm')])
def test_imu_lever_arm_is_named_as_the_other_cause(imu_arm, part):
    value, sigma = np.zeros(len(CONSTANTS)), np.full(len(CONSTANTS), 0.05)
    value[[CONSTANTS.index(f'odometer_lever_arm_{axis}') for axis in 'xy']] = 1.0
    reason, = remarks._lever_arm_reasons(value, sigma, np.zeros(len(CONSTANTS)), with_settings(
        Config(), {'imu.lever_arm': imu_arm}))
    assert 'odometer.lever_arm x: not set, estimated +1.00' in reason.text
    assert reason.remedy.startswith('Measure odometer.lever_arm (x, y) and set it. Axes: ')
    assert part in reason.remedy
    assert 'Slip in turns' in reason.remedy
    assert 'On z' not in reason.remedy


def test_wrong_lever_arm_is_not_unobservable_but_a_delay_without_a_value_is():
    usual = {'scenario': 'town', 'duration': 300.0, 'imu_grade': 'consumer', 'seed': 4}
    _, config, leg = made(**usual, antenna_lever_arm=(1.5, 0.0, 1.0))
    config = with_settings(config, {'gnss.lever_arm': (0.0, 0.0, 1.0),
                                    'gnss.lever_arm_sigma': 0.1})
    found = smooth(replace(leg, antenna_arm=np.array([0.0, 0.0, 1.0])), config)
    texts = reason_texts(found)
    assert 'gnss.lever_arm x: set to +0.00 m, estimated +1.' in texts[Code.LEVER_ARM_OFF]
    # the sigma of this axis is not below that of its setting, but the value is far from it
    arm = found.estimates['antenna_lever_arm_x']
    assert arm.sigma > 0.1 / 2
    assert abs(arm.value - 1.5) < 4 * arm.sigma
    assert 'the antenna lever arm (left, up)' in texts[Code.PARAMETER_NOT_DETERMINED]

    _, config, leg = made(**usual)
    found = smooth(leg, with_settings(config, {'odometer.time_sigma': 2e-3}))
    assert found.details['posterior_to_prior']['odometer_delay'] > 0.5
    assert found.estimates['odometer_delay'].value is None
    assert 'odometer delay' in reason_texts(found)[Code.PARAMETER_NOT_DETERMINED]


def test_vehicle_effects_beside_the_values_are_reported():
    real = RealEffects(receiver_lag=0.8, speed_law=0.006, stated_sigma_ratio=0.5)
    drive, config, leg = made(scenario='town', duration=250.0, imu_grade='industrial', seed=4,
                              fix_noise='rtk', real=real, antenna_lever_arm=(0.8, 0.0, 1.0))
    moved = with_settings(config, {'gnss.lever_arm': (0.0, 0.0, 1.0)})
    leg = replace(leg, antenna_arm=np.array([0.0, 0.0, 1.0]))
    found = smooth(leg, moved)
    texts = reason_texts(found)
    tau = float(re.search(r'about (.*) s;', texts[Code.FIXES_SMOOTHED])[1])
    assert tau == pytest.approx(real.receiver_lag, rel=0.02)     # printed to 0.01 s
    assert 'gnss.lever_arm x: set to +0.00 m, estimated +0.8' in texts[Code.LEVER_ARM_OFF]
    assert ' 2.0 times as large' in texts[Code.FIXES_NOISIER_THAN_SAID]
    assert 'from low to high speed' in texts[Code.SCALE_VARIES]
    slope = found.details['beside']['scale_by_speed']
    true = 2 * real.speed_law / 36.0**2 * FAST_SPEED
    assert abs(slope['slope'] - true) < 3.0 * slope['sigma']
    assert off(found, drive) < 3.0
    assert 'warm tyres' in next(r for r in found.reasons if r.code is Code.SCALE_VARIES).remedy
    # a vehicle without these effects has no such reasons
    clean = reason_texts(smooth(made(**TOWN, fix_noise='rtk', seed=4)[2], config))
    assert not {Code.FIXES_SMOOTHED, Code.FIXES_NOISIER_THAN_SAID, Code.LEVER_ARM_OFF,
                Code.SCALE_VARIES, Code.IMU_AXES_SKEW} & set(clean)


def test_slow_drive_converges_to_the_correct_scale():
    """A yard with all errors of real sensors: with noise in derivatives the scale shrinks."""
    options, _ = draw_vehicle(70_000_024, 'yard', 'consumer', None)
    drive = simulate(options)
    config = configured(drive)
    assert off(smooth(leg_of(drive.leg(), config), config), drive) < 3.3
