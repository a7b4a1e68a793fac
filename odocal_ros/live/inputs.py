# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The node's inputs: the topics that a configuration uses."""

from rclpy.node import Node

from odocal_ros.data.samples import OdometerForm
from odocal_ros.errors import BadUsage
from odocal_ros.live.topic_input import Input
from odocal_ros.messages.sensor_types import types_of
from odocal_ros.settings.config import Config

LOOK_AROUND_S = 1.0     # judgement: between two searches for publishers


class Inputs:
    """All topics of the node that a configuration uses."""

    def __init__(self, node: Node, config: Config) -> None:
        self._node, self._needs_imu = node, config.odometer.needs_imu
        self.by_slot: dict[str, Input] = {}
        for slot, allowed in _wanted(config).items():
            one = self.by_slot[slot] = Input(node, slot, allowed)
            one.check(config)
        self._check_reference()
        for one in self.by_slot.values():
            if len(one.allowed) == 1:  # one fixed type: errors are raised at the start
                one.subscribe(one.allowed[0], config)

    def _check_reference(self) -> None:
        """Refuse one topic as both odometer and reference: its scale would be exactly 1."""
        fix = self.by_slot['fix'].topic if 'fix' in self.by_slot else None
        for slot in ('odometer', 'odometer_right'):
            if slot in self.by_slot and self.by_slot[slot].topic == fix:
                raise BadUsage(f'{fix} is both {slot} and fix: an odometer cannot be calibrated '
                               'against itself; remap one of them to another topic')

    def update(self, config: Config) -> None:
        """Add the topics that the configuration uses, and search for publishers."""
        for slot, allowed in _wanted(config).items():
            if slot not in self.by_slot:
                self.by_slot[slot] = Input(self._node, slot, allowed)
        for one in self.by_slot.values():
            one.look()
            if not one.flowing():
                one.find(config)

    def required(self, config: Config) -> list[Input]:
        """Return the topics without which no leg can be started."""
        surveyed = config.reference.start and config.reference.end
        slots = ['imu'] * (not self.without_imu) + ['odometer']
        slots += ['odometer_right'] * config.odometer.own_topics
        slots += [] if surveyed else ['fix']
        slots += ['heading'] * (config.alignment.heading_source == 'heading_topic')
        return [self.by_slot[slot] for slot in slots if slot in self.by_slot]

    @property
    def without_imu(self) -> bool:
        """Return True if a leg needs no IMU, and none is published."""
        imu = self.by_slot['imu']
        return not (self._needs_imu or imu.publishers or imu.health.received_ns)

    @property
    def leading(self) -> Input:
        """Return the topic whose stamps set the marks: the IMU, or else the odometer."""
        imu = self.by_slot['imu']
        leads = self._needs_imu or imu.newest_ns
        return imu if leads else self.by_slot['odometer']

    def missing(self, config: Config) -> list[str]:
        """Return the causes that prevent a leg, one line per missing topic."""
        return [one.why() for one in self.required(config) if not one.flowing()]

    def begin_leg(self) -> None:
        """Start a new count of lost messages."""
        for one in self.by_slot.values():
            one.health.lost_before = one.health.lost

    def lost(self) -> dict[str, int]:
        """Return topic -> messages lost since the last leg began, or since the start."""
        return {one.topic: one.health.lost - one.health.lost_before
                for one in self.by_slot.values()}

    def doubled(self) -> list[str]:
        """Return the warnings on topics with several publishers."""
        return list(filter(None, (one.doubled() for one in self.by_slot.values())))

    @property
    def topics(self) -> dict[str, str]:
        """Return slot -> topic of the subscribed inputs; the IMU only if needed or published."""
        return {slot: one.topic for slot, one in self.by_slot.items()
                if one.reader is not None and not (slot == 'imu' and self.without_imu)}

    @property
    def form(self) -> OdometerForm | None:
        """Return the form of the odometer's values, None until its type is known."""
        reader = self.by_slot['odometer'].reader
        return reader.form if reader else None

    @property
    def form_right(self) -> OdometerForm | None:
        """Return the form of the right wheel's values where it has a topic of its own."""
        right = self.by_slot.get('odometer_right')
        return right.reader.form if right and right.reader else None


def _wanted(config: Config) -> dict[str, tuple[str, ...]]:
    """Return slot -> message types allowed (empty: any) for the topics a configuration needs."""
    by_marks = bool(config.reference.points)    # the positions are those of marks
    return {slot: types_of(slot, config.odometer) for slot in config.inputs
            if not (slot == 'fix' and by_marks)}
