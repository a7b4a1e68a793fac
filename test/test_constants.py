# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A constant has one name in one module; the name of a threshold states what it limits.

A comment next to it, or above its group, states its origin by a word of settings/levels.py.
"""

import ast
from collections import defaultdict
from pathlib import Path
import re

import odocal_ros

PACKAGE = Path(odocal_ros.__file__).parent
PACKAGES = ('data', 'nav', 'screening', 'settings', 'calib', 'estimator', 'pipeline', 'forecast',
            'apply', 'live')
# indices of unknowns in a vector: two vectors may contain the same quantity
LAYOUTS = ('estimator/state.py', 'apply/errors.py')


# '# s, judgement: ...', '# statistical: ...', 'a sentence. Physical'; what is tuned says by what
MARK = re.compile(r'(?:^|[,;:.] )(?:physical|statistical|judgement|format|definition)(?=[,;:.]|$)'
                  r'|(?:^|[,;:.] )tuned\b.*\b(?:benchmarks|docs/decisions)/', re.IGNORECASE)


def _assignments(tree):
    """Yield the top-level assignments of one or more numbers; dicts are separate tables."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and any(
                isinstance(x, ast.Constant) and type(x.value) in (int, float)
                for x in ast.walk(node.value)) and not isinstance(node.value, ast.Dict):
            yield node


def _numbers(tree):
    """Yield the top-level names of one or more numbers in a module."""
    for node in _assignments(tree):
        for target in node.targets:
            yield from (x.id for x in ast.walk(target) if isinstance(x, ast.Name))


def _unmarked(text):
    """Return the lines with a number without an origin mark in the comments of it or its group."""
    lines, tree = text.splitlines(), ast.parse(text)
    begin = {node.end_lineno: node.lineno for node in tree.body if isinstance(node, ast.Assign)}
    lacks = []
    for node in _assignments(tree):
        beside = [line.partition('#')[2] for line in lines[node.lineno - 1:node.end_lineno]]
        first = node.lineno
        while first - 1 in begin:
            first = begin[first - 1]
        above = first - 1
        while above and lines[above - 1].startswith('#'):
            above -= 1
        comments = beside, [line[1:] for line in lines[above:first - 1]]
        if not any(MARK.search(' '.join(' '.join(c).split())) for c in comments):
            lacks.append(f'{node.lineno}: {lines[node.lineno - 1]}')
    return lacks


def test_no_two_modules_use_one_name_for_two_numbers():
    homes = defaultdict(list)
    for package in PACKAGES:
        for path in (PACKAGE / package).rglob('*.py'):
            where = path.relative_to(PACKAGE).as_posix()
            if where not in LAYOUTS:
                for name in _numbers(ast.parse(path.read_text(encoding='utf-8'))):
                    homes[name].append(where)
    assert len(homes) > 100
    assert {name: where for name, where in homes.items() if len(where) > 1} == {}


def test_each_number_has_its_origin_in_a_comment():
    second = Path(__file__).parents[1] / 'reproductions' / 'odocal_reproductions'
    lacks = {path.as_posix(): _unmarked(path.read_text(encoding='utf-8'))
             for package in (PACKAGE, second) for path in package.rglob('*.py')}
    assert len(lacks) > 300
    assert {where: lines for where, lines in lacks.items() if lines} == {}
