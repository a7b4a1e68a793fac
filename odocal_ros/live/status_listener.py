# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Listens to a calibrator's latched status and hint, which are untrusted."""

from collections.abc import Iterator
import math
import time

from diagnostic_msgs.msg import DiagnosticArray
import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import String

from odocal_ros.safe_io.text_formats import brief_line

MOST_VALUES = 500      # judgement: keys of a status that are read; a calibrator sends 100
# definition: of latched topics, publisher and subscriber
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
HINT_S = 0.1      # judgement: s in which a hint that was sent with a status arrives


class StatusListener:
    """A separate node that receives statuses; a context manager and an iterator over them."""

    def __init__(self, node_name: str, wait_s: float = math.inf) -> None:
        """End the iteration if no status has come for ``wait_s`` s."""
        self._until = time.monotonic() + wait_s
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node('odocal_watch', context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._status: DiagnosticArray | None = None
        self._hint: str | None = None
        name = f'/{node_name.strip("/")}'
        self._node.create_subscription(DiagnosticArray, f'{name}/status', self._receive, LATCHED)
        self._node.create_subscription(String, f'{name}/hint', self._receive_hint, LATCHED)

    def _receive(self, array: DiagnosticArray) -> None:
        if array.status:
            self._status = array

    def _receive_hint(self, message: String) -> None:
        self._hint = brief_line(message.data)

    def __enter__(self) -> 'StatusListener':
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()

    def __iter__(self) -> Iterator[tuple[bytes, dict[str, str], str]]:
        """Yield (level, key -> value, hint) of each status, until the context ends."""
        try:
            while self._context.ok() and time.monotonic() < self._until:
                self._executor.spin_once(timeout_sec=0.5)
                if self._status is not None:      # the hint sent with it may still be in its queue
                    self._executor.spin_once(timeout_sec=HINT_S)
                if self._status is not None and self._hint is not None:
                    status = self._status.status[0]
                    self._status, self._until = None, math.inf
                    yield (status.level, {brief_line(kv.key): brief_line(kv.value)
                                          for kv in status.values[:MOST_VALUES]}, self._hint)
        except ExternalShutdownException:
            return
