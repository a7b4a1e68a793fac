# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The numbers of docs/method.md that the code cites are those of its equations."""

from pathlib import Path
import re

from pages import ROOT
import pytest

import odocal_ros

TAGS = re.findall(r'\\tag\{([STW])(\d+)\}', (ROOT / 'docs/method.md').read_text(encoding='utf-8'))
TAGS = {letter: [int(n) for a, n in TAGS if a == letter] for letter in 'STW'}
MOST = {'S': 30, 'T': 15, 'W': 7}      # there are more of them: smoother, two-point, two wheels


def _cited(text, letter):
    """Return the numbers that a text cites, (S5) to (S8) all four."""
    ends = re.findall(rf'\({letter}(\d+)\)(?: to \({letter}(\d+)\))?', text)
    return {n for first, last in ends for n in range(int(first), int(last or first) + 1)}


def _pages():
    yield from Path(odocal_ros.__file__).parent.rglob('*.py')
    yield from (ROOT / 'docs').rglob('*.md')


@pytest.mark.parametrize('letter', 'STW')
def test_equations_are_in_order_and_cited_and_no_others_are(letter):
    assert list(range(1, len(TAGS[letter]) + 1)) == TAGS[letter]
    assert len(TAGS[letter]) > MOST[letter]
    for page in _pages():
        lacks = _cited(page.read_text(encoding='utf-8'), letter) - set(TAGS[letter])
        assert not lacks, f'{page} cites {lacks} of {letter}'
    code = {n for page in _pages() if page.suffix == '.py'
            for n in _cited(page.read_text(encoding='utf-8'), letter)}
    assert set(TAGS[letter]) - code == set()
