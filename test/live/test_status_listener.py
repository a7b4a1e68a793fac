# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A listener of the status shows the hint that belongs to it."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
import rclpy
from std_msgs.msg import String

from odocal_ros.live.status_listener import LATCHED, StatusListener


def test_a_status_comes_with_its_own_hint():
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('sender', context=context)
    status = node.create_publisher(DiagnosticArray, '/sent/status', LATCHED)
    hint = node.create_publisher(String, '/sent/hint', LATCHED)

    def send(number):
        hint.publish(String(data=str(number)))
        status.publish(DiagnosticArray(status=[DiagnosticStatus(
            values=[KeyValue(key='number', value=str(number))])]))
    with StatusListener('/sent') as listener:
        send(0)
        pairs = []
        for _, values, text in listener:
            pairs.append((values['number'], text))
            if len(pairs) == 20:
                break
            send(len(pairs))
    assert pairs == [(str(k), str(k)) for k in range(20)]
    node.destroy_node()
    context.try_shutdown()
