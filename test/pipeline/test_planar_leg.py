# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Robots without an IMU, with skid steering and with mecanum wheels, from samples to a result."""

from dataclasses import replace
import os
from pathlib import Path
import subprocess
import sys
from types import SimpleNamespace

from drives import cached
import foreign_keys
import numpy as np
import pytest
import yaml

from odocal_ros.output.device_files import controllers
from odocal_ros.pipeline import planar_run
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.pipeline.planar_run import shortened_by_slopes
from odocal_ros.reasons import Code, Verdict
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate
from odocal_ros.sim.truth import operator_settings
from odocal_ros.sim.wheels import effective_width, LATERAL_RATIO

ROOT = Path(__file__).resolve().parents[2]
TEST = ROOT / 'test'
SIGMAS = 3.5      # one of the values below in 2000 is beyond it


@cached
def driven(drive='differential', **more):
    """Return a simulated robot without an IMU, and its settings."""
    options = {'scenario': 'indoor', 'reference': 'mocap', 'fix_rate': 10.0, 'odometer': 'angle',
               'imu': False, 'slip_walk': 5e-4, 'drive': drive, 'duration': 120.0} | more
    made = simulate(SimOptions(**options))
    odometer = operator_settings(made)['odometer']
    odometer.pop('lever_arm')
    return made, with_settings(Config(), {f'odometer.{k}': v for k, v in odometer.items()})


@pytest.mark.core
@pytest.mark.parametrize(('drive', 'wheels'), [
    ('differential', 2), ('skid', 2), ('skid', 4), ('mecanum', 4), ('omni', 3), ('omni', 4)])
def test_values_are_within_their_sigmas(drive, wheels):
    made, config = driven(drive, wheels=wheels)
    found = calibrate(made.leg(), config)
    assert found.verdict is Verdict.ACCEPTED, found.reasons
    estimates = found.methods['planar'].estimates
    width = effective_width(made.options)
    truth = {'scale_factor': made.truth.scale, 'track_width': width, 'rotation_lever': width / 2,
             'lateral_scale_factor': LATERAL_RATIO * made.truth.scale,
             'track_width_arc': effective_width(made.options, 2 * width)}
    names = {'differential': ['track_width'], 'skid': ['track_width', 'track_width_arc'],
             'mecanum': ['rotation_lever', 'lateral_scale_factor'],
             'omni': ['rotation_lever']}[drive]
    for name in ('scale_factor', *names):
        one = estimates[name]
        assert abs(one.value - truth[name]) < SIGMAS * one.sigma, name
        assert one.sigma < (0.05 if name == 'track_width_arc' else 0.01) * one.value


def test_skid_steering_with_an_imu_has_a_gyro_scale():
    made, config = driven('skid', imu=True, gyro_scale_error=0.02, imu_grade='industrial')
    method = calibrate(made.leg(), with_settings(config, {
        'imu.gyro_scale_sigma': 0.02})).methods['planar']
    gyro = method.details['gyro_scale_z']
    assert abs(gyro['value'] - 0.02) < SIGMAS * gyro['sigma']
    assert gyro['sigma'] < 0.005
    width = method.estimates['track_width']
    assert abs(width.value - effective_width(made.options)) < SIGMAS * width.sigma


def test_swapped_wheels_are_rejected():
    made, config = driven()
    leg = made.leg()
    leg = replace(leg, odometer=leg.odometer_right, odometer_right=leg.odometer)
    found = calibrate(leg, config)
    assert found.verdict is Verdict.REJECTED
    codes = {r.code for r in found.methods['planar'].reasons}
    assert Code.WHEELS_SWAPPED in codes
    assert not codes & {Code.MODEL_MISMATCH, Code.NOT_CONVERGED}     # its consequences


def test_a_run_without_turns_has_a_scale_and_no_width():
    made, config = driven()
    leg = made.leg()
    turns = made.motion.yaw_rate(np.arange(0.0, 60.0, 0.1))
    first = np.flatnonzero(np.abs(turns) > 0)[0] * 0.1
    leg = replace(leg, stop_ns=leg.start_ns + round((first - 5.0) * 1e9))
    method = calibrate(leg, config).methods['planar']
    assert method.estimates['track_width'].value is None
    why = next(r for r in method.reasons if r.code is Code.TRACK_WIDTH_NOT_DETERMINED)
    assert 'turns on the spot' in why.remedy


def test_too_few_wheels_state_what_is_required():
    made, config = driven()
    leg = made.leg()
    found = calibrate(replace(leg, odometer_right=type(leg.odometer)(
        *(column[:0] for column in (leg.odometer.stamp_ns, leg.odometer.received_ns,
                                    leg.odometer.value)))), with_settings(config, {
                                        'odometer.left': '', 'odometer.right': ''}))
    assert Code.NO_IMU in {r.code for r in found.reasons}
    made, config = driven()
    found = calibrate(made.leg(), with_settings(config, {'odometer.drive': 'mecanum'}))
    assert found.verdict is Verdict.REJECTED
    assert any('required: 4' in r.text for r in found.reasons)


def test_wheels_of_another_run_are_rejected():
    made, config = driven()
    other, _ = driven(seed=5)
    leg = replace(made.leg(), odometer=other.leg().odometer,
                  odometer_right=other.leg().odometer_right)
    found = calibrate(leg, config)
    codes = {r.code for r in found.methods['planar'].reasons}
    assert Code.NOT_CONVERGED in codes
    assert Code.METHOD_FAILED not in codes


def test_controller_parameters_of_each_drive_are_exported():
    made, config = driven('mecanum')
    text = _controllers(_calibrated(made, config), config)
    assert 'mecanum_drive_controller:' in text
    kinematics = yaml.safe_load(text)['mecanum_drive_controller']['ros__parameters']['kinematics']
    assert set(kinematics) == foreign_keys.MECANUM_KINEMATICS
    assert kinematics['wheels_radius'] == pytest.approx(made.truth.scale, rel=2e-3)
    assert kinematics['sum_of_robot_center_projection_on_X_Y_axis'] == pytest.approx(0.3, rel=1e-2)
    assert 'diff_drive' not in text
    made, config = driven('omni')
    config = with_settings(config, {'odometer.wheel_offset': 0.0})
    parameters = yaml.safe_load(_controllers(_calibrated(made, config), config))
    parameters = parameters['omni_wheel_drive_controller']['ros__parameters']
    assert set(parameters) == foreign_keys.OMNI_WHEEL_DRIVE
    assert parameters['wheel_radius'] == pytest.approx(made.truth.scale, rel=2e-3)
    assert parameters['robot_radius'] == pytest.approx(0.15, rel=1e-2)
    made, config = driven('skid')
    calibration = _calibrated(made, config)
    assert 'wheel_separation_multiplier: 1.7' in _controllers(calibration, config)
    text = _controllers(calibration, with_settings(config, {'odometer.track_width': 0.0}))
    assert 'wheel_separation: 0.51' in text
    assert 'ackermann' not in text


def _calibrated(made, config):
    return combine([calibrate(made.leg(), config)], config)


def _controllers(calibration, config):
    files = controllers(calibration, config, {'software': 'odocal', 'created': 'now',
                                              'inputs': [], 'verdict': 'accepted'})
    return files['ros2_controllers.yaml']


def test_two_legs_are_combined():
    legs = [driven(seed=seed, start_ns=1_750_000_000_000_000_000 + seed * 10**12)
            for seed in (6, 7)]
    config = legs[0][1]
    results = [calibrate(made.leg(), config) for made, _ in legs]
    both = combine(results, config).estimates
    for name in ('scale_factor', 'track_width'):
        assert both[name].sigma < min(r.methods['planar'].estimates[name].sigma for r in results)


def heights(height, sigma=0.02, noise=0.0):
    """Return fixes on a straight of 2 km, m by m, with heights of the distance."""
    path_length = np.arange(0.0, 2000.0)
    up = height(path_length) + noise * np.random.default_rng(0).standard_normal(len(path_length))
    geodetic = np.column_stack([0.8 + path_length / 6.36e6, np.full(len(path_length), 0.2), up])
    return SimpleNamespace(t_fix=path_length, geodetic=geodetic, covariance_n=np.tile(
        np.diag([1e-4, 1e-4, sigma**2]), (len(path_length), 1, 1)))


def test_slopes_shorten_the_path_by_half_their_square():
    """Up and down by 5 %; 300 m of sinusoidal hills of 3 %; noise alone; no heights."""
    shortened = shortened_by_slopes
    of_noise = (0.02 / 5)**2        # of two heights, 5 m apart
    assert shortened(heights(lambda x: 0.05 * np.abs(x - 1000.0))) == pytest.approx(
        0.05**2 / 2 - of_noise, rel=0.01)
    hills = heights(lambda x: 0.03 * 300 / (2 * np.pi) * np.sin(2 * np.pi * x / 300))
    assert shortened(hills) == pytest.approx(0.03**2 / 4 - of_noise, rel=0.02)
    # 33 slopes over 60 m, of 4.7 % noise each: the mean square, 2.2e-3, is good to a quarter
    assert shortened(heights(lambda x: 0 * x, 2.0, 2.0)) < 2.2e-3 / 2 * 0.5
    # the covariance states a tenth of the noise: 0.11 with this sigma; three of these quarters
    assert shortened(heights(lambda x: 0 * x, 0.2, 2.0)) < 2.2e-3 / 2 * 0.75
    assert shortened(heights(lambda x: np.nan * x)) == 0.0


def test_slopes_are_in_the_sigmas_of_scale_and_width(monkeypatch):
    made, config = driven()
    level = calibrate(made.leg(), config).methods['planar']
    monkeypatch.setattr(planar_run, 'shortened_by_slopes', lambda inputs: 1e-3)
    sloping = calibrate(made.leg(), config).methods['planar']
    # full turns have no slope: a scale that is too small makes the width as much too small
    for name in ('scale_factor', 'track_width'):
        a, b = (m.estimates[name] for m in (level, sloping))
        assert b.sigma == pytest.approx(np.hypot(a.sigma, 1e-3 * a.value))
    assert 'slopes' in {s.name for s in sloping.sources} - {s.name for s in level.sources}
    assert Code.MODEL_MISMATCH in {r.code for r in sloping.reasons}


def test_a_result_is_the_same_for_any_number_of_threads():
    """Not even the last bit depends on BLAS threads: node and replay may have other numbers."""
    program = ('import sys; sys.path[:0] = ["test/pipeline"]; import test_planar_leg as t\n'
               'made, config = t.driven("skid", imu=True, imu_grade="industrial", duration=80.0)\n'
               'found = t.calibrate(made.leg(), config).methods["planar"].estimates\n'
               'print([(e.value, e.sigma) for e in found.values()])')
    outputs = {subprocess.run([sys.executable, '-c', program], check=True, capture_output=True,
                              cwd=ROOT, text=True, env=os.environ | {
                                  'OPENBLAS_NUM_THREADS': threads, 'PYTHONPATH': f'{ROOT}:{TEST}'}
                              ).stdout for threads in ('1', '2')}
    assert len(outputs) == 1
    assert 'nan' not in outputs.pop()
