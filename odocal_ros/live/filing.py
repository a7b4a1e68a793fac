# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Result files: written by the worker, answered by a future."""

from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

from rclpy.task import Future

from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.live import answers, result_files as outputs
from odocal_ros.live.plain_log import PlainLog
from odocal_ros.live.result_folders import LATEST, ResultFolders
from odocal_ros.live.worker import Worker
from odocal_ros.output.stored import Stored
from odocal_ros.output.worse import stored_in
from odocal_ros.settings.config import Config


class Filing:
    """
    Saves results and takes them back.

    saved : the newest folder that still stands.   trouble : why the newest result has none.
    """

    def __init__(self, worker: Worker, log: PlainLog, show: Callable[[], None], node: str) -> None:
        self.saved = self.trouble = ''
        self._node = node
        self._worker, self._log, self._show = worker, log, show
        self._folders = ResultFolders()
        self._warned: Calibration | None = None    # the operator knows that latest stays
        self._under_way = 0
        self._artist = Worker()        # a leg that ends meanwhile need not wait for a report

    def save(self, calibration: Calibration, config: Config, topics: dict[str, str],
             imu_frame: str, now_ns: int, asked: bool) -> Future:
        """
        Write the result files in the worker; the future has (success, text).

        asked : by the operator. ``latest`` does not go to a worse result, unless he asks again.
        """
        future = Future()
        self._under_way += 1

        def then(outcome: Any, error: Exception | None) -> None:
            self._under_way -= 1
            if error is None:
                folder, stays = outcome
                self.saved, self.trouble = str(folder), ''
                if stays and asked:
                    self._warned = calibration
                future.set_result((True, f'saved to {folder}' + (
                    f'; latest is unchanged: {stays}; call ~/save{" again" * asked} to point it '
                    'to this result anyway' if stays else '')))
            else:
                self.trouble = answers.one_line(error)
                future.set_result((False, f'not saved: {self.trouble}'))
            log = self._log.info if error is None else self._log.warning
            log(future.result()[1])
            self._show()

        self._worker.submit(partial(
            self._write, calibration, config, [{'bag': '', 'sha256': None, 'node': self._node,
                                               'topics': topics}],
            imu_frame, now_ns, self._folders, asked and calibration is self._warned), then)
        return future

    @property
    def busy(self) -> bool:
        """Return True while files are being written."""
        return self._under_way > 0 or self._artist.busy

    def _write(self, *values: Any) -> tuple[Path, str]:
        """Write the numbers; for the worker."""
        folder, stays, draw = outputs.save(*values)
        if draw is not None:
            self._artist.submit(draw, self._drawn)
        return folder, stays

    def _drawn(self, why: str, error: Exception | None) -> None:
        if error is not None or why:
            self._log.warning('the report could not be drawn: '
                              f'{answers.one_line(error) if error else why}')

    def poll(self) -> None:
        """Take over what has been drawn."""
        self._artist.poll()

    def close(self, grace_s: float) -> bool:
        """Let the report be drawn, waiting a moment for it; return whether it is."""
        return self._artist.close(grace_s)

    def withdraw(self, left: Iterable[LegResult]) -> None:
        """Let ``latest`` and ``saved`` go back to what holds only the legs left."""
        self.trouble = ''

        def then(folder: Path | None, error: Exception | None) -> None:
            self.saved = '' if folder is None else str(folder)
            if error is not None:
                self._log.warning('latest still contains a dropped leg: '
                                  f'{answers.one_line(error)}')
            self._show()

        self._worker.submit(partial(self._folders.withdraw, outputs.marks(left)), then)


def latest_of(config: Config, node: str) -> Stored | None:
    """Return the result that earlier runs of a node hold for the best, None without."""
    return stored_in(outputs.output_root(config, node) / LATEST)
