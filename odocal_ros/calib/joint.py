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
NORMAL_95, DIFFERENCE_DEVIATE = 1.6449, 2.7
# judgement: grid of ln (scatter / usual scatter), the sigmas of a constant between legs
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
    differing: tuple[str, ...] = ()   # constants in which legs differ significantly
    factor: float = 1.0               # of all sigmas, included in ``covariance``
    # (J,) rad or relative, additional error of each leg by its linearisation
    linearisation_error: Floats = field(default_factory=lambda: np.zeros(0))


def fit_jointly(marginals: Sequence[MarginalInformation], steps: Sequence[float] | Floats,
                drifting: str = 'scale_factor', angles: Sequence[str] = (),
                nonlinear: Sequence[str] = (), usual_scatter: Mapping[str, float] | None = None,
                same_drive: Sequence[bool] = ()) -> JointEstimate:
    """
    Return the joint estimate of legs of one vehicle.

    All sigmas are widened if legs differ by more than the sigmas and the scatter.

    marginals : by time, at least one.   steps : (J - 1,) sigma of the change of ``drifting`` from
    leg to leg.   drifting : the constant with a random walk.   angles : constants with a period
    of one turn.   nonlinear : constants in which a leg's equations are not linear: 1 - cos of
    their change becomes an error of that leg alone.   usual_scatter : usual sigma of constants
    between legs, by name; the scatter is estimated, (S38).   same_drive : (J - 1,) True: the next
    leg is a section of the same drive, without scatter.
    """
    usual_scatter = usual_scatter or {}
    legs = LinkedLegs(list(marginals), drifting, np.asarray(steps, float), angles)
    linearisation_error = _add_linearisation_errors(
        legs, [name for name in nonlinear if name in legs.names])
    chi2, freedom = legs.disagreement()
    drives = legs.combine_sections(same_drive)
    estimated_scatter = _estimate_scatter(drives, usual_scatter)
    # a single leg has no scatter
    is_single = len(drives.marginals) == 1 and not marginals[0].scatter_likelihood
    scatter = {} if is_single else estimated_scatter.sigmas
    # chi-square of the drives with scatter, plus that of their sections about each drive
    residual_chi2, residual_freedom = (
        with_scatter + all_legs - all_drives for with_scatter, all_legs, all_drives in zip(
            drives.disagreement(scatter), (chi2, freedom), drives.disagreement(), strict=True))
    disagree = residual_freedom and normal_deviate(residual_chi2, residual_freedom) > NORMAL_95
    factor = float(np.sqrt(residual_chi2 / residual_freedom)) if disagree else 1.0
    last = drives.indices(len(drives.marginals) - 1)
    x, C = drives.solve() if is_single else _average_over_scatter(
        drives, estimated_scatter, usual_scatter)
    information = drives.combined_information(x[last], estimated_scatter.sigmas,
                                              estimated_scatter.likelihood)
    return JointEstimate(
        legs.names, x[last], C[np.ix_(last, last)] * factor**2, legs.prior_sigma,
        legs.relaxed_sigma, chi2, freedom, legs.deviations(), information.widened(factor),
        scatter, _find_differing(legs, scatter, usual_scatter), factor, linearisation_error)


def normal_deviate(chi2: float, freedom: float) -> float:
    """Return the normal deviate of a chi-square (Wilson and Hilferty 1931)."""
    variance = 2 / (9 * freedom)
    return float(((max(chi2, 0.0) / freedom)**(1 / 3) - (1 - variance)) / np.sqrt(variance))


@dataclass(frozen=True, eq=False)
class Scatter:
    """Estimated scatter of constants between legs, by name; arrays are at SCATTER_GRID."""

    sigmas: dict[str, float]        # geometric means
    likelihood: dict[str, Floats]   # (SCATTER_POINTS,) log likelihood
    weights: dict[str, Floats]      # (SCATTER_POINTS,) of a mean over the scatter, (S39)


def _estimate_scatter(legs: LinkedLegs, usual_scatter: Mapping[str, float]) -> Scatter:
    """Return the scatter between the legs of the constants in ``usual_scatter``, (S38)."""
    # posterior mean by restricted likelihood and a half-Cauchy prior of the usual scatter (Gelman
    # 2006)
    from scipy.interpolate import CubicSpline
    sigmas, likelihood, weights = dict(usual_scatter), dict[str, Floats](), dict[str, Floats]()
    fine_grid = np.linspace(SCATTER_GRID[0], SCATTER_GRID[-1], 301)
    for _ in range(2):      # sweeps: the scatter of one hardly depends on that of another
        for name, usual in usual_scatter.items():
            log_likelihood = np.array([
                legs.log_likelihood({**sigmas, name: usual * float(np.exp(x))})
                for x in SCATTER_GRID])
            # legs combined earlier have the likelihood of their scatter
            likelihood[name] = log_likelihood - log_likelihood.max() + sum(
                (leg.scatter_likelihood[name] for leg in legs.marginals
                 if name in leg.scatter_likelihood), np.zeros(SCATTER_POINTS))
            posterior = CubicSpline(SCATTER_GRID, likelihood[name])(fine_grid)
            posterior = posterior + fine_grid - np.log1p(np.exp(2 * fine_grid))
            weight = np.exp(posterior - posterior.max())
            weight /= weight.sum()
            sigmas[name] = usual * float(np.exp(weight @ fine_grid))
            # of the nodes of SCATTER_GRID, for functions linear between them
            weights[name] = np.array([weight @ np.interp(fine_grid, SCATTER_GRID, node)
                                      for node in np.eye(SCATTER_POINTS)])
    return Scatter(sigmas, likelihood, weights)


def _average_over_scatter(legs: LinkedLegs, scatter: Scatter,
                          usual_scatter: Mapping[str, float]) -> tuple[Floats, Floats]:
    """Return the unknowns at this scatter, and their covariance averaged over all of it, (S39)."""
    x, C = legs.solve(scatter.sigmas)
    averaged = C.copy()
    for name, weight in scatter.weights.items():
        for w, log_ratio in zip(weight, SCATTER_GRID, strict=True):
            value, covariance = legs.solve(
                scatter.sigmas | {name: usual_scatter[name] * np.exp(log_ratio)})
            averaged += w * (covariance - C + np.multiply.outer(value - x, value - x))
    return x, averaged


def _find_differing(legs: LinkedLegs, scatter: dict[str, float],
                    usual_scatter: Mapping[str, float]) -> tuple[str, ...]:
    """Return the constants in which legs differ by more than the usual scatter."""
    def deviate(name: str) -> float:
        """Return the normal deviate of the chi-square decrease by one value of it in each leg."""
        chi2, freedom = (legs.disagreement({**scatter, name: usual_scatter[name]})
                         if name in usual_scatter else with_scatter)
        free_chi2, free_freedom = legs.disagreement({**scatter, name: np.inf})
        # below 0.5, the legs do not determine the constant
        return normal_deviate(chi2 - free_chi2, freedom - free_freedom) \
            if freedom - free_freedom > 0.5 else -np.inf
    if len(legs.marginals) < 2:
        return ()
    with_scatter = legs.disagreement(scatter)
    deviates = {name: deviate(name) for name in legs.names}
    # without scatter, only the constant that explains most of the remaining chi-square
    others = [name for name in legs.names if name not in scatter]
    tested = [*scatter, *([max(others, key=deviates.__getitem__)] if others else [])]
    return tuple(name for name in tested if deviates[name] > DIFFERENCE_DEVIATE)


def _add_linearisation_errors(legs: LinkedLegs, nonlinear: Sequence[str]) -> Floats:
    """Add an error to each leg by its distance from the linearisation point; return it: (J,)."""
    linearised, indices = legs.marginals, [legs.names.index(name) for name in nonlinear]
    error = np.zeros(len(linearised))
    for _ in range(3 if nonlinear else 0):     # with reduced weights the estimate changes
        x, _ = legs.solve()
        distance = np.array([x[legs.indices(j)][indices] - marginal.point[indices]
                             for j, marginal in enumerate(linearised)])
        error = (distance**2).sum(axis=1) / 2
        legs.replace_marginals([marginal.with_leg_errors(dict.fromkeys(nonlinear, size))
                                for marginal, size in zip(linearised, error, strict=True)])
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
