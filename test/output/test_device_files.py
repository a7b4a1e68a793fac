# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files for drive controllers and devices, and noise files, with the names of these systems."""

from dataclasses import replace
from math import tau
import re

from calibration_parts import texts, with_estimates
from drives import drive, settings
import foreign_keys
import numpy as np
import pytest
import yaml

from odocal_ros.calib.result import Estimate
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.pipeline.combination import combine

TWIST, IMU = 'wheel_odometry_covariance.yaml', 'imu_errors.yaml'


def controllers(calibration, **settings):
    written = yaml.safe_load(texts(calibration, **settings)['ros2_controllers.yaml'])
    return {name: block['ros__parameters'] for name, block in written.items()}


def wheels(good):
    return with_estimates(good, scale_factor_left=Estimate(0.0408, 1e-6, 'm/pulse'),
                          scale_factor_right=Estimate(0.0412, 1e-6, 'm/pulse'),
                          track_width=Estimate(1.53, 1e-3, 'm'))


def test_every_key_exists_in_its_target_system(good):
    bias = {f'gyro_bias_{a}': Estimate(0.1, 1e-5, 'rad/s') for a in 'xyz'}
    whole = with_estimates(wheels(good), **bias)
    options = {'wheels__pulses_per_revolution': 40.0, 'odometer__track_width': 1.5,
               'odometer__nominal_scale': 0.04}
    written = texts(whole, **options)
    for name, keys in (('vehicle_velocity_converter', foreign_keys.AUTOWARE_VELOCITY),
                       ('imu_corrector', foreign_keys.AUTOWARE_IMU)):
        found = yaml.safe_load(written[f'{name}.param.yaml'])['/**']['ros__parameters']
        assert set(found) == keys
    found = controllers(whole, **options)
    assert {name: set(block) for name, block in found.items()} == foreign_keys.ROS2_CONTROLLERS
    assert all(isinstance(v, float) for block in found.values() for v in block.values())
    lines = written['wheel_input.txt'].splitlines()
    for system, begin in foreign_keys.DEVICES.items():
        above = [i for i, line in enumerate(lines) if line.startswith(f'# {system}')]
        assert len(above) == 1, system
        following = next(line for line in lines[above[0]:] if not line.startswith('#'))
        assert following.startswith(begin)
    assert foreign_keys.UBLOX_FACTOR_ID in written['wheel_input.txt']


def test_every_file_names_its_target_system(good):
    written = texts(good, wheels__pulses_per_revolution=40.0)
    for name, word in (('calibration.yaml', '# for the node calibrator'),
                       ('vehicle_velocity_converter.param.yaml', '# for autoware vehicle_vel'),
                       ('ros2_controllers.yaml', '# for ros2_controllers'),
                       ('wheel_input.txt', '# for receivers'), ('imu_transform.urdf', 'URDF'),
                       ('imu_transform.launch.xml', 'launch file'),
                       ('imu_transform.txt', 'TF')):
        assert word in written[name], name


def test_devices_get_the_wheel_in_their_units(good):
    # 0.05 m per pulse: 50 000 um, 20 pulses per metre; 40 pulses per turn: 2 m circumference
    lines = texts(good, wheels__pulses_per_revolution=40.0)['wheel_input.txt'].splitlines()
    assert [line for line in lines if line and not line.startswith('#')] == [
        'CFG-SFODO-FACTOR = 50000', 'gain: 20.0', 'Pulses per metre = 20',
        'SETWHEELPARAMETERS 40 2 0.05', 'WENC_RADIUS 0.3183099']      # 2 m / (2 pi)
    assert '10 ppm' in ' '.join(lines)                         # 0.5 um of 50 000
    assert '# one pulse: 50000.0 ± 1.2 um; 20.00000 ± 0.00048 pulses/m' in lines
    assert all(len(line) <= 99 for line in lines[3:])


@pytest.mark.parametrize('pulses', [0.0, 40.5])
def test_systems_that_count_turns_are_omitted_without_whole_ticks_per_turn(good, pulses):
    text = texts(good, wheels__pulses_per_revolution=pulses)['wheel_input.txt']
    assert 'SETWHEELPARAMETERS' not in text
    assert 'WENC_RADIUS' not in text
    assert 'wheels.pulses_per_revolution' in text


def test_each_wheel_has_a_multiplier_and_a_configured_track_width_has_none(good):
    found = controllers(good)
    assert found == {'diff_drive_controller': {'left_wheel_radius_multiplier': 1.25,
                                               'right_wheel_radius_multiplier': 1.25}}
    found = controllers(wheels(good), odometer__nominal_scale=0.04, odometer__track_width=1.5)
    assert found['diff_drive_controller'] == pytest.approx({
        'left_wheel_radius_multiplier': 1.02, 'right_wheel_radius_multiplier': 1.03,
        'wheel_separation_multiplier': 1.02})
    reported = with_estimates(wheels(good), track_width=Estimate(1.5, None, 'm'))
    found = controllers(reported, odometer__nominal_scale=0.04, odometer__track_width=1.5)
    assert 'wheel_separation_multiplier' not in found['diff_drive_controller']


@pytest.mark.parametrize(('unit', 'settings', 'radius'), [
    ('m/rad', {}, 0.05), ('m/pulse', {'wheels__pulses_per_revolution': 40.0}, 2 / tau),
    ('1', {'wheels__radius': 0.3}, 0.015)])
def test_the_radius_follows_from_the_scale_factor(good, unit, settings, radius):
    found = controllers(with_estimates(good, scale_factor=Estimate(0.05, 1e-6, unit)), **settings)
    for name, keys in foreign_keys.ROS2_CONTROLLERS.items():
        if name != 'diff_drive_controller':
            assert found[name] == pytest.approx(dict.fromkeys(keys, radius))


def test_undetermined_values_and_noise_are_not_written(good):
    lost = {n: Estimate(None, None, 'm/pulse') for n in ('scale_factor', 'scale_ratio')}
    written = texts(with_estimates(good, **lost))
    assert {'wheel_input.txt', 'ros2_controllers.yaml'}.isdisjoint(written)
    by_angle = with_estimates(good, scale_factor=Estimate(0.05, 1e-6, 'm/rad'))
    assert 'wheel_input.txt' not in texts(by_angle)
    assert not {TWIST, IMU} & texts(good).keys()


def blocks(text):
    return {name: block['ros__parameters'] for name, block in yaml.safe_load(text).items()}


def test_the_covariance_of_two_wheels_agrees_with_the_closed_form(smoothed):
    """Two readings per interval, a walk, sigmas of scale and width; the drive turns on average."""
    found = blocks(texts(smoothed)[TWIST])['diff_drive_controller']
    assert list(found) == [foreign_keys.TWIST_COVARIANCE]
    x, y, z, roll, pitch, yaw = found[foreign_keys.TWIST_COVARIANCE]
    T, v, w, reading = 0.1, 8.0, 0.06, (0.05 * 0.25 / 0.1)**2
    assert x == pytest.approx(2 * reading + (0.75 * 0.003**2 + 0.25 * 0.004**2) / T
                              + (v * 1.2e-6 / 0.05)**2, rel=0.01)
    assert y == pytest.approx(0.005**2 / T, rel=0.01)
    assert z == pytest.approx(0.002**2 / T, rel=0.01)
    assert yaw == pytest.approx((8 * reading + 4 * 0.003**2 / T + (1e-3 * w)**2
                                 + (2e-6 * v)**2) / 1.6**2, rel=0.01)
    assert roll == pitch == 1e6


def with_details(smoothed, **changed):
    leg = smoothed.legs[0]
    method = leg.methods['smoother']
    method = replace(method, details=method.details | changed)
    return replace(smoothed, legs=(replace(leg, methods={'smoother': method}),))


def test_the_table_depends_on_speed_and_turn_rate(smoothed):
    sliding = with_details(smoothed, sideslip={'value': 0.003, 'sigma': 0.0})
    table = blocks(texts(sliding)[TWIST])['wheel_odometry_covariance']
    assert table['period'] == 0.1
    speeds, last = np.array(table['speed']), table['turn_rate_3']
    assert (speeds[0], speeds[-1], last['rad_per_s']) == (0.0, 14.0, 0.3)
    slid = np.array(last['y']) - np.array(last['y'])[1]
    # sideways speed of the drift: angle per force, times force, times speed
    expected = (0.003 * speeds**2 * 0.3)**2
    assert slid[-1] == pytest.approx(expected[-1] - expected[1], rel=0.02)


def test_the_covariance_of_a_coarse_speed_depends_only_on_its_step(smoothed):
    """The fit does not use the integral of such a speed: its travel noise is not estimated."""
    details = smoothed.legs[0].methods['smoother'].details
    coarse = with_details(
        smoothed, noise=details['noise'] | {'steps': 1.2, 'along_hard': 1.0},
        odometer=details['odometer'] | {'reading': 0.0, 'speed_step': 5.0})
    x = blocks(texts(coarse)[TWIST])['diff_drive_controller'][foreign_keys.TWIST_COVARIANCE][0]
    assert x == pytest.approx((0.05 * 5)**2 / 12 * 1.2**2, rel=0.01)


def test_one_wheel_gives_no_turn_rate_and_estimators_get_a_density(smoothed):
    estimates = {name: e for name, e in smoothed.estimates.items() if name != 'track_width'}
    text = texts(replace(smoothed, estimates=estimates))[TWIST]
    assert blocks(text)['diff_drive_controller'][foreign_keys.TWIST_COVARIANCE][5] == 1e6
    assert 'yaw' not in blocks(text)['wheel_odometry_covariance']['turn_rate_0']
    assert 'use a gyro' in text
    text = texts(smoothed)[TWIST]
    density = float(re.search(rf'{foreign_keys.WHEEL_INERTIAL}: (\S+)', text)[1])
    x = blocks(text)['diff_drive_controller'][foreign_keys.TWIST_COVARIANCE][0]
    assert density == pytest.approx(np.sqrt(x * 0.1), rel=0.01)


def test_only_imu_errors_that_the_drive_determined_are_written(smoothed):
    found = blocks(texts(smoothed)[IMU])['imu_errors']
    assert set(found) == {'gyro_scale_z', 'accelerometer_bias_x', *(
        f'gyro_bias_{axis}' for axis in 'xyz')}
    assert found['gyro_scale_z'] == {'value': 0.002, 'sigma': 1e-4}


@pytest.mark.slow
def test_the_scale_error_of_a_gyro_is_found_with_its_sign():
    made = drive(scenario='town', duration=500.0, seed=4, imu_grade='industrial', fix_noise='rtk',
                 gyro_scale_error=0.01)
    config = settings(made, heading_sigma=None, method='smoother')
    result = combine([calibrate(made.leg(), config)], config)
    one = blocks(texts(result)[IMU])['imu_errors']['gyro_scale_z']
    # true rate = reading - scale * reading
    assert abs(one['value'] - 0.01 / 1.01) < 4 * one['sigma'] < 0.004
