# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Limits of reading untrusted files; the user multiplies them by ODOCAL_LIMITS."""

from functools import cache
import os
from pathlib import Path
import stat
from types import ModuleType
from typing import Any

from odocal_ros.errors import BadBag

FACTOR_VARIABLE = 'ODOCAL_LIMITS'
DEFINITION_CHARACTERS = 2**16     # judgement: length of a message definition
MESSAGE_BYTES = 2**26             # judgement: size of one requested message
MESSAGE_VALUES = 100_000          # judgement: in the fixed arrays of one message
PARSE_SECONDS = 20                # judgement: to parse a message definition
# judgement: bytes first given to a decompressor: it copies the rest of its input after each
# frame, and frames may be short
FIRST_PIECE = 2**10
LATEST_NS = 2**62            # judgement: the year 2116: a later time is invalid


class LimitReached(BadBag):
    """A file exceeds a limit, such as the decompressed bytes for its size."""


class Damaged(Exception):
    """A part of a file is damaged; the text goes into the notes."""


def limit_factor() -> float:
    """Return the user's factor of all limits, 1 by default."""
    try:
        return max(float(os.environ.get(FACTOR_VARIABLE, '')), 1.0)
    except ValueError:
        return 1.0


def check(amount: float, limit: float, what: str, unit: str = 'bytes') -> None:
    """Raise LimitReached if an amount exceeds a limit; what : file and quantity, for the text."""
    limit *= limit_factor()
    if amount > limit:
        raise LimitReached(f'{what} exceeds the limit of {limit:.0f} {unit}; if the file is '
                           f'valid, set {FACTOR_VARIABLE}=10 in the environment for ten times '
                           'the limit')


class Allowance:
    """
    Limit of the bytes that a file of a bag may decompress to in one pass, and count of them.

    path : of the compressed file.   bag_bytes : of all files of its bag.
    """

    def __init__(self, path: Path, bag_bytes: int) -> None:
        packed = path.stat().st_size
        self._what = f'{path}: unpacked, it'
        always_allowed = 2**26    # bytes of a bag, distributed over its files
        # further bytes for each byte of the file; sensor messages compress to a tenth
        ratio = 40
        self.limit = int(always_allowed * packed / max(bag_bytes, packed, 1) + ratio * packed)
        self._used = 0

    def restart(self) -> None:
        """Restart the count for another pass."""
        self._used = 0

    def add(self, count: int) -> None:
        """Count decompressed bytes; raise LimitReached above the limit."""
        self._used += count
        check(self._used, self.limit, self._what)

    def check_frames(self, frames: int, packed: int) -> None:
        """Raise LimitReached for implausibly many frames in ``packed`` bytes."""
        always_allowed, bytes_a_frame = 1000, 1024
        check(frames, always_allowed + packed / bytes_a_frame, self._what, 'frames')

    @property
    def remaining(self) -> int:
        """Return the number of bytes that are still allowed."""
        return int(self.limit * limit_factor()) - self._used

    def unpack(self, packing: str, data: bytes | bytearray | memoryview, size: int | None = None
               ) -> bytes | bytearray | memoryview:
        """
        Return decompressed data; if the stream is truncated, the part that exists.

        packing : '', 'zstd', 'lz4' or 'bz2'.   size : stated number of bytes, if any. Raises
        LimitReached; Damaged: another packing, or more than ``size`` bytes; or an error of the
        decompressor.
        """
        max_size = self.remaining if size is None else min(size, self.remaining)
        if not packing:
            self.add(len(data))
            return data
        parts, unpacked, offset, frames = [], 0, 0, 0
        packed = memoryview(data)
        while offset < len(packed) and unpacked <= max_size:
            frames += 1
            self.check_frames(frames, offset)
            stream, piece = _decompressor_class(packing)(), FIRST_PIECE
            while offset < len(packed) and unpacked <= max_size and not stream.eof:
                parts.append(stream.decompress(packed[offset:offset + piece],
                                               max_size + 1 - unpacked))
                unpacked += len(parts[-1])
                offset += min(piece, len(packed) - offset)
                piece *= 2
            if stream.eof:
                offset -= len(stream.unused_data or b'')      # the next frame
        self.add(unpacked)
        if size is not None and unpacked > size:
            raise Damaged('a chunk is larger than its header states')
        return b''.join(parts)


def _decompressor_class(packing: str) -> Any:
    """Return a class with a method ``decompress(data, max_length)``; raises Damaged if unknown."""
    if packing == 'zstd':
        return zstd_module().ZstdDecompressor
    if packing == 'lz4':
        from lz4.frame import LZ4FrameDecompressor  # type: ignore[import-untyped]
        return LZ4FrameDecompressor
    if packing == 'bz2':
        from bz2 import BZ2Decompressor
        return BZ2Decompressor
    raise Damaged(f'compression {packing[:20]!r} is not known')


@cache
def zstd_module() -> ModuleType:
    """Return the zstd module that rosbags uses: the standard library's from Python 3.14 on."""
    from importlib import import_module  # a missing module is searched for each time
    try:
        return import_module('compression.zstd')
    except ModuleNotFoundError:
        return import_module('backports.zstd')


def is_file(path: Path) -> bool:
    """Return True if a path is a regular file: a pipe or a device can be endless or block."""
    try:
        return stat.S_ISREG(path.stat().st_mode)
    except (OSError, ValueError):
        return False


def read_text(path: Path) -> str:
    """Return the text of a YAML file; a pipe is allowed. May raise UnicodeDecodeError."""
    max_bytes = 2**19    # of a YAML file
    return read_bytes(path, max_bytes).decode()


def read_bytes(path: Path, size: int) -> bytes:
    """Return a file of at most ``size`` bytes; raises LimitReached, as a device may be endless."""
    with path.open('rb') as file:
        data = file.read(int(size * limit_factor()) + 1)
    check(len(data), size, f'{path}: the text')
    return data
