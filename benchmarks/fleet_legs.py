# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The second stage of a fleet alone: synthetic legs, scales that walk, a tenth of them changed.

python benchmarks/fleet_legs.py --legs 100000            50 legs a vehicle, a week apart

The rows of a vehicle lie in one file; a fleet's lie in one a bag.
"""

from dataclasses import asdict
import json
from pathlib import Path
import tempfile
import time

from harness import parsed
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from odocal_ros.calib.result import Estimate, LegResult, MethodResult, Source
from odocal_ros.fleet.bags import FleetBag
from odocal_ros.fleet.engine import engine
from odocal_ros.fleet.fleet_results import compute_vehicles, vehicle_jobs
from odocal_ros.fleet.rows import Row, row_schema, text_of_legs

EACH = 50                    # legs of a vehicle
DAY = 86_400 * 10**9         # ns
WALK, STEP = 1e-4, 0.01      # of the scale: per square root of a day; of new tyres
OWN, SHARED = 2e-4, 1e-4     # sigmas of ln K: each leg's, all legs'


def scales(rng, changed):
    """Return the scales of a vehicle's legs, m/pulse."""
    scale = 0.0213 * (1 + 0.003 * rng.standard_normal()) * np.exp(
        np.cumsum(WALK * 7**0.5 * rng.standard_normal(EACH)))
    scale[EACH // 2:] *= 1 + STEP * changed
    return scale


def leg_of(scale, k, rng):
    """Return the two-point result of the k-th leg of a vehicle."""
    value, sigma = float(scale * (1 + OWN * rng.standard_normal())), float(np.hypot(OWN, SHARED))
    column = np.array([[1.0], [0.0]])
    method = MethodResult('two_point', (), {
        'scale_factor': Estimate(value, value * sigma, 'm/pulse'),
        'scale_ratio': Estimate(value / 0.021, value / 0.021 * sigma, '1'),
        'yaw_mounting_angle': Estimate(None, None, 'rad')},
        ('scale_factor', 'yaw_mounting_angle'),
        (Source('fixes', OWN * column), Source('antenna lever arm', SHARED * column, True)))
    start = 1_750_000_000 * 10**9 + 7 * k * DAY
    return LegResult(start, start + 600 * 10**9, 5000.0, 600.0, 60_000, 30_000, 3000, 0, (),
                     {'two_point': method}, bag=f'{k}', C_bi=np.eye(3))


def write(folder, vehicles, rng):
    """Write the rows of vehicles; return their bags and each one's file."""
    bags, files = [], []
    for v in range(vehicles):
        rows = [Row(key=f'{v}-{k}', bag=f'{v}/{k}', vehicle=f'v{v:06d}', model='synthetic',
                    start_ns=leg.start_ns, legs=text_of_legs([leg]))
                for k, leg in enumerate(leg_of(scale, k, rng) for k, scale in enumerate(
                    scales(rng, v % 10 == 0)))]
        bags += [FleetBag(row.vehicle, row.bag, row.model) for row in rows]
        files += [f'{folder}/{v}.parquet'] * EACH
        pq.write_table(pa.Table.from_pylist([asdict(r) for r in rows], schema=row_schema()),
                       files[-1], compression='zstd')
    return bags, files


def used():
    """Return the most memory that this process took, MiB, and its time of a core, s."""
    # not ru_maxrss: a process begins with that of the one it was forked from
    status = dict(line.split(':') for line in Path('/proc/self/status').read_text().splitlines())
    return int(status['VmHWM'].split()[0]) / 2**10, time.process_time()


def main():
    """Make the legs, time the stage."""
    args = parsed(__doc__, legs=100_000, workers=2, seed=1, scratch=str)
    n = args.legs // EACH
    with tempfile.TemporaryDirectory(prefix='fleet_legs_', dir=args.scratch) as name:
        folder = Path(name)
        jobs = vehicle_jobs(*write(folder, n, np.random.default_rng(args.seed)), {})
        with engine(None, args.workers, 2**31, 3) as client:
            before, began = used()[1], time.monotonic()
            vehicles = compute_vehicles(client, jobs, folder / 'out', False)
            took, cpu = time.monotonic() - began, used()[1] - before
            workers = list(client.run(used).values())
        size = sum(path.stat().st_size for path in folder.glob('*.parquet'))
    core, told = sum(c for _, c in workers), sum(bool(json.loads(v['changes'])) for v in vehicles)
    print(f'{n * EACH} legs of {n} vehicles: {took:.0f} s; of a core {core:.0f} s the workers '
          f'({1e3 * core / n:.1f} ms a vehicle), {cpu:.0f} s the command; most memory '
          f'{max(m for m, _ in workers):.0f} MiB a worker, {used()[0]:.0f} MiB the command; rows '
          f'{size / 2**20:.0f} MiB; {told} of {-(-n // 10)} vehicles changed')


if __name__ == '__main__':
    main()
