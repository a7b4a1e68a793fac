# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Pass or fail in words, and as one line of JSON for the computer of a production line."""

import json
import math

from odocal_ros.calib.result import Calibration
from odocal_ros.output.figures import with_sigma
from odocal_ros.pipeline.acceptance import Acceptance, Held
from odocal_ros.settings.config import Config


def accept_line(calibration: Calibration, acceptance: Acceptance, config: Config) -> str:
    """Return the decision on a vehicle as one line of JSON."""
    return json.dumps({'vehicle': config.vehicle, **acceptance.as_dict(),
                       'verdict': calibration.verdict.value,
                       'reasons': [r.code.name for r in calibration.reasons]}, allow_nan=False)


def accept_words(acceptance: Acceptance) -> list[str]:
    """Return the decision, a line on each value, and what to do where it is open."""
    lines = [acceptance.decision.value, *(f'  {_value(held)}' for held in acceptance.values)]
    if acceptance.why:
        lines.append(f'  {acceptance.why}')
    return lines + ([f'  -> {acceptance.do}'] if acceptance.do else [])


def _value(held: Held) -> str:
    e, angle = held.estimate, held.estimate.unit == 'rad'
    factor = math.degrees(1.0) if angle else 1.0
    unit = ' deg' if angle else f' {e.unit}' * (e.unit not in ('', '1'))
    name = held.name.replace('_', ' ')
    limits = ' to '.join('any' if math.isinf(x) else f'{x * factor:g}'
                         for x in (held.low, held.high))
    shown = 'not determined' if e.value is None else (
        f'{with_sigma(e.value, e.sigma, factor)}{unit}')
    return f'{held.decision.value:9} {name} {shown}, limits {limits}{unit}'
