# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The worker, the answer of ~/save, and what ``latest`` points at: never quietly a worse one."""

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
        config = with_settings(Config(), {'output.directory': str(folder)})
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
        saved = saving.saver.saved
        assert saved in text
        return text, (tmp_path / 'latest').resolve().name == saved.rpartition('/')[2]
    return run


def test_what_cannot_be_saved_is_a_warning_until_it_is(saving, tmp_path):
    (tmp_path / 'file').touch()
    success, text = saving.save(GOOD, tmp_path / 'file')
    assert not success
    assert saving.messages == [text]
    assert saving.saver.trouble in text
    assert 'output.directory' in saving.saver.trouble
    assert saving.save(GOOD, tmp_path)[0]
    assert saving.saver.trouble == ''


def test_a_worse_result_needs_the_second_save_of_the_operator(save, tmp_path):
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


def test_the_answer_does_not_wait_for_the_report_and_a_leg_neither(saving, tmp_path, monkeypatch):
    gate, worker, done = threading.Event(), saving.worker, []
    monkeypatch.setattr('odocal_ros.output.files.report_or_error_page', lambda *_: (
        gate.wait(20), ('<html></html>', ''))[1])
    saving.save(GOOD, tmp_path)
    assert (tmp_path / 'latest' / 'calibration.json').exists()
    assert not (tmp_path / 'latest' / 'report.html').exists()
    worker.submit(lambda: 'a leg', lambda result, error: done.append(result))
    wait_for(lambda: worker.poll() or done, 'the leg')
    assert saving.saver.is_busy
    assert not saving.saver.close(0.05)
    gate.set()
    wait_for((tmp_path / 'latest' / 'report.html').exists, 'the report')
    assert done + saving.messages == ['a leg']


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


def test_jobs_given_before_the_end_are_done_but_a_long_one_does_not_hold_it():
    done, gate, w = [], threading.Event(), Worker()
    w.submit(lambda: gate.wait(5.0), lambda *_: None)
    w.submit(lambda: done.append('saved'), lambda *_: None)
    assert not w.close(0.05)       # returns though the first has not ended
    threading.Timer(0.05, gate.set).start()
    assert w.close()
    assert done == ['saved']


def test_each_node_has_a_folder_of_its_own_in_the_ros_home(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
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


def test_results_of_automatic_legs_are_bounded_but_for_the_good_and_the_operators(tmp_path,
                                                                                  monkeypatch):
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
    assert len(list(tmp_path.glob('2026*'))) == 8        # 0: all
    folders.prune(folder, 2)
    # the operator's; 4 is what latest shows, 3 what it would go back to; the last two
    assert [p.name[8:10] for p in sorted(tmp_path.glob('2026*'))] == ['01', '03', '04', '07', '08']
    assert latest(tmp_path) == Path('2026-05-04T09-12-00Z')
    assert (tmp_path / 'journal').is_dir()


def test_a_result_of_an_earlier_session_counts_too(make, tmp_path):
    ResultFolders().point_latest(make('old'), 1, False)
    folders = ResultFolders()
    assert folders.point_latest(make('bad'), 2, False) == 'it is rejected'
    assert latest(tmp_path) == Path('old')


def test_undo_takes_latest_back_to_the_legs_left(make, tmp_path):
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


def test_undo_links_no_target_that_is_gone_or_never_was(make, tmp_path):
    old, folders = make('old'), ResultFolders()
    folders.point_latest(old, 1, False)
    folders.withdraw(0)       # the first of all
    assert latest(tmp_path) is None
    assert old.is_dir()
    ResultFolders().point_latest(old, 0, False)
    folders = ResultFolders()
    folders.point_latest(make('a'), 1, False)
    old.rmdir()
    folders.withdraw(0)
    assert latest(tmp_path) is None


def test_a_link_that_somebody_moved_is_left_alone(make, tmp_path):
    folders = ResultFolders()
    folders.point_latest(make('a'), 1, False)
    ResultFolders().point_latest(make('other'), 5, False)
    folders.withdraw(0)
    assert latest(tmp_path) == Path('other')


def test_two_nodes_file_one_after_the_other(make, tmp_path, monkeypatch):
    """Whoever looks at what is there points at its own before the next looks."""
    good, bad = make('good'), make('bad')
    late = threading.Thread(target=lambda: ResultFolders().point_latest(good, 1, False))
    stored_in = module.stored_in

    def slowly(path):
        found = stored_in(path)
        if not late.ident:          # bad has looked, and good comes
            late.start()
            late.join(0.3)
        return found
    monkeypatch.setattr(module, 'stored_in', slowly)
    ResultFolders().point_latest(bad, 2, False)
    late.join()
    assert latest(tmp_path) == Path('good')
