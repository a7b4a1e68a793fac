# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Automatic legs of the node, with ``leg.automatic``."""

from typing import Any

from odocal_ros.data.samples import Samples
from odocal_ros.live.filing import iso, latest_of
from odocal_ros.live.jobs import Computed, LeftOut
from odocal_ros.live.leg_completion import LegCompletion
from odocal_ros.live.session import State
from odocal_ros.output.stored import Stored
from odocal_ros.pipeline.automatic import LegSearch
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, LegConfig


class AutomaticLegs(LegCompletion):
    """
    Handle automatic legs: ``LegSearch`` finds them from the samples.

    A leg of the operator takes precedence; the search continues after it.
    """

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._search: LegSearch | None = None
        self._searched: LegConfig | None = None      # the settings it was made with
        self._counted_ns = 0                  # start of the leg whose metres are counted
        self._warned: set[str] = set()        # changes of the scale that were said
        self._recording.tap = self._receive

    def tick(self) -> None:
        """Process finished jobs, new messages and the time."""
        super().tick()
        self._keep_search()
        if self._search is not None and self._search.spans:
            self._by_itself(self._search)

    def _receive(self, slot: str, block: Samples) -> None:
        self._watch.feed(slot, block)
        if self._search is not None:
            self._search.feed(slot, block, self._recording.inputs.form)

    def _keep_search(self) -> None:
        """Create the search for the settings in force; none without leg.automatic."""
        leg = self._config().leg
        wanted = leg if leg.automatic else None
        if wanted == self._searched:
            return
        before, self._searched = self._searched, wanted
        self._search = LegSearch(self._config()) if wanted else None
        if wanted and before is None:
            self._go_on()

    def _go_on(self) -> None:
        """Continue with the carried result of earlier runs of the node."""
        found = latest_of(self._config(), self._node_name)
        if not found or not found.carried:
            return
        why = _not_ours(found, self._config())
        if why:
            self._log.warning(f'{found.name} is not continued: {why}')
        else:
            self.session.carried = found.carried
            self._log.info(f'continues {found.name}: {found.carried.legs} legs, the last of '
                           f'{iso(found.carried.last_ns)}')

    def _by_itself(self, search: LegSearch) -> None:
        session, span, newest = self.session, search.spans[0], search.spans[-1]
        if session.state is not State.RECORDING and newest.start_ns != self._counted_ns:
            self._counted_ns = newest.start_ns      # the leg before may still be computed
            self._recording.progress.begin_leg()
        if session.state is State.FAILED and session.open_leg and session.by_itself:
            self._drop_leg(lost=session.trouble)
        elif session.state is State.RECORDING:
            if session.by_itself and span.stop_ns:
                search.spans.popleft()
                self._end_leg(span.stop_ns)
        elif not session.open_leg and not session.busy and not self._why_not():
            if span.start_ns < self._recording.newest_ns - self._config().leg.preroll * 1e9:
                search.spans.popleft()      # its samples are forgotten
            else:
                self._begin_leg(span.start_ns, by_itself=True)

    def end_leg_now(self) -> None:
        """End the leg, by service or for its length; it counts as a leg of the operator."""
        self.session.by_itself = False
        super().end_leg_now()
        self._look_after(self.session.stop_ns, at_rest=False)

    def _drop_leg(self, text: str = '', lost: str = '') -> None:
        super()._drop_leg(text, lost)
        self._look_after(self._recording.newest_ns, at_rest=True)

    def _start_time_anew(self) -> None:
        super()._start_time_anew()
        self._search = LegSearch(self._config()) if self._searched else None

    def _look_after(self, stamp_ns: int, at_rest: bool) -> None:
        if self._search is not None:
            self._search.begin_anew(stamp_ns, at_rest)

    def _take_leg(self, done: Computed | LeftOut) -> None:
        super()._take_leg(done)
        for reason in done.calibration.reasons if isinstance(done, Computed) else ():
            if reason.code is Code.SCALE_CHANGED and reason.text not in self._warned:
                self._warned.add(reason.text)
                self._log.warning(f'{reason.code.name}: {reason.text}. {reason.code.remedy}')


def _not_ours(found: Stored, config: Config) -> str:
    """Return the explanation why a result belongs to another vehicle or mounting, else empty."""
    if found.vehicle != config.vehicle:
        return f'it belongs to vehicle {found.vehicle!r}'
    if list(found.config.get('imu.mounting_rpy', ())) != list(config.imu.mounting_rpy):
        return 'imu.mounting_rpy has changed'
    return ''
