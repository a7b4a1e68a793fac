# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Several legs of a vehicle as one linear least-squares problem: docs/method.md (S35) to (S37).

Input is the marginal information of each leg. All constants are the same in all legs, except one
that drifts, ln K, the logarithm of the scale factor: a random walk from leg to leg. Output are the
normal equations, their solution, and the residuals of legs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from odocal_ros.calib.marginal_information import eliminate_leg_errors, MarginalInformation
from odocal_ros.data.arrays import Floats, Ints

# relative, rad: unit of a constant without a prior, ln K and angles. Judgement: a leg's equations
# are linear within it, half its square being 0.1 %
STEP_UNIT = 0.05
# statistical: of eigenvalues to the largest: errors of doubles, times the loss by elimination
LEG_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class LinkedEquations:
    """Normal equations H x = g of linked legs; n unknowns x as in ``LinkedLegs.equations``."""

    H: Floats                 # (n, n) with the priors, as g and cost
    g: Floats                 # (n,)
    cost: float               # weighted sum of squares at x = 0
    prior_diagonal: Floats    # (n,) part of the priors in the diagonal of H
    prior_g: Floats           # (n,)
    prior_cost: float
    common_count: int         # number of unknowns common to all legs, the first ones of x
    rank: int                 # of the information of the legs and the random walk

    @cached_property
    def _scale(self) -> Floats:
        """Return the factors on x with which the diagonal of H is 1: (n,)."""
        return 1 / np.sqrt(np.maximum(np.diag(self.H), LEG_ROUNDING))

    @cached_property
    def _eigen(self) -> tuple[Floats, Floats]:
        """Return the eigenvalues of H with a unit diagonal, and the eigenvectors in x."""
        eigenvalues, V = np.linalg.eigh(self.H * np.multiply.outer(self._scale, self._scale))
        return eigenvalues, V * self._scale[:, None]

    @property
    def log_determinant(self) -> float:
        """Return the log determinant of H."""
        log_scaled = np.log(np.maximum(self._eigen[0], LEG_ROUNDING)).sum()
        return float(log_scaled - 2 * np.log(self._scale).sum())

    def minimum_cost(self) -> float:
        """Return the weighted sum of squares at the solution."""
        eigenvalues, V = self._eigen
        return self.cost - float(((self.g @ V)**2) @ (1 / np.maximum(eigenvalues, LEG_ROUNDING)))

    def misfit(self) -> tuple[float, float]:
        """Return the chi-square of legs and random walk, and its degrees of freedom: (S36)."""
        eigenvalues, V = self._eigen
        kept = eigenvalues > LEG_ROUNDING
        eigenvalues, V = eigenvalues[kept], V[:, kept]
        x = V @ (self.g @ V / eigenvalues)
        prior_chi2 = x @ (self.prior_diagonal * x - 2 * self.prior_g) + self.prior_cost
        fitted = len(eigenvalues) - float((self.prior_diagonal @ V**2) @ (1 / eigenvalues))
        return self.cost - float(self.g @ x + prior_chi2), self.rank - fitted

    def solve(self) -> tuple[Floats, Floats]:
        """Return x, with the drifting constant of each leg instead of its steps; covariance."""
        eigenvalues, V = self._eigen
        # the drifting constant of a leg is the sum of the unknowns from its step to the last one
        summed = V.copy()
        summed[self.common_count:] = np.cumsum(V[self.common_count:][::-1], axis=0)[::-1]
        eigenvalues = np.maximum(eigenvalues, LEG_ROUNDING)
        return summed @ (self.g @ V / eigenvalues), summed / eigenvalues @ summed.T

    def eliminate_others(self, keep: Ints) -> tuple[Floats, Floats]:
        """Return H and g of some unknowns, the others eliminated."""
        others = np.setdiff1d(np.arange(len(self.g)), keep)
        if not len(others):
            return self.H[np.ix_(keep, keep)], self.g[keep]
        gain = np.linalg.solve(self.H[np.ix_(others, others)], self.H[np.ix_(others, keep)]).T
        D = self.H[np.ix_(keep, keep)] - gain @ self.H[np.ix_(others, keep)]
        return (D + D.T) / 2, self.g[keep] - gain @ self.g[others]


class LinkedLegs:
    """J legs, with the same m constants each, their priors, and the random walk of one of them."""

    def __init__(self, marginals: Sequence[MarginalInformation], drifting: str,
                 steps: Sequence[float] | Floats, angles: Sequence[str] = ()) -> None:
        """
        Take the marginal information of legs in order of time.

        drifting : name of the constant with a random walk.   steps : (J - 1,) sigmas of its change
        from leg to leg.   angles : names of constants with a period of one turn.
        """
        self.names = tuple(dict.fromkeys(name for leg in marginals for name in leg.names))
        self.replace_marginals([_with_names(leg, self.names) for leg in marginals])
        last = self.marginals[-1]
        for name in angles:
            angle = last.point[self.names.index(name)]
            self.replace_marginals([leg.with_angle_near(name, angle) for leg in self.marginals])
        self.prior_mean = last.prior_mean
        self.prior_sigma, self.relaxed_sigma = (
            np.max([getattr(leg, sigma) for leg in self.marginals], axis=0)
            for sigma in ('prior_sigma', 'relaxed_sigma'))
        self.unit = np.where(np.isfinite(self.relaxed_sigma), self.relaxed_sigma, STEP_UNIT)
        self.drifting = self.names.index(drifting)
        # 0.1 ppm of ln K: any vehicle changes more; with smaller sigmas rounding is too large
        self.steps = np.maximum(steps, 1e-7)

    def combine_sections(self, same_drive: Sequence[bool]) -> 'LinkedLegs':
        """Return the drives; same_drive: (J - 1,) True if a leg continues the drive before it."""
        if not any(same_drive):
            return self
        marginals = self.marginals[:1]
        for marginal, is_same in zip(self.marginals[1:], same_drive, strict=True):
            if is_same:
                marginals[-1] = marginals[-1].plus(marginal)
            else:
                marginals.append(marginal)
        return LinkedLegs(marginals, self.names[self.drifting], self.steps[~np.array(same_drive)])

    def replace_marginals(self, marginals: list[MarginalInformation]) -> None:
        """Set the marginals of the legs; each must have the names of all."""
        self.marginals = marginals
        self._information: dict[float, LegInformation] = {}

    def information(self, min_information: float = 0.0) -> 'LegInformation':
        """Return the legs' information where it exceeds a minimum, in units of the priors'."""
        if min_information not in self._information:      # requested for each constant
            self._information[min_information] = _in_units(self.marginals, self.unit,
                                                           min_information)
        return self._information[min_information]

    def indices(self, j: int) -> Ints:
        """Return the indices of the constants of leg j in the unknowns: (m,)."""
        common = len(self.names) - 1
        return np.insert(np.arange(common), self.drifting, common + j)

    def equations(self, legs: 'LegInformation', scatter: dict[str, float] | None = None,
                  prior: bool = True) -> LinkedEquations:
        """
        Return the equations of all legs, the random walk, and the priors.

        Unknowns, in ``unit`` and relative to the point of the last leg: the constants but the
        drifting one; then its steps from leg to leg, last its value in the last leg.

        scatter : sigma between legs, by constant.   prior : include the priors.
        """
        equations = self._leg_equations(legs, scatter)
        common, steps = len(self.names) - 1, len(self.steps)
        walk = np.arange(common, common + steps)
        equations.H[walk, walk] += (self.unit[self.drifting] / self.steps)**2
        weight, offset = np.zeros((2, len(equations.g)))
        if prior:
            last = self.indices(steps)      # of the constants of the last leg
            weight[last] = np.isfinite(self.relaxed_sigma)
            offset[last] = (self.prior_mean - self.marginals[-1].point) / self.unit
        prior_g, prior_cost = weight * offset, float(weight @ offset**2)
        return LinkedEquations(equations.H + np.diag(weight), equations.g + prior_g,
                               equations.cost + prior_cost, weight, prior_g, prior_cost, common,
                               equations.rank + steps)

    def _leg_equations(self, legs: 'LegInformation',
                       scatter: dict[str, float] | None) -> LinkedEquations:
        """Return the equations of the legs alone, without random walk and priors."""
        # with the scatter eliminated, a leg has the information D - T DA'. Its drifting constant
        # is the sum of the steps from this leg on, so rows and columns of a step are sums over the
        # legs up to it
        J, k = len(legs.D), self.drifting
        common = np.delete(np.arange(len(self.names)), k)
        indices = [self.names.index(name) for name in scatter or ()]
        sigmas = np.array(list((scatter or {}).values())) / self.unit[indices]
        T, DA, A = eliminate_leg_errors(legs.D, indices, sigmas)
        # the information of legs combined earlier already includes their scatter
        T[[bool(leg.scatter_likelihood) for leg in self.marginals]] = 0.0
        unbounded = (np.isinf(sigmas) & T.any(axis=1)).sum()
        errors = np.swapaxes(A, 1, 2) @ legs.gradient[:, :, None]
        gradient = legs.gradient - (T @ errors)[:, :, 0]
        last = self.marginals[-1].point
        offset = np.stack([leg.point - last for leg in self.marginals]) / self.unit
        g_legs = gradient + (legs.D @ offset[:, :, None]
                             - T @ (np.swapaxes(DA, 1, 2) @ offset[:, :, None]))[:, :, 0]
        cost = float((offset * (g_legs + gradient)).sum() + (legs.estimate * gradient).sum())
        drifting = legs.D[:, :, k] - np.einsum('jas,js->ja', T, DA[:, k])    # (J, m) column k
        total = legs.D.sum(axis=0) - np.tensordot(T, DA, ((0, 2), (0, 2)))
        cross = np.cumsum(drifting[:, common], axis=0)        # of steps and common constants
        # of two steps: the sum over the legs up to the earlier one
        steps = np.cumsum(drifting[:, k])[np.minimum.outer(np.arange(J), np.arange(J))]
        H = np.block([[total[np.ix_(common, common)], cross.T], [cross, steps]])
        g = np.concatenate([g_legs.sum(axis=0)[common], np.cumsum(g_legs[:, k])])
        return LinkedEquations(H, g, cost, np.zeros(len(g)), np.zeros(len(g)), 0.0, len(common),
                               int(legs.rank.sum() - unbounded))

    def solve(self, scatter: dict[str, float] | None = None) -> tuple[Floats, Floats]:
        """Return constants and covariance, SI units; those of leg j are at ``indices(j)``."""
        x, C = self.equations(self.information(), scatter).solve()
        scale, last = np.empty((2, len(x)))
        for j in range(len(self.marginals)):
            scale[self.indices(j)], last[self.indices(j)] = self.unit, self.marginals[-1].point
        return last + x * scale, C * np.multiply.outer(scale, scale)

    def log_likelihood(self, scatter: dict[str, float]) -> float:
        """Return the restricted log likelihood of a scatter, up to a constant: (S38)."""
        indices = [self.names.index(name) for name in scatter]
        size = np.array(list(scatter.values())) / self.unit[indices]
        equations = self.equations(self.information(), scatter)
        likelihood = -(equations.minimum_cost() + equations.log_determinant) / 2
        is_single = [not leg.scatter_likelihood for leg in self.marginals]   # not combined earlier
        D = self.information().D[:, indices][:, :, indices][is_single]
        return float(likelihood - np.linalg.slogdet(
            np.eye(len(indices)) + D * np.multiply.outer(size, size))[1].sum() / 2)

    def combined_information(self, point: Floats, scatter: dict[str, float],
                             likelihood: dict[str, Floats]) -> MarginalInformation:
        """Return the information of all legs as one leg at a point; likelihood: of the scatter."""
        equations = self.equations(self.information(), scatter, prior=False)
        D, gradient = equations.eliminate_others(self.indices(len(self.marginals) - 1))
        D, gradient = D / np.multiply.outer(self.unit, self.unit), gradient / self.unit
        return MarginalInformation(
            self.names, point, D, gradient - D @ (point - self.marginals[-1].point),
            self.prior_mean, self.prior_sigma, self.relaxed_sigma, likelihood)

    def disagreement(self, scatter: dict[str, float] | None = None) -> tuple[float, float]:
        """
        Return the chi-square of the legs with common constants, and its degrees of freedom: (S36).

        Only directions count that a leg determines at least as well as the priors do: in others
        its equations are not linear, and two legs that each determine one half always agree.
        """
        return self.equations(self.information(1.0), scatter).misfit()

    def deviations(self) -> Floats:
        """
        Return the normalised residual of each leg's constants against the others': (J, m) sigmas.

        The gradient of the leg at the joint estimate over its sigma (Baarda 1968), (S37).
        """
        x, C = self.solve()
        residuals = np.zeros((len(self.marginals), len(self.names)))
        legs = self.information(1.0)
        for j, (D, gradient) in enumerate(zip(legs.D, legs.gradient, strict=True)):
            indices = self.indices(j)
            gradient = gradient - D @ ((x[indices] - self.marginals[j].point) / self.unit)
            C_leg = C[np.ix_(indices, indices)] / np.multiply.outer(self.unit, self.unit)
            variance = np.diag(D - D @ C_leg @ D)
            # no test if the others have less than a millionth of the leg's information
            tested = variance > np.maximum(1e-6 * np.diag(D), 1e-300)
            residuals[j, tested] = gradient[tested] / np.sqrt(variance[tested])
        return residuals


@dataclass(frozen=True, eq=False)
class LegInformation:
    """Information of J legs, in units of their m constants, without directions of rounding."""

    D: Floats         # (J, m, m), as ``MarginalInformation.information``
    gradient: Floats  # (J, m)
    estimate: Floats  # (J, m) of the leg alone, relative to its point: D estimate = gradient
    rank: Ints        # (J,) of D


def _in_units(marginals: Sequence[MarginalInformation], unit: Floats,
              min_information: float) -> LegInformation:
    """Return the information of legs in units (m,), in directions with ``min_information``."""
    rows = []
    for marginal in marginals:
        eigenvalues, V = np.linalg.eigh(marginal.information * np.multiply.outer(unit, unit))
        kept = eigenvalues > max(LEG_ROUNDING * eigenvalues[-1], min_information, 1e-300)
        eigenvalues, V = eigenvalues[kept], V[:, kept]
        gradient = V.T @ (marginal.gradient * unit)      # along the eigenvectors
        rows.append((V * eigenvalues @ V.T, V @ gradient, V @ (gradient / eigenvalues),
                     len(eigenvalues)))
    return LegInformation(*map(np.array, zip(*rows, strict=True)))


def _with_names(marginal: MarginalInformation, names: tuple[str, ...]) -> MarginalInformation:
    """Return a marginal with more names, without information or prior on the new ones."""
    if marginal.names == names:
        return marginal
    indices = [names.index(name) for name in marginal.names]
    D = np.zeros((len(names), len(names)))
    D[np.ix_(indices, indices)] = marginal.information
    fields = ('point', 'gradient', 'prior_mean', 'prior_sigma', 'relaxed_sigma')
    # a prior sigma of 0 has no effect in the maximum over legs
    vectors: dict[str, Any] = {field: np.zeros(len(names)) for field in fields}
    for field, vector in vectors.items():
        vector[indices] = getattr(marginal, field)
    return replace(marginal, names=names, information=D, **vectors)
