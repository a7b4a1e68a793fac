"""
A fleet as it must stand: found changes, kills, workers alike, cost of the engine, bad bags.

python benchmarks/fleet.py found FLEET RESULT            what a run found beside the truth
python benchmarks/fleet.py kills FLEET                   SIGKILL of workers, scheduler, command
python benchmarks/fleet.py alike FLEET                   1, 2 workers and TCP: the same rows
python benchmarks/fleet.py cost FLEET                    against plain replay, overhead a bag
python benchmarks/fleet.py spoilt FLEET                  a bag bomb and a bag that hangs

FLEET: a folder of odocal simulate --fleet.
"""

import argparse
from collections import Counter
from contextlib import contextmanager, suppress
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

import numpy as np

ODOCAL = [sys.executable, '-m', 'odocal_ros.offline.cli']
QUICK = ['--method', 'two_point', '--reports', 'none', '--quiet']


def rows_in(output):
    """Return the rows in an output folder by bag, but for how long each took."""
    from odocal_ros.fleet.rows import rows_of
    rows = list(rows_of(sorted((Path(output) / 'rows').rglob('*.parquet'))))
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


@contextmanager
def process(*command, **options):
    """Run a command beside, and end it with all of its own."""
    running = subprocess.Popen(command, start_new_session=True, **options)
    try:
        yield running
    finally:
        with suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGKILL)
        running.wait()


@contextmanager
def cluster(folder, port, workers=2):
    """Run a dask scheduler and workers over TCP; give its address and the processes."""
    env = os.environ | {'OPENBLAS_NUM_THREADS': '1'}
    quiet = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.DEVNULL, 'env': env}
    address = f'tcp://127.0.0.1:{port}'
    dask = [sys.executable, '-m', 'dask']
    with process(*dask, 'scheduler', '--host', '127.0.0.1', '--port', str(port),
                 '--no-dashboard', **quiet) as scheduler:
        worker = [*dask, 'worker', address, '--nthreads', '1', '--no-dashboard',
                  '--memory-limit', '0', '--local-directory', str(folder)]
        with process(*worker, '--nworkers', str(workers), **quiet):
            yield address, scheduler


def children(pid):
    """Return the processes that run tasks below one."""
    import psutil
    try:
        every = psutil.Process(pid).children(recursive=True)
        return [p.pid for p in every if 'spawn_main' in ' '.join(p.cmdline())]
    except psutil.Error:
        return []


def fleet_command(fleet, output, *options):
    """Return the command that computes a fleet."""
    return [*ODOCAL, 'fleet', str(fleet / 'manifest.csv'), '--output', str(output), *QUICK,
            *options]


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


def alike(args):
    """Compare the rows of one and two local workers, and of two over TCP."""
    folder = Path(tempfile.mkdtemp(prefix='fleet_alike_'))
    rows = {}
    for workers in (1, 2):
        subprocess.run(fleet_command(args.fleet, folder / f'{workers}', '--workers',
                                     str(workers)))
        rows[f'{workers} local'] = rows_in(folder / f'{workers}')
    with cluster(folder, args.port) as (address, _):
        subprocess.run(fleet_command(args.fleet, folder / 'tcp', '--scheduler', address))
    rows['2 over TCP'] = rows_in(folder / 'tcp')
    first = rows['1 local']
    for name, some in rows.items():
        print(f'{name}: {len(some)} rows, the same to the last bit: {some == first}')


def cost(args):
    """Time two workers against two loops of plain replay, and the engine's own time a bag."""
    folder = Path(tempfile.mkdtemp(prefix='fleet_cost_'))
    with open(args.fleet / 'manifest.csv', newline='') as file:
        bags = [(args.fleet / row['bag'], args.fleet / row['config'])
                for row in csv.DictReader(file)]
    code = ('import sys\nfrom odocal_ros.offline.cli import main\n'
            'for bag, config, out in zip(*[iter(sys.argv[1:])] * 3):\n'
            "    main(['replay', bag, '--config', config, '--output', out, '--method', "
            "'two_point', '--quiet', '--set', 'output.formats=[legs]'])\n")
    began = time.monotonic()
    halves = [subprocess.Popen([sys.executable, '-c', code, *(
        str(x) for i, (bag, config) in enumerate(bags) if i % 2 == k
        for x in (bag, config, folder / f'plain{i}'))]) for k in (0, 1)]
    for half in halves:
        half.wait()
    plain = time.monotonic() - began
    from odocal_ros.fleet.bags import find_bags
    from odocal_ros.fleet.command import add_arguments
    from odocal_ros.fleet.engine import engine
    from odocal_ros.fleet.jobs import bag_jobs, computed_rows
    from odocal_ros.fleet.rows import rows_of, RowStore
    parser = argparse.ArgumentParser()
    add_arguments(parser)
    asked = parser.parse_args([str(args.fleet / 'manifest.csv'), '--output', 'x', *QUICK])
    jobs = bag_jobs(find_bags(asked.bags, None), asked, folder / 'out', 600.0, 2**31)
    with engine(None, 2, 2**31, 3) as client:
        list(computed_rows(client, jobs[:4]))      # what is imported once
        began = time.monotonic()
        done = [one for _, one in computed_rows(client, jobs)]
        whole = time.monotonic() - began
        inside = sum(row.seconds for row in rows_of(
            RowStore(folder / 'out').path(one.key) for one in done if one.computed))
    n = sum(one.computed for one in done)
    print(f'{len(bags)} bags: two loops of replay {plain:.1f} s (imports of two processes in it); '
          f'two workers {whole:.1f} s for {n} of them; ratio {plain / len(bags) * n / whole:.2f}')
    print(f'inside the pipeline {inside:.1f} s on two workers: engine and rows take '
          f'{1e3 * (2 * whole - inside) / n:.1f} ms of a worker a bag')


@contextmanager
def silent_server():
    """Give the URL of a bag on a server that takes a call and never says a word."""
    with socket.create_server(('127.0.0.1', 0)) as server:
        yield f'ftp://127.0.0.1:{server.getsockname()[1]}/drive.mcap'


def spoilt(args):
    """Put a bag that unpacks to 2 GiB and one that hangs among a fleet's; compare the others."""
    from odocal_ros.outside.limits import zstd_module
    folder = Path(tempfile.mkdtemp(prefix='fleet_spoilt_'))
    packer = zstd_module().ZstdCompressor()
    (folder / 'bomb.mcap').write_bytes(
        b''.join([packer.compress(bytes(2**20)) for _ in range(2048)]) + packer.flush())
    with open(args.fleet / 'manifest.csv', newline='') as file:
        good = [row | {'bag': str((args.fleet / row['bag']).resolve()), 'config': str(
            (args.fleet / row['config']).resolve())} for row in csv.DictReader(file)][:198]
    rows = {}
    with silent_server() as url:
        bad = [good[0] | {'bag': str(folder / 'bomb.mcap')}, good[0] | {'bag': url}]
        for name, bags in (('clean', good), ('spoilt', good[:60] + bad + good[60:])):
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
    failed = [row for row in rows['spoilt'].values() if row.status == 'failed']
    alike = sum(rows['spoilt'].get(bag) == row for bag, row in rows['clean'].items())
    print(f'{alike} of {len(rows["clean"])} rows the same to the last bit; {len(failed)} failed:')
    for row in failed:
        print(f'  {Path(row.bag).name}: {row.reason}')


def main():
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_subparsers(required=True)
    for function in (found, kills, alike, cost, spoilt):
        sub = what.add_parser(function.__name__)
        sub.set_defaults(run=function)
        sub.add_argument('--seed', type=int, default=1)
        sub.add_argument('fleet', type=Path)
        sub.add_argument('--port', type=int, default=28786)
        if function is found:
            sub.add_argument('result', type=Path)
        if function in (kills, spoilt):
            sub.add_argument('--every', type=float, default=20.0)
            sub.add_argument('--patience', type=float, default=120.0)
    args = parser.parse_args()
    args.run(args)


if __name__ == '__main__':
    main()
