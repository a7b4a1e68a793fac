# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Compare a calibration with the truth of its drive.

``python -m odocal_ros.offline.against_truth calibration.json truth.yaml``: exit 0 if every
value agrees, 1 if one does not, 2 if the files cannot be read. A value agrees inside the
truth's ``accept`` interval if it has one, else within four sigmas.
"""

import json
import math
from pathlib import Path
import sys
from typing import Any, NamedTuple

from odocal_ros.errors import BadUsage, OdocalError
from odocal_ros.offline.cli import print_text, warn
from odocal_ros.output.summary import DEG
from odocal_ros.output.value_text import with_sigma


class Row(NamedTuple):
    """A value and its truth, both in the printed unit."""

    name: str
    value: float | None
    sigma: float | None
    truth: float
    truth_sigma: float      # 0: exact
    accept: list[float]     # limits of the value; empty: four sigmas from the truth

    @property
    def error_in_sigmas(self) -> float:
        """Return the error divided by its sigma, nan without value or sigma."""
        if self.value is None or self.sigma is None:
            return math.nan
        return (self.value - self.truth) / max(math.hypot(self.sigma, self.truth_sigma), 1e-300)

    @property
    def agrees(self) -> bool:
        """Return True if the value agrees with the truth, or is not determined."""
        limit = 4.0    # sigmas: exceeded by chance in one of 16 000
        return self.value is None or (
            self.accept[0] <= self.value <= self.accept[1] if self.accept
            else abs(self.error_in_sigmas) <= limit)


def rows(calibration: dict[str, Any], truth: dict[str, dict[str, Any]]) -> list[Row]:
    """
    Return each value with a known truth.

    calibration : content of calibration.json.   truth : content of a truth.yaml, of odocal
    simulate (``scale`` is the factor) or of a real drive (``scale`` is the ratio to nominal).
    """
    scale = 'scale_factor' if 'ratio' in truth.get('scale', ()) else 'scale_ratio'
    compared = []
    for name, key in ((scale, 'scale'), ('yaw_mounting_angle', 'yaw_mounting_deg'),
                      ('pitch_mounting_angle', 'pitch_mounting_deg')):
        if key in truth:
            factor = DEG if key.endswith('_deg') else 1.0
            entry, true = calibration['result'][name], truth[key]
            value, sigma = (None if entry[part] is None else entry[part] * factor
                            for part in ('value', 'sigma'))
            unit = 'deg' if key.endswith('_deg') else entry['unit']
            label = name.replace('_', ' ') + f', {unit}' * (unit not in (None, '1'))
            compared.append(Row(label, value, sigma, float(true['value']),
                                float(true.get('sigma', 0.0)),
                                list(map(float, true.get('accept') or ()))))
    return compared


def table(compared: list[Row]) -> str:
    """Return values, truth and errors in sigmas as text."""
    lines = [f'{"":<28}{"result":<32}{"truth":<20}error']
    for row in compared:
        truth = with_sigma(row.truth, row.truth_sigma) if row.truth_sigma else f'{row.truth:.8g}'
        value = with_sigma(row.value, row.sigma) if row.value is not None else 'not determined'
        error = '' if math.isnan(row.error_in_sigmas) else f'{row.error_in_sigmas:+z.1f} sigma'
        lines.append(f'{row.name:<28}{value:<32}{truth:<20}{error:<14}'
                     f'{"" if row.agrees else "DOES NOT AGREE"}'.rstrip())
    return '\n'.join(lines)


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
