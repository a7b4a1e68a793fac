# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Result folders that are read-only, removed, or another node's as well: told, nothing half."""

from pathlib import Path
import shutil

from bench import answer_of, wait_for
from kills import drive, LAST_S, START_S, whole_content
from player import part, Player
import pytest

pytestmark = pytest.mark.slow
SCALE, SPEED = 1.02, 30.0
QUICK = ('-p', 'method:=two_point')     # the files are the same
OBEY = (f'import sys; sys.path.insert(0, {str(Path(__file__).resolve().parents[1])!r})\n'
        'from faults import obey_permissions; obey_permissions()\n')


@pytest.fixture(scope='module')
def driven():
    return drive()


def leg(driven, clients, between=lambda: None):
    """Drive a leg for nodes that hear the same topics; return their answers."""
    types, sent = driven
    player = Player(clients[0].node, types)
    wait_for(lambda: all(p.get_subscription_count() == len(clients)
                         for p in player.publishers.values()), 'subscriptions')
    player.play(part(sent, 30, START_S), SPEED)
    for client in clients:
        client.until(state='idle')
        client.start()
    player.play(part(sent, START_S, 100), SPEED)
    between()
    player.play(part(sent, 100, LAST_S), SPEED)
    asked = [client.ask('stop_leg') for client in clients]
    player.play(part(sent, LAST_S, LAST_S + 2), SPEED)
    answers = [client.result(one) for client, one in zip(clients, asked, strict=True)]
    assert all(answer.success for answer in answers), answers
    return answers


def true(content):
    scale = content['result']['scale_factor']
    return abs(scale['value'] - SCALE) < 5 * scale['sigma']


def results(folder):
    """Return the folders that were written for results, whatever is in them."""
    return [path for path in folder.iterdir() if path.name != 'journal' and not path.is_symlink()]


def test_a_folder_that_nobody_may_write_is_told_and_used_once_it_can_be(
        start, connect, driven, tmp_path):
    folder = tmp_path / 'shut'
    folder.mkdir()
    folder.chmod(0o555)
    node = start('-p', f'output.directory:={folder}', *QUICK, before=OBEY)
    client = connect()
    leg(driven, [client])
    status = wait_for(lambda: client.status['save_trouble'] and client.status, 'the warning')
    assert 'Permission denied' in status['save_trouble']
    assert str(folder) in status['save_trouble']
    assert 'Permission denied' in status['journal_trouble']
    assert status['level'] == b'\x01'
    assert abs(float(status['scale_factor']) - SCALE) < 5 * float(status['scale_factor_sigma'])
    assert list(folder.iterdir()) == []
    folder.chmod(0o755)
    answer = client.call('save')
    assert answer.success, answer.message
    one, = results(folder)
    assert true(whole_content(one))
    assert (folder / 'latest').resolve() == one
    assert client.until(save_trouble='')['saved'] == str(one)
    # the folder of the next save can be set after the leg, too
    assert client.set(output__directory=str(tmp_path / 'other')).successful
    answer = client.call('save')
    assert answer.success, answer.message
    other, = results(tmp_path / 'other')
    assert true(whole_content(other))
    assert len(results(folder)) == 1
    assert node.process.poll() is None


def test_a_folder_removed_while_a_leg_is_driven_is_made_again(start, connect, driven, tmp_path):
    folder = tmp_path / 'gone'
    start('-p', f'output.directory:={folder}', *QUICK)
    client = connect()

    def remove():
        wait_for(lambda: list(folder.glob('journal/*/*.mcap')), 'the journal')
        shutil.rmtree(folder)
    leg(driven, [client], remove)
    wait_for(lambda: client.status['journal_trouble'] or (folder / 'journal').exists(),
             'a warning, or the journal anew')
    wait_for((folder / 'latest').exists, 'the result')
    one, = results(folder)
    assert true(whole_content(one))
    assert client.until(saved=str(one))['save_trouble'] == ''


def test_two_nodes_that_save_into_one_folder_have_a_result_each(
        start, connect, driven, tmp_path):
    names = ('first', 'second')
    nodes = [start('-r', f'__node:={name}', '-p', 'output.formats:=[params, transform]', *QUICK)
             for name in names]
    clients = [connect(name) for name in names]
    leg(driven, clients)
    saves = [client.ask('save') for client in clients for _ in range(3)]
    answers = [answer_of(one) for one in saves]
    assert all(answer.success for answer in answers), answers
    folders = results(tmp_path)
    assert len(folders) == 8              # each node saved by itself, too
    assert all(true(whole_content(one)) for one in folders)
    assert (tmp_path / 'latest').resolve() in folders
    for client in clients:
        assert Path(client.status['saved']) in folders
    journals = {client.status['journal'] for client in clients}
    assert len(journals) == len(list((tmp_path / 'journal').iterdir())) == 2
    assert not list(tmp_path.rglob('.*.part'))
    assert all(node.end() == 0 for node in nodes)
