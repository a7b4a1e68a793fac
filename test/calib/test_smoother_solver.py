# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Block solver against dense algebra, the bound against all stacked rows, memory use."""

from dataclasses import replace
from pathlib import Path
import tracemalloc

import numpy as np
import pytest
from smoother_legs import made, truth

from odocal_ros.data.arrays import MAX_RESIDENT_BYTES, release_mapped_memory, work_array
from odocal_ros.estimator import cramer_rao_bound
from odocal_ros.estimator.chain import NormalEquations, NotPositive, solve
from odocal_ros.estimator.cold_start import cold_starts
from odocal_ros.estimator.equations import Equations, WeightedEquations
from odocal_ros.estimator.factors.axle import mean_rates_at
from odocal_ros.estimator.factors.motion_rows import MotionRows
from odocal_ros.estimator.factors.pseudo_observations import (
    SIZE,
    START_SIGMAS,
    STILL_SPEED,
    STILL_TURN,
)
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.state import E, IMPERFECTIONS, M, SIZE_WITH_SLOW, SIZE_WITHOUT_SLOW, SLOW

pytestmark = pytest.mark.core
N, STATES, BORDER = 6, 4, 3
TOTAL = N * STATES + BORDER


@pytest.mark.parametrize('correlation_time', [0.0, 40.0])
def test_bound_is_the_inverse_of_all_stacked_rows(correlation_time):
    drive, config, leg = made(duration=140.0, fix_rate=1.0)
    leg = replace(leg, t_stop=50.0)
    problem = make_problem(leg, config)
    levels = problem.initial_levels.replaced(correlation_time=correlation_time, fix=0.5)
    state = truth(drive, config, leg)
    parts = Equations(problem, state, fitted=True).factors
    motion, fixes = parts['motion'], parts['fixes']
    n, N = (SIZE_WITH_SLOW if correlation_time else SIZE_WITHOUT_SLOW), len(state.t)
    size = N * n + M
    rows = []

    def add(block, at, sigma_root):
        row = np.zeros((len(block), size))
        for columns, value in zip(at, np.split(block, np.cumsum([len(c) for c in at])[:-1],
                                               axis=1), strict=True):
            row[:, columns] += value
        rows.append(sigma_root @ row)

    def block(k):
        return np.arange(k * n, (k + 1) * n)

    border = np.arange(N * n, size)
    every, weighted_copy = slice(None), motion.weighted_copy(levels, M)
    units = motion.noise.columns(every) * weighted_copy.level_sigmas()
    a, b, c = weighted_copy.derivatives(every, units)
    Q = motion.noise.covariance(units, every)
    for k in range(N - 1):
        s = 1 / np.sqrt(np.diag(Q[k]))
        root = np.linalg.inv(np.linalg.cholesky(Q[k] * np.outer(s, s))) * s
        add(np.concatenate([a[k], b[k], c[k]], axis=1), (block(k), block(k + 1), border), root)
    J, Jc = fixes.jacobians(n)
    covariance = leg.covariance_n[problem.used_fixes]
    white = np.hypot(*np.einsum('kij,kj->ki', problem.fix_whitening, fixes.raw)[:, :2].T)
    factor = np.array([np.sqrt(0.5), np.sqrt(0.5), 1.0])
    for i, k in enumerate(fixes.k):
        C = covariance[i] * np.outer(factor, factor)
        root = np.linalg.inv(np.linalg.cholesky(C))
        u = root @ fixes.raw[i]
        weight = np.array([min(1.0, 3 / np.hypot(u[0], u[1]))] * 2 + [min(1.0, 3 / abs(u[2]))])
        end = np.zeros((3, n))
        if n == SIZE_WITH_SLOW:
            end[:, SLOW] = -np.eye(3) * fixes.share[i]
        add(np.concatenate([J[i], end, Jc[i]], axis=1), (block(k), block(k + 1), border),
            np.diag(weight) @ root)
    assert white.max() > 0.0
    single = np.eye(n)
    for k in range(N):
        add(single[[E]], (block(k),),
            np.eye(1) * np.sqrt(parts['travel'].weight[k] / problem.min_levels['travel']))
        if problem.at_rest[k]:
            add(single[3:6], (block(k),), np.eye(3) / STILL_SPEED)
    for k in range(N - 1):
        T = state.t[k + 1] - state.t[k]
        if problem.at_rest[k] and problem.at_rest[k + 1]:
            add(np.concatenate([-single[6:9], single[6:9]], axis=1), (block(k), block(k + 1)),
                np.diag(1 / (STILL_TURN * np.sqrt(T))))
        if n == SIZE_WITH_SLOW:
            decay = np.exp(-T / correlation_time)
            power = correlation_time / 2 * np.array([levels['slow']] * 2 + [levels['slow_up']])
            add(np.concatenate([-decay * single[SLOW], single[SLOW]], axis=1),
                (block(k), block(k + 1)), np.diag(1 / np.sqrt(power * (1 - decay**2))))
    first = np.concatenate([*(np.broadcast_to(sigma, 3) for _, sigma in START_SIGMAS),
                            problem.priors.gyro_bias_sigma, problem.priors.accel_bias_sigma])
    add(single[:15], (block(0),), np.diag(1 / first))
    if n == SIZE_WITH_SLOW:
        add(single[SLOW], (block(0),), np.diag(1 / np.sqrt(power)))
    prior = problem.priors.sigma.copy()
    prior[IMPERFECTIONS] *= np.sqrt(SIZE)         # the first sizes
    add(np.eye(M), (border,), np.diag(1 / prior))
    A = np.concatenate(rows)
    # by QR of the rows, which does not square the condition number: scaled columns
    scale = np.linalg.norm(A, axis=0)
    R = np.linalg.qr(A / scale, mode='r')
    last = np.linalg.inv(R[-M:, -M:])
    dense = last @ last.T / np.outer(scale[-M:], scale[-M:])
    got = cramer_rao_bound(leg, config, state, levels)
    sigma = np.sqrt(np.diag(dense))
    # the normal equations of the chain lose accuracy by their condition: 1e-6 of a sigma
    np.testing.assert_allclose(got / np.outer(sigma, sigma), dense / np.outer(sigma, sigma),
                               atol=1e-5)


def _dense(seed=0, rows=8):
    """Return a dense normal matrix and right side with the pattern of the chain, badly scaled."""
    rng = np.random.default_rng(seed)
    A = np.zeros((0, TOTAL))
    for k in range(N - 1):
        block = np.zeros((rows, TOTAL))
        block[:, k * STATES:(k + 2) * STATES] = rng.standard_normal((rows, 2 * STATES))
        block[:, N * STATES:] = rng.standard_normal((rows, BORDER))
        A = np.concatenate([A, block])
    A = A * np.exp(5 * rng.standard_normal(TOTAL))
    return A.T @ A, A.T @ rng.standard_normal(len(A))


def _as_chain(H, g):
    b = [slice(k * STATES, (k + 1) * STATES) for k in range(N)]
    c = slice(N * STATES, TOTAL)
    out = NormalEquations(N, STATES, BORDER)
    out.diagonal[:] = [H[s, s] for s in b]
    out.upper[:] = [H[b[k], b[k + 1]] for k in range(N - 1)]
    out.coupling[:] = [H[s, c] for s in b]
    out.g[:] = g[:N * STATES].reshape(N, STATES)
    out.corner[:], out.g_constants[:] = H[c, c], g[c]
    return out


def test_step_and_covariances_equal_those_of_a_dense_solve():
    H, g = _dense()
    solution = solve(_as_chain(H, g))
    # the dense inverse of the scaled matrix: with a condition of 1e4 the limit is 1e-10
    s = 1 / np.sqrt(np.diag(H))
    P = np.linalg.inv(H * np.outer(s, s)) * np.outer(s, s)
    x = P @ g
    steps = np.append(solution.step.ravel(), solution.step_constants)
    np.testing.assert_allclose(steps, x, rtol=1e-9)
    c = np.arange(N * STATES, TOTAL)
    np.testing.assert_allclose(solution.covariance, P[np.ix_(c, c)], rtol=1e-9)
    assert solution.log_determinant == pytest.approx(np.linalg.slogdet(H)[1], abs=1e-9)
    near = solution.marginals()
    for k in range(N - 1):
        i = np.r_[k * STATES:(k + 2) * STATES, c]
        np.testing.assert_allclose(near[k], P[np.ix_(i, i)], rtol=1e-8,
                                   atol=1e-10 * np.sqrt(np.outer(P[i, i], P[i, i])).min())


def test_absent_constants_have_their_priors_in_the_marginal_information():
    H, g = _dense()
    solution = solve(_as_chain(H, g))
    normal, weights = _as_chain(H, g), np.array([4.0, 0.25])
    normal.unused_weights = weights
    some = solve(normal)
    whole, part = NormalEquations(N, STATES, BORDER + 2), _as_chain(H, g)
    for to, of in zip((whole.diagonal, whole.upper, whole.g),
                      (part.diagonal, part.upper, part.g), strict=True):
        to[:] = of
    whole.coupling[:, :, :BORDER], whole.corner[:BORDER, :BORDER] = part.coupling, part.corner
    whole.corner[[-2, -1], [-2, -1]], whole.g_constants[:BORDER] = weights, part.g_constants
    all_of = solve(whole)
    for name in ('step', 'step_constants', 'covariance', 'reduced', 'g_reduced'):
        np.testing.assert_allclose(getattr(some, name), getattr(all_of, name), rtol=1e-9,
                                   atol=1e-12, err_msg=name)
    assert some.log_determinant == pytest.approx(all_of.log_determinant, abs=1e-9)
    sides, border = np.ones((N, STATES, 2)), np.ones((BORDER, 2))
    squares, moves = some.quadratic_forms(sides, border)
    wide = np.concatenate([border, np.zeros((2, 2))])
    for found, want in zip((squares, moves), all_of.quadratic_forms(sides, wide), strict=True):
        np.testing.assert_allclose(found, want, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(some.marginals()[1], solution.marginals()[1], rtol=1e-12)


def test_unconstrained_state_is_reported():
    H, g = _dense()
    H[N * STATES + 1, :] = H[:, N * STATES + 1] = 0.0
    with pytest.raises(NotPositive):
        solve(_as_chain(H, g))


# bytes per keyframe: chain 16e3, derivatives 13.4e3, sums and rows 8e3; the rest is for the
# blocks in process, 5e6 for any length
MAX_BYTES = 41.5e3


def peak_of_a_pass(duration):
    """Return the number of keyframes and the peak, bytes, of a pass with correlated fix errors."""
    _, config, leg = made(scenario='town', duration=duration, imu_rate=25.0, fix_rate=1.0)
    problem = make_problem(leg, config)
    state = cold_starts(leg, problem.imu, problem.priors, 0.0)[0].state
    levels = problem.initial_levels.replaced(correlation_time=60.0)
    tracemalloc.start()
    weighted = WeightedEquations(Equations(problem, state), levels)
    solution = solve(weighted.normal())
    weighted.apply_step(solution)
    near = solution.marginals()
    weighted.components(near)
    weighted[MotionRows].road_noise(near)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    return len(state.t), peak


def test_memory_of_a_pass_grows_little_with_the_leg():
    keyframes, peak = peak_of_a_pass(1152.0)
    assert keyframes > 1100
    assert peak / keyframes == pytest.approx(MAX_BYTES / 2, abs=MAX_BYTES / 2)


def resident(peak=False):
    """Return the resident bytes of this process, or their peak since the last call."""
    name = 'VmHWM' if peak else 'VmRSS'
    found = Path('/proc/self/status').read_text().split(f'{name}:')[1].split()[0]
    Path('/proc/self/clear_refs').write_text('5')
    return 1024 * int(found)


def test_turn_rates_in_a_file_are_read_in_chunks():
    rows, step = 6_000_000, 1e-3        # 100 min at 1 kHz
    t, w_b = work_array(rows), work_array(rows, 3)
    t[:] = np.arange(rows) * step
    assert w_b.nbytes > MAX_RESIDENT_BYTES
    release_mapped_memory()
    before = resident()
    mean_rates_at(np.arange(1.0, rows * step - 1.0), t, w_b)
    # all times are read; the rates, if in memory as a whole, would add their own size
    assert resident(peak=True) - before - t.nbytes < w_b.nbytes / 2
