# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The pages for users: their commands, as a user types them."""

from pathlib import Path
import re

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', *sorted((ROOT / 'docs').rglob('*.md'))]


def fenced(page: str) -> list[tuple[str, list[str]]]:
    """Return (language, lines) of each fenced block."""
    found: list[tuple[str, list[str]]] = []
    inside = False
    for line in page.splitlines():
        if line.strip().startswith('```'):
            inside = not inside
            if inside:
                found.append((line.strip()[3:], []))
        elif inside:
            found[-1][1].append(line)
    return found


def blocks(page: str) -> list[list[str]]:
    """Return the fenced blocks without a language, as lines without comments."""
    stripped = [[raw.partition('  #')[0].strip() for raw in lines]
                for language, lines in fenced(page) if not language]
    return [[line for line in lines if line] for lines in stripped]


def commands(page: str) -> list[str]:
    """Return the lines of blocks, and text in backquotes that begins with odocal or ros2."""
    return [line for block in blocks(page) for line in block] + re.findall(
        r'`((?:odocal|ros2 \w+) [^`]+)`', page)


def yaml_blocks(page: str) -> list[str]:
    return ['\n'.join(lines) + '\n' for language, lines in fenced(page) if language == 'yaml']


def all_commands(first: str) -> list[tuple[str, str]]:
    """Return unique (page, command) of all commands that begin with a word."""
    found = [(page.relative_to(ROOT).as_posix(), line) for page in PAGES
             for line in commands(page.read_text(encoding='utf-8'))
             if line.split()[:1] == [first]]
    return list({line: (page, line) for page, line in reversed(found)}.values())[::-1]
