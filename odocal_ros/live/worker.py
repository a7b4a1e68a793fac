# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Worker thread of the calibration node: runs computations one at a time, outside the executor."""

from collections.abc import Callable
import ctypes
from dataclasses import dataclass
from functools import partial
import math
import queue
import threading
import time
from typing import Any, TypeAlias

from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import Path as PathMessage
from rclpy.task import Future
from std_msgs.msg import Header

from odocal_ros.calib.marginal_information import CarriedInformation
from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.data.arrays import Floats
from odocal_ros.data.leg import LegRecorder
from odocal_ros.live import answers
from odocal_ros.live.session import LEGS_WITH_TRACKS, MAX_OPERATOR_LEGS
from odocal_ros.output.plot_style import even_rows
from odocal_ros.output.stored import known_imu
from odocal_ros.pipeline.automatic import add_to_carried, rejecting_reason
from odocal_ros.pipeline.calibrate import calibrate_parts, combine
from odocal_ros.pipeline.prepared_leg import Stage
from odocal_ros.reasons import Reason
from odocal_ros.settings.config import Config

MAX_POSES = 2000    # judgement: of a published path
Paths: TypeAlias = tuple[PathMessage, PathMessage]      # dead reckoning, reference
# judgement: s that a stopping node waits for a job, and for files; launch terminates it after 5 s
JOB_GRACE_S, FILES_GRACE_S = 1.0, 4.0
Job: TypeAlias = Callable[[], Any]
# called with the result of a job and None, or with None and its error
OnDone: TypeAlias = Callable[[Any, Exception | None], None]
# By default glibc has an arena for every thread and, once one was freed, takes arrays of up to 32
# MiB from it: a node kept 100 MiB unused after a leg of an hour at 1 kHz. judgement, of
# mallopt(3): M_ARENA_MAX, arenas of all threads; M_MMAP_THRESHOLD, bytes of a separate block
MALLOC_OPTIONS = {-8: 2, -3: 2**22}
_libc = ctypes.CDLL(None)
# judgement: s after which ~/stop_leg answers without the result. Callers wait 5 s, of which 1 s is
# for a busy machine; the last samples take up to 1 s, the fit of a leg of ten minutes 1 to 2 s
STOP_ANSWER_S = 4.0


@dataclass(frozen=True, eq=False)
class ComputedLeg:
    """Result of a leg."""

    results: tuple[LegResult, ...]         # of each part; gaps of the IMU separate parts
    paths: Paths                           # of the longest part
    calibration: Calibration               # combination with all other legs
    carried: CarriedInformation | None     # of the legs that are no longer kept
    released_count: int                    # number of oldest kept legs that were added to it now


@dataclass(frozen=True, eq=False)
class UnusedLeg:
    """Result of an unused automatic leg, and the cause."""

    results: tuple[LegResult, ...]
    reason: Reason


def compute(recorder: LegRecorder, start_ns: int, stop_ns: int,
            kept_results: list[tuple[LegResult, ...]], config: Config,
            carried: CarriedInformation | None = None, is_automatic: bool = False,
            progress: Callable[[Stage], None] | None = None) -> ComputedLeg | UnusedLeg:
    """
    Return a leg's result, its combination with the kept legs, and the paths to publish.

    start_ns, stop_ns : stamps of the marks.   kept_results : of each kept leg.   carried :
    information of earlier legs.   progress : called with each stage of the computation.
    """
    leg = recorder.close(start_ns, stop_ns, config.leg.preroll)
    results = tuple(calibrate_parts(leg, config, progress=progress))
    if is_automatic and (reason := rejecting_reason(results[0])):
        return UnusedLeg(results, reason)
    paths = leg_paths(max(results, key=lambda result: result.distance), config)
    max_legs = LEGS_WITH_TRACKS if is_automatic else MAX_OPERATOR_LEGS
    released_count = max(0, len(kept_results) + 1 - max_legs)
    new_carried = add_to_carried(
        [result for leg in kept_results[:released_count] for result in leg], config, carried)
    # results of the two-point method cannot be added to ``carried``: all legs are kept
    if new_carried is carried and not is_automatic:
        released_count = 0
    all_results = [*(result for leg in kept_results[released_count:] for result in leg), *results]
    calibration = combine(all_results, config, new_carried, known_imu(config))
    return ComputedLeg(results, paths, calibration, new_carried, released_count)


def recombine(results: list[LegResult], config: Config,
              carried: CarriedInformation | None = None) -> tuple[Calibration, Paths]:
    """Return the combination of the kept legs, at least one, and the paths of the last one."""
    return combine(results, config, carried, known_imu(config)), leg_paths(results[-1], config)


def leg_paths(result: LegResult | None, config: Config) -> Paths:
    """Return the paths of a leg in the frame frames.local, empty without a leg."""
    header = Header(frame_id=config.frames.local)
    if result is None:
        return PathMessage(header=header), PathMessage(header=header)
    header.stamp.sec, header.stamp.nanosec = divmod(result.stop_ns, 10**9)
    return _path(result.track_n, header), _path(result.reference_n, header)


def _path(track_n: Floats | None, header: Header) -> PathMessage:
    """Return at most MAX_POSES positions of a track, (n, 3) m, as a message."""
    if track_n is None or not len(track_n):
        return PathMessage(header=header)
    upright = Quaternion(w=1.0)
    return PathMessage(header=header, poses=[
        PoseStamped(header=header, pose=Pose(
            position=Point(x=float(x), y=float(y), z=float(z)), orientation=upright))
        for x, y, z in track_n[even_rows(len(track_n), MAX_POSES)]])


class Worker:
    """
    Runs jobs one after the other in its own thread.

    ``poll`` delivers their results in the calling thread, the executor's: only the job itself
    runs in parallel to the callbacks. A stopping node waits for requested result files and their
    report, but not for a long computation.
    """

    def __init__(self) -> None:
        self._jobs: queue.Queue[tuple[Job, OnDone] | None] = queue.Queue()
        self._deliveries: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name='odocal_worker', daemon=True)
        self._thread.start()

    @property
    def is_busy(self) -> bool:
        return self._jobs.unfinished_tasks > 0

    def submit(self, job: Job, on_done: OnDone) -> None:
        """Run ``job()``; ``poll`` will call ``on_done(result, error)`` with one of them None."""
        self._jobs.put((job, on_done))

    def poll(self) -> None:
        """Deliver the results of finished jobs."""
        while not self._deliveries.empty():
            self._deliveries.get()()

    def close(self, grace_s: float = JOB_GRACE_S) -> bool:
        """Let the thread end after its queue; return True if it ended within ``grace_s``."""
        self._jobs.put(None)
        self._thread.join(grace_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (entry := self._jobs.get()) is not None:
            job, on_done = entry
            try:
                self._deliveries.put(partial(on_done, job(), None))
            except Exception as error:
                self._deliveries.put(partial(on_done, None, error))
            del entry, job, on_done      # release the job's leg now, not at the next job
            release_memory()
            self._jobs.task_done()


def limit_kept_memory() -> None:
    """Limit the freed memory that is kept; no effect if the C library has no such options."""
    if hasattr(_libc, 'mallopt'):
        for option, value in MALLOC_OPTIONS.items():
            _libc.mallopt(option, value)


def release_memory() -> None:
    """Return free pages to the system; no effect if the C library cannot."""
    if hasattr(_libc, 'malloc_trim'):
        _libc.malloc_trim(0)


class ActiveJob:
    """
    The newest job of the worker, unless it is dropped, and the callers that wait for its result.

    on_failure : called with the cause if a job raises, or the handling of its result.   on_end :
    called after each job that was not dropped.   is_alive : false during shutdown, when an error
    of the handling is no failure. ``stage`` is the progress of the active job.
    """

    def __init__(self, worker: Worker, on_failure: Callable[[str], None],
                 on_end: Callable[[], None], is_alive: Callable[[], bool]) -> None:
        self._worker, self._on_failure = worker, on_failure
        self._on_end, self._is_alive = on_end, is_alive
        self._token: object | None = None       # of the job, None without one
        # the future of each, and the monotonic time, s, until which it waits
        self._callers: list[tuple[Future, float]] = []
        self.stage = Stage()

    def report(self, stage: Stage) -> None:
        """Store the progress of the job; called by the worker's thread."""
        self.stage = stage
        release_memory()      # memory of the pass before

    def submit(self, job: Job, handle: Callable[[Any], object]) -> None:
        """Run a job in the worker and hand its result to ``handle``, unless it is dropped."""
        self._token = token = object()
        self.stage = Stage()

        def on_done(result: Any, error: Exception | None) -> None:
            if token is not self._token:
                return
            self._token = None
            try:
                if error is None:
                    handle(result)
            except Exception as failure:      # so that waiting callers are answered
                if not self._is_alive():
                    raise
                error = failure
            if error is not None:
                self._on_failure(answers.error_line(error))
            self._on_end()

        self._worker.submit(job, on_done)

    def drop(self) -> None:
        """Ignore the result of the active job."""
        self._token = None

    def create_future(self, patience_s: float = math.inf) -> Future:
        """Return a future of (success, text), which ``answer`` or ``answer_expired`` completes."""
        future = Future()
        self._callers.append((future, time.monotonic() + patience_s))
        return future

    def answer(self, success: bool, text: str) -> None:
        """Answer all waiting callers."""
        callers, self._callers = self._callers, []
        for future, _ in callers:
            future.set_result((success, text))

    def answer_expired(self, text: Callable[[], str]) -> None:
        """Answer the callers that have waited for their ``patience_s``; the job continues."""
        now = time.monotonic()
        expired = [future for future, until in self._callers if until <= now]
        self._callers = [(future, until) for future, until in self._callers if until > now]
        for future in expired:
            future.set_result((True, text()))
