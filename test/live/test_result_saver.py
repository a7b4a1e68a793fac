# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The worker, the answer of ~/save, and ``latest``: a worse result does not replace it."""

import json
import os
from pathlib import Path
import threading
import time
from types import SimpleNamespace

from bench import wait_for
import pytest

from odocal_ros.calib.result import Calibration
from odocal_ros.live import result_folders as module
from odocal_ros.live.result_folders import output_root, ResultFolders, ResultSaver
from odocal_ros.live.worker import Worker
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
pytest.importorskip('rclpy', reason='no rclpy here: pip install odocal_ros[ros]')
NOW_NS = 10**18
GOOD = Calibration((), {}, {}, ())
BAD = Calibration((Reason(Code.NO_FIX, 'no fix came'),), {}, {}, ())


@pytest.fixture
def saving():
    """Return worker, result saver, the warnings of both, and a function that saves and answers."""
    worker, messages = Worker(), []
    saver = ResultSaver(worker, SimpleNamespace(info=lambda text: None, warning=messages.append),
                    lambda: None, '/calibrator')

    def run(calibration, folder, by_operator=True):
        config = with_settings(Config(), {'output.directory': str(folder), 'vehicle': 'car 3'})
        future = saver.save(calibration, config, {}, 'imu_link', NOW_NS, by_operator)
        wait_for(lambda: worker.poll() or future.done(), 'the answer of save')
        return future.result()
    yield SimpleNamespace(worker=worker, saver=saver, messages=messages, save=run)
    worker.close()


@pytest.fixture
def save(saving, tmp_path):
    """Return a function that saves a calibration and returns the answer and where latest is."""
    def run(calibration, by_operator=True):
        success, text = saving.save(calibration, tmp_path, by_operator)
        assert success
        saved = saving.saver.saved_folder
        assert saved in text
        return text, (tmp_path / 'latest').resolve().name == saved.rpartition('/')[2]
    return run


def test_a_failed_save_is_a_warning_until_a_save_succeeds(saving, tmp_path):
    (tmp_path / 'file').touch()
    success, text = saving.save(GOOD, tmp_path / 'file')
    assert not success
    assert saving.messages == [text]
    assert saving.saver.error in text
    assert 'output.directory' in saving.saver.error
    assert saving.save(GOOD, tmp_path)[0]
    assert saving.saver.error == ''


def test_a_worse_result_becomes_latest_by_the_second_save_of_the_operator(save, tmp_path):
    assert save(GOOD, by_operator=False)[1]
    for _ in range(2):
        assert not save(BAD, by_operator=False)[1]
    assert not save(BAD)[1]
    assert not save(Calibration(BAD.reasons, {}, {}, ()))[1]        # another result
    text, latest = save(BAD)
    assert not latest
    assert 'latest is unchanged: the new result is rejected (NO_FIX)' in text
    assert 'call ~/save again' in text
    assert save(BAD)[1]
    assert not list(tmp_path.glob('.latest*'))


def test_neither_the_answer_nor_a_leg_waits_for_the_report(saving, tmp_path, monkeypatch):
    gate, worker, done = threading.Event(), saving.worker, []
    monkeypatch.setattr('odocal_ros.output.files.report_or_error_page', lambda *_: (
        gate.wait(20), ('<html></html>', ''))[1])
    saving.save(GOOD, tmp_path)
    content = json.loads((tmp_path / 'latest' / 'calibration.json').read_text())
    assert (content['vehicle'], content['inputs'][0]['node']) == ('car 3', '/calibrator')
    assert not (tmp_path / 'latest' / 'report.html').exists()
    worker.submit(lambda: 'a leg', lambda result, error: done.append(result))
    wait_for(lambda: worker.poll() or done, 'the leg')
    assert saving.saver.is_busy
    assert not saving.saver.close(0.05)
    gate.set()
    wait_for((tmp_path / 'latest' / 'report.html').exists, 'the report')
    assert done + saving.messages == ['a leg']


def test_the_next_save_removes_what_a_killed_node_left(save, tmp_path):
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


def test_pending_jobs_are_finished_at_the_end_but_a_long_one_does_not_delay_it():
    done, gate, w = [], threading.Event(), Worker()
    w.submit(lambda: gate.wait(5.0), lambda *_: None)
    w.submit(lambda: done.append('saved'), lambda *_: None)
    assert not w.close(0.05)       # returns before the first has ended
    threading.Timer(0.05, gate.set).start()
    assert w.close()
    assert done == ['saved']


def test_each_node_has_its_own_folder_in_the_ros_home(saving, tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    assert saving.save(GOOD, '')[0]
    assert (tmp_path / 'odocal/calibrator/latest').exists()
    assert output_root(Config(), '/calibrator') == tmp_path / 'odocal/calibrator'
    assert output_root(Config(), '/car4/calibrator') == tmp_path / 'odocal/car4/calibrator'
    monkeypatch.delenv('ROS_HOME')
    assert output_root(Config(), '/a') == Path('~/.ros/odocal/a').expanduser()
    assert output_root(with_settings(Config(), {'output.directory': '/x'}), '/a') == Path('/x')


@pytest.fixture
def make(tmp_path, monkeypatch):
    """Return a function that makes a result folder; a folder named bad is worse than others."""
    monkeypatch.setattr(module, 'stored_in',
                        lambda path: path.resolve().name if path.exists() else None)
    monkeypatch.setattr(module, 'objection_to_folder', lambda old, new: (
        'it is rejected' if old and 'bad' not in old and 'bad' in new.name else ''))

    def folder(name):
        (tmp_path / name).mkdir()
        return tmp_path / name
    return folder


def latest(tmp_path):
    link = tmp_path / 'latest'
    return link.readlink() if link.is_symlink() else None


def test_old_results_of_automatic_legs_are_removed(tmp_path, monkeypatch):
    of = {}       # name: (automatic, usable)

    def stored(path):
        automatic, usable = of.get(path.resolve().name, (False, False))
        return SimpleNamespace(config={'leg.automatic': automatic}, usable=usable)
    monkeypatch.setattr(module, 'stored_in', stored)
    monkeypatch.setattr(module, 'objection_to_folder',
                        lambda old, new: '' if of[new.name][1] else 'it is rejected')
    folders = ResultFolders()
    for day, made in enumerate([(False, True), *[(True, True)] * 3, *[(True, False)] * 4], 1):
        folder = tmp_path / f'2026-05-{day:02}T09-12-00Z'
        folder.mkdir()
        of[folder.name] = made
        folders.point_latest(folder, day, False)
        folders.prune(folder, 0)
    (tmp_path / 'journal').mkdir()
    assert len(list(tmp_path.glob('2026*'))) == 8        # 0: no limit
    folders.prune(folder, 2)
    # kept: the operator's, 4 as latest, 3 as latest after an undo, and the last two
    assert [p.name[8:10] for p in sorted(tmp_path.glob('2026*'))] == ['01', '03', '04', '07', '08']
    assert latest(tmp_path) == Path('2026-05-04T09-12-00Z')
    assert (tmp_path / 'journal').is_dir()


def test_a_result_of_an_earlier_session_is_compared_too(make, tmp_path):
    ResultFolders().point_latest(make('old'), 1, False)
    folders = ResultFolders()
    assert folders.point_latest(make('bad'), 2, False) == 'it is rejected'
    assert latest(tmp_path) == Path('old')


def test_undo_sets_latest_back_to_the_result_of_the_remaining_legs(make, tmp_path):
    ResultFolders().point_latest(make('old'), 0, False)
    folders = ResultFolders()
    a = make('a')
    folders.point_latest(a, 1, False)
    folders.point_latest(make('b'), 2, False)
    folders.point_latest(make('c'), 2, False)
    assert folders.withdraw(2) == a
    assert latest(tmp_path) == Path('a')
    assert folders.withdraw(0) is None
    assert latest(tmp_path) == Path('old')
    assert folders.withdraw(0) is None


def test_undo_removes_latest_if_its_target_is_missing(make, tmp_path):
    old, folders = make('old'), ResultFolders()
    folders.point_latest(old, 1, False)
    folders.withdraw(0)       # the first result
    assert latest(tmp_path) is None
    assert old.is_dir()
    ResultFolders().point_latest(old, 0, False)
    folders = ResultFolders()
    folders.point_latest(make('a'), 1, False)
    old.rmdir()
    folders.withdraw(0)
    assert latest(tmp_path) is None


def test_a_link_changed_by_another_program_is_kept(make, tmp_path):
    folders = ResultFolders()
    folders.point_latest(make('a'), 1, False)
    ResultFolders().point_latest(make('other'), 5, False)
    folders.withdraw(0)
    assert latest(tmp_path) == Path('other')


def test_two_nodes_update_latest_one_after_the_other(make, tmp_path, monkeypatch):
    """Each node reads and replaces the link before the next one reads it."""
    good, bad = make('good'), make('bad')
    late = threading.Thread(target=lambda: ResultFolders().point_latest(good, 1, False))
    stored_in = module.stored_in

    def slowly(path):
        found = stored_in(path)
        if not late.ident:          # bad has read it, good starts
            late.start()
            late.join(0.3)
        return found
    monkeypatch.setattr(module, 'stored_in', slowly)
    ResultFolders().point_latest(bad, 2, False)
    late.join()
    assert latest(tmp_path) == Path('good')
