# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Drives with known truth: one as samples or bag, or the bags of a fleet with a manifest."""

from collections.abc import Callable
import math
from pathlib import Path
from typing import Any

from odocal_ros.bagio.write import check_target, drive_topics, write_bag
from odocal_ros.errors import BadUsage
from odocal_ros.output.tables import csv_text
from odocal_ros.output.value_text import iso
from odocal_ros.safe_io.atomic_files import uninterrupted, write_text
from odocal_ros.safe_io.text_formats import for_comment, one_line
from odocal_ros.sim import scenarios
from odocal_ros.sim.fleet import drive_options, fleet_of, FleetVehicle, MODELS, with_broken_counter
from odocal_ros.sim.scenarios import Drive, SimOptions
from odocal_ros.sim.truth import operator_settings, truth_entries

TRUTH, SETTINGS, MANIFEST = 'truth.yaml', 'calibrator.yaml', 'manifest.csv'
MADE_HERE = 'Made by odocal simulate.'


def simulate(scenario: str | SimOptions = 'town', out: Path | str | None = None, *,
             storage: str = 'mcap', compression: str = 'none', force: bool = False,
             heading_sigma: float | None = None,
             progress: Callable[[float], None] | None = None, **options: Any) -> Drive:
    """
    Simulate a drive; equal options give equal drives, to the last bit.

    scenario : paper, straight, out_and_back, town, motorway, oval, yard, indoor or square; or all
    options.   out : bag to write; truth.yaml and calibrator.yaml (the operator's settings) are
    next to it.   storage, compression, force, progress : of ``bagio.write.write_bag``.
    heading_sigma : rad: calibrator.yaml gets a heading of this accuracy.   options : fields of
    SimOptions: duration, seed, imu_grade, fix_noise, two_wheels and so on.

    Raises BadUsage: an option is unknown or out of range; a file exists and ``force`` is not set.
    """
    if out is not None:
        out = Path(out)
        for path in truth_paths(out):
            _check_may_replace(path, force)
        check_target(out, storage, compression, force)
    try:
        all_options = scenario if isinstance(scenario, SimOptions) else SimOptions(
            scenario=scenario, **options)
    except TypeError as error:
        raise BadUsage(f'simulate: {error}') from None
    drive = scenarios.simulate(all_options)
    if out is not None:
        write_bag(out, drive_topics(drive), storage, compression, force, progress)
        truth, operator = truth_paths(out)
        node = {'/**/calibrator': {'ros__parameters': operator_settings(drive, heading_sigma)}}
        with uninterrupted():      # a bag is never without its truth
            write_yaml(truth, truth_entries(drive, out.name), f'Truth of {out.name}.')
            write_yaml(operator, node, f'Settings of the operator of {out.name}.')
    return drive


def truth_paths(out: Path) -> list[Path]:
    """Return the paths of truth and settings; with the bag's name if another bag has such."""
    paths = [out.parent / name for name in (TRUTH, SETTINGS)]
    text = paths[0].read_text(encoding='utf-8', errors='replace') if paths[0].exists() else ''
    if MADE_HERE in text and one_line(f'Truth of {out.name}.') not in text:
        return [path.with_name(f'{out.name}.{path.name}') for path in paths]
    return paths


def _check_may_replace(path: Path, force: bool) -> None:
    """Raise BadUsage for an existing file, unless ``force`` is set and a simulation made it."""
    if not path.exists():
        return
    if not force:
        raise BadUsage(f'{path} already exists; give --force to replace it, or --out in another '
                       'folder')
    if MADE_HERE not in path.read_text(encoding='utf-8', errors='replace'):
        raise BadUsage(f'{path} was not made by odocal simulate and is kept; give --out in '
                       'another folder')


def write_yaml(path: Path, content: dict[str, Any], title: str) -> None:
    """Write a YAML file, complete or not at all; title: its first line, a comment."""
    import yaml
    try:
        write_text(path, for_comment(one_line(f'{title} {MADE_HERE}'))
                   + yaml.safe_dump(content, sort_keys=False, default_flow_style=None))
    except OSError as error:
        raise BadUsage(f'{path}: cannot write ({error.strerror}); the bag itself is '
                       'complete') from None


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
            drive = scenarios.simulate(drive_options(vehicle, number, bag, options))
            recorded = with_broken_counter(drive) if vehicle.has_broken_counter(bag) else drive
            name = f'{vehicle.name}/bag_{bag + 1:02d}'
            write_bag(out / name, drive_topics(recorded), storage, compression, force)
            rows.append({'vehicle': vehicle.name, 'bag': name,
                         'config': f'{vehicle.model.name}.yaml', 'model': vehicle.model.name,
                         'odometer_km': f'{vehicle.odometer_km[bag]:.1f}'})
            drives.append(drive)
        if number < len(MODELS):      # the first vehicle of each model
            node = {'/**/calibrator': {'ros__parameters': operator_settings(drives[0], None)}}
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
