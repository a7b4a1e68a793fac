# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Result folders of the calibration node: one for each result, written in its worker thread.

The link ``latest`` points to the best known result of the vehicle. It is moved back if a leg is
undone, and outdated results of automatic legs are removed.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
import os
from pathlib import Path
import re
import shutil
import time
from typing import Any
import uuid

from rclpy.task import Future

from odocal_ros.calib.result import Calibration
from odocal_ros.errors import OdocalError
from odocal_ros.live import answers
from odocal_ros.live.console import PlainLog
from odocal_ros.live.worker import Worker
from odocal_ros.output.stored import objection_to_folder, stored_in
from odocal_ros.output.value_text import iso
from odocal_ros.safe_io.atomic_files import locked, new_folder
from odocal_ros.settings.config import Config

LATEST = 'latest'
REMAINS_AGE_S = 60.0      # judgement: an older empty folder or temporary link is not in use
RESULT_NAME = re.compile(r'(\d{4}-\d\d-\d\dT\d\d-\d\d-\d\dZ)(?:-(\d+))?')     # time, count


@dataclass(frozen=True)
class WrittenResult:
    """A result folder of this session to which ``latest`` was moved."""

    folder: Path
    last_leg_ns: int        # stamp of the start mark of its last leg
    previous_target: str    # name of the folder to which ``latest`` pointed before, or empty


class ResultFolders:
    """
    Keeps the link ``latest`` at the best known result of this session and earlier ones.

    The link does not move from a good calibration to a worse one unless forced. It moves back
    when a leg of its target is dropped. Only results of ``leg.automatic`` are ever removed.
    """

    def __init__(self) -> None:
        self._written: list[WrittenResult] = []

    def point_latest(self, folder: Path, last_leg_ns: int, force: bool) -> str:
        """
        Point ``latest`` at a new folder; return the reason if it stays unchanged, else empty.

        last_leg_ns : stamp of the start mark of the last leg in it.   force : also at a worse one.
        """
        link = folder.parent / LATEST
        with locked(folder.parent):         # another node may write there, too
            _remove_remains(folder.parent)
            previous_target = _link_target(link)
            reason = '' if force else objection_to_folder(stored_in(link), folder)
            if reason:
                return reason
            _set_link(link, folder.name)
        self._written.append(WrittenResult(folder, last_leg_ns, previous_target))
        return ''

    def prune(self, newest: Path, kept_count: int) -> None:
        """
        Remove the oldest results of ``leg.automatic`` in the folder of ``newest``.

        kept_count : number of newest results kept; 0 keeps all. Also kept: the target of
        ``latest``, its earlier targets, and the newest usable result.
        """
        root = newest.parent
        with locked(root):
            matches = filter(None, (RESULT_NAME.fullmatch(path.name) for path in root.iterdir()))
            # by the time, and the count within that second
            by_age = sorted(matches, key=lambda match: (match[1], int(match[2] or 1)))
            names = [match[0] for match in by_age]
            outdated = names[:-kept_count] if kept_count else []
            if not outdated:
                return
            newest_usable = next((name for name in reversed(names) if (
                stored := stored_in(root / name)) and stored.usable), '')
            linked = _link_target(root / LATEST)
            kept_names = {newest.name, newest_usable, linked, *(
                result.previous_target for result in self._written
                if result.folder.name == linked)}
            for name in (name for name in outdated if name not in kept_names):
                stored = stored_in(root / name)
                if stored and stored.config.get('leg.automatic'):
                    shutil.rmtree(root / name, ignore_errors=True)

    def withdraw(self, since_ns: int) -> Path | None:
        """
        Move ``latest`` away from folders with legs that started at ``since_ns`` or later.

        These legs were dropped. Returns the newest folder of this session that is not withdrawn,
        None without one.
        """
        dropped = [result for result in self._written if result.last_leg_ns >= since_ns]
        self._written = [result for result in self._written if result.last_leg_ns < since_ns]
        for result in reversed(dropped):
            root = result.folder.parent
            link = root / LATEST
            if _link_target(link) != result.folder.name:
                continue       # another process has moved it
            if result.previous_target and (root / result.previous_target).is_dir():
                _set_link(link, result.previous_target)
            else:
                link.unlink(missing_ok=True)
        return self._written[-1].folder if self._written else None


def _remove_remains(root: Path) -> None:
    """Remove the remains of killed nodes: empty result folders and temporary links."""
    until = time.time() - REMAINS_AGE_S
    for entry in root.iterdir():
        with suppress(OSError):
            if entry.lstat().st_mtime > until:
                continue
            if RESULT_NAME.fullmatch(entry.name):
                entry.rmdir()      # fails unless it is empty
            elif entry.name.startswith(f'.{LATEST}-') and entry.is_symlink():
                entry.unlink()


def _link_target(link: Path) -> str:
    return link.readlink().name if link.is_symlink() else ''


def _set_link(link: Path, name: str) -> None:
    """Move the link in one step: readers find the old or the new folder."""
    temporary = link.with_name(f'.{LATEST}-{uuid.uuid4().hex}')
    temporary.symlink_to(name)
    temporary.replace(link)


def output_root(config: Config, node: str) -> Path:
    """Return the folder of results: output.directory, else a folder in the ROS home."""
    default = Path(os.environ.get('ROS_HOME') or '~/.ros') / 'odocal' / node.lstrip('/')
    return Path(config.output.directory or default).expanduser()


class ResultSaver:
    """
    Writes results into new folders by the worker, and answers with the folder or the error.

    show : called when ``saved_folder`` (the newest one that is not withdrawn) or ``error`` (of the
    newest save) has changed.   node : full name, for the default folder.
    """

    def __init__(self, worker: Worker, log: PlainLog, show: Callable[[], None], node: str) -> None:
        self.saved_folder = self.error = ''
        self._node = node
        self._worker, self._log, self._show = worker, log, show
        self._folders = ResultFolders()
        # result of a requested save that left ``latest`` unchanged
        self._not_latest: Calibration | None = None
        self._saves_running = 0
        self._report_worker = Worker()        # separate, so that no leg waits until it is drawn

    def save(self, calibration: Calibration, config: Config, topics: dict[str, str],
             imu_frame: str, now_ns: int, by_operator: bool) -> Future:
        """
        Write the result files in the worker; the future has (success, text).

        topics : slot -> name.   now_ns : time of the node's clock, for the folder's name.
        by_operator : requested by ~/save; a second request moves ``latest`` to a worse result.
        """
        future = Future()
        self._saves_running += 1

        def on_done(outcome: Any, error: Exception | None) -> None:
            self._saves_running -= 1
            if error is None:
                folder, unchanged_reason = outcome
                self.saved_folder, self.error = str(folder), ''
                if unchanged_reason and by_operator:
                    self._not_latest = calibration
                text = f'saved to {folder}'
                if unchanged_reason:
                    text += (f'; latest is unchanged: {unchanged_reason}; call ~/save'
                             f'{" again" * by_operator} to point it to this result anyway')
            else:
                self.error = answers.error_line(error)
                text = f'not saved: {self.error}'
            log = self._log.info if error is None else self._log.warning
            log(text)
            future.set_result((error is None, text))
            self._show()

        self._worker.submit(partial(
            self._write, calibration, config, [{'bag': '', 'sha256': None, 'node': self._node,
                                               'topics': topics}],
            imu_frame, now_ns, by_operator and calibration is self._not_latest), on_done)
        return future

    @property
    def is_busy(self) -> bool:
        return self._saves_running > 0 or self._report_worker.is_busy

    def _write(self, calibration: Calibration, config: Config, inputs: list[dict[str, Any]],
               imu_frame: str, now_ns: int, force: bool) -> tuple[Path, str]:
        """Write files into a folder named by the time; return it, and why ``latest`` stays."""
        from odocal_ros.output.files import Results
        from odocal_ros.output.program_files import with_imu_frame
        calibration, config = with_imu_frame(calibration, config, imu_frame)
        root = output_root(config, self._node)
        try:
            folder = new_folder(root, iso(now_ns).replace(':', '-'))
            try:
                results = Results(calibration, config, folder, inputs, iso(now_ns))
                results.write()
            except OdocalError:
                with suppress(OSError):
                    folder.rmdir()      # empty: its name was only reserved
                raise
            last_leg_ns = max((leg.start_ns for leg in calibration.legs), default=0)
            unchanged_reason = self._folders.point_latest(folder, last_leg_ns, force)
            if config.leg.automatic:
                self._folders.prune(folder, config.output.automatic_kept)
        except OSError as error:
            raise OdocalError(f'results cannot be written to {root}: {error.strerror}; set '
                              'output.directory to a writable folder') from None
        if results.has_report:      # drawing it takes long
            self._report_worker.submit(results.draw, self._report_drawn)
        return folder, unchanged_reason

    def _report_drawn(self, drawing_error: str, error: Exception | None) -> None:
        if error is not None or drawing_error:
            self._log.warning('the report could not be drawn: '
                              f'{answers.error_line(error) if error else drawing_error}')

    def poll(self) -> None:
        """Log reports that could not be drawn."""
        self._report_worker.poll()

    def close(self, grace_s: float) -> bool:
        """Wait up to ``grace_s`` for the report; return True if it is drawn."""
        return self._report_worker.close(grace_s)

    def withdraw(self, since_ns: int) -> None:
        """Move ``latest`` and ``saved_folder`` back to the newest result before ``since_ns``."""
        self.error = ''

        def on_done(folder: Path | None, error: Exception | None) -> None:
            self.saved_folder = '' if folder is None else str(folder)
            if error is not None:
                self._log.warning(
                    'could not update `latest` after a leg was dropped; it still points to a '
                    f'result that includes this leg: {answers.error_line(error)}; the next '
                    '~/save corrects it')
            self._show()

        self._worker.submit(partial(self._folders.withdraw, since_ns), on_done)
