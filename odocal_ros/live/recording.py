# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The receiving side of the node: inputs, recorder, and progress of the drive."""

from collections.abc import Callable
from dataclasses import replace
import time

from rclpy.clock import JumpThreshold
from rclpy.duration import Duration
from rclpy.node import Node

from odocal_ros.data.inputs import WHEELS
from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import FixSamples, LOCAL, Samples, take
from odocal_ros.forecast.ability import Received
from odocal_ros.forecast.progress import Progress
from odocal_ros.live.inputs import Inputs
from odocal_ros.live.topic_input import Input, StaticTransforms
from odocal_ros.settings.config import Config

CLOCK_BACK_S = 0.1         # judgement: a clock that steps back by more has jumped
PREROLL_MARGIN_S = 1.0     # judgement: kept beyond the pre-roll; whole blocks are dropped


class Recording:
    """
    Samples so far, in order of arrival.

    ``remember(input, raws, sent_ns)`` is called with every decoded batch of raw messages, in order
    of arrival, for the journal.
    """

    def __init__(self, node: Node, config: Config,
                 remember: Callable[[Input | StaticTransforms, list[bytes], list[int]], None]
                 ) -> None:
        self.inputs = Inputs(node, config)
        self.recorder = LegRecorder()
        self._remember = remember
        self.tap: Callable[[str, Samples], None] | None = None  # also receives every block
        self._clock = node.get_clock()
        self.progress = self._no_progress()
        self._clock_jumped = False
        self._jumps = self._clock.create_jump_callback(
            JumpThreshold(min_forward=None, min_backward=Duration(seconds=-CLOCK_BACK_S)),
            post_callback=self._note_jump)

    def _no_progress(self) -> Progress:
        return Progress(self._clock.ros_time_is_active)  # type: ignore[attr-defined]

    def pump(self, config: Config, found_scale: float) -> None:
        """Decode the messages since the last call, in blocks."""
        fix = self.inputs.by_slot.get('fix')
        static = fix.static if fix else None     # a TF reference has two topics
        if static is not None:
            raws, sent_ns = static.take()
            if raws:
                for slot, block in static.decode(raws, sent_ns):
                    self.recorder.feed(slot, block)
                self._remember(static, raws, sent_ns)
        for source in self.inputs.by_slot.values():
            raws, sent_ns = source.take()
            if not raws:
                continue
            max_gap_s = config.leg.max_gap if source.slot == 'imu' else None
            for slot, block in source.decode(raws, sent_ns, max_gap_s):
                self.recorder.feed(slot, block)
                if slot == 'imu_other':
                    continue
                if not source.sound.all():     # the recorder has all: the pipeline screens
                    block = take(block, source.sound)
                self._show(slot, block, config, found_scale)
            if not self.time_jumped:     # after a jump: no sample of an earlier leg
                self._remember(source, raws, sent_ns)

    def add_marks(self, block: FixSamples, config: Config) -> None:
        """Add the positions of a mark like those of a topic."""
        self.recorder.feed('fix', block)
        self._show('fix', block, config, 0.0)

    def _show(self, slot: str, block: Samples, config: Config, found_scale: float) -> None:
        self.progress.feed(slot, block, config, self.inputs.form, found_scale)
        if self.tap is not None:
            self.tap(slot, block)

    @property
    def local(self) -> bool:
        """Return True if the positions are in a local frame."""
        fix = self.inputs.by_slot.get('fix')
        return fix is None or fix.health.fix_status == LOCAL

    def forget(self, preroll_s: float, start_ns: int) -> None:
        """Drop samples older than the pre-roll of a leg from ``start_ns``, 0: from now."""
        # by the topic's own stamps: a topic on another clock must not grow without limit
        for source in self.inputs.by_slot.values():
            slots = (source.slot, *self._beside(source))
            if source.health.newest_ns:
                since_ns = min(source.health.newest_ns, start_ns or source.health.newest_ns)
                self.recorder.forget_before(
                    since_ns - round((preroll_s + PREROLL_MARGIN_S) * 1e9), slots)

    def _beside(self, source: Input) -> tuple[str, ...]:
        """Return the other slots that the messages of a topic fill: more wheels, other IMUs."""
        if source.slot == 'imu':
            return ('imu_other',)
        several = source.slot == 'odometer' and 'odometer_right' not in self.inputs.by_slot
        return WHEELS[1:] if several else ()

    @property
    def newest_ns(self) -> int:
        """Return the newest stamp of the leading topic, by which marks are set; 0 without one."""
        return self.inputs.leading.newest_ns

    def passed(self, mark_ns: int) -> bool:
        """Return True if every topic with messages has passed a mark."""
        newest = [one.health.newest_ns for one in self.inputs.by_slot.values()]
        return not any(0 < stamp_ns <= mark_ns for stamp_ns in newest)

    def snapshot(self) -> LegRecorder:
        """Return the samples so far, for another thread."""
        copy = self.recorder.snapshot()
        if self.inputs.form is not None:
            copy.form = self.inputs.form
        copy.form_right = self.inputs.form_right
        return copy

    @property
    def time_jumped(self) -> bool:
        """Return True if the clock or the stamps of the leading topic went back."""
        return self._clock_jumped or self.inputs.leading.health.jumped_back

    def restart(self) -> None:
        """Drop all samples, after a jump of time."""
        self._clock_jumped = False
        self.recorder.clear()
        self.progress = self._no_progress()
        for source in self.inputs.by_slot.values():
            source.take()
            source.health.forget()

    def two_wheels(self) -> bool:
        """Return True if there are two wheels, known as left and right."""
        form = self.inputs.form
        sent = [self.recorder.newest_ns(slot) > 0 for slot in WHEELS[:3]]
        return sent == [True, True, False] and (form is None or form.sides)

    def received_before(self, preroll_s: float) -> Received:
        """Return the samples so far that determine what a leg can estimate."""
        return replace(self.progress.received_before(preroll_s), two_wheels=self.two_wheels(),
                       imu=not self.inputs.without_imu)

    def rates_hz(self) -> dict[str, float]:
        """Return the rate of each topic by its stamps."""
        now_ns = time.monotonic_ns()
        return {slot: one.health.rate_hz(now_ns) for slot, one in self.inputs.by_slot.items()}

    def received(self) -> bool:
        """Return True if any message has arrived on any topic."""
        return any(one.health.received_ns for one in self.inputs.by_slot.values())

    def imu_silent_s(self) -> float:
        """Return the time from the last IMU message to the newest of all, s; 0 without an IMU."""
        received_ns = {slot: one.health.received_ns for slot, one in self.inputs.by_slot.items()}
        silent_ns = max(received_ns.values()) - received_ns['imu']
        return 0.0 if self.inputs.without_imu else max(0, silent_ns) * 1e-9

    def close(self) -> None:
        """Unregister from the clock."""
        self._jumps.unregister()

    def _note_jump(self, _jump: object) -> None:
        self._clock_jumped = True  # called from within the clock: only a flag is safe
