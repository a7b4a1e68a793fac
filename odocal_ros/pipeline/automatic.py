# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Start and end of automatic legs (``leg.automatic``): one search for node and replay.

It only uses the stamps of the rows, so that a recording gives the legs of the node. A leg begins
where the vehicle starts to move, and ends at the first standstill after half of
``leg.automatic_minutes``, at any long one, or after these minutes, in motion: then the next one
begins at its end. A gap of the IMU that would reject a leg separates two legs.
"""

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.marginal_information import CarriedInformation
from odocal_ros.calib.result import LegResult
from odocal_ros.data.arrays import Ints
from odocal_ros.data.samples import OdometerForm, OdometerSamples, Samples
from odocal_ros.pipeline.combination import combine
from odocal_ros.reasons import Code, Reason, rejecting, Verdict
from odocal_ros.screening.odometer_rows import StepReader
from odocal_ros.settings.config import Config

LEG_END_REST_NS = 10 * 10**9    # judgement: standstill that ends a leg, for position and biases
PARKED_NS = 120 * 10**9         # judgement: a longer standstill ends a leg of any length
START_REST_NS = 10**9           # judgement: standstill before the first count of a start


@dataclass
class Span:
    """A leg; ``stop_ns`` is 0 while it is open."""

    start_ns: int
    stop_ns: int = 0


class LegSearch:
    """Search for legs in blocks of rows of any size; ``spans``: the legs, the open one last."""

    def __init__(self, config: Config) -> None:
        self._steps: StepReader | None = None
        self._rest_travel = 0.0      # odometer units, largest travel that is no motion
        self._standstill_ns = round(config.leg.standstill * 1e9)
        self._rest_ns = max(LEG_END_REST_NS, self._standstill_ns)
        self._longest_ns = round(config.leg.automatic_minutes * 60e9)
        self._max_gap_ns = round(config.leg.max_gap * 1e9)
        surveyed = config.reference.start and config.reference.end
        # first stamp of each topic that a leg needs, 0 before it
        self._first_ns = dict.fromkeys(('imu', 'odometer') + (() if surveyed else ('fix',)), 0)
        self.spans: deque[Span] = deque()
        max_waiting = 200_000    # odometer rows that wait for the IMU
        # stamp and travel of odometer rows
        self._waiting: deque[tuple[int, float]] = deque(maxlen=max_waiting)
        self._gaps: deque[tuple[int, int]] = deque()         # of the IMU: both edges
        self._imu_ns = 0              # newest stamp of the IMU
        self._travel = 0.0
        self._last_motion: tuple[int, float] | None = None   # stamp, travel
        self._newest_ns = 0           # newest odometer row evaluated
        self._from_ns = 0             # no leg begins before
        self._needs_rest = False      # the next leg begins after a standstill

    @property
    def open_span(self) -> Span | None:
        """Return the leg that has not ended."""
        return self.spans[-1] if self.spans and not self.spans[-1].stop_ns else None

    def feed(self, slot: str, block: Samples, form: OdometerForm | None = None) -> None:
        """Add unscreened rows; those of the odometer are ignored without form."""
        if slot not in self._first_ns or not len(block.stamp_ns):
            return
        self._first_ns[slot] = self._first_ns[slot] or int(block.stamp_ns[0])
        if slot == 'imu':
            self._add_imu_stamps(block.stamp_ns)
        elif isinstance(block, OdometerSamples) and slot == 'odometer' and form is not None:
            self._steps = self._steps or StepReader(form)
            self._rest_travel = self._steps.rest_travel
            steps, stamps, _ = self._steps.read(block)
            travel = self._travel + np.cumsum(steps)
            if len(travel):
                self._waiting.extend(zip(stamps.tolist(), travel.tolist(), strict=True))
                self._travel = float(travel[-1])
        self._evaluate()

    def restart(self, after_ns: int, at_rest: bool) -> None:
        """Remove the legs; the next begins after a stamp, at a start from rest or in motion."""
        self.spans.clear()
        self._from_ns, self._needs_rest = after_ns, at_rest

    def _add_imu_stamps(self, stamps: Ints) -> None:
        known = np.append(self._imu_ns or stamps[0], stamps[stamps > self._imu_ns])
        for k in np.flatnonzero(np.diff(known) > self._max_gap_ns):
            self._gaps.append((int(known[k]), int(known[k + 1])))
        self._imu_ns = int(known.max())

    def _evaluate(self) -> None:
        """Evaluate the odometer rows up to the newest IMU row."""
        if not all(self._first_ns.values()):
            return
        first_ns = max(self._first_ns.values())
        while self._waiting and self._waiting[0][0] <= self._imu_ns:
            stamp_ns, travel = self._waiting.popleft()
            if stamp_ns > self._newest_ns and stamp_ns >= first_ns:
                self._newest_ns = stamp_ns
                self._evaluate_row(stamp_ns, travel)

    def _evaluate_row(self, stamp_ns: int, travel: float) -> None:
        """Begin or end a leg by an odometer row."""
        while self._gaps and self._gaps[0][0] < stamp_ns:
            last, resumed = self._gaps.popleft()
            self._end_leg(last)
            self._last_motion, self._from_ns = None, max(self._from_ns, resumed)
        if stamp_ns < self._from_ns:
            return
        if self._last_motion is None:
            self._last_motion = stamp_ns, travel
        elif abs(travel - self._last_motion[1]) > self._rest_travel:
            self._handle_motion(stamp_ns, self._last_motion[0])
            self._last_motion = stamp_ns, travel
        else:
            self._handle_standstill(stamp_ns, self._last_motion[0])

    def _handle_motion(self, stamp_ns: int, since_ns: int) -> None:
        """Begin or end a leg at a motion after a standstill since ``since_ns``."""
        self._handle_standstill(stamp_ns - START_REST_NS, since_ns)
        rested = stamp_ns - since_ns >= self._standstill_ns
        leg, motion_ns = self.open_span, max(stamp_ns - START_REST_NS, since_ns, self._from_ns)
        if leg is not None and rested and self._long_enough(leg, since_ns):
            self._end_leg(motion_ns)
        elif leg is not None and stamp_ns - leg.start_ns >= self._longest_ns:
            self._end_leg(stamp_ns)
            motion_ns = stamp_ns
        if self.open_span is None and not self._needs_rest:
            self.spans.append(Span(motion_ns))

    def _handle_standstill(self, stamp_ns: int, since_ns: int) -> None:
        """End a leg at a standstill from ``since_ns`` on that is long enough."""
        duration_ns = stamp_ns - since_ns
        self._needs_rest = self._needs_rest and duration_ns < self._standstill_ns
        leg = self.open_span
        if leg is not None and (duration_ns >= PARKED_NS or duration_ns >= self._rest_ns
                                and self._long_enough(leg, since_ns)):
            self._end_leg(since_ns + self._rest_ns)

    def _long_enough(self, leg: Span, until_ns: int) -> bool:
        """Return True if a leg has half of its longest duration."""
        return 2 * (until_ns - leg.start_ns) >= self._longest_ns

    def _end_leg(self, stop_ns: int) -> None:
        leg = self.open_span
        if leg is not None and stop_ns > leg.start_ns:
            leg.stop_ns = stop_ns
        elif leg is not None:
            self.spans.pop()


def rejecting_reason(result: LegResult) -> Reason | None:
    """Return the rejecting reason of a dropped automatic leg, None if it is kept."""
    if result.verdict is not Verdict.REJECTED:
        return None
    return next(iter(rejecting(result.all_reasons)),
                Reason(Code.NO_METHOD, 'no method could be run'))


def add_to_carried(legs: Iterable[LegResult], config: Config,
                   carried: CarriedInformation | None = None) -> CarriedInformation | None:
    """Return the carried information with legs added, in order of time."""
    for leg in legs:
        carried = combine([leg], config, carried).carried or carried
    return carried
