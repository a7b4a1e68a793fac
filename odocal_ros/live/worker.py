# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The computations, the thread that runs one at a time, and callers that wait for its result."""

from collections.abc import Callable
import ctypes
from dataclasses import dataclass
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
from odocal_ros.live.session import LEGS_HELD, MARKED_LEGS_HELD
from odocal_ros.output.plot_style import even_rows
from odocal_ros.output.stored import known_imu
from odocal_ros.pipeline.automatic import add_to_carried, rejecting_reason
from odocal_ros.pipeline.calibrate import calibrate_parts, combine
from odocal_ros.pipeline.prepared_leg import Stage
from odocal_ros.reasons import Reason
from odocal_ros.settings.config import Config

MOST_POSES = 2000    # judgement: of a published path
Paths: TypeAlias = tuple[PathMessage, PathMessage]      # dead reckoning, reference
# judgement: s that a stopping node waits, for a computation and for files: launch sends the next
# signal after 5 s
JOB_GRACE_S, FILES_GRACE_S = 1.0, 4.0
Job: TypeAlias = Callable[[], Any]
Then: TypeAlias = Callable[[Any, Exception | None], None]      # one of them is None
# By default glibc has an arena for every thread and, once one was freed, takes arrays of up to 32
# MiB from it: a node kept 100 MiB unused after a leg of an hour at 1 kHz. judgement, of
# mallopt(3): M_ARENA_MAX, number of arenas of all threads, and M_MMAP_THRESHOLD, bytes from which
# a block is mapped separately
MALLOC_OPTIONS = {-8: 2, -3: 2**22}
_libc = ctypes.CDLL(None)
# judgement: s that ~/stop_leg waits for the result. It must answer within 5 s, 1 s of it is for a
# busy machine; the last samples take up to 1 s, the fit of a leg of ten minutes 1 to 2 s
PATIENCE_S = 4.0


@dataclass(frozen=True, eq=False)
class Computed:
    """
    Result of a leg.

    results : one for each part; gaps of the IMU separate parts.
    carried : information of the legs that are no longer kept.   folded : number of kept legs, the
    oldest, that were added to it now.
    """

    results: tuple[LegResult, ...]
    paths: Paths
    calibration: Calibration
    carried: CarriedInformation | None
    folded: int


@dataclass(frozen=True, eq=False)
class UnusedLeg:
    """Result of an unused automatic leg, and the cause."""

    results: tuple[LegResult, ...]
    reason: Reason


def compute(recorder: LegRecorder, start_ns: int, stop_ns: int,
            kept: list[tuple[LegResult, ...]], config: Config,
            carried: CarriedInformation | None = None, is_automatic: bool = False,
            progress: Callable[[Stage], None] | None = None) -> Computed | UnusedLeg:
    """Return a leg's result, its combination with the kept legs, and the paths to publish."""
    leg = recorder.close(start_ns, stop_ns, config.leg.preroll)
    results = tuple(calibrate_parts(leg, config, progress=progress))
    if is_automatic and (reason := rejecting_reason(results[0])):
        return UnusedLeg(results, reason)
    paths = leg_paths(max(results, key=lambda result: result.distance), config)
    folded = max(0, len(kept) + 1 - (LEGS_HELD if is_automatic else MARKED_LEGS_HELD))
    carried_before, carried = carried, add_to_carried([result for leg in kept[:folded]
                                                       for result in leg],
                                                      config, carried)
    # results of the two-point method cannot be added to ``carried``: all legs are kept
    if carried is carried_before and not is_automatic:
        folded = 0
    current = [result for leg in kept[folded:] for result in leg]
    calibration = combine([*current, *results], config, carried, known_imu(config))
    return Computed(results, paths, calibration, carried, folded)


def recombine(kept: list[LegResult], config: Config, carried: CarriedInformation | None = None,
              ) -> tuple[Calibration, Paths]:
    """Return the combination of the kept legs, at least one, and the paths of the last one."""
    return combine(kept, config, carried, known_imu(config)), leg_paths(kept[-1], config)


def leg_paths(result: LegResult | None, config: Config) -> Paths:
    """Return the paths of a leg in the frame frames.local, empty without a leg."""
    header = Header(frame_id=config.frames.local)
    if result is None:
        return PathMessage(header=header), PathMessage(header=header)
    header.stamp.sec, header.stamp.nanosec = divmod(result.stop_ns, 10**9)
    return _path(result.track_n, header), _path(result.reference_n, header)


def _path(track_n: Floats | None, header: Header) -> PathMessage:
    """Return at most MOST_POSES positions of a track, (n, 3) m, as a message."""
    if track_n is None or not len(track_n):
        return PathMessage(header=header)
    upright = Quaternion(w=1.0)
    return PathMessage(header=header, poses=[
        PoseStamped(header=header, pose=Pose(
            position=Point(x=float(x), y=float(y), z=float(z)), orientation=upright))
        for x, y, z in track_n[even_rows(len(track_n), MOST_POSES)]])


class Worker:
    """
    Runs jobs one after the other in its own thread.

    ``poll`` delivers their results in the calling thread, the executor's: only the job itself
    runs in parallel to the callbacks. A stopping node waits for requested result files and their
    report, but not for a long computation.
    """

    def __init__(self) -> None:
        self._jobs: queue.Queue[tuple[Job, Then] | None] = queue.Queue()
        self._done: queue.SimpleQueue[tuple[Then, Any, Exception | None]] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name='odocal_worker', daemon=True)
        self._thread.start()

    @property
    def is_busy(self) -> bool:
        return self._jobs.unfinished_tasks > 0

    def submit(self, job: Job, then: Then) -> None:
        """Run ``job()``; ``poll`` will call ``then(result, error)`` with one of them None."""
        self._jobs.put((job, then))

    def poll(self) -> None:
        """Deliver the results of finished jobs."""
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
            job, then = entry
            try:
                self._done.put((then, job(), None))
            except Exception as error:
                self._done.put((then, None, error))
            del entry, job, then      # release the job's leg now, not at the next job
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


class Computing:
    """
    At most one active job; the result of a dropped one is ignored.

    ``failed(trouble)`` is called if a job, or ``take`` of its result, raises; ``done()`` after
    each job that was not dropped. ``alive()`` is false during shutdown: an error of ``take`` is
    then no failure.
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
        release_memory()      # memory of the pass before

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
            except Exception as failure:      # so that waiting callers are answered
                if not self._alive():
                    raise
                error = failure
            if error is not None:
                self._failed(answers.error_line(error))
            self._done()

        self._worker.submit(job, then)

    def drop(self) -> None:
        """Ignore the result of the active job."""
        self._job = None

    def create_future(self, patience_s: float = math.inf) -> Future:
        """Return a future that the next ``answer`` or ``answer_late`` completes."""
        future = Future()
        self._waiting.append((future, time.monotonic() + patience_s))
        return future

    def answer(self, success: bool, text: str) -> None:
        """Answer all waiting callers."""
        waiting, self._waiting = self._waiting, []
        for future, _ in waiting:
            future.set_result((success, text))

    def answer_late(self, text: Callable[[], str]) -> None:
        """Answer the callers that have waited for their ``patience_s``; the job continues."""
        now = time.monotonic()
        expired = [future for future, until in self._waiting if until <= now]
        self._waiting = [(future, until) for future, until in self._waiting if until > now]
        for future in expired:
            future.set_result((True, text()))
