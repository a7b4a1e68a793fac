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
def filing():
    """Return worker, filing, the warnings of both, and a function that saves and answers."""
    worker, said = Worker(), []
    filing = Filing(worker, SimpleNamespace(info=lambda text: None, warning=said.append),
                    lambda: None, '/calibrator')

    def run(calibration, folder, asked=True):
        config = with_settings(Config(), {'output.directory': str(folder)})
        future = filing.save(calibration, config, {}, 'imu_link', NOW_NS, asked)
        wait_for(lambda: worker.poll() or future.done(), 'the answer of save')
        return future.result()
    yield SimpleNamespace(worker=worker, filing=filing, said=said, save=run)
    worker.close()


@pytest.fixture
def save(filing, tmp_path):
    """Return a function that saves a calibration and returns the answer and where latest is."""
    def run(calibration, asked=True):
        success, text = filing.save(calibration, tmp_path, asked)
        assert success
        saved = filing.filing.saved
        assert saved in text
        return text, (tmp_path / 'latest').resolve().name == saved.rpartition('/')[2]
    return run


def test_what_cannot_be_saved_is_a_warning_until_it_is(filing, tmp_path):
    (tmp_path / 'file').touch()
    success, text = filing.save(GOOD, tmp_path / 'file')
    assert not success
    assert filing.said == [text]
    assert filing.filing.trouble in text
    assert 'output.directory' in filing.filing.trouble
    assert filing.save(GOOD, tmp_path)[0]
    assert filing.filing.trouble == ''


def test_the_saves_of_the_node_itself_do_not_count_nor_a_warning_of_another_result(save):
    assert save(GOOD, asked=False)[1]
    for _ in range(2):
        assert not save(BAD, asked=False)[1]
    assert not save(BAD)[1]
    assert not save(Calibration(BAD.reasons, {}, {}, ()))[1]
    assert not save(BAD)[1]
    assert save(BAD)[1]


def test_the_answer_does_not_wait_for_the_report_and_a_leg_neither(filing, tmp_path, monkeypatch):
    gate, worker, done = threading.Event(), filing.worker, []
    monkeypatch.setattr('odocal_ros.output.files.report_or_why', lambda *_: (
        gate.wait(20), ('<html></html>', ''))[1])
    filing.save(GOOD, tmp_path)
    assert (tmp_path / 'latest' / 'calibration.json').exists()
    assert not (tmp_path / 'latest' / 'report.html').exists()
    worker.submit(lambda: 'a leg', lambda result, error: done.append(result))
    wait_for(lambda: worker.poll() or done, 'the leg')
    assert filing.filing.busy
    assert not filing.filing.close(0.05)
    gate.set()
    wait_for((tmp_path / 'latest' / 'report.html').exists, 'the report')
    assert done + filing.said == ['a leg']


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
