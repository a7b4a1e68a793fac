# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A disk with errors: in one step, or in every step from one on."""

import ctypes
import errno
import os

from odocal_ros.bagio import segments
from odocal_ros.safe_io import atomic_files


class Refusing:
    """
    Counts the steps of ``atomic_files.disk`` and refuses some.

    at : the first that is refused, 0 for none.   for_ever : also those after it.   error : the
    exception, by default an OSError with the code.
    """

    def __init__(self, at: int, code: int = errno.ENOSPC, for_ever: bool = False,
                 error: BaseException | None = None) -> None:
        self.at, self.for_ever, self.steps = at, for_ever, []
        self.error = error or OSError(code, os.strerror(code), 'refused')

    def __call__(self, step, *values):
        self.steps.append(getattr(step, '__name__', str(step)))
        count = len(self.steps)
        if self.at and (count == self.at or self.for_ever and count > self.at):
            raise self.error
        return step(*values)

    def put_in(self, monkeypatch) -> 'Refusing':
        """Replace the disk."""
        for module in (atomic_files, segments):
            monkeypatch.setattr(module, 'disk', self)
        return self


def obey_permissions() -> None:
    """Drop the right of root to write read-only files (this thread and those it starts)."""
    drop = ~((1 << 1) | (1 << 2)) & 0xffffffff      # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
    libc = ctypes.CDLL(None, use_errno=True)
    head, sets = (ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)()
    if libc.capget(head, sets) == 0:
        sets[0], sets[1] = sets[0] & drop, sets[1] & drop
        libc.capset(head, sets)
