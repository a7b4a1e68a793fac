# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Information of a leg's data on the constants of the vehicle, without priors.

That of earlier legs is carried on without their data: for later days and restarts.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.rotations import wrap

SCATTER_POINTS = 11     # judgement: of the grid over the scatter between legs
NOTHING = {'sigma': np.inf, 'used': np.inf}      # for a null in a file


@dataclass(frozen=True, eq=False)
class MarginalInformation:
    """
    Log likelihood of a leg as a quadratic in the constants x, its other unknowns eliminated.

    It is pull (x - value) - (x - value)' information (x - value) / 2, up to a constant,
    docs/method.md (S33). Constants are identified by name; ln K, rad, m, s.
    """

    names: tuple[str, ...]
    value: Floats  # (m,) linearisation point, as the settings are: lever arms are the full ones
    information: Floats  # (m, m), semidefinite
    pull: Floats         # (m,)
    centre: Floats       # (m,) of the priors
    sigma: Floats        # (m,) of the priors, inf: no prior
    used: Floats         # (m,) the same, widened if the leg contradicts them, or by sizes
    evidence: dict[str, Floats] = field(default_factory=dict)  # (S38)

    def widened(self, factor: float) -> 'MarginalInformation':
        """Return the information with all sigmas multiplied by a factor."""
        return replace(self, information=self.information / factor**2, pull=self.pull / factor**2)

    def plus(self, other: 'MarginalInformation') -> 'MarginalInformation':
        """Return the sum with that of a leg of the same constants, at this one's ``value``."""
        pull = other.pull - other.information @ (self.value - other.value)
        return replace(self, information=self.information + other.information,
                       pull=self.pull + pull, sigma=np.maximum(self.sigma, other.sigma),
                       used=np.maximum(self.used, other.used))

    def loosened(self, sigmas: dict[str, float]) -> 'MarginalInformation':
        """
        Return the information of a leg whose constants have errors of its own.

        The constants of the vehicle are without them.

        sigmas : by name, of each constant's own error d; inf: no information on it remains.
        The data depend on x + d; d is eliminated, docs/method.md (S34).
        """
        at = [self.names.index(name) for name in sigmas]
        taken, DA, A = eliminate_own_errors(self.information, at, np.array(list(sigmas.values())))
        left = self.information - taken @ DA.T
        return replace(self, information=(left + left.T) / 2,
                       pull=self.pull - taken @ (A.T @ self.pull))

    def with_errors(self, effects: Floats) -> 'MarginalInformation':
        """Return the information on x, a covariance larger by E E', effects (m, L), (S33a)."""
        weight = 1 / self.used**2
        G = (self.information + np.diag(weight)) @ effects
        taken = G @ np.linalg.inv(np.eye(G.shape[1]) + effects.T @ G)
        off = np.where(weight > 0, self.centre - self.value, 0.0)
        left = self.information - taken @ G.T
        return replace(self, information=(left + left.T) / 2,
                       pull=self.pull - taken @ (effects.T @ (self.pull + weight * off)))

    def only(self, names: Sequence[str]) -> 'MarginalInformation':
        """Return the information on some constants, the others eliminated with their priors."""
        at = np.isin(self.names, names)
        free = self.loosened({n: s for n, s in zip(self.names, self.used, strict=True)
                              if n not in names})
        D, off = free.information, np.where(np.isfinite(self.used), self.centre - self.value, 0.0)
        evidence = {n: own for n, own in self.evidence.items() if n in names}
        return MarginalInformation(
            tuple(n for n in self.names if n in names), self.value[at], D[np.ix_(at, at)],
            free.pull[at] - D[np.ix_(at, ~at)] @ off[~at], self.centre[at], self.sigma[at],
            self.used[at], evidence)

    def turned(self, name: str, about: float) -> 'MarginalInformation':
        """Return it with an angle, rad, wrapped to within half a turn of ``about``."""
        value, i = self.value.copy(), self.names.index(name)
        value[i] = about + wrap(value[i] - about)
        return replace(self, value=value)


def eliminate_own_errors(D: Floats, at: list[int], sigmas: Floats) -> tuple[Floats, Floats,
                                                                            Floats]:
    """
    Return T, DA and A: eliminating own errors of constants takes T DA' of D, T A' pull, (S34).

    D : (..., m, m) information of legs.   at, sigmas : (k,) indices of the constants, and sigmas
    of their errors; inf: unbounded.   The results are (..., m, k).
    """
    known, own = np.isfinite(sigmas), np.diagonal(D, axis1=-2, axis2=-1)[..., at]
    # the column of an unbounded error may have any length
    size = np.where(known, sigmas, np.where(own > 0, 1 / np.sqrt(np.maximum(own, 1e-300)), 0.0))
    A = np.eye(D.shape[-1])[:, at] * size[..., None, :]
    DA = D[..., at] * size[..., None, :]
    return DA @ np.linalg.pinv(np.diag(known * 1.0) + np.swapaxes(A, -1, -2) @ DA), DA, A


NUMBERS = [f for f in fields(MarginalInformation) if f.name not in ('names', 'evidence')]


@dataclass(frozen=True, eq=False)
class CarriedInformation:
    """Information of all legs so far, with the scale at the last leg."""

    marginal: MarginalInformation      # on the constants
    unit: str      # of the scale
    first_ns: int  # start of the first leg
    last_ns: int   # start of the last leg
    legs: int      # their number

    def includes(self, other: 'CarriedInformation') -> bool:
        """Return True if it contains all the information of another."""
        return self.first_ns == other.first_ns and self.legs > other.legs

    def only(self, names: Sequence[str], keeps: float | Floats) -> 'CarriedInformation':
        """
        Return the information on some constants.

        keeps : share of its prior sigma by which each constant may have changed until use.
        """
        marginal = self.marginal.only(names)
        return replace(self, marginal=marginal.loosened(
            dict(zip(marginal.names, (keeps * marginal.used).tolist(), strict=True))))

    def as_dict(self) -> dict[str, Any]:
        """Return the content for calibration.json."""
        entry = {f.name: np.asarray(getattr(self.marginal, f.name)).tolist() for f in NUMBERS}
        entry |= {'names': list(self.marginal.names),
                  'evidence': {n: x.tolist() for n, x in self.marginal.evidence.items()}}
        return {'unit': self.unit, 'first_ns': self.first_ns, 'last_ns': self.last_ns,
                'legs': self.legs, 'border': entry}


def read_carried(content: dict[str, Any]) -> CarriedInformation:
    """Return the content of ``as_dict``, null: not finite; raises ValueError if not valid."""
    try:
        entry = content['border']
        names = tuple(map(str, entry['names']))
        m = len(names)
        numbers = {f.name: _array(entry[f.name], (m, m) if f.name == 'information' else (m,),
                                  NOTHING.get(f.name, np.nan))
                   for f in NUMBERS}
        evidence = {str(n): _array(x, (SCATTER_POINTS,), np.nan)
                    for n, x in dict(entry.get('evidence', {})).items()}
        information = MarginalInformation(names, **numbers, evidence=evidence)
        return CarriedInformation(information, str(content['unit']), int(content['first_ns']),
                                  int(content['last_ns']), int(content['legs']))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f'carried: {error}') from None


def _array(values: Any, shape: tuple[int, ...], nothing: float) -> Floats:
    found = np.array([nothing if x is None else float(x) for x in np.ravel(values)])
    if found.size != np.prod(shape) or np.isnan(found).any():
        raise ValueError(f'{np.size(values)} numbers; required: {shape}, or null')
    return found.reshape(shape)
