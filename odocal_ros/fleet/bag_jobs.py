# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Jobs of a fleet, one for each bag: making them, computing them on workers, storing their rows.

A job that fails, takes too long or ends its worker gets a row with the cause.
"""

from argparse import Namespace
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
import faulthandler
from functools import cache
from importlib import import_module
import json
import os
from pathlib import Path
import resource
import signal
import tempfile
import threading
import time
from typing import Any, NamedTuple

import numpy as np

from odocal_ros.errors import BadBag, BadUsage, OdocalError
from odocal_ros.fleet import rows
from odocal_ros.fleet.bags import bag_fingerprint, file_system, FleetBag, is_local, local_copy
from odocal_ros.fleet.engine import task_results
from odocal_ros.safe_io.text_formats import error_text

# in texts of errors of other types that a lack of memory causes: no stack for a thread, no library
NO_MEMORY = ("can't start new thread", 'failed to map segment')


@dataclass(frozen=True)
class BagJob:
    """The job of a worker for one bag."""

    bag: FleetBag
    # arguments of ``library.calibrate_bag``
    topics: dict[str, str]
    config: dict[str, object]
    legs: tuple[str, ...]
    settings: str                 # hash of topics, legs and the settings that affect a leg
    folder: str                   # of the data set
    time_limit_s: float = 0.0     # 0: none
    memory_limit: int = 0         # bytes; 0: none

    @property
    def failed_key(self) -> str:
        """Return the key of the row of a failed bag, whose content is unknown."""
        return rows.key_of('failed', self.bag.bag, self.settings)

    def row(self, **fields: Any) -> rows.Row:
        """Return the row of the bag with more fields."""
        return rows.Row(bag=self.bag.bag, vehicle=self.bag.vehicle, model=self.bag.model,
                        odometer_km=self.bag.odometer_km, **fields)

    def failed_row(self, reason: str, **fields: Any) -> rows.Row:
        """Return the row of the bag if it cannot be calibrated."""
        max_length = 500    # characters of a reason
        return self.row(key=self.failed_key, status=rows.FAILED, reason=reason[:max_length],
                        **fields)


class BagOutcome(NamedTuple):
    """The report on a bag to the command; the rest is in its row."""

    key: str            # of its row
    status: str
    computed: bool      # False: the row existed


def calibrate_bag(job: BagJob) -> BagOutcome:
    """Ensure that the data set has the row of a bag; compute it if it is missing."""
    store, started_s = rows.RowStore(job.folder), time.monotonic()
    fingerprint = ''
    _load_libraries()
    with _resource_limits(job, lambda cause: store.put(job.failed_row(cause, seen=fingerprint))):
        try:
            fingerprint = bag_fingerprint(job.bag.bag, job.settings)
            if existing := _existing_row(store, job, fingerprint):
                return BagOutcome(existing.key, existing.status, False)
            row, computed = _compute_row(job, store, fingerprint, started_s)
            store.put(row)
            store.put_key(fingerprint, row.key)
            store.drop(job.failed_key)
            return BagOutcome(row.key, row.status, computed)
        except OdocalError as error:
            cause = error_text(error)
        except Exception as error:     # noqa: BLE001 one bag must not stop others
            cause = (f'internal error ({type(error).__name__}: {error_text(error)}); '
                     'please report it')
            if isinstance(error, MemoryError) or any(text in str(error) for text in NO_MEMORY):
                cause = ('exceeds the memory limit --task-memory '
                         f'({job.memory_limit / 2**20:g} MiB)')
    # outside the memory limit: the row needs memory
    row = job.failed_row(cause, seen=fingerprint, seconds=time.monotonic() - started_s)
    store.put(row)
    return BagOutcome(row.key, rows.FAILED, True)


@cache
def _load_libraries() -> None:
    """Load libraries before memory is limited: OpenBLAS retries endlessly if it is refused."""
    for name in ('odocal_ros.estimator', 'odocal_ros.library.calibrate_bag'):
        import_module(name)
    from scipy.linalg import cho_factor
    matrix = np.eye(128)        # large enough that OpenBLAS needs a buffer
    cho_factor(matrix @ matrix)


def _existing_row(store: rows.RowStore, job: BagJob, fingerprint: str) -> rows.Row | None:
    """Return the existing row of an unchanged bag, None without one."""
    if key := store.find_key(fingerprint):
        return store.get(key)
    failed = store.get(job.failed_key)
    # a bag that ended its worker may have no fingerprint: only its path is known
    return failed if failed and failed.seen in ('', fingerprint) else None


def _compute_row(job: BagJob, store: rows.RowStore, fingerprint: str,
                 started_s: float) -> tuple[rows.Row, bool]:
    """Return the row of a bag, and whether it was computed; False: copied from an equal bag."""
    from odocal_ros.bagio.read import bag_sha256, open_bag
    from odocal_ros.library.calibrate_bag import calibrate_bag as calibrate
    worker = _worker()
    with local_copy(job.bag.bag, worker.local_directory if worker else None) as path:
        with open_bag(path) as bag:
            sha256 = bag_sha256(bag)
            size = sum(Path(file).stat().st_size for file in bag.files)
        key = rows.key_of(sha256, job.settings)
        if (equal_row := store.get(key)) is not None:
            return replace(equal_row, bag=job.bag.bag, seen=fingerprint), False
        calibration = calibrate(path, job.topics, job.config, job.legs)
    legs = calibration.result.legs
    return job.row(
        key=key, seen=fingerprint, sha256=sha256,
        topics=json.dumps(calibration.inputs[0]['topics']),
        settings=json.dumps(rows.changed_settings(calibration.config), sort_keys=True), bytes=size,
        seconds=time.monotonic() - started_s, driven_s=sum(leg.duration for leg in legs),
        start_ns=min((leg.start_ns for leg in legs), default=0),
        legs=rows.text_of_legs(list(legs))), True


def _worker() -> Any:
    """Return the Dask worker of this process, None without one."""
    from distributed import get_worker
    try:
        return get_worker()
    except ValueError:
        return None


@contextmanager
def _resource_limits(job: BagJob, store_failure: Callable[[str], None]) -> Iterator[None]:
    """
    Limit the memory; after the time limit store the failure of the bag and kill this worker.

    Nothing else ends hanging code. The worker's nanny starts another worker, which gets the bag
    again from Dask; its row then exists. Without a nanny there are no limits.
    """
    worker = _worker()
    if worker is None or worker.nanny is None:
        yield
        return

    def end() -> None:
        with suppress(Exception):
            store_failure(f'exceeded the time limit --task-timeout ({job.time_limit_s:g} s)')
        os.kill(os.getpid(), signal.SIGKILL)

    timer = threading.Timer(job.time_limit_s, end)
    timer.daemon = True
    if job.time_limit_s:
        timer.start()
        grace_s = 10.0    # then the process is ended even if the interpreter hangs
        faulthandler.dump_traceback_later(job.time_limit_s + grace_s, exit=True)
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    if job.memory_limit:
        limit = _data_bytes() + job.memory_limit
        resource.setrlimit(resource.RLIMIT_DATA, (
            limit if hard == resource.RLIM_INFINITY else min(limit, hard), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))
        timer.cancel()
        faulthandler.cancel_dump_traceback_later()


def _data_bytes() -> int:
    """Return the private data memory of this process, bytes."""
    status = Path('/proc/self/status').read_text().splitlines()
    return next((int(line.split()[1]) * 1024 for line in status if line.startswith('VmData:')), 0)


def bag_jobs(bags: Sequence[FleetBag], args: Namespace, folder: Path, time_limit_s: float,
             memory_limit: int, config: Any = None) -> list[BagJob]:
    """
    Return a job for each bag.

    args : parsed options of replay (``add_calibration_arguments``).   time_limit_s, memory_limit :
    for a bag, s and bytes.   config : settings, in any form accepted by the library; options and
    settings files take precedence.

    Raises BadUsage, BadConfig: a setting or a settings file is wrong.
    """
    from odocal_ros.library.arguments import config_of, legs_of
    from odocal_ros.offline.replay import config_from_arguments, topics_from_arguments
    settings_of_file: dict[str, dict[str, Any]] = {}
    jobs, topics = [], topics_from_arguments(args)
    base = rows.changed_settings(config_of(config))
    for bag in bags:
        file = bag.config or args.config or ''
        if file not in settings_of_file:
            settings_of_file[file] = config_from_arguments(
                Namespace(**vars(args) | {'config': file}))
        settings = base | settings_of_file[file] | {'vehicle': bag.vehicle}
        legs = bag.legs or tuple(args.leg)
        legs_of(legs)
        key = rows.settings_key(config_of(settings), topics, legs)
        if is_local(bag.bag):      # valid for workers in any folder
            bag = replace(bag, bag=os.path.abspath(file_system(bag.bag)[1]))
        jobs.append(BagJob(bag, topics, settings, legs, key, str(folder.resolve()), time_limit_s,
                           memory_limit))
    return jobs


def computed_rows(client: Any, jobs: Sequence[BagJob],
                  retry_failed: bool = False) -> Iterator[tuple[int, BagOutcome]]:
    """Yield (index of the job, outcome) as jobs end; the row of each is then stored."""
    store = rows.RowStore(jobs[0].folder)
    missing = []      # indices of jobs without a row
    for i, job in enumerate(jobs):
        if (key := _existing_key(store, job)) is None:
            missing.append(i)
            if retry_failed:
                store.drop(job.failed_key)
        else:
            yield i, BagOutcome(key, rows.DONE, False)
    submitted = [jobs[i] for i in missing]
    # random: Dask keeps the result of a task of the same key
    keys = [f'{job.failed_key}-{os.urandom(4).hex()}' for job in submitted]
    for k, outcome, error in task_results(client, calibrate_bag, submitted, 'bag', keys):
        if error is not None:      # the worker was ended each time, or could not write
            row = store.get(submitted[k].failed_key) or submitted[k].failed_row(
                _failure_text(error))
            store.put(row)
            outcome = BagOutcome(row.key, rows.FAILED, True)
        yield missing[k], outcome


def _existing_key(store: rows.RowStore, job: BagJob) -> str | None:
    """Return the key of the row of an unchanged local bag, None without one."""
    if not is_local(job.bag.bag):      # only workers contact servers, which may not answer
        return None
    try:
        return store.find_key(bag_fingerprint(job.bag.bag, job.settings))
    except BadBag:
        return None


def _failure_text(error: BaseException) -> str:
    """Return the cause of a failed task, for people."""
    from distributed.scheduler import KilledWorker
    if isinstance(error, KilledWorker):
        return (f'its worker ended {error.allowed_failures + 1} times during the computation: '
                'killed, or out of memory')
    return f'{type(error).__name__}: {error}'


def make_output_folder(folder: Path) -> None:
    """Make the output folder, or raise BadUsage."""
    try:
        for part in ('rows', 'seen'):
            (folder / part).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise BadUsage(f'{folder}: cannot be written ({error.strerror}); choose another '
                       '--output') from None
