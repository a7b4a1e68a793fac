# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The running estimate during the recording: times of its updates, their cost, and errors."""

import time
from types import SimpleNamespace

from forecast_drives import forecast_at
import pytest

from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import take
from odocal_ros.forecast.forecast import Forecast, ParameterForecast
from odocal_ros.forecast.leg_so_far import SmootherSoFar
from odocal_ros.live import running_estimate
from odocal_ros.live.running_estimate import RunningEstimate, UPDATE_PERIOD_NS, UpdateResult
from odocal_ros.live.worker import Worker

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
