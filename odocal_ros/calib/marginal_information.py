# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Marginal information of a leg on the constants of vehicle and IMU, without their priors.

A fit estimates states, errors of one leg, and constants (scale, mounting angles, lever arms,
delays, IMU errors). The information on the constants, with all other unknowns eliminated, is what
the leg contributes to a combination with other legs: docs/method.md (S33) to (S34).
calibration.json stores it for legs of later days.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.rotations import wrap

SCATTER_POINTS = 11     # judgement: of the grid over the scatter between legs
# format: field of MarginalInformation: its key in calibration.json
JSON_KEYS = {'point': 'value', 'information': 'information', 'gradient': 'pull',
             'prior_mean': 'centre', 'prior_sigma': 'sigma', 'relaxed_sigma': 'used'}


@dataclass(frozen=True, eq=False)
class MarginalInformation:
    """
    Log likelihood of a leg as a quadratic function of m constants x: docs/method.md (S33).

    gradient (x - point) - (x - point)' information (x - point) / 2, in ln K, rad, m, s.
    """

    names: tuple[str, ...]   # of the constants
    point: Floats            # (m,) linearisation point; lever arms as in the settings
    information: Floats      # (m, m) semidefinite
    gradient: Floats         # (m,)
    prior_mean: Floats       # (m,)
    prior_sigma: Floats      # (m,) inf: no prior
    # (m,) the same, widened if the leg contradicts it; imperfections: their estimated size
    relaxed_sigma: Floats
    # (SCATTER_POINTS,) each: log likelihood of the scatter between combined legs, by name (S38)
    scatter_likelihood: dict[str, Floats] = field(default_factory=dict)

    def widened(self, factor: float) -> 'MarginalInformation':
        """Return the information with all sigmas multiplied by a factor."""
        return replace(self, information=self.information / factor**2,
                       gradient=self.gradient / factor**2)

    def plus(self, other: 'MarginalInformation') -> 'MarginalInformation':
        """Return the sum with that of another leg, linearised at the point of this one."""
        gradient = other.gradient - other.information @ (self.point - other.point)
        return replace(self, information=self.information + other.information,
                       gradient=self.gradient + gradient,
                       prior_sigma=np.maximum(self.prior_sigma, other.prior_sigma),
                       relaxed_sigma=np.maximum(self.relaxed_sigma, other.relaxed_sigma))

    def with_leg_errors(self, sigmas: dict[str, float]) -> 'MarginalInformation':
        """
        Return the information on the vehicle if the leg's constants deviate from its: (S34).

        sigmas : of the deviation, by constant; inf: no information on the constant remains.
        """
        indices = [self.names.index(name) for name in sigmas]
        T, DA, A = eliminate_leg_errors(self.information, indices,
                                        np.array(list(sigmas.values())))
        remaining = self.information - T @ DA.T
        return replace(self, information=(remaining + remaining.T) / 2,
                       gradient=self.gradient - T @ (A.T @ self.gradient))

    def with_errors(self, effects: Floats) -> 'MarginalInformation':
        """Return the information with the covariance larger by E E', effects E (m, L): (S33a)."""
        weight = 1 / self.relaxed_sigma**2
        G = (self.information + np.diag(weight)) @ effects
        T = G @ np.linalg.inv(np.eye(G.shape[1]) + effects.T @ G)
        prior_step = np.where(weight > 0, self.prior_mean - self.point, 0.0)
        remaining = self.information - T @ G.T
        return replace(self, information=(remaining + remaining.T) / 2,
                       gradient=self.gradient
                       - T @ (effects.T @ (self.gradient + weight * prior_step)))

    def select(self, names: Sequence[str]) -> 'MarginalInformation':
        """Return the information on some constants, the others eliminated with their priors."""
        kept = np.isin(self.names, names)
        reduced = self.with_leg_errors({name: sigma for name, sigma in zip(
            self.names, self.relaxed_sigma, strict=True) if name not in names})
        D = reduced.information
        prior_step = np.where(np.isfinite(self.relaxed_sigma), self.prior_mean - self.point, 0.0)
        return MarginalInformation(
            tuple(name for name in self.names if name in names), self.point[kept],
            D[np.ix_(kept, kept)],
            reduced.gradient[kept] - D[np.ix_(kept, ~kept)] @ prior_step[~kept],
            self.prior_mean[kept], self.prior_sigma[kept], self.relaxed_sigma[kept],
            {name: x for name, x in self.scatter_likelihood.items() if name in names})

    def with_angle_near(self, name: str, reference: float) -> 'MarginalInformation':
        """Return the information with an angle, rad, at most half a turn from a reference."""
        point, i = self.point.copy(), self.names.index(name)
        point[i] = reference + wrap(point[i] - reference)
        return replace(self, point=point)


def eliminate_leg_errors(D: Floats, indices: list[int],
                         sigmas: Floats) -> tuple[Floats, Floats, Floats]:
    """
    Return T, DA and A of docs/method.md (S34): (..., m, k).

    They eliminate errors of k constants in each leg: the information D is reduced by T DA', the
    gradient h by T A' h.   D : (..., m, m).   indices, sigmas : (k,) of the constants, and sigmas
    of their errors; inf: unbounded.
    """
    bounded, diagonal = np.isfinite(sigmas), np.diagonal(D, axis1=-2, axis2=-1)[..., indices]
    # the column of an unbounded error may have any length
    size = np.where(bounded, sigmas,
                    np.where(diagonal > 0, 1 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0))
    A = np.eye(D.shape[-1])[:, indices] * size[..., None, :]
    DA = D[..., indices] * size[..., None, :]
    return DA @ np.linalg.pinv(np.diag(bounded * 1.0) + np.swapaxes(A, -1, -2) @ DA), DA, A


@dataclass(frozen=True, eq=False)
class CarriedInformation:
    """Information of all legs so far, carried on to later ones; its scale is that of the last."""

    marginal: MarginalInformation      # on the constants
    unit: str      # of the scale
    first_ns: int  # start of the first leg
    last_ns: int   # start of the last leg
    legs: int      # their number

    def includes(self, other: 'CarriedInformation') -> bool:
        """Return True if it contains all the information of another."""
        return self.first_ns == other.first_ns and self.legs > other.legs

    def select(self, names: Sequence[str], change: float) -> 'CarriedInformation':
        """
        Return the information on some constants, which may change until they are used.

        change : 1 sigma, over that of the constant's prior.
        """
        marginal = self.marginal.select(names)
        return replace(self, marginal=marginal.with_leg_errors(
            dict(zip(marginal.names, (change * marginal.relaxed_sigma).tolist(), strict=True))))

    def as_dict(self) -> dict[str, Any]:
        """Return the content for calibration.json."""
        marginal = self.marginal
        entry = {key: np.asarray(getattr(marginal, name)).tolist()
                 for name, key in JSON_KEYS.items()}
        entry |= {'names': list(marginal.names), 'evidence': {
            name: x.tolist() for name, x in marginal.scatter_likelihood.items()}}
        return {'unit': self.unit, 'first_ns': self.first_ns, 'last_ns': self.last_ns,
                'legs': self.legs, 'border': entry}


def read_carried(content: dict[str, Any]) -> CarriedInformation:
    """Return the content of ``as_dict``, null: no prior; raises ValueError if not valid."""
    try:
        entry = content['border']
        names = tuple(map(str, entry['names']))
        m = len(names)
        arrays = {name: _array(entry[key], (m, m) if name == 'information' else (m,),
                               np.inf if name.endswith('_sigma') else np.nan)
                  for name, key in JSON_KEYS.items()}
        likelihood = {str(n): _array(x, (SCATTER_POINTS,), np.nan)
                      for n, x in dict(entry.get('evidence', {})).items()}
        return CarriedInformation(MarginalInformation(names, **arrays,
                                                      scatter_likelihood=likelihood),
                                  str(content['unit']), int(content['first_ns']),
                                  int(content['last_ns']), int(content['legs']))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f'carried: {error}') from None


def _array(values: Any, shape: tuple[int, ...], null: float) -> Floats:
    """Return values as an array of a shape, ``null`` for None; raises ValueError otherwise."""
    array = np.array([null if x is None else float(x) for x in np.ravel(values)])
    if array.size != np.prod(shape) or np.isnan(array).any():
        raise ValueError(f'{np.size(values)} numbers; required: {shape}, or null')
    return array.reshape(shape)
