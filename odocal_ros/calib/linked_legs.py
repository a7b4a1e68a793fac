# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The rows of several legs as one least-squares problem: docs/method.md (S35) to (S37)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from odocal_ros.calib.marginal_information import eliminate_own_errors, MarginalInformation
from odocal_ros.data.arrays import Floats, Ints

# relative, rad: unit of a constant without a prior, ln K and angles. Judgement: a leg's equations
# are linear within it, half its square being 0.1 %
STEP_UNIT = 0.05
# statistical: of eigenvalues to the largest: errors of doubles, times the loss by elimination
LEG_ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class LinkedEquations:
    """Normal equations H x = g of linked legs; see ``LinkedLegs.equations``."""

    H: Floats
    g: Floats
    cost: float                          # of the rows at x = 0
    prior: tuple[Floats, Floats, float]  # diagonal of H, g and cost by priors
    others: int                          # number of constants that do not drift
    rows: int                            # number of rows of legs and random walk

    @cached_property
    def _parts(self) -> tuple[Floats, Floats, Floats]:
        """Return eigenvalues of H with a unit diagonal, its eigenvectors, and the scale."""
        s = 1 / np.sqrt(np.maximum(np.diag(self.H), LEG_ROUNDING))
        size, V = np.linalg.eigh(self.H * np.multiply.outer(s, s))
        return size, V * s[:, None], s

    @property
    def log_determinant(self) -> float:
        """Return the log determinant of H."""
        size, _, s = self._parts
        return float(np.log(np.maximum(size, LEG_ROUNDING)).sum() - 2 * np.log(s).sum())

    def least_cost(self) -> float:
        """Return the weighted sum of squares at the solution."""
        size, V, _ = self._parts
        return self.cost - float(((self.g @ V)**2) @ (1 / np.maximum(size, LEG_ROUNDING)))

    def misfit(self) -> tuple[float, float]:
        """Return the chi-square of legs and random walk, and its degrees of freedom."""
        size, V, _ = self._parts
        size, V = size[size > LEG_ROUNDING], V[:, size > LEG_ROUNDING]
        x = V @ (self.g @ V / size)
        weight, pull, at_zero = self.prior
        of_prior = x @ (weight * x - 2 * pull) + at_zero
        fitted = len(size) - float((weight @ V**2) @ (1 / size))
        return self.cost - float(self.g @ x + of_prior), self.rows - fitted

    def solved(self) -> tuple[Floats, Floats]:
        """Return the solution and its covariance, of each leg its own drifting constant."""
        size, V, _ = self._parts
        V = V.copy()
        V[self.others:] = np.cumsum(V[self.others:][::-1], axis=0)[::-1]
        size = np.maximum(size, LEG_ROUNDING)
        return V @ (self.g @ self._parts[1] / size), V / size @ V.T

    def eliminate_others(self, keep: Ints) -> tuple[Floats, Floats]:
        """Return H and g of some unknowns, the others eliminated."""
        gone = np.setdiff1d(np.arange(len(self.g)), keep)
        if not len(gone):
            return self.H[np.ix_(keep, keep)], self.g[keep]
        taken = np.linalg.solve(self.H[np.ix_(gone, gone)], self.H[np.ix_(gone, keep)]).T
        D = self.H[np.ix_(keep, keep)] - taken @ self.H[np.ix_(gone, keep)]
        return (D + D.T) / 2, self.g[keep] - taken @ self.g[gone]


class LinkedLegs:
    """Marginals of legs with common names, priors of the constants, random walk of one."""

    def __init__(self, marginals: Sequence[MarginalInformation], drifting: str,
                 steps: Sequence[float] | Floats, angles: Sequence[str] = ()) -> None:
        """Take legs by time; ``steps`` (J - 1,): sigmas of the change of ``drifting``."""
        self.names = tuple(dict.fromkeys(n for b in marginals for n in b.names))
        self.replace_marginals([_on(b, self.names) for b in marginals])
        last = self.marginals[-1]
        for name in angles:
            about = last.value[self.names.index(name)]
            self.replace_marginals([b.turned(name, about) for b in self.marginals])
        self.centre = last.centre
        self.sigma, self.used = (
            np.max([getattr(b, which) for b in self.marginals], axis=0)
            for which in ('sigma', 'used'))
        self.unit = np.where(np.isfinite(self.used), self.used, STEP_UNIT)
        self.drifting = self.names.index(drifting)
        # 0.1 ppm of ln K: any vehicle changes more; with smaller sigmas rounding is too large
        self.steps = np.maximum(steps, 1e-7)

    def combine_sections(self, same: Sequence[bool]) -> 'LinkedLegs':
        """Return these legs, with the sections of the same leg added up."""
        is_new_leg = [not together for together in same] or [True] * len(self.steps)
        if all(is_new_leg):
            return self
        marginals = self.marginals[:1]
        for marginal, own in zip(self.marginals[1:], is_new_leg, strict=True):
            marginals = [*marginals, marginal] if own else [
                *marginals[:-1], marginals[-1].plus(marginal)]
        return LinkedLegs(marginals, self.names[self.drifting], self.steps[is_new_leg])

    def replace_marginals(self, marginals: list[MarginalInformation]) -> None:
        """Set the marginals of the legs; each must have the names of all."""
        self.marginals = marginals
        self._clean: dict[float, LegInformation] = {}

    def information(self, least: float = 0.0) -> 'LegInformation':
        """Return the information of the legs in directions with more than ``least`` priors."""
        if least not in self._clean:      # requested for each constant
            self._clean[least] = information(self.marginals, self.unit, least)
        return self._clean[least]

    def place(self, j: int) -> Ints:
        """Return the indices of the constants of leg j in the unknowns."""
        others = len(self.names) - 1
        return np.insert(np.arange(others), self.drifting, others + j)

    def equations(self, legs: 'LegInformation', spread: dict[str, float] | None = None,
                  prior: bool = True) -> LinkedEquations:
        """
        Return the equations of all legs with a scatter, the random walk, and the priors.

        Unknowns, in their units and less the values of the last leg: the constants but the
        drifting one; then its steps from leg to leg, last its value in the last leg.
        """
        H, g, cost, rank = self._of_legs(legs, spread)
        others, steps = len(self.names) - 1, len(self.steps)
        walk = np.arange(others, others + steps)
        H[walk, walk] += (self.unit[self.drifting] / self.steps)**2
        weight, off = np.zeros((2, len(g)))
        if prior:
            at = self.place(steps)
            weight[at] = np.isfinite(self.used)
            off[at] = (self.centre - self.marginals[-1].value) / self.unit
        at_zero = float(weight @ off**2)
        return LinkedEquations(H + np.diag(weight), g + weight * off, cost + at_zero,
                               (weight, weight * off, at_zero), others, rank + steps)

    def _of_legs(self, legs: 'LegInformation',
                 spread: dict[str, float] | None) -> tuple[Floats, Floats, float, int]:
        """Return the equations of the legs, their cost at zero and the number of their rows."""
        # the drifting constant of a leg is the sum of its steps from the leg on: rows and columns
        # of the steps are sums over the legs up to each
        J, k, rest = len(legs.D), self.drifting, np.delete(np.arange(len(self.names)),
                                                           self.drifting)
        taken, DA, pull, rank = self._scattering(legs, spread)
        off = np.stack([b.value - self.marginals[-1].value for b in self.marginals]) / self.unit
        g_legs = pull + (legs.D @ off[:, :, None]
                         - taken @ (np.swapaxes(DA, 1, 2) @ off[:, :, None]))[:, :, 0]
        cost = float((off * (g_legs + pull)).sum() + (legs.nearest * pull).sum())
        of_drifting = legs.D[:, :, k] - np.einsum('jas,js->ja', taken, DA[:, k])
        whole = legs.D.sum(axis=0) - np.tensordot(taken, DA, ((0, 2), (0, 2)))
        across = np.cumsum(of_drifting[:, rest], axis=0)
        steps = np.cumsum(of_drifting[:, k])[np.minimum.outer(np.arange(J), np.arange(J))]
        return (np.block([[whole[np.ix_(rest, rest)], across.T], [across, steps]]),
                np.concatenate([g_legs.sum(axis=0)[rest], np.cumsum(g_legs[:, k])]), cost, rank)

    def solve(self, spread: dict[str, float] | None = None) -> tuple[Floats, Floats]:
        """Return the unknowns and their covariance, of leg j at ``place``."""
        x, C = self.equations(self.information(), spread).solved()
        scale, last = np.empty((2, len(x)))
        for j in range(len(self.marginals)):
            scale[self.place(j)], last[self.place(j)] = self.unit, self.marginals[-1].value
        return last + x * scale, C * np.multiply.outer(scale, scale)

    def log_likelihood(self, spread: dict[str, float]) -> float:
        """Return the restricted log likelihood of a scatter between legs, up to a constant."""
        at, size = [self.names.index(n) for n in spread], np.array(list(spread.values()))
        size = size / self.unit[at]
        equations = self.equations(self.information(), spread)
        out = -(equations.least_cost() + equations.log_determinant) / 2
        own = self.information().D[:, at][:, :, at][[not b.evidence for b in self.marginals]]
        return float(out - np.linalg.slogdet(
            np.eye(len(at)) + own * np.multiply.outer(size, size))[1].sum() / 2)

    def carried(self, value: Floats, spread: dict[str, float],
                evidence: dict[str, Floats]) -> MarginalInformation:
        """Return the information of all legs at ``value``; evidence : of the scatter, by name."""
        equations = self.equations(self.information(), spread, prior=False)
        D, pull = equations.eliminate_others(self.place(len(self.marginals) - 1))
        D, pull = D / np.multiply.outer(self.unit, self.unit), pull / self.unit
        return MarginalInformation(self.names, value, D, pull
                                   - D @ (value - self.marginals[-1].value),
                                   self.centre, self.sigma, self.used, evidence)

    def evidence(self, name: str, points: int) -> Floats:
        """Return the log likelihood of a constant's scatter by combined legs: (points,)."""
        return sum((b.evidence[name] for b in self.marginals if name in b.evidence),
                   np.zeros(points))

    def disagreement(self, spread: dict[str, float] | None = None) -> tuple[float, float]:
        """
        Return the chi-square of the legs with common constants, and its degrees of freedom: (S36).

        Only of directions determined at least as well as by the priors: the equations of a leg
        need not be linear over larger changes. Priors bound what no leg determines: otherwise two
        legs that determine half of the constants each, in different directions, would always
        agree.
        """
        return self.equations(self.information(1.0), spread).misfit()

    def deviations(self) -> Floats:
        """
        Return the normalised residual of each leg's constants against the others': (J, m) sigmas.

        The gradient of the leg at the joint estimate, over its sigma, for each constant: the test
        of one additional unknown, as if the leg were left out (Baarda 1968), docs/method.md (S37).
        """
        x, C = self.solve()
        out = np.zeros((len(self.marginals), len(self.names)))
        legs = self.information(1.0)
        for j, (D, pull) in enumerate(zip(legs.D, legs.pull, strict=True)):
            where = self.place(j)
            pull = pull - D @ ((x[where] - self.marginals[j].value) / self.unit)
            own = C[np.ix_(where, where)] / np.multiply.outer(self.unit, self.unit)
            variance = np.diag(D - D @ own @ D)
            # no test if the others have less than a millionth of the leg's information
            news = variance > np.maximum(1e-6 * np.diag(D), 1e-300)
            out[j, news] = pull[news] / np.sqrt(variance[news])
        return out

    def _scattering(self, legs: 'LegInformation', spread: dict[str, float] | None
                    ) -> tuple[Floats, Floats, Floats, int]:
        """Return T and DA of ``eliminate_own_errors`` by a scatter, pull, and sum of ranks."""
        # the information of combined legs already includes their scatter
        at = [self.names.index(n) for n in spread or ()]
        sigmas = np.array(list((spread or {}).values())) / self.unit[at]
        taken, DA, A = eliminate_own_errors(legs.D, at, sigmas)
        taken[[bool(b.evidence) for b in self.marginals]] = 0.0
        free = (np.isinf(sigmas) & taken.any(axis=1)).sum()
        pull = legs.pull - (taken @ (np.swapaxes(A, 1, 2) @ legs.pull[:, :, None]))[:, :, 0]
        return taken, DA, pull, int(legs.rank.sum() - free)


@dataclass(frozen=True, eq=False)
class LegInformation:
    """Information of J legs, in units of their m constants, without what is rounding."""

    D: Floats        # (J, m, m), as in ``MarginalInformation``
    pull: Floats     # (J, m)
    nearest: Floats  # (J, m) own estimate, less its value: D nearest = pull, also for a scatter
    rank: Ints       # (J,) of D


def information(marginals: Sequence[MarginalInformation], unit: Floats,
                least: float) -> LegInformation:
    """Return the information of legs in directions of more than ``least``: (m,) unit."""
    J, m = len(marginals), len(unit)
    out = LegInformation(np.empty((J, m, m)), np.empty((J, m)), np.empty((J, m)), np.empty(J, int))
    for j, marginal in enumerate(marginals):
        size, V = np.linalg.eigh(marginal.information * np.multiply.outer(unit, unit))
        # of doubles, times the loss by elimination
        keep = size > max(LEG_ROUNDING * size[-1], least, 1e-300)
        size, V = size[keep], V[:, keep]
        along = V.T @ (marginal.pull * unit)
        out.D[j], out.pull[j], out.nearest[j] = V * size @ V.T, V @ along, V @ (along / size)
        out.rank[j] = len(size)
    return out


def _on(marginal: MarginalInformation, names: tuple[str, ...]) -> MarginalInformation:
    """Return a marginal with more names, without information or prior on the new ones."""
    if marginal.names == names:
        return marginal
    at = [names.index(n) for n in marginal.names]
    m = len(names)
    D = np.zeros((m, m))
    D[np.ix_(at, at)] = marginal.information

    def on(values: Floats) -> Floats:
        out = np.zeros(m)       # sigma 0: has no effect in the maximum over legs
        out[at] = values
        return out
    return MarginalInformation(
        names, on(marginal.value), D, on(marginal.pull), on(marginal.centre), on(marginal.sigma),
        on(marginal.used), marginal.evidence)
