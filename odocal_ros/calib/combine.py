# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Combination of the results of one method on several legs of a vehicle, by a weighted mean.

Errors of single legs average down, errors shared by all legs do not: docs/method.md (T14), (T15).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.budget import budget_details
from odocal_ros.calib.joint import NORMAL_95, normal_deviate
from odocal_ros.calib.result import Estimate, MethodResult, Source
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.rotations import wrap
from odocal_ros.reasons import Code, Reason

# shared within a drive but not between power-ups, as an accelerometer bias: legs may differ by it
DIFFERING_SOURCES = {'initial_level'}


def combine_method(name: str, results: Sequence[MethodResult],
                   walk_variance: Floats | None = None) -> MethodResult:
    """
    Return the minimum variance means of the values of one method on J legs.

    The scale is that of the last leg. The sigma includes shared errors once. Scatter beyond the
    sigmas widens them (LEGS_DISAGREE).

    name : the method.   results : one for each leg, at least one.   walk_variance : (J,) variance
    of the random walk of ln K from each leg to the last; None: constant.
    """
    if len(results) == 1:
        return results[0]
    parameters = results[0].parameters
    walk_variance = np.zeros(len(results)) if walk_variance is None else walk_variance
    reasons: tuple[Reason, ...] = ()
    estimates: dict[str, Estimate] = {}
    effects: dict[str, Floats] = {}      # (p, k) of each source
    for i, parameter in enumerate(parameters):
        determined = [k for k, r in enumerate(results) if r.estimates[parameter].value is not None]
        unit = results[0].estimates[parameter].unit
        if not determined:
            estimates[parameter] = Estimate(None, None, unit)
            continue
        mean = _combine(parameter, i, [results[k] for k in determined], walk_variance[determined])
        reasons += mean.reasons
        derivative = mean.value if parameter.startswith('scale_factor') else 1.0    # of K by ln K
        variance = mean.variance + sum(effect @ effect for effect in mean.shared.values())
        estimates[parameter] = Estimate(mean.value, abs(derivative) * float(np.sqrt(variance)),
                                        unit)
        unshared = np.sqrt(mean.variance) * np.eye(len(parameters))[i]
        for source, effect in (mean.shared | {'legs': unshared}).items():
            effects.setdefault(source, np.zeros((len(parameters), len(effect))))[i] = effect
    estimates |= _scale_ratio(results, estimates) | last_leg_values(results, estimates)
    sources = tuple(Source(source, effect, source != 'legs') for source, effect in effects.items())
    details = budget_details(sources, parameters, estimates) if sources else {}
    return MethodResult(name, reasons, estimates, parameters, sources,
                        {'legs_used': len(results)} | details)


def last_leg_values(results: Sequence[MethodResult],
                    combined: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Return values of single legs, such as gyro biases, from the last leg that has them."""
    # combined : values of all legs together, which are left out
    values: dict[str, Estimate] = {}
    for name, e in (item for r in results for item in r.estimates.items()):
        if name not in combined and name != 'scale_ratio' and (
                name not in values or e.value is not None):
            values[name] = e
    return values


class WeightedMean(NamedTuple):
    """The combined value of a parameter."""

    value: float
    variance: float              # of errors that legs do not share; relative for a scale factor
    shared: dict[str, Floats]    # (k,) effects of shared sources, by name
    reasons: tuple[Reason, ...]


def _combine(parameter: str, i: int, results: Sequence[MethodResult],
             walk_variance: Floats) -> WeightedMean:
    """Return the mean of parameter i, the i-th row of the sources: docs/method.md (T14), (T15)."""
    is_scale = parameter.startswith('scale_factor')
    x = np.array([r.estimates[parameter].value for r in results])
    y = np.log(x) if is_scale else x
    is_angle = results[0].estimates[parameter].unit == 'rad'
    if is_angle:       # within half a turn of the first: angles of a reversed IMU are near +-pi
        y = x - ((x - x[0]) - wrap(x - x[0]))
    variances = np.array([sum(s.effects[i] @ s.effects[i] for s in r.sources if not s.shared)
                          for r in results])
    unshared = np.diag(np.maximum(variances, 1e-18))
    if is_scale:    # from the last leg back, two legs share the random walk up to the nearer one
        unshared += np.minimum.outer(walk_variance, walk_variance)
    effects_by_leg = _shared_effects(i, results)
    weight = _weights(unshared + sum(e @ e.T for e in effects_by_leg.values()))
    mean = weight @ y
    shared = {name: weight @ e for name, e in effects_by_leg.items()}
    variance = weight @ unshared @ weight
    # allowed differences: errors of the legs, and shared errors with different effects
    allowed = unshared + np.diag(sum((
        ((e if name in DIFFERING_SOURCES else e - shared[name])**2).sum(axis=1)
        for name, e in effects_by_leg.items()), np.zeros(len(y))))
    freedom = len(y) - 1
    chi2 = float((y - mean) @ np.linalg.solve(allowed, y - mean)) if freedom else 0.0
    reasons: tuple[Reason, ...] = ()
    if freedom and normal_deviate(chi2, freedom) > NORMAL_95:
        factor = np.sqrt(chi2 / freedom)
        variance *= factor**2
        reasons = (Reason(Code.LEGS_DISAGREE, f'{parameter}: the scatter of {len(y)} legs is '
                          f'{factor:.1f} times their uncertainties'),)
    mean = np.exp(mean) if is_scale else wrap(mean) if is_angle else mean
    return WeightedMean(float(mean), float(variance), shared, reasons)


def _shared_effects(i: int, results: Sequence[MethodResult]) -> dict[str, Floats]:
    """Return the effects of each shared source on parameter i in J legs, by name: (J, k)."""
    effects_by_leg = {}
    for name in sorted({s.name for r in results for s in r.sources if s.shared}):
        effects = [next((s.effects[i] for s in r.sources if s.shared and s.name == name), None)
                   for r in results]
        width = max(len(e) for e in effects if e is not None)
        effects_by_leg[name] = np.stack([np.zeros(width) if e is None else e for e in effects])
    return effects_by_leg


def _weights(covariance: Floats) -> Floats:
    """Return the weights, none below zero, of the mean with the least variance: (T14)."""
    # weights by unshared errors alone are too large for a leg that a shared error dominates
    from scipy.optimize import nnls
    root = np.linalg.cholesky(covariance / np.trace(covariance))
    weight, _ = nnls(root.T, np.linalg.solve(root, np.ones(len(root))))
    return np.asarray(weight / weight.sum())


def _scale_ratio(results: Sequence[MethodResult],
                 estimates: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Return the ratio of the combined scale to the nominal one of the first leg."""
    scale = estimates['scale_factor']
    first_ratio, first_scale = (
        results[0].estimates[name].value for name in ('scale_ratio', 'scale_factor'))
    if first_ratio is None or first_scale is None or scale.value is None or scale.sigma is None:
        return {'scale_ratio': Estimate(None, None, '1')}
    nominal = first_scale / first_ratio
    return {'scale_ratio': Estimate(scale.value / nominal, scale.sigma / nominal, '1')}
