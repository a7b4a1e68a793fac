# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A leg with a long fit: ~/stop_leg answers with the running estimate, and the result follows."""

from contextlib import ExitStack
import math
import time
from types import SimpleNamespace

from bench import answer_of, PATIENCE, wait_for
from player import messages_of, playing_to, within
import pytest

from odocal_ros.live import answers
from odocal_ros.live.session import Session, SessionView
from odocal_ros.live.worker import STOP_ANSWER_S
from odocal_ros.output.value_text import with_sigma
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.sim.scenarios import SimOptions, simulate

STOP_S = 140                         # of the drive
MAX_ANSWER_S = 5.0                         # of an answer, as docs/node.md promises
# until a file exists, the fit of the first leg makes three passes and that of the next none
HELD = """
import os, time
from odocal_ros.live import worker
compute = worker.compute
def wait():
    while not os.path.exists({!r}):
        time.sleep(0.01)
def held(*args):
    *samples, tell = args
    def report(stage):
        tell(stage)
        if stage.passes == 3:
            wait()
    if args[3]:      # not the first leg
        wait()
    return compute(*samples, report)
worker.compute = held
"""


@pytest.fixture(scope='module')
def seen(tmp_path_factory):
    """Drive two legs, the second too short for a running estimate; keep all messages."""
    folder = tmp_path_factory.mktemp('out')
    gate = folder / 'go on'
    drive = simulate(SimOptions(scenario='town', duration=160.0, imu_rate=50.0, odometer='speed',
                                odometer_rate=25.0, fix_noise='rtk', imu_grade='industrial'))
    found = SimpleNamespace(truth=drive.truth)
    with ExitStack() as ends:
        leg = ends.enter_context(playing_to(messages_of(drive), {'output.directory': folder},
                                            before=HELD.format(str(gate))))
        ends.callback(gate.touch)      # the node ends after the jobs of its worker
        leg.record(10, 25, STOP_S)
        wait_for(lambda: leg.client.status['estimate_yaw_mounting_angle_rad'] != 'nan',
                 'a running estimate', 4 * PATIENCE)
        _held_leg(found, leg, leg.client, gate)
        _without_estimate(found, leg, leg.client, gate)
        return found


def _held_leg(found, leg, client, gate):
    found.first = _answered(leg, STOP_S)
    found.computing = client.until(state='computing', computing_passes='3')
    found.valid_before = client.get('result.valid')
    found.again = _answered(leg)
    waiting = client.ask('stop_leg')
    gate.touch()
    found.last = client.result(waiting)
    found.calibrated = client.until(state='calibrated')
    found.valid, *scale = client.get(
        'result.valid', 'result.scale_factor', 'result.scale_factor_sigma')
    found.scale = dict(zip(('value', 'sigma'), scale, strict=True))


def _without_estimate(found, leg, client, gate):
    gate.unlink()
    leg.play(STOP_S + 2, STOP_S + 4)
    client.start()
    leg.play(STOP_S + 4, STOP_S + 8)
    found.short = _answered(leg, STOP_S + 8)
    waiting = client.ask('stop_leg')
    client.until(state='computing', leg_id='2')
    client.call('cancel_leg')
    found.cancelled = answer_of(waiting)


def _answered(leg, stop_s=0.0):
    begin, call = time.monotonic(), leg.client.ask('stop_leg')
    if stop_s:
        leg.play(stop_s, stop_s + 2)
    return SimpleNamespace(answer=answer_of(call), seconds=time.monotonic() - begin)


def test_the_answer_does_not_wait_for_a_long_fit(seen):
    for one in (seen.first, seen.again, seen.short):
        assert STOP_ANSWER_S <= one.seconds < MAX_ANSWER_S
        assert one.answer.success
        assert one.answer.message.startswith('provisional: leg ')


def test_the_answer_has_the_running_estimate_of_the_status(seen):
    value, sigma = (float(seen.computing[f'estimate_scale_factor{end}']) for end in ('', '_sigma'))
    text = seen.first.answer.message
    assert f'the running estimate is scale factor {with_sigma(value, sigma)},' in text
    for end in ('', '_sigma'):
        assert seen.computing[f'estimate_yaw_mounting_angle{end}_rad'] != 'nan'
    assert text == seen.again.answer.message
    assert 's before the end' in text


def test_the_answer_cannot_be_mistaken_for_the_result(seen):
    text = seen.first.answer.message
    for word in ('accepted', 'caution', 'rejected', 'OK:'):
        assert word not in text
    assert 'The final result with its verdict follows on ~/status' in text
    assert '~/status' in text
    assert seen.valid_before == [False]
    assert (seen.computing['verdict'], seen.computing['scale_factor']) == ('', 'nan')
    assert 'the result follows on ~/status' in seen.computing['hint']


def test_the_status_shows_passes_and_remaining_change_of_the_fit(seen):
    status = seen.computing
    assert (status['computing_stage'], status['computing_passes']) == ('smoother', '3')
    change = float(status['computing_change_sigmas'])
    assert change > 0
    assert status['hint'].startswith('computing: smoother, 3 passes done, remaining change ')
    left = float(status['hint'].split('change ')[1].split(' sigma')[0])
    assert left == pytest.approx(change, abs=0.5 if change >= 10 else 0.0051)
    assert '%' not in status['hint']
    done = seen.calibrated
    assert (done['computing_stage'], done['computing_passes']) == ('', '0')
    assert (done['computing_change_sigmas'], done['computing_percent']) == ('nan', '0.0')


def test_the_result_follows_in_status_and_parameters_and_to_the_next_call(seen):
    assert seen.last.success
    assert 'accepted: scale factor ' in seen.last.message
    assert seen.valid
    assert with_sigma(**seen.scale) in seen.last.message
    assert float(seen.calibrated['scale_factor']) == seen.scale['value']
    assert seen.calibrated['estimate_scale_factor'] == 'nan'
    assert within(seen.scale, seen.truth.scale)


def test_a_missing_running_estimate_is_reported_and_the_leg_can_be_cancelled(seen):
    assert 'leg 2 is being computed; there is no running estimate' in seen.short.answer.message
    assert 'The final result of all legs' in seen.short.answer.message
    assert (seen.cancelled.success, seen.cancelled.message) == (False, 'leg 2 is cancelled')


def test_the_answer_reports_that_a_leg_would_be_rejected():
    session = Session()
    session.start(1, Config())
    now = SessionView(session, Config(), faults=(
        Reason(Code.IMU_GAP, 'no IMU data for 9 s'),), forecast_age_s=math.nan)
    assert 'The leg would be rejected: IMU_GAP: no IMU data for 9 s. ' in (
        answers.provisional_answer(now))
