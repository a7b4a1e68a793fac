# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The tables legs.parquet and vehicles.parquet of a fleet: their columns and rows, and writing.

Also the comparison of vehicles of one model, and the order of vehicles, the worst first.
"""

from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime, UTC
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from odocal_ros.calib.choice import leg_estimates
from odocal_ros.calib.result import Estimate, LegResult
from odocal_ros.fleet.bags import FleetBag
from odocal_ros.fleet.rows import Row
from odocal_ros.fleet.statistics import MODEL_OUTLIER_SIGMAS, population
from odocal_ros.output.value_text import MAIN_VALUES, UNKNOWN
from odocal_ros.safe_io.atomic_files import locked, whole_file
from odocal_ros.safe_io.text_formats import one_line

LEGS, VEHICLES = 'legs.parquet', 'vehicles.parquet'
VALUES = ('scale_factor', 'scale_ratio', 'yaw_mounting_angle', 'pitch_mounting_angle')
WORST_FIRST = ('FAIL', 'UNDECIDED', 'rejected', 'caution', 'PASS', 'accepted')
VALUE_COLUMNS = ' '.join(f'{name} {name}_sigma' for name in VALUES)


def leg_row(vehicle: str, model: str, number: int, odometer_km: float | None,
            leg: LegResult) -> dict[str, Any]:
    """Return the row of a leg; number : of the leg in its vehicle or bag, from 1."""
    cells = {'vehicle': vehicle, 'model': model, 'leg': number, 'bag': one_line(leg.bag),
           'odometer_km': odometer_km, 'start': utc(leg.start_ns), 'start_ns': leg.start_ns,
           'stop_ns': leg.stop_ns, 'duration_s': leg.duration, 'distance_m': leg.distance,
           'fixes': leg.fixes, 'verdict': leg.verdict.value,
           'reasons': ' '.join(dict.fromkeys(reason.code.name for reason in leg.all_reasons))}
    return cells | value_cells(leg_estimates(leg))


def value_cells(estimates: dict[str, Estimate]) -> dict[str, Any]:
    """Return the cells of VALUE_COLUMNS, and the unit of the scale."""
    cells: dict[str, Any] = {}
    for name in VALUES:
        estimate = estimates.get(name, UNKNOWN)
        cells |= {name: estimate.value, f'{name}_sigma': estimate.sigma}
    return cells | {'unit': estimates.get('scale_factor', UNKNOWN).unit}


def table_rows(bag: FleetBag, row: Row) -> list[dict[str, Any]]:
    """Return the legs of a bag's row as rows of a table; for a failed bag, one without values."""
    bag_cells = {'status': row.status, 'reason': row.reason}
    return [leg_row(bag.vehicle, bag.model, k, bag.odometer_km, leg) | bag_cells
            for k, leg in enumerate(row.leg_results(), 1)] or [
        {'vehicle': bag.vehicle, 'model': bag.model, 'bag': one_line(row.bag), **bag_cells}]


def utc(stamp_ns: int) -> datetime:
    """Return the date of a stamp, ns since 1970."""
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC)


def _schema(texts: str, numbers: str, counts: str, times: str, flags: str = '') -> Any:
    """Return the schema of columns of five types, given as names separated by spaces."""
    import pyarrow as pa
    kinds = ((texts, pa.string()), (times, pa.timestamp('us', 'UTC')), (counts, pa.int64()),
             (flags, pa.bool_()), (numbers, pa.float64()))
    return pa.schema([(name, kind) for names, kind in kinds for name in names.split()])


def leg_schema() -> Any:
    """Return the columns of legs.parquet."""
    return _schema('vehicle model bag verdict reasons unit',
                   f'odometer_km duration_s distance_m {VALUE_COLUMNS}',
                   'leg start_ns stop_ns fixes period', 'start', 'odd')


def vehicle_schema() -> Any:
    """Return the columns of vehicles.parquet."""
    return _schema(
        'vehicle model decision verdict unit why remedy reasons changes odd_legs '
        'outlier failures rejected_for',
        f'{VALUE_COLUMNS} drift_per_year drift_per_year_sigma drift_per_1000_km '
        'drift_per_1000_km_sigma distance_km driven_h scale_deviate yaw_deviate pitch_deviate',
        'bags bags_failed legs legs_good', 'first last since rejected_since')


def vehicle_batches(rows: Sequence[dict[str, Any]]) -> Iterator[Any]:
    """Yield the rows of vehicles as tables of 1000 rows, which limits the memory."""
    import pyarrow as pa
    for k in range(0, len(rows), 1000):
        yield pa.Table.from_pylist(rows[k:k + 1000], schema=vehicle_schema())


def write_table(path: Path, schema: Any, tables: Iterable[Any]) -> None:
    """Write tables one after the other to one file, atomically."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    with locked(path.parent), whole_file(path) as file, pq.ParquetWriter(
            pa.PythonFile(file, mode='w'), schema, compression='zstd') as writer:
        for table in tables:
            if table.num_rows:
                writer.write_table(table)


def folder_name(vehicle: str) -> str:
    """Return the unique name of a vehicle's folder: without / and leading dots, not empty."""
    from urllib.parse import quote
    name = quote(vehicle, safe=' ')
    name = name.replace('.', '%2E', 1) if name.startswith('.') else name or '_'
    max_length = 120    # a file system allows 255, and temporary files have longer names
    if len(name) > max_length:
        name = f'{name[:max_length]}~{hashlib.sha256(vehicle.encode()).hexdigest()[:16]}'
    return name


def group_by_model(rows: Iterable[dict[str, Any]]) -> dict[tuple[str, str], list[dict[str, Any]]]:
    """Return the vehicles of each model and unit of the scale, without rejected ones."""
    models: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        if row['verdict'] != 'rejected':
            models.setdefault((row['model'], row['unit']), []).append(row)
    return models


def compare_with_model(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the rows with each vehicle's deviations from its model in sigmas, the worst first."""
    for name, short in MAIN_VALUES.items():
        for row in rows:
            row[f'{short}_deviate'] = None
        for same_model in group_by_model(row for row in rows if row[name] is not None).values():
            values = population(*(np.array([row[key] for row in same_model], float)
                                  for key in (name, f'{name}_sigma')))
            for row, deviate in zip(same_model, values.deviates.tolist(), strict=True):
                row[f'{short}_deviate'] = None if math.isnan(deviate) else deviate
    for row in rows:
        row['outlier'] = ' '.join(short for short in MAIN_VALUES.values()
                                  if abs(row[f'{short}_deviate'] or 0.0) > MODEL_OUTLIER_SIGMAS)
    return sorted(rows, key=_severity)


def needs_inspection(row: dict[str, Any]) -> bool:
    """Return True for failed or rejected data, outliers, changes and unmet limits of a vehicle."""
    return bool(row['outlier'] or row['bags_failed'] or row['odd_legs'] or row['rejected_for']
                or json.loads(row['changes']) or row['verdict'] == 'rejected'
                or row['decision'] in ('FAIL', 'UNDECIDED'))


def _severity(row: dict[str, Any]) -> tuple[bool | float | str, ...]:
    """Return the sort key of a vehicle: without legs, by verdict, outlier, rejected now, ..."""
    verdict = row['decision'] or row['verdict']
    largest_deviation = max(abs(row[f'{short}_deviate'] or 0.0) for short in MAIN_VALUES.values())
    return (bool(row['legs']), WORST_FIRST.index(verdict), not row['outlier'],
            row['rejected_since'] is None, -len(json.loads(row['changes'])), -row['bags_failed'],
            not row['rejected_for'], -largest_deviation, row['vehicle'])
