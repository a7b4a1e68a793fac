# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One thread for the heavy work, so that callbacks stay short; memory that it frees goes back."""

from collections.abc import Callable
import ctypes
import queue
import threading
from typing import Any, TypeAlias

# judgement: s that a stopping node waits, for a computation and for files: launch asks again,
# and harder, after 5 s
JOB_GRACE_S, FILES_GRACE_S = 1.0, 4.0
Job: TypeAlias = Callable[[], Any]
Then: TypeAlias = Callable[[Any, Exception | None], None]      # one of them is None
Outcome: TypeAlias = tuple[Then, Any, Exception | None]
# Left alone glibc keeps an arena for every thread, and takes arrays of up to 32 MiB out of it once
# one was freed: a node held 100 MiB that nobody used after an hour's leg at 1 kHz. judgement, of
# mallopt(3): arenas for all threads together, bytes from which a block is mapped separately
OPTIONS = {-8: 2, -3: 2**22}
_libc = ctypes.CDLL(None)


class Worker:
    """
    Runs jobs one after the other in a thread of its own.

    ``poll`` hands their outcomes to the thread that asks, the executor's, so that nothing but
    the job itself ever runs beside the callbacks. A stopping node waits for result files just
    asked for, report included, but not for a long computation.
    """

    def __init__(self) -> None:
        self._jobs: queue.Queue[tuple[Job, Then] | None] = queue.Queue()
        self._done: queue.SimpleQueue[Outcome] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name='odocal_worker', daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Return True if a job is running or waiting."""
        return self._jobs.unfinished_tasks > 0

    def submit(self, job: Job, then: Then) -> None:
        """Run ``job()``; ``poll`` will call ``then(result, error)`` with one of them None."""
        self._jobs.put((job, then))

    def poll(self) -> None:
        """Call what was to follow each job that has ended."""
        while not self._done.empty():
            then, result, error = self._done.get()
            then(result, error)

    def close(self, grace_s: float = JOB_GRACE_S) -> bool:
        """Let the thread end after its queue; return True if it ended within ``grace_s``."""
        self._jobs.put(None)
        self._thread.join(grace_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (entry := self._jobs.get()) is not None:
            self._done.put(_outcome(*entry))
            del entry       # a job holds a leg: not until the next one comes
            give_back()
            self._jobs.task_done()


def _outcome(job: Job, then: Then) -> Outcome:
    """Do a job; every failure of it is an answer to the operator."""
    try:
        return then, job(), None
    except Exception as error:
        return then, None, error


def hold_little() -> None:
    """Keep little of what is freed; nothing changes where the C library has no such options."""
    if hasattr(_libc, 'mallopt'):
        for option, value in OPTIONS.items():
            _libc.mallopt(option, value)


def give_back() -> None:
    """Give whole free pages back; nothing where the C library cannot."""
    if hasattr(_libc, 'malloc_trim'):
        _libc.malloc_trim(0)
