"""
Several legs of a vehicle to one estimate of its constants: that of one fit of all their rows.

Each leg comes as its border. Constants are those of the vehicle, the same in every leg, but that
ln K walks at random from leg to leg; what is believed beforehand counts once. Equations:
docs/method.md, several legs.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.border import Border, UNIT

Floats = NDArray[np.float64]
LEAST_STEP = 1e-7    # of ln K between legs: what no vehicle keeps, and no equations hold
NO_NEWS = 1e-6       # share of a leg's information on a constant that others do not foresee
SAME = 1e-8          # singular value, of the largest, that is rounding
Z95 = 1.6449         # one-sided 95 % point of the normal law
MOST_SPREADS = 3     # constants that may differ between legs before all sigmas are widened
STEPS = 40           # of a bisection
BENDS = 3            # passes in which legs are taken to where they were not linearised


@dataclass(frozen=True, eq=False)
class Joint:
    """
    The constants by all legs.

    names, value, covariance : (m,), (m, m), of the last leg where they walk.
    sigma, used : (m,) believed beforehand, first and with what legs gainsaid.
    chi2, freedom : disagreement of the legs before anything was widened, and what it should be.
    spread : sigma by which legs differ, of each constant that does.   deviation : (J, m) of each
    leg from the others, in sigmas, before that.   factor : on all sigmas, in ``covariance``.
    bent : (J,) rad, error of taking the leg's equations to where the constants are.
    """

    names: tuple[str, ...]
    value: Floats
    covariance: Floats
    sigma: Floats
    used: Floats
    chi2: float
    freedom: int
    deviation: Floats
    spread: dict[str, float] = field(default_factory=dict)
    factor: float = 1.0
    bent: Floats = field(default_factory=lambda: np.zeros(0))


class Legs:
    """Borders on common names, the constants' prior, and the walk of one of them."""

    def __init__(self, borders, drifting: str, steps, angles=()):
        """Take legs by time; ``steps`` (J - 1,): sigmas of ``drifting`` between them."""
        self.names = tuple(dict.fromkeys(n for b in borders for n in b.names))
        self.borders = [_on(b, self.names) for b in borders]
        last = self.borders[-1]
        for name in angles:
            about = last.value[self.names.index(name)]
            self.borders = [b.turned(name, about) for b in self.borders]
        self.centre = last.centre
        self.sigma, self.used = (np.max([getattr(b, which) for b in self.borders], axis=0)
                                 for which in ('sigma', 'used'))
        self.unit = np.where(np.isfinite(self.used), self.used, UNIT)
        self.drifting = self.names.index(drifting)
        self.steps = np.maximum(steps, LEAST_STEP)

    def columns(self, j):
        """Return where the constants of leg j stand among the unknowns: z, then k by leg."""
        m = len(self.names)
        where = np.arange(m)
        where[self.drifting] = m + j
        return where

    def system(self, spread=None):
        """Return the rows of all legs and of the walk, and what they should be."""
        m, J = len(self.names), len(self.borders)
        A, b = [], []
        for j, border in enumerate(self.borders):
            R, y = (border.loosened(spread) if spread else border).rows(self.unit)
            A.append(np.zeros((len(R), m + J)))
            A[-1][:, self.columns(j)] = R
            b.append(y)
        walk = np.zeros((J - 1, m + J))
        j = np.arange(J - 1)
        walk[j, m + j], walk[j, m + j + 1] = -1 / self.steps, 1 / self.steps
        used = [i for i in range(m + J) if i != self.drifting]
        scale = np.concatenate([self.unit, np.full(J, self.unit[self.drifting])])[used]
        return np.concatenate([*A, walk])[:, used] * scale, np.concatenate([*b, np.zeros(J - 1)])

    def place(self, j):
        """Return where the constants of leg j stand among the columns of ``system``."""
        where = self.columns(j)
        return where - (where > self.drifting)

    def solve(self, spread=None):
        """Return the unknowns and their covariance, of leg j at ``place``."""
        A, b = self.system(spread)
        held = np.flatnonzero(np.isfinite(self.used))
        prior = np.zeros((len(held), A.shape[1]))
        prior[np.arange(len(held)), self.place(0)[held]] = 1.0     # columns are in its units
        Q, R = np.linalg.qr(np.concatenate([A, prior]))
        inverse = np.linalg.inv(R)
        x = inverse @ (Q.T @ np.concatenate([b, self.centre[held] / self.used[held]]))
        scale = np.empty(A.shape[1])
        for j in range(len(self.borders)):
            scale[self.place(j)] = self.unit
        return x * scale, inverse @ inverse.T * np.multiply.outer(scale, scale)

    def disagreement(self, spread=None):
        """Return by how much the least cost rises when legs are one vehicle's, and freedom."""
        A, b = self.system(spread)
        U, size, _ = np.linalg.svd(A, full_matrices=False)
        U = U[:, size > SAME * size[0]]
        rest = b - U @ (U.T @ b)
        return float(rest @ rest), A.shape[0] - U.shape[1]

    def deviations(self, spread=None):
        """
        Return by how much each leg's constants differ from those by the others, in sigmas: (J, m).

        The leg's pull at the joint estimate over its own sigma, each constant alone: the test of
        one more unknown, as if the leg were left out (Baarda 1968).
        """
        x, C = self.solve(spread)
        out = np.zeros((len(self.borders), len(self.names)))
        for j, border in enumerate(self.borders):
            border = border.loosened(spread) if spread else border
            D, where = border.information, self.place(j)
            pull = border.pull - D @ (x[where] - border.value)
            variance = np.diag(D - D @ C[np.ix_(where, where)] @ D)
            news = variance > NO_NEWS * np.maximum(np.diag(D), 1e-300)
            out[j, news] = pull[news] / np.sqrt(variance[news])
        return out


def joint(borders, steps, drifting='scale_factor', angles=(), curved=()) -> Joint:
    """
    Combine legs of one vehicle.

    Parameters
    ----------
    borders : sequence of Border
        By time, at least one.
    steps : (J - 1,) array
        Sigma by which ``drifting`` may have changed from leg to leg.
    drifting : str
        The constant that walks.
    angles : sequence of str
        Constants that are the same after a whole turn.
    curved : sequence of str
        Those in which a leg's equations are not linear: 1 - cos of their change is an error of
        that leg's own.

    Returns
    -------
    Joint. Legs that differ by more than their sigmas allow have the constants that differ most
    taken for scattering by as much as it takes; where that does not do, all sigmas are widened.

    """
    legs = Legs(list(borders), drifting, np.asarray(steps, float), angles)
    bent = _bend(legs, [n for n in curved if n in legs.names])
    chi2, freedom = legs.disagreement()
    deviation, spread, factor, now = legs.deviations(), {}, 1.0, chi2
    while freedom and now > chi2_95(freedom):
        odd = np.abs(legs.deviations(spread)).max(axis=0)
        odd[[legs.names.index(n) for n in spread]] = 0.0
        if len(spread) == MOST_SPREADS or not odd.any():
            factor = float(np.sqrt(now / freedom))
            break
        name = legs.names[int(np.argmax(odd))]
        spread = spread | {name: _spread(legs, spread, name)}
        now, _ = legs.disagreement(spread)
    x, C = legs.solve(spread)
    where = legs.place(len(borders) - 1)
    return Joint(legs.names, x[where], C[np.ix_(where, where)] * factor**2, legs.sigma, legs.used,
                 chi2, freedom, deviation, spread, factor, bent)


def chi2_95(freedom):
    """Return the 95 % point of chi-square (Wilson and Hilferty 1931; within 1 % from 2 on)."""
    a = 2 / (9 * freedom)
    return freedom * (1 - a + Z95 * np.sqrt(a))**3


def _spread(legs, spread, name) -> float:
    """
    Return the sigma of a constant between legs at which they differ in it as much as they may.

    That is by one for each leg but one beyond where it is free (Paule and Mandel 1982).
    """
    i = legs.names.index(name)
    low = legs.unit[i] * 1e-9
    high = 10 * max(np.ptp([b.value[i] for b in legs.borders]), low)
    least, _ = legs.disagreement(spread | {name: high})
    target = least + len(legs.borders) - 1
    for _ in range(STEPS):
        middle = float(np.sqrt(low * high))
        chi2, _ = legs.disagreement(spread | {name: middle})
        low, high = (middle, high) if chi2 > target else (low, middle)
    return high


def _bend(legs, curved):
    """Give each leg an error of its own for the way from where it was linearised; (J,) of it."""
    first, at = legs.borders, [legs.names.index(n) for n in curved]
    bent = np.zeros(len(first))
    for _ in range(BENDS if curved else 0):
        x, _ = legs.solve()
        way = np.array([x[legs.place(j)][at] - b.value[at] for j, b in enumerate(first)])
        bent = (way**2).sum(axis=1) / 2
        legs.borders = [b.loosened(dict.fromkeys(curved, size))
                        for b, size in zip(first, bent, strict=True)]
    return bent


def _on(border: Border, names) -> Border:
    """Return a border on more names, of which it says and believes nothing."""
    if border.names == names:
        return border
    at = [names.index(n) for n in border.names]
    m = len(names)
    D = np.zeros((m, m))
    D[np.ix_(at, at)] = border.information

    def on(values, rest):
        out = np.full(m, rest)
        out[at] = values
        return out
    # a belief that a leg does not have is none that it has widened
    return Border(names, on(border.value, 0.0), D, on(border.pull, 0.0), on(border.centre, 0.0),
                  on(border.sigma, 0.0), on(border.used, 0.0))
