# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Several legs of a vehicle to one estimate of its constants: that of one fit of all their rows.

Each leg comes as its border. Constants are those of the vehicle, the same in every leg, but that
ln K walks at random from leg to leg; priors count once: docs/method.md (S35).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.border import Border, SCATTER_POINTS
from odocal_ros.calib.linked_legs import LinkedLegs

Floats = NDArray[np.float64]
# statistical, deviates of a chi-square from which legs disagree: once in 20 sets of sound legs by
# chance; in one constant once in 300, since some 15 are looked at: again one set in 20
Z95, DISPUTED_DEVIATES = 1.6449, 2.7
# judgement: of the logarithm of a sigma between legs over the usual one, for a mean over it
SCATTER_GRID = np.linspace(-2.5, 5.0, SCATTER_POINTS)


@dataclass(frozen=True, eq=False)
class Joint:
    """
    The constants by all legs.

    names, value, covariance : (m,), (m, m), of the last leg where they walk.
    sigma, used : (m,) of the priors, first and with what legs contradicted.
    chi2, freedom : disagreement of the legs before anything was widened, and what it should be.
    between : sigma by which a constant scatters between legs, by name.   disputed : constants in
    which legs differ for certain.   deviation : (J, m) of each leg from the others, in sigmas,
    without scatter.   factor : on all sigmas, in ``covariance``.
    bent : (J,) rad, error of taking the leg's equations to where the constants are.
    carried : information of all of them, for later legs.
    """

    names: tuple[str, ...]
    value: Floats
    covariance: Floats
    sigma: Floats
    used: Floats
    chi2: float
    freedom: float
    deviation: Floats
    carried: Border
    between: dict[str, float] = field(default_factory=dict)
    disputed: tuple[str, ...] = ()
    factor: float = 1.0
    bent: Floats = field(default_factory=lambda: np.zeros(0))


def joint(borders: Sequence[Border], steps: Sequence[float] | Floats,
          drifting: str = 'scale_factor', angles: Sequence[str] = (),
          curved: Sequence[str] = (), usual: Mapping[str, float] | None = None,
          same: Sequence[bool] = ()) -> Joint:
    """
    Combine legs of one vehicle.

    borders : by time, at least one.   steps : (J - 1,) sigma by which ``drifting`` may have
    changed from leg to leg.   drifting : the constant that walks.   angles : constants that are
    the same after a whole turn.   curved : those in which a leg's equations are not linear: 1 -
    cos of their change is an error of that leg's own.   usual : constants that scatter between
    legs, with the usual sigma of it; their levels are estimated, (S38).   same : (J - 1,) the
    next is a section of the same leg, and does not scatter from it.

    Returns
    -------
    Joint. Where legs differ by more than their sigmas and their scatter allow, all sigmas are
    widened.

    """
    usual = usual or {}
    legs = LinkedLegs(list(borders), drifting, np.asarray(steps, float), angles)
    bent = _bend(legs, [n for n in curved if n in legs.names])
    chi2, freedom = legs.disagreement()
    drives = legs.joined(same)
    scatter = _scatter(drives, usual)
    # the constants of a single leg are its own
    alone = len(drives.borders) == 1 and not borders[0].evidence
    between = {} if alone else scatter.sigmas
    left, rest = (apart + of_legs - of_drives for apart, of_legs, of_drives in zip(
        drives.disagreement(between), (chi2, freedom), drives.disagreement(), strict=True))
    factor = float(np.sqrt(left / rest)) if rest and deviate(left, rest) > Z95 else 1.0
    where = drives.place(len(drives.borders) - 1)
    x, C = drives.solve() if alone else _averaged(drives, scatter, usual)
    carried = drives.carried(x[where], scatter.sigmas, scatter.evidence).widened(factor)
    return Joint(legs.names, x[where], C[np.ix_(where, where)] * factor**2, legs.sigma, legs.used,
                 chi2, freedom, legs.deviations(), carried, between,
                 _disputed(legs, between, usual), factor, bent)


def deviate(chi2: float, freedom: float) -> float:
    """Return the normal deviate of a chi-square (Wilson and Hilferty 1931)."""
    a = 2 / (9 * freedom)
    out: float = ((max(chi2, 0.0) / freedom)**(1 / 3) - (1 - a)) / np.sqrt(a)
    return out


@dataclass(frozen=True, eq=False)
class Scatter:
    """
    How much constants scatter between legs, by name.

    sigmas : the mean of its logarithm.   evidence : (g,) log likelihood at the points of
    SCATTER_GRID.
    weights : (g,) of these points.
    """

    sigmas: dict[str, float]
    evidence: dict[str, Floats]
    weights: dict[str, Floats]


def _scatter(legs: LinkedLegs, usual: Mapping[str, float]) -> Scatter:
    """
    Return the scatter of these constants between the legs, docs/method.md (S38).

    By restricted likelihood, with a half-Cauchy prior whose scale is the usual sigma (Gelman
    2006).
    """
    from scipy.interpolate import CubicSpline
    between, evidence, weights = dict(usual), dict[str, Floats](), dict[str, Floats]()
    fine = np.linspace(SCATTER_GRID[0], SCATTER_GRID[-1], 301)
    for _ in range(2):      # sweeps: the scatter of one hardly depends on that of another
        for name, size in usual.items():
            own = np.array([legs.log_likelihood({**between, name: size * float(np.exp(off))})
                            for off in SCATTER_GRID])
            evidence[name] = own - own.max() + legs.evidence(name, len(own))
            odds = CubicSpline(SCATTER_GRID, evidence[name])(fine)
            odds = odds + fine - np.log1p(np.exp(2 * fine))
            weight = np.exp(odds - odds.max())
            weight /= weight.sum()
            between[name] = size * float(np.exp(weight @ fine))
            weights[name] = np.array([weight @ np.interp(fine, SCATTER_GRID, node)
                                      for node in np.eye(len(own))])
    return Scatter(between, evidence, weights)


def _averaged(legs: LinkedLegs, scatter: Scatter,
              usual: Mapping[str, float]) -> tuple[Floats, Floats]:
    """
    Return the unknowns at this scatter, and their covariance over all scatters.

    Few legs hardly determine the scatter of a constant: docs/method.md (S39).
    """
    x, C = legs.solve(scatter.sigmas)
    out = C.copy()
    for name, weight in scatter.weights.items():
        for w, off in zip(weight, SCATTER_GRID, strict=True):
            value, covariance = legs.solve(scatter.sigmas | {name: usual[name] * np.exp(off)})
            out += w * (covariance - C + np.multiply.outer(value - x, value - x))
    return x, out


def _disputed(legs: LinkedLegs, between: dict[str, float],
              usual: Mapping[str, float]) -> tuple[str, ...]:
    """
    Return the constants in which legs differ for certain.

    By more than the usual scatter; of those without a level, the one that explains most of what
    is left.
    """
    def deviates(name: str) -> float:
        now, freedom = (legs.disagreement({**between, name: usual[name]}) if name in usual
                        else as_they_are)
        left, rest = legs.disagreement({**between, name: np.inf})
        # less is no constant that legs determine
        return deviate(now - left, freedom - rest) if freedom - rest > 0.5 else -np.inf
    if len(legs.borders) < 2:
        return ()
    as_they_are = legs.disagreement(between)
    odds = {name: deviates(name) for name in legs.names}
    others = [name for name in legs.names if name not in between]
    sure = [*between, *([max(others, key=odds.__getitem__)] if others else [])]
    return tuple(name for name in sure if odds[name] > DISPUTED_DEVIATES)


def _bend(legs: LinkedLegs, curved: Sequence[str]) -> Floats:
    """Give each leg an error for the distance from its linearisation point; return it, (J,)."""
    first, at = legs.borders, [legs.names.index(n) for n in curved]
    bent = np.zeros(len(first))
    for _ in range(3 if curved else 0):     # legs of less weight move the others less
        x, _ = legs.solve()
        way = np.array([x[legs.place(j)][at] - b.value[at] for j, b in enumerate(first)])
        bent = (way**2).sum(axis=1) / 2
        legs.take([b.loosened(dict.fromkeys(curved, size))
                   for b, size in zip(first, bent, strict=True)])
    return bent
