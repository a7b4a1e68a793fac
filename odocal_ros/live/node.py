# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The calibration node: builds recording, session, publishing and journal; one timer runs all."""

from collections.abc import Callable
from functools import partial
import threading
import time

from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import Trigger

from odocal_ros.data.inputs import TOPICS
from odocal_ros.errors import OdocalError
from odocal_ros.live import params
from odocal_ros.live.journal import Journal
from odocal_ros.live.operation import Operation
from odocal_ros.live.process import CheckedNode, print_error, run
from odocal_ros.live.publishing import Publishing
from odocal_ros.live.recording import Recording
from odocal_ros.live.topic_input import SEARCH_PERIOD_S
from odocal_ros.output.stored import known_imu
from odocal_ros.pipeline.floor_marks import check_points

# tuned by benchmarks/live_load.py: period of ``_tick``, s, and while a caller waits. 0.05 s at all
# times would double the CPU load; a queue holds 25 periods of 0.2 s
TICK_S, AWAITED_TICK_S = 0.2, 0.05
HELP = """\
usage: calibrator [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r FROM:=TO] ...]

Calibrates a vehicle's odometer against IMU and GNSS while it is driven (a ROS 2 node; the same
over recorded bags is 'odocal replay').

subscribes   imu/data, odometer, fix; if published fix_velocity, heading and pressure; if
             configured odometer_right
             (another name: -r odometer:=/your/topic)
services     ~/start_leg before a drive and ~/stop_leg after it, which answers with the result;
             ~/mark on each point of reference.points;
             ~/cancel_leg, ~/undo_leg, ~/reset, ~/save   (all std_srvs/srv/Trigger)
publishes    ~/status: missing inputs and what to do next; /diagnostics; ~/path/...; the
             result as parameters result.*
settings     parameters, all described in config/calibrator.yaml:
             'calibrator --ros-args --params-file calibrator.yaml', or one by one
             'calibrator --ros-args -p odometer.nominal_scale:=0.02'"""
SERVICES = ('start_leg', 'stop_leg', 'mark', 'cancel_leg', 'undo_leg', 'reset', 'save')


class Calibrator(CheckedNode):
    """
    Calibrates an odometer over legs that the operator marks by service.

    Works in any executor; SingleThreadedExecutor is recommended.
    """

    default_name = 'calibrator'
    has_running_thread = False      # True: a thread still runs after the end of the node

    def _build(self) -> None:
        self.config = params.declare_settings(self)
        known_imu(self.config)      # raises now, not after the first leg
        if self.config.reference.points:
            check_points(self.config)
        params.declare_results(self)
        params.check_qos(self, map(self.resolve_topic_name, TOPICS.values()))
        self.publishing = Publishing(self)
        self.journal = Journal(self, self.publishing.status_topic)
        self.recording = Recording(self, self.config, self.journal.store)
        self.operation = Operation(self, self.recording, self.publishing, self.journal,
                                   lambda: self.config)
        self._lock = threading.RLock()  # for executors with several threads
        self._due_ns = dict.fromkeys(('search', 'diagnostics', 'status'), 0)
        self.add_on_set_parameters_callback(self._check_parameters)
        self.add_post_set_parameters_callback(self._apply_parameters)
        group = ReentrantCallbackGroup()  # a delayed answer must not block callbacks
        for name in SERVICES:
            command = getattr(self.operation, name)
            self.create_service(Trigger, f'~/{name}', partial(self._serve, command),
                                callback_group=group)
        self._timer = self.steady_timer(TICK_S, self._tick)

    def destroy_node(self) -> None:
        for part in ('operation', 'journal', 'recording'):
            if hasattr(self, part) and getattr(self, part).close() is False:
                self.has_running_thread = True
        if hasattr(self, 'operation') and (text := self.operation.unstopped_leg_text()):
            print_error('calibrator', text)      # a context that is shut down cannot log
        super().destroy_node()  # type: ignore[no-untyped-call]

    def _check_parameters(self, parameters: list[Parameter]) -> SetParametersResult:
        """Refuse parameters that cannot be set now; changes nothing."""
        if self.publishing.setting_results:
            return SetParametersResult(successful=True)
        refusal = params.change_refusal(self.config, self.publishing.results(), parameters)
        session = self.operation.session
        if not refusal and session.is_busy:
            refusal = (f'leg {session.leg_id} is {session.state.value}: its configuration is '
                       'fixed; end it with ~/stop_leg or ~/cancel_leg first')
        try:
            params.with_parameters(self.config, parameters)
        except OdocalError as error:
            refusal = refusal or str(error)
        return SetParametersResult(successful=not refusal, reason=refusal)

    def _apply_parameters(self, parameters: list[Parameter]) -> None:
        self.config = params.with_parameters(self.config, parameters)

    def _tick(self) -> None:
        with self._lock:
            self.operation.tick()
            if self._due('search', SEARCH_PERIOD_S):
                self.recording.inputs.update(self.config)
                session = self.operation.session
                self.recording.drop_old_samples(
                    self.config.leg.preroll, session.start_ns if session.has_open_leg else 0)
            if self._due('diagnostics', self.config.diagnostic_updater.period):
                self.publishing.show_diagnostics(self.recording, self.config)
            if self._due('status', 1 / self.config.publish.rate):
                self.operation.show_status()
            self._set_period()

    def _set_period(self) -> None:
        """Set the period of ``_tick``: shorter while a caller waits."""
        is_awaited = self.operation.is_awaited
        period_s = AWAITED_TICK_S if is_awaited else min(TICK_S, 1 / self.config.publish.rate)
        period_ns = round(period_s * 1e9)
        if period_ns != self._timer.timer_period_ns:
            self._timer.timer_period_ns = period_ns
            self._timer.reset()

    def _due(self, task: str, period_s: float) -> bool:
        """Return True if a task is due, and set the time at which it is due next."""
        now_ns, period_ns = time.monotonic_ns(), round(period_s * 1e9)
        if now_ns < self._due_ns[task]:
            return False
        # a period after it was due, for the right mean rate; after a pause, a period from now
        next_ns = self._due_ns[task] + period_ns
        self._due_ns[task] = next_ns if next_ns > now_ns else now_ns + period_ns
        return True

    async def _serve(self, command: Callable[[], tuple[bool, str] | Future],
                     _request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Answer a Trigger with the result of a command, or of the future that it returns."""
        try:
            with self._lock:
                answer = command()
                self._set_period()
            response.success, response.message = (
                await answer if isinstance(answer, Future) else answer)
        except OdocalError as refused:
            self.get_logger().warning(f'~/{command.__name__} refused: {refused}')
            response.success, response.message = False, str(refused)
        return response


main = partial(run, Calibrator, HELP)
