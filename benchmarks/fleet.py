# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Tests of a fleet: detected changes, kills, identical workers, cost of the engine, bad bags.

python benchmarks/fleet.py found FLEET RESULT            result of a run compared with the truth
python benchmarks/fleet.py kills FLEET                   SIGKILL of workers, scheduler, command
python benchmarks/fleet.py identical FLEET               1, 2, 4 workers and TCP: the same rows
python benchmarks/fleet.py cost FLEET                    against plain replay, overhead a bag
python benchmarks/fleet.py bad_bags FLEET                a bag bomb and a bag that hangs

FLEET: a folder of odocal simulate --fleet.
"""

import argparse
from collections import Counter
from contextlib import contextmanager
import csv
from dataclasses import replace
import json
import os
from pathlib import Path
import signal
import socket
import subprocess
import sys
import tempfile
import time

from fleet_processes import children, cluster, fleet_command, process
import numpy as np


def rows_in(output):
    """Return the rows in an output folder by bag, but for how long each took."""
    from odocal_ros.fleet.rows import read_rows
    rows = list(read_rows(sorted((Path(output) / 'rows').rglob('*.parquet'))))
    by_bag = {row.bag: replace(row, seconds=0.0) for row in rows}
    assert len(by_bag) == len(rows), 'a bag has two rows'
    return by_bag


def bags_of(fleet):
    """Return the number of bags of a fleet."""
    return sum(1 for _ in open(Path(fleet) / 'manifest.csv')) - 1


def found(args):
    """Print what was found beside the truth: changes, false alarms, sigmas of the values."""
    import pandas as pd
    import yaml
    truth = yaml.load((args.fleet / 'truth.yaml').read_text(),
                      getattr(yaml, 'CSafeLoader', yaml.SafeLoader))['vehicles']
    table = pd.read_parquet(args.result / 'vehicles.parquet').set_index('vehicle')
    told, invented, deviates = Counter(), Counter(), {'scale_factor': [], 'yaw_mounting_angle': []}
    for vehicle in truth:
        row, dates = table.loc[vehicle['vehicle']], [start[:10] for start in vehicle['start']]
        seen = [(c['value'], dates.index(c['by'][:10])) for c in json.loads(row.changes)]
        last = len(dates) - 1
        for change in vehicle['changes']:
            what, bag = change['value'], change['bag'] - 1
            if what == 'counter':
                since = row.rejected_since
                right = row.verdict == 'rejected' and not pd.isna(since) and abs(
                    dates.index(f'{since:%Y-%m-%d}') - bag) <= 1
                last = None
            else:
                near = [one for one in seen if one[0] == what and abs(one[1] - bag) <= 1]
                right = bool(near)
                seen = [one for one in seen if one not in near[:1]]
            told[what, 'found' if right else 'MISSED'] += 1
        invented.update(what for what, _ in seen)
        if last is None:
            continue
        invented.update(['odd leg'] * len(row.odd_legs.split()))
        true = {'scale_factor': vehicle['scale_factor'][last],
                'yaw_mounting_angle': np.deg2rad(vehicle['yaw_mounting_deg'][last])}
        for name, values in deviates.items():
            if not pd.isna(row[name]):
                values.append((row[name] - true[name]) / row[f'{name}_sigma'])
    print(f'{len(truth)} vehicles, {int(table.bags.sum())} bags, {int(table.bags_failed.sum())} '
          'failed')
    for (what, how), n in sorted(told.items()):
        print(f'  {what} {how}: {n}')
    print(f'  invented: {dict(invented) or "none"} '
          f'({100 * sum(invented.values()) / len(truth):.1f} for 100 vehicles)')
    for name, values in deviates.items():
        if values:
            z = np.array(values)
            print(f'  {name} of {len(z)} vehicles: (value - truth) / sigma has mean '
                  f'{z.mean():+.2f}, rms {np.sqrt((z**2).mean()):.2f}, largest '
                  f'{np.abs(z).max():.1f}')


def kills(args):
    """Kill a worker every few seconds, the command once, the scheduler once; look at the rows."""
    folder = Path(tempfile.mkdtemp(prefix='fleet_kills_'))
    output, killed, deadline = folder / 'out', Counter(), 0.0
    bags = bags_of(args.fleet)
    rng = np.random.default_rng(args.seed)
    with process(*fleet_command(args.fleet, output, '--workers', '2')) as command:
        deadline = time.monotonic() + args.every
        while command.poll() is None:
            time.sleep(0.2)
            count = len(list((output / 'rows').rglob('*.parquet'))) if output.exists() else 0
            if count > bags / 3:
                killed['command'] += 1
                break
            if time.monotonic() > deadline and (workers := children(command.pid)):
                os.kill(int(rng.choice(workers)), signal.SIGKILL)
                killed['worker'] += 1
                deadline = time.monotonic() + args.every
    before = len(rows_in(output))
    with cluster(folder, args.port) as (address, scheduler):
        time.sleep(5)
        with process(*fleet_command(args.fleet, output, '--scheduler', address),
                     stderr=subprocess.PIPE, text=True) as command:
            while command.poll() is None and len(
                    list((output / 'rows').rglob('*.parquet'))) < 2 * bags / 3:
                time.sleep(0.2)
            scheduler.kill()
            killed['scheduler'] += 1
            try:
                _, said = command.communicate(timeout=args.patience)
                print(f'scheduler killed: exit {command.returncode}: {said.strip()[-200:]}')
            except subprocess.TimeoutExpired:
                print('scheduler killed: THE COMMAND STILL WAITS')
    between = len(rows_in(output))
    code = subprocess.run(fleet_command(args.fleet, output, '--workers', '2')).returncode
    rows = rows_in(output)
    states = Counter(row.status for row in rows.values())
    print(f'killed {dict(killed)}; rows of {bags} bags: {before}, then {between}, after the last '
          f'run {len(rows)} ({dict(states)}), exit {code}')
    assert len(rows) == bags
    left = list((output / 'rows').rglob('.*'))
    print(f'parts of files left: {len(left)}')


def identical(args):
    """Compare the rows of one, two and four local workers, and of two over TCP."""
    folder = Path(tempfile.mkdtemp(prefix='fleet_identical_'))
    rows = {}
    for workers in (1, 2, 4):
        subprocess.run(fleet_command(args.fleet, folder / f'{workers}', '--workers',
                                     str(workers)))
        rows[f'{workers} local'] = rows_in(folder / f'{workers}')
    with cluster(folder, args.port) as (address, _):
        subprocess.run(fleet_command(args.fleet, folder / 'tcp', '--scheduler', address))
    rows['2 over TCP'] = rows_in(folder / 'tcp')
    first = rows['1 local']
    assert len(first) == bags_of(args.fleet), 'some bags have no row'
    for name, some in rows.items():
        print(f'{name}: {len(some)} rows, the same to the last bit: {some == first}')


LOOP = """import sys, time
from odocal_ros.offline.cli import main
rest = ['--method', sys.argv[1], '--quiet', '--set', 'output.formats=[legs]']
bags = [*zip(*[iter(sys.argv[2:])] * 3)]
main(['replay', bags[0][0], '--config', bags[0][1], '--output', bags[0][2] + 'first', *rest])
wall, core = time.monotonic(), time.process_time()
for bag, config, out in bags:
    main(['replay', bag, '--config', config, '--output', out, *rest])
print(time.monotonic() - wall, time.process_time() - core)
"""


def by_replay(bags, folder, method):
    """Return the time of two loops of replay side by side, and that of cores, s."""
    loops = [subprocess.Popen([sys.executable, '-c', LOOP, method, *(
        str(x) for i, (bag, config) in enumerate(bags) if i % 2 == k
        for x in (bag, config, folder / f'plain{i}'))], stdout=subprocess.PIPE, text=True)
        for k in (0, 1)]
    times = np.array([loop.communicate()[0].split() for loop in loops], float)
    return times[:, 0].max(), times[:, 1].sum()


def by_engine(fleet, folder, method):
    """Return the time on two workers, that of cores of workers and of the command, s."""
    from odocal_ros.fleet.bag_jobs import bag_jobs, computed_rows
    from odocal_ros.fleet.bags import find_bags
    from odocal_ros.fleet.command import add_arguments
    from odocal_ros.fleet.engine import engine
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    asked = parser.parse_args([str(fleet / 'manifest.csv'), '--output', 'x', '--method', method])
    first, jobs = (bag_jobs(find_bags(asked.bags, None), asked, folder / name, 600.0, 2**31)
                   for name in ('first', 'out'))
    with engine(None, 2, 2**31, 3) as client:
        list(computed_rows(client, first[:4]))      # what is imported once
        began, cpu = time.monotonic(), time.process_time()
        before = sum(client.run(time.process_time).values())
        done = [one for _, one in computed_rows(client, jobs)]
        wall, cpu = time.monotonic() - began, time.process_time() - cpu
        assert all(one.computed for one in done)
        return wall, sum(client.run(time.process_time).values()) - before, cpu


def cost(args):
    """Time two workers against two loops of plain replay, and the engine's own time a bag."""
    folder = Path(tempfile.mkdtemp(prefix='fleet_cost_'))
    with open(args.fleet / 'manifest.csv', newline='') as file:
        bags = [(args.fleet / row['bag'], args.fleet / row['config'])
                for row in csv.DictReader(file)]
    plain, fleet = (np.min(rounds, axis=0) for rounds in zip(*(
        (by_replay(bags, folder / f'{k}', args.method),
         by_engine(args.fleet, folder / f'{k}', args.method))
        for k in range(args.rounds)), strict=True))
    n = len(bags)
    print(f'{n} bags, the least of {args.rounds} rounds; two loops of replay: {plain[0]:.1f} s, '
          f'{1e3 * plain[1] / n:.1f} ms of a core a bag; two workers: {fleet[0]:.1f} s, '
          f'{1e3 * fleet[1] / n:.1f} ms of a core a bag and {1e3 * fleet[2] / n:.1f} ms the '
          f'command; efficiency {plain[0] / fleet[0]:.2f} by the wall, '
          f'{plain[1] / (fleet[1] + fleet[2]):.2f} by cores')


@contextmanager
def silent_server():
    """Give the URL of a bag on a server that takes a call and never says a word."""
    with socket.create_server(('127.0.0.1', 0)) as server:
        yield f'ftp://127.0.0.1:{server.getsockname()[1]}/drive.mcap'


def bad_bags(args):
    """Put a bag that unpacks to 2 GiB and one that hangs among a fleet's; compare the others."""
    from odocal_ros.safe_io.limits import zstd_module
    folder = Path(tempfile.mkdtemp(prefix='fleet_bad_bags_'))
    packer = zstd_module().ZstdCompressor()
    (folder / 'bomb.mcap').write_bytes(
        b''.join([packer.compress(bytes(2**20)) for _ in range(2048)]) + packer.flush())
    with open(args.fleet / 'manifest.csv', newline='') as file:
        good = [row | {'bag': str((args.fleet / row['bag']).resolve()), 'config': str(
            (args.fleet / row['config']).resolve())} for row in csv.DictReader(file)][:198]
    rows = {}
    with silent_server() as url:
        bad = [good[0] | {'bag': str(folder / 'bomb.mcap')}, good[0] | {'bag': url}]
        for name, bags in (('clean', good), ('bad_bags', good[:60] + bad + good[60:])):
            (folder / name).mkdir()
            with open(folder / name / 'manifest.csv', 'w', newline='') as file:
                table = csv.DictWriter(file, list(good[0]))
                table.writeheader()
                table.writerows(bags)
            began = time.monotonic()
            code = subprocess.run(fleet_command(folder / name, folder / name / 'out', '--workers',
                                                '2', '--task-timeout', str(args.every))).returncode
            rows[name] = rows_in(folder / name / 'out')
            print(f'{name}: {len(bags)} bags, {time.monotonic() - began:.0f} s, exit {code}')
    failed = [row for row in rows['bad_bags'].values() if row.status == 'failed']
    same = sum(rows['bad_bags'].get(bag) == row for bag, row in rows['clean'].items())
    print(f'{same} of {len(rows["clean"])} rows the same to the last bit; {len(failed)} failed:')
    for row in failed:
        print(f'  {Path(row.bag).name}: {row.reason}')


def main():
    """Run the selected tests."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_subparsers(required=True)
    for function in (found, kills, identical, cost, bad_bags):
        sub = what.add_parser(function.__name__)
        sub.set_defaults(run=function)
        sub.add_argument('--seed', type=int, default=1)
        sub.add_argument('fleet', type=Path)
        sub.add_argument('--port', type=int, default=28786)
        if function is found:
            sub.add_argument('result', type=Path)
        if function is cost:
            sub.add_argument('--rounds', type=int, default=3)
            sub.add_argument('--method', default='two_point')
        if function in (kills, bad_bags):
            sub.add_argument('--every', type=float, default=20.0)
            sub.add_argument('--patience', type=float, default=120.0)
    args = parser.parse_args()
    args.run(args)


if __name__ == '__main__':
    main()
