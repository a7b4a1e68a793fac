# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Message classes by name with their definitions, and queues of serialised messages.

Waking the executor for every message is nine tenths of a node's CPU load at 1 kHz. Messages
therefore stay in the middleware's queue: the executor skips the subscription, and ``take`` reads
the queue by ``take_message`` of rclpy's handle, as the executor itself does. This method is
undocumented: if it is missing or fails, the executor takes the messages, at a higher CPU load.
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
# names of types in .msg, by that in the classes of rclpy
MSG_NAMES = {'boolean': 'bool', 'octet': 'byte', 'float': 'float32', 'double': 'float64'}
# definition: of latched topics, publisher and subscriber
LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE,
                     durability=DurabilityPolicy.TRANSIENT_LOCAL)
# type of a field in the classes of rclpy: sequence<base<bound>, max_length>, or base<bound>[count]
FIELD_TYPE = re.compile(r'(sequence<)?([\w/]+)(<\d+>)?(?:, (\d+))?(>)?(\[\d+\])?')
Message: TypeAlias = tuple[bytes, dict[str, Any]]     # serialised, and the info of the middleware


def message_class(msgtype: str) -> Any:
    """Return the class of 'pkg/msg/Type', or raise BadConfig with the action."""
    match = MESSAGE_TYPE.fullmatch(msgtype)     # untrusted: it may be from the network
    try:
        package = match and PathFinder.find_spec(match['package'])      # does not import it
        folders = package.submodule_search_locations or () if package else ()
        if not (match and any(Path(folder, 'msg').is_dir() for folder in folders)):
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

    Constants and defaults are missing: the classes have none, and no message depends on them.
    """
    texts: dict[str, str] = {}
    _collect_texts(kind, '', texts)
    first, *others = texts.items()
    return first[1] + ''.join(f'{"=" * 80}\nMSG: {name}\n{text}' for name, text in others)


def _collect_texts(kind: Any, name: str, texts: dict[str, str]) -> None:
    """Add the text of a class, by its name, and those of all types that it uses."""
    fields = {field: _msg_types(rclpy_type)
              for field, rclpy_type in kind.get_fields_and_field_types().items()}
    texts[name] = ''.join(f'{msg_type} {field}\n' for field, (_, msg_type) in fields.items())
    for base, _ in fields.values():
        if '/' in base and base not in texts:
            package, _, leaf = base.rpartition('/')
            _collect_texts(getattr(importlib.import_module(f'{package}.msg'), leaf), base, texts)


def _msg_types(rclpy_type: str) -> tuple[str, str]:
    """Return base type and type of a field in .msg: of 'double[9]' float64 and float64[9]."""
    match = FIELD_TYPE.fullmatch(rclpy_type)
    if match is None:
        raise ValueError(f'{rclpy_type} is not a type of a message field')
    sequence, base, bound, max_length, _, count = match.groups()
    base = MSG_NAMES.get(base, base)
    text = base + (f'<={bound[1:-1]}' if bound else '')
    if sequence:
        return base, f'{text}[<={max_length}]' if max_length else f'{text}[]'
    return base, text + (count or '')


class Gate(MutuallyExclusiveCallbackGroup):
    """Callback group that the executor skips while ``is_open`` is False."""

    def __init__(self) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.is_open = False

    def can_execute(self, entity: object) -> bool:
        return self.is_open and bool(
            super().can_execute(entity))  # type: ignore[no-untyped-call]


class MessageQueue:
    """
    The messages of one topic since the last ``take``, in order of arrival.

    In simulated time the node's clock gives the send time, so that the executor takes messages.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._subscription: Subscription | None = None
        self._pending: list[Message] = []
        self._queue_depth = 0
        self._uses_executor = False   # take_message of this rclpy is not usable
        self.gate = Gate()
        self.follow_clock()

    def follow_clock(self) -> None:
        """Let the executor take the messages while the node uses simulated time."""
        clock = self._node.get_clock()
        self._is_simulated: bool = clock.ros_time_is_active  # type: ignore[attr-defined]
        self.gate.is_open = self._is_simulated or self._uses_executor

    def subscribe(self, kind: type, topic: str, qos: QoSProfile) -> None:
        self._queue_depth = qos.depth
        self._subscription = self._node.create_subscription(
            kind, topic, self._receive, qos,  # type: ignore[arg-type]
            raw=True, callback_group=self.gate,
            # each event handler costs time in every cycle of the executor
            event_callbacks=SubscriptionEventCallbacks(use_default_callbacks=False),
            qos_overriding_options=QoSOverridingOptions.with_default_policies())

    def take(self) -> tuple[list[bytes], list[int], list[int | None]]:
        """Return messages since the last call: serialised, send times (ns), sequence numbers."""
        if self._subscription is not None and not self._uses_executor:
            try:
                self._fetch(self._subscription)
            except (AttributeError, TypeError, ValueError) as error:
                self._uses_executor = self.gate.is_open = True
                self._node.get_logger().warning(
                    f'this rclpy has no usable take_message ({error}): the executor takes the '
                    'messages, at several times the CPU load')
        pending, self._pending = self._pending, []
        infos = [info for _, info in pending]
        return ([raw for raw, _ in pending],
                [info['source_timestamp'] or info['received_timestamp'] for info in infos],
                [info['publication_sequence_number'] for info in infos])

    def _fetch(self, subscription: Subscription) -> None:
        # all of the queue: one message at a time, as by the executor, would delay the IMU
        handle, kind = subscription.handle, subscription.msg_type
        with handle:
            for _ in range(self._queue_depth):
                message = handle.take_message(kind, True)
                if message is None:
                    return
                raw, info = message
                self._receive(raw, info)

    def _receive(self, raw: bytes, info: dict[str, Any]) -> None:
        if self._is_simulated:
            info['source_timestamp'] = self._node.get_clock().now().nanoseconds
        self._pending.append((raw, info))
