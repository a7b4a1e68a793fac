# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Commands of the calibration node: services of the operator, and automatic legs."""

from functools import partial
from typing import Any

from rclpy.task import Future

from odocal_ros.calib.result import Calibration
from odocal_ros.data.samples import Samples
from odocal_ros.forecast.quantities import quantities_text
from odocal_ros.live import answers, worker
from odocal_ros.live.leg_completion import LegCompletion
from odocal_ros.live.params import RESULTS
from odocal_ros.live.result_folders import LATEST, output_root
from odocal_ros.live.session import CommandRefused, State
from odocal_ros.output.stored import Stored, stored_in
from odocal_ros.output.value_text import counted, iso
from odocal_ros.pipeline.automatic import LegSearch
from odocal_ros.pipeline.floor_marks import HALF_MARK, mark_positions, point_position
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, LegConfig

# judgement: standstill before a mark, s: time span of its positions, and an odometer delay
MARK_STILL_S = 2 * HALF_MARK + 0.5


class AutomaticLegs(LegCompletion):
    """Starts and ends legs at standstills, unless a leg of the operator is running."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self._search: LegSearch | None = None
        self._search_settings: LegConfig | None = None
        self._progress_start_ns = 0           # start of the leg whose distance is measured
        self._logged_changes: set[str] = set()      # changes of the scale that were logged
        self._recording.block_listener = self._receive

    def tick(self) -> None:
        super().tick()
        self._update_search()
        if self._search is not None and self._search.spans:
            self._control_automatic_leg(self._search)

    def _receive(self, slot: str, block: Samples) -> None:
        """Hand a received block to the running estimate and to the search for legs."""
        self._running_estimate.feed(slot, block)
        if self._search is not None:
            self._search.feed(slot, block, self._recording.inputs.odometer_form())

    def _update_search(self) -> None:
        """Create the search for the settings in force; none without leg.automatic."""
        leg = self._config().leg
        settings = leg if leg.automatic else None
        if settings == self._search_settings:
            return
        previous, self._search_settings = self._search_settings, settings
        self._search = LegSearch(self._config()) if settings else None
        if settings and previous is None:
            self._load_carried()

    def _load_carried(self) -> None:
        """Continue with the information that earlier runs of the node stored in ``latest``."""
        stored = stored_in(output_root(self._config(), self._node_name) / LATEST)
        if not stored or not stored.carried:
            return
        reason = _foreign_result_reason(stored, self._config())
        if reason:
            self._log.warning(f'{stored.name} is not continued: {reason}')
        else:
            self.session.carried = stored.carried
            self._log.info(f'continues {stored.name}: {stored.carried.legs} legs, the last of '
                           f'{iso(stored.carried.last_ns)}')

    def _control_automatic_leg(self, search: LegSearch) -> None:
        """Start or end a leg if the search has found its start or its end."""
        session, span, newest = self.session, search.spans[0], search.spans[-1]
        if session.state is not State.RECORDING and newest.start_ns != self._progress_start_ns:
            self._progress_start_ns = newest.start_ns      # the leg before may still be computed
            self._recording.progress.begin_leg()
        if session.state is State.FAILED and session.has_open_leg and session.is_automatic:
            self._drop_leg(drop_cause=session.failure)
        elif session.state is State.RECORDING:
            if session.is_automatic and span.stop_ns:
                search.spans.popleft()
                self._end_leg(span.stop_ns)
        elif not session.has_open_leg and not session.is_busy and not self._start_refusal():
            if span.start_ns < self._recording.newest_ns - self._config().leg.preroll * 1e9:
                search.spans.popleft()      # its samples were dropped
            else:
                self._begin_leg(span.start_ns, is_automatic=True)

    def end_leg_now(self) -> None:
        """End the leg, by service or at its longest duration, as a leg of the operator."""
        self.session.is_automatic = False
        super().end_leg_now()
        if self._search is not None:
            self._search.restart(self.session.stop_ns, at_rest=False)

    def _drop_leg(self, text: str = '', drop_cause: str = '') -> None:
        super()._drop_leg(text, drop_cause)
        if self._search is not None:
            self._search.restart(self._recording.newest_ns, at_rest=True)

    def _restart_after_time_jump(self) -> None:
        super()._restart_after_time_jump()
        self._search = LegSearch(self._config()) if self._search_settings else None

    def _handle_leg_result(self, leg: worker.ComputedLeg | worker.UnusedLeg) -> None:
        super()._handle_leg_result(leg)
        for reason in leg.calibration.reasons if isinstance(leg, worker.ComputedLeg) else ():
            if reason.code is Code.SCALE_CHANGED and reason.text not in self._logged_changes:
                self._logged_changes.add(reason.text)
                self._log.warning(f'{reason}. {reason.remedy}')


def _foreign_result_reason(stored: Stored, config: Config) -> str:
    """Return the reason why a result is not of this vehicle and mounting, as text, or ''."""
    if stored.vehicle != config.vehicle:
        return f'it belongs to vehicle {stored.vehicle!r}'
    if list(stored.config.get('imu.mounting_rpy', ())) != list(config.imu.mounting_rpy):
        return 'imu.mounting_rpy has changed'
    return ''


class Operation(AutomaticLegs):
    """
    The commands of the node's services.

    Each returns (success, text), or a future of it that ``tick`` completes, or raises
    CommandRefused.
    """

    def start_leg(self) -> tuple[bool, str]:
        session, mark_ns = self.session, self._newest_stamp_ns()
        if session.state is State.RECORDING and not session.is_automatic:
            return True, (f'recording since {iso(session.start_ns)}, leg '
                          f'{session.leg_id}; {answers.hint(self.view())}')
        if reason := self._start_refusal():
            raise CommandRefused(f'no leg can be started: {reason}')
        if session.state is State.RECORDING:      # an automatic leg
            self._drop_leg(f'leg {session.leg_id} is replaced by a leg of the operator')
        return True, self._begin_leg(mark_ns)

    def mark(self) -> tuple[bool, str]:
        """Record a mark: the robot is on the next point of ``reference.points``."""
        session, newest_ns = self.session, self._newest_stamp_ns()
        if not self._config().reference.points:
            raise CommandRefused('reference.points is empty: set x and y of each point, and '
                                 'restart the node')
        still_s = self._recording.progress.still_s()
        if session.state is State.RECORDING and still_s < MARK_STILL_S:
            raise CommandRefused(f'the wheels have stood for {still_s:.1f} s, required: '
                                 f'{MARK_STILL_S:g} s; stand on the point and call again')
        delay_s = self._recording.inputs.mark_input.health.delay_s
        mark = session.mark(newest_ns - round(HALF_MARK * 1e9), newest_ns + round(delay_s * 1e9))
        self._recording.add_marks(mark_positions(session.config, [mark]), session.config)
        self.show_status()
        x, y = point_position(session.config, mark.point)
        text = (f'mark {len(session.marks_of_leg())} of leg {session.leg_id}: point '
                f'{mark.point + 1}, x {x:g} m, y {y:g} m')
        self._log.info(text)
        return True, text

    def stop_leg(self) -> tuple[bool, str] | Future:
        """End the leg; the answer has the result, or a provisional one if it takes long."""
        session = self.session
        if session.state is State.RECORDING:
            self.end_leg_now()
        elif session.has_open_leg and session.state is State.FAILED and self._snapshot is not None:
            session.retry(self._config())
            self._compute(self._snapshot)
        elif session.state is not State.COMPUTING:
            return self._last_result()
        return self._active_job.create_future(worker.STOP_ANSWER_S)

    def _last_result(self) -> tuple[bool, str]:
        session, view = self.session, self.view()
        if view.dropped_leg:
            raise CommandRefused(view.dropped_leg)
        within_limits = quantities_text(answers.limit_checks(view))
        if session.calibration is not None:
            success, text = answers.result_answer(session.calibration, within_limits=within_limits,
                                                  advice=answers.advice_after_result(view))
            return success, f'no leg is running; the last result: {text}'
        if session.restored_result is not None:
            form = self._recording.inputs.odometer_form()
            return answers.restored_answer(
                session.restored_result, form.scale_unit if form else '', within_limits)
        raise CommandRefused('no leg is running and there is no result yet: call ~/start_leg '
                             'first')

    def cancel_leg(self) -> tuple[bool, str]:
        text = f'leg {self.session.leg_id} is cancelled'
        self._drop_leg(text)
        self._log.info(text)
        return True, text

    def undo_leg(self) -> tuple[bool, str] | Future:
        results = [result for leg in self.session.begin_undo() for result in leg.results]
        text = f'leg {self.session.leg_id} is undone'
        self._log.info(text)
        self._saver.withdraw(self.session.start_ns)
        self.show_status()
        if not results:
            text += '; no leg is left'
            self._active_job.drop()      # an earlier undo may still be computed
            self._active_job.answer(True, text)
            self._show_no_result()
            return True, text

        def handle(outcome: tuple[Calibration, worker.Paths]) -> None:
            calibration, paths = outcome
            self.session.set_result(calibration)
            self._publish_result(calibration, paths)

        self._active_job.submit(
            partial(worker.recombine, results, self._config(), self.session.carried), handle)
        return self._active_job.create_future()

    def _show_no_result(self) -> None:
        self._publishing.set_results(None)
        self._publishing.show_paths(worker.leg_paths(None, self._config()))
        self.show_status()

    def reset(self) -> tuple[bool, str]:
        if self.session.state is State.FAILED and self.session.has_open_leg:
            self._drop_leg('reset')
        dropped = self.session.begin_reset()
        self._publishing.restored_results = dict(RESULTS)
        for leg in dropped:  # each is published as undone: a replay of the bag omits it too
            self.session.mark_undone(leg)
            self.show_status()
        self._saver.withdraw(0)
        self._show_no_result()
        return True, f'reset: {counted(len(dropped), "leg")} dropped'

    def save(self) -> Future:
        if self.session.calibration is None:
            raise CommandRefused('nothing to save: no leg has been computed yet; call '
                                 '~/start_leg, drive, ~/stop_leg')
        return self._save(self.session.calibration, by_operator=True)
