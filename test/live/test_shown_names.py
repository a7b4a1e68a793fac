# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the shipped layouts name is what a running node has: topics, types, keys, services."""

import re

from bench import ROOT, wait_for
import pytest
from rclpy._rclpy_pybind11 import NodeNameNonExistentError
import shown

from odocal_ros.live.messages import message_class

INPUT_TYPES = {'/imu/data': 'sensor_msgs/msg/Imu', '/fix': 'sensor_msgs/msg/NavSatFix',
               '/odometer': 'std_msgs/msg/Int64'}       # as a pulse counter


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
