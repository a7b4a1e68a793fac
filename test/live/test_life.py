# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Start and end of the node's process, its inputs, and its times."""

from dataclasses import replace
import math
import os
import signal
import subprocess
import sys

from bench import answer_of, NODE, NodeProcess, PATIENCE, ROOT, wait_for
from player import ended, messages_of, part, Player, recording, with_clock
import pytest
from rcl_interfaces.msg import Parameter
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import get_parameter_value

from odocal_ros import __version__
from odocal_ros.bagio import encode
from odocal_ros.settings.config import SETTINGS
from odocal_ros.sim.scenarios import SimOptions, simulate


@pytest.fixture(scope='module')
def sent():
    """Return a minute of slow rates out of a drive: enough to start a leg, light to play."""
    drive = simulate(SimOptions(duration=180.0, imu_rate=20.0, odometer_rate=10.0,
                                odometer='speed'))
    types, messages = messages_of(drive)
    return types, part(messages, 60, 120)


@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGTERM])
def test_signals_end_the_node_cleanly_even_in_a_leg(start, connect, sent, how):
    node, client = start(), connect()
    recording(client, sent, 0, 5, 20)
    assert node.end(how) == 0
    assert 'Traceback' not in node.text
    assert 'rror' not in node.text
    kept = node.lines[-1]
    assert kept.startswith('calibrator: leg 1 was not stopped: the data is in /')
    assert kept.endswith('_leg_1')


@pytest.mark.core
def test_a_signal_before_anything_ran_is_clean_too(start, connect):
    node = start()
    connect().until(state='waiting')
    node.end()
    assert (node.process.returncode, [x for x in node.lines if 'INFO' not in x]) == (0, [])


@pytest.mark.parametrize(('arguments', 'code', 'words'), [
    (['--help'], 0, 'usage: calibrator [--ros-args'), (['-h'], 0, '~/start_leg'),
    (['--help', '--ros-args', '-p', 'imu.grade:=tactical'], 0, 'config/calibrator.yaml'),
    (['--version'], 0, f'odocal_ros {__version__}\n'),
    (['--config', 'x.yaml'], 1, 'calibrator: --config is unknown: settings are ROS')])
def test_help_is_shown_and_what_is_no_ros_argument_is_refused(arguments, code, words):
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
    ('method:=magic', "method: 'magic' is not one of auto, two_point"),
    ('odometer.type:=no_msgs/msg/Such', "'no_msgs/msg/Such' cannot be imported here"),
    ('result.valid:=7', 'result.valid: 7 is not of type bool'),
    ('result.scale_factor:=-0.5', 'result.scale_factor: its value is not positive; use the file'),
    ('result.scale_factor_sigma:=-1.0', 'result.scale_factor: its sigma is negative'),
    ('result.yaw_mounting_angle:=.inf', 'result.yaw_mounting_angle: its value is not finite'),
    ('result.track_width:=0.0', 'result.track_width: its value is not positive'),
    ('result.legs:=-5', 'result.legs: -5 is not a number of legs'),
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


def test_a_bad_override_is_one_line_and_exit_1():
    overrides = [override for override, _ in BAD_OVERRIDES]
    said = subprocess.run([sys.executable, '-c', EACH, *overrides], capture_output=True, text=True,
                          timeout=PATIENCE, env=os.environ | {'PYTHONPATH': str(ROOT)}, check=True)
    lines = said.stderr.splitlines()
    assert lines[1::2] == ['1'] * len(overrides), said.stderr
    assert not said.stdout
    for (override, words), line in zip(BAD_OVERRIDES, lines[::2], strict=True):
        assert line.startswith('calibrator: '), override
        assert words in line, override
        assert 'internal' not in line, override
    node = NodeProcess('-p', overrides[0])
    assert node.wait() == 1
    assert node.lines == lines[:1]


def test_parameters_take_good_values_and_refuse_bad_ones(start, connect):
    start('-p', 'reference.start:=[]', '-p', 'imu.nominal_yaw:=.nan')
    client = connect()
    client.until(state='waiting')
    assert client.set(leg__min_distance=250.0).successful
    assert client.get('leg.min_distance') == [250.0]
    assert client.set(imu__gyro_noise=math.nan).successful
    assert client.set(reference__start=[40.0, 116.0, 50.0, 0.02]).successful
    # as ros2 param set sends an empty list: of no type, which becomes one of booleans
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


def test_the_shipped_file_is_taken_as_it_is_and_other_parameters_are_named(start, connect):
    node = start('--params-file', str(ROOT / 'config' / 'calibrator.yaml'), '-p',
                 'leg.min_distanse:=3.0', '-p', 'somebody.elses:=1', '-p', 'imu.colour:=red',
                 '-p', 'result.gyro_bias_x:=1.0')
    client = connect()
    client.until(state='waiting')
    assert 'no parameter leg.min_distanse: did you mean leg.min_distance?' in node.text
    assert 'no parameter imu.colour. It is ignored.' in node.text
    assert 'somebody' not in node.text
    assert 'gyro_bias' not in node.text
    assert node.text.count('WARN') == 2
    names = [name for name in SETTINGS if name != 'output.directory']
    for name, value in zip(names, client.get(*names), strict=True):
        default = SETTINGS[name].default
        value = default if value is None else value
        same = list(value) == list(default) if isinstance(default, tuple) else (
            value == default or math.isnan(value) and math.isnan(default))
        assert same, name


def test_messages_that_cannot_be_read_are_said(start, connect):
    from std_msgs.msg import Int32MultiArray
    start('-p', 'odometer.field:=data[3]')
    client = connect()
    publisher = client.node.create_publisher(Int32MultiArray, 'odometer', 10)
    wait_for(publisher.get_subscription_count, 'the subscription')

    def unreadable():
        publisher.publish(Int32MultiArray(data=[1, 2]))
        health = client.health.get('calibrator: odometer', {})
        return health.get('unreadable', '0') != '0' and health
    health = wait_for(unreadable, 'the count')
    assert health['message'].startswith('/odometer: ')
    assert 'data[3]' in client.until(state='waiting')['missing']


def test_a_saved_result_comes_back_as_overrides(start, connect):
    start('-p', 'result.scale_factor:=0.0213', '-p', 'result.legs:=2', '-p', 'result.valid:=true',
          '-p', 'result.yaw_mounting_angle:=1', '-p', "result.stamp:='2026-01-02T03:04:05Z'")
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


def test_a_restored_result_gives_way_to_a_leg_and_comes_back_when_it_is_undone(
        start, connect, sent):
    start('-p', 'result.scale_factor:=0.0213', '-p', 'result.scale_factor_sigma:=0.00001', '-p',
          'result.legs:=2', '-p', 'result.valid:=true')
    client = connect()
    client.until(restored='an unknown date', scale_ok='yes')
    player = Player.connected(client, sent[0])
    player.play(part(sent[1], 0, 5), 20)
    assert ('including the result restored from an unknown '
            'date') in client.until(state='idle')['message']
    assert client.call('start_leg').success
    player.play(part(sent[1], 5, 20), 20)
    assert 'restored' not in ended(client, player, part(sent[1], 20, 23), 20).message
    assert client.until(restored='', legs='1')['scale_factor'] != '0.0213'
    assert client.call('undo_leg').success
    client.until(restored='an unknown date', legs='2', scale_factor='0.0213', scale_ok='yes')


def test_an_input_that_never_spoke_is_an_error_in_the_diagnostics(start, connect, sent):
    start()
    client = connect()
    imu = wait_for(lambda: client.health.get('calibrator: imu'), 'diagnostics')
    assert imu['level'] == b'\x02'         # as diagnostic_updater has it; STALE is not ours to say
    assert imu['message'].startswith('no IMU on /imu/data')
    player = Player.connected(client, sent[0])
    with player.playing(sent[1], 10):
        good = wait_for(lambda: (h := client.health['calibrator: imu'])['level'] == b'\x00' and h,
                        'good diagnostics')
    assert float(good['Actual frequency (Hz)']) == pytest.approx(20, rel=0.05)
    assert good['Events since startup'] == good['messages'] != '0'
    wait_for(lambda: client.health['calibrator: imu']['level'] == b'\x02', 'the error of silence')


def test_namespace_and_remaps(start, connect, sent):
    start('-r', '__ns:=/car', '-r', 'imu/data:=/front/imu', '-p',
          'diagnostic_updater.use_fqn:=true')
    client = connect('/car/calibrator')
    player = Player.connected(client, sent[0], {
        'imu': '/front/imu', 'odometer': '/car/odometer', 'fix': '/car/fix'})
    player.play(part(sent[1], 0, 3), 20)
    client.until(state='idle')
    wait_for(lambda: '/car/calibrator: imu' in client.health, 'diagnostics with the full name')


def test_sim_time_and_its_jump_back(start, connect, sent):
    node = start('-p', 'use_sim_time:=true')
    client = connect()
    play = with_clock(client, Player(client.node, sent[0]))
    play(part(sent[1], 0, 10))
    client.until(state='idle')
    arrival = wait_for(lambda: client.health.get('calibrator: imu', {}).get('stamp_delay_s'),
                       'diagnostics')
    assert abs(float(arrival)) < 1.0   # on the sim clock; against the wall clock it is a year
    assert client.call('start_leg').success
    play(part(sent[1], 10, 14))
    play(part(sent[1], 2, 4))
    status = client.until(leg_event='cancelled')
    assert status['leg_id'] == '1'
    wait_for(lambda: 'leg 1 is cancelled' in node.text, 'the warning')
    play(part(sent[1], 4, 6))
    client.until(state='idle')         # and it goes on with what comes after the jump
    assert client.call('start_leg').success


def test_messages_that_queue_in_simulated_time_are_no_clocks_that_differ(start, connect):
    """The node stands still for a moment, as on a busy machine; simulation does not wait."""
    types, messages = messages_of(simulate(SimOptions(
        duration=180.0, imu_rate=100.0, odometer_rate=10.0, odometer='speed')))
    messages = part(messages, 40, 90)
    node = start('-p', 'use_sim_time:=true', '-p', 'publish.rate:=20.0')
    client = connect()
    play = with_clock(client, Player(client.node, types))
    play(part(messages, 0, 10), 0.001)
    client.until(state='idle')
    for first_s in (10, 20, 30):
        node.process.send_signal(signal.SIGSTOP)
        play(part(messages, first_s, first_s + 8), 0.0)
        node.process.send_signal(signal.SIGCONT)
        play(part(messages, first_s + 8, first_s + 10), 0.001)
    client.until(state='idle')
    assert not [s['hint'] for s in client.statuses if 'CLOCKS_DIFFER' in s['hint']]
    assert client.call('start_leg').success


def test_two_nodes_of_one_name_say_so(start):
    nodes = [start(), start()]
    for node in nodes:
        wait_for(lambda node=node: 'another node is called /calibrator' in node.text,
                 'a warning about the other node')
        assert node.text.count('another node is called') == 1
    assert [node.end() for node in nodes] == [0, 0]


def test_imu_stamps_that_start_anew_cancel_the_leg(start, connect, sent):
    node, client = start(), connect()
    player = recording(client, sent, 10, 20, 20)
    waiting = client.ask('stop_leg')
    client.until(state='computing')    # waits for samples beyond the mark, which never come
    player.play(part(sent[1], 0, 5), 20)
    client.until(leg_event='cancelled')
    answer = answer_of(waiting)
    assert not answer.success
    assert 'time jumped' in answer.message
    assert 'time jumped' in node.text


def test_a_forgotten_leg_is_stopped(start, connect, sent):
    node, client = start('-p', 'leg.max_duration:=10.0'), connect()
    player = recording(client, sent, 0, 5, 20)
    player.play(part(sent[1], 5, 20), 20)
    client.until(state='rejected', leg_event='stopped')   # 10 s are too short a leg
    assert 'it reached leg.max_duration, 10 s' in node.text
    answer = client.call('stop_leg')
    assert not answer.success
    assert 'LEG_TOO_SHORT' in answer.message


def test_the_odometer_type_is_taken_from_its_publisher(start, connect, sent):
    node, client = start(), connect()
    types = sent[0] | {'odometer': 'std_msgs/msg/Int64'}
    others = [one for one in sent[1] if one.slot != 'odometer']
    speeds = [one for one in sent[1] if one.slot == 'odometer']
    counts = encode.counter('odometer', simulate(SimOptions(
        duration=180.0, imu_rate=20.0, odometer_rate=10.0)).odometer).pack(slice(len(speeds)))
    counters = [replace(one, raw=row.tobytes()) for one, row in zip(speeds, counts, strict=True)]
    player = Player.connected(client, types)
    wait_for(lambda: 'odometer: std_msgs/msg/Int64 on /odometer, best effort' in node.text,
             'the log line')
    # header stamps of last year beside arrival stamps of now: no leg can be made of these
    with player.playing(sorted(others + counters, key=lambda one: one.stamp_ns), 2):
        status = client.until(state='idle', level=b'\x01')
        assert 'CLOCKS_DIFFER' in status['hint']
        answer = client.call('start_leg')
    assert not answer.success
    assert 'CLOCKS_DIFFER' in answer.message
    assert 'days ahead of' in answer.message       # no setting reaches so far
    assert 'exceeds the range of time_offset' in answer.message
    assert 'use_sim_time' in answer.message


@pytest.mark.parametrize('offer', ['reliable', 'best effort'])
def test_increments_are_asked_for_reliably_where_offered(start, connect, offer):
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from std_msgs.msg import Int32
    node = start('-p', 'odometer.quantity:=increment')
    client = connect()
    client.node.create_publisher(Int32, 'odometer', QoSProfile(
        depth=10, reliability=ReliabilityPolicy[offer.upper().replace(' ', '_')]))
    wait_for(lambda: f'Int32 on /odometer, {offer}' in node.text, f'a {offer} subscription')


def test_waiting_says_why(start, connect, sent):
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import Image, Imu, NavSatFix
    start()
    client = connect()
    client.until(state='waiting', hint='no IMU on /imu/data: 0 publishers found; start the '
                 'driver or remap imu/data')
    silent = client.node.create_publisher(
        Imu, 'imu/data', QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT))
    client.until(hint='/imu/data: 1 publisher found (best effort) but no message yet; check the '
                      'driver')
    client.node.create_publisher(Image, 'odometer', 1)
    wait_for(lambda: 'sensor_msgs/msg/Image' in client.status['missing'], 'the foreign type')
    client.node.create_publisher(Image, 'fix', 1)
    foreign = '/fix carries sensor_msgs/msg/Image, not sensor_msgs/msg/NavSatFix or geometry_msgs'
    wait_for(lambda: foreign in client.status['missing'], 'the foreign type of the fix')
    assert silent.topic_name == '/imu/data'
    assert NavSatFix.__name__ in client.status['missing']


def test_1_khz_arrives_whole_and_services_answer_meanwhile(start, connect):
    drive = simulate(SimOptions(duration=180.0, imu_rate=1000.0, odometer_rate=250.0,
                                fix_rate=25.0, odometer='speed'))
    types, messages = messages_of(drive)
    messages = part(messages, 60, 63)
    start()
    client = connect()
    player = Player.connected(client, types)
    player.play(part(messages, 0, 1), 1)
    assert client.call('start_leg').success
    player.play(part(messages, 1, 3), 1)
    assert client.get('leg.min_distance') == [100.0]
    for slot, name in (('imu', 'imu'), ('odometer', 'odometer'), ('fix', 'gnss')):
        count = str(sum(one.slot == slot for one in messages))
        health = wait_for(lambda name=name, count=count: (
            client.health.get(f'calibrator: {name}', {}).get('messages') == count
            and client.health[f'calibrator: {name}']), f'{count} messages of {name}')
        assert health['dropped'] == '0'


def test_each_node_has_a_folder_of_its_own_in_the_ros_home(tmp_path, monkeypatch):
    from odocal_ros.live.filing import output_root
    from odocal_ros.settings.config import Config, with_settings
    monkeypatch.setenv('ROS_HOME', str(tmp_path))
    assert output_root(Config(), '/calibrator') == tmp_path / 'odocal/calibrator'
    assert output_root(Config(), '/car4/calibrator') == tmp_path / 'odocal/car4/calibrator'
    monkeypatch.delenv('ROS_HOME')
    assert str(output_root(Config(), '/calibrator')) == os.path.expanduser(
        '~/.ros/odocal/calibrator')
    assert str(output_root(with_settings(Config(), {'output.directory': '/x'}), '/a')) == '/x'


def test_the_result_of_another_vehicle_is_not_restored(start, connect):
    of_three = ['-p', 'result.scale_factor:=0.02', '-p', 'result.scale_factor_sigma:=0.00001',
                '-p', 'result.valid:=true', '-p', 'result.vehicle:=car 3']
    refused = NodeProcess(*of_three, '-p', 'vehicle:=car 4')
    assert refused.wait() == 1
    line, = refused.lines
    assert "the result belongs to vehicle 'car 3', but this node to 'car 4'" in line
    start(*of_three, '-p', 'vehicle:=car 3')
    client = connect()
    assert 'of vehicle car 3' in client.call('stop_leg').message
