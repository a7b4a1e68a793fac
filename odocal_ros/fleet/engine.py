# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Dask as the engine of a fleet: local processes or an existing cluster."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
import logging
import os
from typing import Any, NamedTuple

from odocal_ros.errors import BadUsage, OdocalError

REQUIRED_PACKAGES = ('cryptography', 'dask', 'distributed', 'fsspec', 'pyarrow', 'pandas')
MEMORY = 2 * 2**30       # judgement: bytes for a task, by default
MIN_TASKS = 50        # judgement: least number submitted: workers may be starting
CONNECTION_LOST = ('the connection to the Dask scheduler is lost; start it again and repeat the '
                   'command: finished bags are kept')


def check_installed() -> None:
    """Raise BadUsage with the command that installs the missing packages."""
    missing = [name for name in REQUIRED_PACKAGES if find_spec(name) is None]
    if missing:
        raise BadUsage(f'odocal fleet needs {", ".join(missing)}: pip install '
                       f'{" ".join(missing)}')


@contextmanager
def engine(scheduler: str | None, workers: int | None, memory: int, tries: int) -> Iterator[Any]:
    """
    Yield a Dask client: of the scheduler at an address, or of temporary local processes.

    workers : None: as many as cores or memory allow.   memory : bytes of a task.
    tries : attempts for a bag that ends its worker; an existing cluster has a setting for it.
    """
    import dask
    from distributed import Client, LocalCluster, Security
    if scheduler:
        for name in ('distributed', 'tornado.application'):      # BadUsage reports the error
            logging.getLogger(name).setLevel(logging.CRITICAL)
        try:
            client = Client(scheduler, timeout='5s')
        except (OSError, RuntimeError, ValueError) as error:
            raise BadUsage(f'--scheduler {scheduler}: no answer ({error}); start one with: dask '
                           'scheduler') from None
        with client:
            yield client
        return
    local_settings = {
        'distributed.scheduler.allowed-failures': tries - 1,
        # a worker gets one bag at a time: one that ends its worker affects no other bag
        'distributed.scheduler.worker-saturation': 1.0,
        'distributed.logging.distributed': 'critical',
        'distributed.worker.memory.terminate': False,
        # profiling every 10 ms takes 5 % of a core
        'distributed.worker.profile.enabled': False,
        # replaces Dask's default, whose MALLOC_TRIM_THRESHOLD_ returns memory at once: page
        # faults at its next use took a quarter of a bag's time
        'distributed.nanny.pre-spawn-environ': dict.fromkeys(
            ('OMP_NUM_THREADS', 'MKL_NUM_THREADS', 'OPENBLAS_NUM_THREADS'), 1)}
    with dask.config.set(local_settings), LocalCluster(
            n_workers=workers or _workers(memory), threads_per_worker=1, processes=True,
            # access to a scheduler's port allows to run code: a temporary key is required
            security=Security.temporary(), host='127.0.0.1',
            dashboard_address='127.0.0.1:0', memory_limit=0,
            silence_logs='CRITICAL') as cluster, Client(cluster) as client:
        yield client


def _workers(memory: int) -> int:
    """Return the number of processes that cores and free memory allow."""
    import psutil
    free = int(psutil.virtual_memory().available)
    return max(1, min(len(os.sched_getaffinity(0)), free // memory))


class TaskResult(NamedTuple):
    """The end of a task."""

    job: int        # its index
    result: Any     # None after an error
    error: BaseException | None


def task_results(client: Any, task: Callable[[Any], Any], jobs: Sequence[Any], name: str,
                 keys: Sequence[str]) -> Iterator[TaskResult]:
    """
    Yield the result of ``task`` for each job as tasks end, in any order.

    name, keys : key of each task on the scheduler, which gets some tasks for each worker at a
    time: this limits its memory.

    Raises OdocalError: the connection to the scheduler is lost.
    """
    from distributed import as_completed, CancelledError
    completed, waiting, batch_size = as_completed(), range(len(jobs)), 0
    running: dict[str, int] = {}      # index of the job by key of its task
    while waiting or running:
        error, result = None, None
        if waiting and len(running) <= batch_size:
            batch_size = _batch_size(client)
            batch, waiting = waiting[:batch_size], waiting[batch_size:]
            futures = client.map(task, [jobs[i] for i in batch], pure=True, retries=0,
                                 key=[f'{name}-{keys[i]}' for i in batch])
            running |= {future.key: i for future, i in zip(futures, batch, strict=True)}
            completed.update(futures)
            del futures      # a reference would keep all results in memory
        future = next(completed)
        try:
            result = future.result()
        except CancelledError:
            raise OdocalError(CONNECTION_LOST) from None
        except Exception as failure:     # noqa: BLE001 of the task, or that its workers were ended
            error = failure
        yield TaskResult(running.pop(future.key), result, error)
        future.release()


def _batch_size(client: Any) -> int:
    """Return the number of tasks to submit at a time."""
    try:
        per_worker = 2
        return max(MIN_TASKS, per_worker * int(sum(client.nthreads().values())))
    except OSError:
        raise OdocalError(CONNECTION_LOST) from None
