# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A file as bytes, not mapped: a mapped page that the disk cannot read ends the process."""

import os
from pathlib import Path

import numpy as np

LET_GO = 2**23      # judgement: bytes


class FileBytes:
    """The bytes that a file has when it is opened, by offset."""

    def __init__(self, path: Path) -> None:
        # glibc gives a block of memory back to the system, and has all its pages made again for
        # the next, unless a larger one was released earlier
        np.empty(LET_GO, np.uint8)
        self._path = path
        self._file = path.open('rb')
        self._size = os.fstat(self._file.fileno()).st_size

    def __len__(self) -> int:
        """Return the size."""
        return self._size

    def __getitem__(self, place: slice) -> bytes:
        """Return the bytes of a slice of step 1; OSError names the file."""
        start, stop, _ = place.indices(self._size)
        try:
            parts = []
            while start < stop and (part := os.pread(self._file.fileno(), stop - start, start)):
                parts.append(part)
                start += len(part)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path)) from None
        return parts[0] if len(parts) == 1 else b''.join(parts)

    def close(self) -> None:
        """Close the file."""
        self._file.close()
