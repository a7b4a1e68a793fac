"""One thread for the heavy work, so that callbacks stay short."""

from collections.abc import Callable
import queue
import threading

GRACE_S, FILES_S = 1.0, 4.0      # launch asks a second time, and harder, after 5 s


class Worker:
    """
    Runs jobs one after the other in a thread of its own.

    ``poll`` hands their outcomes to the thread that asks, the executor's, so that nothing but
    the job itself ever runs beside the callbacks. A node told to end waits for result files just
    asked for, report included, but not for a long computation.
    """

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue = queue.SimpleQueue()
        self._done: queue.SimpleQueue = queue.SimpleQueue()
        self._at_work = False
        self._thread = threading.Thread(target=self._run, name='odocal_worker', daemon=True)
        self._thread.start()

    @property
    def busy(self) -> bool:
        """Return whether a job is under way or waits."""
        return self._at_work or not self._jobs.empty()

    def submit(self, job: Callable[[], object],
               then: Callable[[object, Exception | None], None]) -> None:
        """Run ``job()``; ``poll`` will call ``then(result, error)`` with one of them None."""
        self._jobs.put((job, then))

    def poll(self) -> None:
        """Call what was to follow each job that has ended."""
        while not self._done.empty():
            then, result, error = self._done.get()
            then(result, error)

    def close(self, grace_s: float = GRACE_S) -> bool:
        """Let the thread end after the jobs it was given; return whether it has, in that time."""
        self._jobs.put(None)
        self._thread.join(grace_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (entry := self._jobs.get()) is not None:
            job, then = entry
            self._at_work = True
            try:
                self._done.put((then, job(), None))
            except Exception as error:  # every failure of a job is an answer to the operator
                self._done.put((then, None, error))
            self._at_work = False
