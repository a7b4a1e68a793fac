# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The tables of a fleet: columns of legs.parquet and vehicles.parquet, a leg as a row, writing."""

from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime, UTC
from pathlib import Path
from typing import Any

from odocal_ros.calib.choice import leg_estimates
from odocal_ros.calib.result import Estimate, LegResult
from odocal_ros.fleet.bags import FleetBag
from odocal_ros.fleet.rows import legs_from, Row
from odocal_ros.reasons import Reason
from odocal_ros.safe_io.atomic_files import locked, whole_file
from odocal_ros.safe_io.text_formats import one_line

LEGS, VEHICLES = 'legs.parquet', 'vehicles.parquet'
VALUES = ('scale_factor', 'scale_ratio', 'yaw_mounting_angle', 'pitch_mounting_angle')
VALUE_COLUMNS = ' '.join(f'{name} {name}_sigma' for name in VALUES)


def all_reasons(leg: LegResult) -> list[Reason]:
    """Return the reasons of a leg and of its methods."""
    return [*leg.reasons, *(r for m in leg.methods.values() for r in m.reasons)]


def leg_row(vehicle: str, model: str, number: int, odometer_km: float | None,
            leg: LegResult) -> dict[str, Any]:
    row = {'vehicle': vehicle, 'model': model, 'leg': number, 'bag': one_line(leg.bag),
           'odometer_km': odometer_km, 'start': utc(leg.start_ns), 'start_ns': leg.start_ns,
           'stop_ns': leg.stop_ns, 'duration_s': leg.duration, 'distance_m': leg.distance,
           'fixes': leg.fixes, 'verdict': leg.verdict.value,
           'reasons': ' '.join(dict.fromkeys(r.code.name for r in all_reasons(leg)))}
    return row | value_cells(leg_estimates(leg))


def value_cells(estimates: dict[str, Estimate]) -> dict[str, Any]:
    """Return the cells of VALUE_COLUMNS, and the unit of the scale."""
    cells: dict[str, Any] = {}
    for name in VALUES:
        e = estimates.get(name)
        cells |= {name: e and e.value, f'{name}_sigma': e and e.sigma}
    return cells | {'unit': estimates['scale_factor'].unit if 'scale_factor' in estimates else ''}


def rows_of_legs(bag: FleetBag, row: Row) -> list[dict[str, Any]]:
    """Return the legs of a bag's row as rows of a table; of a failed bag a row without values."""
    of_bag = {'status': row.status, 'reason': row.reason}
    return [leg_row(bag.vehicle, bag.model, k, bag.odometer_km, leg) | of_bag
            for k, leg in enumerate(legs_from(row.legs), 1)] or [
        {'vehicle': bag.vehicle, 'model': bag.model, 'bag': one_line(row.bag), **of_bag}]


def utc(stamp_ns: int) -> datetime:
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC)


def _schema(texts: str, numbers: str, counts: str, times: str, flags: str = '') -> Any:
    import pyarrow as pa
    kinds = ((texts, pa.string()), (times, pa.timestamp('us', 'UTC')), (counts, pa.int64()),
             (flags, pa.bool_()), (numbers, pa.float64()))
    return pa.schema([(name, kind) for names, kind in kinds for name in names.split()])


def leg_schema() -> Any:
    return _schema('vehicle model bag verdict reasons unit',
                   f'odometer_km duration_s distance_m {VALUE_COLUMNS}',
                   'leg start_ns stop_ns fixes period', 'start', 'odd')


def vehicle_schema() -> Any:
    return _schema(
        'vehicle model decision verdict unit why remedy reasons changes odd_legs '
        'outlier failures rejected_for',
        f'{VALUE_COLUMNS} drift_per_year drift_per_year_sigma drift_per_1000_km '
        'drift_per_1000_km_sigma distance_km driven_h scale_deviate yaw_deviate pitch_deviate',
        'bags bags_failed legs legs_good', 'first last since rejected_since')


def in_batches(rows: Sequence[dict[str, Any]]) -> Iterator[Any]:
    import pyarrow as pa
    for k in range(0, len(rows), 1000):
        yield pa.Table.from_pylist(rows[k:k + 1000], schema=vehicle_schema())


def batches(parts: Sequence[Path]) -> Iterator[Any]:
    import pyarrow.parquet as pq
    for part in parts:
        yield pq.ParquetFile(part).read(use_threads=False)


def write_table(path: Path, schema: Any, tables: Iterable[Any]) -> None:
    """Write tables one after the other to one file, atomically."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    with locked(path.parent), whole_file(path) as file, pq.ParquetWriter(
            pa.PythonFile(file, mode='w'), schema, compression='zstd') as writer:
        for table in tables:
            if table.num_rows:
                writer.write_table(table)

