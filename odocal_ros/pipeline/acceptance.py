# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Comparison of a calibration with limits, as at the end of a production line: pass or fail.

A value passes if its two-sigma interval is within its limits, and fails if all of it is outside;
otherwise it is undecided, and more must be driven. With a correct sigma a vehicle on a limit or
beyond passes in at most 2.3 % of all cases, and one within its limits fails at most as often
(docs/fleet.md).
"""

from dataclasses import dataclass
from enum import Enum
import math
from typing import Any

from odocal_ros.calib.choice import REASON_ESTIMATES
from odocal_ros.calib.result import Calibration, Estimate
from odocal_ros.nav.rotations import wrap
from odocal_ros.reasons import Code, Reason, Verdict
from odocal_ros.settings.config import Config

LIMIT_SIGMAS = 2.0      # statistical: of a value, on one side of its limit; once in 44
DRIVE_MORE = {'scale_factor': Code.SCALE_SIGMA_TOO_LARGE, 'scale_ratio':
              Code.SCALE_SIGMA_TOO_LARGE, 'yaw_mounting_angle': Code.YAW_SIGMA_TOO_LARGE,
              'pitch_mounting_angle': Code.YAW_SIGMA_TOO_LARGE}


class Decision(Enum):
    """Decision on a vehicle, the best first."""

    PASS = 'PASS'
    UNDECIDED = 'UNDECIDED'
    FAIL = 'FAIL'


@dataclass(frozen=True)
class ValueDecision:
    """A value compared with its limits."""

    name: str
    estimate: Estimate
    low: float        # limits, in the unit of the estimate; infinite: none
    high: float
    decision: Decision
    required_sigma: float | None = None    # the value passes with it; None: with no sigma

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of calibration.json."""
        return {'decision': self.decision.value, **self.estimate.as_dict(),
                'low': self.low if math.isfinite(self.low) else None,
                'high': self.high if math.isfinite(self.high) else None,
                'required_sigma': self.required_sigma}


@dataclass(frozen=True)
class Acceptance:
    """The decision on a vehicle and on each value; if undecided, the cause and the remedy."""

    decision: Decision
    values: tuple[ValueDecision, ...]
    why: str = ''
    remedy: str = ''

    def as_dict(self) -> dict[str, Any]:
        """Return the entry of calibration.json."""
        return {'decision': self.decision.value, 'why': self.why, 'remedy': self.remedy,
                'values': {entry.name: entry.as_dict() for entry in self.values}}


def decide(value: float, sigma: float, low: float, high: float) -> Decision:
    """Return PASS for a value certainly within its limits, FAIL if certainly outside."""
    lower, upper = value - LIMIT_SIGMAS * sigma, value + LIMIT_SIGMAS * sigma
    if low <= lower and upper <= high:
        return Decision.PASS
    return Decision.FAIL if upper < low or lower > high else Decision.UNDECIDED


def accept(calibration: Calibration, config: Config) -> Acceptance | None:
    """
    Return the decision on a calibration by the settings ``accept.*``; None if no limit is set.

    A vehicle fails with any of its values, and passes with all of them. A rejected calibration is
    undecided, and with ``accept.strict`` one with a caution does not pass.
    """
    unknown = Estimate(None, None, '')
    values = tuple(decide_value(name, calibration.estimates.get(name, unknown), low, high)
                   for name, (low, high) in config.accept.limits.items())
    if not values:
        return None
    worst = max((entry.decision for entry in values), key=list(Decision).index)
    is_withheld = calibration.verdict is Verdict.REJECTED or (
        config.accept.strict and calibration.verdict is not Verdict.ACCEPTED)
    if calibration.verdict is Verdict.REJECTED or (is_withheld and worst is Decision.PASS):
        reason = next(reason for reason in calibration.reasons
                      if reason.code.severity is calibration.verdict)
        return Acceptance(Decision.UNDECIDED, values, f'{calibration.verdict.value}: {reason}',
                          reason.remedy)
    if worst is not Decision.UNDECIDED:
        return Acceptance(worst, values)
    explanations = [_explain_undecided(entry, calibration.reasons) for entry in values
                    if entry.decision is Decision.UNDECIDED]
    return Acceptance(worst, values, '; '.join(why for why, _ in explanations),
                      ' '.join(dict.fromkeys(remedy for _, remedy in explanations)))


def decide_value(name: str, estimate: Estimate, low: float, high: float) -> ValueDecision:
    """Return the decision on an estimate; an angle is compared modulo one turn."""
    value, sigma = estimate.value, estimate.sigma
    if value is None or sigma is None:
        return ValueDecision(name, estimate, low, high, Decision.UNDECIDED)
    if estimate.unit == 'rad':      # wrapped to within half a turn of the limits
        middle = low if math.isinf(high) else high if math.isinf(low) else (low + high) / 2
        value = middle + float(wrap(value - middle))
    margin = min(value - low, high - value)
    return ValueDecision(name, estimate, low, high, decide(value, sigma, low, high),
                         margin / LIMIT_SIGMAS if margin > 0 else None)


def _explain_undecided(undecided: ValueDecision, reasons: tuple[Reason, ...]) -> tuple[str, str]:
    """Return the explanation why a value is undecided, and the remedy."""
    name, estimate = undecided.name.replace('_', ' '), undecided.estimate
    if estimate.value is None or estimate.sigma is None:
        parameter = 'scale_factor' if undecided.name == 'scale_ratio' else undecided.name
        reason = next((reason for reason in reasons
                       if REASON_ESTIMATES.get(reason.code) == parameter), None)
        if undecided.name == 'scale_ratio' and reason is None:
            return f'{name} is not known', 'Set odometer.nominal_scale.'
        return f'{name} is not determined', (reason or DRIVE_MORE[undecided.name]).remedy
    factor, unit = (math.degrees(1.0), ' deg') if estimate.unit == 'rad' else (1.0, '')
    if undecided.required_sigma is None:
        turn = math.tau if unit else math.inf
        excess, limit = min(((math.remainder(estimate.value - x, turn), x) for x in (
            undecided.low, undecided.high) if math.isfinite(x)), key=lambda pair: abs(pair[0]))
        return (f'{name} is {factor * (limit + excess):.5g}{unit}, beyond its limit of '
                f'{factor * limit:.5g}{unit} by less than {LIMIT_SIGMAS:g} sigma (sigma '
                f'{factor * estimate.sigma:.2g}{unit})', DRIVE_MORE[undecided.name].remedy)
    legs = math.ceil((estimate.sigma / undecided.required_sigma)**2)
    return (f'{name} is within its limits, but its sigma is {factor * estimate.sigma:.2g}{unit}; '
            f'the limit is {factor * undecided.required_sigma:.2g}{unit} (needs about {legs} '
            'times as many such legs)', DRIVE_MORE[undecided.name].remedy)
