# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The topic of static transforms beside a TF reference, which each publisher sends once."""

from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

from odocal_ros.live.journal_writer import ALWAYS_NS
from odocal_ros.live.waiting_messages import WaitingMessages
from odocal_ros.messages.sensor_types import Pairs, TRANSFORMS
from odocal_ros.messages.transforms import STATIC, StaticReader

DEPTH = 100     # judgement: publishers of static transforms


class StaticTransforms:
    """Messages that hold at all times: each journal has all of them."""

    slot, msgtype, newest_ns = 'fix_static', TRANSFORMS, ALWAYS_NS

    def __init__(self, node: Node, moving_topic: str, kind: type, reader: StaticReader) -> None:
        self.topic = moving_topic + STATIC
        self._reader = reader
        self._deserialize: Callable[[bytes], Any] = partial(deserialize_message,
                                                            message_type=kind)
        self._waiting = WaitingMessages(node)
        self._waiting.subscribe(kind, self.topic, QoSProfile(
            history=HistoryPolicy.KEEP_LAST, depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL))

    def take(self) -> tuple[list[bytes], list[int]]:
        """Return the messages that came since the last call, and when they were sent, ns."""
        self._waiting.follow_clock()
        pending = self._waiting.take()
        return ([raw for raw, _ in pending],
                [i['source_timestamp'] or i['received_timestamp'] for _, i in pending])

    def decode(self, raws: list[bytes], sent_ns: list[int]) -> Pairs:
        """Return the positions that waited for these messages."""
        return self._reader.rows(raws, sent_ns, self._deserialize)
