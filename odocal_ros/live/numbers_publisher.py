# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Messages of a header and numbers, published serialised.

To set the fields of a message object and to serialise it costs many times as much as to copy the
numbers to where they lie.
"""

import struct
from typing import Any

from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.serialization import serialize_message

from odocal_ros.data.arrays import Floats
from odocal_ros.messages.cdr import layout_of


class NumbersPublisher:
    """Publishes copies of one message with another stamp and other numbers."""

    def __init__(self, node: Node, topic: str, message: Any) -> None:
        """
        Create the publisher.

        message : its header holds the frame; after its last string are only 64-bit floats.
        """
        raw = serialize_message(message)      # what follows the message is no part of it
        package, name = type(message).__module__.split('.')[0], type(message).__name__
        layout = layout_of(f'{package}/msg/{name}', raw)
        assert layout is not None
        self._raw = raw[:layout.size]
        self._publisher = node.create_publisher(
            type(message), topic, 10,
            event_callbacks=PublisherEventCallbacks(use_default_callbacks=False))

    def send(self, stamp_ns: int, numbers: Floats) -> None:
        """Publish with a stamp, ns, and all its floats in order: (n,)."""
        values = numbers.tobytes()
        stamp = struct.pack('<iI', *divmod(stamp_ns, 10**9))
        self._publisher.publish(self._raw[:4] + stamp + self._raw[12:-len(values)] + values)
