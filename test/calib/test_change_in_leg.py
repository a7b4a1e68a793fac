# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Step changes of scale, mounting, counter or bias within a leg are found and reported."""

from dataclasses import replace
import re
from types import SimpleNamespace

from drives import ANGLES, cached, off, turned
import numpy as np
import pytest
from smoother_legs import leg_of, made, reason_texts

from odocal_ros import read_bag
from odocal_ros.calib.scale_variation import counter_change_reasons, Sections
from odocal_ros.estimator import smooth
from odocal_ros.estimator.chain import NormalEquations, solve
from odocal_ros.estimator.constant_steps import ConstantStep, find_constant_steps
from odocal_ros.estimator.convergence import CONVERGENCE
from odocal_ros.estimator.equations import Equations, WeightedEquations
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.result.remarks import _change_reasons, MIN_REPORTED_CHANGE
from odocal_ros.estimator.smoother import best_fit
from odocal_ros.estimator.state import LN_K, M, PITCH, YAW
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code, Verdict
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

DRIVE = {'imu_grade': 'industrial', 'duration': 240.0, 'fix_sigma': 0.3}
AFTER = 1 / 3       # fraction of the leg after the change; the leg ends with a standstill
SENSORS = {'f_b': 'accelerometer', 'w_b': 'gyro'}
AT = 70.0       # s
STEPS = {'f_b': (0.06, 0.06, -0.05), 'w_b': (0.001, -0.001, 0.0014)}     # 10 mg, 0.1 deg/s


def recounted(leg, factor):
    """Return a leg whose odometer increments are multiplied by a factor."""
    sent = leg.odometer
    value = sent.value[0] + np.cumsum(np.append(0.0, np.diff(sent.value) * factor))
    return leg.with_rows(odometer=replace(sent, value=np.round(value).astype(int)))


def changed(turn=(0.0, 0.0, 0.0), scale=0.0, **limits):
    """Return truth, estimates, reasons of a drive with an IMU turn, rad, and a scale change."""
    drive, config, _ = made(**DRIVE)
    leg = drive.leg()
    begin, end = leg.imu.stamp_ns[[0, -1]]
    at = begin + AFTER * (end - begin)
    leg = recounted(leg.with_rows(imu=turned(leg.imu, at, turn)),
                    1 + scale * (leg.odometer.stamp_ns[:-1] >= at))
    result = smooth(leg_of(leg, config), with_settings(config, limits))
    return drive.truth, result.estimates, reason_texts(result)


def equations_at(problem, fit, constants):
    return Equations(problem, replace(fit.state, constants=constants), fit.priors,
                     fit.variance_factors, True)


@pytest.fixture(scope='module')
def fitted():
    _, config, leg = made(**DRIVE)
    problem = make_problem(leg, config)
    return problem, best_fit(problem, config)


def column_of(problem, fit, constant, size):
    """Return the derivatives of the whitened motion rows by a constant, by differences: (K, r)."""
    rows = fit.weighted[MotionRows]
    above, below = (equations_at(problem, fit, fit.state.constants + by * (
        np.arange(M) == constant)).factors['motion'].raw for by in (size, -size))
    return np.einsum('kij,kj->ki', rows.whiten, (above - below) / (2 * size))


@pytest.mark.parametrize('constant', [YAW, PITCH])
def test_step_size_equals_a_fit_with_one_more_constant(fitted, constant):
    problem, fit = fitted
    weighted, rows = fit.weighted, fit.weighted[MotionRows]
    solution = solve(weighted.normal())
    step = next(s for s in find_constant_steps(weighted, solution) if s.constant == constant)
    at = int(np.searchsorted(fit.state.t, step.t))
    column = column_of(problem, fit, constant, 1e-5)
    column[:at] = 0.0

    plain, n, m = weighted.normal(), weighted.n, weighted.m
    wider = NormalEquations(len(fit.state.t), n, m + 1)
    wider.diagonal[:], wider.upper[:] = plain.diagonal, plain.upper
    wider.coupling[:, :, :m], wider.corner[:m, :m] = plain.coupling, plain.corner
    wider.g[:], wider.g_constants[:m] = plain.g, plain.g_constants
    by = np.einsum('kij,ki->kj', rows.J, column)
    wider.coupling[:-1, :, m] += by[:, :n]
    wider.coupling[1:, :, m] += by[:, n:2 * n]
    wider.corner[:m, m] = wider.corner[m, :m] = by[:, 2 * n:].sum(axis=0)
    wider.corner[m, m] = (column**2).sum()
    wider.g_constants[m] = -(column * rows.r).sum()
    whole = solve(wider)
    sigma = np.sqrt(whole.covariance[m, m])
    assert step.sigma == pytest.approx(sigma, rel=2e-3)
    # the other unknowns have converged within the convergence limit
    assert step.size == pytest.approx(whole.step_constants[m], abs=CONVERGENCE.max_step * sigma)


def test_shortened_last_iteration_does_not_change_the_steps(fitted):
    problem, fit = fitted
    constants = fit.state.constants.copy()
    constants[[LN_K, YAW]] += 0.01
    equations = equations_at(problem, fit, constants)
    found = []
    for fraction in (1.0, 0.4):
        weighted = WeightedEquations(equations, fit.levels)
        full = solve(weighted.normal())
        solution = replace(full, step=fraction * full.step, step_fraction=fraction,
                         step_constants=fraction * full.step_constants)
        found.append([step.size
                      for step in find_constant_steps(weighted.apply_step(solution), solution)])
    sigma = [step.sigma for step in fit.constant_steps]
    # fixes in the tails are down-weighted with the full step
    np.testing.assert_allclose(*found, atol=0.1 * max(sigma))


def test_no_step_is_reported_without_a_change(fitted):
    _, fit = fitted
    assert {s.constant for s in fit.constant_steps} == {LN_K, YAW, PITCH}
    # the largest of 15 overlapping intervals exceeds 4 sigma in one of 1,000 drives
    assert all(abs(s.size) < 4 * s.sigma for s in fit.constant_steps)
    assert Code.CHANGE_IN_LEG not in changed()[2]


@pytest.mark.parametrize('deg', [1.0, -1.0])
def test_mounting_sigma_covers_both_angles_after_a_small_imu_turn(deg):
    truth, found, texts = changed(turn=(0.0, 0.0, np.deg2rad(deg)),
                                 **{'verdict.max_yaw_sigma': 0.05})
    yaw = found['yaw_mounting_angle']
    assert 'yaw mounting angle changes by about' in texts[Code.CHANGE_IN_LEG]
    for true in (truth.yaw, truth.yaw + np.deg2rad(deg)):
        assert abs(yaw.value - true) < 2 * yaw.sigma
    assert np.deg2rad(abs(deg)) / 2 < yaw.sigma < np.deg2rad(2 * abs(deg))


@pytest.mark.parametrize(('axis', 'name'), [(2, 'yaw'), (1, 'pitch')])
def test_imu_turn_of_degrees_removes_the_angle_and_names_the_cause(axis, name):
    _, found, texts = changed(turn=np.deg2rad(3.0) * np.eye(3)[axis])
    assert found[f'{name}_mounting_angle'].value is None
    assert f'the {name} mounting angle changes by about' in texts[Code.CHANGE_IN_LEG]
    if name == 'yaw':
        assert 'see CHANGE_IN_LEG' in texts[Code.YAW_NOT_DETERMINED]


def test_scale_step_is_reported_with_size_and_time():
    _, _, texts = changed(scale=0.02)
    assert 'the scale factor changes by about -1.' in texts[Code.CHANGE_IN_LEG]
    near = float(texts[Code.CHANGE_IN_LEG].split('near t = ')[1].split(' s')[0])
    assert abs(near - (AFTER * DRIVE['duration'] - 20.0)) < DRIVE['duration'] / 8


def test_gradual_scale_change_is_not_reported_as_a_step():
    """The scale rises and falls by 0.3 %; the best single step has 6 to 7 sigma."""
    drive, config, _ = made(imu_grade='tactical', duration=400.0, fix_sigma=0.02)
    leg = drive.leg()
    arch = 0.003 * np.sin(np.pi * np.linspace(0.0, 1.0, len(leg.odometer.value) - 1))
    texts = reason_texts(smooth(leg_of(recounted(leg, 1 + arch), config), config))
    assert 'from start to end' in texts[Code.SCALE_VARIES]
    assert Code.CHANGE_IN_LEG not in texts


@pytest.mark.parametrize('constant', [LN_K, YAW])
def test_change_without_effect_is_not_reported(constant):
    for size, count in ((0.9 * MIN_REPORTED_CHANGE, 0), (1.1 * MIN_REPORTED_CHANGE, 1)):
        fit = SimpleNamespace(constant_steps=(ConstantStep(constant, 100.0, size, size / 7),))
        assert len(_change_reasons(fit)) == count


@pytest.mark.core
@pytest.mark.parametrize(('ratio', 'sigma', 'text'), [
    ([1.4] * 4 + [0.9] + [0.7] * 5, 1e-3, 'after t = 40 to 50 s the odometer counts 2.00 times as '
     'much per metre'),
    ([0.7] * 4 + [0.9] + [1.4] * 5, 1e-3, '0.50 times'),
    ([1.0] * 5 + [1e-6] * 5, 1e-3, 'Likely cause: the position or the counter is frozen'),
    ([1.0] * 10, 1e-3, ''), ([1.01] * 5 + [0.99] * 5, 1e-4, ''),
    ([1.05] * 5 + [0.95] * 5, 0.05, ''), ([1.0] * 4 + [0.7] + [1.0] * 5, 1e-3, ''),
    (np.linspace(0.9, 1.1, 10), 1e-3, ''), ([1.0] * 5 + [np.nan] * 5, 1e-3, ''),
    ([0.93] + [1.0] * 9, 0.015, ''), ([1.0] * 9 + [0.93], 0.015, ''),
    ([2.0] + [1.0] * 9, 0.015, '2.00 times')],
    ids=['halved', 'doubled', 'frozen', 'constant', 'tyres', 'uncertain', 'slip', 'drift', 'half',
         'multipath at first', 'multipath at last', 'doubled at first'])
def test_counter_change_is_found_with_place_and_factor(ratio, sigma, text):
    """Ten sections of 100 m in 10 s each."""
    edges = np.linspace(0.0, 1000.0, len(ratio) + 1)
    parts = Sections(edges[:-1], edges[1:], np.array(ratio), np.full(len(ratio), sigma))
    found = counter_change_reasons(parts, np.linspace(0.0, 100.0, 101),
                                   np.linspace(0.0, 1000.0, 101))
    assert [r.code for r in found] == [Code.TRACK_MISMATCH] * bool(text)
    assert all(text in r.text for r in found)


@pytest.fixture(scope='module')
def town():
    return simulate(SimOptions(scenario='town', duration=240.0, seed=3, imu_rate=50.0,
                               odometer_rate=25.0, fix_noise='rtk'))


@pytest.mark.slow
@pytest.mark.parametrize('factor', [1, 2, 4])
def test_edge_decoding_that_changes_in_mid_drive_is_found(town, factor):
    leg = town.leg()
    late = leg.odometer.stamp_ns[1:] > (leg.start_ns + leg.stop_ns) // 2
    result = calibrate(recounted(leg, np.where(late, factor, 1)),
                       with_settings(Config(), {'imu.grade': town.options.imu_grade}))
    texts = [r.text for r in result.reasons if f'{factor:.2f} times as much' in r.text]
    assert len(texts) == (factor > 1)
    assert (result.verdict is Verdict.REJECTED) == (factor > 1)


@pytest.mark.parametrize(('size', 'more'), [
    (1 / 9.80665, 0.0), (0.0, 0.1), (2.0, 0.0), (1.0, [0.0, 9.8, 0.0])])
def test_accelerometer_unit_or_range_change_is_found_but_not_in_a_bend_at_1_g(town, size, more):
    leg = town.leg()
    force = leg.imu.f_i.copy()
    late = leg.imu.stamp_ns > (leg.start_ns + 2 * leg.stop_ns) // 3
    force[late] = force[late] * size + more
    result = calibrate(replace(leg, imu=replace(leg.imu, f_i=force)), Config())
    texts = [r.text[:9] for r in result.reasons if r.code is Code.IMU_UNITS]
    assert texts == ['from t = '] * (size != 1.0)
    assert result.verdict is Verdict.REJECTED or size == 1.0


@cached
def calibrated(stepping=None):
    """Return a drive and its result; the bias of one sensor changes in a step at AT."""
    drive, config, leg = made(duration=200.0, imu_grade='industrial', fix_noise='rtk')
    if stepping:
        step = (leg.t_imu > AT)[:, None] * np.array(STEPS[stepping])
        leg = replace(leg, **{stepping: getattr(leg, stepping) + step})
    return drive, smooth(leg, config)


@pytest.mark.slow
@pytest.mark.parametrize('stepping', STEPS)
def test_bias_step_is_reported_as_a_step_and_not_as_noise(stepping):
    drive, method = calibrated(stepping)
    _, plain = calibrated()
    for name in ('scale_factor', *ANGLES):
        assert off(method, drive, name) < 3.3
        # one of 200 intervals has no continuity of the bias
        assert method.estimates[name].sigma < 1.3 * plain.estimates[name].sigma
    texts = reason_texts(method)
    assert not {Code.IMU_WORSE_THAN_GRADE, Code.MODEL_MISMATCH, Code.WHEEL_SLIP,
                Code.CHANGE_IN_LEG} & set(texts)
    assert Code.IMU_BIAS_STEP not in reason_texts(plain)
    found = re.fullmatch(f'the {SENSORS[stepping]} bias changes by ([0-9.]+) (deg/s|m/s\\^2) near '
                         't = ([0-9]+) s; estimated before and after', texts[Code.IMU_BIAS_STEP])
    unit = {'deg/s': np.deg2rad(1.0), 'm/s^2': 1.0}[found[2]]
    # two digits; the step occurs within an interval of 1 s
    assert float(found[1]) * unit == pytest.approx(np.linalg.norm(STEPS[stepping]), rel=0.1)
    assert abs(float(found[3]) - AT) <= 3


@pytest.mark.slow
@pytest.mark.parametrize('turn_deg', [0.0, 3.0, -5.0])
def test_turn_of_the_imu_that_the_vehicle_does_not_make_is_a_step_of_the_yaw(data_dir, turn_deg):
    """A real car with whole km/h: the fit keeps the yaw, and calls the gyro an outlier."""
    mounting = [0.0, -np.pi / 2, np.pi / 2]
    recording = read_bag(data_dir / 'canedge_car_165' / 'bag', {'odometer': '/vehicle/twist'},
                         {'imu.mounting_rpy': mounting})
    start_ns, seconds = recording.start_ns + 330 * 10**9, 670
    leg = recording.recorder.close(start_ns, start_ns + seconds * 10**9)
    turn = matrix_from_rpy(mounting).T @ [0.0, 0.0, np.deg2rad(turn_deg)]
    leg = leg.with_rows(imu=turned(leg.imu, start_ns + seconds // 2 * 10**9, turn))
    result = calibrate(leg, recording.config).methods['smoother']
    found = re.search('yaw mounting angle changes by about ([^ ]+) deg near t = ([0-9]+) s',
                      reason_texts(result).get(Code.CHANGE_IN_LEG, ''))
    assert bool(found) == bool(turn_deg)
    assert (result.estimates['yaw_mounting_angle'].value is None) == bool(turn_deg)
    if found:
        assert float(found[1]) == pytest.approx(turn_deg, rel=0.1)
        assert abs(float(found[2]) - seconds // 2) < 3
