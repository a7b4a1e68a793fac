# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""One thread for the heavy work, the running computation, and callers that wait for its result."""

from collections.abc import Callable
import ctypes
import math
import queue
import threading
import time
from typing import Any, TypeAlias

from rclpy.task import Future

from odocal_ros.live import answers
from odocal_ros.pipeline.prepared import Stage

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
# judgement: s that ~/stop_leg waits for the result. It answers within 5 s, of which one is for a
# busy machine; the last samples take up to 1 s, the fit of a leg of ten minutes 1 to 2 s
PATIENCE_S = 4.0


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


class Computing:
    """
    At most one active job; the result of a dropped one is ignored.

    ``failed(trouble)`` is called for a job that raised, or whose result could not be taken;
    ``done()`` is called after each that counted. ``alive()`` is false while the node is shut
    down: what breaks then is no failure.
    """

    def __init__(self, worker: Worker, failed: Callable[[str], None],
                 done: Callable[[], None], alive: Callable[[], bool]) -> None:
        self._worker, self._failed, self._done, self._alive = worker, failed, done, alive
        self._job: object | None = None
        self._waiting: list[tuple[Future, float]] = []     # until when, s of the monotonic clock
        self.at = Stage()

    def report(self, stage: Stage) -> None:
        """Store the progress of the job; called by the worker's thread."""
        self.at = stage
        give_back()      # what the pass before needed

    def submit(self, job: Job, take: Callable[[Any], object]) -> None:
        """Run a job in the worker and hand its result to ``take``."""
        self._job = token = object()
        self.at = Stage()

        def then(result: Any, error: Exception | None) -> None:
            if token is not self._job:
                return
            self._job = None
            try:
                if error is None:
                    take(result)
            except Exception as wrong:      # else nobody who waits would ever be answered
                if not self._alive():
                    raise
                error = wrong
            if error is not None:
                self._failed(answers.one_line(error))
            self._done()

        self._worker.submit(job, then)

    def drop(self) -> None:
        """Drop the job: its result will be ignored."""
        self._job = None

    def promise(self, patience_s: float = math.inf) -> Future:
        """Return a future that the next answer, or that of ``answer_late``, will be set on."""
        future = Future()
        self._waiting.append((future, time.monotonic() + patience_s))
        return future

    def answer(self, success: bool, text: str) -> None:
        """Answer all waiting callers."""
        waiting, self._waiting = self._waiting, []
        for future, _ in waiting:
            future.set_result((success, text))

    def answer_late(self, text: Callable[[], str]) -> None:
        """Answer callers whose waiting time is over; the job continues."""
        now = time.monotonic()
        late = [future for future, until in self._waiting if until <= now]
        self._waiting = [one for one in self._waiting if one[1] > now]
        for future in late:
            future.set_result((True, text()))
