# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
odocal fleet, and calibrate_bags for notebooks: bags of many vehicles, each a task on Dask.

Imports of Dask and the pipeline are inside functions, so that --help stays quick.
"""

import argparse
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
import re
import sys
import tempfile
from typing import Any, TYPE_CHECKING

from odocal_ros.errors import BadUsage
from odocal_ros.offline.cli import print_text, warn
from odocal_ros.offline.replay import add_calibration_arguments

if TYPE_CHECKING:
    from odocal_ros.fleet.bag_jobs import BagJob

TIMEOUT = 3600.0      # s, judgement: time limit of a bag, by default
GIB = 2**30           # definition: bytes


def _byte_count(text: str) -> int:
    """Return the bytes of a size such as 500M."""
    match = re.fullmatch(r'(\d+(?:\.\d+)?) ?([KMG]?)(?:i?B)?', text)
    if not match or not float(match[1]):
        raise argparse.ArgumentTypeError(f'{text}: required: a size such as 2G or 500M')
    units = {'': 1, 'K': 2**10, 'M': 2**20, 'G': GIB}
    return int(float(match[1]) * units[match[2]])


def _positive_count(text: str) -> int:
    try:
        number = int(text)
    except ValueError:
        number = 0
    if number < 1:
        raise argparse.ArgumentTypeError(f'{text}: required: a whole number, 1 or more')
    return number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('bags', nargs='+', metavar='BAG', help='a manifest (.csv or .parquet with columns vehicle '
        'and bag), or bags, folders of bags, globs, URLs')
    add('--output', required=True, metavar='DIR', help='folder for rows and results; all workers '
        'must have access')
    add('--vehicle-from', metavar='PATTERN', help='regular expression for the path of a bag; '
        "its group is the name of the vehicle (default: the name of the bag's folder)")
    add('--scheduler', metavar='ADDRESS', help='Dask cluster, such as tcp://host:8786 (default: '
        'local processes)')
    add('--workers', type=_positive_count, metavar='N', help='number of local processes (default: '
        'limited by cores and memory)')
    add('--task-timeout', type=float, default=TIMEOUT, metavar='S', help='time limit per bag '
        f'(default {TIMEOUT:g})')
    add('--task-memory', type=_byte_count, default=2 * GIB, metavar='SIZE', help='memory limit '
        'per bag (default 2G)')
    add('--tries', type=_positive_count, default=3, metavar='N', help='attempts per bag '
        'if its local worker process is killed, such as out of memory (default 3)')
    add('--again', action='store_true', help='retry bags that failed in an earlier run')
    add('--reports', choices=('flagged', 'all', 'none'), default='flagged', help='vehicles that '
        'get report.html; flagged (default): those that need inspection')
    add('--kpi', action='store_true', help='with limits (--accept): compare the decision on each '
        'leg with the decision on all legs of the vehicle; writes kpi.json')
    add('--files', action='store_true', help='write configuration files for each vehicle '
        '(Autoware, ros2_control, receivers, TF)')
    add('--quiet', action='store_true', help='print only errors, and with limits (--accept) the '
        'accept/reject line of each vehicle')
    add_calibration_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Calibrate a fleet; return 0 without failures (with --accept: all pass), else 1."""
    from odocal_ros.fleet.engine import check_installed
    check_installed()
    from odocal_ros.fleet.bag_jobs import bag_jobs, make_output_folder
    from odocal_ros.fleet.bags import find_bags
    from odocal_ros.fleet.engine import engine
    from odocal_ros.fleet.fleet_results import exit_code, run_settings, summary_text, write_outcome
    from odocal_ros.fleet.kpi import write_kpi
    from odocal_ros.output.value_text import counted
    from odocal_ros.settings.config import Config, with_settings
    if not args.task_timeout > 0:
        raise BadUsage(f'--task-timeout {args.task_timeout:g}: required: seconds above 0')
    output = Path(args.output)
    bags = find_bags(args.bags, args.vehicle_from)
    jobs = bag_jobs(bags, args, output, args.task_timeout, args.task_memory)
    limits = with_settings(Config(), run_settings(jobs)).accept.limits
    if args.kpi and not limits:
        raise BadUsage('--kpi requires limits: give --accept NAME=LOW:HIGH')
    make_output_folder(output)
    with engine(args.scheduler, args.workers, args.task_memory, args.tries) as client:
        if not args.quiet:
            address = client.dashboard_link if find_spec('bokeh') else ''    # bokeh draws it
            warn(f'odocal: {counted(len(jobs), "bag")} of '
                 f'{counted(len({b.vehicle for b in bags}), "vehicle")}'
                 + f'; dashboard: {address}' * bool(address))
        row_files = _compute_rows(client, jobs, args)
        vehicles = write_outcome(client, jobs, row_files, output, args)
    kpi_text = write_kpi(vehicles, limits, output) if args.kpi else ''
    if args.accept or any(row['decision'] for row in vehicles):
        for row in vehicles:
            print_text(row['line'])
    if not args.quiet:
        max_vehicles = 20    # with remarks on the terminal
        print_text(summary_text(vehicles, output, max_vehicles) + kpi_text)
    return exit_code(vehicles, args.strict)


def _compute_rows(client: Any, jobs: 'list[BagJob]', args: argparse.Namespace) -> list[str]:
    """Compute the rows of all bags and show the progress; return their files, in order."""
    from tqdm import tqdm

    from odocal_ros.fleet.bag_jobs import computed_rows
    from odocal_ros.fleet.rows import FAILED, RowStore
    store, failed_count = RowStore(jobs[0].folder), 0
    row_files = [''] * len(jobs)
    on_terminal = sys.stderr is not None and sys.stderr.isatty()
    with tqdm(total=len(jobs), unit='bag', disable=args.quiet, file=sys.stderr, dynamic_ncols=True,
              mininterval=0.5 if on_terminal else 30.0, desc='bags') as bar:
        for i, outcome in computed_rows(client, jobs, args.again):
            row_files[i] = str(store.path(outcome.key))
            failed_count += outcome.status == FAILED
            bar.set_postfix(failed=failed_count, refresh=False)
            bar.update()
    return row_files


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
    from odocal_ros.fleet.bag_jobs import bag_jobs
    from odocal_ros.fleet.bags import bag_of_row, find_bags
    vehicle_from = options.pop('vehicle_from', None)
    if hasattr(bags, 'to_dict'):
        fleet_bags = [bag_of_row(row, '', f'row {number}')
                      for number, row in enumerate(bags.to_dict('records'))]
    else:
        names = [bags] if isinstance(bags, (str, Path)) else bags
        fleet_bags = find_bags([str(name) for name in names], vehicle_from)
    args = _arguments(options)
    with tempfile.TemporaryDirectory(prefix='odocal_') as temporary:
        jobs = bag_jobs(fleet_bags, args, Path(output or temporary), TIMEOUT, MEMORY, config)
        if client is not None:
            return _data_frame(client, jobs)
        with engine(None, None, MEMORY, 3) as local_client:
            return _data_frame(local_client, jobs)


def _arguments(options: dict[str, Any]) -> Any:
    """Return the arguments of replay, by name; raise BadUsage for an unknown one."""
    parser = argparse.ArgumentParser()
    add_calibration_arguments(parser)
    args = parser.parse_args([])
    unknown = set(options) - set(vars(args))
    if unknown:
        raise BadUsage(f'calibrate_bags has no option {", ".join(sorted(unknown))}; options: '
                       f'{", ".join(sorted(vars(args)))}')
    for name, value in options.items():
        setattr(args, name, value)
    return args


def _data_frame(client: Any, jobs: Sequence[Any]) -> Any:
    import pandas as pd

    from odocal_ros.fleet.bag_jobs import computed_rows
    from odocal_ros.fleet.rows import read_rows, RowStore
    from odocal_ros.fleet.tables import table_rows
    store = RowStore(jobs[0].folder)
    row_files = {i: store.path(outcome.key) for i, outcome in computed_rows(client, jobs)}
    bag_rows = read_rows(row_files[i] for i in range(len(jobs)))
    return pd.DataFrame([row for job, bag_row in zip(jobs, bag_rows, strict=True)
                         for row in table_rows(job.bag, bag_row)])
