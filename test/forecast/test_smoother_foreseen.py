# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the running estimate of the smoother makes foreseen: sigmas, metres, stops and words."""

from dataclasses import replace
import math

from foreseeing import fit_updates
import numpy as np
import pytest

from odocal_ros.calib.result import Estimate
from odocal_ros.errors import OdocalError
from odocal_ros.forecast.forecast import Forecast, ParameterForecast
from odocal_ros.forecast.leg_forecast import forecast_leg
from odocal_ros.forecast.leg_so_far import SmootherSoFar
from odocal_ros.forecast.smoother_forecast import add_running_estimate, update_running
from odocal_ros.live.answers import hint
from odocal_ros.live.session import Session, SessionView
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.slow


def forecast_at(seen, config, **settings):
    return forecast_leg(seen.leg, 5.0, with_settings(config, settings), smoother=SmootherSoFar())


def test_the_sigma_that_counts_is_of_the_method_that_will_give(exact, updates):
    found = forecast_at(updates[-1], exact, method='auto')
    e = found.methods['smoother'].estimates
    assert found.estimates['scale_factor'] == replace(e['scale_factor'], method='smoother')
    assert found.scale.sigma == pytest.approx(e['scale_factor'].sigma / e['scale_factor'].value)
    assert found.yaw.sigma == pytest.approx(e['yaw_mounting_angle'].sigma)
    assert found.pitch == pytest.approx(e['pitch_mounting_angle'].sigma)
    assert (found.scale.remaining_m, found.yaw.remaining_m, found.complete) == (0.0, 0.0, True)
    assert found.until_ns == updates[-1].leg.stop_ns
    ends = forecast_at(updates[-1], exact, method='two_point')
    assert ends.estimates == {}
    assert ends.scale.sigma > 3 * found.scale.sigma


def test_before_the_smoother_can_say_anything_the_end_points_are_foreseen(exact, updates):
    class Silent:
        def update(self, *_):
            raise OdocalError('too little')

    leg = updates[0].leg
    assert update_running(leg, Config(), Silent(), lambda: True) is None
    assert forecast_leg(leg, 5.0, Config(), smoother=Silent()).scale.sources[0][0] == 'fix_end'
    with pytest.raises(OdocalError, match='too little'):
        update_running(leg, with_settings(Config(), {'method': 'smoother'}), Silent(),
                       lambda: True)


@pytest.mark.parametrize('method', ['smoother', 'auto'])
def test_what_the_leg_will_be_rejected_for_is_said_at_once(exact, updates, method):
    leg = updates[-1].leg
    backwards = replace(leg, odometer=replace(leg.odometer, value=-leg.odometer.value))
    required = with_settings(exact, {'method': method})
    found = forecast_leg(backwards, 5.0, required, smoother=SmootherSoFar())
    fault = found.faults[0]
    assert (fault.code, fault.text[:41]) == (Code.ODOMETER_REVERSED,
                                             'odometer and IMU have opposite directions')
    assert found.estimates.get('scale_factor') is None      # no value that would be thrown away
    session = Session()
    session.start(1, required)
    stated = hint(SessionView(session, required, forecast=found, faults=found.faults,
                              distance_m=900.0,
                              max_speed=10.0))
    assert 'the leg would be rejected: ODOMETER_REVERSED' in stated
    assert forecast_leg(leg, 5.0, required, smoother=SmootherSoFar()).faults == ()


def test_the_metres_and_the_stops_foreseen_are_about_those_it_takes(town_drive, exact):
    white = with_settings(exact, {'gnss.correlation_time': 0.0})
    early, late = (seen.running for seen in fit_updates(town_drive, white, (95.0, 240.0)))
    assert late.distance > 1.6 * early.distance
    assert late.agility > 1.5 * early.agility
    # what was to be driven for the sigmas that came out, and what was driven
    before = Forecast(*(ParameterForecast(None, float(sigma), None) for sigma in late.sigmas[:2]))
    found = add_running_estimate(before, early, exact)
    # a law of one power stands for what starts, stops and turns make of it
    assert found.scale.remaining_m == pytest.approx(late.distance - early.distance, rel=0.4)
    assert 'stop and start' in found.yaw.manoeuvre
    assert late.agility / early.agility == pytest.approx(
        (early.sigmas[1] / late.sigmas[1])**2, rel=0.5)


def of_sigmas(seen, scale=1e-4, yaw=1e-3, agility=120.0, known=True):
    """Return an forecast made of a running estimate with other figures."""
    method = seen.running.method
    found = dict(method.estimates)
    if not known:
        found['yaw_mounting_angle'] = Estimate(None, None, 'rad')
    running = replace(seen.running, method=replace(method, estimates=found), agility=agility,
                      sigmas=np.array([scale, yaw, 1e-3]), speed=10.0, distance=500.0)
    before = Forecast(ParameterForecast(0.1, 1e-3, 500.0),
                      ParameterForecast(None, 0.01, None, (), 'not told'))
    return add_running_estimate(before, running, Config())


def test_the_yaw_asks_for_stops_and_starts_until_it_is_there(updates):
    # agility 120 by a sigma twice the asked: three times as much more, 30 for each stop and start
    found = of_sigmas(updates[-1], yaw=0.02)
    assert found.yaw.manoeuvre == 'for the yaw: stop and start 12 times, or make as many turns'
    assert found.yaw.remaining_m == pytest.approx(1500.0)
    assert found.yaw.as_text('yaw', 'deg', math.degrees(1)).endswith(
        ' ± 1.15 deg so far (limit 0.57)')
    assert not found.complete
    assert of_sigmas(updates[-1],
                     yaw=0.0105).yaw.manoeuvre.startswith('for the yaw: stop and start 1 ')
    assert of_sigmas(updates[-1],
                     yaw=0.2).yaw.manoeuvre.startswith('for the yaw: stop and start often,')
    assert of_sigmas(updates[-1], yaw=0.2).yaw.remaining_m is None
    never = of_sigmas(updates[-1], yaw=0.05, agility=0.0, known=False)
    assert never.yaw.as_text('yaw', 'deg', math.degrees(1)) == (
        'yaw is not determined yet (2.86 deg)')
    good = of_sigmas(updates[-1], yaw=0.009)
    assert (good.yaw.manoeuvre, good.yaw.remaining_m, good.complete) == ('', 0.0, True)


def test_the_hint_tells_the_value_what_is_lacking_and_how_old_it_is(updates):
    session = Session()
    session.start(1, Config())
    known = {'distance_m': 300.0, 'max_speed': 10.0}
    far = replace(of_sigmas(updates[-1], scale=2e-3, yaw=0.02), distance_m=300.0)
    text = hint(SessionView(session, Config(), forecast=far, forecast_age_s=6.0, **known))
    # twice the asked sigma: 500 m more by white errors, 1500 m by slow ones, here some of both
    assert (' m/pulse ± 2000 ppm so far; drive 710 m more to reach the limit of 1000 ppm; yaw '
            in text)
    assert text.endswith('; for the yaw: stop and start 12 times, or make as many turns')
    stated = hint(SessionView(session, Config(), forecast=far, forecast_age_s=40.0, **known))
    assert '; estimate is 40 s old; ' in stated
    good = hint(SessionView(session, Config(), forecast=of_sigmas(updates[-1]), **known))
    assert good.startswith('OK: scale 0.02')
    assert good.endswith('stand still 10 s at the end point, then call ~/stop_leg')
