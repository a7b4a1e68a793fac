# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Running estimate: values, sigmas and problems of the leg while it is driven."""

from dataclasses import dataclass, replace
from functools import partial
import threading
import time
from typing import Any, TypeAlias

from odocal_ros.data.leg import LegRecorder, SLOTS
from odocal_ros.data.samples import join, OdometerForm, take
from odocal_ros.forecast import leg_so_far
from odocal_ros.forecast.forecast import combine_sections, Forecast, LegEnded
from odocal_ros.forecast.leg_forecast import forecast_leg
from odocal_ros.forecast.smoother_forecast import planar_forecast
from odocal_ros.forecast.thinned_leg import ThinnedLeg
from odocal_ros.live.answers import error_line
from odocal_ros.live.console import PlainLog
from odocal_ros.live.worker import Worker
from odocal_ros.pipeline.planar_run import is_planar
from odocal_ros.reasons import Code, most_severe_first, Reason
from odocal_ros.settings.config import Config

UPDATE_PERIOD_NS = 5 * 10**9  # judgement: in IMU time, so that a fast replay has as many updates
# tuned by benchmarks/live_load.py: share of one core for updates in the long run; at 455 messages
# a second the node then needs less than 0.6 of the CPU of one with empty callbacks
UPDATE_CPU_SHARE = 1 / 60

Block: TypeAlias = tuple[str, Any]      # slot, rows


@dataclass
class UpdateResult:
    """Result of an update: forecast and faults of the leg so far, or the error."""

    forecast: Forecast | None = None
    faults: tuple[Reason, ...] = ()
    cpu_time_s: float = 0.0      # without cold starts of the smoother, rare in a long leg
    error: Exception | None = None


class RunningEstimate:
    """
    Keeps the newest forecast of the recorded leg, None without one.

    If a gap of the IMU cuts the leg, each quantity is from the section that is better for it.

    The callback thread only collects blocks; the worker computes, one update at a time. ``end``
    stops a running update at its next step, so that the result of the leg does not wait for it.
    Errors of an update are only logged.
    """

    def __init__(self, worker: Worker, log: PlainLog) -> None:
        self._worker, self._log = worker, log
        self._smoother = leg_so_far.SmootherSoFar()
        self._stop_event = threading.Event()
        self._start_ns = self._due_ns = 0
        self._config = Config()
        self.end()

    def end(self) -> None:
        self._forget()
        self._thinned_leg: ThinnedLeg | None = None
        self._imu_gaps: leg_so_far.ImuGaps | None = None
        self._earlier_forecast: Forecast | None = None    # best of the earlier sections

    def _forget(self) -> None:
        """Stop a running update, and discard its data."""
        self._stop_event.set()
        self._section_forecast: Forecast | None = None     # of the current section
        self._pre_roll: LegRecorder | None = None
        self._faults: tuple[Reason, ...] = ()
        self._new_blocks: list[Block] = []
        self._is_updating = self._is_loaded = False
        self._pause_until_s = 0.0      # steady clock

    def begin(self, recorder: LegRecorder, start_ns: int, config: Config) -> None:
        """Start with a leg from a mark, ns; ``recorder`` has the pre-roll, the samples so far."""
        self.end()
        self._config, self._pre_roll = config, recorder
        self._start_section(start_ns, recorder.form)
        self._imu_gaps = leg_so_far.ImuGaps(start_ns, config.leg.max_gap)
        self._imu_gaps.feed(recorder.rows('imu'))      # leg.automatic sets marks in the past

    @property
    def forecast(self) -> Forecast | None:
        return combine_sections(self._earlier_forecast, self._section_forecast)

    def _start_section(self, start_ns: int, form: OdometerForm) -> None:
        self._stop_event, self._start_ns = threading.Event(), start_ns
        self._thinned_leg, self._smoother = ThinnedLeg(form), leg_so_far.SmootherSoFar()
        self._due_ns = start_ns + UPDATE_PERIOD_NS

    def feed(self, slot: str, block: Any) -> None:
        """Store the rows of a received block that have a plausible stamp."""
        if self._thinned_leg is None:
            return
        # of the first sample after a gap
        resumed_ns = self._imu_gaps.feed(block) if slot == 'imu' and self._imu_gaps else 0
        if resumed_ns:
            self._earlier_forecast = self.forecast
            self._forget()
            self._start_section(resumed_ns, self._thinned_leg.form)
            block = take(block, block.stamp_ns >= resumed_ns)
        self._new_blocks.append((slot, block))

    def faults(self, silent_s: float = 0.0) -> tuple[Reason, ...]:
        """Return a reason for each problem, the worst first; silent_s : since an IMU message."""
        if self._imu_gaps is None:
            return ()
        cut = [Reason(Code.LEG_CUT, f'{r.text}: the leg is cut there into sections; each value '
                      'of the forecast is from the section with the smaller sigma')
               for r in self._imu_gaps.reasons(silent_s)]
        forecast = self._section_forecast
        reasons = (*cut, *self._faults, *(forecast.faults if forecast else ()))
        by_code = {r.code: r for r in reversed(reasons)}
        return tuple(most_severe_first(by_code.values()))

    def update(self, newest_ns: int, distance_m: float = 0.0) -> None:
        """Submit an update of the leg to a stamp, with its length, m, to the worker if due."""
        if (self._thinned_leg is None or self._is_updating or newest_ns < self._due_ns
                or time.monotonic() < self._pause_until_s):
            return
        self._due_ns, self._is_updating = newest_ns + UPDATE_PERIOD_NS, True
        pre_roll, self._pre_roll = self._pre_roll, None
        new_blocks, self._new_blocks = self._new_blocks, []
        self._worker.submit(
            partial(_compute_update, self._thinned_leg, pre_roll, new_blocks, self._start_ns,
                    self._config, self._stop_event, self._smoother),
            partial(self._receive_update, self._stop_event, distance_m))

    def _receive_update(self, stop_event: threading.Event, distance_m: float,
                        result: UpdateResult, _error: None) -> None:
        if stop_event.is_set():
            return
        self._is_updating = False
        self._faults = result.faults
        self._section_forecast = result.forecast and replace(
            result.forecast, distance_m=distance_m)
        if self._is_loaded:
            self._pause_until_s = time.monotonic() + result.cpu_time_s / UPDATE_CPU_SHARE
        self._is_loaded = True       # the first update loads pre-roll and modules: no pause
        if result.error is not None:
            self._log.debug(f'no forecast for the leg: {error_line(result.error)}')


def _compute_update(thinned: ThinnedLeg, pre_roll: LegRecorder | None, new_blocks: list[Block],
                    start_ns: int, config: Config, stop_event: threading.Event,
                    smoother: leg_so_far.SmootherSoFar) -> UpdateResult:
    """Return the result of an update; runs in the worker."""
    begin, result = time.thread_time(), UpdateResult()
    try:
        _add_rows(thinned, pre_roll, new_blocks, stop_event)
        leg = thinned.leg(start_ns)
        if is_planar(leg, config):
            result.forecast = planar_forecast(leg, config, lambda: not stop_event.is_set())
        else:
            result.faults = leg_so_far.find_thinned_faults(leg, config)
            result.forecast = forecast_leg(leg, thinned.fix_rate(), config,
                                           lambda: not stop_event.is_set(), smoother)
    except Exception as error:  # an error of the running estimate does not end the leg
        result.error = error
    leg_so_far.screen_thinned.cache_clear()      # no later update uses this leg
    result.cpu_time_s = time.thread_time() - begin - smoother.cold_start_cpu_s
    return result


def _add_rows(thinned: ThinnedLeg, pre_roll: LegRecorder | None, new_blocks: list[Block],
              stop_event: threading.Event) -> None:
    """Add the pre-roll, if any, and the new blocks to the thinned leg."""
    for slot in (slot for slot in SLOTS if slot != 'imu_other'):      # other IMUs
        if stop_event.is_set():
            raise LegEnded
        blocks = [pre_roll.rows(slot)] if pre_roll is not None else []
        blocks += [block for name, block in new_blocks if name == slot]
        blocks = [block for block in blocks if len(block.stamp_ns)]
        if blocks:
            thinned.feed(slot, join(blocks))
