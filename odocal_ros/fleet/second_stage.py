# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Vehicles from rows on the engine: groups of vehicles, each a task that writes its part."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, UTC
import hashlib
import json
from pathlib import Path
import shutil
from typing import Any
import uuid

import numpy as np

from odocal_ros.fleet import tables
from odocal_ros.fleet.bags import FleetBag
from odocal_ros.fleet.engine import results
from odocal_ros.fleet.statistics import FAR, population
from odocal_ros.fleet.vehicles import Vehicle, vehicle_of, VehicleJob

COMPARED = {'scale_factor': 'scale', 'yaw_mounting_angle': 'yaw', 'pitch_mounting_angle': 'pitch'}
WORST = ('FAIL', 'UNDECIDED', 'rejected', 'caution', 'PASS', 'accepted')


@dataclass(frozen=True)
class GroupJob:
    """Vehicles whose legs go to one part of a table; ``files``: folder for results, or ''."""

    vehicles: tuple[VehicleJob, ...]
    part: str
    files: str = ''


def vehicle_jobs(bags: Sequence[FleetBag], rows: Sequence[str],
                 settings: dict[str, Any]) -> list[VehicleJob]:
    """Return a job for each vehicle; ``rows``: the file of each bag's row."""
    of: dict[str, list[int]] = {}
    for i, bag in enumerate(bags):
        of.setdefault(bag.vehicle, []).append(i)
    # the same bag given twice under one vehicle is one row
    return [VehicleJob(vehicle, tuple(bags[i] for i in which),
                       tuple(dict.fromkeys(rows[i] for i in which)), settings)
            for vehicle, which in of.items()]


def vehicles_together(client: Any, jobs: Sequence[VehicleJob], folder: Path,
                      files: bool) -> list[dict[str, Any]]:
    """Return the vehicles' rows, the worst first; write tables, and results if ``files``."""
    parts = folder / f'.parts.{uuid.uuid4().hex}'
    parts.mkdir(parents=True)
    try:
        groups = [GroupJob(group, str(parts / f'{k:06d}.parquet'),
                           str(folder / 'vehicles') if files else '')
                  for k, group in enumerate(_grouped(jobs))]
        found: dict[int, list[dict[str, Any]]] = {}
        for k, rows, error in results(client, group_of, groups, 'vehicles',
                                      [Path(group.part).stem + parts.name for group in groups]):
            if error is not None:
                raise error
            found[k] = rows
        vehicles = beside_their_model([row for k in sorted(found) for row in found[k]])
        tables.write_table(folder / tables.LEGS, tables.leg_schema(),
                           tables.batches(sorted(parts.glob('*.parquet'))))
        tables.write_table(folder / tables.VEHICLES, tables.vehicle_schema(),
                           tables.in_batches(vehicles))
        return vehicles
    finally:
        shutil.rmtree(parts, ignore_errors=True)


def _grouped(jobs: Sequence[VehicleJob]) -> Iterator[tuple[VehicleJob, ...]]:
    group: list[VehicleJob] = []
    together = 500    # bags of a group of vehicles, at least
    for job in jobs:
        group.append(job)
        if sum(len(one.bags) for one in group) >= together:
            yield tuple(group)
            group = []
    if group:
        yield tuple(group)


def group_of(group: GroupJob) -> list[dict[str, Any]]:
    """Compute vehicles one after the other; write their legs as a part, return their rows."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    rows = []
    with pq.ParquetWriter(group.part, tables.leg_schema(), compression='zstd') as writer:
        legs: list[dict[str, Any]] = []
        for job in group.vehicles:
            vehicle = vehicle_of(job)
            rows.append(vehicle.row)
            legs += vehicle.legs
            if group.files and vehicle.calibration is not None:
                _write_files(vehicle, Path(group.files))
        if legs:
            writer.write_table(pa.Table.from_pylist(legs, schema=tables.leg_schema()))
    return rows


def _write_files(vehicle: Vehicle, folder: Path) -> None:
    """Write the files of replay for a vehicle, except report and track."""
    from odocal_ros.output.files import write_results
    from odocal_ros.settings.config import with_settings
    assert vehicle.calibration is not None
    assert vehicle.config is not None
    formats = tuple(f for f in vehicle.config.output.formats if f not in ('report', 'track'))
    write_results(vehicle.calibration, with_settings(vehicle.config, {'output.formats': formats}),
                  folder / file_name(vehicle.row['vehicle']), list(vehicle.inputs),
                  datetime.now(UTC).isoformat(timespec='seconds'), force=True)


def file_name(vehicle: str) -> str:
    """Return a unique name for a vehicle's folder that is never a path."""
    from urllib.parse import quote
    name = quote(vehicle, safe=' ')
    name = name.replace('.', '%2E', 1) if name.startswith('.') else name or '_'
    most = 120    # characters: a file system allows 255, and temporary files have longer names
    if len(name) > most:
        name = f'{name[:most]}~{hashlib.sha256(vehicle.encode()).hexdigest()[:16]}'
    return name


def by_model(rows: Iterable[dict[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Return the vehicles of each model and unit of the scale, without rejected ones."""
    kinds: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        if row['verdict'] != 'rejected':
            kinds.setdefault((row['model'], row['unit']), []).append(row)
    return kinds


def beside_their_model(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows with each vehicle's deviations from its model in sigmas, the worst first."""
    for name, short in COMPARED.items():
        for row in rows:
            row[f'{short}_deviate'] = None
        for some in by_model(row for row in rows if row[name] is not None).values():
            found = population(*(np.array([row[key] for row in some], float)
                                 for key in (name, f'{name}_sigma')))
            for row, deviate in zip(some, found.deviates.tolist(), strict=True):
                row[f'{short}_deviate'] = None if deviate != deviate else deviate
    for row in rows:
        row['outlier'] = ' '.join(short for short in COMPARED.values()
                                  if abs(row[f'{short}_deviate'] or 0.0) > FAR)
    return sorted(rows, key=_badness)


def flagged(row: dict[str, Any]) -> bool:
    """Return True if a vehicle needs inspection."""
    return bool(row['outlier'] or row['bags_failed'] or row['odd_legs'] or row['rejected_for']
                or json.loads(row['changes']) or row['verdict'] == 'rejected'
                or row['decision'] in ('FAIL', 'UNDECIDED'))


def _badness(row: dict[str, Any]) -> tuple[bool | float | str, ...]:
    judged = row['decision'] or row['verdict']
    far = max(abs(row[f'{short}_deviate'] or 0.0) for short in COMPARED.values())
    return (not row['legs'] and -1 or 0, WORST.index(judged), not row['outlier'],
            row['rejected_since'] is None, -len(json.loads(row['changes'])), -row['bags_failed'],
            not row['rejected_for'], -far, row['vehicle'])
