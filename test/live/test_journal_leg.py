# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The journal of a leg: its size limit, and a disk on which an operation fails."""

import errno
from itertools import count
import os

from disk_errors import Refusing
import pytest

from odocal_ros.bagio import segments
from odocal_ros.bagio.bag_file import Channel
from odocal_ros.bagio.mcap_write import pack
from odocal_ros.bagio.read import open_bag
from odocal_ros.bagio.segments import JOURNAL_FILE
from odocal_ros.live import journal_leg

SECOND = 10**9
NAME = '2026-01-02T03-04-05Z_leg_1'
CHUNKS = 6


def journal(root, name=NAME, limit=10**9):
    return journal_leg.LegJournal(journal_leg.JournalPlan(1, root, name, 'a: 1\n', limit),
                      {1: Channel('/odometer', 'std_msgs/msg/Int64')}, [])


def driven(root):
    """Write a leg of six seconds and a mark added later; return its journal."""
    one = journal(root)
    logged = []
    for k in range(CHUNKS):
        one.append([chunk(k)])
        logged.append(one.error)
    one.finish()
    logged.append(one.error)
    one.add_mark([chunk(CHUNKS)])
    return one, [*logged, one.error]


def chunk(k):
    return pack(1, times_of(k), [b'\0\1\0\0' + bytes(8)] * 2)


def times_of(*seconds):
    """Return the times of the messages in some chunks."""
    return [k * SECOND + i for k in seconds for i in (0, 1)]


def large(k):
    return pack(1, [k * SECOND], [os.urandom(100_000)])


def times(folder):
    with open_bag(folder) as bag:
        return [time_ns for time_ns, _ in bag.messages('/odometer')]


@pytest.fixture(autouse=True)
def joined_soon(monkeypatch):
    """Join files already after three."""
    monkeypatch.setattr(segments, 'FILES_JOINED', 3)


def test_one_failed_disk_operation_loses_no_message(tmp_path, monkeypatch):
    expected_times, without_mark = times_of(*range(CHUNKS + 1)), 0
    for step in count(1):
        with monkeypatch.context() as patch:
            disk = Refusing(step, errno.EIO).put_in(patch)
            one, logged = driven(tmp_path / str(step))
        if len(disk.steps) < step:
            break
        name = disk.steps[step - 1]
        found = times(one.folder)
        # the added mark is missing until the next attempt
        without_mark += found == expected_times[:-2]
        assert found in (expected_times, expected_times[:-2]), (step, name)
        one.retry()
        assert sorted(set(times(one.folder))) == expected_times, (step, name)
        assert one.error == '' or found == expected_times, (step, name)
        folders = os.listdir(tmp_path / str(step))
        assert len(folders) == 1, folders
        assert not [n for n in os.listdir(one.folder) if n.endswith('.part')], name
        if any(logged):
            assert os.strerror(errno.EIO) in ''.join(logged)
        else:
            assert found == expected_times
    assert step > 60
    assert 0 < without_mark < 20


@pytest.mark.parametrize('code', [errno.ENOSPC, errno.EIO, errno.EROFS])
def test_a_permanently_failing_disk_keeps_what_was_written_before(tmp_path, monkeypatch, code):
    for step in count(1):
        root = tmp_path / str(step)
        with monkeypatch.context() as patch:
            disk = Refusing(step, code, for_ever=True).put_in(patch)
            _, logged = driven(root)
        if len(disk.steps) < step:
            break
        assert os.strerror(code) in logged[-1] or os.strerror(code) in logged[-2]
        folders = list(root.iterdir())
        if not folders:
            continue        # nothing was written, and no folder is left
        found = times(folders[0])
        assert found == times_of(*range(CHUNKS + 1))[:len(found)]
        assert found
    assert step > 60


@pytest.mark.parametrize('where', ['root', 'leg'])
def test_a_missing_folder_is_reported_and_used_again_when_it_is_back(tmp_path, where):
    root = tmp_path / 'journal'
    one = journal(root)
    one.append([chunk(0)])
    folder = root if where == 'root' else root / NAME
    away = tmp_path / 'away'
    folder.rename(away)
    one.append([chunk(1)])
    assert 'No such file or directory' in one.error
    assert NAME in one.error
    away.rename(folder)
    one.append([chunk(2)])
    assert one.error == ''
    one.finish()
    assert times(one.folder) == times_of(*range(3))


def test_two_nodes_with_one_folder_write_separate_journals(tmp_path):
    both = [journal(tmp_path) for _ in range(2)]
    for k in range(CHUNKS):
        for n, one in enumerate(both):
            one.append([chunk(10 * n + k)])
    for one in both:
        one.finish()
        assert one.error == ''
    assert [times(one.folder)[0] for one in both] == [0, 10 * SECOND]
    assert sorted(os.listdir(tmp_path)) == [NAME, f'{NAME}-2']


def test_old_empty_journals_are_removed(tmp_path):
    def aged(name, *files):
        (tmp_path / name).mkdir()
        for file in files:
            (tmp_path / name / file).touch()
        os.utime(tmp_path / name, (10**9, 10**9))
    aged(NAME)
    aged(f'{NAME}-2', JOURNAL_FILE)
    aged(f'{NAME}-3', JOURNAL_FILE, '.part_000000.mcap.part')
    aged(f'{NAME}-4', JOURNAL_FILE, 'part_000000.mcap')
    aged('mine')
    (tmp_path / f'{NAME}-5').mkdir()
    journal_leg.clear_empty(tmp_path)
    assert sorted(os.listdir(tmp_path)) == [f'{NAME}-4', f'{NAME}-5', 'mine']


def folder_of(root, name, size, age):
    """Make a folder like a journal; size in bytes, age in s."""
    folder = root / name
    folder.mkdir(parents=True)
    (folder / JOURNAL_FILE).touch()
    os.utime(folder / JOURNAL_FILE, ns=(0, -age * SECOND + 10**18))
    (folder / 'part.mcap').write_bytes(bytes(size))
    return folder


def test_only_the_oldest_unlocked_journals_are_removed(tmp_path):
    old, middle, new = (folder_of(tmp_path, name, 1000, age)
                        for name, age in (('c', 3), ('b', 2), ('a', 1)))
    (tmp_path / 'calibration').mkdir()
    (tmp_path / 'calibration' / 'result').write_bytes(bytes(5000))
    (tmp_path / 'link').symlink_to(new)
    assert journal_leg.journal_folders(tmp_path) == [old, middle, new]
    assert journal_leg.make_room(tmp_path, 3000) == 3000
    assert journal_leg.make_room(tmp_path, 3000, needed=1) == 2000
    assert journal_leg.journal_folders(tmp_path) == [middle, new]
    with journal_leg.lock_journal(middle):      # a node is writing to it
        assert journal_leg.make_room(tmp_path, 1500) == 1000
        assert journal_leg.journal_folders(tmp_path) == [middle]
        assert journal_leg.make_room(tmp_path, 10) == 1000
    assert journal_leg.make_room(tmp_path, 10) == 0
    assert (tmp_path / 'calibration' / 'result').exists()
    assert journal_leg.make_room(tmp_path / 'none', 10) == 0


def test_all_journals_together_stay_within_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(journal_leg, 'METADATA_BYTES', 10_000)
    limit, taken, write_file = 1_200_000, [], segments.write_file

    def watched(*args):
        size = write_file(*args)
        taken.append(sum(map(journal_leg.folder_size, journal_leg.journal_folders(tmp_path))))
        return size
    monkeypatch.setattr(segments, 'write_file', watched)   # joined and single files exist
    for leg_id in range(1, 5):
        one = journal(tmp_path, f'leg_{leg_id}', limit)
        for k in range(5):
            one.append([large(k)])
        one.finish()
        assert one.error == ''
    assert len(taken) == 4 * (5 + 1 + 1)
    assert 900_000 < max(taken) <= limit
    assert [f.name for f in journal_leg.journal_folders(tmp_path)][-1] == 'leg_4'


def test_a_leg_larger_than_the_limit_is_kept_up_to_the_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(journal_leg, 'METADATA_BYTES', 10_000)
    folder_of(tmp_path, 'old', 1000, 1)
    one = journal(tmp_path, limit=500_000)
    for k in range(20):
        one.append([large(k)])
    assert 'raise journal.max_bytes' in one.error
    one.finish()
    folder, = journal_leg.journal_folders(tmp_path)
    assert journal_leg.folder_size(folder) <= 500_000
    with open_bag(folder) as bag:
        # space is reserved to join each new file with the existing ones
        assert bag.topics['/odometer'].count == 2
        assert bag.start_ns == 0


def test_unwritten_data_waits_in_memory_up_to_a_limit(tmp_path, monkeypatch):
    monkeypatch.setattr(journal_leg, 'MAX_UNWRITTEN_BYTES', 350_000)
    one = journal(tmp_path)
    one.append([large(0)])
    with monkeypatch.context() as patch:
        Refusing(1, for_ever=True).put_in(patch)
        for k in range(1, 6):
            one.append([large(k)])
    assert 'no further attempt in this leg' in one.error
    assert not one._unwritten
    one.append([large(6)])                # an early end is better than a gap
    one.finish()
    with open_bag(one.folder) as bag:
        assert bag.topics['/odometer'].count == 1
