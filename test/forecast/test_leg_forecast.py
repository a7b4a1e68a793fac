# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Forecast of a leg during its recording: sigmas, distances and texts."""

from dataclasses import replace
import math

from drives import thinned
from forecast_drives import forecast_at, HEADING
import numpy as np
import pytest

from odocal_ros.calib.result import Estimate
from odocal_ros.errors import OdocalError
from odocal_ros.forecast import leg_forecast
from odocal_ros.forecast.forecast import Forecast, ParameterForecast, status_keys, UNREACHABLE_TEXT
from odocal_ros.forecast.leg_forecast import drive_on, forecast_leg, LegEnded
from odocal_ros.forecast.leg_so_far import find_thinned_faults, SmootherSoFar
from odocal_ros.forecast.planned_drive import PlannedDrive
from odocal_ros.live.answers import hint
from odocal_ros.live.session import Session, SessionView
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
SECOND = 10**9
GOOD = ParameterForecast(430e-6, 1e-3, 0.0, (('fix_end', 3e-4), ('fix_start', 2.5e-4)))
MORE = ParameterForecast(1820e-6, 1e-3, 231.0)
YAW = ParameterForecast(0.005, 0.0087, 0.0)
NO_YAW = ParameterForecast(None, 0.0087, None, (), 'limited by the heading uncertainty (1 deg)')


def test_forecast_at_the_end_of_a_leg_agrees_with_the_result(drive, config):
    leg = drive.leg()
    result = calibrate(leg, config).methods['two_point'].estimates
    forecast = forecast_at(drive, config, (leg.stop_ns - leg.start_ns) / SECOND)
    scale, yaw = result['scale_factor'], result['yaw_mounting_angle']
    # the rough scale is good to a per cent, and the fix sigma there scatters by 5 % from residuals
    assert forecast.scale.sigma == pytest.approx(scale.sigma / scale.value, rel=0.1)
    assert forecast.yaw.sigma == pytest.approx(yaw.sigma, rel=0.05)
    assert forecast.yaw.sources[0] == ('initial_heading', pytest.approx(HEADING))
    assert {name for name, _ in forecast.scale.sources} >= {'fix_start', 'fix_end'}


def test_forecast_distance_agrees_with_the_distance_required(drive, config):
    t_now = 100.0
    first = forecast_at(drive, config, t_now)
    required = first.scale.sigma / 1.6
    strict = with_settings(config, {'verdict.max_scale_sigma': required})
    metres = forecast_at(drive, strict, t_now).scale.remaining_m
    speed = drive.truth.distance / 240.0            # driven in about the middle 240 s
    later = [forecast_at(drive, strict, t_now + share * metres / speed) for share in (0.5, 1.5)]
    assert later[0].scale.remaining_m > 0 < metres
    assert later[0].scale.sigma > required
    assert (later[1].scale.remaining_m, later[1].scale.sigma <= required) == (0.0, True)
    assert later[0].scale.remaining_m < 0.8 * metres


def test_yaw_is_not_reached_below_the_heading_sigma_or_from_course_alone(drive, config):
    required = with_settings(config, {'verdict.max_yaw_sigma': 0.9 * HEADING})
    yaw = forecast_at(drive, required, 150.0).yaw
    assert yaw.remaining_m is None
    assert yaw.as_text('yaw', 'deg', math.degrees(1)) == (
        'yaw: limited by the heading uncertainty (0.17 deg)')
    course = with_settings(config, {'alignment.heading_source': 'course'})
    yaw = forecast_at(drive, course, 150.0).yaw
    assert (yaw.sigma, yaw.remaining_m) == (None, None)
    assert 'not separable from the course over ground' in yaw.limitation


def test_yaw_is_not_excluded_by_end_points_before_a_smoother_result(drive):
    """10 s after a mark in motion; after another 15 s of such driving the smoother gives it."""
    cells = thinned(drive.leg(), 110.0, 98.0)
    config = with_settings(Config(), {'odometer.nominal_scale': drive.truth.scale})
    leg = cells.leg(drive.leg().start_ns + 100 * SECOND)
    found = forecast_leg(leg, cells.fix_rate(), config, smoother=SmootherSoFar())
    assert found.methods == {}
    assert 'yaw is not determined yet' in found.as_text()
    assert found.manoeuvres == ['drive on with stops, starts and turns']
    assert not found.is_complete
    still = replace(leg, imu=replace(leg.imu, f_i=np.zeros_like(leg.imu.f_i)))    # never
    never = forecast_leg(still, cells.fix_rate(), config, smoother=SmootherSoFar())
    assert 'yaw: not separable from the course over ground' in never.as_text()


def test_forecast_uses_a_received_orientation_as_the_heading(drive, config):
    auto = with_settings(config, {'alignment.heading_source': 'auto',
                                  'alignment.heading': math.nan})
    cells = thinned(drive.leg(), 150.0)
    leg = cells.leg(drive.leg().start_ns)
    n = len(leg.imu.stamp_ns)
    oriented = replace(leg, imu=replace(leg.imu, yaw_variance=np.full(n, 0.004**2),
                                        q_ni=np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))))
    forecast = forecast_leg(oriented, cells.fix_rate(), auto)
    assert forecast.yaw.sources[0] == ('initial_heading', pytest.approx(0.004))


def test_no_forecast_is_made_at_rest_or_before_a_scale_is_known(drive, config):
    with pytest.raises(OdocalError):
        forecast_at(drive, config, -5.0)
    with pytest.raises(OdocalError, match='not known yet'):
        forecast_at(drive, config, 6.0)
    known = with_settings(config, {'odometer.nominal_scale': drive.truth.scale})
    assert forecast_at(drive, known, 6.0).scale.sigma > 0.01    # 0.3 m fixes 10 m apart


def test_a_drive_is_lengthened_at_its_own_speed_and_heading():
    t = np.arange(0.0, 61.0)
    speed = np.where((t < 10) | (t > 50), 0.0, 8.0)
    bend = np.where(t > 30, np.pi / 2, 0.0)
    drive = PlannedDrive(t, speed, bend, np.zeros(61))
    more = drive_on(drive, 400.0)
    assert more.distance - drive.distance == pytest.approx(400.0)
    assert more.duration - drive.duration == pytest.approx(50.0)
    assert more.standstills(2.0)[-1] == pytest.approx((101.0, 110.0))
    onward = (more.t > 50.0) & (more.t < 100.0)
    assert more.yaw[onward] == pytest.approx(np.pi / 2)


def test_a_prediction_uses_few_rows_and_keeps_the_stops(drive, config, monkeypatch):
    seen = []

    def counted(planned, sigmas):
        seen.append(planned)
        return predict(planned, sigmas)

    predict = leg_forecast.predict
    monkeypatch.setattr(leg_forecast, 'predict', counted)
    monkeypatch.setattr(leg_forecast, 'DRIVE_ROWS', 100)
    sparse = forecast_at(drive, config, 270.0)
    assert len(seen[0].t) <= 100 + 2 * 100      # a standstill of 10 s is added in steps of 0.1 s
    monkeypatch.setattr(leg_forecast, 'DRIVE_ROWS', 100_000)
    dense = forecast_at(drive, config, 270.0)
    assert len(seen[-1].t) > 10 * len(seen[0].t)
    assert seen[0].standstills(2.0) == seen[-1].standstills(2.0)
    assert sparse.scale.sigma == pytest.approx(dense.scale.sigma, rel=0.02)
    assert sparse.yaw.sigma == pytest.approx(dense.yaw.sigma, rel=0.02)


def test_an_update_stops_at_its_next_step_after_the_end_of_the_leg(drive, config):
    strict, required = with_settings(config, {'verdict.max_scale_sigma': 1e-9}), []

    def is_needed():
        required.append(True)
        return len(required) < 3

    with pytest.raises(LegEnded):
        forecast_at(drive, strict, 150.0, is_needed=is_needed)
    assert len(required) == 3


@pytest.fixture(scope='module')
def two():
    return simulate(SimOptions(scenario='town', duration=240.0, two_wheels=True, imu_rate=50.0,
                               seed=4, imu_grade='tactical'))


def smoother_forecast_at(made, t_stop, **settings):
    config = with_settings(Config(), {'imu.grade': made.options.imu_grade} | settings)
    return forecast_at(made, config, t_stop, smoother=SmootherSoFar())


@pytest.fixture(scope='module')
def found(two):
    """Return the estimates of the smoother; method wheels is an alias of it."""
    return calibrate(two.leg(), with_settings(Config(), {
        'method': 'smoother', 'imu.grade': 'tactical'})).methods['smoother'].estimates


@pytest.mark.parametrize('method', ['smoother', 'auto', 'wheels'])
def test_forecast_of_two_wheels_agrees_with_the_result(two, found, method):
    whole = two.leg()
    forecast = smoother_forecast_at(two, (whole.stop_ns - whole.start_ns) / SECOND, method=method)
    left, right, width = (found[name] for name in (
        'scale_factor_left', 'scale_factor_right', 'track_width'))
    # the thinned leg has a tenth of the rows, whose noise is estimated again
    assert forecast.wheels.left_right == pytest.approx(
        max(e.sigma / e.value for e in (left, right)), rel=0.25)
    assert forecast.wheels.track_width == pytest.approx(width.sigma / width.value, rel=0.5)
    assert forecast.estimates['scale_factor_left'].value == pytest.approx(
        left.value, abs=left.sigma)


def test_two_point_and_a_single_counter_give_no_forecast_of_wheels(two, drive):
    assert smoother_forecast_at(two, 100.0, method='two_point').wheels is None
    assert smoother_forecast_at(drive, 100.0, method='smoother').wheels is None


@pytest.mark.parametrize('method', ['smoother', 'auto'])
def test_without_an_accelerometer_the_forecast_has_a_scale_and_no_angle(two, method):
    still = replace(two, imu=replace(two.imu, f_i=np.zeros_like(two.imu.f_i)))
    forecast = smoother_forecast_at(still, 200.0, method=method)
    assert 0.0 < forecast.scale.sigma < 0.01
    assert forecast.wheels.left_right < 0.01
    assert (forecast.yaw.sigma, forecast.pitch) == (None, None)
    assert forecast.yaw.limitation
    assert not any(forecast.estimates[name].value for name in (
        'yaw_mounting_angle', 'pitch_mounting_angle'))


def test_swapped_wheels_are_reported_during_the_recording(two):
    leg = two.leg()
    swapped = replace(leg, odometer=leg.odometer_right, odometer_right=leg.odometer)
    found = find_thinned_faults(swapped, with_settings(Config(), {
        'odometer.track_width': 1.6, 'imu.grade': 'tactical'}))
    assert found[0].code is Code.WHEELS_SWAPPED
    assert 'Swap odometer.left' in found[0].remedy


def test_a_large_scale_sigma_is_printed_in_per_cent():
    assert ParameterForecast(0.138, 1e-3, 2108.0, value_text='1.02').as_text('scale', 'ppm',
                                                                             1e6) == (
        'scale 1.02 ± 13.8 % so far; drive 2200 m more to reach the limit of 0.1 %')
    assert ParameterForecast(0.0099, 1e-3, 0.0).as_text('scale', 'ppm', 1e6) == (
        'OK: scale 9900 ppm (limit 1000)')


def hint_text(forecast, **more):
    session = Session()
    session.start(1, Config())
    known = {'distance_m': 300.0, 'max_speed': 10.0, 'forecast': forecast}
    return hint(SessionView(session, Config(), **known | more))


@pytest.mark.parametrize(('forecast', 'still_s', 'text'), [
    (None, 0.0, 'stand still 10 s at the end point, then call ~/stop_leg'),
    (None, 5.0, 'stand still 5 s more, then call ~/stop_leg'),
    (None, 10.0, 'call ~/stop_leg'),
    (Forecast(MORE, YAW, distance_m=300.0), 5.0,
     'scale uncertainty so far: 1820 ppm; drive 240 m more to reach the limit of '
     '1000 ppm; OK: yaw 0.286 deg (limit 0.5)'),
    (Forecast(GOOD, YAW), 10.0, 'OK: scale 430 ppm (limit 1000); OK: yaw 0.286 deg (limit '
     '0.5); call ~/stop_leg'),
    (Forecast(GOOD, NO_YAW), 0.0, 'OK: scale 430 ppm (limit 1000); yaw: limited by the heading '
     'uncertainty (1 deg); stand still 10 s at the end point, then call ~/stop_leg'),
    (Forecast(replace(MORE, remaining_m=None, limitation=UNREACHABLE_TEXT), YAW), 10.0,
     'scale 1820 ppm: the limit is not reached within another 20 km; OK: yaw 0.286 deg (limit '
     '0.5); call ~/stop_leg'),
    (Forecast(replace(MORE, sigma=None), NO_YAW, distance_m=300.0), 0.0,
     'scale is not determined yet; drive 240 m more to reach the limit of 1000 ppm; yaw: '
     'limited by the heading uncertainty (1 deg)')])
def test_the_hint_states_which_values_are_ok_and_what_is_missing(forecast, still_s, text):
    assert hint_text(forecast, still_s=still_s) == text


def test_the_hint_states_the_minimum_leg_first_and_then_the_remaining_distance():
    assert hint_text(Forecast(GOOD, YAW), distance_m=60.0, max_speed=1.0) == (
        'drive 40 m more, faster than leg.min_speed, 2.78 m/s (10 km/h); then drive on, with '
        'stops and left and right turns, until this hint shows OK for scale and yaw')
    forecast = Forecast(MORE, YAW, distance_m=300.0)
    assert 'drive 140 m more' in hint_text(forecast, distance_m=400.0)
    assert 'drive on to reach the limit of 1000 ppm' in hint_text(forecast, distance_m=600.0)


def test_status_keys_are_numbers_and_empty_without_a_forecast():
    keys = status_keys(Forecast(GOOD, NO_YAW))
    running = {key: keys.pop(key) for key in list(keys) if key.startswith('estimate_')}
    assert running.pop('estimate_method') == ''
    assert len(running) == 7
    assert all(math.isnan(value) for value in running.values())
    assert keys == {
        'predicted_scale_sigma_ppm': pytest.approx(430.0), 'metres_to_go_scale': 0.0,
        'largest_error_source_scale': 'fix_end',
        'predicted_scale_sources_ppm': 'fix_end 300, fix_start 250',
        'predicted_yaw_sigma_deg': '', 'metres_to_go_yaw': '', 'largest_error_source_yaw': '',
        'predicted_yaw_sources_deg': ''}
    none = status_keys(None)
    assert set(none) == set(keys) | set(running) | {'estimate_method'}
    assert {none[key] for key in keys} == {''}
    found = status_keys(Forecast(GOOD, YAW, estimates={
        'scale_factor': Estimate(0.02, 1e-5, 'm/pulse', 'smoother'),
        'yaw_mounting_angle': Estimate(0.01, 1e-3, 'rad', 'two_point'),
        'pitch_mounting_angle': Estimate(None, None, 'rad', 'smoother')}), 7.5)
    assert [found[f'estimate_{name}'] for name in (
        'scale_factor', 'scale_factor_sigma', 'yaw_mounting_angle_rad',
        'yaw_mounting_angle_sigma_rad', 'method', 'age_s')] == [
            0.02, 1e-5, 0.01, 1e-3, 'smoother, two_point', 7.5]
    assert all(math.isnan(found[f'estimate_pitch_mounting_angle{end}_rad'])
               for end in ('', '_sigma'))


def test_an_estimate_with_a_stamp_in_the_future_has_no_age():
    forecast = Forecast(GOOD, GOOD, until_ns=1_750_000_671_800_000_000)
    assert forecast.age_s(forecast.until_ns + 2_500_000_000) == pytest.approx(2.5)
    # wrong stamps, or none: the status contained -1750000671.8 s
    for stamp_ns in (0, forecast.until_ns - 1):
        assert math.isnan(forecast.age_s(stamp_ns))
