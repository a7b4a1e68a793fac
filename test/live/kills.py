# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Kill the node in the middle of a leg and look what its journal has left of it."""

import contextlib
from dataclasses import dataclass
import io
import json
from pathlib import Path
import time

from bench import wait_for
from player import messages_of, part, playing_to

from odocal_ros.bagio.read import open_bag
from odocal_ros.library.legs import marked_legs
from odocal_ros.offline.cli import main
from odocal_ros.sim.scenarios import SimOptions, simulate

SCALE = 1.02      # true
SPEED = 10.0      # times real time: 380 messages a second
BEFORE_S, START_S, LAST_S = 30.0, 60.0, 170.0    # of the drive: played from, marked, played to
NUMBERS = ('--set', 'output.formats=[params]')   # no report is drawn


@dataclass(frozen=True)
class Remains:
    """What a killed leg has left."""

    moment_s: float        # wall time from the mark to the kill
    lost_s: float          # wall time from the newest IMU message in the journal to the kill
    told_s: float          # how long the leg was by the last status, in the time that it played
    short_s: float         # by how much the journal is shorter than that
    files: int
    marks: list            # (start, stop) as replay finds them
    start_ns: int          # the mark, as the node had published it
    code: int              # of odocal replay
    legs: list             # of calibration.json
    text: str              # what replay said
    result: dict | None    # calibration.json


def drive():
    """Return types and messages of a drive that starts at 60 s."""
    return messages_of(simulate(SimOptions(
        scenario='straight', duration=180.0, imu_rate=25.0, odometer_rate=11.0, fix_rate=2.0,
        odometer='speed', fix_noise='rtk', scale=SCALE)))


def killed(driven, moment_s: float, folder: Path, *args: str) -> Remains:
    """Kill a node that records a leg of a drive ``moment_s`` after its start mark."""
    types, sent = driven
    with playing_to(types, '-p', f'output.directory:={folder}', *args) as (node, client, player):
        player.play(part(sent, BEFORE_S, START_S), 3 * SPEED)
        client.until(state='idle')
        answer = client.call('start_leg')
        marked = time.monotonic()
        assert answer.success, answer.message
        with player.playing(part(sent, START_S, LAST_S), SPEED):
            status = client.until(state='recording')
            time.sleep(max(0.0, moment_s - (time.monotonic() - marked)))
            # a busy machine: by then the node must have heard of most of it
            wait_for(lambda: told(client) >= moment_s - 1.0, 'the leg in the status')
            told_s, end_ns = told(client), time.time_ns()
            node.process.kill()
            node.wait()
            moment_s = time.monotonic() - marked
    journal, = (folder / 'journal').iterdir()
    return remains(journal, moment_s, end_ns, int(status['leg_start_ns']), told_s)


def told(client) -> float:
    """Return how long the leg is by the newest status, in s as it is played."""
    return float(client.status['duration_s']) / SPEED


def remains(journal: Path, moment_s: float, end_ns: int, start_ns: int,
            told_s: float = 0.0) -> Remains:
    """Return what is left in a journal."""
    with open_bag(journal) as bag:
        rows = [(time_ns, m.header.stamp) for time_ns, m in bag.messages('/imu/data')]
        newest_ns = max(time_ns for time_ns, _ in rows)
        kept_s = max(s.sec * 10**9 + s.nanosec - start_ns for _, s in rows) * 1e-9 / SPEED
        marks, files = marked_legs(bag), len(bag.files)
    code, result, said = replayed(journal, *NUMBERS)
    return Remains(moment_s, (end_ns - newest_ns) * 1e-9, told_s, told_s - kept_s, files, marks,
                   start_ns, code, result['legs'] if result else [], said, result)


def replayed(journal: Path, *more: str) -> tuple[int, dict | None, str]:
    """Return exit code, calibration.json and what ``odocal replay JOURNAL more`` says."""
    out, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        code = main(['replay', str(journal), *more, '--json', '--force', '--output',
                     str(journal.parent.parent / 'replayed')])
    return code, json.loads(out.getvalue()) if out.getvalue() else None, said.getvalue()


@dataclass(frozen=True)
class Files:
    """What a node that was killed at its files has left of results."""

    whole: list            # calibration.json of each result folder that has one
    half: list             # folders with files of a result, and no calibration.json or another's
    latest: bool           # points at a whole one, or is not there
    journal: tuple         # code, calibration.json and words of a replay of the journal


def killed_at_files(driven, stage: str, moment_s: float, folder: Path, *args: str) -> Files:
    """Kill a node ``moment_s`` after ~/stop_leg was asked, or ~/save after that (stage)."""
    types, sent = driven
    with playing_to(types, '-p', f'output.directory:={folder}', *args) as (node, client, player):
        player.play(part(sent, BEFORE_S, START_S), 3 * SPEED)
        client.until(state='idle')
        client.start()
        player.play(part(sent, START_S, LAST_S), 3 * SPEED)
        asked, begin = client.ask('stop_leg'), time.monotonic()
        player.play(part(sent, LAST_S, LAST_S + 2), 3 * SPEED)
        if stage == 'save':
            client.result(asked)
            client.ask('save')
            begin = time.monotonic()
        time.sleep(max(0.0, moment_s - (time.monotonic() - begin)))
        node.process.kill()
        node.wait()
    journal, = (folder / 'journal').iterdir()
    results = [path for path in folder.iterdir() if path.is_dir() and not path.is_symlink()
               and path.name != 'journal' and not path.name.startswith('.')]
    contents = {path: whole_content(path) for path in results}
    latest = folder / 'latest'
    return Files([c for c in contents.values() if c],
                 [path for path, c in contents.items() if c is None and any(path.iterdir())],
                 not latest.is_symlink() or bool(whole_content(latest)),
                 replayed(journal, *NUMBERS))


def same_result(live: dict, offline: dict, *more: str) -> None:
    """Assert that two results are the same in every digit, and more of their parts."""
    for key in ('result', 'verdict', 'reasons', 'methods', 'check', *more):
        assert live[key] == offline[key], key


def check_replay(live: dict, journal: Path) -> str:
    """Assert that a journal replays to the result of the node, to the last bit; return its log."""
    code, offline, said = replayed(journal)
    assert code == 0, said
    same_result(live, offline, 'config')
    for here, there in zip(live['legs'], offline['legs'], strict=True):
        assert here | {'bag': journal.name} == there
    assert live['inputs'][0]['topics'] == offline['inputs'][0]['topics']
    return said


def wrong(left: Files | Remains) -> list[float]:
    """Return by how many sigmas values that were not rejected miss the truth, where too many."""
    found = [*left.whole, left.journal[1]] if isinstance(left, Files) else [left.result]
    scales = [one['result']['scale_factor'] for one in found
              if one and one['verdict'] != 'rejected']
    off = [abs(scale['value'] - SCALE) / scale['sigma'] for scale in scales if scale['value']]
    return [sigmas for sigmas in off if sigmas > 5]


def whole_content(folder: Path) -> dict | None:
    """Return calibration.json where all that stands beside it is of the same calibration."""
    try:
        content = json.loads((folder / 'calibration.json').read_text())
    except FileNotFoundError:
        return None
    others = [p for p in folder.iterdir() if p.suffix in ('.yaml', '.txt', '.xml', '.urdf')]
    same = all(content['created'] in path.read_text() for path in others)
    return content if same and (folder / 'calibration.yaml') in others else None
