# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A result folder: replaced as a whole, so that it never mixes two calibrations.

Files are written into a sibling folder, which replaces the folder by one rename. If that is
impossible (a mount, a folder with other files), files are replaced one by one. The main file,
which marks a complete result, is removed first and written last.
"""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager, ExitStack, suppress
import ctypes
import errno
import os
from pathlib import Path
import re
import shutil
from typing import Any
import uuid

from odocal_ros.errors import BadUsage
from odocal_ros.safe_io.atomic_files import (
    disk,
    locked,
    PART,
    sync_folder,
    uninterrupted,
    write_text,
)

NOT_BY_RENAME = (errno.EACCES, errno.EPERM, errno.EROFS, errno.EBUSY, errno.EXDEV)
ASIDE = '.old'
LEFT = re.compile(rf'\.(?P<place>.+)\.[0-9a-f]{{32}}\{PART}(?P<aside>\{ASIDE})?')


class ResultFolder:
    """
    A result folder.

    main : the file that marks a result.   ours : names of all possible files of a result.
    """

    def __init__(self, place: Path, main: str, ours: frozenset[str]) -> None:
        self.place = Path(os.path.realpath(place))
        self._main, self._ours = main, ours
        self._main_file: tuple[Any, ...] = ()       # identity of the written main file

    @property
    def written(self) -> bool:
        """Return True if the content of the folder is unchanged since it was written."""
        with suppress(OSError):
            return self._main_file == _which(self.place / self._main)
        return False

    def put(self, texts: Mapping[str, str], force: bool) -> None:
        """
        Write a result, or leave everything unchanged.

        Raises BadUsage: a result exists and no ``force``. Raises OSError: it cannot be written.
        """
        self.place.parent.mkdir(parents=True, exist_ok=True)
        try:
            with self._sibling(self.place.parent, texts) as new:
                if self._exchangeable():
                    self._exchange(new, force)
                    return
        except OSError as error:
            if error.errno not in NOT_BY_RENAME or not self.place.is_dir():
                raise
        with self._sibling(self.place, texts) as new:
            self._file_by_file(new, texts, force)

    def add(self, name: str, text: str) -> bool:
        """Add a file to the written result; return False if another result has replaced it."""
        with locked(self.place.parent):
            if self.written:
                write_text(self.place / name, text)
            return self.written

    @contextmanager
    def _sibling(self, parent: Path, texts: Mapping[str, str]) -> Iterator[Path]:
        """Make a folder with the files; its remains are removed after the block."""
        new = parent / f'.{self.place.name}.{uuid.uuid4().hex}{PART}'
        with locked(self.place.parent):
            self._clear(parent)
            disk(os.mkdir, new)
            held = ExitStack()
            held.enter_context(locked(new))     # before others may clear it away
        with held:
            try:
                for name, text in texts.items():
                    write_text(new / name, text)
                sync_folder(new)
                self._main_file = _which(new / self._main)
                yield new
            finally:
                shutil.rmtree(new, ignore_errors=True)

    def _clear(self, parent: Path) -> None:
        """Remove or restore folders of killed writers; active writers lock theirs."""
        found = [(parent / name, LEFT.fullmatch(name)) for name in os.listdir(parent)]
        for one, left in ((one, left) for one, left in found if left):
            with suppress(OSError), locked(one, wait=False) as held:
                if left['aside'] and not (parent / left['place']).exists():
                    one.rename(parent / left['place'])
                elif held:
                    shutil.rmtree(one, ignore_errors=True)

    def _refuse(self, force: bool) -> None:
        if (self.place / self._main).exists() and not force:
            raise BadUsage(f'{self.place / self._main} exists; give another folder with --output, '
                           'or --force to replace it')

    def _exchangeable(self) -> bool:
        """Return True if the folder is private and unused by this process."""
        if not self.place.is_dir():
            return True
        return self.place != Path.cwd() and all(
            name in self._ours or any(name.startswith(f'.{our}.') for our in self._ours)
            for name in os.listdir(self.place))

    def _exchange(self, new: Path, force: bool) -> None:
        with locked(self.place.parent), uninterrupted():
            self._refuse(force)
            try:
                disk(os.rename, new, self.place)      # nothing, or an empty folder, is there
            except OSError as error:
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
                    raise
                disk(_swap, new, self.place)
            sync_folder(self.place.parent)

    def _file_by_file(self, new: Path, texts: Mapping[str, str], force: bool) -> None:
        with locked(self.place.parent), uninterrupted():
            self._refuse(force)
            for name in sorted(self._ours, key=self._main.__ne__):
                (self.place / name).unlink(missing_ok=True)
            for name in sorted(texts, key=self._main.__eq__):
                disk(os.rename, new / name, self.place / name)
            sync_folder(self.place)


def _which(path: Path) -> tuple[int, int]:
    about = path.stat()
    return about.st_ino, about.st_mtime_ns


def _swap(one: Path, other: Path) -> None:
    """Swap two folders in one step if the system can, else in two."""
    rename = getattr(ctypes.CDLL(None, use_errno=True), 'renameat2', None)
    names = [os.fsencode(path) for path in (one, other)]
    if rename is not None:
        at_fdcwd, rename_exchange = -100, 2      # of linux/fcntl.h and linux/fs.h
        if rename(at_fdcwd, names[0], at_fdcwd, names[1], rename_exchange) == 0:
            return
        code = ctypes.get_errno()
        if code not in (errno.EINVAL, errno.ENOSYS):      # not supported by the file system
            raise OSError(code, os.strerror(code), str(other))
    aside = one.with_name(f'{one.name}{ASIDE}')
    os.rename(other, aside)
    try:
        os.rename(one, other)
    except OSError:
        os.rename(aside, other)
        raise
    os.rename(aside, one)
