# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags of many vehicles with known truth: a folder with a manifest for odocal fleet."""

from collections.abc import Callable
import math
from pathlib import Path
from typing import Any

from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.errors import BadUsage
from odocal_ros.library.simulate import TRUTH, write_yaml
from odocal_ros.output.tables import csv_text
from odocal_ros.output.value_text import iso
from odocal_ros.safe_io.atomic_files import write_text
from odocal_ros.sim.fleet import drive_options, fleet_of, FleetVehicle, MODELS, with_broken_counter
from odocal_ros.sim.scenarios import Drive, SimOptions, simulate
from odocal_ros.sim.truth import settings

MANIFEST = 'manifest.csv'


def simulate_fleet(out: Path, options: SimOptions, vehicles: int, bags: int, *,
                   storage: str = 'mcap', compression: str = 'none', force: bool = False,
                   progress: Callable[[float, str], None] | None = None) -> Path:
    """
    Write OUT/<vehicle>/bag_<nn>, OUT/<model>.yaml, truth.yaml and manifest.csv; return the latter.

    options : of each drive, except values that differ between vehicles.   vehicles, bags : number
    of vehicles, and of bags of each.   storage, compression, force : of ``bagio.write.write_bag``.
    progress : is called with the fraction done and the name of the vehicle.

    Raises BadUsage: a number is out of range; a manifest exists and ``force`` is not set.
    """
    limit = 100_000    # vehicles
    if not (1 <= vehicles <= limit and 1 <= bags <= 1000):
        raise BadUsage(f'--fleet {vehicles} --bags {bags}: required: 1 to {limit} vehicles '
                       'with 1 to 1000 bags each')
    manifest = out / MANIFEST
    if manifest.exists() and not force:
        raise BadUsage(f'{manifest} already exists; give --force to replace the fleet, or '
                       'another --out')
    rows, truth = [], []
    for number, vehicle in enumerate(fleet_of(vehicles, bags, options.seed)):
        drives = []
        for bag in range(bags):
            drive = simulate(drive_options(vehicle, number, bag, options))
            recorded = with_broken_counter(drive) if vehicle.has_broken_counter(bag) else drive
            name = f'{vehicle.name}/bag_{bag + 1:02d}'
            write_bag(out / name, drive_topics(recorded), storage, compression, force)
            rows.append({'vehicle': vehicle.name, 'bag': name,
                         'config': f'{vehicle.model.name}.yaml', 'model': vehicle.model.name,
                         'odometer_km': f'{vehicle.odometer_km[bag]:.1f}'})
            drives.append(drive)
        if number < len(MODELS):      # the first vehicle of each model
            node = {'/**/calibrator': {'ros__parameters': settings(drives[0], None)}}
            write_yaml(out / rows[-1]['config'], node,
                       f'Settings of the operator of a {vehicle.model.name}.')
        truth.append(_truth(vehicle, drives))
        if progress:
            progress((number + 1) / vehicles, vehicle.name)
    write_yaml(out / TRUTH, {'vehicles': truth}, 'Truth of a fleet; sizes relative or rad.')
    write_text(manifest, csv_text(rows))      # last: it marks a complete fleet
    return manifest


def _truth(vehicle: FleetVehicle, drives: list[Drive]) -> dict[str, Any]:
    """Return the entry of a vehicle in truth.yaml; its bags are counted from 1 there."""
    last = drives[-1].truth
    return {
        'vehicle': vehicle.name, 'model': vehicle.model.name,
        'scale_factor': [float(drive.truth.scale) for drive in drives],
        'scale_ratio': last.scale_ratio,
        'yaw_mounting_deg': [math.degrees(drive.truth.yaw) for drive in drives],
        'pitch_mounting_deg': math.degrees(last.pitch),
        'start': [iso(drive.truth.start_ns) for drive in drives],
        'changes': [{'value': change.value, 'bag': change.bag + 1,
                     'size': change.size, 'after': iso(drives[change.bag - 1].truth.start_ns),
                     'by': iso(drives[change.bag].truth.start_ns)}
                    for change in vehicle.changes]}
