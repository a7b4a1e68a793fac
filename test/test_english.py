# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Texts, docs and tests use the terms of CONTRIBUTING.md, not the words that these replace."""

import ast
from functools import cache
import io
import re
import tokenize

from pages import ROOT
import pytest

from odocal_ros.reasons import Code
from odocal_ros.settings.config import SETTINGS

# what is not used: what to write instead
WORDS = {
    r'tells?|told|untold|foretells?': 'determine, observe, show, configured',
    r'hears?|heard|hearer': 'receive, use, listen',
    r'feels?|felt|unfelt': 'measure',
    r'wanders?|wandered|wandering': 'drift',
    r'mends?|mended|mending': 'fix, correct, check',
    r'gainsays?|gives? way': 'contradict, is relaxed',
    r'borne out|from nothing': 'confirmed, cold start',
    r'astray|strays?|strayed': 'outlier, deviate',
    r'heaved|shaken|shakes|leaned': 'crest, vibrating, lean',
    r'goes before|went before|go before': 'takes precedence',
    r'goes? to and fro|to and fro': 'oscillates',
    r'alike': 'the same, correlated',
    r'lies? off|lying off|ly off': 'are outliers',
    r'(?<!same )(?<!this )(?<!either )(?<!no )(?<!another )way': 'path, path length, travel',
    r'above all': 'largest',
    r'take care|for the eye|the sky|open sky\b.*\bsees': 'warnings, for people, sky view',
    r'exchanged?': 'swap',
    r'by (?:itself|themselves)': 'automatically, separately',
    r'begins? anew|anew': 'restart, again',
    r'allows? for it|put(?:s)? \w+ off': 'accounted for, differs from its setting',
    r'(?:is|are) (?:wanted|asked)|were asked': 'the limit is, required',
    r'(?:nothing|nobody|somebody) (?:tells|knows|says|sees)': 'cannot be decided from the data',
    r'whoever|who does not': 'to ..., do ...',
    r'as (?:it|they) (?:was|were) \S+ s ago': 'estimate is N s old',
    r'eased?|eases': 'reduce',
    r'believable|believed': 'plausible, the limit is',
    r'honest|honestly': 'reliable, correct',
    r'creeps?|crept|ran away|runs away': 'converges slowly, diverged',
    r'believes?|doubts?|doubted|in doubt': 'has the prior, uncertainty',
    r'(?:is|are|was|were) taken for|passes for|passed for': 'is treated as, looks like',
    r'settles?|goes on|by hand|speaks?|spoke': 'converges, continues, manually, reports',
    r'in vain|hence|thereof|therein|aught|naught|thence|whereof': 'plain words'}
UNUSED = re.compile(r'(?<![\w/.`:-])(?:(?i:' + '|'.join(WORDS) + r')|Imus?)(?![\w/`-])')
MODULES = [path for folder in (
            'odocal_ros', 'reproductions', 'benchmarks', 'tools', 'examples', 'test')
           for path in sorted((ROOT / folder).rglob('*.py'))]
PAGES = [*sorted(ROOT.glob('*.md')), *sorted((ROOT / 'docs').rglob('*.md'))]
SETTING_FILES = [path for folder in ('config', 'launch')
                 for path in sorted((ROOT / folder).iterdir()) if path.is_file()]
# names of settings, files and values, equations, links
NAMES = re.compile(r'``[^`\n]*``|`[^`\n]*`|\{[^{}]*\}|\$[^$]*\$|\([^() ]*\.md\)|https?://\S+|[\w-]+_[\w-]+')


def unused(text):
    return [match.group() for match in UNUSED.finditer(NAMES.sub(' ', text))]


def literals(path):
    """Return (line, text) of the string literals of a module but docstrings; {} for a value."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding='utf-8'))))
    inner = {id(part) for node in nodes if isinstance(node, ast.JoinedStr)
             for part in ast.walk(node) if part is not node}
    inner |= {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if id(node) in inner:
            continue
        if isinstance(node, ast.JoinedStr):
            yield node.lineno, ''.join(part.value if isinstance(part, ast.Constant) else '{}'
                                       for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.lineno, node.value


def printed():
    """Return the printed texts of the package: literals with a space; sim names random streams."""
    return [(f'{path.relative_to(ROOT)}:{line}', text)
            for folder in ('odocal_ros', 'reproductions/odocal_reproductions')
            for path in sorted((ROOT / folder).rglob('*.py'))
            for line, text in literals(path)
            if len(text.split()) > (3 if path.parent.name == 'sim' else 1)]


@cache
def remarks():
    """Return (module:line, text) of all docstrings and comments."""
    found = []
    for path in MODULES:
        source, name = path.read_text(encoding='utf-8'), path.relative_to(ROOT)
        found += [(f'{name}:{getattr(node, "lineno", 1)}', ast.get_docstring(node) or '')
                  for node in ast.walk(ast.parse(source))
                  if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)]
        found += [(f'{name}:{token.start[0]}', token.string)
                  for token in tokenize.generate_tokens(io.StringIO(source).readline)
                  if token.type == tokenize.COMMENT]
    return found


def test_printed_texts_and_html_pages_are_plain():
    found = [f'{where}: {words}: {text[:90]}' for where, text in printed()
             if (words := unused(text))]
    assert not found, '\n'.join(found)
    for page in (ROOT / 'odocal_ros').rglob('*.html'):
        text = re.sub(r'\{[{%].*?[%}]\}|<[^>]*>', ' ', page.read_text(encoding='utf-8'))
        assert not unused(text), page.name


def test_differences_have_no_negative_zero():
    found = [module.name for module in (ROOT / 'odocal_ros').rglob('*.py')
             if re.search(r':\+\.\d+f\}', module.read_text(encoding='utf-8'))]
    assert not found      # +z.1f prints +0.0 for -0.01


@pytest.mark.parametrize('page', [*PAGES, *SETTING_FILES], ids=lambda page: page.name)
def test_docs_and_files_of_settings_are_plain(page):
    found = [f'{number}: {words}' for number, line in enumerate(
        page.read_text(encoding='utf-8').splitlines(), 1) if (words := unused(line))]
    assert not found, '\n'.join(found)


def test_the_newest_section_of_the_changelog_is_plain():
    sections = re.split(r'^-+$', (ROOT / 'CHANGELOG.rst').read_text(encoding='utf-8'),
                        flags=re.MULTILINE)
    found = [f'{words}: {line}' for line in sections[1].splitlines() if (words := unused(line))]
    assert found == []


@pytest.mark.parametrize('code', Code, ids=lambda code: code.name)
def test_remedies_are_short_sentences(code):
    for sentence in re.split(r'(?<=[.:;]) ', re.sub(r'\([^)]*\)', '', code.remedy)):
        assert len(sentence.split()) <= 20, sentence


def test_settings_are_described_in_short_sentences():
    for setting in SETTINGS.values() if isinstance(SETTINGS, dict) else SETTINGS:
        for sentence in re.split(r'(?<=[.:;]) ', setting.about):
            assert len(sentence.split()) <= 30, setting.name


def test_docstrings_and_comments_are_plain_and_say_what_is_returned():
    # 'name : meaning' and 'name=value' name parameters
    found = [f'{where}: {words}' for where, text in remarks()
             if (words := unused(re.sub(r'\b\w+ :|\b\w+=', ' ', text)))]
    assert not found, '\n'.join(found)
    vague = re.compile(r'Returns? (?:what|how|why|whether|where|which|when)\b|(?:Tell|Say)s?\b')
    found = [f'{where}: {text.splitlines()[0]}' for where, text in remarks() if vague.match(text)]
    assert not found, '\n'.join(found)


def test_names_of_tests_are_plain():
    found = [f'{path.relative_to(ROOT)}: {words}: {node.name}'
             for folder in ('test', 'reproductions/test') for path in (ROOT / folder).rglob('*.py')
             for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
             if isinstance(node, ast.ClassDef | ast.FunctionDef)
             and (words := unused(node.name.replace('_', ' ')))]
    assert not found, '\n'.join(found)


def test_the_words_are_found():
    assert unused('this drive tells the way; mend the Imu of the node') == [
        'tells', 'way', 'mend', 'Imu']
    assert unused('in the same way, `odometer.way` and /imu/way are names of an IMU') == []
