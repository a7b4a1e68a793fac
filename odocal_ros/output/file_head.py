"""What stands at the top of every file that others load, and how numbers are written in them."""

import math

from odocal_ros.calib.result import Calibration
from odocal_ros.output.summary import sentence


def head(calibration: Calibration, content: dict) -> str:
    """Return comment lines: what made the file, when, from which bags, with which result."""
    bags = ', '.join(str(i['bag']) for i in content['inputs'] if i.get('bag')) or 'live'
    lines = [f'{content["software"]}, {content["created"]}, {len(calibration.legs)} leg'
             f'{"s" * (len(calibration.legs) != 1)}, from: {bags}', sentence(calibration)]
    return ''.join(f'# {line}\n' for line in lines)


def number(value: float | None) -> str:
    """Return a double as YAML that every reader types as one: 1e-05 is text to YAML 1.1."""
    if value is None or not math.isfinite(value):
        return '.nan'
    text = repr(float(value))
    mantissa, e, exponent = text.partition('e')
    return text if not e or '.' in mantissa else f'{mantissa}.0e{exponent}'
