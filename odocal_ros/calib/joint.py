# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Several legs of a vehicle to one estimate of its constants: that of one fit of all their rows.

Each leg comes as its border. Constants are those of the vehicle, the same in every leg, but that
ln K walks at random from leg to leg; priors count once: docs/method.md (S35).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.border import Border
from odocal_ros.calib.linked_legs import LinkedLegs

Floats = NDArray[np.float64]
# statistical, deviates of a chi-square from which legs disagree: once in 20 sets of sound legs by
# chance; in one constant once in 300, since some 15 are looked at: again one set in 20
Z95, DISPUTED_DEVIATES = 1.6449, 2.7


@dataclass(frozen=True, eq=False)
class Joint:
    """
    The constants by all legs.

    names, value, covariance : (m,), (m, m), of the last leg where they walk.
    sigma, used : (m,) of the priors, first and with what legs gainsaid.
    chi2, freedom : disagreement of the legs before anything was widened, and what it should be.
    spread : sigma by which legs differ, of each constant that does.   deviation : (J, m) of each
    leg from the others, in sigmas, before that.   factor : on all sigmas, in ``covariance``.
    bent : (J,) rad, error of taking the leg's equations to where the constants are.
    carried : what all of them tell, for legs to come.
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
    spread: dict[str, float] = field(default_factory=dict)
    factor: float = 1.0
    bent: Floats = field(default_factory=lambda: np.zeros(0))


def joint(borders: Sequence[Border], steps: Sequence[float] | Floats,
          drifting: str = 'scale_factor', angles: Sequence[str] = (),
          curved: Sequence[str] = ()) -> Joint:
    """
    Combine legs of one vehicle.

    borders : by time, at least one.   steps : (J - 1,) sigma by which ``drifting`` may have
    changed from leg to leg.   drifting : the constant that walks.   angles : constants that are
    the same after a whole turn.   curved : those in which a leg's equations are not linear: 1 -
    cos of their change is an error of that leg's own.

    Returns
    -------
    Joint. Constants in which legs differ for certain are taken to scatter between them by as much
    as it takes; where legs still differ by more than their sigmas allow, all sigmas are widened.

    """
    legs = LinkedLegs(list(borders), drifting, np.asarray(steps, float), angles)
    bent = _bend(legs, [n for n in curved if n in legs.names])
    chi2, freedom = legs.disagreement()
    deviation, spread = legs.deviations(), _disputed(legs)
    left, rest = legs.disagreement(spread)
    factor = float(np.sqrt(left / rest)) if rest and deviate(left, rest) > Z95 else 1.0
    x, C = legs.solve(spread)
    where = legs.place(len(borders) - 1)
    return Joint(legs.names, x[where], C[np.ix_(where, where)] * factor**2, legs.sigma, legs.used,
                 chi2, freedom, deviation, legs.carried(x[where], spread).widened(factor), spread,
                 factor, bent)


def deviate(chi2: float, freedom: float) -> float:
    """Return the normal deviate of a chi-square (Wilson and Hilferty 1931)."""
    a = 2 / (9 * freedom)
    out: float = ((max(chi2, 0.0) / freedom)**(1 / 3) - (1 - a)) / np.sqrt(a)
    return out


def _disputed(legs: LinkedLegs) -> dict[str, float]:
    """Return the constants in which legs differ for certain, and by what sigma."""
    spread: dict[str, float] = {}
    while len(spread) < 3:      # where legs differ in more, all their sigmas are in doubt
        now, freedom = legs.disagreement(spread)
        found = []
        for name in (n for n in legs.names if n not in spread):
            left, rest = legs.disagreement(spread | {name: np.inf})
            if freedom - rest > 0.5:    # less is no constant that legs tell
                found.append((deviate(now - left, freedom - rest), name, left + freedom - rest))
        if not found or max(found)[0] < DISPUTED_DEVIATES:
            break
        _, name, target = max(found)
        spread = spread | {name: _spread(legs, spread, name, target)}
    return spread


def _spread(legs: LinkedLegs, spread: dict[str, float], name: str, target: float) -> float:
    """
    Return the sigma of a constant between legs at which they differ in it as much as they may.

    target : the disagreement that is left where the constant is each leg's own, and one for each
    leg but one (Paule and Mandel 1982). No more than its prior: what is known to 1 %
    does not differ by 4 %, and without this limit the legs would determine it from their noise.
    """
    i = legs.names.index(name)
    high = 1e3 * max(np.ptp([b.value[i] for b in legs.borders]), legs.unit[i])
    high = min(high, float(legs.used[i]))
    low = high * 1e-12
    for _ in range(40):     # halvings of the logarithm: to 3e-11 of it
        middle = float(np.sqrt(low * high))
        chi2, _ = legs.disagreement(spread | {name: middle})
        low, high = (middle, high) if chi2 > target else (low, middle)
    out: float = high
    return out


def _bend(legs: LinkedLegs, curved: Sequence[str]) -> Floats:
    """Give each leg an error of its own for the way from where it was linearised; (J,) of it."""
    first, at = legs.borders, [legs.names.index(n) for n in curved]
    bent = np.zeros(len(first))
    for _ in range(3 if curved else 0):     # legs of less weight move the others less
        x, _ = legs.solve()
        way = np.array([x[legs.place(j)][at] - b.value[at] for j, b in enumerate(first)])
        bent = (way**2).sum(axis=1) / 2
        legs.take([b.loosened(dict.fromkeys(curved, size))
                   for b, size in zip(first, bent, strict=True)])
    return bent
