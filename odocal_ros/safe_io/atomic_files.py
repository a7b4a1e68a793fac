# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Atomic writing of files and result folders: after a crash, the old or the new content is complete.

A result folder is replaced as a whole, so that it never mixes two calibrations. Files are written
into a temporary folder, which replaces the result folder by one rename. If that is impossible (a
mount, a folder with other files), files are replaced one by one. The main file, which marks a
complete result, is removed first and written last.
"""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, ExitStack, suppress
import ctypes
import errno
import fcntl
import os
from pathlib import Path
import re
import shutil
import signal
import threading
from typing import Any, BinaryIO
import uuid

from odocal_ros.errors import BadUsage

MAX_SAME_NAME = 1000         # judgement: folders of one name
PART = '.part'                # suffix of temporary files and folders; no result or bag has it
# errors after which files are written into the folder one by one
RENAME_REFUSED = (errno.EACCES, errno.EPERM, errno.EROFS, errno.EBUSY, errno.EXDEV)
ASIDE = '.old'                # suffix of the earlier folder while two folders are swapped
# names of temporary folders
TEMPORARY = re.compile(rf'\.(?P<place>.+)\.[0-9a-f]{{32}}\{PART}(?P<aside>\{ASIDE})?')


def disk(operation: Callable[..., Any], *arguments: Any) -> Any:
    """Call an operation that can fail on the disk; tests replace this function by failing ones."""
    return operation(*arguments)


class WholeFile:
    """Output file of ``whole_file``, which alone flushes and closes it, not a library."""

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
    """Yield an output file that replaces ``path`` if the block ends without an error."""
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
    """Create a folder ``name``, or ``name-2`` and so on if it exists, and return its path."""
    root.mkdir(parents=True, exist_ok=True)
    for count in range(1, MAX_SAME_NAME + 1):
        folder = root / (name if count == 1 else f'{name}-{count}')
        try:
            folder.mkdir()
        except FileExistsError:
            continue
        return folder
    raise OSError(errno.EEXIST, f'it holds {MAX_SAME_NAME} folders named {name}; delete some')


def write_text(path: Path, text: str) -> None:
    """Write a text file completely or not at all, and sync it to the disk."""
    with whole_file(path) as file:
        file.write(text.encode())


def sync_folder(folder: Path) -> None:
    """Sync the directory entries of a folder to the disk."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        disk(os.fsync, handle)
    finally:
        os.close(handle)


@contextmanager
def locked(folder: Path, wait: bool = True) -> Iterator[bool]:
    """Lock a folder until the end of the block or process; yield False if another one has it."""
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
            pass      # no support for locks, as on some network disks
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
    handler = signal.signal(signal.SIGINT, lambda *arguments: received.append(arguments))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
        if received and callable(handler):
            handler(*received[0])


class ResultFolder:
    """
    A folder for the files of a result.

    place : path of the folder.   main : name of the file that marks a complete result.
    result_names : names of all possible files of a result.
    """

    def __init__(self, place: Path, main: str, result_names: frozenset[str]) -> None:
        self.place = Path(os.path.realpath(place))
        self._main, self._result_names = main, result_names
        self._main_file: tuple[Any, ...] = ()       # inode and time of the written main file

    @property
    def is_unchanged(self) -> bool:
        """Return True if the folder contains the result that this object has written."""
        with suppress(OSError):
            return self._main_file == _identity(self.place / self._main)
        return False

    def put(self, texts: Mapping[str, str], force: bool) -> None:
        """
        Write a result, or leave everything unchanged.

        Raises BadUsage: a result exists and no ``force``. Raises OSError: it cannot be written.
        """
        self.place.parent.mkdir(parents=True, exist_ok=True)
        try:
            with self._temporary(self.place.parent, texts) as new:
                if self._is_replaceable():
                    self._replace_folder(new, force)
                    return
        except OSError as error:
            if error.errno not in RENAME_REFUSED or not self.place.is_dir():
                raise
        with self._temporary(self.place, texts) as new:
            self._replace_files(new, texts, force)

    def add(self, name: str, text: str) -> bool:
        """Add a file to the written result; return False if another result has replaced it."""
        with locked(self.place.parent):
            if self.is_unchanged:
                write_text(self.place / name, text)
            return self.is_unchanged

    @contextmanager
    def _temporary(self, parent: Path, texts: Mapping[str, str]) -> Iterator[Path]:
        """Yield a temporary folder with the files; after the block, it is removed if it exists."""
        new = parent / f'.{self.place.name}.{uuid.uuid4().hex}{PART}'
        with locked(self.place.parent):
            self._remove_abandoned(parent)
            disk(os.mkdir, new)
            locks = ExitStack()
            locks.enter_context(locked(new))     # an unlocked one is removed as abandoned
        with locks:
            try:
                for name, text in texts.items():
                    write_text(new / name, text)
                sync_folder(new)
                self._main_file = _identity(new / self._main)
                yield new
            finally:
                shutil.rmtree(new, ignore_errors=True)

    def _remove_abandoned(self, parent: Path) -> None:
        """Remove or restore temporary folders of killed processes; active ones lock theirs."""
        for match in filter(None, map(TEMPORARY.fullmatch, os.listdir(parent))):
            folder, place = parent / match[0], parent / match['place']
            with suppress(OSError), locked(folder, wait=False) as is_locked:
                if match['aside'] and not place.exists():
                    folder.rename(place)
                elif is_locked:
                    shutil.rmtree(folder, ignore_errors=True)

    def _refuse_existing(self, force: bool) -> None:
        if (self.place / self._main).exists() and not force:
            raise BadUsage(f'{self.place / self._main} exists; give another folder with --output, '
                           'or --force to replace it')

    def _is_replaceable(self) -> bool:
        """Return True if the folder has only files of a result and is not the working folder."""
        if not self.place.is_dir():
            return True
        return self.place != Path.cwd() and all(
            name in self._result_names
            or any(name.startswith(f'.{result}.') for result in self._result_names)
            for name in os.listdir(self.place))

    def _replace_folder(self, new: Path, force: bool) -> None:
        with locked(self.place.parent), uninterrupted():
            self._refuse_existing(force)
            try:
                disk(os.rename, new, self.place)      # nothing, or an empty folder, is there
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
                disk(_swap, new, self.place)
            sync_folder(self.place.parent)

    def _replace_files(self, new: Path, texts: Mapping[str, str], force: bool) -> None:
        with locked(self.place.parent), uninterrupted():
            self._refuse_existing(force)
            for name in sorted(self._result_names, key=lambda name: name != self._main):
                (self.place / name).unlink(missing_ok=True)      # the main file first
            for name in sorted(texts, key=lambda name: name == self._main):      # and here last
                disk(os.rename, new / name, self.place / name)
            sync_folder(self.place)


def _identity(path: Path) -> tuple[int, int]:
    """Return inode and modification time, ns, of a file."""
    status = path.stat()
    return status.st_ino, status.st_mtime_ns


def _swap(new: Path, place: Path) -> None:
    """Swap two folders by one system call if the file system supports it, else by renames."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), 'renameat2', None)
    names = [os.fsencode(path) for path in (new, place)]
    if rename is not None:
        at_fdcwd, rename_exchange = -100, 2      # of linux/fcntl.h and linux/fs.h
        if rename(at_fdcwd, names[0], at_fdcwd, names[1], rename_exchange) == 0:
            return
        code = ctypes.get_errno()
        if code not in (errno.EINVAL, errno.ENOSYS):      # not supported by the file system
            raise OSError(code, os.strerror(code), str(place))
    aside = new.with_name(f'{new.name}{ASIDE}')
    os.rename(place, aside)
    try:
        os.rename(new, place)
    except OSError:
        os.rename(aside, place)
        raise
    os.rename(aside, new)
