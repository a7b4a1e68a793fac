# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Texts for the operator from a ``SessionView``: next action (hint), answers of services."""

from collections.abc import Iterable, Sequence

from odocal_ros.calib.choice import deciding_methods, REASON_ESTIMATES
from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.errors import OdocalError
from odocal_ros.forecast import quantities
from odocal_ros.forecast.forecast import PREDICTED_REST_S
from odocal_ros.forecast.progress import clock_difference_text
from odocal_ros.live.session import RestoredResult, SessionView, State
from odocal_ros.output.summary import sentence, values_in_words
from odocal_ros.output.value_text import counted
from odocal_ros.reasons import cautions, Reason, Verdict
from odocal_ros.safe_io.text_formats import error_text

MAX_REASONS = 3     # judgement: in an answer
KMH = 3.6    # definition: km/h per m/s
MAX_FORECAST_AGE_S = 15.0    # judgement: above it, the age is reported
MIN_MARKS = 2         # judgement: marks from which the hint no longer asks for ~/mark
DRIVE = 'drive '
DRIVE_ON = ('then drive on, with stops and left and right turns, until this hint shows OK for '
            'scale and yaw')
STRAIGHT = 'drive straight at normal speed until left and right scale are separable'
TURNS = 'for the track width: turn by 90 deg in total or more'
SPOT_TURNS = ('for the track width: turn on the spot in both directions, and drive straight for a '
              'metre after each turn')


def result_answer(calibration: Calibration, parts: Sequence[LegResult] = (), leg_id: int = 0,
                  within_limits: str = '', advice: str = '') -> tuple[bool, str]:
    """
    Return (success, text) of a result: values, verdict, legs, cautions and the next action.

    parts : results of the leg's sections.   within_limits, advice : texts on quantities that meet
    their limits, and on the next action, as in the status.
    A rejected calibration is no success, so that a script does not use its values.
    """
    text = sentence(calibration)
    if parts and len(calibration.legs) > 1:
        verdict = Verdict.worst(part.verdict for part in parts)
        sections = f' in {len(parts)} sections' if len(parts) > 1 else ''
        text = (f'leg {leg_id}{sections}, {sum(part.distance for part in parts):.0f} m, '
                f'{verdict.value}; all legs {text}')
    sentences = [text, within_limits]
    for reason in cautions(calibration.reasons)[:MAX_REASONS]:
        sentences += [str(reason), reason.remedy]
    if advice and advice not in sentences:
        sentences.append(f'Next: {advice}')
    return calibration.verdict is not Verdict.REJECTED, _sentences(sentences)


def provisional_answer(at_stop: SessionView) -> str:
    """Return a *provisional* answer with the running estimate; at_stop : view before the mark."""
    session, forecast = at_stop.session, at_stop.forecast
    estimates = forecast.estimates if forecast else {}
    estimate = 'there is no running estimate'
    if any(e.value is not None for e in estimates.values()):
        estimate = (f'the running estimate is {values_in_words(estimates)}, computed '
                    f'{at_stop.forecast_age_s:.0f} s before the end')
    faults = [f'The leg would be rejected: {reason}'
              for reason in at_stop.faults[:1] if at_stop.is_rejected_so_far]
    combined = ' of all legs' if session.legs else ''
    return _sentences([
        f'provisional: leg {session.leg_id} is being computed; {estimate}', *faults,
        f'The final result{combined} with its verdict follows on ~/status and in the parameters '
        'result.*; call ~/stop_leg again to wait for it'])


def restored_answer(result: RestoredResult, unit: str, within_limits: str) -> tuple[bool, str]:
    """Return (success, text) of a restored result; ``unit`` is that of its scale."""
    return result.is_valid, _sentences([
        f'no leg is running; {result.as_text(unit)}', within_limits,
        'Next: drive a leg to update it'])


def _sentences(parts: Iterable[str]) -> str:
    """Join non-empty sentences; all but the last get one full stop."""
    *before, last = filter(None, parts)
    return ' '.join([*(f'{part.rstrip(".")}.' for part in before), last])


def error_line(error: BaseException) -> str:
    """Return an error as one line; an unexpected one is reported as an internal error."""
    text = error_text(error)
    if isinstance(error, OdocalError):
        return text
    return f'internal error, please report it: {type(error).__name__}: {text}'


def hint(view: SessionView, action_first: bool = False) -> str:
    """Return the next action; action_first : in a leg, it comes before the estimate."""
    session, state = view.session, view.session.state
    if state is State.COMPUTING:
        return f'computing: {view.stage.as_text() or "started"}; the result follows on ~/status'
    if state is State.FAILED:
        return ('call ~/stop_leg to compute the leg again, or ~/cancel_leg to drop it'
                if session.has_open_leg else 'call ~/reset')
    if view.is_rejected_so_far:
        return '; '.join([_fault_text(view), *view.missing_inputs[:1]])
    if view.missing_inputs:
        return view.missing_inputs[0]
    if view.clock_differences:
        return clock_difference_text(view.clock_differences)
    if state is State.RECORDING:
        actions, facts = _recording_hint(view)
        return '; '.join([*(actions or ['drive on']), *facts] if action_first else
                         [*facts, *actions])
    if state is State.IDLE:
        if view.config.leg.automatic and view.has_imu:
            return 'start driving: a leg starts automatically'
        if view.still_s < PREDICTED_REST_S:
            return (f'stand still {PREDICTED_REST_S:.0f} s before ~/start_leg '
                    f'({view.still_s:.0f} s so far)')
        return 'call ~/start_leg'
    return advice_after_result(view)


def limit_checks(view: SessionView) -> dict[str, str]:
    """Return quantity -> yes, no or unknown: its limit is met in the leg, else in the result."""
    session = view.session
    if session.state is State.RECORDING:
        return quantities.check_forecast(view.forecast, view.config, view.two_wheels,
                                         view.is_rejected_so_far)
    if session.state is not State.COMPUTING and session.calibration is not None:
        return quantities.check_calibration(session.calibration, view.config, view.two_wheels)
    if session.state is not State.COMPUTING and session.restored_result is not None:
        return quantities.check_estimates(session.restored_result.estimates, view.config,
                                          view.two_wheels, session.restored_result.is_valid)
    return quantities.all_unknown()


def metres_to_go(view: SessionView) -> float:
    """Return the distance that the leg lacks to leg.min_distance, m; 0 without a leg."""
    if view.session.state is not State.RECORDING:
        return 0.0
    return max(0.0, view.leg.min_distance - view.distance_m)


def seconds_to_stand(view: SessionView) -> float:
    """Return the seconds of standstill still required, before the start or at the end of a leg."""
    if view.session.state is State.RECORDING or not view.session.is_busy:
        return max(0.0, PREDICTED_REST_S - view.still_s)
    return 0.0


def manoeuvres(view: SessionView) -> list[str]:
    """Return the missing manoeuvres of the leg, besides metres and standstill."""
    if view.session.state is not State.RECORDING:
        return []
    required, min_speed = [], view.leg.min_speed
    if view.max_speed < min_speed:
        required.append(f'{DRIVE}faster than leg.min_speed, {min_speed:.3g} m/s '
                        f'({KMH * min_speed:.0f} km/h)')
    if view.config.reference.points and len(view.session.marks_of_leg()) < MIN_MARKS:
        required.append('call ~/mark at rest on each point')
    if view.two_wheels and 'smoother' in deciding_methods(view.session.config.method):
        required += _wheel_manoeuvres(view)
    return required + (view.forecast.manoeuvres if view.forecast else [])


def _wheel_manoeuvres(view: SessionView) -> list[str]:
    """Return the manoeuvres for the wheels; before the first update only for the track width."""
    config = view.session.config
    wheels = None if view.forecast is None else view.forecast.wheels
    limit = quantities.QUANTITIES['left_right'].limit(config)
    required = []
    if wheels is not None and not (wheels.left_right is not None and wheels.left_right <= limit):
        required.append(STRAIGHT)
    if not config.odometer.track_width and (wheels is None or wheels.track_width is None):
        required.append(TURNS if view.has_imu else SPOT_TURNS)
    return required


def _recording_hint(view: SessionView) -> tuple[list[str], list[str]]:
    """Return the hint as two lists: actions, then facts."""
    metres, required = metres_to_go(view), manoeuvres(view)
    facts = list(map(str, view.faults[:1]))     # a caution, or a gap
    if metres > 0 or view.max_speed < view.leg.min_speed:
        if metres > 0:
            required = [f'{DRIVE}{metres:.0f} m more',
                        *(text.removeprefix(DRIVE) for text in required)]
        end = _end_text(view) if view.session.is_automatic else DRIVE_ON
        return [', '.join(required), end], facts
    if view.forecast is None:
        return [*required, _end_text(view)], facts
    facts.append(view.forecast.as_text(view.distance_m))
    if view.forecast_age_s > MAX_FORECAST_AGE_S:
        facts.append(f'estimate is {view.forecast_age_s:.0f} s old')
    is_last_step = view.forecast.is_complete or view.session.is_automatic
    return required + ([_end_text(view)] if is_last_step else []), facts


def _fault_text(view: SessionView) -> str:
    text = f'{view.faults[0]}. {view.faults[0].remedy.rstrip(".")}'
    if view.session.is_automatic:
        return f'the leg will not be used: {text}; the next leg starts automatically'
    return f'call ~/cancel_leg and start again: the leg would be rejected: {text}'


def _end_text(view: SessionView) -> str:
    if view.session.is_automatic:
        remaining_min = view.session.config.leg.automatic_minutes - view.duration_s / 60
        return ('the leg ends automatically at a standstill, or within '
                f'{max(1, round(remaining_min))} min')
    if view.still_s < view.session.config.leg.standstill:
        return f'stand still {PREDICTED_REST_S:.0f} s at the end point, then call ~/stop_leg'
    remaining_s = seconds_to_stand(view)
    return (f'stand still {remaining_s:.0f} s more, then ' if remaining_s >= 1
            else '') + 'call ~/stop_leg'


def advice_after_result(view: SessionView) -> str:
    """Return the advice after a result: the largest improvement, then the other quantities."""
    reasons, config = view.session.reasons, view.config
    missing_legs = config.verdict.min_legs - len(view.session.legs)
    if missing_legs > 0:
        return f'drive {counted(missing_legs, "more leg")}'
    if warnings := cautions(reasons):
        return warnings[0].remedy
    save = '' if config.output.autosave or view.saved_folder else 'call ~/save, or '
    text = ('drive on: legs start and end automatically' if config.leg.automatic else
            f'{save}drive another leg for a smaller sigma')
    return '; '.join([text, *_remedies(reasons, limit_checks(view))])


def _remedies(reasons: Sequence[Reason], checks: dict[str, str]) -> list[str]:
    """Return the remedies of the reasons about quantities that exceed their limits."""
    # estimate -> label of its quantity
    labels = {estimate: quantities.QUANTITIES[name].label for name, check in checks.items()
              if check == quantities.NO for estimate in quantities.QUANTITIES[name].estimates}
    return list(dict.fromkeys(
        f'for the {labels[REASON_ESTIMATES[r.code]]}: {r.remedy[0].lower()}{r.remedy[1:]}'
        for r in reasons if REASON_ESTIMATES.get(r.code) in labels))
