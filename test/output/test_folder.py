# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Result folders contain one calibration, also after concurrent writes, failures and kills."""

from contextlib import suppress
import errno
import json
import multiprocessing
import os
from pathlib import Path
import signal
import threading

from disk_errors import Refusing
import pytest

from odocal_ros.errors import BadUsage
from odocal_ros.safe_io import atomic_files
from odocal_ros.safe_io.atomic_files import ResultFolder

MAIN, OURS = 'main.json', frozenset({'main.json', 'a.txt', 'b.txt', 'late.html'})


def texts(tag, *names):
    return {name: f'{tag} {name}' for name in (names or ('main.json', 'a.txt', 'b.txt'))}


def put(place, tag, *names, force=True):
    one = ResultFolder(place, MAIN, OURS)
    one.put(texts(tag, *names), force)
    return one


def held(place):
    return {p.name: p.read_text() for p in Path(place).iterdir()}


@pytest.fixture
def refuse(monkeypatch):
    def at(step, code=errno.ENOSPC):
        return Refusing(step, code).put_in(monkeypatch)
    return at


def test_a_result_is_written_to_a_new_an_empty_and_an_old_folder(tmp_path):
    place = tmp_path / 'deep' / 'out'
    put(place, 'one', force=False)
    assert held(place) == texts('one')
    put(place, 'two', 'main.json', 'b.txt')
    assert held(place) == texts('two', 'main.json', 'b.txt')
    (tmp_path / 'empty').mkdir()
    put(tmp_path / 'empty', 'one', force=False)
    assert held(tmp_path / 'empty') == texts('one')
    assert sorted(p.name for p in (tmp_path / 'deep').iterdir()) == ['out']


def test_other_files_and_the_folder_itself_are_kept(tmp_path):
    place = tmp_path / 'out'
    put(place, 'one')
    (place / 'mine').mkdir()
    (place / 'mine' / 'x').write_text('keep')
    before = place.stat().st_ino
    put(place, 'two', 'main.json')
    assert place.stat().st_ino == before
    assert (place / 'mine' / 'x').read_text() == 'keep'
    assert sorted(p.name for p in place.iterdir()) == ['main.json', 'mine']


def test_the_working_directory_and_a_link_to_the_folder_are_kept(tmp_path, monkeypatch):
    put(tmp_path / 'out', 'one')
    monkeypatch.chdir(tmp_path / 'out')
    put(Path('.'), 'two')
    assert held('.') == texts('two')
    assert os.listdir(tmp_path) == ['out']
    put(tmp_path / 'out', 'one')
    (tmp_path / 'latest').symlink_to('out')
    put(tmp_path / 'latest', 'two')
    assert (tmp_path / 'latest').is_symlink()
    assert held(tmp_path / 'out') == texts('two')


@pytest.mark.parametrize('foreign', [False, True])
def test_an_existing_result_is_not_replaced_without_force(tmp_path, foreign):
    put(tmp_path / 'out', 'one')
    if foreign:
        (tmp_path / 'out' / 'mine').touch()
    before = held(tmp_path / 'out')
    with pytest.raises(BadUsage, match=r'main\.json exists; give another folder'):
        put(tmp_path / 'out', 'two', force=False)
    assert held(tmp_path / 'out') == before
    assert os.listdir(tmp_path) == ['out']


@pytest.mark.parametrize('old', [None, 'ours', 'foreign'])
def test_any_failed_disk_operation_leaves_the_old_or_the_new_result(tmp_path, refuse, old):
    place = tmp_path / 'out'
    steps = 0
    while True:
        steps += 1
        if place.exists():
            for path in place.iterdir():
                path.unlink()
            place.rmdir()
        if old:
            put(place, 'one')
        if old == 'foreign':
            (place / 'mine').write_text('keep')
        before = held(place) if old else None
        disk = refuse(steps, errno.ENOSPC)
        with suppress(OSError):
            put(place, 'two')
        refuse(0)
        if len(disk.steps) < steps:
            break
        after = held(place) if place.exists() else None
        mine = {'mine': 'keep'} if old == 'foreign' else {}
        whole_now = texts('two') | mine
        # the last operation syncs the folder: the new names already exist
        assert after in (before, whole_now) or MAIN not in after, disk.steps[-1]
        assert not list(tmp_path.rglob('.*'))
    assert steps > 12


def write_many(place, tag, force, ready, out):
    ready.wait()
    try:
        put(place, tag, 'main.json', f'{"ab"[tag % 2]}.txt', force=force)
        out.put('written')
    except BadUsage:
        out.put('refused')


@pytest.mark.parametrize('force', [False, True])
def test_of_several_writers_without_force_exactly_one_succeeds(tmp_path, force):
    context = multiprocessing.get_context('fork')
    for turn in range(10):
        place, out, ready = tmp_path / str(turn), context.Queue(), context.Event()
        writers = [context.Process(target=write_many, args=(place, tag, force, ready, out))
                   for tag in range(6)]
        for one in writers:
            one.start()
        ready.set()
        outcomes = sorted(out.get(timeout=30) for _ in writers)
        for one in writers:
            one.join()
        assert outcomes == (['written'] * 6 if force else ['refused'] * 5 + ['written'])
        now = held(place)
        tag = int(now[MAIN].split()[0])
        assert now == texts(tag, 'main.json', f'{"ab"[tag % 2]}.txt')
    assert sorted(os.listdir(tmp_path)) == sorted(map(str, range(10)))


def test_a_late_file_is_added_only_to_its_own_result(tmp_path):
    first = put(tmp_path / 'out', 'one')
    assert first.add('late.html', 'one late')
    second = put(tmp_path / 'out', 'two')
    assert not first.add('late.html', 'one late')
    assert (first.is_unchanged, second.is_unchanged) == (False, True)
    assert held(tmp_path / 'out') == texts('two')


def swap_repeatedly(place):
    for turn in range(10**6):
        put(place, turn, 'main.json', f'{"ab"[turn % 2]}.txt')


@pytest.mark.parametrize('foreign', [False, True])
def test_a_kill_leaves_one_result_or_none_and_the_next_write_cleans_up(tmp_path, foreign):
    context = multiprocessing.get_context('fork')
    place = tmp_path / 'out'
    put(place, 0, 'main.json', 'a.txt')
    if foreign:
        (place / 'mine').touch()
    for turn in range(20):
        one = context.Process(target=swap_repeatedly, args=(place,))
        one.start()
        one.join(0.02 + 0.003 * turn)
        one.kill()
        one.join()
        now = {k: v for k, v in held(place).items() if k in OURS} if not any(
            p.is_dir() for p in place.iterdir()) else {
            p.name: p.read_text() for p in place.iterdir() if p.name in OURS}
        tags = {text.split()[0] for text in now.values()}
        assert len(tags) <= 1
        if MAIN in now:
            assert set(now) == {MAIN, f'{"ab"[int(tags.pop()) % 2]}.txt'}
        else:
            assert foreign      # replaced file by file: no result without the main file
    put(place, 'last')
    assert not list(tmp_path.rglob('.*'))


def test_without_an_atomic_swap_folders_are_replaced_in_two_steps(tmp_path, monkeypatch):
    class Old:
        renameat2 = None
    monkeypatch.setattr(atomic_files.ctypes, 'CDLL', lambda *_, **__: Old)
    put(tmp_path / 'out', 'one')
    put(tmp_path / 'out', 'two')
    assert held(tmp_path / 'out') == texts('two')
    assert os.listdir(tmp_path) == ['out']
    # killed between the two steps: the next write restores the old folder first
    (tmp_path / 'out').rename(tmp_path / f'.out.{"0" * 32}.part.old')
    with pytest.raises(BadUsage, match='exists'):
        put(tmp_path / 'out', 'three', force=False)
    assert held(tmp_path / 'out') == texts('two')


def test_ctrl_c_waits_for_the_swap(tmp_path, monkeypatch):
    put(tmp_path / 'out', 'one')
    swap = atomic_files._swap

    def interrupted(*paths):
        os.kill(os.getpid(), signal.SIGINT)
        swap(*paths)
    monkeypatch.setattr(atomic_files, '_swap', interrupted)
    # background jobs of a shell ignore SIGINT
    signal.signal(signal.SIGINT, signal.default_int_handler)
    one = ResultFolder(tmp_path / 'out', MAIN, OURS)
    with pytest.raises(KeyboardInterrupt):
        one.put(texts('two'), True)
    assert one.is_unchanged
    assert held(tmp_path / 'out') == texts('two')
    assert os.listdir(tmp_path) == ['out']
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_the_delay_of_ctrl_c_has_no_effect_in_other_threads():
    done = []
    thread = threading.Thread(
        target=lambda: [done.append(1) for _ in [atomic_files.uninterrupted()]])
    thread.start()
    thread.join()
    assert done == [1]


def test_a_failed_write_leaves_only_the_old_file(tmp_path, refuse):
    path = tmp_path / 'a.json'
    atomic_files.write_text(path, 'old')
    for step in range(1, 6):
        refuse(step)
        with pytest.raises(OSError, match='No space'):
            atomic_files.write_text(path, 'new')
        assert path.read_text() == 'old'
        assert list(tmp_path.iterdir()) == [path]
    refuse(0)
    with path.open() as reader:
        atomic_files.write_text(path, json.dumps('new'))
        assert reader.read() == 'old'
