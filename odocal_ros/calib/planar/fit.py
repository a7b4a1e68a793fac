# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The planar estimate: poses, wheel constants and noise levels of a run, in one fit.

Gauss-Newton for poses and constants; levels by restricted likelihood, docs/decisions/0024.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from odocal_ros.calib.planar.chain import Equations, Rows, Solved
from odocal_ros.calib.planar.first_values import first_values
from odocal_ros.calib.planar.run import Fit, PriorKnowledge, Run
from odocal_ros.data.arrays import Floats

# first levels and medians of their hyperpriors, variances. Judgement: wheels slip by millimetres
# in a metre, robots by less to the side; positions: noise and drift of a SLAM
LEVELS = {'along': 2e-3**2, 'side': 1e-3**2, 'turn': 4e-3**2, 'spin': 4e-3**2, 'drift': 1e-2**2,
          'white': 1.0, 'gyro': 1.0}
ESTIMATED = tuple(LEVELS)[:-1]       # the level of the gyro is its specification
# judgement: sigmas of the hyperpriors of the logarithm of a variance
WIDE_HYPERPRIOR, HYPERPRIOR_SIGMAS = 3.0, dict.fromkeys(('along', 'turn', 'spin'), 1.0)
# degrees of freedom of Student's distribution of white errors and of steps of correlated ones,
# for outliers and loop closures. Judgement; 16 SLAM runs each: rms of error over sigma of the
# scale 0.79, 0.98 and 1.12 (wheels, skid, mecanum); with a normal distribution and a drift_length
# of 5 m 1.08, 1.39 and 1.63
STUDENT_FREEDOM = 4.0
# m/s, added to the speed of wheels, moving and at rest, for noise that grows with time. Judgement
SPEED_IN_MOTION, SPEED_AT_REST = 0.1, 1e-3
LEAST = 1e-4        # judgement: lowest level, over its median: no sensor is without noise
MOST_PASSES = 80
CONVERGED = 0.02    # largest last step: sigmas of a constant, logarithm of a level


def fit_run(run: Run, known: PriorKnowledge, after_pass: Callable[[int, float], None] = lambda
            *_: None) -> Fit:
    """
    Return the estimate of a run.

    after_pass : called after each pass with its number and the largest step of a constant, in
    sigmas.
    """
    initial = first_values(run, known.width)
    scale = (initial.left + initial.right) / 2
    c, prior = priors(run, known, initial.left, initial.right, initial.width)
    state = np.zeros((len(run.t), 5))
    state[:, 0], state[:, 1] = (np.interp(run.t, run.t[run.node], axis)
                                for axis in run.position.T)
    state[:, 2] = initial.heading
    mean, n = c.copy(), len(state)
    levels, passes, converged = dict(LEVELS), 0, False
    student_weights = {'white': np.ones(len(run.node)), 'drift': np.ones(n)}
    metres = noise_path(run, scale)
    first_gains = np.array([scale, scale, scale / initial.width])
    while passes < MOST_PASSES and not converged:
        passes += 1
        rows = _rows(run, known, state, c, metres, first_gains, student_weights)
        equations = {name: Equations(r, n) for name, r in rows.items()}
        pull = np.einsum('ij,j->i', prior, c - mean)
        solved = _solved(equations, levels, prior, pull)
        residuals = {name: replace(r, value=_residuals_after_step(r, solved)) for name,
                     r in rows.items()}
        step = _level_steps(equations, residuals, levels, prior, solved)
        state, c = state + solved.step, c + solved.constants
        for name, weight in student_weights.items():
            off = (residuals[name].value**2
                   * residuals[name].weight).sum(1) / weight / levels[name]
            student_weights[name] = (STUDENT_FREEDOM + 2) / (STUDENT_FREEDOM + off)
        for name, by in step.items():
            levels[name] *= float(np.exp(by))
        sigma = np.sqrt(np.diag(solved.covariance))
        change = float((np.abs(solved.constants) / sigma).max())
        converged = change < CONVERGED and max(map(abs, step.values())) < CONVERGED
        after_pass(passes, change)
    found = fit_at(run, known, state, c, levels, first_gains, prior, student_weights)
    return replace(found, passes=passes, converged=converged, swapped=initial.swapped)


def fit_at(run: Run, known: PriorKnowledge, state: Floats, c: Floats, levels: dict[str, float],
           first_gains: Floats, prior: Floats, student_weights: dict[str, Floats]
           | None = None) -> Fit:
    """
    Return the fit at given states (n + 1, 5) and constants (m,), with their covariance.

    levels : variance of each noise.   first_gains : (3,) gains of forward, left and turn to which
    residuals refer.   prior : (m, m) information.   student_weights : None: equal.
    """
    # the information of Student's distribution is 3/4 of that of a normal one
    even = {'white': np.ones(len(run.node)), 'drift': np.ones(len(state))}
    student_weights = {name: weight * (STUDENT_FREEDOM + 2) / (STUDENT_FREEDOM + 4) / weight.mean()
                       for name, weight in (student_weights or even).items()}
    rows = _rows(run, known, state, c, noise_path(run, first_gains[0]), first_gains,
                 student_weights)
    equations = {name: Equations(r, len(state)) for name, r in rows.items()}
    solved = _solved(equations, levels, prior, 0 * c)
    names = (*run.wheels.names, 'ahead', 'left_of', 'delay',
             *(('gyro_scale', 'gyro_bias') if len(run.gyro) else ()))
    return Fit(names, c, solved.covariance, state[:, :3],
               {name: float(np.sqrt(levels[name])) for name in ESTIMATED}, 0, True, False)


def priors(run: Run, known: PriorKnowledge, left: float, right: float, width: float,
           ) -> tuple[Floats, Floats]:
    """Return first values (m,) and prior information (m, m) of the constants."""
    value, covariance = run.wheels.prior(left, right, width)
    more = [(known.offset[0], known.offset_sigma), (known.offset[1], known.offset_sigma),
            (0.0, known.delay_sigma)]
    more += [(0.0, known.gyro_scale_sigma), (0.0, known.gyro_bias_sigma)] * bool(len(run.gyro))
    own = len(value)
    information = np.diag(np.append(np.ones(own), [s**-2.0 for _, s in more]))
    information[:own, :own] = np.linalg.inv(covariance)
    return np.append(value, [v for v, _ in more]), information


def noise_path(run: Run, scale: float) -> Floats:
    """Return the effective wheel path in each interval, by which its noise grows: (n,) m."""
    path: Floats = run.wheels.path * scale
    return path + np.diff(run.t) * np.where(path > 0, SPEED_IN_MOTION, SPEED_AT_REST)


def _solved(equations: dict[str, Equations], levels: dict[str, float], prior: Floats,
            slope: Floats) -> Solved:
    weight = np.array([1 / levels[name] for name in equations])
    return Solved(list(equations.values()), weight, prior, slope)


def _residuals_after_step(rows: Rows, solved: Solved) -> Floats:
    """Return the linearised residuals after a step."""
    step = np.append(solved.step, np.zeros((1, solved.step.shape[1])), axis=0)
    out: Floats = (rows.value + (rows.here @ step[rows.node][:, :, None])[:, :, 0]
                   + (rows.ahead @ step[rows.node + 1][:, :, None])[:, :, 0]
                   + np.einsum('kqm,m->kq', rows.constant, solved.constants))
    return out


def _level_steps(equations: dict[str, Equations], left: dict[str, Rows], levels: dict[str, float],
                 prior: Floats, solved: Solved) -> dict[str, float]:
    """Return the steps of the logarithms of the levels to the most likely values (restricted)."""
    # the degrees of freedom that the unknowns take from a level are the derivative of the log
    # determinant by the logarithm of its weight
    steps, h, whole = {}, 1e-3, solved.log_determinant()
    for name in ESTIMATED:
        other = _solved(equations, levels | {name: levels[name] * np.exp(-h)}, prior, 0 * prior[0])
        freedom = left[name].count - (other.log_determinant() - whole) / h
        chi2 = left[name].square() / levels[name]
        hyperprior_sigma = HYPERPRIOR_SIGMAS.get(name, WIDE_HYPERPRIOR)
        pull = np.log(LEVELS[name] / levels[name]) / hyperprior_sigma**2
        step = ((chi2 - freedom) / 2 + pull) / (max(chi2, freedom) / 2 + 1 / hyperprior_sigma**2)
        lowest = np.log(LEAST * LEVELS[name] / levels[name])
        steps[name] = float(max(np.clip(step, -1.5, 1.5), lowest))
    return steps


def _rows(run: Run, known: PriorKnowledge, state: Floats, c: Floats, metres: Floats,
          first_gains: Floats, student_weights: dict[str, Floats]) -> dict[str, Rows]:
    """Return the residual rows of each level at a linearisation point."""
    m, w = len(run.wheels.names), len(c)
    rows = _wheel_rows(run, state, c, metres, first_gains) | {
        'drift': _drift_rows(state, metres / known.drift_length, w, student_weights['drift']),
        'white': _position_rows(run, state, c, m, student_weights['white'])}
    if len(run.gyro):
        rows['gyro'] = _gyro_rows(run, known, state, c)
    return rows


def _wheel_rows(run: Run, state: Floats, c: Floats, metres: Floats, first_gains: Floats,
                ) -> dict[str, Rows]:
    """Return rows of the increments: body motion between the states minus that by the wheels."""
    n, m, w = len(run.t) - 1, len(run.wheels.names), len(c)
    k, here = np.arange(n), np.zeros((n, 3, 5))
    model, J = run.wheels.increments(c[:m])
    turn_per_metre = first_gains[2] / first_gains[0]
    turned = np.diff(state[:, 2])
    middle = state[:-1, 2] + turned / 2
    cos, sin = np.cos(middle), np.sin(middle)
    dx, dy = np.diff(state[:, :2], axis=0).T
    moved = np.stack([cos * dx + sin * dy, cos * dy - sin * dx], -1)
    chord = np.sinc(turned / (2 * np.pi))       # chord over arc
    here[:, 0, 0], here[:, 0, 1], here[:, 1, 0], here[:, 1, 1] = -cos, -sin, sin, -cos
    here[:, 2, 2] = -1.0
    ahead = -here
    for side in (here, ahead):
        side[:, 0, 2], side[:, 1, 2] = moved[:, 1] / 2, -moved[:, 0] / 2
    arc = np.stack([chord, chord, np.ones(n)], -1)
    # residuals are metres of the wheels: divided by their gains, times the first gains
    gain, by_gain = run.wheels.gains(c[:m])
    unit = first_gains / gain
    value = (np.column_stack([moved, turned]) - model * arc) * unit
    constant = np.zeros((n, 3, w))
    constant[:, :, :m] = -(J * arc[:, :, None] * unit[:, :, None]
                           + by_gain * (value / gain)[:, :, None])
    here, ahead = here * unit[:, :, None], ahead * unit[:, :, None]
    weight = np.stack([1 / metres, 1 / metres, 1 / (metres * turn_per_metre**2)], -1)
    # intervals with more turn than travel have a separate level of the turn
    turns_on_spot = run.wheels.turns_on_spot
    return {name: Rows(k[of], value[of, i:i + 1], here[of, i:i + 1], ahead[of, i:i + 1],
                       constant[of, i:i + 1], weight[of, i:i + 1])
            for name, i, of in (('along', 0, k), ('side', 1, k), ('turn', 2, k[~turns_on_spot]),
                                ('spin', 2, k[turns_on_spot]))}


def _gyro_rows(run: Run, known: PriorKnowledge, state: Floats, c: Floats) -> Rows:
    """Return rows of the gyro: turn between the states minus that by the gyro."""
    n, m = len(run.t) - 1, len(run.wheels.names)
    dt, by, here = np.diff(run.t), np.zeros((n, 1, len(c))), np.zeros((n, 1, 5))
    here[:, 0, 2] = -1.0
    by[:, 0, m + 3], by[:, 0, m + 4] = -run.gyro, dt
    off = np.diff(state[:, 2]) - run.gyro * (1 + c[m + 3]) + dt * c[m + 4]
    return Rows(np.arange(n), off[:, None], here, -here, by,
                1 / (known.gyro_noise**2 * dt[:, None]))


def _drift_rows(state: Floats, decay_exponent: Floats, w: int, student_weights: Floats) -> Rows:
    """Return rows of the time-correlated error of positions."""
    # backwards: e_k = kept e_(k+1) + step, and the last one is stationary
    n, correlation = len(state), np.append(np.exp(-decay_exponent), 0.0)
    here, ahead = np.zeros((n, 2, 5)), np.zeros((n, 2, 5))
    here[:, 0, 3] = here[:, 1, 4] = 1.0
    ahead[:, 0, 3] = ahead[:, 1, 4] = -correlation
    value = state[:, 3:] - correlation[:, None] * np.roll(state[:, 3:], -1, axis=0)
    weight = np.repeat((student_weights / (1 - correlation**2))[:, None], 2, axis=1)
    return Rows(np.arange(n), value, here, ahead, np.zeros((n, 2, w)), weight)


def _position_rows(run: Run, state: Floats, c: Floats, m: int, student_weights: Floats) -> Rows:
    """Return rows of the positions."""
    k, count = run.node, len(run.node)
    psi = state[k, 2]
    (a, b, delay), cos, sin = c[m:m + 3], np.cos(psi), np.sin(psi)
    speed = np.gradient(state[:, :2], run.t, axis=0)[k]
    arm = np.stack([cos * a - sin * b, sin * a + cos * b], -1)
    value = (state[k, :2] + arm + state[k, 3:] - delay * speed) - run.position
    here, constant = np.zeros((count, 2, 5)), np.zeros((count, 2, len(c)))
    here[:, 0, 0] = here[:, 1, 1] = here[:, 0, 3] = here[:, 1, 4] = 1.0
    here[:, 0, 2], here[:, 1, 2] = -arm[:, 1], arm[:, 0]
    constant[:, 0, m], constant[:, 1, m], constant[:, 0, m + 1], constant[:, 1, m + 1] = (
        cos, sin, -sin, cos)
    constant[:, :, m + 2] = -speed
    weight = np.repeat((student_weights / run.sigma**2)[:, None], 2, axis=1)
    return Rows(k, value, here, np.zeros_like(here), constant, weight)
