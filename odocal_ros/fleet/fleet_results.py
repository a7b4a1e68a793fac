# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Results of a fleet from the rows of its bags: vehicles, tables, page, reports, summary."""

from argparse import Namespace
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from datetime import datetime, UTC
import io
from pathlib import Path
import shutil
from typing import Any
import uuid

from odocal_ros.errors import OdocalError
from odocal_ros.fleet import tables
from odocal_ros.fleet.bag_jobs import BagJob
from odocal_ros.fleet.bags import FleetBag, local_copy
from odocal_ros.fleet.engine import task_results
from odocal_ros.fleet.page import fleet_page, remarks
from odocal_ros.fleet.rows import NON_LEG_GROUPS
from odocal_ros.fleet.vehicles import Vehicle, vehicle_of, VehicleJob
from odocal_ros.output.value_text import counted
from odocal_ros.reasons import Verdict
from odocal_ros.safe_io.atomic_files import locked, write_text
from odocal_ros.safe_io.text_formats import for_table

TABLE, PAGE = 'fleet.csv', 'fleet.html'


@dataclass(frozen=True)
class GroupJob:
    """Vehicles that one task computes, since a task for each would be slower."""

    vehicles: tuple[VehicleJob, ...]
    legs_file: str      # for the rows of their legs
    results_folder: str = ''     # for their result files, or ''


def vehicle_jobs(bags: Sequence[FleetBag], row_files: Sequence[str],
                 settings: dict[str, Any]) -> list[VehicleJob]:
    """Return a job for each vehicle; ``row_files``: the file of each bag's row."""
    by_vehicle: dict[str, list[tuple[FleetBag, str]]] = {}
    for bag, row_file in zip(bags, row_files, strict=True):
        by_vehicle.setdefault(bag.vehicle, []).append((bag, row_file))
    # dict.fromkeys: a bag given twice under one vehicle has one row
    return [VehicleJob(vehicle, tuple(bag for bag, _ in entries),
                       tuple(dict.fromkeys(row_file for _, row_file in entries)), settings)
            for vehicle, entries in by_vehicle.items()]


def compute_vehicles(client: Any, jobs: Sequence[VehicleJob], folder: Path,
                     files: bool) -> list[dict[str, Any]]:
    """Return the vehicles' rows, the worst first; write tables, and results if ``files``."""
    import pyarrow.parquet as pq
    # workers write the legs to files: as results they would fill the memory of the scheduler
    temporary = folder / f'.parts.{uuid.uuid4().hex}'
    temporary.mkdir(parents=True)
    try:
        groups = [GroupJob(group, str(temporary / f'{k:06d}.parquet'),
                           str(folder / 'vehicles') if files else '')
                  for k, group in enumerate(_grouped(jobs))]
        rows_by_group: dict[int, list[dict[str, Any]]] = {}
        keys = [f'{k}-{temporary.name}' for k in range(len(groups))]
        for k, rows, error in task_results(client, compute_group, groups, 'vehicles', keys):
            if error is not None:
                raise error
            rows_by_group[k] = rows
        vehicles = tables.compare_with_model(
            [row for k in range(len(groups)) for row in rows_by_group[k]])
        tables.write_table(folder / tables.LEGS, tables.leg_schema(), (
            pq.ParquetFile(group.legs_file).read(use_threads=False) for group in groups))
        tables.write_table(folder / tables.VEHICLES, tables.vehicle_schema(),
                           tables.vehicle_batches(vehicles))
        return vehicles
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _grouped(jobs: Sequence[VehicleJob]) -> Iterator[tuple[VehicleJob, ...]]:
    """Yield groups of vehicles with enough bags for one task."""
    group: list[VehicleJob] = []
    min_bags = 500
    for job in jobs:
        group.append(job)
        if sum(len(entry.bags) for entry in group) >= min_bags:
            yield tuple(group)
            group = []
    if group:
        yield tuple(group)


def compute_group(group: GroupJob) -> list[dict[str, Any]]:
    """Compute vehicles one after the other; write the rows of their legs, return their rows."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    rows, legs = [], []
    for job in group.vehicles:
        vehicle = vehicle_of(job)
        rows.append(vehicle.row)
        legs += vehicle.legs
        if group.results_folder and vehicle.calibration is not None:
            _write_files(vehicle, Path(group.results_folder))
    pq.write_table(pa.Table.from_pylist(legs, schema=tables.leg_schema()), group.legs_file,
                   compression='zstd')
    return rows


def _write_files(vehicle: Vehicle, folder: Path) -> None:
    """Write the files of replay for a vehicle, except report and track."""
    from odocal_ros.output.files import write_results
    from odocal_ros.settings.config import with_settings
    assert vehicle.calibration is not None
    assert vehicle.config is not None
    formats = tuple(f for f in vehicle.config.output.formats if f not in ('report', 'track'))
    write_results(vehicle.calibration, with_settings(vehicle.config, {'output.formats': formats}),
                  folder / tables.folder_name(vehicle.row['vehicle']), list(vehicle.inputs),
                  datetime.now(UTC).isoformat(timespec='seconds'), force=True)


@dataclass(frozen=True)
class ReportJob:
    """A replay of the bags of a vehicle since its last change."""

    jobs: tuple[BagJob, ...]
    output: str     # folder


def write_outcome(client: Any, jobs: Sequence[BagJob], row_files: Sequence[str], output: Path,
                  args: Namespace) -> list[dict[str, Any]]:
    """
    Write tables, reports and page of a fleet; return the vehicles' rows, the worst first.

    row_files : the file of each job's row.   args : of the command: ``files``, ``reports``.
    """
    by_vehicle = vehicle_jobs([job.bag for job in jobs], row_files, run_settings(jobs))
    vehicles = compute_vehicles(client, by_vehicle, output, args.files)
    with locked(output):          # another fleet's command may write here too
        write_text(output / TABLE, _csv(output / tables.VEHICLES))
    _draw_reports(client, vehicles, jobs, output, args.reports)
    with locked(output):
        write_text(output / PAGE, fleet_page(vehicles, output))
    return vehicles


def run_settings(jobs: Sequence[BagJob]) -> dict[str, Any]:
    """Return the settings of this run that do not affect legs, such as the limits."""
    from odocal_ros.library.arguments import config_of
    from odocal_ros.settings.config import flat
    # an unset frame of the IMU keeps the one in the messages of the bag
    return {name: value for name, value in flat(config_of(jobs[0].config)).items()
            if name.partition('.')[0] in NON_LEG_GROUPS and (name != 'frames.imu' or value)}


def _csv(table: Path) -> str:
    """Return a Parquet file as CSV whose texts a spreadsheet does not take for formulas."""
    import pyarrow as pa
    from pyarrow import csv, parquet as pq
    columns = pq.ParquetFile(table).read(use_threads=False)
    for i, name in enumerate(columns.column_names):
        if pa.types.is_string(columns.schema.types[i]):
            text = [None if x is None else for_table(x) for x in columns[name].to_pylist()]
            columns = columns.set_column(i, name, pa.array(text, pa.string()))
    output = io.BytesIO()
    csv.write_csv(columns, output)
    return output.getvalue().decode()


def _draw_reports(client: Any, vehicles: Sequence[dict[str, Any]], jobs: Sequence[BagJob],
                  output: Path, selection: str) -> None:
    """
    Draw reports of vehicles, each a task; store the cause of a failure, or '', in their rows.

    selection : flagged, all or none.
    """
    job_of = {job.bag.bag: job for job in jobs}
    reported = [row for row in vehicles if row['current_bags'] and (
        selection == 'all' or selection == 'flagged' and tables.needs_inspection(row))]
    report_jobs = [ReportJob(tuple(job_of[bag] for bag in row['current_bags']), str(
        (output / 'reports' / tables.folder_name(row['vehicle'])).resolve()))
        for row in reported]
    keys = [f'{k}-{id(report_jobs)}' for k in range(len(report_jobs))]
    for k, cause, error in task_results(client, draw_report, report_jobs, 'report', keys):
        reported[k]['report'] = cause if error is None else f'{type(error).__name__}: {error}'


def draw_report(job: ReportJob) -> str:
    """Replay bags into a folder; return the cause of a failure, or ''."""
    from odocal_ros.library.calibrate_bag import calibrate_bag
    first = job.jobs[0]
    errors: list[str] = []
    try:
        with ExitStack() as stack:
            bags = [stack.enter_context(local_copy(bag_job.bag.bag, None)) for bag_job in job.jobs]
            calibration = calibrate_bag(bags, first.topics, first.config, first.legs)
            calibration.save(Path(job.output), True, errors.append)
    except OdocalError as error:
        return str(error)
    return '; '.join(errors)


def summary_text(vehicles: Sequence[dict[str, Any]], output: Path, max_vehicles: int) -> str:
    """Return the summary for the terminal, with remarks on at most ``max_vehicles``."""
    counts = Counter(row['decision'] or row['verdict'] for row in vehicles)
    failed = sum(row['bags_failed'] for row in vehicles)
    bags = sum(row['bags'] for row in vehicles)
    lines = [', '.join(f'{n} {decision}' for decision, n in sorted(counts.items()))
             + f'; {counted(bags, "bag")}, {failed} failed']
    flagged = [row for row in vehicles if tables.needs_inspection(row)]
    lines += [f'  {row["vehicle"]}: {"; ".join(remarks(row))}' for row in flagged[:max_vehicles]]
    if len(flagged) > max_vehicles:
        lines.append(f'  and {len(flagged) - max_vehicles} more')
    return '\n'.join([*lines, f'written: {output}/ ({TABLE}, vehicles.parquet, legs.parquet)',
                      f'report:  {output / PAGE}'])


def exit_code(vehicles: Sequence[dict[str, Any]], strict: bool) -> int:
    """Return 1 for failed bags, and for vehicles that are rejected or do not pass; else 0."""
    failing = {'FAIL', 'UNDECIDED', Verdict.REJECTED.value} | (
        {Verdict.CAUTION.value} if strict else set())
    return int(any(row['bags_failed'] or (row['decision'] or row['verdict']) in failing
                   for row in vehicles))
