# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The operator's commands and their answers in each state."""

from functools import partial

from rclpy.task import Future

from odocal_ros.calib.result import Calibration
from odocal_ros.forecast.quantities import words
from odocal_ros.live import answers, jobs
from odocal_ros.live.automatic_legs import AutomaticLegs
from odocal_ros.live.filing import iso
from odocal_ros.live.guidance import after_result, hint, quantities_ok
from odocal_ros.live.session import Refused, State
from odocal_ros.live.worker import PATIENCE_S
from odocal_ros.pipeline.floor_marks import mark_positions, place_of, WITHIN

# the positions of a mark reach WITHIN to both sides, and another 0.5 s for the odometer's delay.
# Judgement
MARK_STILL_S = 2 * WITHIN + 0.5


class Operation(AutomaticLegs):
    """
    The commands of the node's services.

    Each returns (success, text), or a future of it that ``tick`` will fill; refusals are raised.
    """

    def start_leg(self) -> tuple[bool, str]:
        """Open a leg at the newest stamp."""
        session, mark_ns = self.session, self._mark_ns()
        if session.state is State.RECORDING and not session.by_itself:
            return True, (f'recording since {iso(session.start_ns)}, leg '
                          f'{session.leg_id}; {hint(self.view())}')
        if why := self._why_not():
            raise Refused(f'no leg can be started: {why}')
        if session.state is State.RECORDING:      # one that nobody asked for
            self._drop_leg(f'leg {session.leg_id} is replaced by a started by the operator')
        return True, self._begin_leg(mark_ns)

    def mark(self) -> tuple[bool, str]:
        """Record a mark: the robot stands on the next point of ``reference.points``."""
        session, newest_ns = self.session, self._mark_ns()
        if not self._config().reference.points:
            raise Refused('reference.points is empty: set x and y of each point, and restart the '
                          'node')
        still_s = self._recording.progress.still_s()
        if session.state is State.RECORDING and still_s < MARK_STILL_S:
            raise Refused(f'the wheels have stood for {still_s:.1f} s, required: '
                          f'{MARK_STILL_S:g} s; stand on the point and call again')
        delay_s = self._recording.inputs.leading.health.delay_s
        mark = session.mark(newest_ns - round(WITHIN * 1e9), newest_ns + round(delay_s * 1e9))
        self._recording.add_marks(mark_positions(session.config, [mark]), session.config)
        self.show_status()
        x, y = place_of(session.config, mark.point)
        text = (f'mark {len(session.marks_of_leg())} of leg {session.leg_id}: point '
                f'{mark.point + 1}, x {x:g} m, y {y:g} m')
        self._log.info(text)
        return True, text

    def stop_leg(self) -> tuple[bool, str] | Future:
        """End the leg; the answer carries the result, a provisional one where it takes long."""
        session = self.session
        if session.state is State.RECORDING:
            self.end_leg_now()
        elif session.open_leg and session.state is State.FAILED and self._snapshot is not None:
            session.retry(self._config())
            self._compute(self._snapshot)
        elif session.state is not State.COMPUTING:
            return self._last_result()
        return self._computing.promise(PATIENCE_S)

    def _last_result(self) -> tuple[bool, str]:
        """Return the answer to a stop without a leg."""
        session, now = self.session, self.view()
        if now.lost:
            raise Refused(now.lost)
        good = words(quantities_ok(now))
        if session.calibration is not None:
            success, text = answers.outcome(session.calibration, good=good,
                                            advice=after_result(now))
            return success, f'no leg is running; the last result: {text}'
        if session.restored is not None:
            form = self._recording.inputs.form
            return answers.restored(session.restored, form.scale_unit if form else '', good)
        raise Refused('no leg is running and there is no result yet: call ~/start_leg first')

    def cancel_leg(self) -> tuple[bool, str]:
        """Drop the open leg."""
        text = f'leg {self.session.leg_id} is cancelled'
        self._drop_leg(text)
        self._log.info(text)
        return True, text

    def undo_leg(self) -> tuple[bool, str] | Future:
        """Drop the last kept leg and combine the others again."""
        left = [one for leg in self.session.begin_undo() for one in leg.results]
        text = f'leg {self.session.leg_id} is undone'
        self._log.info(text)
        self._filing.withdraw(left)
        self.show_status()
        if not left:
            self._publishing.set_results(None)
            self._publishing.show_paths(jobs.leg_paths(None, self._config()))
            self._computing.drop()      # an undo just before may still be combined
            self._computing.answer(True, f'{text}; no leg is left')
            self.show_status()
            return True, f'{text}; no leg is left'

        def take(outcome: tuple[Calibration, jobs.Paths]) -> None:
            self.session.settle(outcome[0])
            self._take_result(*outcome)

        self._computing.submit(
            partial(jobs.recombine, left, self._config(), self.session.carried), take)
        return self._computing.promise()

    def reset(self) -> tuple[bool, str]:
        """Drop all legs and the result."""
        if self.session.state is State.FAILED and self.session.open_leg:
            self._drop_leg('reset')
        dropped = self.session.begin_reset()
        self._publishing.forget_restored()
        for leg in dropped:  # each shown as undone, so that a replay of the bag leaves it out too
            self.session.dropped(leg)
            self.show_status()
        self._publishing.set_results(None)
        self._publishing.show_paths(jobs.leg_paths(None, self._config()))
        self._filing.withdraw([])
        self.show_status()
        return True, f'reset: {len(dropped)} leg{"s" * (len(dropped) != 1)} dropped'

    def save(self) -> Future:
        """Write the result files."""
        if self.session.calibration is None:
            raise Refused('nothing to save: no leg has been computed yet; call ~/start_leg, '
                          'drive, ~/stop_leg')
        return self._save(self.session.calibration, asked=True)
