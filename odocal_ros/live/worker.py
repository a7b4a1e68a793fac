"""One thread for the heavy work, so that callbacks stay short."""

from collections.abc import Callable
import queue
import threading

GRACE_S = 2.0      # files take some 20 ms


class Worker:
    """
    Runs jobs one after the other in a thread of its own.

    ``poll`` hands their outcomes to the thread that asks, the executor's, so that nothing but
    the job itself ever runs beside the callbacks. A node told to end waits a moment for it, so
    that result files just asked for are written, but not for a long computation.
    """

    def __init__(self) -> None:
        self._jobs: queue.SimpleQueue = queue.SimpleQueue()
        self._done: queue.SimpleQueue = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name='odocal_worker', daemon=True)
        self._thread.start()

    def submit(self, job: Callable[[], object],
               then: Callable[[object, Exception | None], None]) -> None:
        """Run ``job()``; ``poll`` will call ``then(result, error)`` with one of them None."""
        self._jobs.put((job, then))

    def poll(self) -> None:
        """Call what was to follow each job that has ended."""
        while not self._done.empty():
            then, result, error = self._done.get()
            then(result, error)

    def close(self) -> None:
        """Let the thread end after the jobs it was given, waiting a moment for them."""
        self._jobs.put(None)
        self._thread.join(GRACE_S)

    def _run(self) -> None:
        while (entry := self._jobs.get()) is not None:
            job, then = entry
            try:
                self._done.put((then, job(), None))
            except Exception as error:  # every failure of a job is an answer to the operator
                self._done.put((then, None, error))
