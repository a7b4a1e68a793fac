# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Files of noises: the covariance of the wheel twist in closed form, and the errors of the IMU."""

from dataclasses import replace
import re

from drives import drive, settings
import foreign_keys
import numpy as np
import pytest
import yaml

from odocal_ros.output import ros_files
from odocal_ros.output.files import as_json
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.pipeline.combination import combine
from odocal_ros.settings.config import Config

TWIST, IMU = 'wheel_odometry_covariance.yaml', 'imu_errors.yaml'


def written(calibration):
    config = Config()
    return ros_files.texts(calibration, config, as_json(calibration, config, [],
                                                        '2026-01-02T03:04:05+00:00'))


def blocks(text):
    return {name: block['ros__parameters'] for name, block in yaml.safe_load(text).items()}


def test_the_covariance_of_two_wheels_in_closed_form(smoothed):
    """Two readings per interval, a walk, sigmas of scale and width; the drive turns on average."""
    found = blocks(written(smoothed)[TWIST])['diff_drive_controller']
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


def test_the_table_by_speed_and_turn_rate(smoothed):
    leg = smoothed.legs[0]
    details = leg.methods['smoother'].details | {'sideslip': {'value': 0.003, 'sigma': 0.0}}
    method = replace(leg.methods['smoother'], details=details)
    table = blocks(written(replace(smoothed, legs=(replace(leg, methods={
        'smoother': method}),)))[TWIST])['wheel_odometry_covariance']
    assert table['period'] == 0.1
    speeds, last = np.array(table['speed']), table['turn_rate_3']
    assert (speeds[0], speeds[-1], last['rad_per_s']) == (0.0, 14.0, 0.3)
    slid = np.array(last['y']) - np.array(last['y'])[1]
    # sideways speed of the drift: angle per force, times force, times speed
    expected = (0.003 * speeds**2 * 0.3)**2
    assert slid[-1] == pytest.approx(expected[-1] - expected[1], rel=0.02)


def test_of_a_speed_in_coarse_steps_only_the_grid_counts(smoothed):
    """The fit does not use the integral of such a speed: its travel noise is not estimated."""
    leg = smoothed.legs[0]
    details = leg.methods['smoother'].details
    details = details | {'noise': details['noise'] | {'steps': 1.2, 'along_hard': 1.0},
                         'odometer': details['odometer'] | {'reading': 0.0, 'speed_step': 5.0}}
    method = replace(leg.methods['smoother'], details=details)
    text = written(replace(smoothed, legs=(replace(leg, methods={'smoother': method}),)))[TWIST]
    x = blocks(text)['diff_drive_controller'][foreign_keys.TWIST_COVARIANCE][0]
    assert x == pytest.approx((0.05 * 5)**2 / 12 * 1.2**2, rel=0.01)


def test_one_wheel_gives_no_turn_rate(smoothed):
    estimates = {name: e for name, e in smoothed.estimates.items() if name != 'track_width'}
    text = written(replace(smoothed, estimates=estimates))[TWIST]
    assert blocks(text)['diff_drive_controller'][foreign_keys.TWIST_COVARIANCE][5] == 1e6
    assert 'yaw' not in blocks(text)['wheel_odometry_covariance']['turn_rate_0']
    assert 'use a gyro' in text


def test_the_density_for_estimators_with_wheels(smoothed):
    text = written(smoothed)[TWIST]
    density = float(re.search(rf'{foreign_keys.WHEEL_INERTIAL}: (\S+)', text)[1])
    x = blocks(text)['diff_drive_controller'][foreign_keys.TWIST_COVARIANCE][0]
    assert density == pytest.approx(np.sqrt(x * 0.1), rel=0.01)


def test_two_point_results_have_no_noise_files(good):
    assert not {TWIST, IMU} & written(good).keys()


def test_only_errors_of_the_imu_that_the_drive_determined(smoothed):
    found = blocks(written(smoothed)[IMU])['imu_errors']
    assert set(found) == {'gyro_scale_z', 'accelerometer_bias_x', *(
        f'gyro_bias_{axis}' for axis in 'xyz')}
    assert found['gyro_scale_z'] == {'value': 0.002, 'sigma': 1e-4}


@pytest.mark.slow
def test_the_scale_error_of_a_gyro_is_found_with_its_sign():
    made = drive(scenario='town', duration=500.0, seed=4, imu_grade='industrial', fix_noise='rtk',
                 gyro_scale_error=0.01)
    config = settings(made, heading_sigma=None, method='smoother')
    result = combine([calibrate(made.leg(), config)], config)
    one = blocks(written(result)[IMU])['imu_errors']['gyro_scale_z']
    # true rate = reading - scale * reading
    assert abs(one['value'] - 0.01 / 1.01) < 4 * one['sigma'] < 0.004
