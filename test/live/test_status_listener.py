# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

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
