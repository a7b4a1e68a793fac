# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Messages that wait, serialised, in the middleware's queue until they are taken.

Waking the executor for every message is nine tenths of what a node costs at 1 kHz. So it is kept
away from the subscription, and ``take`` asks rclpy's handle for what waits by ``take_message``, as
the executor itself does. That is no documented part of rclpy: where it is missing, or answers in
another way, the executor takes the messages from then on. Only the CPU load changes.
"""

from typing import Any, TypeAlias

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

Message: TypeAlias = tuple[bytes, dict[str, Any]]     # serialised, and the info of the middleware


class Gate(MutuallyExclusiveCallbackGroup):
    """A callback group that the executor leaves alone while it is shut."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.is_open = False

    def can_execute(self, entity: object) -> bool:
        """Return True if the executor can wait for the entity."""
        return self.is_open and bool(
            super().can_execute(entity))  # type: ignore[no-untyped-call]


class WaitingMessages:
    """
    The messages of one topic, as they came.

    In simulated time a message is stamped with the node's clock as it arrives: the executor
    carries it then, too.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscription: Subscription | None = None
        self._pending: list[Message] = []
        self._most = 0                # the depth of the queue
        self._carried = False         # by the executor, for want of take_message
        self.gate = Gate()
        self.follow_clock()

    def follow_clock(self) -> None:
        """Note whether the node's time is a simulated one."""
        clock = self._node.get_clock()
        self._simulated: bool = clock.ros_time_is_active  # type: ignore[attr-defined]
        self.gate.is_open = self._simulated or self._carried

    def subscribe(self, kind: type, topic: str, qos: QoSProfile) -> None:
        """Begin to listen."""
        self._most = qos.depth
        self._subscription = self._node.create_subscription(
            kind, topic, self._receive, qos,  # type: ignore[arg-type]
            raw=True, callback_group=self.gate,
            # each event handler costs time in every turn of the executor
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def take(self) -> tuple[list[bytes], list[int], list[int | None]]:
        """Return the messages since the last call: serialised, when sent (ns), and numbers."""
        if self._subscription is not None and not self._carried:
            try:
                self._fetch(self._subscription)
            except (AttributeError, TypeError, ValueError) as error:
                self._carried = self.gate.is_open = True
                self._node.get_logger().warning(
                    f'this rclpy has no usable take_message ({error}): the executor takes the '
                    'messages, at several times the CPU load')
        pending, self._pending = self._pending, []
        infos = [info for _, info in pending]
        return ([raw for raw, _ in pending],
                [info['source_timestamp'] or info['received_timestamp'] for info in infos],
                [info['publication_sequence_number'] for info in infos])

    def _fetch(self, subscription: Subscription) -> None:
        """
        Take what waits in the middleware's queue.

        The executor takes one at a time of each topic, so that where it lags the IMU lags most.
        """
        handle, kind = subscription.handle, subscription.msg_type
        with handle:
            for _ in range(self._most):
                message = handle.take_message(kind, True)
                if message is None:
                    return
                raw, info = message
                self._receive(raw, info)

    def _receive(self, raw: bytes, info: dict[str, Any]) -> None:
        """Remember one message."""
        if self._simulated:
            info['source_timestamp'] = self._node.get_clock().now().nanoseconds
        self._pending.append((raw, info))
