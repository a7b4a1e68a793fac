# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The running estimate: updated in the worker every few seconds while a leg is recorded."""

from dataclasses import replace
from functools import partial
import threading
import time
from typing import Any, TypeAlias

from odocal_ros.data.leg import LegRecorder, SLOTS
from odocal_ros.data.samples import join, OdometerForm, take
from odocal_ros.forecast import leg_so_far
from odocal_ros.forecast.forecast import Abandoned, better, Forecast
from odocal_ros.forecast.foresight import forecast_of
from odocal_ros.forecast.smoother_forecast import planar_forecast
from odocal_ros.forecast.thinned_leg import ThinnedLeg
from odocal_ros.live.answers import one_line
from odocal_ros.live.console import PlainLog
from odocal_ros.live.worker import Worker
from odocal_ros.pipeline.planar_run import is_planar
from odocal_ros.reasons import Code, most_severe_first, Reason
from odocal_ros.settings.config import Config

# judgement: in IMU time, so that a fast replay has as many updates
LOOK_PERIOD_NS = 5 * 10**9
# tuned by benchmarks/live_load.py: share of one core for updates in the long run; the whole node
# then needs less than three fifths of the CPU of a typed subscriber of 455 messages a second
LOOK_SHARE = 1 / 60

Block: TypeAlias = tuple[str, Any]      # slot, rows
# forecast, faults, CPU time in s, error
Look: TypeAlias = tuple[Forecast | None, tuple[Reason, ...], float, Exception | None]


class RunningEstimate:
    """
    Keeps the newest forecast of the recorded leg, None without one.

    If a gap cuts the leg, each quantity is from the section that is better for it.

    The callback thread only collects blocks; cells and forecast are computed in the worker, one
    update at a time. ``end`` stops a running update at its next step, so that the result of the
    leg does not wait for it. Errors of an update are only logged.
    """

    def __init__(self, worker: Worker, log: PlainLog) -> None:
        self._worker, self._log = worker, log
        self._smoother = leg_so_far.SmootherSoFar()
        self._over = threading.Event()
        self._start_ns = self._due_ns = 0
        self._config = Config()
        self.end()

    def end(self) -> None:
        self._forget()
        self._thinned: ThinnedLeg | None = None
        self._gaps: leg_so_far.ImuGaps | None = None
        self._earlier: Forecast | None = None    # of earlier sections

    def _forget(self) -> None:
        """Stop a running update, and discard its data."""
        self._over.set()
        self._newest: Forecast | None = None     # of the current section
        self._before: LegRecorder | None = None
        self._faults: tuple[Reason, ...] = ()
        self._fresh: list[Block] = []
        self._looking = self._warm = False
        self._pause_until = 0.0

    def begin(self, recorder: LegRecorder, start_ns: int, config: Config) -> None:
        """Watch a leg that starts at a mark; ``recorder`` has the samples so far."""
        self.end()
        self._config, self._before = config, recorder
        self._look_from(start_ns, recorder.form)
        self._gaps = leg_so_far.ImuGaps(start_ns, config.leg.max_gap)
        self._gaps.feed(recorder.rows('imu'))      # leg.automatic sets marks in the past

    @property
    def forecast(self) -> Forecast | None:
        return better(self._earlier, self._newest)

    def _look_from(self, start_ns: int, form: OdometerForm) -> None:
        """Start a new section at a stamp."""
        self._over, self._start_ns = threading.Event(), start_ns
        self._thinned, self._smoother = ThinnedLeg(form), leg_so_far.SmootherSoFar()
        self._due_ns = start_ns + LOOK_PERIOD_NS

    def feed(self, slot: str, block: Any) -> None:
        """Store the rows of a received block that have a plausible stamp."""
        if self._thinned is None:
            return
        if slot == 'imu' and self._gaps is not None and (again_ns := self._gaps.feed(block)):
            self._earlier = self.forecast
            self._forget()
            self._look_from(again_ns, self._thinned.form)
            block = take(block, block.stamp_ns >= again_ns)
        self._fresh.append((slot, block))

    def faults(self, silent_s: float = 0.0) -> tuple[Reason, ...]:
        """
        Return the problems of the leg so far, one reason per code, the most severe first.

        silent_s : time from the last IMU message to the newest of all, s.
        """
        if self._gaps is None:
            return ()
        cut = [Reason(Code.LEG_CUT, f'{r.text}: the leg is cut there; values are those of the '
                      'better section') for r in self._gaps.reasons(silent_s)]
        seen = (*cut, *self._faults, *(self._newest.faults if self._newest else ()))
        first = {r.code: r for r in reversed(seen)}
        return tuple(most_severe_first(first.values()))

    def look(self, newest_ns: int, distance_m: float = 0.0) -> None:
        """Submit an update of the leg to a stamp, with its length, m, to the worker if due."""
        if (self._thinned is None or self._looking or newest_ns < self._due_ns
                or time.monotonic() < self._pause_until):
            return
        self._due_ns, self._looking = newest_ns + LOOK_PERIOD_NS, True
        before, self._before = self._before, None
        fresh, self._fresh = self._fresh, []
        self._worker.submit(
            partial(_look, self._thinned, before, fresh, self._start_ns, self._config, self._over,
                    self._smoother),
            partial(self._take, self._over, distance_m))

    def _take(self, over: threading.Event, distance_m: float, look: Look | None,
              error: Exception | None) -> None:
        if over.is_set():
            return
        self._looking = False
        newest, self._faults, seconds, failure = look or (None, (), 0.0, error)
        self._newest = newest and replace(newest, distance_m=distance_m)
        # the first update loads the pre-roll and modules, a one-time cost
        self._pause_until = time.monotonic() + seconds / LOOK_SHARE if self._warm else 0.0
        self._warm = True
        if failure is not None:
            self._log.debug(f'no forecast for the leg: {one_line(failure)}')


def _look(thinned: ThinnedLeg, before: LegRecorder | None, fresh: list[Block], start_ns: int,
          config: Config, over: threading.Event, smoother: leg_so_far.SmootherSoFar,
          ) -> Look:
    """Return forecast, faults, CPU time in s, and the error; runs in the worker."""
    begin = time.thread_time()
    forecast: Forecast | None = None
    found: tuple[Reason, ...] = ()
    failure: Exception | None = None
    try:
        _bring_up_to_date(thinned, before, fresh, over)
        leg = thinned.leg(start_ns)
        if is_planar(leg, config):
            forecast = planar_forecast(leg, config, lambda: not over.is_set())
        else:
            found = leg_so_far.faults_in_cells(leg, config)
            forecast = forecast_of(leg, thinned.fix_rate(), config, lambda: not over.is_set(),
                                   smoother)
    except Exception as error:  # an error of the running estimate does not end the leg
        failure = error
    finally:
        leg_so_far.screened_in_cells.cache_clear()      # no later update uses this leg
    # without the time of cold starts, which become rare as a leg grows
    return forecast, found, time.thread_time() - begin - smoother.once_s, failure


def _bring_up_to_date(thinned: ThinnedLeg, before: LegRecorder | None, fresh: list[Block],
                      over: threading.Event) -> None:
    for slot in (slot for slot in SLOTS if slot != 'imu_other'):
        if over.is_set():
            raise Abandoned
        blocks = [before.rows(slot)] if before is not None else []
        blocks += [block for name, block in fresh if name == slot]
        blocks = [block for block in blocks if len(block.stamp_ns)]
        if blocks:
            thinned.feed(slot, join(blocks))
