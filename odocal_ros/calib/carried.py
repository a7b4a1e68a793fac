# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Prior of a vehicle from its earlier legs, without their data: for later days and restarts."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from odocal_ros.calib.border import Border, SCATTER_POINTS
from odocal_ros.data.arrays import Floats

NUMBERS = [f for f in fields(Border) if f.name not in ('names', 'evidence')]
NOTHING = {'sigma': np.inf, 'used': np.inf}      # for a null in a file


@dataclass(frozen=True, eq=False)
class Carried:
    """
    Border of all legs so far, with the scale at the last leg.

    unit : of the scale.   first_ns, last_ns : start times of the first and of the last leg.
    legs : number of legs.
    """

    border: Border
    unit: str
    first_ns: int
    last_ns: int
    legs: int

    def includes(self, other: 'Carried') -> bool:
        """Return True if it contains all the information of another."""
        return self.first_ns == other.first_ns and self.legs > other.legs

    def only(self, names: Sequence[str], keeps: float | Floats) -> 'Carried':
        """
        Return the information on some constants.

        keeps : share of its prior sigma by which each constant may have changed until use.
        """
        border = self.border.only(names)
        return replace(self, border=border.loosened(
            dict(zip(border.names, (keeps * border.used).tolist(), strict=True))))

    def as_dict(self) -> dict[str, Any]:
        """Return the content for calibration.json."""
        border = {f.name: np.asarray(getattr(self.border, f.name)).tolist() for f in NUMBERS}
        border |= {'names': list(self.border.names),
                   'evidence': {n: x.tolist() for n, x in self.border.evidence.items()}}
        return {'unit': self.unit, 'first_ns': self.first_ns, 'last_ns': self.last_ns,
                'legs': self.legs, 'border': border}


def carried_from(content: dict[str, Any]) -> Carried:
    """
    Return the Carried from the dict of ``as_dict``; null: a value that is not finite.

    Raises
    ------
    ValueError
        The content is not valid.

    """
    try:
        entry = content['border']
        names = tuple(map(str, entry['names']))
        m = len(names)
        numbers = {f.name: _array(entry[f.name], (m, m) if f.name == 'information' else (m,),
                                  NOTHING.get(f.name, np.nan))
                   for f in NUMBERS}
        evidence = {str(n): _array(x, (SCATTER_POINTS,), np.nan)
                for n, x in dict(entry.get('evidence', {})).items()}
        return Carried(Border(names, **numbers, evidence=evidence), str(content['unit']),
                       int(content['first_ns']), int(content['last_ns']), int(content['legs']))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f'carried: {error}') from None


def _array(values: Any, shape: tuple[int, ...], nothing: float) -> Floats:
    found = np.array([nothing if x is None else float(x) for x in np.ravel(values)])
    if found.size != np.prod(shape) or np.isnan(found).any():
        raise ValueError(f'{np.size(values)} numbers; required: {shape}, or null')
    return found.reshape(shape)
