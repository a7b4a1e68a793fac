# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Combination of the results of one method on several legs of a vehicle, by a weighted mean.

Errors of single legs average down, errors shared by all legs do not: docs/method.md, (T15), (T16).
"""

from collections.abc import Mapping, Sequence

import numpy as np

from odocal_ros.calib.budget import known_budget
from odocal_ros.calib.joint import NORMAL_95, normal_deviate
from odocal_ros.calib.result import Estimate, MethodResult, Source
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.rotations import wrap
from odocal_ros.reasons import Code, Reason

# shared within a drive but not between power-ups, as an accelerometer bias: legs may differ by it
DIFFERING_SOURCES = {'initial_level'}


def combine_method(name: str, results: Sequence[MethodResult],
                   walked: Floats | None = None) -> MethodResult:
    """
    Return the minimum variance means of the values of one method on J legs.

    The scale is that of the last leg. The sigma includes shared errors once. Scatter beyond the
    sigmas widens them (LEGS_DISAGREE).

    name : the method.   results : one for each leg, at least one.   walked : (J,) variance of the
    random walk of ln K from each leg to the last; None: constant.
    """
    if len(results) == 1:
        return results[0]
    parameters = results[0].parameters
    walked = np.zeros(len(results)) if walked is None else walked
    reasons: tuple[Reason, ...] = ()
    estimates: dict[str, Estimate] = {}
    sources: dict[str, list[tuple[int, Floats]]] = {}
    for i, parameter in enumerate(parameters):
        determined = [k for k, r in enumerate(results) if r.estimates[parameter].value is not None]
        unit = results[0].estimates[parameter].unit
        if not determined:
            estimates[parameter] = Estimate(None, None, unit)
            continue
        value, variance, shared, scatter_reasons = _combine(
            parameter, i, [results[k] for k in determined], walked[determined])
        reasons += scatter_reasons
        scale = value if parameter.startswith('scale_factor') else 1.0     # of ln K to K
        sigma = abs(scale) * float(np.sqrt(variance + sum(v @ v for v in shared.values())))
        estimates[parameter] = Estimate(value, sigma, unit)
        unshared = np.sqrt(variance) * np.eye(len(parameters))[i]
        for source, effect in (shared | {'legs': unshared}).items():
            sources.setdefault(source, []).append((i, effect))
    estimates |= _scale_ratio(results, estimates) | newest_leg_values(results, estimates)
    stacked = _stacked(sources, len(parameters))
    details = known_budget(stacked, parameters, estimates) if sources else {}
    return MethodResult(name, reasons, estimates, parameters, stacked,
                        {'legs_used': len(results)} | details)


def newest_leg_values(results: Sequence[MethodResult],
                      estimates: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """
    Return values that apply to single legs, such as gyro biases, of the last leg that has them.

    estimates : combined values, which are left out. The heading error in older results applies to
    the start of a leg: a combination has none.
    """
    newest: dict[str, Estimate] = {}
    for name, e in (item for r in results for item in r.estimates.items()):
        if name == 'heading_error':
            e = Estimate(None, None, e.unit)
        if name not in estimates and name != 'scale_ratio' and (
                name not in newest or e.value is not None):
            newest[name] = e
    return newest


def _combine(parameter: str, i: int, results: Sequence[MethodResult], walked: Floats,
             ) -> tuple[float, float, dict[str, Floats], tuple[Reason, ...]]:
    """Return mean, unshared variance, shared effects, and reasons of parameter i: (T15), (T16)."""
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
        unshared += np.minimum.outer(walked, walked)
    by_leg = _shared_effects(i, results)
    weight = _weights(unshared + sum(g @ g.T for g in by_leg.values()))
    mean = weight @ y
    shared = {n: weight @ g for n, g in by_leg.items()}
    variance = weight @ unshared @ weight
    # allowed differences: errors of the legs, and shared errors with different effects
    allowed = unshared + np.diag(sum((
        ((g if n in DIFFERING_SOURCES else g - shared[n])**2).sum(axis=1)
        for n, g in by_leg.items()), np.zeros(len(y))))
    freedom = len(y) - 1
    chi2 = float((y - mean) @ np.linalg.solve(allowed, y - mean)) if freedom else 0.0
    reasons: tuple[Reason, ...] = ()
    if freedom and normal_deviate(chi2, freedom) > NORMAL_95:
        factor = np.sqrt(chi2 / freedom)
        variance *= factor**2
        reasons = (Reason(Code.LEGS_DISAGREE, f'{parameter}: the scatter of {len(y)} legs is '
                          f'{factor:.1f} times their uncertainties'),)
    mean = np.exp(mean) if is_scale else wrap(mean) if is_angle else mean
    return float(mean), float(variance), shared, reasons


def _shared_effects(i: int, results: Sequence[MethodResult]) -> dict[str, Floats]:
    """Return the effects of each shared source on parameter i in J legs, by name: (J, k)."""
    by_leg = {}
    for name in sorted({s.name for r in results for s in r.sources if s.shared}):
        effects = [next((s.effects[i] for s in r.sources if s.shared and s.name == name), None)
                   for r in results]
        width = max(len(e) for e in effects if e is not None)
        by_leg[name] = np.stack([np.zeros(width) if e is None else e for e in effects])
    return by_leg


def _weights(covariance: Floats) -> Floats:
    """Return the weights, none below zero, of the mean with the least variance: (T15)."""
    from scipy.optimize import nnls
    # by unshared errors alone, a leg that a shared error dominates would make the mean worse
    root = np.linalg.cholesky(covariance / np.trace(covariance))
    weight, _ = nnls(root.T, np.linalg.solve(root, np.ones(len(root))))
    out: Floats = weight / weight.sum()
    return out


def _scale_ratio(results: Sequence[MethodResult],
                 estimates: Mapping[str, Estimate]) -> dict[str, Estimate]:
    """Return the ratio of the combined scale to the nominal one of the first leg."""
    first, scale = results[0].estimates, estimates['scale_factor']
    ratio = first['scale_ratio'].value
    first_scale = first['scale_factor'].value
    if ratio is None or first_scale is None or scale.value is None or scale.sigma is None:
        return {'scale_ratio': Estimate(None, None, '1')}
    nominal = first_scale / ratio
    return {'scale_ratio': Estimate(scale.value / nominal, scale.sigma / nominal, '1')}


def _stacked(sources: Mapping[str, list[tuple[int, Floats]]], p: int) -> tuple[Source, ...]:
    """Return the sources from their effects by (row, effects) of each of p parameters."""
    out = []
    for name, rows in sources.items():
        effects = np.zeros((p, max(len(e) for _, e in rows)))
        for i, e in rows:
            effects[i, :len(e)] = e
        out.append(Source(name, effects, name != 'legs'))
    return tuple(out)
