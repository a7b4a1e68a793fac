# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The pages are correct: commands parse, names exist, tables and recipes are right."""

import math
import re
import shlex

from foreign_keys import ARDUPILOT, LIDAR_INERTIAL, RECIPES
from pages import commands, fenced, PAGES, ROOT
import pytest
import yaml

from odocal_ros.offline import cli
from odocal_ros.reasons import Code
from odocal_ros.settings.config import SETTINGS, settings_of
from odocal_ros.settings.node_configs import ApplyConfig
from tools import settings_page
from tools.reason_meanings import MEANINGS

README = (ROOT / 'README.md').read_text(encoding='utf-8')
PAGE = (ROOT / 'docs' / 'recipes.md').read_text(encoding='utf-8')


@pytest.mark.parametrize('path', [*settings_page.pages()], ids=lambda path: path.name)
def test_generated_pages_are_up_to_date(path):
    assert path.read_text(encoding='utf-8') == settings_page.pages()[path], (
        'stale: run python -m tools.settings_page --write')


def test_an_outdated_page_is_reported_and_written_again(tmp_path, monkeypatch, capsys):
    (tmp_path / 'config').mkdir()
    (tmp_path / 'docs').mkdir()
    whole = (ROOT / 'docs' / 'settings.md').read_text()
    stale = whole.replace('| `method` | string |', '| old |')
    (tmp_path / 'docs' / 'settings.md').write_text(stale)
    (tmp_path / 'config' / 'calibrator.yaml').write_text('old')
    fresh = settings_page.pages
    monkeypatch.setattr(settings_page, 'pages', lambda: fresh(tmp_path))
    monkeypatch.setattr('sys.argv', ['settings_page'])
    assert settings_page.main() == 1
    assert capsys.readouterr().out.count('stale: ') == 5
    monkeypatch.setattr('sys.argv', ['settings_page', '--write'])
    assert settings_page.main() == 0
    assert (tmp_path / 'docs' / 'settings.md').read_text() == whole
    monkeypatch.setattr('sys.argv', ['settings_page'])
    assert settings_page.main() == 0


def test_each_setting_has_a_row():
    page = (ROOT / 'docs' / 'settings.md').read_text()
    rows = re.findall(r'^\| `([\w.]+)` \| [\w\[\]]+(?: \(read-only\))? \| (.*?) \|', page,
                      re.MULTILINE)
    assert [name for name, _ in rows] == list(SETTINGS)
    assert dict(rows)['leg.min_distance'] == '100.0'


def test_the_readme_is_short_and_has_its_sections_in_order():
    lines = README.splitlines()
    assert len(lines) <= 120
    order = ['pictures/watch.svg', '## Install', 'pip install .', 'uvx ', 'docker build',
             'colcon build', './tools/try-it', './tools/test', '## Your own bag',
             'odocal try drive\n', 'odocal replay', '## Live', '## Result', '## Where next']
    places = [README.index(what) for what in order]
    assert places == sorted(places)


def test_each_reason_is_explained_once_in_the_order_of_the_enum():
    explained = [code for codes in MEANINGS.values() for code in codes]
    assert explained == list(Code), 'say what the code means in tools/reason_meanings.py'
    assert all(text.endswith('.') for codes in MEANINGS.values() for text in codes.values())


def test_odocal_commands_parse():
    lines = [line for page in PAGES for line in commands(page.read_text(encoding='utf-8'))
             if line.startswith('odocal ')]
    assert len(lines) >= 3
    for line in lines:
        words = shlex.split(line)[1:]
        assert words[0] in cli.COMMANDS, line
        if len(words) == 1:      # a mention, not a command line
            continue
        args = cli._parser(words[0]).parse_args(words)
        assert args.command == words[0], line


def test_scripts_and_links_exist():
    for page in PAGES:
        text = page.read_text(encoding='utf-8')
        for link in re.findall(r'\]\((?!http)([^)#]+)\)', text):
            assert (page.parent / link).exists(), f'{page.name}: {link}'
        for line in commands(text):
            if line.startswith(('./tools/', '.ci/')):
                script = ROOT / shlex.split(line)[0]
                assert script.stat().st_mode & 0o111, line
    for name in re.findall(r'`((?:odocal_ros|test|config|docs|launch)/[\w./]+)`', ''.join(
            page.read_text(encoding='utf-8') for page in PAGES)):
        assert (ROOT / name).exists(), name


def test_modules_of_the_method_page_exist():
    for page in PAGES:
        for name in re.findall(r'`((?:\w+/)*\w+\.py)`', page.read_text(encoding='utf-8')):
            places = (ROOT / name, ROOT / 'odocal_ros' / name)
            assert any(p.exists() for p in places), f'{page.name}: {name}'


def test_settings_and_reasons_named_in_the_text_exist():
    known = {*SETTINGS, *settings_of(ApplyConfig)}
    groups = {name.partition('.')[0] for name in known if '.' in name}
    for page in PAGES:
        text = page.read_text(encoding='utf-8')
        for name in re.findall(r'`([a-z_]+\.[a-z_]+)`', text):
            if name.partition('.')[0] in groups and not name.endswith(('.py', '.yaml')):
                assert name in known, f'{page.name}: {name}'
        for name in re.findall(r'`([A-Z]+_[A-Z_]+)`', text):
            if not name.startswith('ODOCAL'):
                assert name in Code.__members__, f'{page.name}: {name}'
        for name, _ in re.findall(r'--set ([\w.]+)=(\S+)', text):
            assert name in SETTINGS, f'{page.name}: {name}'


def test_the_node_has_the_topics_and_services_on_the_page():
    pytest.importorskip('rclpy', reason='no rclpy here: pip install odocal_ros[ros]')
    from odocal_ros.data.inputs import TOPICS
    from odocal_ros.live import node
    from odocal_ros.live.publishing import PLOTTED
    topics = {'status', 'hint', 'scale_factor', 'yaw_mounting_angle'}     # and `_sigma`
    assert topics | {f'{name}_sigma' for name in topics} >= set(PLOTTED)
    page = (ROOT / 'docs' / 'interface.md').read_text(encoding='utf-8')
    services = set(re.findall(r'`~/(\w+)`', page)) - topics
    assert services == set(node.SERVICES)
    for topic in TOPICS.values():
        assert f'`{topic}`' in page, topic


def blocks():
    """Return the blocks of settings: of ROS nodes, and of ArduPilot as name -> value."""
    texts = ['\n'.join(lines) for language, lines in fenced(PAGE) if language == 'text']
    ros = [yaml.safe_load(text) for text in texts if 'ros__parameters' in text]
    plain = [dict(line.split() for line in text.splitlines()) for text in texts
             if text.startswith('WENC')]
    return ros, plain


def test_each_parameter_exists_in_the_other_system():
    ros, plain = blocks()
    ours = yaml.safe_load((ROOT / 'config' / 'ekf_odocal.yaml').read_text())
    ros.append({name.rpartition('/')[2]: block for name, block in ours.items()})
    found = {node: set(block['ros__parameters']) for one in ros for node, block in one.items()}
    assert set(found) == set(RECIPES)
    for one in ros:
        for node, block in one.items():
            assert set(block['ros__parameters']) <= RECIPES[node], node
    named = set(re.findall(r'\b(?:WENC|EK3)\w+', PAGE))
    assert named <= ARDUPILOT
    assert {name for one in plain for name in one} <= ARDUPILOT
    assert set(re.findall(r'`(extrinsic\w+)`', PAGE)) == LIDAR_INERTIAL


def test_the_recipes_have_fifteen_states_and_a_radius_with_the_travel_of_the_factor():
    ros, _ = blocks()
    config = ros[0]['ekf_filter_node']['ros__parameters']['twist0_config']
    assert [i for i, fused in enumerate(config) if fused] == [6, 7, 11]       # vx, vy, vyaw
    assert len(config) == 15
    # by the equation of ArduPilot: distance = 2 pi counts / CPR * radius
    _, (settings,) = blocks()
    travel = 2 * math.pi / float(settings['WENC_CPR']) * float(settings['WENC_RADIUS'])
    assert abs(travel - 0.0213) < 1e-7


TAGS = re.findall(r'\\tag\{([STW])(\d+)\}', (ROOT / 'docs/method.md').read_text(encoding='utf-8'))
TAGS = {letter: [int(n) for a, n in TAGS if a == letter] for letter in 'STW'}
MIN_TAGS = {'S': 30, 'T': 14, 'W': 7}   # fewer than there are: smoother, two-point, two wheels


def _cited(text, letter):
    """Return the numbers that a text cites, (S5) to (S8) all four."""
    ends = re.findall(rf'\({letter}(\d+)\)(?: to \({letter}(\d+)\))?', text)
    return {n for first, last in ends for n in range(int(first), int(last or first) + 1)}


@pytest.mark.parametrize('letter', 'STW')
def test_equations_of_the_method_are_in_order_and_all_citations_exist(letter):
    assert list(range(1, len(TAGS[letter]) + 1)) == TAGS[letter]
    assert len(TAGS[letter]) > MIN_TAGS[letter]
    code = set()
    for page in (*(ROOT / 'odocal_ros').rglob('*.py'), *(ROOT / 'docs').rglob('*.md')):
        cited = _cited(page.read_text(encoding='utf-8'), letter)
        lacks = cited - set(TAGS[letter])
        assert not lacks, f'{page} cites {lacks} of {letter}'
        code |= cited if page.suffix == '.py' else set()
    assert set(TAGS[letter]) == code
