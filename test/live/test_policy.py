# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The SROS2 policy names what the node has in the graph: no more, no less."""

from contextlib import suppress
from xml.etree import ElementTree

from bench import ROOT, wait_for
import pytest
from rclpy.node import NodeNameNonExistentError

NAMES = {'publish': 'get_publisher_names_and_types_by_node',
         'subscribe': 'get_subscriber_names_and_types_by_node',
         'reply': 'get_service_names_and_types_by_node',
         'request': 'get_client_names_and_types_by_node'}
ALL = ('-p', 'gnss.use_velocity:=true', '-p', 'odometer.left:=topic', '-p',
       'odometer.right:=topic', '-p', 'use_sim_time:=true')


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
