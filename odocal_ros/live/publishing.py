# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the calibration node publishes: status, diagnostics, paths, and result parameters."""

from functools import partial
import math
import time
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from nav_msgs.msg import Path as PathMessage
from rclpy.event_handler import PublisherEventCallbacks
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from std_msgs.msg import Float64, String

from odocal_ros.bagio.segments import STATUS_NAME
from odocal_ros.calib.result import Calibration, wheel_factors
from odocal_ros.forecast import quantities
from odocal_ros.forecast.forecast import status_keys
from odocal_ros.live import answers, params
from odocal_ros.live.console import losses_text
from odocal_ros.live.health import Health
from odocal_ros.live.messages import LATCHED
from odocal_ros.live.recording import Recording
from odocal_ros.live.session import Session, SessionView, State
from odocal_ros.live.worker import Paths
from odocal_ros.output.value_text import counted, iso
from odocal_ros.pipeline.prepared_leg import Stage
from odocal_ros.reasons import Code, Verdict
from odocal_ros.safe_io.text_formats import date_text
from odocal_ros.settings.config import Config

# causes for which an automatic leg is not used without a warning: short moves are not a fault
SHORT_MOVE_CODES = (Code.LEG_TOO_SHORT, Code.SPEED_TOO_LOW)
# judgement: decimals of the values in the status; other values are published in full
DECIMALS = dict.fromkeys((
    'distance_m', 'duration_s', 'imu_rate_hz', 'odometer_rate_hz', 'fix_rate_hz', 'standstill_s',
    'distance_to_minimum_m', 'seconds_to_stand', 'estimate_age_s', 'metres_to_go_scale',
    'metres_to_go_yaw', 'computing_percent'), 1) | {
        'max_speed_mps': 2, 'predicted_scale_sigma_ppm': 2, 'predicted_yaw_sigma_deg': 4,
        'required_scale_sigma_ppm': 1, 'required_yaw_sigma_deg': 4, 'computing_change_sigmas': 4}
# results of the status, and the unit in their keys
KEY_UNITS = {'scale_factor': '', 'yaw_mounting_angle': '_rad', 'pitch_mounting_angle': '_rad',
             'scale_factor_left': '', 'scale_factor_right': '', 'track_width': '_m'}
RESULT_PARAMETERS = {f'{name}{end}{unit}': f'result.{name}{end}'      # by key
                     for name, unit in KEY_UNITS.items() for end in ('', '_sigma')}
PLOTTED = ('scale_factor', 'scale_factor_sigma', 'yaw_mounting_angle', 'yaw_mounting_angle_sigma')
# names of inputs in /diagnostics, if not those of the slots
SLOT_NAMES = {'fix': 'gnss', 'fix_velocity': 'gnss velocity', 'odometer_right': 'odometer right'}


def calibration_status(view: SessionView) -> DiagnosticStatus:
    """Return the content of ``~/status``; docs/interface.md describes each key."""
    session, results = view.session, view.results
    hint, checks = answers.hint(view), answers.limit_checks(view)
    observability = view.observability
    reasons = view.faults if session.state is State.RECORDING else session.reasons
    stage = view.stage if session.state is State.COMPUTING else Stage()
    keys = {
        'state': view.state, 'leg_id': session.leg_id, 'leg_start_ns': session.start_ns,
        'leg_stop_ns': session.stop_ns, 'leg_event': session.event,
        'marks': ','.join(map(str, session.marks)),
        'distance_m': view.distance_m, 'duration_s': view.duration_s,
        'imu_rate_hz': view.rates_hz.get('imu', 0.0),
        'odometer_rate_hz': view.rates_hz.get('odometer', 0.0),
        'fix_rate_hz': view.rates_hz.get('fix', 0.0),
    } | {key: results[name] for key, name in RESULT_PARAMETERS.items()} | _wheel_factors(view) | {
        'verdict': session.verdict(), 'hint': hint,
        'legs': results['result.legs'] if view.restored_stamp else len(session.legs),
        'leg_ids': ','.join(str(leg.leg_id) for leg in session.legs),
        'restored': view.restored_stamp, 'standstill_s': view.still_s,
        'max_speed_mps': view.max_speed, 'distance_to_minimum_m': answers.metres_to_go(view),
        'seconds_to_stand': answers.seconds_to_stand(view),
        'required_scale_sigma_ppm': view.config.verdict.max_scale_sigma * 1e6,
        'required_yaw_sigma_deg': math.degrees(view.config.verdict.max_yaw_sigma),
        'manoeuvres': '; '.join(answers.manoeuvres(view)),
        'observable': ', '.join(observability.observable) if observability else '',
        'not_observable': '; '.join(observability.not_observable) if observability else '',
        'messages_lost': sum(view.lost_messages.values()),
        'missing': '; '.join(view.missing_inputs),
        'reasons': ','.join(reason.code.name for reason in reasons),
        'saved': view.saved_folder, 'save_error': view.save_error, 'lost': view.dropped_leg,
        'automatic': _automatic_text(view), 'unused': _unused_text(session),
        'carried_legs': session.carried.legs if session.carried else 0,
        'journal': view.journal_folder, 'journal_error': view.journal_error,
        'computing_stage': stage.name, 'computing_passes': stage.passes,
        'computing_change_sigmas': stage.change, 'computing_percent': 100 * stage.done,
    } | {f'{name}_ok': answer for name, answer in checks.items()} | status_keys(
        view.forecast, view.forecast_age_s)
    return DiagnosticStatus(
        level=level(view), name=STATUS_NAME, message=sentence(view, hint, checks),
        hardware_id='odocal',
        values=[KeyValue(key=k, value=_value_text(v, DECIMALS.get(k))) for k, v in keys.items()])


def _wheel_factors(view: SessionView) -> dict[str, object]:
    """Return key -> factor or sigma of each wheel of a vehicle with more than two."""
    calibration = view.session.calibration
    estimates = calibration.estimates if calibration else {}
    return {f'{name}{end}': math.nan if value is None else value
            for name in wheel_factors(estimates) if name not in RESULT_PARAMETERS
            for end, value in (('', estimates[name].value), ('_sigma', estimates[name].sigma))}


def current_value(view: SessionView, name: str) -> float:
    """Return a value or sigma of the result, or of the running estimate until the leg has one."""
    if view.session.state is not State.RECORDING and view.forecast is None:
        return float(view.results[f'result.{name}'])
    estimate = (view.forecast.estimates if view.forecast else {}).get(name.removesuffix('_sigma'))
    if estimate is None or estimate.value is None:
        return math.nan
    number = estimate.sigma if name.endswith('_sigma') else estimate.value
    return math.nan if number is None else float(number)


def level(view: SessionView) -> Any:
    """Return STALE before any message, ERROR if action is required, WARN for cautions."""
    state = view.session.state
    if state in (State.FAILED, State.REJECTED) or view.is_rejected_so_far:
        return DiagnosticStatus.ERROR
    if state is State.IDLE and not view.has_received:
        return DiagnosticStatus.STALE
    unused = view.session.unused_reason
    has_warning = (
        state is State.CALIBRATED and view.session.verdict() != Verdict.ACCEPTED.value
        or view.missing_inputs or view.clock_differences or view.journal_error or view.save_error
        or view.dropped_leg or view.faults or view.duplicate_publishers
        or _change_texts(view.session) or unused and unused.code not in SHORT_MOVE_CODES)
    return DiagnosticStatus.WARN if has_warning else DiagnosticStatus.OK


def sentence(view: SessionView, hint: str, checks: dict[str, str]) -> str:
    """Return state, accuracy, next action (hint) and problems; checks : of limits."""
    session = view.session
    legs = counted(len(session.legs), 'leg')
    if session.carried:
        legs += f' and {session.carried.legs} before'
    state_text = {
        'waiting': 'Waiting',
        'idle': 'Ready',
        'recording': f'Recording leg {session.leg_id}: {view.distance_m:.0f} m in '
                     f'{view.duration_s:.0f} s',
        'computing': f'Computing leg {session.leg_id}',
        'calibrated': f'Calibrated from {legs}, {session.verdict()}',
        'rejected': 'Rejected',
        'failed': f'Failed: {session.failure}',
    }[view.state]
    if view.restored_stamp and session.state is State.IDLE:
        state_text += f', including the result restored from {view.restored_stamp}'
    within_limits = '' if session.state is State.RECORDING else quantities.quantities_text(checks)
    errors = [f'{statement}: {error}' for statement, error in (
        ('the result is not saved', view.save_error),
        ('the journal cannot be written', view.journal_error)) if error]
    return '; '.join(filter(None, (
        state_text, *_change_texts(session), within_limits, view.dropped_leg, hint,
        _unused_text(session), *view.duplicate_publishers, losses_text(view.lost_messages),
        *errors)))


def _change_texts(session: Session) -> list[str]:
    """Return the texts on changes of the scale between the legs."""
    return [r.text for r in session.reasons if r.code is Code.SCALE_CHANGED]


def _unused_text(session: Session) -> str:
    return f'a leg was not used: {session.unused_reason}' if session.unused_reason else ''


def _automatic_text(view: SessionView) -> str:
    if not view.config.leg.automatic:
        return ''
    if view.session.state is not State.RECORDING:
        return 'waiting'
    return 'leg' if view.session.is_automatic else 'started by the operator'


def _value_text(value: object, places: int | None = None) -> str:
    """Return a value as text for PlotJuggler: a number without unit, in full or rounded."""
    if not isinstance(value, float):
        return str(value)
    return repr(float(value) if places is None or not math.isfinite(value)
                else round(float(value), places))


def input_status(name: str, health: Health, missing_reason: str, is_needed: bool,
                 now_ns: int) -> DiagnosticStatus:
    """
    Return the health of one input for ``/diagnostics``.

    Levels as in diagnostic_updater: no messages are an ERROR from the start, or a WARN if no leg
    needs the input. STALE is left to the aggregator, for nodes that no longer report.
    """
    rate, silent = health.rate_hz(now_ns), health.silent_s(now_ns)
    if missing_reason:
        status = DiagnosticStatus.ERROR if is_needed else DiagnosticStatus.WARN
        message = missing_reason
    elif health.fix_status is not None and health.fix_status < 0:
        status, message = DiagnosticStatus.WARN, f'no position: NavSatStatus {health.fix_status}'
    elif health.unreadable_count:
        status = DiagnosticStatus.WARN
        message = f'{rate:.1f} Hz, {health.unreadable_count} messages unreadable'
    else:
        status, message = DiagnosticStatus.OK, f'{rate:.1f} Hz'
    # the first two have the names of diagnostic_updater, which monitors search for
    values = {'Events since startup': health.count, 'Actual frequency (Hz)': rate,
              'rate_hz': rate, 'age_s': silent if math.isfinite(silent) else -1.0,
              'messages': health.count, 'gaps': health.gap_count, 'dropped': health.lost_count,
              'unreadable': health.unreadable_count, 'stamp_delay_s': health.delay_s}
    if health.fix_status is not None:
        values['fix_status'] = health.fix_status
    return DiagnosticStatus(
        level=status, name=name, message=message, hardware_id='odocal',
        values=[KeyValue(key=k, value=_value_text(v)) for k, v in values.items()])


class Publishing:
    """The publishers of the node, and its parameters ``result.*``."""

    def __init__(self, node: Node) -> None:
        no_callbacks = PublisherEventCallbacks(use_default_callbacks=False)
        publisher_of = partial(node.create_publisher, event_callbacks=no_callbacks)
        self._node = node
        self._status = publisher_of(DiagnosticArray, '~/status', LATCHED)
        self.status_topic: str = self._status.topic_name      # resolved
        self._diagnostics = publisher_of(DiagnosticArray, '/diagnostics', 1)
        self._hint = publisher_of(String, '~/hint', LATCHED)
        self._plotted = {name: publisher_of(Float64, f'~/{name}', LATCHED) for name in PLOTTED}
        self._last_messages: dict[Publisher, str] = {}        # last message of each
        self._paths = [publisher_of(PathMessage, f'~/path/{name}', LATCHED)
                       for name in ('dead_reckoning', 'reference')]
        self.setting_results = False      # true while the node itself sets ``result.*``
        self.restored_results = self.results()      # published while no leg is kept

    def results(self) -> dict[str, Any]:
        return {name: self._node.get_parameter(name).value for name in params.RESULTS}

    def scale_factor(self) -> float:
        """Return the scale factor in force, NaN without one."""
        return float(self._node.get_parameter('result.scale_factor').value)

    def set_results(self, calibration: Calibration | None) -> None:
        """Set all ``result.*`` at once; None: to the restored result, if there is one."""
        results = self.restored_results
        if calibration:
            stamp = date_text(iso(self._node.get_clock().now().nanoseconds))
            results = params.result_values(calibration, stamp,
                                           self._node.get_parameter('vehicle').value)
        self.setting_results = True
        try:
            self._node.set_parameters_atomically(
                [Parameter(name, value=value) for name, value in results.items()])
        finally:
            self.setting_results = False

    def show_paths(self, messages: Paths) -> None:
        for publisher, message in zip(self._paths, messages, strict=True):
            publisher.publish(message)

    def show_status(self, view: SessionView) -> DiagnosticArray:
        array = self._array([calibration_status(view)])
        # the hint first: receivers of the status then have it
        self._show(self._hint, String(data=answers.hint(view, action_first=True)))
        self._status.publish(array)
        for name, publisher in self._plotted.items():
            self._show(publisher, Float64(data=current_value(view, name)))
        return array

    def _show(self, publisher: Publisher, message: Float64 | String) -> None:
        """Publish a message if it differs from the last one; NaN equals NaN."""
        if repr(message) != self._last_messages.get(publisher):
            self._last_messages[publisher] = repr(message)
            publisher.publish(message)

    def show_diagnostics(self, recording: Recording, config: Config) -> None:
        node = self._node.get_fully_qualified_name()
        if not config.diagnostic_updater.use_fqn:
            node = node.lstrip('/')      # with its namespace, to separate vehicles
        required = recording.inputs.required(config)
        self._diagnostics.publish(self._array([
            input_status(f'{node}: {SLOT_NAMES.get(slot, slot)}', source.health,
                         source.missing_reason(), source in required, time.monotonic_ns())
            for slot, source in recording.inputs.by_slot.items()
            if source in required or slot in recording.inputs.topics]))

    def _array(self, statuses: list[DiagnosticStatus]) -> DiagnosticArray:
        array = DiagnosticArray(status=statuses)
        array.header.stamp = self._node.get_clock().now().to_msg()
        return array
