"""Kill the node in the middle of a leg and look what its journal has left of it."""

import contextlib
from dataclasses import dataclass
import io
import json
from pathlib import Path
import time

from bench import Client, NodeProcess, wait_for
from player import messages_of, part, Player

from odocal_ros.bagio.read import open_bag
from odocal_ros.offline.cli import main
from odocal_ros.offline.legs import marked_legs
from odocal_ros.sim.scenarios import SimOptions, simulate

SPEED = 10.0      # times real time: 760 messages a second
BEFORE_S, START_S, LAST_S = 30.0, 60.0, 170.0    # of the drive: played from, marked, played to


@dataclass(frozen=True)
class Remains:
    """What a killed leg has left."""

    moment_s: float        # wall time from the mark to the kill
    lost_s: float          # wall time from the newest Imu message in the journal to the kill
    files: int
    marks: list            # (start, stop) as replay finds them
    start_ns: int          # the mark, as the node had published it
    code: int              # of odocal replay
    legs: list             # of calibration.json
    text: str              # what replay said


def drive():
    """Return types and messages of a drive that starts at 60 s."""
    return messages_of(simulate(SimOptions(
        scenario='straight', duration=180.0, imu_rate=50.0, odometer_rate=21.0, fix_rate=5.0,
        odometer='speed', fix_noise='rtk')))


def killed(driven, moment_s: float, folder: Path) -> Remains:
    """Kill a node that records a leg of a drive ``moment_s`` after its start mark."""
    types, sent = driven
    node, client = NodeProcess('-p', f'output.directory:={folder}'), Client()
    try:
        player = Player(client.node, types)
        wait_for(player.matched, 'subscriptions')
        player.play(part(sent, BEFORE_S, START_S), 3 * SPEED)
        client.until(state='idle')
        answer = client.call('start_leg')
        marked = time.monotonic()
        assert answer.success, answer.message
        with player.playing(part(sent, START_S, LAST_S), SPEED):
            status = client.until(state='recording')
            time.sleep(max(0.0, moment_s - (time.monotonic() - marked)))
            end_ns = time.time_ns()
            node.process.kill()
            node.wait()
            moment_s = time.monotonic() - marked
    finally:
        node.end()
        client.close()
    journal, = (folder / 'journal').iterdir()
    return remains(journal, moment_s, end_ns, int(status['leg_start_ns']))


def remains(journal: Path, moment_s: float, end_ns: int, start_ns: int) -> Remains:
    """Return what is left in a journal."""
    with open_bag(journal) as bag:
        newest_ns = max(time_ns for time_ns, _ in bag.messages('/imu/data'))
        marks, files = marked_legs(bag), len(bag.files)
    code, result, said = replayed(journal)
    return Remains(moment_s, (end_ns - newest_ns) * 1e-9, files, marks, start_ns, code,
                   result['legs'] if result else [], said)


def replayed(journal: Path, *more: str) -> tuple[int, dict | None, str]:
    """Return exit code, calibration.json and what ``odocal replay JOURNAL more`` says."""
    out, said = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(said):
        code = main(['replay', str(journal), *more, '--json', '--force', '--output',
                     str(journal.parent.parent / 'replayed')])
    return code, json.loads(out.getvalue()) if out.getvalue() else None, said.getvalue()
