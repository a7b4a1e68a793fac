# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What layouts and the SROS2 policy name is what a node has: topics, types, keys, services."""

from contextlib import suppress
import re
from xml.etree import ElementTree

from bench import ROOT, wait_for
import pytest
from rclpy.node import NodeNameNonExistentError
import shown

from odocal_ros.live.messages import message_class

INPUT_TYPES = {'/imu/data': 'sensor_msgs/msg/Imu', '/fix': 'sensor_msgs/msg/NavSatFix',
               '/odometer': 'std_msgs/msg/Int64'}       # as a pulse counter
NAMES = {'publish': 'get_publisher_names_and_types_by_node',
         'subscribe': 'get_subscriber_names_and_types_by_node',
         'reply': 'get_service_names_and_types_by_node',
         'request': 'get_client_names_and_types_by_node'}
ALL = ('-p', 'gnss.use_velocity:=true', '-p', 'odometer.left:=topic', '-p',
       'odometer.right:=topic', '-p', 'use_sim_time:=true')


def has_field(msgtype, fields):
    """Return whether a message has a number at these fields."""
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


def test_the_node_publishes_and_serves_what_the_layouts_name(start, connect):
    start()
    client = connect()
    status = client.until(state='waiting')
    node = client.node

    def of_node(what):
        # a message may be here before discovery knows the name of who sent it
        try:
            return dict(getattr(node, f'get_{what}_names_and_types_by_node')('calibrator', '/'))
        except NodeNameNonExistentError:
            return {}

    def publishers():
        return of_node('publisher')
    wait_for(lambda: set(shown.published()) <= set(publishers()), 'all publishers')
    for topic, kind in shown.published().items():
        assert publishers()[topic] == [kind]
        # a node that has just ended may still be there
        info, = wait_for(lambda topic=topic: len(
            found := node.get_publishers_info_by_topic(topic)) == 1 and found,
            f'the one publisher of {topic}')
        if topic != '/diagnostics':      # the display asks for it: latched
            assert info.qos_profile.durability.name == 'TRANSIENT_LOCAL'
    assert shown.status_keys() <= set(status)
    told = keys_on_the_page()
    assert len(told) > 40
    assert told <= set(status)
    # and no key is kept from the reader; a sigma stands with its value
    rest = set(status) - told - {'level', 'name', 'message'}
    assert not {key for key in rest if '_sigma' not in key}
    array = client.arrays[-1].status[0]
    assert shown.status_names() == {(array.hardware_id, array.name)}
    wait_for(lambda: set(shown.services()) <= set(of_node('service')), 'all services')
    served = of_node('service')
    for service in shown.services():
        assert served[service] == ['std_srvs/srv/Trigger']


@pytest.mark.parametrize(('topic', 'fields'), sorted(shown.of_inputs()))
def test_the_inputs_have_the_fields_that_are_drawn(topic, fields):
    assert has_field(INPUT_TYPES[topic], fields)
    assert not has_field(INPUT_TYPES[topic], (*fields[:-1], 'nothing'))


def allowed(enclave):
    """Return what a policy allows: kind -> names, as sros2 expands them."""
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


def test_the_policy_is_the_graph_of_a_node_that_is_asked_for_everything(start, connect):
    from geometry_msgs.msg import TwistStamped
    from sensor_msgs.msg import FluidPressure, Imu, NavSatFix
    from std_msgs.msg import Int64
    start(*ALL)
    client = connect()
    for kind, name in ((Imu, 'heading'), (NavSatFix, 'fix'), (Int64, 'odometer'),
                       (Int64, 'odometer_right'),
                       (TwistStamped, 'fix_velocity'), (FluidPressure, 'pressure')):
        # found by their publishers
        client.node.create_publisher(kind, name, 10)
    client.until(state='waiting')
    wanted = allowed('/calibrator')
    for kind, names in wanted.items():
        wait_for(lambda kind=kind, names=names: seen(client, kind) == names,
                 f'{kind}: {sorted(names)}')


def test_an_ordinary_node_stays_within_it(start, connect):
    start()
    client = connect()
    client.until(state='waiting')
    wanted = allowed('/calibrator')
    for kind, names in wanted.items():
        if names:
            wait_for(lambda kind=kind: seen(client, kind), kind)
        assert seen(client, kind) <= names


def test_the_operator_may_ask_what_the_node_answers():
    node, operator = allowed('/calibrator'), allowed('/calibrator_operator')
    assert operator['request'] <= node['reply']
    assert operator['subscribe'] <= node['publish']
    assert not operator['reply']


@pytest.mark.parametrize('name', ['config/sros2_policy.xml', 'package.xml'])
def test_security_names_files_that_are_there(name):
    assert (ROOT / name).exists()
    assert name in (ROOT / 'SECURITY.md').read_text()
