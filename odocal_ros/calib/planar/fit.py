# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The planar estimate of a run: poses, wheel constants and noise levels, in one fit.

Each node has five states: x, y, m, heading, rad, and the time-correlated error of the position in
x and y, m. The constants c, (m,), are those of ``Wheels.names``, then the position of the tracked
point ahead and left of the wheels, m, the delay of the positions, s, and, with a gyro, its
relative scale error and bias, rad/s. Gauss-Newton estimates states and constants, and in the same
passes restricted likelihood the levels, variances of the noises: docs/decisions/0024.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from odocal_ros.calib.planar.chain import Equations, normal_equations, Rows, Solution, weighted_sum
from odocal_ros.calib.planar.first_values import first_values
from odocal_ros.calib.planar.run import Fit, PriorKnowledge, Run
from odocal_ros.data.arrays import Floats

# first levels and medians of their hyperpriors, variances. Per metre of wheel path, in m^2: slip
# along it, to the side, in turns, and in turns on the spot. Correlated error of positions, m^2;
# factors on the stated variances of positions and gyro. Judgement: wheels slip by millimetres
# in a metre, robots by less to the side; positions: noise and drift of a SLAM
LEVELS = {'along': 2e-3**2, 'side': 1e-3**2, 'turn': 4e-3**2, 'spin': 4e-3**2, 'drift': 1e-2**2,
          'white': 1.0, 'gyro': 1.0}
ESTIMATED = tuple(LEVELS)[:-1]       # the level of the gyro is its specification
# judgement: sigmas of the hyperpriors of the logarithm of a variance
WIDE_HYPERPRIOR, HYPERPRIOR_SIGMAS = 3.0, dict.fromkeys(('along', 'turn', 'spin'), 1.0)
# degrees of freedom of Student's distribution of white errors and of steps of correlated ones,
# for outliers and loop closures. Judgement, measured: docs/decisions/0024
STUDENT_FREEDOM = 4.0
# m/s, added to the speed of wheels, moving and at rest, for noise that grows with time. Judgement
SPEED_IN_MOTION, SPEED_AT_REST = 0.1, 1e-3
MIN_LEVEL = 1e-4  # judgement: lowest level, over its median: no sensor is without noise
MAX_PASSES = 80
# judgement: for a converged fit; sigmas of a constant, or logarithm of a level
LARGEST_LAST_STEP = 0.02


def fit_run(run: Run, knowledge: PriorKnowledge,
            after_pass: Callable[[int, float], None] = lambda *_: None) -> Fit:
    """Return the estimate of a run; after_pass gets the pass and the largest step in sigmas."""
    initial = first_values(run, knowledge.width)
    scale = (initial.left + initial.right) / 2
    prior_mean, prior = priors(run, knowledge, initial.left, initial.right, initial.width)
    c, state = prior_mean.copy(), np.zeros((len(run.t), 5))
    state[:, 0], state[:, 1] = (np.interp(run.t, run.t[run.node], axis) for axis in run.position.T)
    state[:, 2] = initial.heading
    levels, passes, converged = dict(LEVELS), 0, False
    student_weights = {'white': np.ones(len(run.node)), 'drift': np.ones(len(state))}
    first_gains = np.array([scale, scale, scale / initial.width])
    while passes < MAX_PASSES and not converged:
        passes += 1
        rows = _rows(run, knowledge, state, c, first_gains, student_weights)
        equations = {name: normal_equations(r, len(state)) for name, r in rows.items()}
        solution = _solve(equations, levels, prior, np.einsum('ij,j->i', prior, c - prior_mean))
        residuals = {name: replace(r, value=_residuals_after_step(r, solution))
                     for name, r in rows.items()}
        level_steps = _level_steps(equations, residuals, levels, prior, solution)
        state, c = state + solution.states, c + solution.constants
        for name, weight in student_weights.items():
            chi2 = (residuals[name].value**2
                    * residuals[name].weight).sum(1) / weight / levels[name]
            student_weights[name] = (STUDENT_FREEDOM + 2) / (STUDENT_FREEDOM + chi2)
        for name, step in level_steps.items():
            levels[name] *= float(np.exp(step))
        sigma = np.sqrt(np.diag(solution.covariance))
        change = float((np.abs(solution.constants) / sigma).max())
        level_change = max(map(abs, level_steps.values()))
        converged = change < LARGEST_LAST_STEP and level_change < LARGEST_LAST_STEP
        after_pass(passes, change)
    result = fit_at(run, knowledge, state, c, levels, first_gains, prior, student_weights)
    return replace(result, passes=passes, converged=converged, swapped=initial.swapped)


def fit_at(run: Run, knowledge: PriorKnowledge, state: Floats, c: Floats, levels: dict[str, float],
           first_gains: Floats, prior: Floats, student_weights: dict[str, Floats]
           | None = None) -> Fit:
    """
    Return the fit at given states (n + 1, 5) and constants (m,), with their covariance.

    levels : variance of each noise.   first_gains : (3,) gains of forward, left and turn to which
    residuals refer.   prior : (m, m) information.   student_weights : None: equal.
    """
    # the information of Student's distribution is 3/4 of that of a normal one
    equal_weights = {'white': np.ones(len(run.node)), 'drift': np.ones(len(state))}
    student_weights = {name: weight * (STUDENT_FREEDOM + 2) / (STUDENT_FREEDOM + 4) / weight.mean()
                       for name, weight in (student_weights or equal_weights).items()}
    rows = _rows(run, knowledge, state, c, first_gains, student_weights)
    equations = {name: normal_equations(r, len(state)) for name, r in rows.items()}
    solution = _solve(equations, levels, prior, 0 * c)
    names = (*run.wheels.names, 'ahead', 'left_of', 'delay',
             *(('gyro_scale', 'gyro_bias') if len(run.gyro) else ()))
    return Fit(names, c, solution.covariance, state[:, :3],
               {name: float(np.sqrt(levels[name])) for name in ESTIMATED}, 0, True, False)


def priors(run: Run, knowledge: PriorKnowledge, left: float, right: float, width: float,
           ) -> tuple[Floats, Floats]:
    """Return prior values (m,) and prior information (m, m) of the constants."""
    wheel_values, covariance = run.wheels.prior(left, right, width)
    others = [*((value, knowledge.offset_sigma) for value in knowledge.offset),
              (0.0, knowledge.delay_sigma)]
    if len(run.gyro):
        others += [(0.0, knowledge.gyro_scale_sigma), (0.0, knowledge.gyro_bias_sigma)]
    m = len(wheel_values)
    information = np.diag(np.append(np.ones(m), [sigma**-2.0 for _, sigma in others]))
    information[:m, :m] = np.linalg.inv(covariance)
    return np.append(wheel_values, [value for value, _ in others]), information


def noise_path(run: Run, scale: float) -> Floats:
    """Return the effective wheel path in each interval, by which its noise grows: (n,) m."""
    path: Floats = run.wheels.path * scale
    return path + np.diff(run.t) * np.where(path > 0, SPEED_IN_MOTION, SPEED_AT_REST)


def _solve(equations: dict[str, Equations], levels: dict[str, float], prior: Floats,
           prior_gradient: Floats) -> Solution:
    weight = np.array([1 / levels[name] for name in equations])
    return Solution(weighted_sum(equations.values(), weight), prior, prior_gradient)


def _residuals_after_step(rows: Rows, solution: Solution) -> Floats:
    """Return the linearised residuals after a step: (n, q)."""
    step = np.append(solution.states, np.zeros((1, solution.states.shape[1])), axis=0)
    return np.asarray(rows.value + (rows.by_state @ step[rows.node][:, :, None])[:, :, 0]
                      + (rows.by_next @ step[rows.node + 1][:, :, None])[:, :, 0]
                      + np.einsum('kqm,m->kq', rows.by_constants, solution.constants))


def _level_steps(equations: dict[str, Equations], residuals: dict[str, Rows],
                 levels: dict[str, float], prior: Floats,
                 solution: Solution) -> dict[str, float]:
    """Return steps of the logarithms of the levels to their most likely values, by Newton."""
    # the degrees of freedom that the unknowns take from a level are the derivative of the log
    # determinant by the logarithm of its weight
    steps, h, log_determinant = {}, 1e-3, solution.log_determinant
    for name in ESTIMATED:
        other = _solve(equations, levels | {name: levels[name] * np.exp(-h)}, prior, 0 * prior[0])
        freedom = residuals[name].count - (other.log_determinant - log_determinant) / h
        chi2 = residuals[name].weighted_square_sum() / levels[name]
        hyperprior_sigma = HYPERPRIOR_SIGMAS.get(name, WIDE_HYPERPRIOR)
        prior_slope = np.log(LEVELS[name] / levels[name]) / hyperprior_sigma**2
        step = ((chi2 - freedom) / 2 + prior_slope) / (
            max(chi2, freedom) / 2 + 1 / hyperprior_sigma**2)
        lowest = np.log(MIN_LEVEL * LEVELS[name] / levels[name])
        steps[name] = float(max(np.clip(step, -1.5, 1.5), lowest))
    return steps


def _rows(run: Run, knowledge: PriorKnowledge, state: Floats, c: Floats, first_gains: Floats,
          student_weights: dict[str, Floats]) -> dict[str, Rows]:
    """Return the residual rows of each level at a linearisation point."""
    path = noise_path(run, first_gains[0])
    decay = path / knowledge.drift_length
    rows = _wheel_rows(run, state, c, path, first_gains) | {
        'drift': _drift_rows(state, decay, len(c), student_weights['drift']),
        'white': _position_rows(run, state, c, student_weights['white'])}
    if len(run.gyro):
        rows['gyro'] = _gyro_rows(run, knowledge, state, c)
    return rows


def _wheel_rows(run: Run, state: Floats, c: Floats, path: Floats, first_gains: Floats,
                ) -> dict[str, Rows]:
    """Return rows of the increments: body motion between the states minus that by the wheels."""
    n, m = len(run.t) - 1, len(run.wheels.names)
    k, by_state = np.arange(n), np.zeros((n, 3, 5))
    model, J = run.wheels.increments(c[:m])
    turn_per_metre = first_gains[2] / first_gains[0]
    turn = np.diff(state[:, 2])
    middle = state[:-1, 2] + turn / 2
    cos, sin = np.cos(middle), np.sin(middle)
    dx, dy = np.diff(state[:, :2], axis=0).T
    motion = np.stack([cos * dx + sin * dy, cos * dy - sin * dx], -1)
    chord = np.sinc(turn / (2 * np.pi))       # chord over arc
    by_state[:, 0, 0], by_state[:, 0, 1] = -cos, -sin
    by_state[:, 1, 0], by_state[:, 1, 1] = sin, -cos
    by_state[:, 2, 2] = -1.0
    by_next = -by_state
    for by_end in (by_state, by_next):
        by_end[:, 0, 2], by_end[:, 1, 2] = motion[:, 1] / 2, -motion[:, 0] / 2
    arc = np.stack([chord, chord, np.ones(n)], -1)
    # residuals are metres of the wheels: divided by their gains, times the first gains
    gain, gain_by_c = run.wheels.gains(c[:m])
    unit = first_gains / gain
    value = (np.column_stack([motion, turn]) - model * arc) * unit
    by_constants = np.zeros((n, 3, len(c)))
    by_constants[:, :, :m] = -(J * arc[:, :, None] * unit[:, :, None]
                               + gain_by_c * (value / gain)[:, :, None])
    by_state, by_next = by_state * unit[:, :, None], by_next * unit[:, :, None]
    weight = np.stack([1 / path, 1 / path, 1 / (path * turn_per_metre**2)], -1)
    # intervals with more turn than travel have a separate level of the turn
    turns_on_spot = run.wheels.turns_on_spot
    levels = (('along', 0, k), ('side', 1, k), ('turn', 2, k[~turns_on_spot]),
              ('spin', 2, k[turns_on_spot]))      # name, component, intervals
    return {name: Rows(nodes, *(x[nodes, i:i + 1] for x in (
        value, by_state, by_next, by_constants, weight))) for name, i, nodes in levels}


def _gyro_rows(run: Run, knowledge: PriorKnowledge, state: Floats, c: Floats) -> Rows:
    """Return rows of the gyro: turn between the states minus that by the gyro."""
    n, m = len(run.t) - 1, len(run.wheels.names)
    dt, by_constants, by_state = np.diff(run.t), np.zeros((n, 1, len(c))), np.zeros((n, 1, 5))
    by_state[:, 0, 2] = -1.0
    by_constants[:, 0, m + 3], by_constants[:, 0, m + 4] = -run.gyro, dt
    value = np.diff(state[:, 2]) - run.gyro * (1 + c[m + 3]) + dt * c[m + 4]
    return Rows(np.arange(n), value[:, None], by_state, -by_state, by_constants,
                1 / (knowledge.gyro_noise**2 * dt[:, None]))


def _drift_rows(state: Floats, decay_exponent: Floats, m: int, student_weights: Floats) -> Rows:
    """Return rows of the time-correlated error of positions, a Gauss-Markov process over path."""
    # backwards: e_k = correlation e_(k+1) + step, and the last one is stationary
    n, correlation = len(state), np.append(np.exp(-decay_exponent), 0.0)
    by_state, by_next = np.zeros((n, 2, 5)), np.zeros((n, 2, 5))
    by_state[:, 0, 3] = by_state[:, 1, 4] = 1.0
    by_next[:, 0, 3] = by_next[:, 1, 4] = -correlation
    value = state[:, 3:] - correlation[:, None] * np.roll(state[:, 3:], -1, axis=0)
    weight = np.repeat((student_weights / (1 - correlation**2))[:, None], 2, axis=1)
    return Rows(np.arange(n), value, by_state, by_next, np.zeros((n, 2, m)), weight)


def _position_rows(run: Run, state: Floats, c: Floats, student_weights: Floats) -> Rows:
    """Return rows of the positions: tracked point, with its errors, minus measured position."""
    k, count, m = run.node, len(run.node), len(run.wheels.names)
    psi = state[k, 2]
    (ahead, left, delay), cos, sin = c[m:m + 3], np.cos(psi), np.sin(psi)
    speed = np.gradient(state[:, :2], run.t, axis=0)[k]
    arm = np.stack([cos * ahead - sin * left, sin * ahead + cos * left], -1)
    value = (state[k, :2] + arm + state[k, 3:] - delay * speed) - run.position
    by_state, by_constants = np.zeros((count, 2, 5)), np.zeros((count, 2, len(c)))
    by_state[:, 0, 0] = by_state[:, 1, 1] = by_state[:, 0, 3] = by_state[:, 1, 4] = 1.0
    by_state[:, 0, 2], by_state[:, 1, 2] = -arm[:, 1], arm[:, 0]
    by_constants[:, :, m] = np.stack([cos, sin], -1)
    by_constants[:, :, m + 1] = np.stack([-sin, cos], -1)
    by_constants[:, :, m + 2] = -speed
    weight = np.repeat((student_weights / run.sigma**2)[:, None], 2, axis=1)
    return Rows(k, value, by_state, np.zeros_like(by_state), by_constants, weight)
