# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A journal on a disk that refuses each of its steps in turn: told, whole, and computed from."""

import errno
import os

from faults import Refusing
import pytest

from odocal_ros.bagio import segments
from odocal_ros.bagio.channels import Channel
from odocal_ros.bagio.chunks import pack
from odocal_ros.bagio.read import open_bag
from odocal_ros.bagio.segments import JOURNAL
from odocal_ros.live.journal_leg import clear_empty, LegJournal, Plan

SECOND = 10**9
NAME = '2026-01-02T03-04-05Z_leg_1'
CHUNKS = 6


def journal(root):
    return LegJournal(Plan(1, root, NAME, 'a: 1\n', 10**9),
                      {1: Channel('/odometer', 'std_msgs/msg/Int64')}, [])


def driven(root):
    """Write a leg of six seconds and a mark added later; return its journal."""
    one = journal(root)
    said = []
    for k in range(CHUNKS):
        one.put([chunk(k)])
        said.append(one.trouble)
    one.finish()
    said.append(one.trouble)
    one.add([chunk(CHUNKS)])
    return one, [*said, one.trouble]


def chunk(k):
    return pack(1, [k * SECOND, k * SECOND + 1], [b'\0\1\0\0' + bytes(8)] * 2)


def times(folder):
    with open_bag(folder) as bag:
        return [time_ns for time_ns, _ in bag.messages('/odometer')], bag.notes


@pytest.fixture(autouse=True)
def joined_soon(monkeypatch):
    """Join files already after three."""
    monkeypatch.setattr(segments, 'TOGETHER', 3)


def test_one_refused_step_loses_nothing_but_what_it_says(tmp_path, monkeypatch):
    wanted = [k * SECOND + i for k in range(CHUNKS + 1) for i in (0, 1)]
    step, without_mark = 0, 0
    while True:
        step += 1
        with monkeypatch.context() as patch:
            disk = Refusing(step, errno.EIO).put_in(patch)
            one, said = driven(tmp_path / str(step))
        if len(disk.steps) < step:
            break
        name = disk.steps[step - 1]
        found, _ = times(one.folder)
        without_mark += found == wanted[:-2]    # of the added mark, until it is tried again
        assert found in (wanted, wanted[:-2]), (step, name)
        one.retry()
        assert sorted(set(times(one.folder)[0])) == wanted, (step, name)
        assert one.trouble == '' or found == wanted, (step, name)
        folders = os.listdir(tmp_path / str(step))
        assert len(folders) == 1, folders
        assert not [n for n in os.listdir(one.folder) if n.endswith('.part')], name
        if any(said):
            assert os.strerror(errno.EIO) in ''.join(said)
        else:
            assert found == wanted
    assert step > 60
    assert 0 < without_mark < 20


@pytest.mark.parametrize('code', [errno.ENOSPC, errno.EIO, errno.EROFS])
def test_a_disk_that_takes_no_more_keeps_what_it_took(tmp_path, monkeypatch, code):
    step = 0
    while True:
        step += 1
        root = tmp_path / str(step)
        with monkeypatch.context() as patch:
            disk = Refusing(step, code, for_ever=True).put_in(patch)
            _, said = driven(root)
        if len(disk.steps) < step:
            break
        assert os.strerror(code) in said[-1] or os.strerror(code) in said[-2]
        folders = list(root.iterdir())
        if not folders:
            continue        # nothing of it could be written, and nothing is left
        found, _ = times(folders[0])
        assert found == [k * SECOND + i for k in range(CHUNKS + 1) for i in (0, 1)][:len(found)]
        assert found
    assert step > 60


@pytest.mark.parametrize('where', ['root', 'leg'])
def test_a_folder_that_is_removed_or_read_only_is_told_and_used_again(tmp_path, where):
    root = tmp_path / 'journal'
    one = journal(root)
    one.put([chunk(0)])
    folder = root if where == 'root' else root / NAME
    away = tmp_path / 'away'
    folder.rename(away)
    one.put([chunk(1)])
    assert 'No such file or directory' in one.trouble
    assert NAME in one.trouble
    away.rename(folder)
    one.put([chunk(2)])
    assert one.trouble == ''
    one.finish()
    assert times(one.folder)[0] == [k * SECOND + i for k in range(3) for i in (0, 1)]


def test_two_nodes_on_one_folder_have_journals_of_their_own(tmp_path):
    both = [journal(tmp_path) for _ in range(2)]
    for k in range(CHUNKS):
        for n, one in enumerate(both):
            one.put([chunk(10 * n + k)])
    for one in both:
        one.finish()
        assert one.trouble == ''
    assert [times(one.folder)[0][0] for one in both] == [0, 10 * SECOND]
    assert sorted(os.listdir(tmp_path)) == [NAME, f'{NAME}-2']


def test_empty_journals_do_not_pile_up(tmp_path):
    def aged(name, *files):
        (tmp_path / name).mkdir()
        for file in files:
            (tmp_path / name / file).touch()
        os.utime(tmp_path / name, (10**9, 10**9))
    aged(NAME)
    aged(f'{NAME}-2', JOURNAL)
    aged(f'{NAME}-3', JOURNAL, '.part_000000.mcap.part')
    aged(f'{NAME}-4', JOURNAL, 'part_000000.mcap')
    aged('mine')
    (tmp_path / f'{NAME}-5').mkdir()
    clear_empty(tmp_path)
    assert sorted(os.listdir(tmp_path)) == [f'{NAME}-4', f'{NAME}-5', 'mine']
