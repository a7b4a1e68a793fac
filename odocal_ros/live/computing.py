# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The running computation, and the callers that wait for its result."""

from collections.abc import Callable
import math
import time
from typing import Any

from rclpy.task import Future

from odocal_ros.live import answers
from odocal_ros.live.worker import give_back, Job, Worker
from odocal_ros.pipeline.prepared import Stage

# judgement: s that ~/stop_leg waits for the result. It answers within 5 s, of which one is for a
# busy machine; the last samples take up to 1 s, the fit of a leg of ten minutes 1 to 2 s
PATIENCE_S = 4.0


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
