# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Each ros2 line of README and docs, checked by name and done by a client on a driven leg."""

import math
import re
import shlex
from types import SimpleNamespace

from bench import answer_of, Client, NodeProcess, PATIENCE, wait_for
from launch_stand_in import of_python, ROOT
from pages import all_commands
from player import messages_of, part, Player, straight
import pytest
from test_shown_names import has_field, INPUT_TYPES
import yaml

from odocal_ros.live.messages import message_class
from odocal_ros.offline import cli

LINES = [(page, shlex.split(line)) for page, line in all_commands('ros2')]
FOREIGN = {'foxglove_bridge': 'a package of Foxglove, installed apart'}
TOPICS = {'imu': '/my_imu', 'odometer': '/ticks', 'fix': '/gps/fix'}
SPEED = 30.0
LEG = '/calibrator/start_leg', '/calibrator/stop_leg'


def of(*start):
    """Return what follows the first words in the lines that begin with them."""
    found = [words[1 + len(start):] for _, words in LINES if words[1:1 + len(start)] == [*start]]
    assert found, f'no line with ros2 {" ".join(start)}: take its test away'
    return found


@pytest.fixture(scope='module')
def driven(tmp_path_factory):
    """Start the node as the README does and drive a leg with the services as written there."""
    run = next(words for words in of('run') if words[1] == 'calibrator')     # the README's
    ros_args = run[run.index('--ros-args') + 1:]
    node = NodeProcess(*ros_args, '-p', f'output.directory:={tmp_path_factory.mktemp("out")}')
    client = Client()
    seen = SimpleNamespace(client=client, answers={})
    try:
        made = straight(imu_grade='industrial')
        types, sent = messages_of(made)
        seen.truth = made.truth.scale
        player = Player.connected(client, types, TOPICS)
        # others belong to runs of their own: test_mark_live.py, test_drive_pattern.py
        kinds = dict(of('service', 'call'))
        calls = [(name, kinds[name]) for name in LEG]
        # standing; driving to the next stop, and a little on: a leg ends with its last message
        stretches = [(45, 60, 60), (60, 117, 119)]
        for (name, kind), (begin, mark, end) in zip(calls, stretches, strict=True):
            player.play(part(sent, begin, mark), SPEED)
            future = ask(client.node, name, kind)
            player.play(part(sent, mark, end), SPEED)
            seen.answers[name] = client.result(future)
        client.until(leg_event='stopped')
        seen.graph = lambda: dict(client.node.get_topic_names_and_types())
        yield seen
    finally:
        seen.code = node.end()
        client.close()


def ask(node, name, kind):
    """Call a service as ``ros2 service call`` does, from its name and type as text."""
    package, folder, leaf = kind.split('/')
    service = getattr(__import__(f'{package}.{folder}', fromlist=[leaf]), leaf)
    client = node.create_client(service, name)
    assert client.wait_for_service(PATIENCE), f'no {name} of type {kind}'
    return client.call_async(service.Request())


def test_every_line_is_of_a_kind_that_is_tried_here():
    alone = ('run', 'launch', 'odocal')
    assert {(words[1],) if words[1] in alone else tuple(words[1:3])
            for _, words in LINES} == {*((word,) for word in alone), ('service', 'call'),
                                       ('topic', 'echo'), ('param', 'get'), ('param', 'set'),
                                       ('param', 'dump'), ('bag', 'record')}


def test_run_names_an_entry_point_of_the_package():
    entries = re.findall(r"'(\w+) = odocal_ros", (ROOT / 'setup.py').read_text())
    for package, executable, *_ in of('run'):
        assert package == 'odocal_ros'
        assert executable in entries


def test_odocal_lines_are_commands_of_odocal():
    for command, *options in of('odocal'):
        assert cli._parser({command}).parse_args([command, *options]).command == command


def test_launch_names_a_file_and_arguments_that_are_there():
    for package, name, *arguments in of('launch'):
        if package in FOREIGN:
            continue
        assert package == 'odocal_ros'
        given = dict(word.split(':=', 1) for word in arguments if word != '--show-args')
        declared, nodes = of_python(ROOT / 'launch' / name, given)
        assert set(given) <= set(declared)
        assert nodes


def test_the_calls_start_and_stop_a_leg(driven):
    assert tuple(driven.answers) == LEG
    assert all(answer.success for answer in driven.answers.values()), driven.answers
    assert 'scale factor' in driven.answers['/calibrator/stop_leg'].message


def test_what_is_echoed_comes(driven):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    node = driven.client.node
    for words in of('topic', 'echo'):
        topic = next(word for word in words if word.startswith('/'))
        if topic in INPUT_TYPES:          # what the operator's drivers send
            assert has_field(INPUT_TYPES[topic], words[words.index('--field') + 1].split('.'))
            continue
        kind, = wait_for(lambda topic=topic: driven.graph().get(topic), f'the type of {topic}')
        got = []
        # as ros2 topic echo does: latched where all that is offered is
        # messages may be here before discovery knows who sends them
        publishers = wait_for(
            lambda topic=topic: node.get_publishers_info_by_topic(topic), f'who sends {topic}')
        offered = {p.qos_profile.durability for p in publishers}
        latched = offered == {DurabilityPolicy.TRANSIENT_LOCAL}
        qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL if latched
                         else DurabilityPolicy.VOLATILE)
        subscription = node.create_subscription(message_class(kind), topic, got.append, qos)
        wait_for(lambda got=got: got, f'a message on {topic}')
        node.destroy_subscription(subscription)


def test_parameters_are_there_and_hold_the_result(driven):
    values = {}
    for name, parameter in of('param', 'get'):
        assert name == '/calibrator'
        values[parameter], = driven.client.get(parameter)
    assert values['result.valid'] is True
    off = values['result.scale_factor'] - driven.truth
    assert abs(off) < 4 * values['result.scale_factor_sigma']
    assert not math.isnan(off)


def test_what_is_set_is_taken(driven):
    for name, parameter, value in of('param', 'set'):
        assert name == '/calibrator'
        assert driven.client.set(**{parameter: yaml.safe_load(value)}).successful
        assert driven.client.get(parameter) == [yaml.safe_load(value)]


def test_a_dump_lists_the_settings_and_the_result(driven):
    from rcl_interfaces.srv import ListParameters
    (name,), = of('param', 'dump')
    assert name == '/calibrator'
    listed = answer_of(driven.client.send(ListParameters, 'list_parameters',
                                          ListParameters.Request())).result.names
    assert {'method', 'odometer.nominal_scale', 'result.scale_factor'} <= set(listed)


def test_what_is_recorded_is_published(driven):
    # a bag to inspect holds no leg yet, and needs no status
    for words, status in zip(of('bag', 'record'), (set(), {'/calibrator/status'}), strict=True):
        topics = [word for word in words if word.startswith('/')]
        assert set(topics) == {*TOPICS.values(), *status}
        wait_for(lambda topics=topics: set(topics) <= set(driven.graph()), 'the topics')
