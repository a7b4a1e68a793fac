"""What a service answers, in one line."""

from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.errors import OdocalError
from odocal_ros.output.summary import sentence
from odocal_ros.reasons import Verdict

MOST_REASONS = 3


def outcome(calibration: Calibration, leg: LegResult | None = None,
            leg_id: int = 0) -> tuple[bool, str]:
    """
    Return the answer that carries a result: values, verdict, legs, what to do better.

    A rejected calibration is no success: a script must not take its values for good.
    """
    text = sentence(calibration)
    reasons = _worth_telling(calibration)
    if leg is not None and len(calibration.legs) > 1:
        text = f'leg {leg_id}, {leg.distance:.0f} m, {leg.verdict.value}; all legs {text}'
    for reason in reasons[:MOST_REASONS]:
        text = (f'{text.rstrip(".")}. {reason.code.name}: {reason.text.rstrip(".")}. '
                f'{reason.remedy}')
    return calibration.verdict is not Verdict.REJECTED, text


def _worth_telling(calibration: Calibration) -> list:
    """Return the reasons that lowered the verdict, the gravest first."""
    order = list(Verdict)
    grave = [r for r in calibration.reasons if r.code.gravity is not Verdict.ACCEPTED]
    return sorted(grave, key=lambda r: -order.index(r.code.gravity))


def one_line(error: BaseException) -> str:
    """Return an error as one line; one that was not foreseen says so."""
    text = ' '.join(str(error).split())
    if isinstance(error, OdocalError):
        return text
    return f'internal error, please report it: {type(error).__name__}: {text}'
