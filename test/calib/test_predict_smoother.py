# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Predicted sigmas of the smoother against simulated drives, reference bounds and the fit."""

from dataclasses import replace
import math

from drives import planned
import numpy as np
import pytest
from smoother_legs import made, truth

from odocal_ros.estimator import cramer_rao_bound, prepare, smooth
from odocal_ros.estimator.equations import Equations
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.result.remarks import MODEL_FLOOR
from odocal_ros.forecast.planned_drive import drive_from_rates, TOWN_SIDES, TOWN_SPEED, TOWN_T
from odocal_ros.forecast.planned_methods import (
    ideal_samples,
    keyframe_spacing,
    planned_noise_levels,
    predict_smoother,
    WIDEST_SPACING,
)
from odocal_ros.forecast.predict import Sigmas
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.settings.nominal import GRADES

pytestmark = pytest.mark.slow
NAMES = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')
ROAD = {'sway': 0.05, 'slip_walk': 0.01}       # noise levels of a planned drive
WHITE = {'gnss.correlation_time': 0.0}
USUAL = prepare.imperfection_sigmas(GRADES['consumer'])


def sigmas_of(method):
    """Return the sigmas of scale, yaw and pitch, relative and rad."""
    return np.array([method.estimates[n].sigma for n in NAMES], float)


def figures(drive, config, tau=0.0):
    return Sigmas(config=with_settings(config, {'gnss.correlation_time': tau}),
                  fix=drive.options.fix_sigma, quantum=drive.options.scale, sway=0.05, slip=0.01)


CELLS = [({'scenario': 'town', 'imu_grade': 'industrial'}, 0.0),
         ({'scenario': 'town', 'imu_grade': 'consumer', 'fix_noise': 'correlated'}, 60.0),
         ({'scenario': 'straight', 'imu_grade': 'tactical', 'fix_noise': 'rtk'}, 0.0)]


@pytest.mark.parametrize(('options', 'tau'), CELLS)
def test_bound_of_ideal_samples_equals_that_of_a_simulated_leg_at_its_truth(options, tau):
    drive, config, leg = made(**ROAD, **options)
    sigmas = figures(drive, config, tau)
    problem = make_problem(leg, config)
    true = cramer_rao_bound(leg, config, truth(drive, config, leg),
                            planned_noise_levels(problem, sigmas))
    sigma = np.hypot(np.sqrt(np.diag(true))[:3], MODEL_FLOOR)
    # standstills are found to about a second of twenty or more in a drive, keyframes are at other
    # times: 5 % of the information from standstills
    predicted = predict_smoother(planned(drive.motion, drive.options), sigmas)
    np.testing.assert_allclose(sigmas_of(predicted) / sigma, 1.0, atol=0.05)


def test_predicted_sigma_equals_the_sigma_of_the_smoother():
    options, tau = CELLS[1]
    drive, config, leg = made(**ROAD, **options)
    config = with_settings(config, {'gnss.correlation_time': tau})
    result = smooth(leg, config)
    stated = sigmas_of(result) / [result.estimates[NAMES[0]].value, 1.0, 1.0]
    # the smoother estimates the noise: slip and sideslip from about 400 intervals (1 / sqrt(800) =
    # 3.5 %), gyro and accelerometer from 100 s at rest in three axes (4 %): three times their root
    # sum square is 16 %; standstills and the fixed shares halve it
    predicted = predict_smoother(planned(drive.motion, drive.options), figures(drive, config, tau))
    np.testing.assert_allclose(sigmas_of(predicted) / stated, 1.0, atol=0.12)


def stop_and_go():
    """Return the town drive of the reference bounds: ten minutes."""
    t = np.arange(0.0, 600.05, 0.1)
    minute = (t // 60).astype(int)
    turning = (t % 60 >= 22.0) & (t % 60 < 30.0)
    speed = np.interp(t % 60, TOWN_T, TOWN_SPEED)
    return drive_from_rates(t, speed, np.where(turning, np.array(TOWN_SIDES)[minute % 4], 0.0)
                            * np.pi / 16)


def straight():
    t = np.arange(0.0, 720.05, 0.1)
    return drive_from_rates(t, np.interp(t, [60, 85, 635, 660], [0, 12, 12, 0]), np.zeros_like(t))


def paper():
    t = np.arange(0.0, 900.05, 0.1)
    return drive_from_rates(t, np.interp(t, [300, 340, 860, 900], [0, 20, 20, 0]),
                            np.zeros_like(t))


@pytest.mark.parametrize(('drive', 'grade', 'white', 'pulses'), [
    (stop_and_go, 'consumer', 128, 93), (stop_and_go, 'industrial', 110, 70),
    (stop_and_go, 'tactical', 85, 21), (straight, 'industrial', 57, 11),
    (paper, 'navigation', 35, 5.7)])
def test_scale_sigmas_agree_with_the_reference_bounds(monkeypatch, drive, grade, white, pulses):
    # by an independent program (docs/decisions/0005): lever arms and delays known, fixes white, no
    # slip of the pulses, an ideal vehicle; it finds standstills by the odometer only, so the last
    # digits differ
    config = with_settings(Config(), WHITE | {
        'imu.grade': grade, 'gnss.lever_arm_sigma': 1e-4, 'gnss.time_sigma': 0.0,
        'odometer.time_sigma': 0.0, 'imu.accel_scale_sigma': 0.0})
    monkeypatch.setattr(prepare, 'imperfection_sigmas', lambda *_: np.zeros(len(USUAL)))
    for slip, quantum, table in ((0.05 / math.sqrt(10), 0.0, white), (0.0, 0.02, pulses)):
        method = predict_smoother(drive(), Sigmas(config=config, slip=slip, quantum=quantum))
        assert 1e6 * method.estimates[NAMES[0]].sigma == pytest.approx(
            np.hypot(table, 1e6 * MODEL_FLOOR[0]), rel=0.10)


@pytest.fixture
def town_sigmas():
    # without a gyro error by force, otherwise most of the pitch sigma of a consumer grade
    return Sigmas(config=with_settings(Config(), WHITE | {'imu.gyro_by_force_sigma': 0.0}))


def test_thinned_fixes_keep_the_sigma(town_sigmas, monkeypatch):
    # heights drift by the stated sigma, which differs here
    monkeypatch.setattr(prepare, 'HEIGHT_TIME', np.inf)
    drive = stop_and_go().cut_at(180.0, 10.0)
    often = predict_smoother(drive, replace(town_sigmas, fix=2.0, fix_rate=16.0))
    rare = predict_smoother(drive, replace(town_sigmas, fix=0.5, fix_up=1.0, fix_rate=1.0))
    np.testing.assert_allclose(sigmas_of(often), sigmas_of(rare), rtol=1e-6)


def test_wider_keyframes_never_decrease_a_sigma(town_sigmas):
    drive = stop_and_go()
    fine, coarse = (sigmas_of(predict_smoother(drive, town_sigmas, spacing))
                    for spacing in (1.0, WIDEST_SPACING))
    # each keyframe keeps the information of its interval except changes within it, on the safe
    # side: about a tenth; for yaw, which misalignment affects at the start of a turn, twice that
    assert (coarse >= fine).all()
    assert (coarse < 1.2 * fine).all()
    assert keyframe_spacing(drive) == 1.0
    assert keyframe_spacing(replace(drive, t=drive.t * 3)) == pytest.approx(3.0, rel=0.01)
    assert keyframe_spacing(replace(drive, t=drive.t * 10)) == WIDEST_SPACING
    day = replace(drive, t=drive.t * 60)
    assert day.duration / keyframe_spacing(day) == pytest.approx(1440.0)


def test_samples_and_states_agree_for_any_sensor_positions(town_sigmas):
    drive = stop_and_go().cut_at(180.0, 10.0)
    drive = replace(drive, slope=0.03 * np.sin(drive.travel / 100.0))
    config = with_settings(town_sigmas.config, {
        'imu.lever_arm': (1.0, 0.4, 0.8), 'odometer.lever_arm': (-0.5, 0.7, -0.2),
        'gnss.lever_arm': (0.3, -0.6, 1.5)})
    sigmas = replace(town_sigmas, config=config, fix=0.02)
    one = ideal_samples(drive, sigmas, 1.0)
    problem = make_problem(one.leg, config, one.imu)
    parts = Equations(problem, one.state).factors
    # a turn starts within a sample of 0.05 s: 0.2 rad/s and 3 m/s^2 give 5 mrad and 4 cm/s at
    # most, in addition to the error of the 0.1 s steps of a planned drive
    assert np.abs(parts['fixes'].raw).max() < 0.03
    r = parts['motion'].raw
    assert np.abs(r[:, 3:6]).max() < 0.1        # velocity
    assert np.abs(r[:, 6:9]).max() < 0.01       # attitude
    assert np.median(np.abs(r[:, 15:18]), axis=0).max() < 1e-3      # path by odometer, m
    assert np.abs(r[:, 15:18]).max() < 0.03


def test_external_heading_improves_the_yaw_according_to_its_sigma(town_sigmas):
    drive = straight().cut_at(300.0, 30.0)

    def yaw(source, sigma):
        config = with_settings(town_sigmas.config, {
            'imu.grade': 'industrial', 'alignment.heading_source': source,
            'alignment.heading_sigma': sigma})
        return sigmas_of(predict_smoother(drive, replace(town_sigmas, config=config)))[1]

    alone = yaw('auto', 0.1)
    # two independent measurements of one angle: not better than the sum of their information
    both = 1 / math.hypot(1 / alone, 1 / math.radians(0.1))
    assert both * 0.999 <= yaw('fixed', math.radians(0.1)) < alone
    for source in ('heading_topic', 'imu_orientation'):
        # over the drive it also determines the gyro drift; its own error remains
        assert 0.9 * both <= yaw(source, math.radians(0.1)) < alone
        assert yaw(source, 1.0) == alone        # the smoother does not use such a large sigma
    assert yaw('fixed', 1.0) == pytest.approx(alone, rel=2e-3)
    assert yaw('course', 0.001) == alone == yaw('gyrocompass', 0.001)


def test_drive_that_the_smoother_rejects_is_rejected_in_the_prediction(town_sigmas):
    t = np.arange(0.0, 120.0, 0.1)
    even = drive_from_rates(t, np.full_like(t, 15.0), np.zeros_like(t))
    method = predict_smoother(even, town_sigmas)
    assert method.estimates['yaw_mounting_angle'].sigma is None
    reason = next(r for r in method.reasons if r.code is Code.YAW_NOT_DETERMINED)
    assert 'stops, starts and turns' in reason.remedy
    short = drive_from_rates(t[:150], np.full(150, 15.0), np.zeros(150))
    method = predict_smoother(short, town_sigmas)
    assert method.estimates['scale_factor'].sigma is None
    assert [r.code for r in method.reasons] == [Code.SCALE_NOT_DETERMINED]
    assert '74 fixes and ' in method.reasons[0].text


def test_more_slip_and_sideslip_increase_the_sigmas(town_sigmas):
    drive = stop_and_go()
    at = [sigmas_of(predict_smoother(drive, replace(town_sigmas, sway=sway, slip=slip)))
          for sway, slip in ((0.05, 0.01), (0.2, 0.01), (0.05, 0.05))]
    assert at[1][1] > 1.5 * at[0][1]       # the yaw sigma depends on the sideways noise
    assert at[1][0] < 1.2 * at[0][0]
    assert at[2][0] > 1.5 * at[0][0]       # the scale sigma depends on the slip
    budget = predict_smoother(drive, town_sigmas).details['budget']
    for i, name in enumerate(NAMES):
        assert math.sqrt(sum(row[name]**2 for row in budget.values())) == pytest.approx(
            at[0][i], rel=1e-6)
