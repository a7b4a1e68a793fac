# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Atomic writing of files and folders; the only module that does it.

Every operation that the disk can fail is called through ``disk``, so that tests can fail each.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
import errno
import fcntl
import os
from pathlib import Path
import signal
import threading
from typing import Any, BinaryIO

MOST_SAME_NAME = 1000             # judgement: folders of one name
PART = '.part'                # suffix of files being written; no result or bag has it


class Disk:
    """Caller of operations that the disk can fail."""

    def __call__(self, step: Callable[..., Any], *values: Any) -> Any:
        """Return the result of an operation of the operating system."""
        return step(*values)


disk = Disk()


class WholeFile:
    """A file being written; each write can fail, and no library closes it."""

    closed = False

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.tell = file.tell

    def write(self, data: bytes) -> int:
        written: int = disk(self._file.write, data)
        return written

    def flush(self) -> None:
        pass

    close = flush


@contextmanager
def whole_file(path: Path) -> Iterator[WholeFile]:
    """Open a file to write; after an error in the block, the earlier file is unchanged."""
    part = path.with_name(f'.{path.name}{PART}')
    try:
        with disk(open, part, 'wb') as file:
            yield WholeFile(file)
            disk(file.flush)
            disk(os.fsync, file.fileno())
        disk(os.rename, part, path)
        sync_folder(path.parent)
    except BaseException:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def new_folder(root: Path, name: str) -> Path:
    """Create a new folder; its name has a number if the folder exists."""
    root.mkdir(parents=True, exist_ok=True)
    for count in range(1, MOST_SAME_NAME + 1):
        folder = root / (name if count == 1 else f'{name}-{count}')
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise OSError(errno.EEXIST, f'it holds {MOST_SAME_NAME} folders named {name}; delete some')


def write_text(path: Path, text: str) -> None:
    """Write a text file completely or not at all; it is synced to the disk at return."""
    with whole_file(path) as file:
        file.write(text.encode())


def sync_folder(folder: Path) -> None:
    """Sync the names in a folder to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        disk(os.fsync, handle)
    finally:
        os.close(handle)


@contextmanager
def locked(folder: Path, wait: bool = True) -> Iterator[bool]:
    """
    Lock a folder against other callers; yields True if it is locked.

    No lock file is created, and the lock ends with the process. Yields True also without support
    for locks, as on some network disks.
    """
    try:
        handle = os.open(folder, os.O_RDONLY)
    except PermissionError:
        yield True
        return
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        except OSError:
            pass
        yield True
    finally:
        os.close(handle)


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Delay Ctrl-C until the end of the block."""
    if threading.current_thread() is not threading.main_thread():
        yield       # only the main thread receives it
        return
    received: list[tuple[Any, ...]] = []
    before = signal.signal(signal.SIGINT, lambda *values: received.append(values))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
        if received and callable(before):
            before(*received[0])
