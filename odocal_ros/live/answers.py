# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Answers of the services, each as one line."""

from collections.abc import Iterable, Sequence

from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.errors import OdocalError
from odocal_ros.live.session import Restored, SessionView
from odocal_ros.output.summary import sentence, values_in_words
from odocal_ros.outside.names import said_by
from odocal_ros.reasons import cautions, Verdict

MOST_REASONS = 3     # judgement: in an answer


def outcome(calibration: Calibration, parts: Sequence[LegResult] = (), leg_id: int = 0,
            good: str = '', advice: str = '') -> tuple[bool, str]:
    """
    Return the answer that carries a result: values, verdict, legs, what to do better.

    good, advice : which quantities are good enough, and what to do next, as the status says them.
    A rejected calibration is no success: a script must not take its values for good.
    """
    text = sentence(calibration)
    if parts and len(calibration.legs) > 1:
        verdict = Verdict.worst(one.verdict for one in parts)
        cut = f' in {len(parts)} parts' if len(parts) > 1 else ''
        text = (f'leg {leg_id}{cut}, {sum(one.distance for one in parts):.0f} m, '
                f'{verdict.value}; all legs {text}')
    said = [text, good]
    for reason in cautions(calibration.reasons)[:MOST_REASONS]:
        said += [f'{reason.code.name}: {reason.text}', reason.remedy]
    if advice and advice not in said:
        said.append(f'Next: {advice}')
    return calibration.verdict is not Verdict.REJECTED, _sentences(said)


def provisional(at_stop: SessionView) -> str:
    """
    Return the answer that a leg is being computed, with its running estimate.

    at_stop : as it was just before the stop mark.   The word *provisional* stands where the
    answer with the result has its verdict.
    """
    session, forecast = at_stop.session, at_stop.forecast
    known = forecast.estimates if forecast else {}
    estimate = 'there is no running estimate'
    if any(e.value is not None for e in known.values()):
        estimate = (f'the running estimate is {values_in_words(known)}, computed '
                    f'{at_stop.forecast_age_s:.0f} s before the end')
    faults = [f'Now it would be rejected: {r.code.name}: {r.text}'
              for r in at_stop.faults[:1] if at_stop.lost_cause]
    of_all = ' of all legs' if session.legs else ''
    return _sentences([
        f'provisional: leg {session.leg_id} is being computed; {estimate}', *faults,
        f'The final result{of_all} with its verdict follows on ~/status and in the parameters '
        'result.*; call ~/stop_leg again to wait for it'])


def restored(result: Restored, unit: str, good: str) -> tuple[bool, str]:
    """Return the answer that carries a restored result; ``unit`` is that of its scale."""
    return result.valid, _sentences([f'no leg is running; {result.words(unit)}', good,
                                     'Next: drive a leg to update it'])


def _sentences(parts: Iterable[str]) -> str:
    """Return sentences one after the other, each ended once."""
    *before, last = filter(None, parts)
    return ' '.join([*(f'{part.rstrip(".")}.' for part in before), last])


def one_line(error: BaseException) -> str:
    """Return an error as one line; an unexpected one is named an internal error."""
    text = said_by(error)
    if isinstance(error, OdocalError):
        return text
    return f'internal error, please report it: {type(error).__name__}: {text}'
