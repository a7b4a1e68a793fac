# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The rows of several legs as one least-squares problem: docs/method.md (S35) to (S37)."""

from collections.abc import Sequence

import numpy as np

from odocal_ros.calib.border import Border, directions, loosened
from odocal_ros.data.arrays import Floats, Ints

# relative, rad: unit of a constant without a prior, ln K and angles. Judgement: a leg's equations
# are linear within it, half its square being 0.1 %
STEP_UNIT = 0.05


class LinkedLegs:
    """Borders with common names, the priors of the constants, and the random walk of one."""

    def __init__(self, borders: Sequence[Border], drifting: str,
                 steps: Sequence[float] | Floats, angles: Sequence[str] = ()) -> None:
        """Take legs by time; ``steps`` (J - 1,): sigmas of the change of ``drifting``."""
        self.names = tuple(dict.fromkeys(n for b in borders for n in b.names))
        self.take([_on(b, self.names) for b in borders])
        last = self.borders[-1]
        for name in angles:
            about = last.value[self.names.index(name)]
            self.take([b.turned(name, about) for b in self.borders])
        self.centre = last.centre
        self.sigma, self.used = (
            np.max([getattr(b, which) for b in self.borders], axis=0)
            for which in ('sigma', 'used'))
        self.unit = np.where(np.isfinite(self.used), self.used, STEP_UNIT)
        self.drifting = self.names.index(drifting)
        # 0.1 ppm of ln K: any vehicle changes more; with smaller sigmas rounding is too large
        self.steps = np.maximum(steps, 1e-7)

    def joined(self, same: Sequence[bool]) -> 'LinkedLegs':
        """Return these legs, with the sections of the same leg added up."""
        apart = [not together for together in same] or [True] * len(self.steps)
        if all(apart):
            return self
        borders = self.borders[:1]
        for border, own in zip(self.borders[1:], apart, strict=True):
            borders = [*borders, border] if own else [*borders[:-1], borders[-1].plus(border)]
        return LinkedLegs(borders, self.names[self.drifting], self.steps[apart])

    def take(self, borders: list[Border]) -> None:
        """Replace the borders; each must have the names of all."""
        self.borders = borders
        self._determined: list[Border] | None = None

    def determined(self) -> list[Border]:
        """Return the part of each border that is determined at least as well as by the priors."""
        if self._determined is None:      # requested for each constant
            self._determined = [b.determined(self.unit) for b in self.borders]
        return self._determined

    def columns(self, j: int) -> Ints:
        """Return the indices of the constants of leg j in the unknowns: z, then the drifting."""
        m = len(self.names)
        where = np.arange(m)
        where[self.drifting] = m + j
        return where

    def system(self, spread: dict[str, float] | None = None,
               borders: Sequence[Border] | None = None) -> tuple[Floats, Floats]:
        """Return the rows of all legs and of the random walk, and their right-hand sides."""
        m, J, borders = len(self.names), len(self.borders), borders or self.borders
        A, b = [], []
        D, pull = self._scattering(borders, spread)
        for j, (size, V) in enumerate(directions(D, self.unit)):
            root = np.sqrt(size)
            R = (V * root).T / self.unit
            A.append(np.zeros((len(R), m + J)))
            A[-1][:, self.columns(j)] = R
            b.append(R @ borders[j].value + V.T @ (pull[j] * self.unit) / root)
        walk = np.zeros((J - 1, m + J))
        k = np.arange(J - 1)
        walk[k, m + k], walk[k, m + k + 1] = -1 / self.steps, 1 / self.steps
        used = [i for i in range(m + J) if i != self.drifting]
        scale = np.concatenate([self.unit, np.full(J, self.unit[self.drifting])])[used]
        return np.concatenate([*A, walk])[:, used] * scale, np.concatenate([*b, np.zeros(J - 1)])

    def place(self, j: int) -> Ints:
        """Return the indices of the constants of leg j in the columns of ``system``."""
        where = self.columns(j)
        return where - (where > self.drifting)

    def solve(self, spread: dict[str, float] | None = None) -> tuple[Floats, Floats]:
        """Return the unknowns and their covariance, of leg j at ``place``."""
        A, b = self.system(spread)
        prior, centre = self._prior_rows(A.shape[1])
        Q, R = np.linalg.qr(np.concatenate([A, prior]))
        inverse = np.linalg.inv(R)
        x = inverse @ (Q.T @ np.concatenate([b, centre]))
        scale = np.empty(len(x))
        for j in range(len(self.borders)):
            scale[self.place(j)] = self.unit
        return x * scale, inverse @ inverse.T * np.multiply.outer(scale, scale)

    def log_likelihood(self, spread: dict[str, float]) -> float:
        """Return the restricted log likelihood of a scatter between legs, up to a constant."""
        at, size = [self.names.index(n) for n in spread], np.array(list(spread.values()))
        A, b = self.system(spread)
        prior, centre = self._prior_rows(A.shape[1])
        Q, R = np.linalg.qr(np.concatenate([A, prior]))
        b = np.concatenate([b, centre])
        out = -(b @ b - ((b @ Q)**2).sum()) / 2 - np.log(np.abs(np.diag(R))).sum()
        for border in self.borders:
            if not border.evidence:
                own = border.information[np.ix_(at, at)] * np.multiply.outer(size, size)
                out -= np.linalg.slogdet(np.eye(len(at)) + own)[1] / 2
        return float(out)

    def _prior_rows(self, columns: int) -> tuple[Floats, Floats]:
        """Return the priors of the constants as rows and right-hand sides."""
        held = np.flatnonzero(np.isfinite(self.used))
        prior = np.zeros((len(held), columns))
        prior[np.arange(len(held)), self.place(0)[held]] = 1.0     # columns are in its units
        return prior, self.centre[held] / self.used[held]

    def carried(self, value: Floats, spread: dict[str, float],
                evidence: dict[str, Floats]) -> Border:
        """
        Return the information of all legs on the last leg's constants, at ``value``.

        evidence : log likelihood of the scatter between legs, by name.
        """
        A, b = self.system(spread)
        rows, b = _left(A, b, self.place(len(self.borders) - 1))
        rows = rows / self.unit
        return Border(self.names, value, rows.T @ rows, rows.T @ (b - rows @ value),
                      self.centre, self.sigma, self.used, evidence)

    def evidence(self, name: str, points: int) -> Floats:
        """Return the log likelihood of a constant's scatter by combined legs: (points,)."""
        return sum((b.evidence[name] for b in self.borders if name in b.evidence),
                   np.zeros(points))

    def disagreement(self, spread: dict[str, float] | None = None) -> tuple[float, float]:
        """
        Return the chi-square of the legs with common constants, and its degrees of freedom: (S36).

        Only of directions determined at least as well as by the priors: the equations of a leg
        need not be linear over larger changes.
        """
        A, b = self.system(spread, self.determined())
        # priors bound what no leg determines: otherwise two legs that determine half of the
        # constants each, in different directions, would always agree
        prior, centre = self._prior_rows(A.shape[1])
        U, size, _ = np.linalg.svd(np.concatenate([A, prior]), full_matrices=False)
        of_legs, U = slice(len(A)), U[:, size > 1e-8 * size[0]]      # below is rounding
        rest = (b - U[of_legs] @ (U.T @ np.concatenate([b, centre])))
        return float(rest @ rest), len(A) - float((U[of_legs]**2).sum())

    def deviations(self) -> Floats:
        """
        Return the normalised residual of each leg's constants against the others': (J, m) sigmas.

        The gradient of the leg at the joint estimate, over its sigma, for each constant: the test
        of one additional unknown, as if the leg were left out (Baarda 1968), docs/method.md (S37).
        """
        x, C = self.solve()
        out = np.zeros((len(self.borders), len(self.names)))
        legs = self.determined()
        for j, (D, pull) in enumerate(zip(*self._scattering(legs, None), strict=True)):
            where = self.place(j)
            pull = pull - D @ (x[where] - legs[j].value)
            variance = np.diag(D - D @ C[np.ix_(where, where)] @ D)
            # no test if the others have less than a millionth of the leg's information
            news = variance > np.maximum(1e-6 * np.diag(D), 1e-300)
            out[j, news] = pull[news] / np.sqrt(variance[news])
        return out

    def _scattering(self, borders: Sequence[Border],
                    spread: dict[str, float] | None) -> tuple[Floats, Floats]:
        """
        Return information and pull of legs whose constants scatter: (J, m, m), (J, m).

        The information of combined legs already includes their scatter.
        """
        D, pull = (np.stack([getattr(b, what) for b in borders]) for what in (
            'information', 'pull'))
        own = [not b.evidence for b in borders]
        if spread and any(own):
            D[own], pull[own] = loosened(D[own], pull[own], [self.names.index(n) for n in spread],
                                         np.array(list(spread.values())))
        return D, pull


def _left(A: Floats, b: Floats, keep: Ints) -> tuple[Floats, Floats]:
    """Return rows of some unknowns, the others eliminated by QR, and their right-hand sides."""
    gone = np.setdiff1d(np.arange(A.shape[1]), keep)
    # only the first rows of R contain the eliminated unknowns
    R = np.asarray(np.linalg.qr(np.column_stack([A[:, gone], A[:, keep], b]), mode='r'))
    return R[len(gone):, len(gone):-1], R[len(gone):, -1]


def _on(border: Border, names: tuple[str, ...]) -> Border:
    """Return a border with more names, without information or prior on the new ones."""
    if border.names == names:
        return border
    at = [names.index(n) for n in border.names]
    m = len(names)
    D = np.zeros((m, m))
    D[np.ix_(at, at)] = border.information

    def on(values: Floats, rest: float) -> Floats:
        out = np.full(m, rest)
        out[at] = values
        return out
    # sigma 0: has no effect in the maximum over legs
    return Border(names, on(border.value, 0.0), D, on(border.pull, 0.0), on(border.centre, 0.0),
                  on(border.sigma, 0.0), on(border.used, 0.0), border.evidence)
