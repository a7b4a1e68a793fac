# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Processes of the fleet benchmarks: the command, a Dask cluster, children of a process."""

from contextlib import contextmanager, suppress
import os
import signal
import subprocess
import sys

ODOCAL = [sys.executable, '-m', 'odocal_ros.offline.cli']
QUICK = ['--method', 'two_point', '--reports', 'none', '--quiet']


@contextmanager
def process(*command, **options):
    """Run a command beside, and end it with all of its own."""
    running = subprocess.Popen(command, start_new_session=True, **options)
    try:
        yield running
    finally:
        with suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGKILL)
        running.wait()


@contextmanager
def cluster(folder, port, workers=2):
    """Run a dask scheduler and workers over TCP; give its address and the processes."""
    env = os.environ | {'OPENBLAS_NUM_THREADS': '1'}
    quiet = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.DEVNULL, 'env': env}
    address = f'tcp://127.0.0.1:{port}'
    dask = [sys.executable, '-m', 'dask']
    with process(*dask, 'scheduler', '--host', '127.0.0.1', '--port', str(port),
                 '--no-dashboard', **quiet) as scheduler:
        worker = [*dask, 'worker', address, '--nthreads', '1', '--no-dashboard',
                  '--memory-limit', '0', '--local-directory', str(folder)]
        with process(*worker, '--nworkers', str(workers), **quiet):
            yield address, scheduler


def children(pid):
    """Return the processes that run tasks below one."""
    import psutil
    try:
        every = psutil.Process(pid).children(recursive=True)
        return [p.pid for p in every if 'spawn_main' in ' '.join(p.cmdline())]
    except psutil.Error:
        return []


def fleet_command(fleet, output, *options):
    """Return the command that computes a fleet."""
    return [*ODOCAL, 'fleet', str(fleet / 'manifest.csv'), '--output', str(output), *QUICK,
            *options]
