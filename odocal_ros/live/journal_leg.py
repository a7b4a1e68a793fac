# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The journal of one leg: a bag that grows in segments; the oldest journals are deleted."""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
import fcntl
from pathlib import Path
import re
import shutil
import time
from typing import TextIO

from odocal_ros.bagio.bag_file import Channel
from odocal_ros.bagio.mcap_write import PackedChunk
from odocal_ros.bagio.segments import JOURNAL_FILE, SegmentedBag
from odocal_ros.safe_io.atomic_files import new_folder, PART, write_text

JOURNAL_NAME = re.compile(r'\d{4}-\d\d-\d\dT\d\d-\d\d-\d\dZ_leg_\d+(-\d+)?')     # of a journal
NEW_FOLDER_S = 10.0       # judgement: a node may still be about to write into a younger folder
MAX_UNWRITTEN_BYTES = 64 * 2**20     # judgement: kept in memory while writing fails
METADATA_BYTES = 2**20            # judgement: for metadata and file heads


def journal_folders(root: Path) -> list[Path]:
    """Return the folders of journals, the oldest first."""
    dated = []
    with suppress(FileNotFoundError):
        for folder in root.iterdir():
            with suppress(OSError):
                if not folder.is_symlink():
                    dated.append(((folder / JOURNAL_FILE).stat().st_mtime_ns, folder))
    return [folder for _, folder in sorted(dated)]


def clear_empty(root: Path) -> None:
    """Remove journals without data: their nodes were killed early, or the disk was full."""
    for folder in list(root.iterdir()):
        with suppress(OSError):
            is_journal = JOURNAL_NAME.fullmatch(folder.name) and not folder.is_symlink()
            is_old = is_journal and folder.stat().st_mtime < time.time() - NEW_FOLDER_S
            # these files never contain a message
            if is_old and all(path.name == JOURNAL_FILE or path.name.endswith(PART)
                              for path in folder.iterdir()) and not _in_use(folder):
                shutil.rmtree(folder)


def folder_size(folder: Path) -> int:
    """Return the bytes of the files in a folder, which another process may delete now."""
    total = 0
    with suppress(FileNotFoundError):
        for path in folder.iterdir():
            with suppress(FileNotFoundError):
                total += path.stat().st_size
    return total


def make_room(root: Path, limit: int, needed: int = 0) -> int:
    """Delete the oldest unused journals for ``needed`` more bytes; return the size of the rest."""
    sizes = {folder: folder_size(folder) for folder in journal_folders(root)}
    for folder in list(sizes):
        if sum(sizes.values()) + needed <= limit:
            break
        if not _in_use(folder):
            shutil.rmtree(folder, ignore_errors=True)
            sizes[folder] = folder_size(folder)
    return sum(sizes.values())


def lock_journal(folder: Path) -> TextIO:
    """Lock a journal as in use, until the returned file is closed or the process ends."""
    file = (folder / JOURNAL_FILE).open(encoding='utf-8')
    with suppress(OSError):      # a file system without locks: its use is unknown
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return file


def _in_use(folder: Path) -> bool:
    try:
        with (folder / JOURNAL_FILE).open(encoding='utf-8') as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


@dataclass(frozen=True)
class JournalPlan:
    """Folder, settings and size limit of a leg's journal."""

    leg_id: int
    root: Path
    name: str
    settings: str      # the text of journal.yaml
    limit: int         # bytes, all journals of the folder together


class LegJournal:
    """
    Writes the journal of one leg; ``error`` is the cause while writing fails, else empty.

    Chunks that cannot be written stay in memory for the next attempt. Above MAX_UNWRITTEN_BYTES
    the journal ends with the data written so far, and the error stays.
    """

    def __init__(self, plan: JournalPlan, channels: dict[int, Channel],
                 chunks: list[PackedChunk]) -> None:
        self.plan = plan
        self.error = ''
        self._channels = channels
        self._unwritten = chunks      # the pre-roll is written with the start mark, not before
        self._bag: SegmentedBag | None = None
        self._lock: TextIO | None = None
        self._other_bytes = 0              # bytes of the other journals
        self._is_closed = False       # True: no more data are written
        self.late_marks: list[PackedChunk] = []      # after the end, not written yet

    @property
    def folder(self) -> str:
        return str(self._bag.folder) if self._bag else ''

    def append(self, chunks: list[PackedChunk]) -> None:
        """Write chunks, after those that are not written yet."""
        if self._is_closed:
            return
        self._unwritten += chunks
        if self._unwritten:
            self._attempt(self._write)
        if self.error and not self._is_closed and sum(
                chunk.size for chunk in self._unwritten) > MAX_UNWRITTEN_BYTES:
            self._give_up(f'{self.error}; no further attempt in this leg')

    def finish(self) -> None:
        """Join the files to one complete bag."""
        if not self._is_closed:
            self.append([])
            if self._bag is not None and not self._unwritten:
                self._attempt(self._finish)
            elif self._bag is not None and not self._bag.segments:     # nothing was written
                shutil.rmtree(self._bag.folder, ignore_errors=True)
                self._bag = None
        self._is_closed, self._unwritten = True, []
        if self._lock is not None:
            self._lock.close()

    def add_mark(self, chunks: list[PackedChunk]) -> None:
        """Add a mark to the finished journal."""
        self.late_marks += chunks
        self.retry()

    def retry(self) -> None:
        """Write the marks that are not written yet."""
        bag = self._bag
        if bag is None or not bag.segments or not bag.folder.exists():
            self.late_marks = []         # there is nothing to replay
        elif self.late_marks:
            self._attempt(self._add_late)

    def _add_late(self) -> None:
        assert self._bag is not None
        self._bag.add(self.late_marks)
        self.late_marks, self.error = [], ''

    def _write(self) -> None:
        if self._bag is None:
            self._bag = self._open()
        # joining files, this one included, temporarily needs their size twice
        size = 2 * sum(chunk.size for chunk in self._unwritten) + METADATA_BYTES
        size += self._bag.unjoined_size
        if self._other_bytes + self._bag.size + size > self.plan.limit:
            used_bytes = make_room(self.plan.root, self.plan.limit, size)
            self._other_bytes = used_bytes - self._bag.size
            if used_bytes + size > self.plan.limit:
                self._give_up(f'{self.plan.root}: the journals reach their limit of '
                              f'{self.plan.limit} bytes; raise journal.max_bytes')
                return
        self._bag.append(self._unwritten)
        self._unwritten = []
        self._bag.join_some()

    def _open(self) -> SegmentedBag:
        root = self.plan.root
        root.mkdir(parents=True, exist_ok=True)
        clear_empty(root)
        self._other_bytes = make_room(root, self.plan.limit)
        folder = new_folder(root, self.plan.name)
        try:
            write_text(folder / JOURNAL_FILE, self.plan.settings)
            self._lock = lock_journal(folder)
        except OSError:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        bag = SegmentedBag(folder)
        bag.channels = self._channels
        return bag

    def _finish(self) -> None:
        assert self._bag is not None
        used_bytes = make_room(self.plan.root, self.plan.limit, self._bag.size + METADATA_BYTES)
        self._bag.finish(free_bytes=self.plan.limit - used_bytes - METADATA_BYTES)

    def _give_up(self, error: str) -> None:
        self.error, self._is_closed, self._unwritten = error, True, []

    def _attempt(self, write: Callable[[], object]) -> None:
        try:
            write()
        except OSError as error:
            where = error.filename or self.plan.root
            self.error = (f'{where}: {error.strerror or error}; free disk space or set '
                          'output.directory to a writable folder')
        else:
            if not self._is_closed:
                self.error = ''
