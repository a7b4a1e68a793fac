# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
One input topic of a node, from the search for its publishers to samples.

In: the name of the input and the messages of its topic. Out: blocks of samples, the health of the
topic, and the reason as text if it cannot be used.
"""

from collections.abc import Callable, Sequence
import difflib
from functools import partial
import time
from typing import Any

import numpy as np
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.serialization import deserialize_message
from rclpy.topic_endpoint_info import TopicEndpointInfo

from odocal_ros.data.inputs import EXTERNAL_SLOTS, INPUTS
from odocal_ros.data.samples import FixSamples, Reading
from odocal_ros.errors import BadData, OdocalError
from odocal_ros.live.health import Health
from odocal_ros.live.journal_writer import ALWAYS_NS
from odocal_ros.live.messages import message_class, MessageQueue
from odocal_ros.messages.decode import make_reader, Reader
from odocal_ros.messages.message_fields import Pairs, TRANSFORMS
from odocal_ros.messages.odometer_types import TYPES
from odocal_ros.messages.transforms import STATIC, StaticReader, TransformReader
from odocal_ros.output.value_text import counted
from odocal_ros.safe_io.text_formats import error_text, one_line
from odocal_ros.settings.config import Config

# judgement: number of suggested topics; minimum similarity of names by difflib, 1 is equal
MAX_SUGGESTIONS, NAME_SIMILARITY = 2, 0.4
SEARCH_PERIOD_S = 1.0     # judgement: between two searches for publishers
HEALTH_ROWS = 20       # judgement: readings per update of the health
STATIC_DEPTH = 100     # judgement: queue, one message per publisher of static transforms
# method of a reader: serialised messages, send times, ns, deserialiser -> (slot, rows) pairs
ReadMethod = Callable[[list[bytes], list[int], Callable[[bytes], Any]], Sequence[tuple[str, Any]]]
QOS_NAMES = {ReliabilityPolicy.RELIABLE: 'reliable', ReliabilityPolicy.BEST_EFFORT: 'best effort'}


class StaticTransforms:
    """The topic of static transforms of a TF reference, sent once and kept in every journal."""

    slot, msgtype, newest_ns = 'fix_static', TRANSFORMS, ALWAYS_NS

    def __init__(self, node: Node, moving_topic: str, kind: type, reader: StaticReader) -> None:
        self.topic = moving_topic + STATIC
        self._reader = reader
        self._deserialize = partial(deserialize_message, message_type=kind)
        self._queue = MessageQueue(node)
        self._queue.subscribe(kind, self.topic, QoSProfile(
            history=HistoryPolicy.KEEP_LAST, depth=STATIC_DEPTH,
            reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL))

    def take(self) -> tuple[list[bytes], list[int]]:
        """Return the messages since the last call, and their send times, ns."""
        self._queue.follow_clock()
        return self._queue.take()[:2]

    def decode(self, raws: list[bytes], sent_ns: list[int]) -> Pairs:
        """Return the positions that could not be computed without these transforms."""
        return self._reader.rows(raws, sent_ns, self._deserialize)


class Input:
    """
    One topic, from raw messages to blocks of samples.

    slot : name of the input, such as imu or fix.   allowed : accepted message types; empty: all
    that ``make_reader`` can read. The reader and the subscription exist once the type is known.
    """

    def __init__(self, node: Node, slot: str, allowed: tuple[str, ...]) -> None:
        self.slot, self.allowed_types = slot, allowed
        self.name = INPUTS[slot].topic
        self.topic = node.resolve_topic_name(self.name)
        self.msgtype = ''
        self.reader: Reader | None = None
        self.health = Health()
        self.error = ''      # cause if the topic or its last messages cannot be used
        self.is_plausible = np.empty(0, bool)    # mask of plausible stamps in the last block
        self.frame = ''        # frame_id of the IMU's messages, once one has come
        self.publishers: list[TopicEndpointInfo] = []
        self.suggestions: list[str] = []     # suggested topics if this one has no publisher
        self._failed_count = 0      # messages whose block raised an error
        # stamps and ``received_ns`` that are not in ``health`` yet
        self._new_stamps: list[Reading] = []
        self._configured_frame = ''     # imu.frame_id at the subscription
        self._node = node
        self._deserialize: Callable[[bytes], Any] | None = None
        self.queue = MessageQueue(node)
        self.static_transforms: StaticTransforms | None = None     # second topic of a TF reference

    def check_type(self, config: Config) -> None:
        """Raise OdocalError at start-up if the one allowed message type cannot be read."""
        if len(self.allowed_types) == 1:
            message_class(self.allowed_types[0])
            make_reader(self.slot, self.allowed_types[0], config)

    def search_publishers(self, config: Config) -> None:
        """Update clock and publishers; without messages also suggested topics and the type."""
        self.queue.follow_clock()
        self._update_health()
        self.publishers = self._node.get_publishers_info_by_topic(self.topic)
        self.suggestions = [] if self.publishers else self._suggested_topics()
        if self.reader is None:
            self._find_type(config)

    def _suggested_topics(self) -> list[str]:
        """Return published topics of a suitable type, the most similar name first."""
        usable = set(self.allowed_types or TYPES)
        own_topics = {p.topic_name for p in self._node.publishers}
        if self.slot == 'fix':      # most topics of these types contain the wheel odometry
            usable -= {'nav_msgs/msg/Odometry', TRANSFORMS}
        names = [name for name, types in self._node.get_topic_names_and_types()
                 if usable & set(types) and name not in own_topics
                 and self._node.count_publishers(name)]
        # many types can be an odometer: only topics with similar names
        return difflib.get_close_matches(self.topic, names, MAX_SUGGESTIONS,
                                         0.0 if self.allowed_types else NAME_SIMILARITY)

    def duplicate_publishers(self) -> str:
        """Return a warning if the topic has several publishers or IMUs, else an empty text."""
        frames = self.reader.frames if self.reader is not None else None
        if frames is not None and frames.other_frame and not self._configured_frame:
            return (f'{self.topic} contains messages of several IMUs (frame_id '
                    f'{one_line(frames.frame)!r} and '
                    f'{one_line(frames.other_frame)!r}): set imu.frame_id to the one to use')
        same_type = [p for p in self.publishers if p.topic_type == self.msgtype]
        if len(same_type) < 2:
            return ''
        # a node's name is discovered after its topics
        names_text = ', '.join(sorted('not known yet' if 'UNKNOWN' in p.node_name
                                      else f'{p.node_namespace.rstrip("/")}/{p.node_name}'
                                      for p in same_type))
        return (f'{self.topic} has {len(same_type)} publishers ({names_text}): their messages are '
                'mixed; stop all but one')

    def _find_type(self, config: Config) -> None:
        """Find the message type and subscribe; an error is logged and stored in ``error``."""
        published_types = [p.topic_type for p in self.publishers]
        types = self.allowed_types if len(self.allowed_types) == 1 else published_types
        try:
            for msgtype in types[:1]:
                self.subscribe(msgtype, config)
        except (OdocalError, ParameterException, InvalidQosOverridesError) as error:
            text = error_text(error)
            if text != self.error:
                self._node.get_logger().error(text)
            self.error = text

    def subscribe(self, msgtype: str, config: Config) -> None:
        """Create the reader and the subscription; raise OdocalError for a wrong type."""
        if self.allowed_types and msgtype not in self.allowed_types:
            raise BadData(f'{self.topic} carries {msgtype}, required: '
                          f'{" or ".join(self.allowed_types)}; remap {self.name} to another topic')
        kind = message_class(msgtype)
        reader = make_reader(self.slot, msgtype, config)
        self._configured_frame = config.imu.frame_id
        # wait for a publisher: increments need its QoS, and an optional topic may never have one,
        # but its subscription would cost CPU time
        if not self.publishers and (self.slot in EXTERNAL_SLOTS or self._has_increments(reader)):
            return
        offered = {p.qos_profile.reliability for p in self.publishers}
        is_reliable = self._has_increments(reader) and offered == {ReliabilityPolicy.RELIABLE}
        policy = ReliabilityPolicy.RELIABLE if is_reliable else ReliabilityPolicy.BEST_EFFORT
        qos = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=INPUTS[self.slot].queue,
                         reliability=policy)
        self._deserialize = partial(deserialize_message, message_type=kind)
        self.queue.subscribe(kind, self.name, qos)
        self.reader, self.msgtype, self.error = reader, msgtype, ''
        if isinstance(reader, TransformReader):
            self.static_transforms = StaticTransforms(self._node, self.topic, kind, reader.static)
        self._node.get_logger().info(
            f'{self.slot}: {msgtype} on {self.topic}, {QOS_NAMES[policy]}')

    @staticmethod
    def _has_increments(reader: Reader) -> bool:
        # a lost increment is lost travel, so such a topic uses reliable QoS if it is offered
        return reader.form is not None and reader.form.quantity == 'increment'

    def take(self) -> tuple[list[bytes], list[int]]:
        """Return the messages since the last call, and their send times, ns."""
        raws, sent_ns, numbers = self.queue.take()
        if raws:
            self.health.register_arrival(numbers, time.monotonic_ns())
        return raws, sent_ns

    def decode(self, raws: list[bytes], sent_ns: list[int],
               max_gap_s: float | None) -> list[tuple[str, Any]]:
        """
        Return (slot, block) pairs of messages; unreadable messages are counted.

        sent_ns : send times from ``take``, ``received_ns`` of the samples.   max_gap_s : longer
        steps between stamps are counted as gaps; None: steps above five intervals.
        """
        pairs = self._read(self.reader.rows if self.reader else None, raws, sent_ns)
        for slot, block in pairs:
            if slot == self.slot:
                self.is_plausible = np.array(self.health.check_stamps(
                    block.stamp_ns.tolist(), block.received_ns, max_gap_s), bool)
                if isinstance(block, FixSamples) and len(block.status):
                    self.health.fix_status = int(block.status[-1])
        return pairs

    def readings(self, raws: list[bytes], sent_ns: list[int]) -> list[tuple[str, list[Reading]]]:
        """Return (slot, readings) pairs of a few messages: as ``decode``, but faster."""
        pairs = self._read(self.reader.readings if self.reader else None, raws, sent_ns)
        for slot, rows in pairs:
            self._new_stamps += [row[:2] for row in rows] if slot == self.slot else []
        if len(self._new_stamps) > HEALTH_ROWS:
            self._update_health()
        return pairs

    def _update_health(self) -> None:
        """Add the readings since the last call to the health."""
        if self._new_stamps:
            stamps, received_ns = zip(*self._new_stamps, strict=True)
            self.health.check_stamps(list(stamps), received_ns)
            self._new_stamps = []

    def _read(self, read: ReadMethod | None, raws: list[bytes],
              sent_ns: list[int]) -> list[tuple[str, Any]]:
        """Return (slot, rows) pairs of messages by a function of the reader."""
        reader, deserialize = self.reader, self._deserialize
        if reader is None or deserialize is None or read is None:
            return []
        try:
            pairs = list(read(raws, sent_ns, deserialize))
            if self.slot == 'imu':
                self.frame = reader.frame or self.frame or deserialize(raws[0]).header.frame_id
        except Exception as error:  # no message may stop the node
            self._failed_count += len(raws)
            self.error = f'{self.topic}: {error_text(error)}'
            pairs = []
        self.health.unreadable_count = self._failed_count + reader.unreadable
        if not pairs and reader.error:
            self.error = f'{self.topic}: {reader.error}'
        return pairs

    @property
    def newest_ns(self) -> int:
        """Return the newest usable stamp on the sender's clock, ns."""
        return self.health.newest_ns

    def is_flowing(self) -> bool:
        return self.health.is_flowing(time.monotonic_ns())

    def missing_reason(self) -> str:
        """Return the reason why no usable message arrives, as text; empty if one does."""
        if self.is_flowing():
            return ''
        silent = self.health.silent_s(time.monotonic_ns())
        if self.error:
            return self.error
        if self.health.has_no_stamps:
            return f'{self.topic}: all header stamps are zero; check the driver'
        if not self.publishers:
            names = ' or '.join(self.suggestions)
            suggestions = f' (did you mean {names}?)' if names else ''
            return f'no {INPUTS[self.slot].label} on {self.topic}: 0 publishers found' + (
                f', silent for {silent:.0f} s; restart the driver'
                if self.health.last_arrival_ns else
                f'; start the driver or remap {self.name}{suggestions}')
        types = {p.topic_type for p in self.publishers}
        if self.msgtype and self.msgtype not in types:
            return (f'{self.topic} is published as {", ".join(sorted(types))}; required: '
                    f'{self.msgtype}. Remap {self.name}'
                    + ', or restart the node' * (len(self.allowed_types) != 1))
        offers = ', '.join(sorted({QOS_NAMES.get(p.qos_profile.reliability, 'unknown QoS')
                                   for p in self.publishers}))
        publishers_text = counted(len(self.publishers), 'publisher')
        if not self.health.last_arrival_ns:
            return (f'{self.topic}: {publishers_text} found ({offers}) but no message yet; check '
                    'the driver')
        return (f'no {INPUTS[self.slot].label} on {self.topic} for {silent:.0f} s: '
                f'{publishers_text} found; check the driver')
