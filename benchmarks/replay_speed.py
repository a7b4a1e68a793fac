"""
Replay beside plain rosbags reading, in one run: time and memory, with and without a camera.

    python benchmarks/replay_speed.py [--hours 1] [--camera] [--repeat 3] [--folder DIR]

Writes simulated bags (200 Hz Imu, 50 Hz pulses, 5 Hz fixes), then for each storage runs in turn a
process that only iterates over the raw messages (rosbag2.Reader, nothing decoded) and a whole
``odocal replay --method two_point``. Goal: replay within 2.5 times (sqlite3) or 2 times (mcap) the
iteration plus one second of start-up, under 1 GiB.
"""

import argparse
import os
from pathlib import Path
import statistics
import sys
import tempfile
import time

GOAL = {'sqlite3': 2.5, 'mcap': 2.0}
ITERATE = """
import sys, time
from rosbags.rosbag2 import Reader
began = time.perf_counter()
count = 0
with Reader(sys.argv[1]) as reader:
    wanted = [c for c in reader.connections if c.topic in ("/imu/data", "/odometer", "/fix")]
    for connection, stamp, raw in reader.messages(connections=wanted):
        count += 1
print(count, time.perf_counter() - began)
"""


def main() -> None:
    """Run the comparison and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('--hours', type=float, default=1.0)
    parser.add_argument('--camera', action='store_true', help='add 1 GB of camera messages')
    parser.add_argument('--repeat', type=int, default=3)
    parser.add_argument('--folder', type=Path, help='keep and reuse the bags here')
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = args.folder or Path(scratch)
        print(f'{"bag":28} {"messages":>9} {"raw s":>7} {"replay s":>9} {"x raw":>6} '
              f'{"(replay-1)/raw":>15} {"goal":>5} {"peak MiB":>9}')
        for storage in GOAL:
            for camera in [False] + [True] * args.camera:
                _compare(_bag(folder, storage, camera, args.hours), storage, args.repeat)


def _bag(folder, storage, camera, hours):
    """Return a simulated bag, written unless it is there."""
    from odocal_ros.bagio.encode import camera as camera_topic
    from odocal_ros.bagio.write import drive_topics, write_bag
    from odocal_ros.sim.scenarios import SimOptions, simulate
    path = folder / f'{hours:g}h_{storage}{"_camera" * camera}'
    if path.exists():
        return path
    import numpy as np
    drive = simulate(SimOptions(scenario='straight', duration=3600.0 * hours, imu_rate=200.0))
    topics = drive_topics(drive)
    if camera:
        size, count = 200_000, 5000
        times = np.linspace(drive.imu.stamp_ns[0], drive.imu.stamp_ns[-1], count).astype(np.int64)
        topics.append(camera_topic('/camera', times, size, np.random.default_rng(1)))
    folder.mkdir(parents=True, exist_ok=True)
    return write_bag(path, topics, storage=storage)


def _compare(path, storage, repeat):
    raw, replay, peak, count = [], [], 0, 0
    for _ in range(repeat):         # in turn, so that a busy machine hurts both alike
        out, _, _ = _run([sys.executable, '-c', ITERATE, str(path)])
        count, seconds = int(out.split()[0]), float(out.split()[1])
        raw.append(seconds)
        with tempfile.TemporaryDirectory() as output:
            _, seconds, rss = _run([sys.executable, '-m', 'odocal_ros.offline.cli', 'replay',
                                    str(path), '--method', 'two_point', '--quiet', '--force',
                                    '--output', output])
        replay.append(seconds)
        peak = max(peak, rss)
    a, b = statistics.median(raw), statistics.median(replay)
    print(f'{path.name:28} {count:9d} {a:7.2f} {b:9.2f} {b / a:6.2f} {(b - 1) / a:15.2f} '
          f'{GOAL[storage]:5.1f} {peak / 1024:9.0f}')


def _run(command):
    """Run a command; return what it printed, its wall seconds and its peak RSS, KiB."""
    read, write = os.pipe()
    began = time.perf_counter()
    pid = os.posix_spawn(command[0], command, os.environ, file_actions=[
        (os.POSIX_SPAWN_DUP2, write, 1), (os.POSIX_SPAWN_CLOSE, read)])
    os.close(write)
    with os.fdopen(read) as pipe:
        out = pipe.read()
    _, status, usage = os.wait4(pid, 0)
    if os.waitstatus_to_exitcode(status) > 1:
        raise SystemExit(f'{" ".join(command)} failed')
    return out, time.perf_counter() - began, usage.ru_maxrss


if __name__ == '__main__':
    main()
