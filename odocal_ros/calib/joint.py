# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Joint estimate of a vehicle's constants from several legs, equal to one fit of all their rows.

Input is the marginal information of each leg. The constants are the same in every leg, except
ln K, a random walk from leg to leg; priors count once: docs/method.md (S35). Scale and angles also
scatter between legs, (S38). New tyres or a load change the scale beyond both: ``scale_steps``.
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
# physical: sigma of ln K after a change of tyre, gear or counter, so large that K is free
FREE_STEP = 1.0


@dataclass(frozen=True, eq=False)
class JointEstimate:
    """Joint estimate of m constants from all J legs."""

    names: tuple[str, ...]
    value: Floats                     # (m,), of the last leg for the one that drifts
    covariance: Floats                # (m, m)
    prior_sigma: Floats               # (m,)
    relaxed_sigma: Floats             # (m,) prior sigma, widened if the legs contradict the prior
    chi2: float                       # of the legs, before ``factor``
    freedom: float                    # its degrees of freedom
    deviation: Floats                 # (J, m) sigmas, of each leg from the others, (S37)
    information: MarginalInformation  # of all legs, for later ones
    # name of a constant -> sigma of its differences between legs; empty for a single leg
    scatter: dict[str, float] = field(default_factory=dict)
    disputed: tuple[str, ...] = ()    # constants in which legs differ significantly
    factor: float = 1.0               # of all sigmas, included in ``covariance``
    # (J,) rad or relative, additional error of each leg by its linearisation
    linearisation_error: Floats = field(default_factory=lambda: np.zeros(0))


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
    linearisation_error = _add_linearisation_errors(legs, [n for n in curved if n in legs.names])
    chi2, freedom = legs.disagreement()
    drives = legs.combine_sections(same)
    estimated = _estimate_scatter(drives, usual)
    # a single leg has no scatter
    is_single = len(drives.marginals) == 1 and not marginals[0].scatter_likelihood
    scatter = {} if is_single else estimated.sigmas
    # chi-square of the drives with scatter, plus that of their sections about each drive
    residual_chi2, residual_freedom = (
        with_scatter + of_legs - of_drives for with_scatter, of_legs, of_drives in zip(
            drives.disagreement(scatter), (chi2, freedom), drives.disagreement(), strict=True))
    disagree = residual_freedom and normal_deviate(residual_chi2, residual_freedom) > NORMAL_95
    factor = float(np.sqrt(residual_chi2 / residual_freedom)) if disagree else 1.0
    last = drives.indices(len(drives.marginals) - 1)
    x, C = drives.solve() if is_single else _average_over_scatter(drives, estimated, usual)
    information = drives.combined_information(x[last], estimated.sigmas, estimated.likelihood)
    return JointEstimate(
        legs.names, x[last], C[np.ix_(last, last)] * factor**2, legs.prior_sigma,
        legs.relaxed_sigma, chi2, freedom, legs.deviations(), information.widened(factor),
        scatter, _find_disputed(legs, scatter, usual), factor, linearisation_error)


def normal_deviate(chi2: float, freedom: float) -> float:
    """Return the normal deviate of a chi-square (Wilson and Hilferty 1931)."""
    a = 2 / (9 * freedom)
    out: float = ((max(chi2, 0.0) / freedom)**(1 / 3) - (1 - a)) / np.sqrt(a)
    return out


@dataclass(frozen=True, eq=False)
class Scatter:
    """Estimated scatter of constants between legs, by name; arrays are at SCATTER_GRID."""

    sigmas: dict[str, float]        # geometric means
    likelihood: dict[str, Floats]   # (SCATTER_POINTS,) log likelihood
    weights: dict[str, Floats]      # (SCATTER_POINTS,) of a mean over the scatter, (S39)


def _estimate_scatter(legs: LinkedLegs, usual: Mapping[str, float]) -> Scatter:
    """Return the scatter between the legs of the constants in ``usual``, (S38)."""
    # by restricted likelihood, with a half-Cauchy prior of the usual sigma (Gelman 2006)
    from scipy.interpolate import CubicSpline
    sigmas, likelihood, weights = dict(usual), dict[str, Floats](), dict[str, Floats]()
    fine = np.linspace(SCATTER_GRID[0], SCATTER_GRID[-1], 301)
    for _ in range(2):      # sweeps: the scatter of one hardly depends on that of another
        for name, size in usual.items():
            log = np.array([legs.log_likelihood({**sigmas, name: size * float(np.exp(x))})
                            for x in SCATTER_GRID])
            # legs combined earlier bring the likelihood of their scatter
            likelihood[name] = log - log.max() + sum(
                (b.scatter_likelihood[name] for b in legs.marginals
                 if name in b.scatter_likelihood), np.zeros(SCATTER_POINTS))
            posterior = CubicSpline(SCATTER_GRID, likelihood[name])(fine)
            posterior = posterior + fine - np.log1p(np.exp(2 * fine))
            weight = np.exp(posterior - posterior.max())
            weight /= weight.sum()
            sigmas[name] = size * float(np.exp(weight @ fine))
            weights[name] = np.array([weight @ np.interp(fine, SCATTER_GRID, node)
                                      for node in np.eye(SCATTER_POINTS)])
    return Scatter(sigmas, likelihood, weights)


def _average_over_scatter(legs: LinkedLegs, scatter: Scatter,
                          usual: Mapping[str, float]) -> tuple[Floats, Floats]:
    """Return the unknowns at this scatter, and their covariance averaged over all of it, (S39)."""
    x, C = legs.solve(scatter.sigmas)
    averaged = C.copy()
    for name, weight in scatter.weights.items():
        for w, log_ratio in zip(weight, SCATTER_GRID, strict=True):
            value, covariance = legs.solve(
                scatter.sigmas | {name: usual[name] * np.exp(log_ratio)})
            averaged += w * (covariance - C + np.multiply.outer(value - x, value - x))
    return x, averaged


def _find_disputed(legs: LinkedLegs, scatter: dict[str, float],
                   usual: Mapping[str, float]) -> tuple[str, ...]:
    """Return the constants in which legs differ by more than the usual scatter."""
    def deviate(name: str) -> float:
        """Return the normal deviate of the chi-square that a free constant in each leg removes."""
        chi2, freedom = (legs.disagreement({**scatter, name: usual[name]}) if name in usual
                         else with_scatter)
        free_chi2, free_freedom = legs.disagreement({**scatter, name: np.inf})
        # below 0.5, the legs do not determine the constant
        return normal_deviate(chi2 - free_chi2, freedom - free_freedom) \
            if freedom - free_freedom > 0.5 else -np.inf
    if len(legs.marginals) < 2:
        return ()
    with_scatter = legs.disagreement(scatter)
    deviates = {name: deviate(name) for name in legs.names}
    # of those without scatter, only the one that explains most of the remaining chi-square
    others = [name for name in legs.names if name not in scatter]
    tested = [*scatter, *([max(others, key=deviates.__getitem__)] if others else [])]
    return tuple(name for name in tested if deviates[name] > DISPUTED_DEVIATES)


def _add_linearisation_errors(legs: LinkedLegs, curved: Sequence[str]) -> Floats:
    """Add an error to each leg by its distance from the linearisation point; return it: (J,)."""
    linearised, indices = legs.marginals, [legs.names.index(n) for n in curved]
    error = np.zeros(len(linearised))
    for _ in range(3 if curved else 0):     # with reduced weights the estimate changes
        x, _ = legs.solve()
        distance = np.array([x[legs.indices(j)][indices] - b.point[indices]
                             for j, b in enumerate(linearised)])
        error = (distance**2).sum(axis=1) / 2
        legs.replace_marginals([b.with_leg_errors(dict.fromkeys(curved, size))
                                for b, size in zip(linearised, error, strict=True)])
    return error


@dataclass(frozen=True)
class ScaleStep:
    """A permanent change of the scale between two legs."""

    leg: int        # index of the later one, from 0
    change: float   # of ln K
    sigmas: float   # its size in sigmas


def scale_steps(marginals: Sequence[MarginalInformation], steps: Sequence[float] | Floats,
                drifting: str, angles: Sequence[str] = ()) -> list[ScaleStep]:
    """
    Return changes of the scale from its prediction by the earlier legs, beyond REMARK_SIGMAS.

    Arguments as for ``fit_jointly``. After a change, only later legs predict the scale.
    """
    steps, changes = np.array(steps, float), []
    for j in range(1, len(marginals)):
        legs = LinkedLegs(marginals[:j + 1], drifting, steps[:j], angles)
        sigmas = float(legs.deviations()[j, legs.drifting])
        if abs(sigmas) <= REMARK_SIGMAS:
            continue
        steps[j - 1] = FREE_STEP
        legs = LinkedLegs(marginals[:j + 1], drifting, steps[:j], angles)
        x, _ = legs.solve()
        before, now = (x[legs.indices(k)[legs.drifting]] for k in (j - 1, j))
        changes.append(ScaleStep(j, float(now - before), sigmas))
    return changes
