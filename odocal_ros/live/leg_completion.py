# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The life of a leg in the calibration node, from its start mark to the answer of ``stop_leg``.

In: marks of the operator or of automatic legs. Out: a result, combined with those of earlier legs,
as a future: computation and saving run in the worker.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from math import nan
import time

from rclpy.task import Future

from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.data.leg import LegRecorder
from odocal_ros.forecast.leg_so_far import SILENT_TIME
from odocal_ros.forecast.progress import clock_difference_text
from odocal_ros.forecast.quantities import find_observable, Observability, quantities_text
from odocal_ros.live import answers, worker
from odocal_ros.live.console import Console
from odocal_ros.live.journal import Journal, replay_command
from odocal_ros.live.params import restored_from
from odocal_ros.live.process import CheckedNode
from odocal_ros.live.publishing import Publishing
from odocal_ros.live.recording import Recording
from odocal_ros.live.result_folders import ResultSaver
from odocal_ros.live.running_estimate import RunningEstimate
from odocal_ros.live.session import Session, SessionView, State
from odocal_ros.output.value_text import iso
from odocal_ros.pipeline.floor_marks import settings_with_marks
from odocal_ros.settings.config import Config

LATE_TOPIC_S = 1.0   # judgement: longest wait for late topics at the stop mark


class LegCompletion:
    """Completes a leg. Nothing blocks: the worker computes, and ``tick`` handles its results."""

    def __init__(self, node: CheckedNode, recording: Recording, publishing: Publishing,
                 journal: Journal, config: Callable[[], Config]) -> None:
        """Use ``config()``, the configuration in force; a running leg keeps that of its start."""
        self.session = Session()
        self.session.restored_result = restored_from(publishing.results())
        self._recording, self._publishing = recording, publishing
        self._config, self._journal = config, journal
        self._log, self._clock = node.get_logger(), node.get_clock()
        self._worker = worker.Worker()
        self._running_estimate = RunningEstimate(self._worker, self._log)
        self._node_name = node.get_fully_qualified_name()
        self._active_job = worker.ActiveJob(self._worker, self._fail, self.show_status,
                                           node.context.ok)
        self._observability: Observability | None = None      # of the leg last started
        # steady time until which a stopped leg waits for its last samples
        self._samples_until_ns: int | None = None
        self._snapshot: LegRecorder | None = None      # samples of the stopped leg, for a retry
        self._view_at_stop: SessionView | None = None  # before the mark of the stopped leg
        self._distance_m = 0.0           # of the leg that changed last
        self._is_imu_silent = False      # in the recorded leg
        self._console = Console(self._log)
        self._saver = ResultSaver(self._worker, self._log, self.show_status, self._node_name)

    @property
    def is_awaited(self) -> bool:
        """Return True while a leg is computed or files are written."""
        return self.session.state is State.COMPUTING or self._saver.is_busy

    def tick(self) -> None:
        """Process finished jobs, new messages and timeouts."""
        self._worker.poll()
        self._saver.poll()
        self.decode_new_messages()
        if self._recording.has_time_jumped:
            self._restart_after_time_jump()
        self._stop_when_too_long()
        self._close_when_complete()
        if (view := self._view_at_stop) and self.session.state is State.COMPUTING:
            self._active_job.answer_expired(partial(answers.provisional_answer, view))
        if self.session.state is State.RECORDING:
            self._running_estimate.update(self._recording.newest_ns,
                                          self._recording.progress.distance_m())
            self._report_silence()
        self._journal.tick(self._config(), self.session.is_busy)

    def _report_silence(self) -> None:
        """Publish the status immediately when the IMU falls silent or returns."""
        is_silent = self._recording.imu_silent_s() > SILENT_TIME
        if is_silent is not self._is_imu_silent:
            self._is_imu_silent = is_silent
            self.show_status()

    def decode_new_messages(self) -> None:
        """Decode; the distance is computed with the running estimate of the scale, or a result."""
        forecast = self._running_estimate.forecast
        estimate = forecast.estimates.get('scale_factor') if forecast else None
        scale = estimate.value if estimate else None
        self._recording.decode_new_messages(
            self._config(), self._publishing.scale_factor() if scale is None else scale)

    def close(self) -> bool:
        """Wait briefly for running jobs and files; return True if all are done."""
        self._running_estimate.end()
        grace_s = worker.FILES_GRACE_S if self._saver.is_busy else worker.JOB_GRACE_S
        until = time.monotonic() + grace_s
        is_done = self._worker.close(grace_s)
        return self._saver.close(max(0.0, until - time.monotonic())) and is_done

    def unstopped_leg_text(self) -> str:
        """Return the folder and replay command of a leg that was not stopped, else empty."""
        if self.session.state is not State.RECORDING:
            return ''
        return f'leg {self.session.leg_id} was not stopped: {self._data_location()}'

    def _data_location(self, start_ns: int = 0) -> str:
        """Return the place of the newest leg's data and how to compute it from a mark."""
        folder = self._journal.folder
        return (f'the data is in {folder}; compute it with {replay_command(folder, start_ns)}'
                if folder else 'it has no journal')

    def _restart_after_time_jump(self) -> None:
        jump = 'time jumped back (a bag restarted, or a clock was set)'
        if self.session.state is State.RECORDING or self._samples_until_ns is not None:
            self._log.warning(f'{jump}: leg {self.session.leg_id} is cancelled')
            self._drop_leg(drop_cause='time jumped back')
            self._log.warning(self._dropped_leg_text())
        else:
            self._log.warning(f'{jump}: all samples so far are dropped')
        self._recording.restart()
        self.session.marks.clear()
        self._journal.restart()

    def view(self) -> SessionView:
        """Return a snapshot of everything that status and answers state."""
        session, recording = self.session, self._recording
        inputs, progress = recording.inputs, recording.progress
        in_leg = session.state is State.RECORDING
        if in_leg:
            self._distance_m = progress.distance_m()
        end_ns = session.stop_ns or recording.newest_ns
        forecast = self._running_estimate.forecast
        if self._view_at_stop is not None and session.state is State.COMPUTING:
            forecast = self._view_at_stop.forecast
        config = session.config if session.is_busy else self._config()
        return SessionView(
            session, config, missing_inputs=inputs.missing_reasons(config),
            duplicate_publishers=inputs.duplicate_publishers(),
            lost_messages=inputs.lost_messages(), rates_hz=recording.rates_hz(),
            clock_differences=progress.clocks.find_differing(config),
            results=self._publishing.results(), restored_stamp=session.restored_stamp(),
            distance_m=self._distance_m,
            duration_s=max(0, end_ns - session.start_ns) * 1e-9 if session.start_ns else 0.0,
            max_speed=progress.max_speed(), still_s=progress.still_s(),
            two_wheels=recording.two_wheels(),
            observability=self._observability if in_leg else None,
            forecast=forecast, forecast_age_s=forecast.age_s(end_ns) if forecast else nan,
            faults=self._running_estimate.faults(recording.imu_silent_s()) if in_leg else (),
            stage=self._active_job.stage, dropped_leg=self._dropped_leg_text(),
            saved_folder=self._saver.saved_folder, save_error=self._saver.error,
            journal_folder=self._journal.folder, journal_error=self._journal.error,
            has_received=recording.has_received(), is_local=recording.is_local,
            has_imu=not inputs.without_imu)

    def show_status(self) -> None:
        view = self.view()
        self._console.report(view, time.monotonic_ns())
        self._journal.store_status(self.session, self._publishing.show_status(view))

    def _newest_stamp_ns(self) -> int:
        """Return the newest stamp of the IMU, or else of the odometer, on the sensors' clock."""
        self.decode_new_messages()
        return self._recording.newest_ns

    def _stop_when_too_long(self) -> None:
        session, limit = self.session, self.session.config.leg.max_duration
        duration_s = (self._recording.newest_ns - session.start_ns) * 1e-9
        if session.state is State.RECORDING and duration_s > limit:
            self._log.warning(
                f'leg {session.leg_id} is stopped: it reached leg.max_duration, {limit:g} s')
            self.end_leg_now()

    def _start_refusal(self) -> str:
        """Return the reason why no leg can start, as text; empty if one can."""
        missing = self._recording.inputs.missing_reasons(self._config())
        clocks = self._recording.progress.clocks.find_differing(self._config())
        return '; '.join(missing) or (clock_difference_text(clocks) if clocks else '')

    def _begin_leg(self, mark_ns: int, is_automatic: bool = False) -> str:
        """Open a leg at a mark, a stamp in ns; return the text for log and answer."""
        session = self.session
        config = self._config()
        session.start(mark_ns, settings_with_marks(config) if config.reference.points else config,
                      is_automatic)
        self._recording.inputs.begin_leg()
        self._journal.begin(session, self._recording.inputs.topics)
        if not is_automatic:
            self._recording.progress.begin_leg()
        self._running_estimate.begin(self._recording.snapshot(), mark_ns, session.config)
        self._observability = find_observable(session.config, self._recording.received_before(
            session.config.leg.preroll))
        self.show_status()
        text = (f'recording leg {session.leg_id} since {iso(mark_ns)}; {answers.hint(self.view())}'
                f'. With these settings, {self._observability.as_text()}')
        self._log.info(text)
        return text

    def end_leg_now(self) -> None:
        self._end_leg(self._newest_stamp_ns())

    def _end_leg(self, mark_ns: int) -> None:
        view = self.view()
        if view.forecast is not None:
            view = replace(view, forecast=view.forecast.without_predictions())
        self._view_at_stop = view
        self.session.stop(mark_ns)
        self._running_estimate.end()
        self._samples_until_ns = time.monotonic_ns() + round(LATE_TOPIC_S * 1e9)
        self.show_status()
        self._close_when_complete()

    def _close_when_complete(self) -> None:
        """Hand the leg to the worker once each topic has passed the stop mark, or time is up."""
        if self._samples_until_ns is None:
            return
        if (time.monotonic_ns() > self._samples_until_ns
                or self._recording.has_passed(self.session.stop_ns)):
            self._samples_until_ns = None
            self._journal.end()
            self._snapshot = self._recording.snapshot()
            self._compute(self._snapshot)

    def _compute(self, samples: LegRecorder) -> None:
        session = self.session
        self._active_job.submit(partial(
            worker.compute, samples, session.start_ns, session.stop_ns,
            [leg.results for leg in session.legs], session.config, session.carried,
            session.is_automatic, self._active_job.report), self._handle_leg_result)

    def _fail(self, error: str) -> None:
        """Report that the computation of a leg, or the publication of its result, failed."""
        if self.session.state is State.COMPUTING:      # else the result is available
            self.session.fail(error)
        self._log.error(f'leg {self.session.leg_id} failed: {error}')
        remedy = ('the leg is kept: call ~/stop_leg to compute it again, or ~/cancel_leg to drop '
                  'it') if self.session.has_open_leg else 'call ~/reset'
        self._active_job.answer(False, f'failed: {error}; {remedy}')

    def _handle_leg_result(self, leg: worker.ComputedLeg | worker.UnusedLeg) -> None:
        leg_id, self._snapshot, self._view_at_stop = self.session.leg_id, None, None
        self._distance_m = sum(result.distance for result in leg.results)
        if isinstance(leg, worker.UnusedLeg):
            self.session.drop_unusable(leg.reason)
            text = f'leg {leg_id}, {self._distance_m:.0f} m, is not used: {leg.reason}'
            self._log.info(text)
            self._active_job.answer(False, text)
            return
        self.session.finish(leg.results, leg.calibration)
        self.session.set_carried(leg.carried, leg.released_count)
        is_usable = self._publish_result(leg.calibration, leg.paths, leg.results)
        if is_usable and self._config().output.autosave:
            self._save(leg.calibration)

    def _publish_result(self, calibration: Calibration, paths: worker.Paths,
                        parts: Sequence[LegResult] = ()) -> bool:
        """Publish and answer a result; return True if it is usable."""
        self._publishing.set_results(calibration)
        self._publishing.show_paths(paths)
        view = self.view()
        is_usable, text = answers.result_answer(
            calibration, parts, self.session.leg_id, quantities_text(answers.limit_checks(view)),
            answers.advice_after_result(view))
        self._log.info(text)
        self._active_job.answer(is_usable, text)
        return is_usable

    def _dropped_leg_text(self) -> str:
        """Return the text on a leg that was dropped automatically, empty without one."""
        session = self.session
        return '' if not session.drop_cause else (
            f'leg {session.leg_id} was cancelled: {session.drop_cause}; '
            f'{self._data_location(session.start_ns)}; call ~/start_leg for a new leg')

    def _drop_leg(self, text: str = '', drop_cause: str = '') -> None:
        """Drop the open leg; text : answer to callers.   drop_cause : '' if the operator asked."""
        self.session.cancel(drop_cause)
        self._running_estimate.end()
        self._samples_until_ns = self._snapshot = self._view_at_stop = None
        self._active_job.drop()
        self.show_status()
        self._journal.end()
        self._active_job.answer(False, text or self._dropped_leg_text())

    def _save(self, calibration: Calibration, by_operator: bool = False) -> Future:
        inputs = self._recording.inputs
        config = replace(self.session.config, output=self._config().output)   # may be new
        return self._saver.save(calibration, config, inputs.topics, inputs.by_slot['imu'].frame,
                                self._clock.now().nanoseconds, by_operator)
