"""The launch files: arguments described, names those of the code, both twins alike."""

import ast
from pathlib import Path
import re
from xml.etree import ElementTree

import pytest

from odocal_ros.live.inputs import TOPICS

ROOT = Path(__file__).resolve().parents[2]
ARGUMENTS = ['params_file', 'imu_topic', 'odometer_topic', 'fix_topic', 'namespace',
             'use_sim_time']
REMAPPED = {'imu/data': 'imu_topic', 'odometer': 'odometer_topic', 'fix': 'fix_topic'}


@pytest.fixture(scope='module')
def python():
    return (ROOT / 'launch' / 'calibrator.launch.py').read_text()


@pytest.fixture(scope='module')
def xml():
    return ElementTree.parse(ROOT / 'launch' / 'calibrator.launch.xml').getroot()


def described(text):
    """Return argument -> description of the Python file, without running it."""
    table = next(node.value for node in ast.parse(text).body
                 if isinstance(node, ast.Assign) and node.targets[0].id == 'ARGUMENTS')
    return {row.elts[0].value: row.elts[2].value for row in table.elts}


def test_both_declare_the_same_arguments_with_descriptions(python, xml):
    arguments = described(python)
    assert list(arguments) == ARGUMENTS
    assert arguments == {arg.get('name'): arg.get('description') for arg in xml.iter('arg')}
    assert all(arguments.values())


def test_the_remapped_topics_are_the_nodes(python, xml):
    assert set(REMAPPED) == {TOPICS[slot] for slot in ('imu', 'odometer', 'fix')}
    assert {r.get('from'): r.get('to') for r in xml.iter('remap')} == {
        topic: f'$(var {argument})' for topic, argument in REMAPPED.items()}
    pairs = re.findall(r"\('([a-z/]+)', '([a-z]+)'\)", python.split('remappings=')[1])
    assert {topic: f'{name}_topic' for topic, name in pairs} == REMAPPED


def test_the_executable_is_the_one_installed(python, xml):
    setup = (ROOT / 'setup.py').read_text()
    node = xml.find('node')
    assert f"'{node.get('exec')} = odocal_ros.live.node:main'" in setup
    for key, value in (('package', node.get('pkg')), ('executable', node.get('exec')),
                       ('name', node.get('name'))):
        assert f"{key}='{value}'" in python
    assert '"launch/*"' in setup or "'launch/*'" in setup


def test_it_runs_where_launch_is_installed(python):
    launch = pytest.importorskip('launch', reason='launch is not on PyPI')
    pytest.importorskip('launch_ros', reason='launch_ros is not on PyPI')
    scope = {}
    exec(compile(python, 'calibrator.launch.py', 'exec'), scope)
    assert isinstance(scope['generate_launch_description'](), launch.LaunchDescription)
