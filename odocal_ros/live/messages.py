# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Message classes by name with their definitions, and messages that wait until they are taken.

They stay serialised in the middleware's queue: waking the executor for every message is nine
tenths of a node's CPU load at 1 kHz. The executor therefore skips the subscription, and ``take``
reads the queue by ``take_message`` of rclpy's handle, as the executor itself does. This method
is undocumented: if it is missing or behaves differently, the executor takes the messages from
then on. Only the CPU load changes.
"""

import importlib
from importlib.machinery import PathFinder
from pathlib import Path
import re
from typing import Any, TypeAlias

from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from odocal_ros.errors import BadConfig

MESSAGE_TYPE = re.compile(r'(?P<package>[a-z][a-z0-9_]*)/msg/(?P<name>[A-Z][A-Za-z0-9]*)')
NAMES = {'boolean': 'bool', 'octet': 'byte', 'float': 'float32', 'double': 'float64'}
# definition: of latched topics, publisher and subscriber
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
KIND = re.compile(r'(sequence<)?([\w/]+)(<\d+>)?(?:, (\d+))?(>)?(\[\d+\])?')
Message: TypeAlias = tuple[bytes, dict[str, Any]]     # serialised, and the info of the middleware


def message_class(msgtype: str) -> Any:
    """Return the class of 'pkg/msg/Type', or raise BadConfig with the action."""
    match = MESSAGE_TYPE.fullmatch(msgtype)     # untrusted: it may be from the network
    try:
        found = match and PathFinder.find_spec(match['package'])      # does not import it
        if not (match and found and any(
                Path(place, 'msg').is_dir() for place in found.submodule_search_locations or ())):
            raise ImportError
        return getattr(importlib.import_module(f'{match["package"]}.msg'), match['name'])
    except (ImportError, AttributeError):
        raise BadConfig(
            f'message type {msgtype!r} cannot be imported here: install its package or source '
            f"its workspace ('ros2 interface show {msgtype}' must work), or correct the type"
        ) from None


def definition_of(kind: type) -> str:
    """
    Return the definition of a message class for a bag: its .msg text and those of its fields.

    Constants and defaults are missing, as in the classes; serialised messages do not depend on
    them.
    """
    texts: dict[str, str] = {}
    _collect(kind, '', texts)
    first, *others = texts.items()
    return first[1] + ''.join(f'{"=" * 80}\nMSG: {name}\n{text}' for name, text in others)


def _collect(kind: Any, name: str, texts: dict[str, str]) -> None:
    """Add the texts of a class and of all types that it uses."""
    fields = {field: _in_msg(about) for field, about in kind.get_fields_and_field_types().items()}
    texts[name] = ''.join(f'{whole} {field}\n' for field, (_, whole) in fields.items())
    for base, _ in fields.values():
        if '/' in base and base not in texts:
            package, _, leaf = base.rpartition('/')
            _collect(getattr(importlib.import_module(f'{package}.msg'), leaf), base, texts)


def _in_msg(about: str) -> tuple[str, str]:
    """Return the base type and the field's type in .msg syntax."""
    match = KIND.fullmatch(about)
    if match is None:
        raise ValueError(f'a field of type {about}')
    sequence, base, bound, most, _, array = match.groups()
    base = NAMES.get(base, base)
    text = base + (f'<={bound[1:-1]}' if bound else '')
    if sequence:
        return base, f'{text}[<={most}]' if most else f'{text}[]'
    return base, text + (array or '')


class Gate(MutuallyExclusiveCallbackGroup):
    """A callback group that the executor skips while ``is_open`` is False."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.is_open = False

    def can_execute(self, entity: object) -> bool:
        return self.is_open and bool(
            super().can_execute(entity))  # type: ignore[no-untyped-call]


class WaitingMessages:
    """
    The messages of one topic, in order of arrival.

    In simulated time a message is stamped with the node's clock on arrival, so the executor takes
    it then, too.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscription: Subscription | None = None
        self._pending: list[Message] = []
        self._most = 0                # the depth of the queue
        self._carried = False         # taken by the executor, without take_message
        self.gate = Gate()
        self.follow_clock()

    def follow_clock(self) -> None:
        """Update whether the node uses simulated time."""
        clock = self._node.get_clock()
        self._simulated: bool = clock.ros_time_is_active  # type: ignore[attr-defined]
        self.gate.is_open = self._simulated or self._carried

    def subscribe(self, kind: type, topic: str, qos: QoSProfile) -> None:
        self._most = qos.depth
        self._subscription = self._node.create_subscription(
            kind, topic, self._receive, qos,  # type: ignore[arg-type]
            raw=True, callback_group=self.gate,
            # each event handler costs time in every cycle of the executor
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def take(self) -> tuple[list[bytes], list[int], list[int | None]]:
        """Return messages since the last call: serialised, send times (ns), sequence numbers."""
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
        # all of the queue: the executor takes one message of a topic at a time, and under load
        # the IMU would lag most
        handle, kind = subscription.handle, subscription.msg_type
        with handle:
            for _ in range(self._most):
                message = handle.take_message(kind, True)
                if message is None:
                    return
                raw, info = message
                self._receive(raw, info)

    def _receive(self, raw: bytes, info: dict[str, Any]) -> None:
        if self._simulated:
            info['source_timestamp'] = self._node.get_clock().now().nanoseconds
        self._pending.append((raw, info))
