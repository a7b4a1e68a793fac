# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The method ``wheels``: from the solution of a leg to estimates, sources and reasons."""

from typing import Any

import numpy as np

from odocal_ros.calib.budget import budget_table, HEIGHT_UNKNOWN, total_covariance
from odocal_ros.calib.receiver_lag import lag_reasons
from odocal_ros.calib.result import Estimate, MethodResult, Source
from odocal_ros.calib.wheels.leg import wheel_factors, WheelLeg
from odocal_ros.calib.wheels.model import FIX_LAG2, GYRO, HEADING, LATENCY, RATIO, SCALE, WIDTH
from odocal_ros.calib.wheels.observable import (
    correlation,
    judge_fit,
    judge_heading,
    judge_width,
    separable,
    width_observable,
    without_turns,
)
from odocal_ros.calib.wheels.solution import Solution
from odocal_ros.calib.wheels.unseen import solve_with_slips
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.alignment import HEADING_LIMIT
from odocal_ros.nav.angles import wrap
from odocal_ros.nav.dead_reckoning import forward_b
from odocal_ros.nav.earth import A
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.screen import Inputs
from odocal_ros.settings.config import Config

PARAMETERS = ('scale_factor', 'scale_factor_left', 'scale_factor_right', 'yaw_mounting_angle',
              'track_width')       # rows of the sources: relative for scales, rad, m
NOTE = ('heading_error is how far the heading at the start must be turned, counter-clockwise: its '
        'error less the yaw mounting angle, which a drive cannot tell apart')


def fit_wheels(leg: WheelLeg, config: Config, turn_rate: bool = True) -> MethodResult:
    """
    Return left and right scale, heading error and track width of a leg with their sigmas.

    Parameters
    ----------
    leg : WheelLeg
        Tracks of both wheels, fixes, alignment.
    config : Config
        gnss, odometer (time_sigma, track_width), wheels and verdict are used.
    turn_rate : bool
        False leaves the wheels' turn against the gyro's out, as the patent does.

    """
    dead = [side for side, track in (('left', leg.left), ('right', leg.right))
            if not np.diff(track.at(np.array([leg.t_start, leg.t_stop])), axis=0).any()]
    if dead:
        return refused(leg, Reason(Code.WHEEL_DEAD, f'the {" and the ".join(dead)} wheel does not '
                                   'count between the marks'))
    try:
        solution, slipped, slips = solve_with_slips(leg, config, turn_rate)
    except np.linalg.LinAlgError:
        return refused(leg, Reason(Code.NOT_CONVERGED, 'the equations of both wheels have no '
                                   'solution'))
    if solution is None:
        return refused(leg, Reason(Code.NO_FIX, 'fewer than five fixes between the marks, or less '
                                   'than five seconds of them'))
    covariance = np.linalg.inv(solution.fit.normal).astype(np.float64, copy=False)
    sigma = np.sqrt(np.diag(covariance))
    # relative: a scale no better than 10 % is none
    if not (np.isfinite(sigma).all() and sigma[SCALE] < 0.1 and sigma[HEADING] < HEADING_LIMIT):
        return refused(leg, Reason(Code.LEG_TOO_SHORT, 'the fixes tell the scale only to '
                                   f'{100 * sigma[SCALE]:.2g} %'))
    reasons = separable(solution, sigma[RATIO], config, turn_rate)
    apart = not reasons
    reasons = slipped + reasons
    width_known, why = width_observable(solution, sigma[WIDTH], config.odometer.track_width)
    heading = float(wrap(solution.state.heading))
    about_heading = judge_heading(leg, heading, config)
    yaw_known = Code.YAW_NOT_SEPARABLE not in {r.code for r in about_heading}
    sources = _sources(leg, solution)
    reasons += why + about_heading + judge_fit(solution) + lag_reasons(
        solution.state.fix_lag_square, sigma[FIX_LAG2])
    if width_known:
        reasons += judge_width(solution.state.width, sigma[WIDTH], config.odometer.track_width)
    total = np.sqrt(np.diag(total_covariance(sources)))
    K = solution.state.scale
    left, right = wheel_factors(K, solution.state.log_ratio)
    values = {'scale_factor': K, 'scale_factor_left': left, 'scale_factor_right': right}
    estimates = {name: Estimate(value, value * float(s), leg.scale_unit)
                 if apart or name == 'scale_factor' else Estimate(None, None, leg.scale_unit)
                 for (name, value), s in zip(values.items(), total, strict=False)}
    estimates |= {
        'scale_ratio': Estimate(K / leg.nominal, K / leg.nominal * float(total[0]), '1')
        if leg.nominal else Estimate(None, None, '1'),
        'heading_error': Estimate(heading, float(sigma[HEADING]), 'rad'),
        'yaw_mounting_angle': Estimate(-heading, float(total[3]), 'rad') if yaw_known
        else Estimate(None, None, 'rad'),
        'track_width': Estimate(solution.state.width, float(sigma[WIDTH]), 'm') if width_known
        else Estimate(None, None, 'm'),
        'gyro_bias_z': _gyro_bias(leg, solution)}
    return MethodResult('wheels', tuple(reasons), estimates, PARAMETERS, sources,
                        _details(leg, solution, covariance, sources, (K, left, right, 1.0, 1.0),
                                 slips))


def refused(leg: WheelLeg | Inputs, reason: Reason) -> MethodResult:
    """Return the result of a leg that the method refuses: every value unknown."""
    unit = {'yaw_mounting_angle': 'rad', 'heading_error': 'rad', 'track_width': 'm',
            'scale_ratio': '1', 'gyro_bias_z': 'rad/s'}
    names = (*PARAMETERS, 'scale_ratio', 'heading_error', 'gyro_bias_z')
    return MethodResult('wheels', (reason,), {
        n: Estimate(None, None, unit.get(n, leg.scale_unit)) for n in names}, PARAMETERS)


def _rows(solution: Solution) -> Floats:
    """Return the derivatives of PARAMETERS by the solution's own, docs/method.md (W2): (5, p)."""
    ratio = np.exp(solution.state.log_ratio)
    rows = np.zeros((5, len(solution.priors)))
    rows[:3, SCALE] = 1.0
    rows[1, RATIO], rows[2, RATIO] = -1 / (1 + ratio), ratio / (1 + ratio)
    rows[3, HEADING] = -1.0
    rows[4, WIDTH] = 1.0
    return rows


def _root(covariance: Floats) -> Floats:
    value, vector = np.linalg.eigh((covariance + covariance.T) / 2)
    out: Floats = vector * np.sqrt(np.maximum(value, 0.0))
    return out


def _sources(leg: WheelLeg, solution: Solution) -> tuple[Source, ...]:
    """Return the parts of the covariance as effects on PARAMETERS: docs/method.md (W15)."""
    rows = _rows(solution)
    BX = rows @ solution.fit.B
    sources = []
    for part in solution.parts:
        effects = BX @ part.root if part.root is not None else _root(BX @ part.whole() @ BX.T)
        if effects.shape[1] > len(rows):
            effects = _root(effects @ effects.T)
        sources.append(Source(part.name, effects, part.shared))
    # a prior is a source too: of the width given, of a surveyed start
    priors = np.linalg.inv(solution.fit.normal) * np.sqrt(solution.priors)
    keep = solution.priors > 0
    for name, column in (('fix_latency', LATENCY), ('gyro_scale', GYRO),
                         ('receiver_smoothing', FIX_LAG2)):
        sources.append(Source(name, rows @ priors[:, [column]], True))
        keep[column] = False
    sources.append(Source('priors', rows @ priors[:, keep]))
    heading = np.zeros((5, 1))
    heading[3] = leg.alignment.heading_sigma
    sources.append(Source('initial_heading', heading, leg.alignment.heading_shared))
    for name, size, shared in (('height', _height_sigma(leg) / A, True),
                               ('second_order', _second_order(solution), False)):
        sources.append(Source(name, np.array([[size]] * 3 + [[0.0]] * 2), shared))
    return tuple(sources)


def _height_sigma(leg: WheelLeg) -> float:
    if not np.isfinite(leg.fixes_n[:, 2]).any():
        return HEIGHT_UNKNOWN
    return float(np.sqrt(np.median(leg.covariance_n[:, 2, 2])))


def _second_order(solution: Solution) -> float:
    """
    Return what climb and heading not known make of the scale, relative: docs/method.md (W16).

    Half their mean square over the way shortens the level track; of a normal error its rms is
    sqrt(3) / 2 of the variance. In it too is what epochs of 40 ms cut off bends, with counts and
    bins: 1.5 ppm in a town, by simulated fixes of 2 cm and better.
    """
    share = solution.eq.length / max(solution.eq.length.sum(), 1e-9)
    phi = (solution.fit.phi_sigma[:-1]**2 + solution.fit.phi_sigma[1:]**2) / 2
    unknown = np.sqrt(3) / 2 * np.hypot(solution.height.climb_variance, share @ phi)
    return float(np.hypot(unknown, 1.5e-6))


def _gyro_bias(leg: WheelLeg, solution: Solution) -> Estimate:
    a = leg.alignment
    value, sigma = solution.bias_z
    up = solution.eq.phi_axes[-1, 2]
    up = up / max(np.linalg.norm(up), 1e-9)
    before = float(np.sqrt(up**2 @ a.gyro_bias_sigma**2))
    if sigma > 0.7 * before:        # the leg tells hardly more than the alignment did
        return Estimate(None, None, 'rad/s')
    return Estimate(float(up @ a.gyro_bias) + value, sigma, 'rad/s')


def _details(leg: WheelLeg, solution: Solution, covariance: Floats, sources: tuple[Source, ...],
             scale: tuple[float, ...], slips: tuple[dict[str, Any], ...]) -> dict[str, Any]:
    state, noise = solution.state, solution.noise
    condition, ratio_sigma = without_turns(solution)
    used = solution.fit.use[:2 * len(solution.eq.turn)]
    residual = solution.residual[:2 * len(solution.eq.turn)][used]
    return {
        'budget': budget_table(sources, PARAMETERS, scale),
        'correlation': correlation(covariance),
        'condition_number': condition,       # of left, right and heading by the fixes alone
        'f': state.scale * forward_b(-state.heading, state.pitch),
        'wheel_ratio': {'value': float(np.exp(state.log_ratio)),
                        'sigma': float(np.exp(state.log_ratio) * np.sqrt(covariance[1, 1])),
                        'sigma_by_fixes_alone': ratio_sigma},
        'pitch': {'value': state.pitch, 'sigma': solution.height.pitch_sigma,
                  'known': solution.height.known},
        'track_width_used': state.width,
        'start_n': state.start_n,
        'residual_rms': float(np.sqrt((residual**2).mean() * 2)),
        'fixes': {'used': solution.kept, 'dropped': solution.dropped,
                  'white_share': noise.white, 'slow_share': noise.slow,
                  'correlation_time': noise.time},
        'fix_latency_seen': state.latency,      # s by which stamps are late
        'fix_latency_sigma': float(np.sqrt(covariance[LATENCY, LATENCY])),
        'gyro_scale_seen': {'value': state.gyro_scale, 'sigma': float(np.sqrt(
            covariance[GYRO, GYRO]))},
        'slips': slips,        # those that only this fit sees
        'slip_walk': float(np.sqrt(solution.turns.slip)),
        'count_noise': float(np.sqrt(solution.turns.counts)),   # 1: each row rounds anew
        'heading_source': leg.alignment.heading_source,
        'heading_drift': {'t': solution.bins.edges, 'rad': state.phi[:, 2]},
        'note': NOTE}
