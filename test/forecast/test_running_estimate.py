# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The running estimate of the smoother: its times, cost and errors, and the forecast from it."""

from dataclasses import replace
import math
import time
from types import SimpleNamespace

from forecast_drives import fit_updates, forecast_at
import numpy as np
import pytest

from odocal_ros.calib.result import Estimate
from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import take
from odocal_ros.errors import OdocalError
from odocal_ros.forecast.forecast import Forecast, ParameterForecast
from odocal_ros.forecast.leg_forecast import forecast_leg
from odocal_ros.forecast.leg_so_far import SmootherSoFar
from odocal_ros.forecast.smoother_forecast import add_running_estimate, update_running
from odocal_ros.live import running_estimate
from odocal_ros.live.answers import hint
from odocal_ros.live.running_estimate import RunningEstimate, UPDATE_PERIOD_NS, UpdateResult
from odocal_ros.live.session import Session, SessionView
from odocal_ros.live.worker import Worker
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.slow
SECOND = 10**9


class Log:
    def __init__(self):
        self.lines = []

    def debug(self, text):
        self.lines.append(text)


def watched(drive, config, worker, log):
    leg = drive.leg()
    recorder, estimate = LegRecorder(), RunningEstimate(worker, log)
    recorder.form = leg.form
    half = leg.start_ns + 150 * SECOND
    for slot in ('imu', 'odometer', 'fix'):
        rows = leg.rows(slot)
        recorder.feed(slot, take(rows, rows.stamp_ns <= leg.start_ns))
    estimate.begin(recorder, leg.start_ns, config)
    for slot in ('imu', 'odometer', 'fix'):
        rows = leg.rows(slot)
        for first_ns in range(leg.start_ns, half, 10 * SECOND):
            estimate.feed(slot, take(rows, (rows.stamp_ns > first_ns)
                                     & (rows.stamp_ns <= first_ns + 10 * SECOND)))
    return estimate, half


def finished(worker):
    done = []
    worker.submit(lambda: None, lambda *_: done.append(True))
    deadline = time.monotonic() + 20.0
    while not done and time.monotonic() < deadline:
        time.sleep(0.001)       # a loop without sleep blocks the worker by the interpreter lock
        worker.poll()
    assert done


@pytest.fixture
def worker():
    one = Worker()
    yield one
    one.close()


def test_the_running_estimate_equals_the_forecast_of_its_thinned_leg(drive, config, worker):
    log = Log()
    estimate, now_ns = watched(drive, config, worker, log)
    estimate.update(drive.leg().start_ns + UPDATE_PERIOD_NS - 1)
    finished(worker)
    assert estimate.forecast is None                      # too early
    estimate.update(now_ns)
    finished(worker)
    expected = forecast_at(drive, config, 150.0, smoother=SmootherSoFar())
    assert log.lines == []
    assert estimate.forecast.scale.sigma == pytest.approx(expected.scale.sigma)
    assert estimate.forecast.yaw.sigma == pytest.approx(expected.yaw.sigma)


def test_an_error_in_an_update_is_only_logged(drive, config, worker, monkeypatch):
    def fail(*_):
        raise ValueError('a bug')

    monkeypatch.setattr(running_estimate, 'forecast_leg', fail)
    log = Log()
    estimate, now_ns = watched(drive, config, worker, log)
    estimate.update(now_ns)
    finished(worker)
    assert estimate.forecast is None
    line, = log.lines
    assert 'a bug' in line
    monkeypatch.undo()
    estimate.update(now_ns + UPDATE_PERIOD_NS)
    finished(worker)
    assert estimate.forecast is not None


def test_a_leg_that_ends_during_an_update_has_no_forecast(drive, config, worker):
    log = Log()
    estimate, now_ns = watched(drive, config, worker, log)
    estimate.update(now_ns)
    estimate.end()
    finished(worker)
    assert (estimate.forecast, log.lines) == (None, [])
    estimate.update(now_ns + UPDATE_PERIOD_NS)
    finished(worker)
    assert estimate.forecast is None


def test_updates_take_a_small_share_of_a_core(drive, config, worker, monkeypatch):
    updates, good = [], ParameterForecast(430e-6, 1e-3, 0.0)

    def costly_update(*args):
        updates.append(1)
        return UpdateResult(Forecast(good, good), cpu_time_s=1.0)

    monkeypatch.setattr(running_estimate, '_compute_update', costly_update)
    clock = SimpleNamespace(now=100.0, monotonic=lambda: clock.now)
    monkeypatch.setattr(running_estimate, 'time', clock)
    estimate, now_ns = watched(drive, config, worker, Log())
    for _ in range(320):
        clock.now += 1.0
        now_ns += UPDATE_PERIOD_NS
        estimate.update(now_ns)
        finished(worker)
    # the first includes imports and does not count, the others are 60 s apart: 1, 2, 62, ... 302 s
    assert len(updates) == 7


def forecast_from(seen, config, **settings):
    return forecast_leg(seen.leg, 5.0, with_settings(config, settings), smoother=SmootherSoFar())


def test_sigmas_are_of_the_method_that_gives_the_result(exact, updates):
    found = forecast_from(updates[-1], exact, method='auto')
    e = found.methods['smoother'].estimates
    assert found.estimates['scale_factor'] == replace(e['scale_factor'], method='smoother')
    assert found.scale.sigma == pytest.approx(e['scale_factor'].sigma / e['scale_factor'].value)
    assert found.yaw.sigma == pytest.approx(e['yaw_mounting_angle'].sigma)
    assert found.pitch == pytest.approx(e['pitch_mounting_angle'].sigma)
    assert (found.scale.remaining_m, found.yaw.remaining_m, found.is_complete) == (0.0, 0.0, True)
    assert found.until_ns == updates[-1].leg.stop_ns
    ends = forecast_from(updates[-1], exact, method='two_point')
    assert ends.estimates == {}
    assert ends.scale.sigma > 3 * found.scale.sigma


def test_before_the_first_smoother_estimate_the_forecast_is_of_two_point(exact, updates):
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
def test_a_fault_that_rejects_the_leg_is_reported_at_once(exact, updates, method):
    leg = updates[-1].leg
    backwards = replace(leg, odometer=replace(leg.odometer, value=-leg.odometer.value))
    required = with_settings(exact, {'method': method})
    found = forecast_leg(backwards, 5.0, required, smoother=SmootherSoFar())
    fault = found.faults[0]
    assert (fault.code, fault.text[:41]) == (Code.ODOMETER_REVERSED,
                                             'odometer and IMU have opposite directions')
    assert found.estimates.get('scale_factor') is None      # no value of a leg that is rejected
    session = Session()
    session.start(1, required)
    stated = hint(SessionView(session, required, forecast=found, faults=found.faults,
                              distance_m=900.0, max_speed=10.0))
    assert 'the leg would be rejected: ODOMETER_REVERSED' in stated
    assert forecast_leg(leg, 5.0, required, smoother=SmootherSoFar()).faults == ()


def test_forecast_distance_and_stops_are_near_those_required(town_drive, exact):
    white = with_settings(exact, {'gnss.correlation_time': 0.0})
    early, late = (seen.running for seen in fit_updates(town_drive, white, (95.0, 240.0)))
    assert late.distance > 1.6 * early.distance
    assert late.agility > 1.5 * early.agility
    # distance predicted for the resulting sigmas, and the driven one
    before = Forecast(*(ParameterForecast(None, float(sigma), None) for sigma in late.sigmas[:2]))
    found = add_running_estimate(before, early, exact)
    # one power law approximates the effect of starts, stops and turns
    assert found.scale.remaining_m == pytest.approx(late.distance - early.distance, rel=0.4)
    assert 'stop and start' in found.yaw.manoeuvre
    assert late.agility / early.agility == pytest.approx(
        (early.sigmas[1] / late.sigmas[1])**2, rel=0.5)


def of_sigmas(seen, scale=1e-4, yaw=1e-3, agility=120.0, known=True, limit=None):
    """Return a forecast from a running estimate with other sigmas."""
    method = seen.running.method
    found = dict(method.estimates)
    if not known:
        found['yaw_mounting_angle'] = Estimate(None, None, 'rad')
    running = replace(seen.running, method=replace(method, estimates=found), agility=agility,
                      sigmas=np.array([scale, yaw, 1e-3]), speed=10.0, distance=500.0)
    before = Forecast(ParameterForecast(0.1, 1e-3 if limit is None else limit, 500.0),
                      ParameterForecast(None, 0.01 if limit is None else limit, None, (), ''))
    return add_running_estimate(before, running, Config())


def test_the_yaw_requires_stops_and_starts_until_it_is_within_the_limit(updates):
    # agility 120 at a sigma of twice the limit: three times as much more, 30 per stop and start
    found = of_sigmas(updates[-1], yaw=0.02)
    assert found.yaw.manoeuvre == 'for the yaw: stop and start 12 times, or make as many turns'
    assert found.yaw.remaining_m == pytest.approx(1500.0)
    assert found.yaw.as_text('yaw', 'deg', math.degrees(1)).endswith(
        ' ± 1.15 deg so far (limit 0.57)')
    assert not found.is_complete
    assert of_sigmas(updates[-1],
                     yaw=0.0105).yaw.manoeuvre.startswith('for the yaw: stop and start 1 ')
    assert of_sigmas(updates[-1],
                     yaw=0.2).yaw.manoeuvre.startswith('for the yaw: stop and start often,')
    assert of_sigmas(updates[-1], yaw=0.2).yaw.remaining_m is None
    never = of_sigmas(updates[-1], yaw=0.05, agility=0.0, known=False)
    assert never.yaw.as_text('yaw', 'deg', math.degrees(1)) == (
        'yaw is not determined yet (2.86 deg)')
    good = of_sigmas(updates[-1], yaw=0.009)
    assert (good.yaw.manoeuvre, good.yaw.remaining_m, good.is_complete) == ('', 0.0, True)


def test_a_limit_of_zero_is_never_reached(updates):
    found = of_sigmas(updates[-1], limit=0.0)
    assert found.scale.remaining_m is None
    assert found.yaw.remaining_m is None
    assert found.yaw.manoeuvre == 'for the yaw: stop and start often, or make as many turns'


def test_the_hint_states_the_value_what_is_missing_and_its_age(updates):
    session = Session()
    session.start(1, Config())
    known = {'distance_m': 300.0, 'max_speed': 10.0}
    far = replace(of_sigmas(updates[-1], scale=2e-3, yaw=0.02), distance_m=300.0)
    text = hint(SessionView(session, Config(), forecast=far, forecast_age_s=6.0, **known))
    # twice the limit: 500 m more for white errors, 1500 m for slow ones, here some of both
    assert (' m/pulse ± 2000 ppm so far; drive 670 m more to reach the limit of 1000 ppm; yaw '
            in text)
    assert text.endswith('; for the yaw: stop and start 12 times, or make as many turns')
    stated = hint(SessionView(session, Config(), forecast=far, forecast_age_s=40.0, **known))
    assert '; estimate is 40 s old; ' in stated
    good = hint(SessionView(session, Config(), forecast=of_sigmas(updates[-1]), **known))
    assert good.startswith('OK: scale 0.02')
    assert good.endswith('stand still 10 s at the end point, then call ~/stop_leg')
