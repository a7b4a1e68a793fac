# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Names of the files of a journal, by which a reader knows which of them to read."""

from collections.abc import Sequence
from pathlib import Path
import re

JOURNAL = 'journal.yaml'     # beside the files: the folder is a journal, and its settings
NUMBERED = re.compile(r'part_(\d+)(?:-(\d+))?\.mcap')


def part_name(first: int, last: int) -> str:
    """Return the name of a file that holds the segments of some numbers."""
    return f'part_{first:06}.mcap' if first == last else f'part_{first:06}-{last:06}.mcap'


def whole_name(folder: Path, number: int = 0) -> str:
    """Return the name of the file that holds all segments (0), or of one added to it later."""
    return f'{folder.name}_{number}.mcap'


def without_joined(files: Sequence[Path]) -> list[Path]:
    """Return the files of a journal without those whose messages are in another file too."""
    numbers = {path: NUMBERED.fullmatch(path.name) for path in files}
    others = [path for path, match in numbers.items() if match is None]
    if any(path.name.endswith('_0.mcap') for path in others):
        return others      # all was joined, and metadata.yaml was still to come
    spans = [(int(m[1]), int(m[2])) for m in numbers.values() if m and m[2]]
    return [path for path, m in numbers.items() if not m or m[2] or not any(
        first <= int(m[1]) <= last for first, last in spans)]
