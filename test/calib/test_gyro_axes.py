# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Axes of the gyro compared with gravity and the course of the fixes."""

import ast
from dataclasses import replace
from functools import cache
import re
from types import SimpleNamespace

from drives import changed, drive, reason_texts, rejecting, settings
import numpy as np
import pytest
from scipy.stats import f as f_distribution

from odocal_ros.calib.gyro_axes import level_axes, wrong_axes_by_gravity
from odocal_ros.calib.mounting import estimate_mounting
from odocal_ros.data.samples import take
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.pipeline.calibrate import calibrate, find_faults, screen_leg
from odocal_ros.reasons import Code, Verdict
from odocal_ros.screening.gravity_fit import gravity_fit, GravityFit
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import with_settings

SOUND, SAME = np.array([1.0, 1j, 0.0]), np.eye(3)
AXES = {'mirrored x': np.diag([-1.0, 1.0, 1.0]), 'mirrored y': np.diag([1.0, -1.0, 1.0]),
        'x and y swapped': np.eye(3)[[1, 0, 2]], 'x and z swapped': np.eye(3)[[2, 1, 0]],
        'y and z swapped': np.eye(3)[[0, 2, 1]]}
DO = {'mirrored x': 'negate angular_velocity.x', 'mirrored y': 'negate angular_velocity.y',
      'x and y swapped': 'publish the value of angular_velocity.x as angular_velocity.y; publish '
      'the value of angular_velocity.y as angular_velocity.x',
      'x and z swapped': 'publish the value of angular_velocity.x as angular_velocity.z',
      'y and z swapped': 'publish the value of angular_velocity.y as angular_velocity.z'}
DEG = np.pi / 180


@cache
def town():
    return drive(scenario='town', duration=400.0, imu_grade='industrial', slope=0.04, seed=5)


def with_imu(made, M=SAME, **more):
    """Return the leg of a drive whose gyro outputs M w, or with other columns changed."""
    return replace(made.leg(), imu=changed(made.imu, **({'w_i': lambda w: w @ M.T} | more)))


def of_gyro(made, M=SAME, C=SAME, **options):
    """Return the reasons of a leg with gyro output M w and an IMU rotated by C (b to i)."""
    config = with_settings(settings(made), options)
    leg = with_imu(made, M @ C, f_i=lambda f: f @ C.T)
    return {r.code: r for r in find_faults(screen_leg(leg, config), config)}


X_MIRRORED, Y_MIRRORED = ({'f_i': lambda f, i=i: f * (1.0 - 2.0 * np.eye(3)[i])} for i in (0, 1))


@pytest.mark.parametrize(('changes', 'code', 'do'), [
    *(({'M': AXES[name]}, Code.GYRO_AXES, f': {DO[name]}') for name in AXES),
    # an accelerometer axis error is not attributed to the gyro
    (X_MIRRORED, Code.IMU_AXES, 'negate linear_acceleration.x'),
    (Y_MIRRORED, Code.IMU_AXES, 'negate linear_acceleration.y')], ids=[*AXES, 'f x', 'f y'])
def test_wrong_axis_rejects_the_leg_and_names_the_correction(changes, code, do):
    result = calibrate(with_imu(town(), **changes), settings(town()))
    assert rejecting(result) == {code} == set(reason_texts(result))
    assert do in next(r.special_remedy for r in result.reasons)


@pytest.mark.parametrize('seed', [5, 6])
@pytest.mark.parametrize('name', ['mirrored x', 'x and y swapped'])
def test_precise_coefficient_of_three_segments_names_the_axis(seed, name):
    """On gentle hills three segments determine the roll coefficient: 1.00 ± 0.04, ± 0.06."""
    made = drive(scenario='town', duration=300.0, imu_rate=50.0, imu_grade='industrial',
                 odometer_rate=20.0, fix_rate=5.0, fix_noise='rtk', slope=0.03, seed=seed)
    assert 'measures the rotation of gravity' in of_gyro(made, AXES[name])[Code.GYRO_AXES].text
    assert Code.GYRO_AXES not in of_gyro(made)


@pytest.mark.parametrize(('name', 'pitch'), [('mirrored x', 0.4), ('x and y swapped', 0.4),
                                             ('x and y swapped', 2.0)])
def test_wrong_axes_hidden_by_flat_ground_are_reported_as_accelerometer_skew(name, pitch):
    """Turns give the pitch by the gyro, accelerations by the accelerometer: they contradict."""
    made = drive(scenario='town', duration=400.0, imu_grade='industrial', slope=0.0, seed=5,
                 fix_rate=5.0, pitch=pitch * DEG)
    config = settings(made, method='smoother')
    found = {}
    for axes in (np.eye(3), AXES[name]):
        result = calibrate(with_imu(made, axes), config)
        found[axes is AXES[name]] = result.verdict, Code.IMU_AXES_SKEW in reason_texts(result)
    assert found == {False: (Verdict.ACCEPTED, False), True: (Verdict.CAUTION, True)}


@pytest.mark.parametrize('segments', [1.5, 3.0, 12.0])
@pytest.mark.parametrize(('found', 'nearest'), [(1j, 0.0), (-1.0, 0.0), (0.5 + 0.3j, 0.5),
                                                (1.2, 1.0)])
def test_chance_of_a_coefficient_follows_the_f_distribution(segments, found, nearest):
    """A complex mean has two degrees of freedom, its scatter two per segment minus two."""
    fit = GravityFit(np.array([found]), np.array([0.1]), np.array([segments]))
    assert fit.chance(0, 1.0) == pytest.approx(
        f_distribution.sf(abs(found - nearest)**2 / 0.1**2, 2, 2 * (segments - 1)), rel=1e-9)


@pytest.mark.parametrize('rpy', [(np.pi / 2, 0, 0), (-np.pi / 2, 0, 0), (0, np.pi / 2, 0),
                                 (-np.pi / 2, -np.pi / 2, 0), (-np.pi / 2, 0, -np.pi / 2)])
def test_a_gyro_on_its_side_without_accelerometer_gets_its_mounting(rpy):
    """The last one is an optical frame: x right, y down, z forward."""
    no_force = {'w_i': lambda w: w @ matrix_from_rpy(rpy),
                'f_i': lambda f: np.full_like(f, np.nan)}
    leg = replace(town().leg(), imu=changed(town().imu, **no_force))
    config = settings(town())
    found = {r.code: r for r in find_faults(screen_leg(leg, config), config)}
    remedy = found[Code.GYRO_AXES].special_remedy
    mounting = ast.literal_eval(re.search(r'to (\[.*\]):', remedy)[1])
    config = with_settings(config, {'imu.mounting_rpy': tuple(mounting)})
    assert not {Code.GYRO_AXES, Code.GYRO_SIGN} & {
        r.code for r in find_faults(screen_leg(leg, config), config)}
    assert matrix_from_rpy(mounting)[2] == pytest.approx(matrix_from_rpy(rpy)[2], abs=1e-4)


@pytest.mark.parametrize(('x', 'y', 'named'), [
    (-1.36j, 0.98j, []), (-1.0, 0.98j, ['x']), (1j, 0.9, ['x', 'y'])])
def test_two_gyro_axes_with_the_same_signal_are_not_an_axis_fault(monkeypatch, x, y, named):
    """The first coefficients are from a zoo drive with correct axes; their chance is 7e-6."""
    fit = GravityFit(np.array([x, y, 0.0]), np.array([0.1, 0.05, 0.02]), np.full(3, 12.0))
    monkeypatch.setattr('odocal_ros.calib.gyro_axes.gravity_fit', lambda *_: fit)
    inputs = SimpleNamespace(t_imu=None, travel=None)
    found = wrong_axes_by_gravity(inputs, SimpleNamespace(rough_scale=1.0), None, None, None,
                                  ['x', 'y', 'z'])
    assert [sent for sent, *_ in found] == named


@pytest.mark.parametrize(('topic', 'changes', 'cause'), [
    ('imu', {'w_i': np.negative}, 'angular_velocity has the wrong sign'),
    ('imu', {'f_i': lambda f: f * [-1.0, 1.0, 1.0], 'w_i': lambda w: w * [1.0, -1.0, -1.0]},
     'longitude (x and y) are swapped, or linear_acceleration is negated'),
    ('fix', {'longitude': np.negative}, 'longitude (x and y) are swapped, or linear_acceler'),
    ('imu', {'w_i': np.negative, 'f_i': lambda f: np.full_like(f, np.nan)}, 'expected: 1)')])
def test_third_sensor_identifies_the_wrong_sign(topic, changes, cause):
    leg = replace(town().leg(), **{topic: changed(getattr(town(), topic), **changes)})
    (found,) = (r for r in calibrate(leg, settings(town())).reasons if r.code is Code.GYRO_SIGN)
    assert cause in found.text
    assert ('Set imu.mounting_rpy' in found.special_remedy) == (
        'f_i' in changes and cause == 'expected: 1)')
    assert ('Swap latitude and longitude' in found.special_remedy) == ('longitude (x' in cause)


def test_mirrored_gyro_is_found_by_accelerations_with_few_fixes():
    """The course of five fixes is not conclusive; accelerations in turns show the sign."""
    fix = town().fix
    few = replace(town(), fix=take(fix, np.linspace(0, len(fix.stamp_ns) - 1, 5).astype(int)))
    assert Code.GYRO_SIGN not in of_gyro(few)
    mirrored = of_gyro(few, np.diag([1.0, 1.0, -1.0]))
    assert 'accelerations in turns' in mirrored[Code.GYRO_SIGN].text


@pytest.mark.parametrize(('sensor', 'wrong', 'yaw'), [
    ('w_i', [1.0, 1.0, -1.0], 0.0), ('f_i', [1.0, -1.0, 1.0], 0.0),
    ('f_i', [-1.0, 1.0, 1.0], np.pi)])
def test_mirrored_axis_does_not_hide_the_mounting(sensor, wrong, yaw):
    """Otherwise only the orientation is reported, and not the fault."""
    made, C = town(), matrix_from_rpy((np.pi / 2, 0.0, np.pi / 2))
    sent = {name: getattr(made.imu, name) for name in ('w_i', 'f_i')}
    sent[sensor] = sent[sensor] * wrong
    inputs, _ = screen(made.leg(), settings(made))
    found = estimate_mounting(inputs.t_imu, sent['w_i'] @ C, sent['f_i'] @ C, inputs.travel,
                              made.options.nominal_scale)
    assert found.C_bi == pytest.approx(matrix_from_rpy((0.0, 0.0, yaw)) @ C, abs=1e-9)


def test_axes_are_those_of_the_messages_for_any_mounting():
    """An IMU that is rolled and points backwards has its x along another vehicle axis."""
    rpy = (np.pi / 2, 0.0, np.pi / 2)
    C = matrix_from_rpy(rpy).T
    for name in ('mirrored x', 'mirrored y'):
        reasons = of_gyro(town(), AXES[name], C, **{'imu.mounting_rpy': rpy})
        if Code.GYRO_SIGN in reasons:      # the axis that turns with the course
            continue
        assert DO[name] in reasons[Code.GYRO_AXES].special_remedy, name
    assert not {Code.GYRO_SIGN, Code.GYRO_AXES} & set(
        of_gyro(town(), SAME, C, **{'imu.mounting_rpy': rpy}))


@pytest.mark.parametrize('up', [(0.1, -0.05, 0.99), (0.0, 0.1, -0.99), (0.99, 0.1, 0.0),
                                (0.1, -0.99, 0.1)])
def test_level_axes_are_right_handed_and_named_by_the_nearest_sensor_axis(up):
    up = np.array(up) / np.linalg.norm(up)
    axes, names = level_axes(up)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    assert axes[2] == pytest.approx(up)
    for axis, name in zip(axes, names, strict=True):
        assert axis['xyz'.index(name[-1])] * (-1 if name[0] == '-' else 1) > 0.9


@pytest.mark.parametrize(('scenario', 'more'), [
    ('town', {'slope': 0.04}), ('straight', {'slope': 0.04}),
    ('town', {'slope': 0.04, 'imu_grade': 'consumer'}), ('town', {}),
    ('straight', {'imu_grade': 'consumer'})])
def test_correct_gyro_is_not_reported(scenario, more):
    made = drive(duration=300.0, seed=11, scenario=scenario, **more)
    assert Code.GYRO_AXES not in of_gyro(made)


def test_fit_finds_each_coefficient_within_its_sigma():
    made = town()
    inputs = screen_leg(made.leg(), settings(made)).inputs
    axes, _ = level_axes(inputs.median_f_b / np.linalg.norm(inputs.median_f_b))
    for M, expected in ((np.eye(3), SOUND), (AXES['mirrored x'], SOUND * [-1, 1, 1]),
                        (AXES['x and y swapped'], SOUND[[1, 0, 2]])):
        fit = gravity_fit(inputs.t_imu, inputs.w_b @ M.T, inputs.f_b, axes, inputs.travel,
                          made.options.nominal_scale)
        off = np.abs(fit.coefficient - expected)
        assert np.all(off[:2] < 4 * fit.sigma[:2])
        assert np.all(fit.sigma[:2] < 0.2)
        assert off[2] < 0.1, 'the tilt that the median of the force leaves'
