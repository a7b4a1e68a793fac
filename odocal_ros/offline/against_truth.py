# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Compare a calibration with the truth of its drive.

``python -m odocal_ros.offline.against_truth calibration.json truth.yaml``: exit 0 if every
value agrees, 1 if one does not, 2 if the files cannot be read. A value agrees inside the
truth's ``accept`` interval if it has one, else within four sigmas.
"""

from dataclasses import dataclass
import json
import math
from pathlib import Path
import sys
from typing import Any

from odocal_ros.errors import BadUsage, OdocalError
from odocal_ros.offline.cli import print_text, warn
from odocal_ros.output.summary import DEG
from odocal_ros.output.value_text import with_sigma


@dataclass(frozen=True)
class Row:
    """A value and its truth, both in the printed unit."""

    name: str
    value: float | None
    sigma: float | None
    truth: float
    truth_sigma: float = 0.0
    accept: tuple[float, float] | None = None

    @property
    def error_in_sigmas(self) -> float | None:
        """Return the error divided by its sigma, None without value or sigma."""
        if self.value is None or self.sigma is None:
            return None
        return (self.value - self.truth) / max(math.hypot(self.sigma, self.truth_sigma), 1e-300)

    @property
    def agrees(self) -> bool:
        """Return True if the value agrees with the truth; a missing value is not an error."""
        if self.value is None:
            return True
        if self.accept is not None:
            return self.accept[0] <= self.value <= self.accept[1]
        limit = 4.0    # sigmas: exceeded by chance in one of 16 000
        return self.error_in_sigmas is not None and abs(self.error_in_sigmas) <= limit


def rows(calibration: dict[str, Any], truth: dict[str, dict[str, Any]]) -> list[Row]:
    """
    Return each value with a known truth.

    calibration : content of calibration.json.   truth : content of a truth.yaml, of odocal
    simulate (``scale`` is the factor) or of a real drive (``scale`` is the ratio to nominal).
    """
    scale = 'scale_factor' if 'ratio' in truth.get('scale', ()) else 'scale_ratio'
    return [_row(name, calibration['result'], truth[key], factor) for name, key, factor in (
        (scale, 'scale', 1.0), ('yaw_mounting_angle', 'yaw_mounting_deg', DEG),
        ('pitch_mounting_angle', 'pitch_mounting_deg', DEG)) if key in truth]


def _row(name: str, result: dict[str, dict[str, Any]], truth: dict[str, Any],
         factor: float) -> Row:
    entry = result[name]
    value, sigma = (None if entry[key] is None else entry[key] * factor
                    for key in ('value', 'sigma'))
    unit = 'deg' if factor != 1.0 else entry['unit'] or ''
    accept = truth.get('accept')
    return Row(f'{name.replace("_", " ")}{f", {unit}" if unit not in ("", "1") else ""}', value,
               sigma, float(truth['value']), float(truth.get('sigma', 0.0)),
               None if accept is None else (float(accept[0]), float(accept[1])))


def table(compared: list[Row]) -> str:
    """Return values, truth and errors in sigmas as text."""
    lines = [f'{"":<28}{"found":<32}{"truth":<20}off by']
    for row in compared:
        if row.value is None:
            lines.append(f'{row.name:<28}{"not determined":<32}{_truth(row)}')
            continue
        error_text = '' if row.error_in_sigmas is None else f'{row.error_in_sigmas:+z.1f} sigma'
        lines.append(f'{row.name:<28}{with_sigma(row.value, row.sigma):<32}{_truth(row):<20}'
                     f'{error_text:<14}{"" if row.agrees else "DOES NOT AGREE"}'.rstrip())
    return '\n'.join(lines)


def _truth(row: Row) -> str:
    return with_sigma(row.truth, row.truth_sigma) if row.truth_sigma else f'{row.truth:.8g}'


def main(argv: list[str] | None = None) -> int:
    argv = sys.argv[1:] if argv is None else argv
    try:
        if len(argv) != 2:
            raise BadUsage('required: two files: calibration.json truth.yaml')
        compared = rows(*(_read(Path(name)) for name in argv))
        if not compared or compared[0].value is None:
            raise BadUsage(f'{argv[0]}: no scale factor to compare; see its reasons')
    except OdocalError as error:
        warn(f'against_truth: {error}')
        return 2
    print_text(table(compared))
    return 0 if all(row.agrees for row in compared) else 1


def _read(path: Path) -> dict[str, dict[str, Any]]:
    import yaml
    try:
        text = path.read_text(encoding='utf-8')
        content = json.loads(text) if path.suffix == '.json' else yaml.safe_load(text)
    except OSError as error:
        raise BadUsage(f'{path}: cannot be read ({error.strerror})') from None
    except (ValueError, yaml.YAMLError) as error:
        raise BadUsage(f'{path}: {" ".join(str(error).split())}') from None
    if not isinstance(content, dict) or path.suffix == '.json' and 'result' not in content:
        raise BadUsage(f'{path}: wrong file; required: calibration.json and truth.yaml')
    return content


if __name__ == '__main__':
    sys.exit(main())
