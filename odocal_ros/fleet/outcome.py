# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Output from a fleet's rows: tables, page, reports of vehicles, summary, exit code."""

from argparse import Namespace
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
import io
from pathlib import Path
from typing import Any

from odocal_ros.errors import OdocalError
from odocal_ros.fleet import second_stage
from odocal_ros.fleet.bag_task import BagJob
from odocal_ros.fleet.bags import at_hand
from odocal_ros.fleet.engine import results
from odocal_ros.fleet.page import fleet_page, remarks
from odocal_ros.fleet.tables import VEHICLES
from odocal_ros.output.figures import counted
from odocal_ros.reasons import Verdict
from odocal_ros.safe_io.atomic_files import locked, write_text
from odocal_ros.safe_io.text_formats import for_table

TABLE, PAGE = 'fleet.csv', 'fleet.html'


@dataclass(frozen=True)
class ReportJob:
    """A replay of the bags of a vehicle since its last change."""

    jobs: tuple[BagJob, ...]
    output: str


def write_outcome(client: Any, jobs: Sequence[BagJob], rows: Sequence[str], output: Path,
                  args: Namespace) -> list[dict[str, Any]]:
    """Write tables, reports and page from the rows of all bags; return the vehicles' rows."""
    of = second_stage.vehicle_jobs([job.bag for job in jobs], rows, asked(jobs))
    vehicles = second_stage.vehicles_together(client, of, output, args.files)
    with locked(output):          # another fleet's command may write here too
        write_text(output / TABLE, _csv(output / VEHICLES))
    _reports(client, vehicles, jobs, output, args.reports)
    with locked(output):
        write_text(output / PAGE, fleet_page(vehicles, output))
    return vehicles


def asked(jobs: Sequence[BagJob]) -> dict[str, Any]:
    """Return the limits of this run, independent of those of the rows."""
    from odocal_ros.fleet.rows import NOT_OF_LEGS
    from odocal_ros.library.asked import config_of
    from odocal_ros.settings.config import flat
    return {name: value for name, value in flat(config_of(jobs[0].config)).items()
            if name.partition('.')[0] in NOT_OF_LEGS and (name != 'frames.imu' or value)}


def _csv(table: Path) -> str:
    """Return a table as text for a spreadsheet."""
    import pyarrow as pa
    from pyarrow import csv, parquet as pq
    whole = pq.ParquetFile(table).read(use_threads=False)
    for i, name in enumerate(whole.column_names):
        if pa.types.is_string(whole.schema.types[i]):
            text = [None if x is None else for_table(x) for x in whole[name].to_pylist()]
            whole = whole.set_column(i, name, pa.array(text, pa.string()))
    sink = io.BytesIO()
    csv.write_csv(whole, sink)
    return sink.getvalue().decode()


def _reports(client: Any, vehicles: Sequence[dict[str, Any]], jobs: Sequence[BagJob], output: Path,
             which: str) -> None:
    """Draw reports of vehicles, each a task; store the cause of a failure, or '', in the row."""
    of = {job.bag.bag: job for job in jobs}
    wanted = [row for row in vehicles if row['now'] and (
        which == 'all' or which == 'flagged' and second_stage.flagged(row))]
    asked_for = [ReportJob(tuple(of[bag] for bag in row['now']), str(
        (output / 'reports' / second_stage.file_name(row['vehicle'])).resolve()))
                 for row in wanted]
    keys = [f'{k}-{id(asked_for)}' for k in range(len(asked_for))]
    for k, why, error in results(client, draw_report, asked_for, 'report', keys):
        wanted[k]['report'] = why if error is None else f'{type(error).__name__}: {error}'


def draw_report(job: ReportJob) -> str:
    """Replay bags into a folder; return the cause of a failure, or ''."""
    from odocal_ros.library.calibrate_bag import calibrate_bag
    first = job.jobs[0]
    troubles: list[str] = []
    try:
        with ExitStack() as stack:
            bags = [stack.enter_context(at_hand(one.bag.bag, None)) for one in job.jobs]
            found = calibrate_bag(bags, first.topics, first.config, first.legs)
            found.save(Path(job.output), True, troubles.append)
    except OdocalError as error:
        return str(error)
    return '; '.join(troubles)


def said(vehicles: Sequence[dict[str, Any]], output: Path, most: int) -> str:
    counts = Counter(row['decision'] or row['verdict'] for row in vehicles)
    failed = sum(row['bags_failed'] for row in vehicles)
    bags = sum(row['bags'] for row in vehicles)
    lines = [', '.join(f'{n} {what}' for what, n in sorted(counts.items()))
             + f'; {counted(bags, "bag")}, {failed} failed']
    worth = [row for row in vehicles if second_stage.flagged(row)]
    lines += [f'  {row["vehicle"]}: {"; ".join(remarks(row))}' for row in worth[:most]]
    if len(worth) > most:
        lines.append(f'  and {len(worth) - most} more')
    return '\n'.join([*lines, f'written: {output}/ ({TABLE}, vehicles.parquet, legs.parquet)',
                      f'report:  {output / PAGE}'])


def exit_code(vehicles: Sequence[dict[str, Any]], strict: bool) -> int:
    """Return 1 for failed bags, and for vehicles that are rejected or do not pass; else 0."""
    bad = {'FAIL', 'UNDECIDED', Verdict.REJECTED.value} | (
        {Verdict.CAUTION.value} if strict else set())
    return int(any(row['bags_failed'] or (row['decision'] or row['verdict']) in bad
                   for row in vehicles))
