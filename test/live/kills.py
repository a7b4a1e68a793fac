# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Kill the node during a leg and read what its journal contains."""

import contextlib
import io
import json
from pathlib import Path
import time
from types import SimpleNamespace

from bench import wait_for
from player import messages_of, playing_to, stamp_of, within

from odocal_ros.bagio.read import open_bag
from odocal_ros.library.find_legs import marked_legs
from odocal_ros.offline.cli import main
from odocal_ros.sim.scenarios import SimOptions, simulate

SCALE = 1.02      # true
SPEED = 10.0      # times real time: 380 messages a second
BEFORE_S, START_S, LAST_S = 30.0, 60.0, 170.0    # of the drive: start of playing, start mark, end
NUMBERS = ('--set', 'output.formats=[params]')   # no report is drawn


def drive():
    """Return types and messages of a drive that starts at 60 s."""
    return messages_of(simulate(SimOptions(
        scenario='straight', duration=180.0, imu_rate=25.0, odometer_rate=11.0, fix_rate=2.0,
        odometer='speed', fix_noise='rtk', scale=SCALE)))


def killed(driven, moment_s: float, folder: Path) -> SimpleNamespace:
    """Kill a node that records a leg of a drive ``moment_s`` after its start mark."""
    with playing_to(driven, {'output.directory': folder}, 3 * SPEED) as leg:
        leg.record(BEFORE_S, START_S)
        marked, client = time.monotonic(), leg.client
        with leg.playing(START_S, LAST_S, SPEED):
            status = client.until(state='recording')
            time.sleep(max(0.0, moment_s - (time.monotonic() - marked)))
            # on a busy machine: wait until the node has received most of the leg
            wait_for(lambda: duration_in_status(client) >= moment_s - 1.0, 'the leg in the status')
            leg_s, end_ns = duration_in_status(client), time.time_ns()
            leg.node.process.kill()
            leg.node.wait()
            moment_s = time.monotonic() - marked
    journal, = (folder / 'journal').iterdir()
    return remains(journal, moment_s, end_ns, int(status['leg_start_ns']), leg_s)


def duration_in_status(client) -> float:
    """Return the duration of the leg in the newest status, s of wall time."""
    return float(client.status['duration_s']) / SPEED


def remains(journal: Path, moment_s: float, end_ns: int, start_ns: int,
            leg_s: float = 0.0) -> SimpleNamespace:
    """
    Return the content of a journal: files, marks found by replay, and the result of replay.

    moment_s : wall time from the mark to the kill.   end_ns : time of the kill.   start_ns : start
    mark in the status.   leg_s : duration of the leg in the last status, s of wall time.
    """
    with open_bag(journal) as bag:
        rows = [(time_ns, stamp_of(m)) for time_ns, m in bag.messages('/imu/data')]
        newest_ns = max(time_ns for time_ns, _ in rows)
        kept_s = (max(stamp for _, stamp in rows) - start_ns) * 1e-9 / SPEED
        marks, files = marked_legs(bag), len(bag.files)
    code, result, stderr = replayed(journal, *NUMBERS)
    return SimpleNamespace(
        moment_s=moment_s, leg_s=leg_s, files=files, marks=marks, start_ns=start_ns, code=code,
        text=stderr, results=[result] if result else [], legs=result['legs'] if result else [],
        # lost wall time, and by how much the journal is shorter than the leg in the status
        lost_s=(end_ns - newest_ns) * 1e-9, short_s=leg_s - kept_s)


def stamps_of(journal: Path, topic: str) -> list[int]:
    """Return the header stamps of a topic, ns."""
    with open_bag(journal) as bag:
        return [stamp_of(message) for _, message in bag.messages(topic)]


def replayed(journal: Path, *more: str) -> tuple[int, dict | None, str]:
    """Return exit code, calibration.json and stderr of ``odocal replay JOURNAL more``."""
    out, stderr = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(stderr):
        code = main(['replay', str(journal), *more, '--json', '--force', '--output',
                     str(journal.parent.parent / 'replayed')])
    return code, json.loads(out.getvalue()) if out.getvalue() else None, stderr.getvalue()


def killed_at_files(driven, stage: str, moment_s: float, folder: Path,
                    **settings) -> SimpleNamespace:
    """
    Kill a node ``moment_s`` after a call of ~/stop_leg, or of ~/save after it (stage).

    Return calibration.json of each complete result, folders with an incomplete one, whether latest
    is missing or points at a complete one, and the output of ``replayed`` for the journal.
    """
    with playing_to(driven, {'output.directory': folder} | settings, 3 * SPEED) as leg:
        leg.record(BEFORE_S, START_S, LAST_S)
        call, begin = leg.client.ask('stop_leg'), time.monotonic()
        leg.play(LAST_S, LAST_S + 2)
        if stage == 'save':
            leg.client.result(call)
            leg.client.ask('save')
            begin = time.monotonic()
        time.sleep(max(0.0, moment_s - (time.monotonic() - begin)))
        leg.node.process.kill()
        leg.node.wait()
    journal, = (folder / 'journal').iterdir()
    results = [path for path in folder.iterdir() if path.is_dir() and not path.is_symlink()
               and path.name != 'journal' and not path.name.startswith('.')]
    contents = {path: whole_content(path) for path in results}
    latest = folder / 'latest'
    whole, replay = [c for c in contents.values() if c], replayed(journal, *NUMBERS)
    return SimpleNamespace(
        whole=whole, journal=replay, results=[*whole, *filter(None, [replay[1]])],
        half=[path for path, c in contents.items() if c is None and any(path.iterdir())],
        latest=not latest.is_symlink() or bool(whole_content(latest)))


def same_result(live: dict, offline: dict, *more: str) -> None:
    """Assert that two results are the same in every digit; more : further keys to compare."""
    for key in ('result', 'verdict', 'reasons', 'methods', 'check', *more):
        assert live[key] == offline[key], key


def check_replay(live: dict, journal: Path) -> str:
    """Assert that a journal replays to the result of the node, to the last bit; return its log."""
    code, offline, stderr = replayed(journal)
    assert code == 0, stderr
    same_result(live, offline, 'config')
    for here, there in zip(live['legs'], offline['legs'], strict=True):
        assert here | {'bag': journal.name} == there
    assert live['inputs'][0]['topics'] == offline['inputs'][0]['topics']
    return stderr


def wrong(left: SimpleNamespace) -> list[float]:
    """Return the scale factors that were not rejected and are wrong by more than 5 sigmas."""
    scales = [one['result']['scale_factor'] for one in left.results
              if one['verdict'] != 'rejected']
    return [scale['value'] for scale in scales if scale['value'] and not within(scale, SCALE, 5)]


def whole_content(folder: Path) -> dict | None:
    """Return calibration.json if all other files are of the same calibration, else None."""
    try:
        content = json.loads((folder / 'calibration.json').read_text())
    except FileNotFoundError:
        return None
    others = [p for p in folder.iterdir() if p.suffix in ('.yaml', '.txt', '.xml', '.urdf')]
    same = all(content['created'] in path.read_text() for path in others)
    return content if same and (folder / 'calibration.yaml') in others else None
