# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The jobs of a fleet run: one for each bag, with the settings for its worker."""

from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
import os
from pathlib import Path
import tempfile
from typing import Any

from odocal_ros.errors import BadBag, BadUsage
from odocal_ros.fleet.bag_task import BagJob, calibrate_bag, Done
from odocal_ros.fleet.bags import file_system, FleetBag, is_local, seen_as
from odocal_ros.fleet.engine import results
from odocal_ros.fleet.rows import changed_settings, FAILED, RowStore, settings_key


def bag_jobs(bags: Sequence[FleetBag], args: Namespace, folder: Path, seconds: float,
             memory: int, config: Any = None) -> list[BagJob]:
    """
    Return a job for each bag.

    args : parsed options of replay (``add_calibration_arguments``).   config : settings
    that take precedence, in any form accepted by the library.

    Raises BadUsage, BadConfig: a setting or a settings file is wrong.
    """
    from odocal_ros.library.asked import config_of, legs_of
    from odocal_ros.offline.replay import asked_config, asked_topics
    read: dict[str, dict[str, Any]] = {}
    jobs, topics = [], asked_topics(args)
    before = changed_settings(config_of(config))
    for bag in bags:
        file = bag.config or args.config or ''
        if file not in read:
            read[file] = asked_config(Namespace(**vars(args) | {'config': file}))
        settled = before | read[file] | {'vehicle': bag.vehicle}
        legs = bag.legs or tuple(args.leg)
        legs_of(legs)
        settings = settings_key(config_of(settled), topics, legs)
        if is_local(bag.bag):      # valid for workers in any folder
            bag = replace(bag, bag=os.path.abspath(file_system(bag.bag)[1]))
        jobs.append(BagJob(bag, topics, settled, legs, settings,
                           str(folder.resolve()), seconds, memory))
    return jobs


def computed_rows(client: Any, jobs: Sequence[BagJob],
                  again: bool = False) -> Iterator[tuple[int, Done]]:
    """Yield (number, outcome) of each job as it ends; ``again``: retry failed ones."""
    store = RowStore(jobs[0].folder)
    open_jobs = []
    for i, job in enumerate(jobs):
        if (key := _known(store, job)) is None:
            open_jobs.append(i)
            if again:
                store.drop(job.place)
        else:
            yield i, Done(key, 'done', False)
    asked = [jobs[i] for i in open_jobs]
    for k, done, error in results(client, calibrate_bag, asked, 'bag',
                                  [f'{job.place}-{os.urandom(4).hex()}' for job in asked]):
        job = jobs[open_jobs[k]]
        if error is not None:      # the worker was ended each time, or could not write
            row = store.get(job.place) or job.failed(_why(error))
            store.put(row)
            done = Done(row.key, FAILED, True)
        yield open_jobs[k], done


def _known(store: RowStore, job: BagJob) -> str | None:
    """Return the key of the row of an unchanged bag on this machine, None without one."""
    if not is_local(job.bag.bag):      # the worker contacts servers: they may not answer
        return None
    try:
        return store.known(seen_as(job.bag.bag, job.settings))
    except BadBag:
        return None


def _why(error: BaseException) -> str:
    """Return the cause of a failed task, for people."""
    from distributed.scheduler import KilledWorker
    if isinstance(error, KilledWorker):
        return (f'its worker ended {error.allowed_failures + 1} times during the computation: '
                'killed, or out of memory')
    return f'{type(error).__name__}: {error}'


def writable(folder: Path) -> None:
    """Make the output folder, or raise BadUsage."""
    try:
        for part in ('rows', 'seen'):
            (folder / part).mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise BadUsage(f'{folder}: cannot be written ({error.strerror}); choose another '
                       '--output') from None
