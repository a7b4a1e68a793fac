# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Start and end of the node's process, its parameters, and results that it restores."""

import math
import os
import signal
import subprocess
import sys

from bench import answer_of, NODE, NodeProcess, PATIENCE, ROOT, wait_for
from player import light
import pytest
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import get_parameter_value

from odocal_ros import __version__
from odocal_ros.settings.config import SETTINGS

RESULT = {'result.scale_factor': 0.0213, 'result.legs': 2, 'result.valid': True}
SIGMA = {'result.scale_factor_sigma': 1e-5}


@pytest.fixture(scope='module')
def sent():
    return light()


@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_node_cleanly_even_during_a_leg(play_to, sent, how):
    leg = play_to(sent)
    leg.record(0, 5)
    assert leg.node.end(how) == 0
    assert 'Traceback' not in leg.node.text
    assert 'rror' not in leg.node.text
    kept = leg.node.lines[-1]
    assert kept.startswith('calibrator: leg 1 was not stopped: the data is in /')
    assert kept.endswith('_leg_1')


@pytest.mark.core
def test_a_signal_right_after_the_start_ends_the_node_cleanly(start, connect):
    node = start()
    connect().until(state='waiting')
    node.end()
    assert (node.process.returncode, [x for x in node.lines if 'INFO' not in x]) == (0, [])


@pytest.mark.parametrize(('arguments', 'code', 'words'), [
    (['--help'], 0, 'usage: calibrator [--ros-args'), (['-h'], 0, '~/start_leg'),
    (['--help', '--ros-args', '-p', 'imu.grade:=tactical'], 0, 'config/calibrator.yaml'),
    (['--version'], 0, f'odocal_ros {__version__}\n'),
    (['--config', 'x.yaml'], 1, 'calibrator: --config is unknown: settings are ROS')])
def test_help_is_shown_and_an_unknown_argument_is_refused(arguments, code, words):
    ended = subprocess.run([*NODE, *arguments], capture_output=True, text=True, timeout=PATIENCE,
                           env=os.environ | {'PYTHONPATH': str(ROOT)}, check=False)
    assert ended.returncode == code
    assert words in ended.stdout + ended.stderr
    assert bool(ended.stdout) == (code == 0)


BAD_OVERRIDES = [
    ('leg.min_distance:=3', "'3' of type 'INTEGER', expecting type 'DOUBLE'; write it as a decim"),
    ('leg.min_distance:=0.5', 'leg.min_distance out of range'),
    ('gnss.min_status:=9', 'gnss.min_status out of range'),
    ('imu.gyro_noise:=5.0', 'imu.gyro_noise = 5: required: 0 to 1'),
    ('odometer.lever_arm:=[1.0, 2.0]', 'odometer.lever_arm: 2 values; required: 3'),
    ('reference.points:=[1.0, 2.0, 3.0]', 'reference.points has 3 values; required with marks'),
    ('method:=magic', "method: 'magic' is not one of auto, two_point"),
    ('odometer.type:=no_msgs/msg/Such', "'no_msgs/msg/Such' cannot be imported here"),
    ('result.valid:=7', 'result.valid: 7 is not of type bool'),
    ('result.scale_factor:=-0.5', 'result.scale_factor: its value is not positive; load the'),
    ('result.scale_factor_sigma:=-1.0', 'result.scale_factor: its sigma is negative'),
    ('result.yaw_mounting_angle:=.inf', 'result.yaw_mounting_angle: its value is not finite'),
    ('result.track_width:=0.0', 'result.track_width: its value is not positive'),
    ('result.legs:=-5', 'result.legs is -5; it must be 0 or more'),
    ('result.stamp:="a\\eb"', 'is not a date'),
    ('frames.base:=$(x)', 'frames.base: '),
    ('use_sim_time:=abc', 'use_sim_time'),
    ('qos_overrides./imu/data.subscription.reliability:=often', 'qos_overrides'),
    ('qos_overrides./fix.subscription.history:=7', 'qos_overrides'),
    ('qos_overrides./imu/data.subscription.depth:=-3', 'qos_overrides'),
    ('start_type_description_service:=7', 'start_type_description_service'),
    ('qos_overrides./odometer.subscription.depth:=x', 'qos_overrides'),
    ('qos_overrides./odometer.subscription.reliability:=often', 'qos_overrides'),
    ('qos_overrides./imu/data.subscription.depth:=x', "'x' is not a whole number"),
    ('leg.min_distance', "Couldn't parse parameter override rule")]
# one process for all: most of a start is the import
EACH = ('import sys\nfrom odocal_ros.live.node import main\nfor override in sys.argv[1:]:\n'
        '    sys.stderr.write(f"{main([\'\', \'--ros-args\', \'-p\', override])}\\n")')


def test_a_bad_override_gives_one_line_and_exit_code_1():
    overrides = [override for override, _ in BAD_OVERRIDES]
    finished = subprocess.run([sys.executable, '-c', EACH, *overrides], capture_output=True,
                              text=True,
                              timeout=PATIENCE, env=os.environ | {'PYTHONPATH': str(ROOT)},
                              check=True)
    lines = finished.stderr.splitlines()
    assert lines[1::2] == ['1'] * len(overrides), finished.stderr
    assert not finished.stdout
    for (override, words), line in zip(BAD_OVERRIDES, lines[::2], strict=True):
        assert line.startswith('calibrator: '), override
        assert words in line, override
        assert 'internal' not in line, override
    node = NodeProcess('-p', overrides[0])
    assert node.wait() == 1
    assert node.lines == lines[:1]


def test_valid_parameter_values_are_set_and_others_are_refused(start, connect):
    start({'reference.start': '[]', 'imu.nominal_yaw': '.nan'})
    client = connect()
    client.until(state='waiting')
    assert client.set(leg__min_distance=250.0).successful
    assert client.get('leg.min_distance') == [250.0]
    assert client.set(imu__gyro_noise=math.nan).successful
    assert client.set(reference__start=[40.0, 116.0, 50.0, 0.02]).successful
    # as ros2 param set sends an empty list: without type, read as a list of booleans
    empty = Parameter(name='reference.start', value=get_parameter_value('[]'))
    answer = answer_of(client.send(SetParameters, 'set_parameters',
                                   SetParameters.Request(parameters=[empty])))
    assert answer.results[0].successful, answer.results[0].reason
    assert client.set(reference__start=[40.0, 116.0, 50.0, 0.02]).successful
    for value, words in (({'leg__min_distance': 0.5}, 'out of range'),
                         ({'leg__min_distance': 3}, 'Wrong parameter type'),
                         ({'leg__min_distance': math.nan}, 'out of range'),
                         ({'imu__gyro_noise': 2.0}, 'required: 0 to 1'),
                         ({'reference__start': [40.0]}, '1 values; required: 4'),
                         ({'imu__grade': 'golden'}, 'not one of consumer'),
                         ({'odometer__type': 'std_msgs/msg/Int64'}, 'fixed at start-up'),
                         ({'result__valid': True}, 'set by the node')):
        result = client.set(**value)
        assert not result.successful, value
        assert words in result.reason
    assert client.get('leg.min_distance') == [250.0]


def test_the_shipped_file_is_accepted_and_unknown_parameters_are_reported(start, connect):
    node = start({'leg.min_distanse': 3.0, 'somebody.elses': 1, 'imu.colour': 'red',
                  'projection.kind': 'leg', 'result.gyro_bias_x': 1.0},
                 '--params-file', str(ROOT / 'config' / 'calibrator.yaml'))
    client = connect()
    client.until(state='waiting')
    assert 'no parameter leg.min_distanse: did you mean leg.min_distance?' in node.text
    for name in ('imu.colour', 'projection.kind'):     # the second is of an earlier version
        assert f'no parameter {name}. It is ignored.' in node.text
    assert 'somebody' not in node.text
    assert 'gyro_bias' not in node.text
    assert node.text.count('WARN') == 3
    names = [name for name in SETTINGS if name != 'output.directory']
    for name, value in zip(names, client.get(*names), strict=True):
        default = SETTINGS[name].default
        value = default if value is None else value
        same = list(value) == list(default) if isinstance(default, tuple) else (
            value == default or math.isnan(value) and math.isnan(default))
        assert same, name


def test_a_saved_result_is_restored_from_overrides(start, connect):
    start(RESULT | {'result.yaw_mounting_angle': 1, 'result.stamp': "'2026-01-02T03:04:05Z'"})
    client = connect()
    client.until(state='waiting', scale_factor='0.0213', yaw_mounting_angle_rad='1.0')
    assert client.get('result.legs', 'result.valid', 'result.stamp') == [
        2, True, '2026-01-02T03:04:05Z']
    status = client.status
    assert (status['legs'], status['restored']) == ('2', '2026-01-02T03:04:05Z')
    assert (status['scale_ok'], status['yaw_ok']) == ('no', 'no')        # no sigma came with them
    answer = client.call('stop_leg')
    assert answer.success
    assert 'restored result of 2026-01-02T03:04:05Z: scale factor 0.0213' in answer.message
    assert 'from 2 legs' in answer.message
    assert client.call('undo_leg').message.startswith('no leg to undo')
    assert client.call('reset').success
    client.until(restored='', legs='0', scale_factor='nan')
    assert not client.call('stop_leg').success


def test_a_leg_replaces_a_restored_result_and_undo_brings_it_back(play_to, sent):
    leg = play_to(sent, RESULT | SIGMA)
    client = leg.client
    client.until(restored='an unknown date', scale_ok='yes')
    leg.play(0, 5)
    assert ('including the result restored from an unknown '
            'date') in client.until(state='idle')['message']
    assert client.call('start_leg').success
    leg.play(5, 20)
    assert 'restored' not in leg.ended(20, 3).message
    assert client.until(restored='', legs='1')['scale_factor'] != '0.0213'
    assert client.call('undo_leg').success
    client.until(restored='an unknown date', legs='2', scale_factor='0.0213', scale_ok='yes')


def test_two_nodes_with_the_same_name_give_a_warning(start):
    nodes = [start(), start()]
    for node in nodes:
        wait_for(lambda node=node: 'another node is called /calibrator' in node.text,
                 'a warning about the other node')
        assert node.text.count('another node is called') == 1
    assert [node.end() for node in nodes] == [0, 0]


def test_the_result_of_another_vehicle_is_not_restored(start, connect):
    of_three = RESULT | SIGMA | {'result.vehicle': 'car 3'}
    refused = start(of_three | {'vehicle': 'car 4'})
    assert refused.wait() == 1
    line, = refused.lines
    assert "the result belongs to vehicle 'car 3', but this node to 'car 4'" in line
    start(of_three | {'vehicle': 'car 3'})
    assert 'of vehicle car 3' in connect().call('stop_leg').message
