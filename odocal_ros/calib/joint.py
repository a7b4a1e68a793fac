# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Joint estimate of a vehicle's constants from several legs, equal to one fit of all their rows.

Each leg is given by its marginal information. The constants are the same in every leg, except
ln K, a random walk from leg to leg; priors count once: docs/method.md (S35). New tyres or a load
change the scale beyond the random walk.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from odocal_ros.calib.linked_legs import LinkedLegs
from odocal_ros.calib.marginal_information import MarginalInformation, SCATTER_POINTS
from odocal_ros.data.arrays import Floats
from odocal_ros.settings.levels import REMARK_SIGMAS

# statistical, limits of the chi-square's normal deviate for disagreement: by chance once in 20
# sets of sound legs; in one constant once in 300, with some 15 tested again one set in 20
NORMAL_95, DISPUTED_DEVIATES = 1.6449, 2.7
# judgement: grid of ln (sigma between legs / usual sigma), for means over it
SCATTER_GRID = np.linspace(-2.5, 5.0, SCATTER_POINTS)
# 1 sigma of a permanent change of ln K, by any tyre, gear or counter: physical
FREE_STEP = 1.0


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """Joint estimate of m constants from all J legs."""

    names: tuple[str, ...]
    value: Floats                   # (m,), of the last leg for the one that drifts
    covariance: Floats              # (m, m)
    sigma: Floats                   # (m,) of the priors
    used: Floats                    # (m,) the same, widened by legs that contradict them
    chi2: float                     # of the legs before any widening
    freedom: float                  # its degrees of freedom
    deviation: Floats  # (J, m) of each leg from the others, in sigmas, without scatter
    carried: MarginalInformation                 # information of all legs, for later legs
    between: dict[str, float] = field(default_factory=dict)  # scatter between legs
    disputed: tuple[str, ...] = ()  # constants in which legs differ
    factor: float = 1.0             # on all sigmas, included in ``covariance``
    bent: Floats = field(default_factory=lambda: np.zeros(0))  # rad, linearisation errors


def fit_jointly(marginals: Sequence[MarginalInformation], steps: Sequence[float] | Floats,
                drifting: str = 'scale_factor', angles: Sequence[str] = (),
                curved: Sequence[str] = (), usual: Mapping[str, float] | None = None,
                same: Sequence[bool] = ()) -> JointEstimate:
    """
    Combine legs of one vehicle; all sigmas are widened if legs differ beyond them and the scatter.

    marginals : by time, at least one.   steps : (J - 1,) sigma of the change of ``drifting`` from
    leg to leg.   drifting : the constant with a random walk.   angles : constants with a period
    of one turn.   curved : constants in which a leg's equations are not linear: 1 - cos of their
    change becomes an error of that leg alone.   usual : usual scatter sigma of constants between
    legs, by name; the scatter is estimated, (S38).   same : (J - 1,) True: the next is a section
    of the same leg, without scatter.
    """
    usual = usual or {}
    legs = LinkedLegs(list(marginals), drifting, np.asarray(steps, float), angles)
    bent = _add_linearisation_errors(legs, [n for n in curved if n in legs.names])
    chi2, freedom = legs.disagreement()
    drives = legs.combine_sections(same)
    scatter = _scatter(drives, usual)
    # a single leg has no scatter
    alone = len(drives.marginals) == 1 and not marginals[0].evidence
    between = {} if alone else scatter.sigmas
    left, rest = (in_scatter + of_legs - of_drives for in_scatter, of_legs, of_drives in zip(
        drives.disagreement(between), (chi2, freedom), drives.disagreement(), strict=True))
    factor = float(np.sqrt(left / rest)) if rest and normal_deviate(left,
                                                                    rest) > NORMAL_95 else 1.0
    where = drives.place(len(drives.marginals) - 1)
    x, C = drives.solve() if alone else _average_over_scatter(drives, scatter, usual)
    carried = drives.carried(x[where], scatter.sigmas, scatter.evidence).widened(factor)
    return JointEstimate(legs.names, x[where], C[np.ix_(where, where)] * factor**2, legs.sigma,
                         legs.used,
                         chi2, freedom, legs.deviations(), carried, between,
                         _find_disputed(legs, between, usual), factor, bent)


def normal_deviate(chi2: float, freedom: float) -> float:
    """Return the normal deviate of a chi-square (Wilson and Hilferty 1931)."""
    a = 2 / (9 * freedom)
    out: float = ((max(chi2, 0.0) / freedom)**(1 / 3) - (1 - a)) / np.sqrt(a)
    return out


@dataclass(frozen=True, eq=False)
class Scatter:
    """Scatter of constants between legs, by name."""

    sigmas: dict[str, float]     # geometric means
    evidence: dict[str, Floats]  # (g,) log likelihood at the points of SCATTER_GRID
    weights: dict[str, Floats]   # (g,) of these points


def _scatter(legs: LinkedLegs, usual: Mapping[str, float]) -> Scatter:
    """Return the scatter between the legs of the constants in ``usual``, (S38)."""
    # by restricted likelihood, with a half-Cauchy prior of the usual sigma (Gelman 2006)
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


def _average_over_scatter(legs: LinkedLegs, scatter: Scatter,
                          usual: Mapping[str, float]) -> tuple[Floats, Floats]:
    """Return the unknowns at this scatter, and their covariance averaged over all of it, (S39)."""
    x, C = legs.solve(scatter.sigmas)
    out = C.copy()
    for name, weight in scatter.weights.items():
        for w, off in zip(weight, SCATTER_GRID, strict=True):
            value, covariance = legs.solve(scatter.sigmas | {name: usual[name] * np.exp(off)})
            out += w * (covariance - C + np.multiply.outer(value - x, value - x))
    return x, out


def _find_disputed(legs: LinkedLegs, between: dict[str, float],
                   usual: Mapping[str, float]) -> tuple[str, ...]:
    """Return the constants in which legs differ by more than the usual scatter."""
    # of those without scatter, only the one that explains most of the remaining chi-square
    def deviates(name: str) -> float:
        now, freedom = (legs.disagreement({**between, name: usual[name]}) if name in usual
                        else as_they_are)
        left, rest = legs.disagreement({**between, name: np.inf})
        # below, the legs do not determine the constant
        return normal_deviate(now - left, freedom - rest) if freedom - rest > 0.5 else -np.inf
    if len(legs.marginals) < 2:
        return ()
    as_they_are = legs.disagreement(between)
    odds = {name: deviates(name) for name in legs.names}
    others = [name for name in legs.names if name not in between]
    sure = [*between, *([max(others, key=odds.__getitem__)] if others else [])]
    return tuple(name for name in sure if odds[name] > DISPUTED_DEVIATES)


def _add_linearisation_errors(legs: LinkedLegs, curved: Sequence[str]) -> Floats:
    """Add a linearisation error to each leg, by the distance from its point; return it, (J,)."""
    first, at = legs.marginals, [legs.names.index(n) for n in curved]
    bent = np.zeros(len(first))
    for _ in range(3 if curved else 0):     # with reduced weights the estimate changes
        x, _ = legs.solve()
        moved = np.array([x[legs.place(j)][at] - b.value[at] for j, b in enumerate(first)])
        bent = (moved**2).sum(axis=1) / 2
        legs.replace_marginals([b.loosened(dict.fromkeys(curved, size))
                   for b, size in zip(first, bent, strict=True)])
    return bent


@dataclass(frozen=True)
class ScaleStep:
    """A change of ln K from leg number ``leg`` - 1 to ``leg``, from 0, and its size in sigmas."""

    leg: int
    change: float
    sigmas: float


def scale_steps(marginals: Sequence[MarginalInformation], steps: Sequence[float] | Floats,
                drifting: str, angles: Sequence[str] = ()) -> list[ScaleStep]:
    """
    Return changes of the scale from its prediction by the earlier legs, beyond REMARK_SIGMAS.

    Arguments as for ``fit_jointly``. After a change, only later legs predict the scale.
    """
    steps, found = np.array(steps, float), []
    for j in range(1, len(marginals)):
        legs = LinkedLegs(marginals[:j + 1], drifting, steps[:j], angles)
        sigmas = float(legs.deviations()[j, legs.drifting])
        if abs(sigmas) <= REMARK_SIGMAS:
            continue
        steps[j - 1] = FREE_STEP
        legs = LinkedLegs(marginals[:j + 1], drifting, steps[:j], angles)
        x, _ = legs.solve()
        before, now = (x[legs.place(k)[legs.drifting]] for k in (j - 1, j))
        found.append(ScaleStep(j, float(now - before), sigmas))
    return found
