# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The result folders that a session has written, and what ``latest`` points at."""

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
import re
import shutil
import time
import uuid

from odocal_ros.output.stored import replacing, stored_in
from odocal_ros.outside.whole import locked

LATEST = 'latest'
LEFT_S = 60.0      # judgement: age of an empty folder, or of an unfinished link, that nobody uses
RESULT_NAME = re.compile(r'(\d{4}-\d\d-\d\dT\d\d-\d\d-\d\dZ)(?:-(\d+))?')     # by its time


@dataclass(frozen=True)
class Filed:
    """A written folder: the start marks of its legs, what ``latest`` was before it."""

    folder: Path
    legs: frozenset[int]
    before: str

    @property
    def root(self) -> Path:
        """Return the folder that holds all results."""
        return self.folder.parent


class ResultFolders:
    """
    Keeps ``latest`` at the best that is known, in this session and over earlier ones.

    The link does not go from a good calibration to a worse one unless forced, and it goes back
    when the legs of what it points at are undone. Nothing that an operator has had written is
    ever removed.
    """

    def __init__(self) -> None:
        self._filed: list[Filed] = []

    def file(self, folder: Path, legs: frozenset[int], force: bool) -> str:
        """
        Point ``latest`` at a folder just written; return why it stays where it is instead.

        legs : start marks, ns, of the legs in it.
        """
        link = folder.parent / LATEST
        with locked(folder.parent):         # another node may file there, too
            _clear(folder.parent)
            before = _target(link)
            worse = '' if force else replacing(stored_in(link), folder)
            if worse:
                return worse
            _point(link, folder.name)
        self._filed.append(Filed(folder, legs, before))
        return ''

    def prune(self, newest: Path, kept: int) -> None:
        """
        Remove the oldest results of ``leg.automatic`` beside a new one, all but so many; 0: none.

        What ``latest`` shows, what it would go back to, and the newest good one stay.
        """
        root = newest.parent
        with locked(root):
            names = sorted((p.name for p in root.iterdir() if RESULT_NAME.fullmatch(p.name)),
                           key=_age)
            old = names[:-kept] if kept else []
            shown = _target(root / LATEST)
            stay = {newest.name, shown, *(f.before for f in self._filed if f.folder.name == shown)}
            for name in reversed(names if old else []):
                found = stored_in(root / name)
                if found and found.usable:
                    stay.add(name)
                    break
            for name in (n for n in old if n not in stay):
                found = stored_in(root / name)
                if found and found.config.get('leg.automatic'):
                    shutil.rmtree(root / name, ignore_errors=True)

    def withdraw(self, left: frozenset[int]) -> Path | None:
        """
        Take back what holds legs that are dropped; ``left`` are the start marks of the others.

        Returns the newest folder of this session that still stands, None when there is none.
        """
        dropped = [f for f in self._filed if not f.legs <= left]
        self._filed = [f for f in self._filed if f.legs <= left]
        for one in reversed(dropped):
            link = one.root / LATEST
            if _target(link) != one.folder.name:
                continue       # somebody else has moved it since
            if one.before and (one.root / one.before).is_dir():
                _point(link, one.before)
            else:
                link.unlink(missing_ok=True)
        return self._filed[-1].folder if self._filed else None


def _age(name: str) -> tuple[str, int]:
    """Return the sort key of result names: their time, and the number within that second."""
    when, count = RESULT_NAME.findall(name)[0]
    return when, int(count or 1)


def _clear(root: Path) -> None:
    """Remove what nodes that were killed have left: empty folders of results, and links."""
    until = time.time() - LEFT_S
    for one in root.iterdir():
        with suppress(OSError):
            if one.lstat().st_mtime > until:
                continue
            if RESULT_NAME.fullmatch(one.name):
                one.rmdir()      # only an empty folder can be
            elif one.name.startswith(f'.{LATEST}-') and one.is_symlink():
                one.unlink()


def _target(link: Path) -> str:
    return link.readlink().name if link.is_symlink() else ''


def _point(link: Path, name: str) -> None:
    """Move the link in one step: readers find the old or the new folder."""
    other = link.with_name(f'.{LATEST}-{uuid.uuid4().hex}')
    other.symlink_to(name)
    other.replace(link)
