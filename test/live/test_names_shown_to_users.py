# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Names in layouts, in the SROS2 policy and in ros2 commands of the docs exist in a node."""

from contextlib import suppress
import re
import shlex
from types import SimpleNamespace
from xml.etree import ElementTree

from bench import answer_of, PATIENCE, ROOT, wait_for
from launch_stand_in import of_python
import layout_names
from pages import all_commands
from player import messages_of, playing_to, straight, within
import pytest
from rclpy.node import NodeNameNonExistentError
from ros_bags import STORAGES
import yaml

from odocal_ros.live.messages import message_class
from odocal_ros.offline import cli

INPUT_TYPES = {'/imu/data': 'sensor_msgs/msg/Imu', '/fix': 'sensor_msgs/msg/NavSatFix',
               '/odometer': 'std_msgs/msg/Int64'}       # as a pulse counter
NAMES = {'publish': 'get_publisher_names_and_types_by_node',
         'subscribe': 'get_subscriber_names_and_types_by_node',
         'reply': 'get_service_names_and_types_by_node',
         'request': 'get_client_names_and_types_by_node'}
ALL = {'gnss.use_velocity': True, 'odometer.left': 'topic', 'odometer.right': 'topic',
       'use_sim_time': True}


def has_field(msgtype, fields):
    """Return True if a message type has a number at a path of fields."""
    kind = msgtype
    for field in fields:
        inner = message_class(kind).get_fields_and_field_types()
        if field not in inner:
            return False
        kind = '{}/msg/{}'.format(*inner[field].split('/')) if '/' in inner[field] \
            else inner[field]
    return kind in ('double', 'float', 'int64')


def keys_on_the_page():
    """Return the keys of the status that docs/watching.md lists."""
    page = (ROOT / 'docs' / 'watching.md').read_text(encoding='utf-8')
    table = page.partition('| keys |')[2].partition('\n\n')[0]
    rows = re.findall(r'^\| ([^|]+) \|', table, re.MULTILINE)
    return {name for row in rows for name in re.findall(r'`(\w+)`', row) if name != '_sigma'}


def test_the_node_has_the_topics_and_services_of_the_layouts(start, connect):
    start()
    client = connect()
    status = client.until(state='waiting')
    node = client.node

    def of_node(what):
        # a message may arrive before discovery knows the name of its sender
        with suppress(NodeNameNonExistentError):
            return dict(getattr(node, f'get_{what}_names_and_types_by_node')('calibrator', '/'))
        return {}
    wait_for(lambda: set(layout_names.published()) <= set(of_node('publisher')), 'all publishers')
    for topic, kind in layout_names.published().items():
        assert of_node('publisher')[topic] == [kind]
        # a node that has just ended may still be listed
        info, = wait_for(lambda topic=topic: len(
            found := node.get_publishers_info_by_topic(topic)) == 1 and found,
            f'the one publisher of {topic}')
        if topic != '/diagnostics':      # the display needs it latched
            assert info.qos_profile.durability.name == 'TRANSIENT_LOCAL'
    assert layout_names.status_keys() <= set(status)
    documented = keys_on_the_page()
    assert len(documented) > 40
    assert documented <= set(status)
    # all keys are documented; a sigma is described with its value
    rest = set(status) - documented - {'level', 'name', 'message'}
    assert not {key for key in rest if '_sigma' not in key}
    array = client.arrays[-1].status[0]
    assert layout_names.status_names() == {(array.hardware_id, array.name)}
    wait_for(lambda: set(layout_names.services()) <= set(of_node('service')), 'all services')
    for service in layout_names.services():
        assert of_node('service')[service] == ['std_srvs/srv/Trigger']
    for kind, names in allowed('/calibrator').items():      # a node conforms to the policy
        assert seen(client, kind) <= names


@pytest.mark.parametrize(('topic', 'fields'), sorted(layout_names.of_inputs()))
def test_the_inputs_have_the_fields_that_the_layouts_plot(topic, fields):
    assert has_field(INPUT_TYPES[topic], fields)
    assert not has_field(INPUT_TYPES[topic], (*fields[:-1], 'nothing'))


def allowed(enclave):
    """Return the names that a policy allows, by kind, as sros2 expands them."""
    policy = ElementTree.parse(ROOT / 'config' / 'sros2_policy.xml').getroot()
    profile, = policy.findall(f'enclaves/enclave[@path="{enclave}"]/profiles/profile')
    found = {kind: set() for kind in NAMES}
    for group in profile:
        (kind, rule), = group.attrib.items()
        assert rule == 'ALLOW'
        for one in group:
            name = one.text
            name = f'/{profile.attrib["node"]}{name[1:]}' if name.startswith('~') else name
            assert '*' not in name
            found[kind].add(name if name.startswith('/') else f'/{name}')
    return found


def seen(client, kind, node='calibrator'):
    """Return the names of a kind that have been discovered so far, none of an unknown node."""
    with suppress(NodeNameNonExistentError):
        return {name for name, _ in getattr(client.node, NAMES[kind])(node, '/')}
    return set()


def test_the_policy_equals_the_graph_of_a_node_with_all_inputs(start, connect):
    from geometry_msgs.msg import TwistStamped
    from sensor_msgs.msg import FluidPressure, Imu, NavSatFix
    from std_msgs.msg import Int64
    start(ALL)
    client = connect()
    for kind, name in ((Imu, 'heading'), (NavSatFix, 'fix'), (Int64, 'odometer'),
                       (Int64, 'odometer_right'),
                       (TwistStamped, 'fix_velocity'), (FluidPressure, 'pressure')):
        # found by their publishers
        client.node.create_publisher(kind, name, 10)
    client.until(state='waiting')
    expected = allowed('/calibrator')
    for kind, names in expected.items():
        wait_for(lambda kind=kind, names=names: seen(client, kind) == names,
                 f'{kind}: {sorted(names)}')


def test_the_operator_may_call_only_services_of_the_node():
    node, operator = allowed('/calibrator'), allowed('/calibrator_operator')
    assert operator['request'] <= node['reply']
    assert operator['subscribe'] <= node['publish']
    assert not operator['reply']


@pytest.mark.parametrize('name', ['config/sros2_policy.xml', 'package.xml'])
def test_security_names_existing_files(name):
    assert (ROOT / name).exists()
    assert name in (ROOT / 'SECURITY.md').read_text()


LINES = [(page, shlex.split(line)) for page, line in all_commands('ros2')]
FOREIGN = {'foxglove_bridge': 'a package of Foxglove, installed apart'}
TOPICS = {'imu': '/my_imu', 'odometer': '/ticks', 'fix': '/gps/fix'}
LEG = '/calibrator/start_leg', '/calibrator/stop_leg'


def of(*start):
    """Return the arguments of all ros2 commands that begin with these words."""
    found = [words[1 + len(start):] for _, words in LINES if words[1:1 + len(start)] == [*start]]
    assert found, f'no line with ros2 {" ".join(start)}: take its test away'
    return found


@pytest.fixture(scope='module')
def driven(tmp_path_factory):
    """Start the node as the README does and drive a leg with the services as written there."""
    run = next(words for words in of('run') if words[1] == 'calibrator')     # the README's
    made = straight(imu_grade='industrial')
    with playing_to(messages_of(made), {'output.directory': tmp_path_factory.mktemp('out')},
                    words=tuple(run[run.index('--ros-args') + 1:])) as leg:
        leg.names, client = TOPICS, leg.client
        seen = SimpleNamespace(client=client, answers={}, truth=made.truth.scale)
        # other services have their own tests: test_references_live.py, test_drive_pattern.py
        kinds = dict(of('service', 'call'))
        # standstill; drive to the next stop and 2 s more: a leg ends with its last message
        for name, (begin, mark, end) in zip(LEG, [(45, 60, 60), (60, 117, 119)], strict=True):
            leg.play(begin, mark)
            future = ask(client.node, name, kinds[name])
            leg.play(mark, end)
            seen.answers[name] = client.result(future)
        client.until(leg_event='stopped')
        seen.graph = lambda: dict(client.node.get_topic_names_and_types())
        yield seen


def ask(node, name, kind):
    """Call a service as ``ros2 service call`` does, from its name and type as text."""
    package, folder, leaf = kind.split('/')
    service = getattr(__import__(f'{package}.{folder}', fromlist=[leaf]), leaf)
    client = node.create_client(service, name)
    assert client.wait_for_service(PATIENCE), f'no {name} of type {kind}'
    return client.call_async(service.Request())


def test_every_ros2_command_of_the_docs_is_tested_here():
    alone = ('run', 'launch', 'odocal')
    assert {(words[1],) if words[1] in alone else tuple(words[1:3])
            for _, words in LINES} == {*((word,) for word in alone), ('service', 'call'),
                                       ('topic', 'echo'), ('param', 'get'), ('param', 'set'),
                                       ('param', 'dump'), ('bag', 'record'), ('bag', 'convert')}


def test_run_and_odocal_name_commands_of_the_package():
    entries = re.findall(r"'(\w+) = odocal_ros", (ROOT / 'setup.py').read_text())
    for package, executable, *_ in of('run'):
        assert package == 'odocal_ros'
        assert executable in entries
    for command, *options in of('odocal'):
        assert cli._parser(command).parse_args([command, *options]).command == command


def test_launch_names_an_existing_file_and_its_arguments():
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


def test_echoed_topics_have_messages(driven):
    from rclpy.qos import DurabilityPolicy, QoSProfile
    node = driven.client.node
    for words in of('topic', 'echo'):
        topic = next(word for word in words if word.startswith('/'))
        if topic in INPUT_TYPES:          # sent by the operator's drivers
            assert has_field(INPUT_TYPES[topic], words[words.index('--field') + 1].split('.'))
            continue
        kind, = wait_for(lambda topic=topic: driven.graph().get(topic), f'the type of {topic}')
        got = []
        # as ros2 topic echo does: latched if all publishers are
        # messages may arrive before discovery knows their senders
        publishers = wait_for(
            lambda topic=topic: node.get_publishers_info_by_topic(topic), f'who sends {topic}')
        offered = {p.qos_profile.durability for p in publishers}
        latched = offered == {DurabilityPolicy.TRANSIENT_LOCAL}
        qos = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL if latched
                         else DurabilityPolicy.VOLATILE)
        subscription = node.create_subscription(message_class(kind), topic, got.append, qos)
        wait_for(lambda got=got: got, f'a message on {topic}')
        node.destroy_subscription(subscription)


def test_parameters_exist_hold_the_result_and_can_be_set(driven):
    from rcl_interfaces.srv import ListParameters
    client, values = driven.client, {}
    for name, parameter in of('param', 'get'):
        assert name == '/calibrator'
        values[parameter], = client.get(parameter)
    assert values['result.valid'] is True
    assert within({'value': values['result.scale_factor'],
                   'sigma': values['result.scale_factor_sigma']}, driven.truth)
    for name, parameter, value in of('param', 'set'):
        assert name == '/calibrator'
        assert client.set(**{parameter: yaml.safe_load(value)}).successful
        assert client.get(parameter) == [yaml.safe_load(value)]
    assert of('param', 'dump') == [['/calibrator']]
    listed = answer_of(client.send(ListParameters, 'list_parameters',
                                   ListParameters.Request())).result.names
    assert {'method', 'odometer.nominal_scale', 'result.scale_factor'} <= set(listed)


def test_recorded_topics_are_published(driven):
    # a bag for odocal inspect has no leg yet and needs no status
    for words, status in zip(of('bag', 'record'), (set(), {'/calibrator/status'}), strict=True):
        topics = [word for word in words if word.startswith('/')]
        assert set(topics) == {*TOPICS.values(), *status}
        wait_for(lambda topics=topics: set(topics) <= set(driven.graph()), 'the topics')


def test_the_file_for_converting_names_a_format_that_replay_reads():
    (option_in, _, option_out, name), = of('bag', 'convert')
    page = (ROOT / 'docs/from_a_bag.md').read_text()
    bag, = yaml.safe_load(re.search(rf'{name} is `([^`]*)`', page)[1])['output_bags']
    assert (option_in, option_out) == ('-i', '-o')
    assert bag['storage_id'] in STORAGES
    assert bag['all_topics'] is True
