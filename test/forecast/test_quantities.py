# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Quantities within their limits, observable quantities of a drive, and their texts."""

from dataclasses import replace
import math

import numpy as np
import pytest

pytest.importorskip('diagnostic_msgs', reason='no ROS here: pip install odocal_ros[ros]')

from odocal_ros.calib.result import Calibration, Estimate
from odocal_ros.data.samples import HeadingSamples
from odocal_ros.forecast import quantities
from odocal_ros.forecast.forecast import (
    combine_sections,
    Forecast,
    ParameterForecast,
    WheelsForecast,
)
from odocal_ros.forecast.quantities import find_observable, Received, stated_variance
from odocal_ros.live import answers
from odocal_ros.live.answers import hint, limit_checks, manoeuvres, seconds_to_stand, TURNS
from odocal_ros.live.publishing import level
from odocal_ros.live.session import RestoredResult, Session, SessionView
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
CONFIG = Config()
GOOD, BAD = ParameterForecast(1e-4, 1e-3, 0.0), ParameterForecast(2e-3, 1e-3, 300.0)
YAW, NO_YAW = ParameterForecast(0.005, 0.0087, 0.0), ParameterForecast(None, 0.0087, None, (),
                                                                       'not told')
NONE = {'heading_topic': math.inf, 'imu_orientation': math.inf}


def estimates(**sigmas):
    """Return estimates of value 1, one for each sigma; None: not determined."""
    return {name: Estimate(None if s is None else 1.0, s, '1') for name, s in sigmas.items()}


WHOLE = estimates(scale_factor=1e-4, yaw_mounting_angle=0.002, pitch_mounting_angle=0.003,
                  scale_factor_left=2e-4, scale_factor_right=3e-4, track_width=0.01)


def result(values=None, *codes):
    return Calibration(tuple(Reason(c, 'seen') for c in codes), values or WHOLE, {}, ())


def ok(judged, two_wheels=True, config=CONFIG):
    """Return yes, no or unknown of scale, yaw, pitch, left and right, track width."""
    of = quantities.check_forecast if isinstance(judged,
                                                 Forecast) else quantities.check_calibration
    return ' '.join(of(judged, config, two_wheels).values())


@pytest.mark.parametrize(('position', 'names'), list(enumerate((
    ('scale_factor',), ('yaw_mounting_angle',), ('pitch_mounting_angle',),
    ('scale_factor_left', 'scale_factor_right'), ('track_width',)))))
def test_each_limit_applies_to_its_own_quantity_only(position, names):
    for name in names:
        for worse in (Estimate(1.0, 0.06, '1'), Estimate(None, None, '1')):
            found = ok(result(WHOLE | {name: worse})).split()
            assert found.pop(position) == 'no'
            assert found == ['yes'] * 4


TIGHT = {'config': with_settings(CONFIG, {'verdict.max_scale_sigma': 9e-4})}
GIVEN = {'config': with_settings(CONFIG, {'odometer.track_width': 1.6})}
PPM_950 = WHOLE | {'scale_factor': Estimate(0.02, 1.9e-5, 'm/pulse')}
ONE = {name: WHOLE[name] for name in list(WHOLE)[:3]}
BARE = WHOLE | {'track_width': Estimate(None, None, 'm')}


@pytest.mark.parametrize(('judged', 'options', 'found'), [
    (result(), {}, 'yes yes yes yes yes'),
    (result(PPM_950), {}, 'yes yes yes yes yes'), (result(PPM_950), TIGHT, 'no yes yes yes yes'),
    # a reason applies to its value, or to all
    (result(None, Code.YAW_FAR_FROM_NOMINAL), {}, 'yes no yes yes yes'),
    (result(None, Code.COVARIANCE_UNKNOWN), {}, 'yes yes yes yes yes'),
    (result(None, Code.LEG_TOO_SHORT), {}, 'no no no no no'),
    # one counter does not determine two wheels
    (result(ONE), {'two_wheels': False}, 'yes yes yes unknown unknown'),
    (Forecast(GOOD, YAW, 0.001), {'two_wheels': False}, 'yes yes yes unknown unknown'),
    # a configured track width is not required from the drive
    (result(BARE), GIVEN, 'yes yes yes yes unknown'), (result(), GIVEN, 'yes yes yes yes yes'),
    (Forecast(GOOD, YAW, 0.001, WheelsForecast(1e-4, None)), GIVEN, 'yes yes yes yes unknown'),
    (Forecast(GOOD, YAW, 0.001, WheelsForecast(2e-4, 0.01)), {}, 'yes yes yes yes yes'),
    (Forecast(BAD, NO_YAW, None, WheelsForecast(None, None)), {}, 'no no no no no'),
    (Forecast(GOOD, YAW, 0.01, WheelsForecast(2e-3, 0.06)), {}, 'yes yes no no no'),
    (Forecast(GOOD, YAW, 0.001), {}, 'yes yes yes unknown unknown')])
def test_results_and_forecasts_are_compared_with_the_limits(judged, options, found):
    assert ok(judged, **options) == found


def test_each_quantity_of_a_leg_with_sections_is_from_the_better_one():
    begun = Forecast(BAD, NO_YAW, None, until_ns=2, estimates=estimates(scale_factor=None))
    done = Forecast(GOOD, NO_YAW, 0.002, until_ns=1, estimates=estimates(
        scale_factor=1e-4, yaw_mounting_angle=0.02))
    stated = combine_sections(done, begun)
    assert ok(stated) == 'yes no yes unknown unknown'
    assert stated.scale.remaining_m == 0.0            # within the limit
    assert {name: e.sigma for name, e in stated.estimates.items()} == {
        'scale_factor': 1e-4, 'yaw_mounting_angle': 0.02}
    assert stated.until_ns == 2
    # a finished section does not grow: the remaining distance is that of the current one
    coarse = Forecast(ParameterForecast(5e-3, 1e-3, 700.0), YAW, until_ns=3)
    assert combine_sections(begun, coarse).scale == replace(BAD, remaining_m=700.0)
    assert combine_sections(begun, coarse).yaw == YAW
    assert combine_sections(None, begun) is combine_sections(begun, None) is begun
    assert combine_sections(None, None) is None


def recording(**known):
    session = Session()
    session.start(1, CONFIG)
    return SessionView(session, CONFIG, **({'two_wheels': True} | known))


def test_quantities_are_from_the_forecast_or_result_of_the_state():
    now = recording(forecast=Forecast(GOOD, NO_YAW))
    assert limit_checks(now)['scale'] == 'yes'
    session = now.session
    session.stop(2)
    assert set(limit_checks(now).values()) == {'unknown'}
    session.finish(None, result())
    assert set(limit_checks(now).values()) == {'yes'}
    session.start(3, CONFIG)
    assert set(limit_checks(replace(now, forecast=None)).values()) == {'unknown'}
    session.cancel()
    assert set(limit_checks(now).values()) == {'yes'}
    fresh = SessionView(Session(), CONFIG)
    assert set(limit_checks(fresh).values()) == {'unknown'}
    fresh.session.restored_result = RestoredResult(WHOLE, 2, True, '2026-01-02T03:04:05Z')
    assert limit_checks(fresh)['scale'] == 'yes'
    fresh.session.restored_result = RestoredResult(WHOLE, 2, False, '2026-01-02T03:04:05Z')
    assert limit_checks(fresh)['scale'] == 'no'


# driving instructions

def test_two_wheels_require_turns_and_a_straight_section():
    far = {'distance_m': 500.0, 'max_speed': 10.0}
    assert manoeuvres(recording(**far)) == [TURNS]           # before the first update
    assert manoeuvres(recording(**far, two_wheels=False)) == []
    without_width = Forecast(GOOD, YAW, 0.001, WheelsForecast(2e-4, None))
    assert manoeuvres(recording(**far, forecast=without_width)) == [TURNS]
    neither = replace(without_width, wheels=WheelsForecast(2e-3, None))
    assert hint(recording(**far, forecast=neither, still_s=10.0)) == (
        'OK: scale 100 ppm (limit 1000); OK: yaw 0.286 deg (limit 0.5); drive straight at '
        'normal speed until left and right scale are separable; for the track width: turn by '
        '90 deg in total or more; call ~/stop_leg')
    both = replace(without_width, wheels=WheelsForecast(2e-4, 0.01))
    assert manoeuvres(recording(**far, forecast=both)) == []


def test_a_configured_width_or_the_mean_of_both_requires_no_turns():
    for settings in ({'odometer.track_width': 1.6}, {'method': 'two_point'}):
        session = Session()
        session.start(1, with_settings(CONFIG, settings))
        assert manoeuvres(SessionView(session, session.config, two_wheels=True,
                                      max_speed=10.0)) == []


def test_the_hint_states_first_that_a_leg_would_be_rejected():
    enough = Forecast(GOOD, YAW, 0.001)
    dead = (Reason(Code.WHEEL_DEAD, 'the left'),)
    now = recording(forecast=enough, distance_m=500.0, faults=dead,
                    missing_inputs=['no IMU for 3 s'])
    assert hint(now).startswith('call ~/cancel_leg and start again: the leg would be rejected: '
                                'WHEEL_DEAD: the left. Check the sensor')
    assert hint(now).endswith('; no IMU for 3 s')
    assert set(limit_checks(now).values()) == {'no', 'unknown'}
    assert (level(now), level(recording(forecast=enough))) == (b'\x02', b'\x00')
    # a caution does not require another drive: it is stated before the usual hint
    uncertainty = (Reason(Code.COUNTER_RESET, 'by -70'),)
    stated = hint(recording(forecast=enough, distance_m=500.0, max_speed=10.0, two_wheels=False,
                            faults=uncertainty))
    assert stated.startswith('COUNTER_RESET: by -70; OK: ')
    assert level(recording(faults=uncertainty)) == b'\x01'


def test_remaining_seconds_of_standstill_are_stated():
    assert seconds_to_stand(SessionView(Session(), CONFIG, still_s=3.0)) == 7.0
    assert seconds_to_stand(recording(still_s=12.0)) == 0.0
    now = recording(still_s=3.0)
    now.session.stop(2)
    assert seconds_to_stand(now) == 0.0


# what is observable as configured

@pytest.mark.parametrize(('settings', 'received', 'expected'), [
    ({}, {}, 'observable: the scale and the pitch; not observable: the yaw (the only heading is '
     'the course over ground, which includes it: set alignment.heading_source)'),
    ({'alignment.heading': 0.7, 'alignment.heading_sigma': 0.002}, {},
     'observable: the scale, the yaw (from the configured heading, 0.11 deg) and the pitch'),
    ({'alignment.heading': 0.7, 'alignment.heading_sigma': 0.02}, {'has_height': False},
     'observable: the scale; not observable: the yaw to 0.5 deg (the configured heading has an '
     'uncertainty of 1.1 deg); the pitch (fixes without height)'),
    ({}, {'variances': NONE | {'heading_topic': 0.001**2}},
     'observable: the scale, the yaw (from the heading topic, 0.057 deg) and the pitch'),
    ({'imu.grade': 'navigation'}, {'rest_s': 600.0},
     'observable: the scale, the yaw (from the gyrocompass, '),
    ({'alignment.heading': 0.7, 'alignment.heading_sigma': 0.002}, {'two_wheels': True},
     'observable: the scale, the yaw (from the configured heading, 0.11 deg), the pitch, left '
     'and right wheel and the track width (needs turns)'),
    ({'alignment.heading': 0.7, 'alignment.heading_sigma': 0.002, 'odometer.track_width': 1.6},
     {'two_wheels': True, 'rest_s': 1.0},
     'observable: the scale, the yaw (from the configured heading, 0.11 deg), the pitch and left '
     'and right wheel; level and gyro bias are estimated from the drive, because it starts '
     'without a standstill'),
    ({'method': 'two_point', 'alignment.heading': 0.7, 'alignment.heading_sigma': 0.002},
     {'two_wheels': True}, 'observable: the scale, the yaw (from the configured heading, 0.11 '
     'deg) and the pitch; not observable: left and right wheel separately (method two_point uses '
     'their mean)')])
def test_observable_quantities_are_stated_beforehand(monkeypatch, settings, received, expected):
    monkeypatch.setattr(quantities, 'METHODS', ('two_point',))
    known = Received(**({'variances': NONE, 'rest_s': 30.0} | received))
    text = find_observable(with_settings(CONFIG, settings), known).as_text()
    assert text.startswith(expected) if expected.endswith(', ') else text == expected


def test_the_smoother_needs_no_external_heading(monkeypatch):
    monkeypatch.setattr(quantities, 'METHODS', ('two_point', 'smoother'))
    found = find_observable(with_settings(CONFIG, {'method': 'smoother'}), Received(NONE, 30.0))
    assert 'the yaw (from stops, starts and turns)' in found.observable
    only = with_settings(CONFIG, {'method': 'two_point'})
    assert len(find_observable(only, Received(NONE, 30.0)).not_observable) == 1


def test_an_orientation_without_variance_or_unit_length_is_not_used():
    def sent(x, variance):
        """Return four orientations, of length x."""
        rows, q = np.arange(4), np.tile(np.multiply([0.0, 0.0, 0.0, 1.0], x), (4, 1))
        return HeadingSamples(rows, rows, q, np.array(variance))

    assert stated_variance(sent(1.0, [0.1, 0.3, 0.2, np.nan])) == pytest.approx(0.2)
    assert stated_variance(sent(0.0, [0.0] * 4)) == math.inf
    assert stated_variance(sent(1e200, [0.1] * 4)) == math.inf      # whose square overflows
    assert stated_variance(sent(1.0, [np.nan] * 4)) == math.inf


# service responses

def test_a_response_has_values_quantities_reasons_and_the_next_action():
    success, text = answers.result_answer(result(None, Code.YAW_FAR_FROM_NOMINAL), (), 0,
                                          'OK: scale; not OK: yaw', 'drive another leg')
    assert success
    assert text == (
        'caution: scale factor 1.00000 ± 0.00010, left 1.00000 ± 0.00020, right 1.00000 ± '
        '0.00030, track width 1.000 ± 0.010, yaw mounting +57.30 ± 0.11 deg, pitch mounting '
        '+57.30 ± 0.17 deg; 0 of 0 legs usable. OK: scale; not OK: yaw. YAW_FAR_FROM_NOMINAL: '
        'seen. Check imu.mounting_rpy, imu.nominal_yaw and the heading source. Next: drive '
        'another leg')
    remedy = Code.YAW_FAR_FROM_NOMINAL.remedy
    again = answers.result_answer(result(None, Code.YAW_FAR_FROM_NOMINAL), advice=remedy)[1]
    assert again.count(remedy) == 1


def test_a_restored_result_is_stated_as_restored():
    kept = RestoredResult(estimates(scale_factor=1e-4, yaw_mounting_angle=None), 2, True,
                    '2026-01-02T03:04:05Z')
    success, text = answers.restored_answer(kept, 'm/pulse', 'OK: scale')
    assert success
    assert text == (
        'no leg is running; restored result of 2026-01-02T03:04:05Z: scale factor 1.00000 ± '
        '0.00010 m/pulse (1.00000 ± 0.00010 pulses/m), yaw mounting not determined, pitch '
        'mounting not determined; from 2 legs. OK: scale. Next: drive a leg to update it')
    success, text = answers.restored_answer(replace(kept, is_valid=False), '', '')
    assert not success
    assert 'which was rejected' in text
