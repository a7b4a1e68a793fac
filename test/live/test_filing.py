# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The worker, the answer of ~/save, and what it takes to replace a good result by a worse one."""

import os
import threading
import time
from types import SimpleNamespace

from bench import wait_for
import pytest

from odocal_ros.calib.result import Calibration
from odocal_ros.live.filing import Filing
from odocal_ros.live.worker import Worker
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
pytest.importorskip('rclpy', reason='no rclpy here: pip install odocal_ros[ros]')
NOW_NS = 10**18
GOOD = Calibration((), {}, {}, ())
BAD = Calibration((Reason(Code.NO_FIX, 'no fix came'),), {}, {}, ())


@pytest.fixture
def save(tmp_path):
    """Return a function that saves a calibration and returns the answer and where latest is."""
    worker = Worker()
    log = SimpleNamespace(info=lambda text: None, warning=lambda text: None)
    filing = Filing(worker, log, lambda: None, '/calibrator')
    config = with_settings(Config(), {'output.directory': str(tmp_path)})

    def run(calibration, asked=True):
        future = filing.save(calibration, config, {}, 'imu_link', NOW_NS, asked)

        def done():
            worker.poll()
            return future.done()
        wait_for(done, 'the answer of save')
        success, text = future.result()
        assert success
        assert filing.saved in text
        return text, (tmp_path / 'latest').resolve().name == filing.saved.rpartition('/')[2]
    yield run
    worker.close()


def test_a_worse_result_needs_the_second_save(save):
    assert save(GOOD)[1]
    text, latest = save(BAD)
    assert not latest
    assert 'latest is unchanged: the new result is rejected (NO_FIX)' in text
    assert 'call ~/save again' in text
    assert save(BAD)[1]


def test_what_a_killed_node_has_left_is_removed_by_the_next_save(save, tmp_path):
    empty, full, new = (tmp_path / f'2026-01-01T00-00-0{k}Z' for k in range(3))
    other = tmp_path / 'notes'
    for folder in (empty, full, new, other):
        folder.mkdir()
    (full / 'calibration.json').write_text('{}')
    link, young = (tmp_path / f'.latest-{digit * 32}' for digit in 'ab')
    for one in (link, young):
        one.symlink_to(full.name)
    for old in (empty, full, other, link):
        os.utime(old, (time.time() - 600.0,) * 2, follow_symlinks=False)
    save(GOOD)
    assert {one.name for one in (empty, full, new, other, link, young) if one.is_symlink()
            or one.exists()} == {full.name, new.name, other.name, young.name}


def test_what_cannot_be_saved_is_a_warning_until_it_is(tmp_path):
    worker, said = Worker(), []
    filing = Filing(worker, SimpleNamespace(info=lambda text: None, warning=said.append),
                    lambda: None, '/calibrator')

    def save(folder):
        future = filing.save(GOOD, with_settings(Config(), {'output.directory': str(folder)}), {},
                             'imu_link', NOW_NS, True)
        wait_for(lambda: worker.poll() or future.done(), 'the answer of save')
        return future.result()
    (tmp_path / 'file').touch()
    success, text = save(tmp_path / 'file')
    assert not success
    assert said == [text]
    assert filing.trouble in text
    assert 'output.directory' in filing.trouble
    assert save(tmp_path)[0]
    assert filing.trouble == ''
    worker.close()


def test_the_saves_of_the_node_itself_do_not_count(save):
    assert save(GOOD, asked=False)[1]
    for _ in range(2):
        assert not save(BAD, asked=False)[1]
    assert not save(BAD)[1]
    assert save(BAD)[1]


def test_a_warning_holds_for_its_own_result_only(save):
    save(GOOD)
    save(BAD)
    other = Calibration(BAD.reasons, {}, {}, ())
    assert not save(other)[1]


def test_the_answer_does_not_wait_for_the_report_and_a_leg_neither(tmp_path, monkeypatch):
    gate, worker, done = threading.Event(), Worker(), []
    monkeypatch.setattr('odocal_ros.output.files.report_or_why', lambda *_: (
        gate.wait(20), ('<html></html>', ''))[1])
    filing = Filing(worker, SimpleNamespace(info=lambda text: None, warning=done.append),
                    lambda: None, '/calibrator')
    config = with_settings(Config(), {'output.directory': str(tmp_path)})
    future = filing.save(GOOD, config, {}, 'imu_link', NOW_NS, True)
    wait_for(lambda: worker.poll() or future.done(), 'the answer')
    assert (tmp_path / 'latest' / 'calibration.json').exists()
    assert not (tmp_path / 'latest' / 'report.html').exists()
    worker.submit(lambda: 'a leg', lambda result, error: done.append(result))
    wait_for(lambda: worker.poll() or done, 'the leg')
    assert filing.busy
    assert not filing.close(0.05)
    gate.set()
    wait_for((tmp_path / 'latest' / 'report.html').exists, 'the report')
    assert done == ['a leg']
    worker.close()


def test_jobs_given_before_the_end_are_done():
    done, gate, w = [], threading.Event(), Worker()
    w.submit(lambda: gate.wait(5.0), lambda *_: None)
    w.submit(lambda: done.append('saved'), lambda *_: None)
    threading.Timer(0.05, gate.set).start()
    assert w.close()
    assert done == ['saved']


def test_a_long_job_does_not_hold_the_end():
    gate, w = threading.Event(), Worker()
    w.submit(gate.wait, lambda *_: None)
    began = time.monotonic()
    assert not w.close(0.05)       # returns though the job has not ended
    assert not gate.is_set()
    assert time.monotonic() - began < 60.0
    gate.set()
