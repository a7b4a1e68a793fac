# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal simulate --fleet: the bags of many vehicles, their manifest and their truth."""

import argparse
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

from odocal_ros.errors import BadUsage
from odocal_ros.offline.say import Phase, say
from odocal_ros.output.figures import iso
from odocal_ros.outside.whole import write_text

if TYPE_CHECKING:
    from odocal_ros.sim.fleet import FleetVehicle
    from odocal_ros.sim.options import SimOptions
    from odocal_ros.sim.scenarios import Drive

MANIFEST = 'manifest.csv'


def simulate_fleet(args: argparse.Namespace, options: 'SimOptions') -> int:
    """
    Write DIR/<vehicle>/bag_<nn>, DIR/<model>.yaml, DIR/manifest.csv and DIR/truth.yaml; return 0.

    options : of each drive, except values that differ between vehicles.
    """
    from odocal_ros.library.simulate import write_yaml
    from odocal_ros.output.tables import csv_text
    from odocal_ros.sim.fleet import fleet_of
    out = Path(args.out)
    most = 100_000    # vehicles
    if not (1 <= args.fleet <= most and 1 <= args.bags <= 1000):
        raise BadUsage(f'--fleet {args.fleet} --bags {args.bags}: required: 1 to {most} vehicles '
                       'with 1 to 1000 bags each')
    if (out / MANIFEST).exists() and not args.force:
        raise BadUsage(f'{out / MANIFEST} already exists; give --force to replace the fleet, or '
                       'another --out')
    vehicles = fleet_of(args.fleet, args.bags, options.seed)
    rows, truth = [], []
    with Phase('simulating', args.quiet) as phase:
        for number, vehicle in enumerate(vehicles):
            drives = [_bag(args, out, number, vehicle, bag, options) for bag in range(args.bags)]
            rows += [row for row, _ in drives]
            truth.append(_truth(vehicle, [made for _, made in drives]))
            phase((number + 1) / len(vehicles), vehicle.name)
    write_yaml(out / 'truth.yaml', {'vehicles': truth}, 'Truth of a fleet; sizes relative or rad.')
    write_text(out / MANIFEST, csv_text(rows))      # last: it marks a complete fleet
    if not args.quiet:
        say(f'{out}: {len(vehicles)} vehicles, {len(rows)} bags; truth in {out}/truth.yaml; next: '
            f'odocal fleet {out / MANIFEST} --output result')
    return 0


def _bag(args: argparse.Namespace, out: Path, number: int, vehicle: 'FleetVehicle', bag: int,
         options: 'SimOptions') -> 'tuple[dict[str, str], Drive]':
    """Write a bag; return its row of the manifest, and its drive with options and truth."""
    from odocal_ros.bagio.write import drive_topics, write_bag
    from odocal_ros.library.simulate import write_yaml
    from odocal_ros.sim.fleet import as_driven, drive_options, MODELS
    from odocal_ros.sim.scenarios import simulate
    from odocal_ros.sim.truth import settings
    drive = simulate(drive_options(vehicle, number, bag, options))
    name = f'{vehicle.name}/bag_{bag + 1:02d}'
    write_bag(out / name, drive_topics(as_driven(drive, vehicle.broken(bag))), args.storage,
              args.compression, args.force)
    config = f'{vehicle.model.name}.yaml'
    if number < len(MODELS) and not bag:      # one of each model
        write_yaml(out / config, {'/**/calibrator': {'ros__parameters': settings(drive, None)}},
                   f'Settings of the operator of a {vehicle.model.name}.')
    return {'vehicle': vehicle.name, 'bag': name, 'config': config, 'model': vehicle.model.name,
            'odometer_km': f'{vehicle.odometer_km[bag]:.1f}'}, drive


def _truth(vehicle: 'FleetVehicle', drives: 'list[Drive]') -> dict[str, Any]:
    last = drives[-1].truth
    return {
        'vehicle': vehicle.name, 'model': vehicle.model.name,
        'scale_factor': [float(drive.truth.scale) for drive in drives],
        'scale_ratio': last.scale_ratio,
        'yaw_mounting_deg': [math.degrees(drive.truth.yaw) for drive in drives],
        'pitch_mounting_deg': math.degrees(last.pitch),
        'start': [iso(drive.truth.start_ns) for drive in drives],
        'changes': [{'value': change.what, 'bag': change.bag + 1,
                     'size': change.size, 'after': iso(drives[change.bag - 1].truth.start_ns),
                     'by': iso(drives[change.bag].truth.start_ns)}
                    for change in vehicle.changes]}
