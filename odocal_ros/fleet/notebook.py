# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""calibrate_bags: calibrate the bags of a fleet from Python, for notebooks."""

from collections.abc import Mapping, Sequence
from pathlib import Path
import tempfile
from typing import Any

from odocal_ros.errors import BadUsage


def calibrate_bags(bags: Any, config: Any = None, client: Any = None,
                   output: str | Path | None = None, **options: Any) -> Any:
    """
    Calibrate bags separately, and return a pandas DataFrame with one row per leg.

    bags : bags, folders, globs or URLs, or a manifest; a DataFrame has the manifest's columns.
    config : Config, settings by dotted name, or a parameter file.   client : distributed.Client
    of the workers; None: temporary local processes.   output : folder for the rows, which later
    calls reuse; None: a temporary folder.   options : of ``replay`` by name: imu_topic, leg,
    method and the like; vehicle_from.

    Returns the columns of legs.parquet, and ``status`` and ``reason`` of the bag; a failed bag is
    a row without values.
    """
    from odocal_ros.fleet.engine import check_installed, engine, MEMORY
    check_installed()
    from odocal_ros.fleet.bags import find_bags
    from odocal_ros.fleet.command import TIMEOUT
    from odocal_ros.fleet.jobs import bag_jobs
    vehicle_from = options.pop('vehicle_from', None)
    if hasattr(bags, 'to_dict'):
        found = [_bag(row) for row in bags.to_dict('records')]
    else:
        names = [bags] if isinstance(bags, (str, Path)) else bags
        found = find_bags([str(name) for name in names], vehicle_from)
    args = _arguments(options)
    with tempfile.TemporaryDirectory(prefix='odocal_') as temporary:
        jobs = bag_jobs(found, args, Path(output or temporary), TIMEOUT, MEMORY, config)
        if client is not None:
            return _frame(client, jobs)
        with engine(None, None, MEMORY, 3) as own:
            return _frame(own, jobs)


def _bag(row: Mapping[str, Any]) -> Any:
    from odocal_ros.fleet.bags import COLUMNS, FleetBag
    known = {name: row[name] for name in COLUMNS if name in row and row[name] == row[name]
             and row[name] is not None}
    return FleetBag(**known | {'legs': tuple(str(known.get('legs', '')).split())})


def _arguments(options: dict[str, Any]) -> Any:
    from argparse import ArgumentParser

    from odocal_ros.offline.replay import add_calibration_arguments
    parser = ArgumentParser()
    add_calibration_arguments(parser)
    args = parser.parse_args([])
    unknown = set(options) - set(vars(args))
    if unknown:
        raise BadUsage(f'calibrate_bags has no option {", ".join(sorted(unknown))}; options: '
                       f'{", ".join(sorted(vars(args)))}')
    for name, value in options.items():
        setattr(args, name, value)
    return args


def _frame(client: Any, jobs: Sequence[Any]) -> Any:
    import pandas as pd

    from odocal_ros.fleet.jobs import computed_rows
    from odocal_ros.fleet.rows import rows_of, RowStore
    from odocal_ros.fleet.tables import rows_of_legs
    store = RowStore(jobs[0].folder)
    files = {i: store.path(done.key) for i, done in computed_rows(client, jobs)}
    table = []
    for i in sorted(files):
        row = next(rows_of([files[i]]))
        table += rows_of_legs(jobs[i].bag, row)
    return pd.DataFrame(table)
