# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Settings from files and --set: read as the node reads them, one sentence per error."""

import json
import math
import os
import subprocess
import sys

import pytest

from odocal_ros.errors import BadConfig, BadUsage, OdocalError
from odocal_ros.settings.config import Config, flat, SETTINGS
from odocal_ros.settings.config_file import parse_set, read_config_file, scalar

pytestmark = pytest.mark.core
BLOCK = '/**/calibrator:\n  ros__parameters:\n'
DISTANCE = '  ros__parameters:\n    leg.min_distance: '


@pytest.fixture
def write(tmp_path):
    def file(text):
        path = tmp_path / 'params.yaml'
        path.write_text(text, encoding='utf-8')
        return path
    return file


@pytest.mark.parametrize(('text', 'values'), [
    *((f'{key}:\n{DISTANCE}50.0\n', {'leg.min_distance': 50.0}) for key in (
        '/**', '/**/calibrator', '/calibrator', 'calibrator', '/*')),
    # later blocks take precedence, a repeated key keeps its place, namespaces may be nested
    (f'calibrator:\n{DISTANCE}1.0\n/**:\n{DISTANCE}2.0\n', {'leg.min_distance': 2.0}),
    (f'/**:\n{DISTANCE}2.0\ncalibrator:\n{DISTANCE}1.0\n/**:\n{DISTANCE}5.0\n',
     {'leg.min_distance': 1.0}),
    ('/**:\n  calibrator:\n    ros__parameters:\n      leg.min_distance: 5.0\n',
     {'leg.min_distance': 5.0}),
    (BLOCK + '    leg: {min_distance: 50.0}\n    leg.min_speed: 1.0\n    method: all\n'
     '    gnss:\n      lever_arm: [1, 0, 0.5]\n',
     {'leg.min_distance': 50.0, 'leg.min_speed': 1.0, 'method': 'all',
      'gnss.lever_arm': (1.0, 0.0, 0.5)}),
    (BLOCK + '    leg.min_distance: 50\n', {'leg.min_distance': 50.0}),
    # output of ros2 param dump
    (BLOCK + '    use_sim_time: true\n    result: {scale_factor: .nan, valid: false}\n'
     '    qos_overrides:\n      /imu/data:\n        subscription: {depth: 10}\n'
     '    start_type_description_service: true\n    method: all\n', {'method': 'all'})])
def test_a_file_gives_the_settings_of_the_node(write, text, values):
    found = read_config_file(write(text))
    assert found == values
    assert [type(x) for x in found.values()] == [type(x) for x in values.values()]


@pytest.mark.parametrize('key', ['/car1/calibrator', 'imu_driver', '/**/driver', '/calibrator2'])
def test_blocks_of_other_nodes_are_named_but_not_used(write, key):
    path = write(f'{key}:\n  ros__parameters:\n    leg.min_distance: 50.0\n')
    with pytest.raises(BadConfig, match=r'no block for the calibrator; it has .*required: a top-'):
        read_config_file(path)


@pytest.mark.parametrize(('text', 'error', 'match'), [
    ('    leg.min_distnace: 5.0\n', BadConfig,
     r'line 3: no setting .* did you mean leg.min_distance'),
    ('    projection:\n      kind: leg\n', BadConfig, "line 4: no setting 'projection.kind'; the "
     r'settings projection.\* were removed; delete them$'),
    ('    leg: {min_distance: far}\n', BadConfig, "line 3: leg.min_distance: 'far' is not a num"),
    ('\n    leg.min_distance: 0.0\n', BadConfig, 'line 4: leg.min_distance = 0: required: 1 to 1'),
    ('    gnss.lever_arm: [1.0, 2.0]\n', BadConfig, 'line 3: gnss.lever_arm: 2 values; required: '
     '3'),
    ('    gnss.lever_arm: [[1.0], 2.0, 3.0]\n', BadConfig, r'\[1.0\] is not a number'),
    ('    odometer.left: 0\n', BadConfig, 'write it in quotes'),
    ('    method: [all\n', BadConfig, 'line 4: not valid YAML: '),
    ('    method: "a\x07b"\n', BadConfig, 'not valid YAML: ')])
def test_an_error_names_its_line(write, text, error, match):
    with pytest.raises(error, match=match) as caught:
        read_config_file(write(BLOCK + text))
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('text', ['', 'just words\n', '- 1\n', 'leg:\n  min_distance: 5.0\n'])
def test_a_file_without_settings_of_the_node_is_refused(write, text):
    with pytest.raises(BadConfig, match='no block for the calibrator'):
        read_config_file(write(text))


def test_files_that_cannot_be_read_are_refused(tmp_path):
    with pytest.raises(BadUsage, match='No such file'):
        read_config_file(tmp_path / 'nowhere.yaml')
    with pytest.raises(BadUsage, match='Is a directory'):
        read_config_file(tmp_path)
    (tmp_path / 'latin').write_bytes(b'/**: \xff\xfe')
    with pytest.raises(BadConfig, match='not a text file'):
        read_config_file(tmp_path / 'latin')


@pytest.mark.parametrize(('text', 'name', 'value'), [
    ('leg.min_distance=50', 'leg.min_distance', 50.0),
    ('leg.max_gap=1e-1', 'leg.max_gap', 0.1),
    ('gnss.lever_arm=[1, 0, 0.5]', 'gnss.lever_arm', (1.0, 0.0, 0.5)),
    ('output.formats=[params]', 'output.formats', ('params',)),
    ('output.formats=[]', 'output.formats', ()),
    ('reference.start=[]', 'reference.start', ()),
    ('odometer.left=0', 'odometer.left', '0'),
    ("odometer.left='on'", 'odometer.left', 'on'),
    ('odometer.field=data[1]', 'odometer.field', 'data[1]'),
    ('frames.imu=', 'frames.imu', ''),
    ('odometer.signed=false', 'odometer.signed', False),
    ('verdict.min_legs=3', 'verdict.min_legs', 3),
    (' method = all ', 'method', 'all')])
def test_set_reads_yaml_and_returns_the_type_of_the_setting(text, name, value):
    got = parse_set(text)
    assert got == (name, value)
    assert type(got[1]) is type(value)


def test_set_accepts_nan_if_a_setting_may_be_unset():
    assert math.isnan(parse_set('imu.nominal_yaw=nan')[1])
    with pytest.raises(BadConfig, match='NaN is not allowed'):
        parse_set('leg.min_distance=.nan')


@pytest.mark.parametrize(('text', 'error', 'match'), [
    ('leg.min_distance', BadUsage, 'required: key=value'),
    ('=5', BadUsage, 'required: key=value'),
    ('gnss.lever_arm=[1, 2', BadUsage, 'not valid YAML'),
    ('leg.min_dist=5', BadConfig, "^--set: no setting 'leg.min_dist'; did you mean leg.min_dist"),
    ('imu.grde=tactical', BadConfig, r"no setting 'imu.grde'; did you mean imu.grade\?$"),
    ('grade=tactical', BadConfig, r"no setting 'grade'; did you mean imu.grade\?$"),
    ('imu.gyro_scale=-1', BadConfig, '^--set imu.gyro_scale = -1: required: 0 to 1000$'),
    ('imu.gyro_noise=-1', BadConfig, 'required: 0 to 1 rad/s/sqrt'),
    ('leg.min_distance=', BadConfig, 'is not a number'),
    ('verdict.min_legs=2.5', BadConfig, 'is not a whole number'),
    ('leg.max_gap={a: 1}', BadConfig, 'is not a number'),
    ('imu.nominal_yaw=1.0e+308', BadConfig, 'imu.nominal_yaw = 1e.308: the limit is 1e.09'),
    ('reference.start=[1.0, 2.0, -1.0e+300, 1.0]', BadConfig, 'the limit is')])
def test_set_reports_the_error_in_one_line(text, error, match):
    with pytest.raises(error, match=match) as caught:
        parse_set(text)
    assert '\n' not in str(caught.value)
    assert isinstance(caught.value, OdocalError)


SCALARS = ['true', 'yes', 'Y', 'on', 'off', 'no', 'n', '3', '+3', '-3', '0x10', '010', '08', '0',
           '1.', '.5', '1e3', '1E-3', '-1.5e-7', '1_000', '1_0.5', '.nan', '.NaN', 'nan', 'NaN',
           '.inf', '-.inf', 'inf', '1:30', '~', 'null', 'text', "'3.0'", '"on"', '1e', 'e3', '--1']
BLOCKS = {
    'a wildcard after the node wins': ['calibrator', '/**'],
    'the node after a wildcard wins': ['/**', 'calibrator'],
    'a key that comes again keeps its place': ['/**', 'calibrator', '/**'],
    'four ways to say it': ['/calibrator', '/**/calibrator', '/*', 'calibrator'],
    'others are passed over': ['/**', '/car/calibrator', 'driver', '/*/calibrator']}
READ_BY_ROS = """
import json, sys, rclpy
from rclpy.node import Node
rclpy.init(args=['--ros-args', '--params-file', sys.argv[1]])
node = Node('calibrator', automatically_declare_parameters_from_overrides=True)
print(json.dumps({k: repr(p.value) for k, p in node._parameters.items()}))
rclpy.shutdown()
"""


def read_by_ros(path) -> dict[str, str]:
    """Return the parameters that a node named calibrator reads from a file, as reprs."""
    out = subprocess.run([sys.executable, '-c', READ_BY_ROS, str(path)], check=True, text=True,
                         capture_output=True, env=os.environ).stdout
    return json.loads(out)


@pytest.mark.parametrize('keys', BLOCKS.values(), ids=BLOCKS)
def test_blocks_take_precedence_as_in_a_node(write, keys):
    pytest.importorskip('rclpy')
    path = write(''.join(
        f'{key}:\n  ros__parameters:\n    leg.min_distance: {n}.0\n    leg.max_gap: 0.{n}\n'
        for n, key in enumerate(keys, 1)))
    by_ros = read_by_ros(path)
    assert {k: repr(v) for k, v in read_config_file(path).items()} == {
        k: by_ros[k] for k in ('leg.min_distance', 'leg.max_gap')}


def test_plain_values_get_the_same_types_as_in_ros(write):
    pytest.importorskip('rclpy')
    path = write('/**:\n  ros__parameters:\n' + ''.join(
        f'    s{i}: {text}\n' for i, text in enumerate(SCALARS)))
    by_ros = {k: v for k, v in read_by_ros(path).items() if k[1:].isdigit()}
    ours = {f's{i}': repr(text[1:-1] if text[0] in '\'"' else scalar(text))
            for i, text in enumerate(SCALARS)}
    assert ours == by_ros


def test_the_shipped_file_holds_every_setting_at_its_default():
    from tools.settings_page import ROOT
    values = read_config_file(ROOT / 'config' / 'calibrator.yaml')
    assert list(values) == list(SETTINGS)
    default = Config()
    for name, value in values.items():
        assert repr(value) == repr(flat(default)[name]), name
