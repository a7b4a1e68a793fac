# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Reading and replaying an hour's bag beside plain reading: each ratio beside its goal, in one run.

    python benchmarks/reader_speed.py [--minutes 60] [--repeat 5] [--camera] [--wall] [--growth]
                                      [--only WORD ...] [--folder DIR]

Writes simulated bags of a town drive (200 Hz IMU, 50 Hz counts, 5 Hz fixes; --camera adds 1 GB of
pictures), each read once before it is timed. Every figure is the median of processes of their own,
in processor seconds (--wall: on the clock), taken in turn, so that other load affects all equally.
``read`` are the file's bytes, unpacked where they are packed; ``raw`` is rosbags' iteration over
the wanted topics, nothing decoded; neither counts its imports. ``auto`` is the replay with all
files and the report, less what the methods themselves take. --growth compares 10 min with 3 h.
"""

import multiprocessing
import os
from pathlib import Path
import statistics
import sys
import tempfile
import time

from harness import parsed

TIMED = """
import sys, time
from pathlib import Path
path, topics = Path(sys.argv[1]), {'/imu/data': 'imu', '/odometer': 'odometer', '/fix': 'fix'}
file = next(f for f in sorted(path.iterdir()) if f.suffix != '.yaml')
clock = time.perf_counter if sys.argv[2] == 'wall' else time.process_time
"""
BARE = TIMED + """
from backports.zstd import ZstdDecompressor
import numpy as np
from odocal_ros.bagio.bag_file import PREALLOCATED_BYTES
from odocal_ros.bagio.mcap_records import CHUNK, CHUNK_HEAD, records_of
# else most of it goes into memory that is made for each chunk
np.empty(PREALLOCATED_BYTES, np.uint8)
began = clock()
with file.open('rb') as f:
    data = f.read()
if path.name.startswith('zstd'):
    for op, body, _ in records_of(memoryview(data), 8):
        if op == CHUNK:
            ZstdDecompressor().decompress(body[44:], CHUNK_HEAD.unpack_from(body)[2])
print(clock() - began)
"""
RAW = TIMED + """
from rosbags.rosbag2 import Reader
began = clock()
with Reader(path) as reader:
    wanted = [c for c in reader.connections if c.topic in topics]
    for connection, stamp, raw in reader.messages(connections=wanted):
        pass
print(clock() - began)
"""
ARRAYS = TIMED + """
from odocal_ros.bagio.read import open_bag
from odocal_ros.data.leg import LegRecorder
from odocal_ros.messages.decode import make_reader
from odocal_ros.settings.config import Config
import odocal_ros.bagio.mcap_columns, yaml
import rosbags.typesys, concurrent.futures.thread
recorder = LegRecorder()
began = clock()
with open_bag(path) as bag:
    bag.read({topic: make_reader(slot, bag.topics[topic].msgtype, Config())
              for topic, slot in topics.items()}, recorder.feed)
rows = [recorder.rows(slot) for slot in topics.values()]
print(clock() - began)
"""
AUTO = TIMED + """
from odocal_ros.offline.cli import main
from odocal_ros.pipeline import methods
run, spent = methods.run_methods, 0.0
def timed(*args):
    global spent
    began = clock()
    found = run(*args)
    spent += clock() - began
    return found
methods.run_methods = timed
main(['replay', str(path), '--quiet', '--force', '--output', sys.argv[3]])
print(spent)
"""
ODOCAL = [sys.executable, '-m', 'odocal_ros.offline.cli']
FILES = ['--set', 'output.formats=[params, transform]']
# what, beside what, and at most so many times that, by kind of bag
GOALS = (('arrays', 'read', {'mcap': 5.0, 'zstd': 4.0, 'sqlite3': 20.0}),
         ('arrays', 'raw', {'mcap': 1 / 8, 'zstd': 1 / 8, 'sqlite3': 2.5}),
         ('two_point', 'raw', {'mcap': 0.8, 'sqlite3': 5.0}),
         ('inspect', 'raw', {'mcap': 0.6, 'sqlite3': 4.0}),
         ('auto', 'raw', {'mcap': 1.2}))
PEAK = {60: 300, 180: 600}       # MiB of two_point, by minutes
HELP = 2.5                       # times a bare python
SHORT, LONG, GROWTH = 10.0, 180.0, 1.1      # min, min, times proportional


def main() -> None:
    """Measure, and print a table."""
    args = parsed(__doc__, minutes=60.0, repeat=5, camera=(False, 'add 1 GB of camera messages'),
                  wall=(False, 'time on the clock'), growth=(False, '10 min beside 3 h'),
                  only={'nargs': '*', 'default': ['mcap', 'zstd', 'sqlite3', 'help']},
                  folder=(Path, 'keep and reuse the bags here'))
    clock = 'wall' if args.wall else 'cpu'
    print(f'{"what":34} {"s":>7} {"beside":>8} {"s":>7} {"ratio":>7} {"goal":>7}')
    with tempfile.TemporaryDirectory() as scratch:
        for kind in [kind for kind in args.only if kind != 'help']:
            folder = args.folder or Path(scratch)
            if args.growth:
                _grown(*(_bag(folder, kind, minutes, args.camera) for minutes in (SHORT, LONG)),
                       args.repeat, clock)
            else:
                _compare(_bag(folder, kind, args.minutes, args.camera), kind, args.repeat, clock,
                         args.minutes)
        if 'help' in args.only and not args.growth:
            bare, shown = (_medians({'x': command}, args.repeat, clock)[0]['x'] for command in (
                [sys.executable, '-c', 'pass'], [*ODOCAL, '--help']))
            _line('odocal --help', shown, 'python', bare, HELP)


def _bag(folder, kind, minutes, camera):
    """Return a simulated bag, written unless it is there."""
    path = folder / f'{kind}_{minutes:g}min{"_camera" * camera}'
    if not path.exists():
        # in another process: the peak memory of those that follow begins with that of their parent
        writer = multiprocessing.get_context('spawn').Process(
            target=_write, args=(path, kind, minutes, camera))
        writer.start()
        writer.join()
    return path


def _camera(time_ns):
    """Return a topic of sensor_msgs/CompressedImage with 200 kB of random bytes each, as CDR."""
    import numpy as np

    from odocal_ros.bagio.encode import Topic
    size, rng = 200_000, np.random.default_rng(1)
    # little-endian, stamp 0, frame_id, format, length of the data
    head = b'\0\1\0\0' + bytes(8) + b'\7\0\0\0camera\0\0' + b'\5\0\0\0jpeg\0\0\0\0' \
        + size.to_bytes(4, 'little')

    def pack(rows):
        messages = [head + rng.bytes(size) for _ in time_ns[rows]]
        return np.array(messages, f'V{len(head) + size}')
    return Topic('/camera', 'sensor_msgs/msg/CompressedImage', time_ns, pack)


def _write(path, kind, minutes, camera):
    import numpy as np

    from odocal_ros.bagio.write import drive_topics, write_bag
    from odocal_ros.sim.scenarios import SimOptions, simulate
    drive = simulate(SimOptions(scenario='town', duration=60.0 * minutes, imu_rate=200.0))
    topics = drive_topics(drive)
    if camera:
        times = np.linspace(*drive.imu.stamp_ns[[0, -1]], 5000).astype(np.int64)
        topics.append(_camera(times))
    path.parent.mkdir(parents=True, exist_ok=True)
    storage, compression = ('mcap', 'storage') if kind == 'zstd' else (kind, 'none')
    write_bag(path, topics, storage=storage, compression=compression)


def _compare(path, kind, repeat, clock, minutes):
    """Print the ratios of a bag."""
    seconds, peak = _measured(path, repeat, clock)
    for what, beside, goals in GOALS:
        if kind in goals:
            _line(f'{path.name}: {what}', seconds[what], beside, seconds[beside], goals[kind])
    most = PEAK.get(minutes)
    print(f'{f"{path.name}: peak of two_point":34} {peak["two_point"]:7.0f} MiB'
          + f' (goal {most})' * bool(most), flush=True)


def _grown(short, long, repeat, clock):
    """Print how what is done grows from a short bag to a long one."""
    (few, _), (many, _) = (_measured(path, repeat, clock) for path in (short, long))
    for what in ('arrays', 'two_point', 'inspect', 'auto'):
        _line(f'{long.name}: {what}', many[what], f'{SHORT:g} min', few[what],
              GROWTH * LONG / SHORT)


def _measured(path, repeat, clock):
    """Return the median seconds of all that is done with a bag, and the peaks, MiB."""
    file = next(f for f in sorted(path.iterdir()) if f.suffix != '.yaml')
    with file.open('rb') as f:
        while f.read(2**20):      # in pieces, for the same reason as in _bag
            pass
    with tempfile.TemporaryDirectory() as out:
        commands = {name: [sys.executable, '-c', script, str(path), clock]
                    for name, script in (('read', BARE), ('raw', RAW), ('arrays', ARRAYS))}
        commands['two_point'] = [*ODOCAL, 'replay', str(path), '--method', 'two_point',
                                 '--quiet', '--force', '--output', out, *FILES]
        commands['inspect'] = [*ODOCAL, 'inspect', str(path)]
        commands['auto'] = [sys.executable, '-c', AUTO, str(path), clock, out]
        return _medians(commands, repeat, clock)


def _line(what, seconds, beside, others, goal) -> None:
    print(f'{what:34} {seconds:7.3f} {beside:>8} {others:7.3f} {seconds / others:7.3f} '
          f'{goal:7.3f} {"" if seconds <= goal * others else "missed"}', flush=True)


def _medians(commands, repeat, clock):
    """Return the median seconds of commands, run in turn, and their peak memory, MiB."""
    seconds, peak = {name: [] for name in commands}, dict.fromkeys(commands, 0.0)
    for _ in range(repeat):
        for name, command in commands.items():
            out, spent, rss = _run(command, clock)
            if name in ('read', 'raw', 'arrays'):      # they say what they took themselves
                spent = float(out.split()[-1])
            elif name == 'auto':                       # it says what its methods took
                spent -= float(out.split()[-1])
            seconds[name].append(spent)
            peak[name] = max(peak[name], rss / 1024)
    return {name: statistics.median(each) for name, each in seconds.items()}, peak


def _run(command, clock):
    """Run a command; return what it printed, its seconds and its peak RSS, KiB."""
    read, write = os.pipe()
    began = time.perf_counter()
    # what is installed has its bytecode beside it
    environment = {k: v for k, v in os.environ.items() if k != 'PYTHONDONTWRITEBYTECODE'}
    pid = os.posix_spawn(command[0], command, environment, file_actions=[
        (os.POSIX_SPAWN_DUP2, write, 1), (os.POSIX_SPAWN_CLOSE, read)])
    os.close(write)
    with os.fdopen(read) as pipe:
        out = pipe.read()
    _, status, usage = os.wait4(pid, 0)
    if os.waitstatus_to_exitcode(status) > 1:
        raise SystemExit(f'{" ".join(command)} failed')
    wall = time.perf_counter() - began
    return out, wall if clock == 'wall' else usage.ru_utime + usage.ru_stime, usage.ru_maxrss


if __name__ == '__main__':
    main()
