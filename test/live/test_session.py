# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The session of the operator: every command in every state."""

from dataclasses import replace
import json
from types import SimpleNamespace

from drives import drive, settings
import pytest

from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.live import worker
from odocal_ros.live.session import CommandRefused, LEGS_WITH_TRACKS, Session, State
from odocal_ros.output.files import as_json
from odocal_ros.output.program_files import geojson
from odocal_ros.output.report import report_html
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config

pytestmark = pytest.mark.core
CONFIG = Config()


def result(start_ns=1, stop_ns=2):
    return LegResult(start_ns=start_ns, stop_ns=stop_ns, distance=1.0, duration=1.0,
                     imu_samples=0, pulses=0, fixes=0, rejected_fixes=0, reasons=(), methods={})


def calibration(*codes):
    return Calibration(tuple(Reason(c, 'seen') for c in codes), {}, {}, ())


def drive_leg(session, start_ns, *codes, is_automatic=False):
    session.start(start_ns, CONFIG, is_automatic)
    session.stop(start_ns + 4)
    session.finish(result(), calibration(*codes))


def with_legs(count):
    session = Session()
    for leg in range(count):
        drive_leg(session, 10 * leg + 1)
    return session


def test_a_leg_is_recorded_and_computed_between_two_marks():
    session = Session()
    session.start(100, CONFIG)
    assert (session.state, session.event, session.leg_id) == (State.RECORDING, 'started', 1)
    assert (session.start_ns, session.stop_ns) == (100, 0)
    session.stop(200)
    assert (session.state, session.event, session.stop_ns) == (State.COMPUTING, 'stopped', 200)
    session.finish(result(), calibration())
    assert (session.state, session.verdict()) == (State.CALIBRATED, 'accepted')
    drive_leg(session, 300, Code.LEG_TOO_SHORT)     # a reason that rejects
    assert (session.state, len(session.legs)) == (State.REJECTED, 2)


def test_a_failed_leg_is_kept_until_a_retry_or_a_cancellation():
    session = with_legs(1)
    session.start(50, CONFIG)
    session.stop(60)
    session.fail('no memory')
    assert (session.state, session.has_open_leg, session.is_busy) == (State.FAILED, True, False)
    with pytest.raises(CommandRefused, match='leg 2 failed and is kept.*~/stop_leg.*~/cancel_leg'):
        session.start(70, CONFIG)
    session.retry(CONFIG)
    assert session.state is State.COMPUTING
    session.fail('no memory')
    session.cancel()
    assert (session.state, session.event, len(session.legs)) == (State.CALIBRATED, 'cancelled', 1)


def test_cancel_restores_the_state_before_the_leg():
    session = Session()
    session.start(1, CONFIG)
    session.cancel()
    assert (session.state, session.event, session.legs) == (State.IDLE, 'cancelled', [])
    session.start(2, CONFIG)
    assert session.leg_id == 2  # ids are never used twice: replay would mix the legs up


def test_undo_removes_the_last_leg_and_shows_its_marks():
    session = with_legs(2)
    assert [leg.leg_id for leg in session.begin_undo()] == [1]
    assert (session.leg_id, session.start_ns, session.stop_ns) == (2, 11, 15)
    assert (session.event, session.state) == ('undone', State.COMPUTING)
    # no start and no cancel while it is computed
    with pytest.raises(CommandRefused, match='is being computed'):
        session.start(90, CONFIG)
    with pytest.raises(CommandRefused, match='no leg is running'):
        session.cancel()
    session.set_result(calibration(Code.LEG_TOO_SHORT))
    assert session.state is State.REJECTED
    assert session.begin_undo() == []
    assert (session.state, session.calibration) == (State.IDLE, None)


def test_a_reset_drops_all_legs_and_the_carried_result():
    session = with_legs(3)
    session.set_carried('two legs', 2)
    assert [leg.leg_id for leg in session.legs] == [3]
    assert [leg.leg_id for leg in session.begin_reset()] == [3]
    assert (session.legs, session.calibration, session.state) == ([], None, State.IDLE)
    assert session.carried is None


@pytest.mark.parametrize(('command', 'words'), [
    (lambda s: s.stop(1), 'no leg is running: call ~/start_leg first'),
    (lambda s: s.cancel(), 'no leg is running'),
    (lambda s: s.begin_undo(), 'no leg to undo')])
def test_an_idle_session_refuses(command, words):
    with pytest.raises(CommandRefused, match=words):
        command(Session())


@pytest.mark.parametrize('command', [Session.begin_undo, Session.begin_reset])
def test_an_open_leg_must_be_ended_first(command):
    session = with_legs(1)
    session.start(50, CONFIG)
    with pytest.raises(CommandRefused,
                       match='leg 2 is open: end it with ~/stop_leg or ~/cancel_leg'):
        command(session)


def test_an_unusable_automatic_leg_does_not_change_the_result():
    session = with_legs(1)
    before = session.calibration
    session.start(50, CONFIG, is_automatic=True)
    session.stop(60)
    session.drop_unusable(Reason(Code.LEG_TOO_SHORT, '30 m'))
    assert (session.state, session.event, session.has_open_leg) == (
        State.CALIBRATED, 'cancelled', False)
    assert session.calibration is before
    assert session.unused_reason.text == '30 m'
    drive_leg(session, 70, is_automatic=True)
    assert session.unused_reason is None


@pytest.fixture(scope='module')
def town():
    made = drive(scenario='town', duration=120.0, imu_grade='industrial', seed=4)
    return calibrate(made.leg(), settings(made, method='auto')), settings(made)


def test_many_legs_keep_their_values_and_only_the_newest_their_tracks(town):
    (whole, config), session = town, Session()
    for leg in range(LEGS_WITH_TRACKS + 2):
        session.start(10 * leg + 1, CONFIG)
        session.stop(10 * leg + 5)
        session.finish((whole,), calibration())
    drawn = [leg.results[0].evidence is not None for leg in session.legs]
    assert drawn == [False] * 2 + [True] * LEGS_WITH_TRACKS
    bare = session.legs[0].results[0]
    later = replace(whole, start_ns=whole.stop_ns, stop_ns=2 * whole.stop_ns - whole.start_ns)
    full, both = (combine([first, later], config) for first in (whole, bare))
    assert both.estimates == full.estimates
    content = [as_json(one, config, [], '2026-01-02T03:04:05+00:00') for one in (full, both)]
    assert content[0] == content[1]
    assert 'of the newest legs only, none of leg 1.' in report_html(both, config, content[1])
    track, = geojson(both, config, content[1]).values()
    assert {one['properties']['leg'] for one in json.loads(track)['features']} == {2}


def test_released_legs_remain_in_the_result(town, monkeypatch):
    """A sigma may differ by 5 %: the scatter between legs is carried over on a grid."""
    whole, config = town
    every = [replace(whole, methods=dict(whole.methods), start_ns=whole.start_ns + day * 10**14,
                     stop_ns=whole.stop_ns + day * 10**14) for day in range(4)]
    monkeypatch.setattr(worker, 'MAX_OPERATOR_LEGS', 3)
    monkeypatch.setattr(worker, 'calibrate_parts', lambda *_, **__: every[-1:])

    def computed():
        return worker.compute(SimpleNamespace(close=lambda *_: None), 0, 1,
                              [(one,) for one in every[:-1]], config)
    done = computed()
    assert done.released_count == 1
    assert done.carried.legs == 1
    assert done.calibration.legs == tuple(every[1:])
    for name, expected in combine(every, config).estimates.items():
        if expected.value is not None:
            found = done.calibration.estimates[name]
            assert abs(found.value - expected.value) < 0.05 * expected.sigma, name
            assert found.sigma == pytest.approx(expected.sigma, rel=0.05), name
    for one in every:      # two-point results have no information to carry over
        del one.methods['smoother']
    done = computed()
    assert (done.released_count, done.carried) == (0, None)
    assert done.calibration.legs == tuple(every)
