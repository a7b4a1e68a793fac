# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What ``latest`` points at: the best known, never quietly a worse one."""

from pathlib import Path
import threading
from types import SimpleNamespace

import pytest

from odocal_ros.live import filing as module
from odocal_ros.live.filing import ResultFolders

pytestmark = pytest.mark.core


@pytest.fixture
def make(tmp_path, monkeypatch):
    """Return a function that makes a result folder; a folder named bad is worse than others."""
    monkeypatch.setattr(module, 'stored_in',
                        lambda path: path.resolve().name if path.exists() else None)
    monkeypatch.setattr(module, 'replacing', lambda old, new: (
        'it is rejected' if old and 'bad' not in old and 'bad' in new.name else ''))

    def folder(name):
        (tmp_path / name).mkdir()
        return tmp_path / name
    return folder


def latest(tmp_path):
    link = tmp_path / 'latest'
    return link.readlink() if link.is_symlink() else None


def test_latest_goes_with_each_result_but_not_to_a_worse_one(make, tmp_path):
    folders = ResultFolders()
    assert folders.file(make('a'), 1, False) == ''
    assert folders.file(make('b'), 2, False) == ''
    assert latest(tmp_path) == Path('b')
    bad = make('bad')
    assert folders.file(bad, 3, False) == 'it is rejected'
    assert latest(tmp_path) == Path('b')
    assert folders.file(bad, 3, True) == ''
    assert latest(tmp_path) == Path('bad')
    assert sorted(p.name for p in tmp_path.iterdir()) == ['a', 'b', 'bad', 'latest']


def test_results_of_automatic_legs_are_bounded_but_for_the_good_and_the_operators(tmp_path,
                                                                                  monkeypatch):
    of = {}       # name: (automatic, usable)

    def stored(path):
        automatic, usable = of.get(path.resolve().name, (False, False))
        return SimpleNamespace(config={'leg.automatic': automatic}, usable=usable)
    monkeypatch.setattr(module, 'stored_in', stored)
    monkeypatch.setattr(module, 'replacing',
                        lambda old, new: '' if of[new.name][1] else 'it is rejected')
    folders = ResultFolders()
    for day, made in enumerate([(False, True), *[(True, True)] * 3, *[(True, False)] * 4], 1):
        folder = tmp_path / f'2026-05-{day:02}T09-12-00Z'
        folder.mkdir()
        of[folder.name] = made
        folders.file(folder, day, False)
        folders.prune(folder, 0)
    (tmp_path / 'journal').mkdir()
    assert len(list(tmp_path.glob('2026*'))) == 8        # 0: all
    folders.prune(folder, 2)
    # the operator's; 4 is what latest shows, 3 what it would go back to; the last two
    assert [p.name[8:10] for p in sorted(tmp_path.glob('2026*'))] == ['01', '03', '04', '07', '08']
    assert latest(tmp_path) == Path('2026-05-04T09-12-00Z')
    assert (tmp_path / 'journal').is_dir()


def test_a_result_of_an_earlier_session_counts_too(make, tmp_path):
    ResultFolders().file(make('old'), 1, False)
    folders = ResultFolders()
    assert folders.file(make('bad'), 2, False) == 'it is rejected'
    assert latest(tmp_path) == Path('old')


def test_undo_takes_latest_back_to_the_legs_left(make, tmp_path):
    ResultFolders().file(make('old'), 0, False)
    folders = ResultFolders()
    a = make('a')
    folders.file(a, 1, False)
    folders.file(make('b'), 2, False)
    folders.file(make('c'), 2, False)
    assert folders.withdraw(2) == a
    assert latest(tmp_path) == Path('a')
    assert folders.withdraw(0) is None
    assert latest(tmp_path) == Path('old')
    assert folders.withdraw(0) is None


def test_undo_links_no_target_that_is_gone_or_never_was(make, tmp_path):
    old, folders = make('old'), ResultFolders()
    folders.file(old, 1, False)
    folders.withdraw(0)       # the first of all
    assert latest(tmp_path) is None
    assert old.is_dir()
    ResultFolders().file(old, 0, False)
    folders = ResultFolders()
    folders.file(make('a'), 1, False)
    old.rmdir()
    folders.withdraw(0)
    assert latest(tmp_path) is None


def test_a_link_that_somebody_moved_is_left_alone(make, tmp_path):
    folders = ResultFolders()
    folders.file(make('a'), 1, False)
    ResultFolders().file(make('other'), 5, False)
    folders.withdraw(0)
    assert latest(tmp_path) == Path('other')


def test_two_nodes_file_one_after_the_other(make, tmp_path, monkeypatch):
    """Whoever looks at what is there points at its own before the next looks."""
    good, bad = make('good'), make('bad')
    late = threading.Thread(target=lambda: ResultFolders().file(good, 1, False))
    stored_in = module.stored_in

    def slowly(path):
        found = stored_in(path)
        if not late.ident:          # bad has looked, and good comes
            late.start()
            late.join(0.3)
        return found
    monkeypatch.setattr(module, 'stored_in', slowly)
    ResultFolders().file(bad, 2, False)
    late.join()
    assert latest(tmp_path) == Path('good')
