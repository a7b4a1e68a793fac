# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Reception of all input topics of the calibration node.

In: raw messages. Out: samples in the recorder of the leg, raw messages in the journal, and the
reasons why inputs are missing.
"""

from collections.abc import Callable
from dataclasses import replace
import time

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node

from odocal_ros.data.inputs import WHEELS
from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import FixSamples, LOCAL_STATUS, OdometerForm, Samples, take
from odocal_ros.errors import BadUsage
from odocal_ros.forecast.progress import Progress
from odocal_ros.forecast.quantities import Received
from odocal_ros.live.topic_input import Input, StaticTransforms
from odocal_ros.messages.message_fields import types_of
from odocal_ros.settings.config import Config

CLOCK_BACK_S = 0.1         # judgement: a clock that steps back by more has jumped
PREROLL_MARGIN_S = 1.0     # judgement: kept before the pre-roll, since whole blocks are dropped


class Inputs:
    """All topics of the node that a configuration uses."""

    def __init__(self, node: Node, config: Config) -> None:
        self._node, self._needs_imu = node, config.odometer.needs_imu
        self.by_slot: dict[str, Input] = {}
        for slot, allowed in _used_inputs(config).items():
            source = self.by_slot[slot] = Input(node, slot, allowed)
            source.check_type(config)
        self._check_reference()
        for source in self.by_slot.values():
            if len(source.allowed_types) == 1:  # one fixed type: errors are raised at the start
                source.subscribe(source.allowed_types[0], config)

    def _check_reference(self) -> None:
        """Refuse one topic as both odometer and reference: its scale would be exactly 1."""
        fix = self.by_slot['fix'].topic if 'fix' in self.by_slot else None
        for slot in ('odometer', 'odometer_right'):
            if slot in self.by_slot and self.by_slot[slot].topic == fix:
                raise BadUsage(f'topic {fix} is used as {slot} and as fix: an odometer cannot '
                               'be calibrated against itself; remap one of them to another topic')

    def update(self, config: Config) -> None:
        """Add the topics that the configuration uses, and search for publishers."""
        for slot, allowed in _used_inputs(config).items():
            if slot not in self.by_slot:
                self.by_slot[slot] = Input(self._node, slot, allowed)
        for source in self.by_slot.values():
            source.search_publishers(config)

    def required(self, config: Config) -> list[Input]:
        """Return the topics without which no leg can be started."""
        is_required = {
            'imu': not self.without_imu, 'odometer': True,
            'odometer_right': config.odometer.has_two_topics,
            'fix': not (config.reference.start and config.reference.end),
            'heading': config.alignment.heading_source == 'heading_topic'}
        return [self.by_slot[slot] for slot, required in is_required.items()
                if required and slot in self.by_slot]

    @property
    def without_imu(self) -> bool:
        """Return True if a leg needs no IMU, and none is published."""
        imu = self.by_slot['imu']
        return not (self._needs_imu or imu.publishers or imu.health.last_arrival_ns)

    @property
    def mark_input(self) -> Input:
        """Return the input whose stamps set the marks: the IMU, or else the odometer."""
        imu = self.by_slot['imu']
        return imu if self._needs_imu or imu.newest_ns else self.by_slot['odometer']

    def missing_reasons(self, config: Config) -> list[str]:
        """Return the causes that prevent a leg, one line per missing topic."""
        return [source.missing_reason() for source in self.required(config)
                if not source.is_flowing()]

    def begin_leg(self) -> None:
        """Start a new count of lost messages."""
        for source in self.by_slot.values():
            source.health.lost_before_leg = source.health.lost_count

    def lost_messages(self) -> dict[str, int]:
        """Return topic -> messages lost since the last leg began, or since the start."""
        return {source.topic: source.health.lost_count - source.health.lost_before_leg
                for source in self.by_slot.values()}

    def duplicate_publishers(self) -> list[str]:
        texts = (source.duplicate_publishers() for source in self.by_slot.values())
        return [text for text in texts if text]

    @property
    def topics(self) -> dict[str, str]:
        """Return slot -> topic of the subscribed inputs; the IMU only if needed or published."""
        return {slot: source.topic for slot, source in self.by_slot.items()
                if source.reader is not None and not (slot == 'imu' and self.without_imu)}

    def odometer_form(self, slot: str = 'odometer') -> OdometerForm | None:
        """Return the meaning of odometer values; None without the topic or before its type."""
        source = self.by_slot.get(slot)
        return source.reader.form if source and source.reader else None


def _used_inputs(config: Config) -> dict[str, tuple[str, ...]]:
    """Return slot -> message types allowed (empty: any) for the topics a configuration needs."""
    uses_marks = bool(config.reference.points)    # the positions are those of marks
    return {slot: types_of(slot, config.odometer) for slot in config.inputs
            if not (slot == 'fix' and uses_marks)}


class Recording:
    """
    The samples so far, in order of arrival.

    ``store_messages(input, raws, sent_ns)`` is called with every decoded batch of raw messages, in
    order of arrival, for the journal. ``block_listener(slot, block)``, if set, is called with each
    block of samples whose stamps are plausible.
    """

    def __init__(self, node: Node, config: Config,
                 store_messages: Callable[[Input | StaticTransforms, list[bytes], list[int]], None]
                 ) -> None:
        self.inputs = Inputs(node, config)
        self.recorder = LegRecorder()
        self._store_messages = store_messages
        self.block_listener: Callable[[str, Samples], None] | None = None
        self._clock = node.get_clock()
        self.progress = self._new_progress()
        self._clock_has_jumped = False
        self._jumps = self._clock.create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(seconds=-CLOCK_BACK_S)),
            post_callback=self._note_jump)

    def _new_progress(self) -> Progress:
        return Progress(self._clock.ros_time_is_active)  # type: ignore[attr-defined]

    def decode_new_messages(self, config: Config, known_scale: float) -> None:
        """Decode new messages; known_scale : scale factor for the distance, NaN without one."""
        fix = self.inputs.by_slot.get('fix')
        static = fix.static_transforms if fix else None     # a TF reference has two topics
        if static is not None:
            raws, sent_ns = static.take()
            if raws:
                for slot, block in static.decode(raws, sent_ns):
                    self.recorder.feed(slot, block)
                self._store_messages(static, raws, sent_ns)
        for source in self.inputs.by_slot.values():
            raws, sent_ns = source.take()
            if not raws:
                continue
            max_gap_s = config.leg.max_gap if source.slot == 'imu' else None
            for slot, block in source.decode(raws, sent_ns, max_gap_s):
                self.recorder.feed(slot, block)
                if slot == 'imu_other':
                    continue
                if not source.is_plausible.all():   # the recorder keeps all: the pipeline screens
                    block = take(block, source.is_plausible)
                self._distribute(slot, block, config, known_scale)
            if not self.has_time_jumped:     # after a jump: no sample of an earlier leg
                self._store_messages(source, raws, sent_ns)

    def add_marks(self, block: FixSamples, config: Config) -> None:
        """Add the positions of a mark like those of a topic."""
        self.recorder.feed('fix', block)
        self._distribute('fix', block, config, 0.0)

    def _distribute(self, slot: str, block: Samples, config: Config, known_scale: float) -> None:
        self.progress.feed(slot, block, config, self.inputs.odometer_form(), known_scale)
        if self.block_listener is not None:
            self.block_listener(slot, block)

    @property
    def is_local(self) -> bool:
        """Return True if positions are in a local frame, or from marks only."""
        fix = self.inputs.by_slot.get('fix')
        return fix is None or fix.health.fix_status == LOCAL_STATUS

    def drop_old_samples(self, preroll_s: float, start_ns: int) -> None:
        """Drop samples before the pre-roll of a leg that starts at ``start_ns``; 0: now."""
        # by the topic's own stamps: a topic on another clock must not grow without limit
        for source in self.inputs.by_slot.values():
            slots = (source.slot, *self._additional_slots(source))
            if source.health.newest_ns:
                since_ns = min(source.health.newest_ns, start_ns or source.health.newest_ns)
                self.recorder.forget_before(
                    since_ns - round((preroll_s + PREROLL_MARGIN_S) * 1e9), slots)

    def _additional_slots(self, source: Input) -> tuple[str, ...]:
        """Return the other slots that the messages of a topic fill: more wheels, other IMUs."""
        if source.slot == 'imu':
            return ('imu_other',)
        has_all_wheels = source.slot == 'odometer' and 'odometer_right' not in self.inputs.by_slot
        return WHEELS[1:] if has_all_wheels else ()

    @property
    def newest_ns(self) -> int:
        """Return the newest stamp of the leading topic, by which marks are set; 0 without one."""
        return self.inputs.mark_input.newest_ns

    def has_passed(self, mark_ns: int) -> bool:
        """Return True if every topic with messages has passed a mark."""
        newest = [source.health.newest_ns for source in self.inputs.by_slot.values()]
        return not any(0 < stamp_ns <= mark_ns for stamp_ns in newest)

    def snapshot(self) -> LegRecorder:
        """Return the samples so far, for another thread."""
        copy = self.recorder.snapshot()
        copy.form = self.inputs.odometer_form() or copy.form
        copy.form_right = self.inputs.odometer_form('odometer_right')
        return copy

    @property
    def has_time_jumped(self) -> bool:
        return self._clock_has_jumped or self.inputs.mark_input.health.has_jumped_back

    def restart(self) -> None:
        """Drop all samples, after a jump of time."""
        self._clock_has_jumped = False
        self.recorder.clear()
        self.progress = self._new_progress()
        for source in self.inputs.by_slot.values():
            source.take()
            source.health.reset_times()

    def two_wheels(self) -> bool:
        """Return True if there are two wheels, known as left and right."""
        form = self.inputs.odometer_form()
        first, second, third = (self.recorder.newest_ns(slot) > 0 for slot in WHEELS[:3])
        return first and second and not third and (form is None or form.sides_known)

    def received_before(self, preroll_s: float) -> Received:
        """Return the samples so far that determine what a leg can estimate."""
        return replace(self.progress.received_before(preroll_s), two_wheels=self.two_wheels(),
                       has_imu=not self.inputs.without_imu)

    def rates_hz(self) -> dict[str, float]:
        now_ns = time.monotonic_ns()
        return {slot: source.health.rate_hz(now_ns)
                for slot, source in self.inputs.by_slot.items()}

    def has_received(self) -> bool:
        return any(source.health.last_arrival_ns for source in self.inputs.by_slot.values())

    def imu_silent_s(self) -> float:
        """Return the time from the last IMU message to the newest of all, s; 0 without an IMU."""
        arrivals_ns = {slot: source.health.last_arrival_ns
                       for slot, source in self.inputs.by_slot.items()}
        silent_ns = max(arrivals_ns.values()) - arrivals_ns['imu']
        return 0.0 if self.inputs.without_imu else max(0, silent_ns) * 1e-9

    def close(self) -> None:
        self._jumps.unregister()

    def _note_jump(self, _jump: object) -> None:
        self._clock_has_jumped = True  # called from within the clock: only a flag is safe
