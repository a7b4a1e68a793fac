# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Disk space of the journals of a folder; the oldest are deleted beyond the limit."""

from contextlib import suppress
import fcntl
from pathlib import Path
import re
import shutil
import time
from typing import TextIO

from odocal_ros.bagio.numbered import JOURNAL
from odocal_ros.outside.whole import PART

JOURNAL_NAME = re.compile(r'\d{4}-\d\d-\d\dT\d\d-\d\d-\d\dZ_leg_\d+(-\d+)?')     # of a journal
FOLDER_NEW_S = 10.0       # judgement: a node may be about to write into its folder


def journals(root: Path) -> list[Path]:
    """Return the journals in a folder, the oldest first."""
    found = []
    with suppress(FileNotFoundError):
        for folder in root.iterdir():
            with suppress(OSError):
                if not folder.is_symlink():
                    found.append(((folder / JOURNAL).stat().st_mtime_ns, folder))
    return [folder for _, folder in sorted(found)]


def clear_empty(root: Path) -> None:
    """Remove journals without data: their nodes were killed early, or the disk was full."""
    for folder in list(root.iterdir()):
        with suppress(OSError):
            named = JOURNAL_NAME.fullmatch(folder.name) and not folder.is_symlink()
            old = named and folder.stat().st_mtime < time.time() - FOLDER_NEW_S
            if old and all(is_nothing(path) for path in folder.iterdir()) and not _in_use(folder):
                shutil.rmtree(folder)


def is_nothing(path: Path) -> bool:
    """Return True if a journal file certainly holds no message."""
    return path.name == JOURNAL or path.name.endswith(PART)


def size_of(folder: Path) -> int:
    """Return the bytes that a journal takes."""
    total = 0
    with suppress(FileNotFoundError):
        for path in folder.iterdir():
            with suppress(FileNotFoundError):
                total += path.stat().st_size
    return total


def make_room(root: Path, limit: int, needed: int = 0) -> int:
    """
    Delete the oldest journals until all of them and ``needed`` more bytes stay within the limit.

    A journal in use stays. Returns the bytes taken after that.
    """
    sizes = {folder: size_of(folder) for folder in journals(root)}
    for folder in list(sizes):
        if sum(sizes.values()) + needed <= limit:
            break
        if not _in_use(folder):
            shutil.rmtree(folder, ignore_errors=True)
            sizes[folder] = size_of(folder)
    return sum(sizes.values())


def claim(folder: Path) -> TextIO:
    """Lock a journal as in use, until the returned file is closed or the process ends."""
    file = (folder / JOURNAL).open(encoding='utf-8')
    with suppress(OSError):      # a file system without locks: then it is unknown
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return file


def _in_use(folder: Path) -> bool:
    try:
        with (folder / JOURNAL).open(encoding='utf-8') as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False
