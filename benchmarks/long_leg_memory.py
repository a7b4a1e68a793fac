# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
What a long leg takes of memory: peak RSS beside its goal, for replay and for the node.

    python benchmarks/long_leg_memory.py [--hours 3 2] [--imu 1000] [--looks 3] [--bag BAG]

Writes a simulated town drive (200 Hz IMU, 50 Hz counts, 2 Hz fixes; kept with --bag) and runs, one
after the other,

replay   ``odocal replay`` of the whole drive
node     with all of the node's modules, what the node does with each message between the wire and
         the result, at once and not in real time: recorder, thinned, --looks running estimates
         evenly through the leg, and then the computing. IMU rows are laid between those of the bag
         until they come at --imu Hz. What DDS and the journal hold (the journal: seconds) is left
         out.
"""

import argparse
import contextlib
from dataclasses import fields, replace
from pathlib import Path
import subprocess
import sys
import tempfile
import time

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

BASE_HZ = 200.0
REPLAY_GOAL, NODE_GOAL = 600, 300     # MiB
POLL = 50                             # IMU rows in a block, as at 1 kHz


def peak_mib() -> float:
    """Return the largest resident size of this process since it was last asked."""
    status = Path('/proc/self/status').read_text()
    Path('/proc/self/clear_refs').write_text('5')
    return int(status.split('VmHWM:')[1].split()[0]) / 1024


def finer(block, before, times):
    """Return an IMU block with rows laid between those of it, and its last row."""
    import numpy as np

    from odocal_ros.data.samples import join, take
    if before is not None:
        block = join([before, block])
    n = len(block.stamp_ns)
    at = np.arange((n - 1) * times + 1) / times
    base = int(block.stamp_ns[0])

    def between(x):
        flat = x.reshape(n, -1)
        rows = np.stack([np.interp(at, np.arange(n), column) for column in flat.T], -1)
        return rows.reshape(len(at), *x.shape[1:])

    columns = {f.name: between(getattr(block, f.name)) for f in fields(block)
               if not f.name.endswith('_ns')}
    stamps = {name: base + between(getattr(block, name) - base).astype(np.int64)
              for name in ('stamp_ns', 'received_ns')}
    return take(replace(block, **columns, **stamps), slice(1 if before else 0, None)), \
        take(block, slice(-1, None))


def node(bag_path, hours, imu_hz, looks) -> None:
    """Do what the node does of a leg, and print the peaks."""
    from odocal_ros.bagio.read import open_bag
    from odocal_ros.data.leg import LegRecorder
    from odocal_ros.data.samples import take
    from odocal_ros.forecast.leg_forecast import forecast_leg
    from odocal_ros.forecast.leg_so_far import SmootherSoFar
    from odocal_ros.forecast.thinned_leg import ThinnedLeg
    import odocal_ros.live.node  # noqa: F401 all that a node holds
    from odocal_ros.live.worker import compute, limit_kept_memory, release_memory
    from odocal_ros.messages.decode import make_reader
    from odocal_ros.settings.config import Config
    limit_kept_memory()
    print(f'node, modules loaded: {peak_mib():.0f} MiB', flush=True)
    config, recorder, thinned, smoother = Config(), LegRecorder(), ThinnedLeg(), SmootherSoFar()
    last, begin, done = {}, [], []

    class Full(Exception):
        pass

    def feed(slot, block):
        recorder.feed(slot, block)
        thinned.feed(slot, block)

    def take_in(slot, block):
        for first in range(0, len(block.stamp_ns), 1000):     # no larger than what is polled
            some = take(block, slice(first, first + 1000))
            if slot != 'imu':
                feed(slot, some)
                continue
            some, last[slot] = finer(some, last.get(slot), round(imu_hz / BASE_HZ))
            for k in range(0, len(some.stamp_ns), POLL):
                recorder.feed(slot, take(some, slice(k, k + POLL)))
            thinned.feed(slot, some)
        if slot == 'imu':
            newest = int(block.stamp_ns[-1])
            look_at(newest)

    def look_at(newest):
        if not begin:
            begin.append(newest)
        gone = (newest - begin[0]) * 1e-9
        if looks and gone > (len(done) + 1) * hours * 3600 / looks * 0.999:
            done.append(gone)
            forecast_leg(thinned.leg(begin[0]), thinned.fix_rate(), config, lambda: True, smoother)
            release_memory()
            print(f'node, {gone / 3600:.1f} h recorded, estimate running: {peak_mib():.0f} MiB '
                  f'(goal {NODE_GOAL})', flush=True)
        if gone > hours * 3600:
            raise Full

    with open_bag(bag_path) as bag:
        readers = {topic: make_reader(slot, bag.topics[topic].msgtype, config) for slot, topic in (
            ('imu', '/imu/data'), ('odometer', '/odometer'), ('fix', '/fix'))}
        with contextlib.suppress(Full):
            bag.read(readers, take_in)
        recorder.form = readers['/odometer'].form
    print(f'node, recorded: {peak_mib():.0f} MiB (goal {NODE_GOAL})', flush=True)
    release_memory()     # as the worker does after each look
    stop = recorder.newest_ns('imu')
    began = time.perf_counter()
    result, = compute(recorder.snapshot(), begin[0], stop, [], config,
                      progress=lambda *_: release_memory()).results
    scale = result.methods['smoother'].estimates['scale_factor']
    print(f'node, computed ({result.imu_samples} IMU rows, {time.perf_counter() - began:.0f} s, '
          f'scale {scale.value} +- {scale.sigma}): {peak_mib():.0f} MiB (goal {NODE_GOAL})',
          flush=True)


def replay(bag_path, scratch) -> None:
    """Replay and print the peak."""
    import resource

    from odocal_ros.offline.cli import main as odocal
    began = time.perf_counter()
    try:
        odocal(['replay', str(bag_path), '--output', f'{scratch}/out', '--force', '--quiet'])
    except SystemExit as end:
        if end.code and end.code > 1:
            raise
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f'replay, {time.perf_counter() - began:.0f} s: {peak:.0f} MiB (goal {REPLAY_GOAL})',
          flush=True)


def main() -> None:
    """Run both, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--hours', type=float, nargs=2, default=(3.0, 2.0))
    parser.add_argument('--imu', type=float, default=1000.0, help='Hz of the node')
    parser.add_argument('--looks', type=int, default=3)
    parser.add_argument('--bag', type=Path, help='bag to read; written if it is not there')
    parser.add_argument('--role', choices=('replay', 'node'))
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        bag = args.bag or Path(scratch) / 'drive'
        if args.role:
            (replay(bag, scratch) if args.role == 'replay' else
             node(bag, args.hours[1], args.imu, args.looks))
            return
        if not bag.exists():
            subprocess.run([sys.executable, '-m', 'odocal_ros.offline.cli', 'simulate',
                            '--scenario', 'town', '--duration', str(3600 * max(args.hours)),
                            '--imu-rate', str(BASE_HZ), '--fix-rate', '2', '--out', str(bag),
                            '--quiet'], check=True)
        for role in ('replay', 'node'):
            subprocess.run([sys.executable, __file__, '--bag', str(bag), '--role', role,
                            '--hours', *map(str, args.hours), '--imu', str(args.imu),
                            '--looks', str(args.looks)], check=True)


if __name__ == '__main__':
    main()
