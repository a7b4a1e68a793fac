# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The bound of the chain against an independent dense covariance of the same rows."""

from dataclasses import replace

import numpy as np
import pytest
from smoother_legs import made, truth

from odocal_ros.estimator import bound
from odocal_ros.estimator.equations import Equations
from odocal_ros.estimator.factors.priors import SIZE, START_SIGMAS
from odocal_ros.estimator.factors.rests import STILL_SPEED, STILL_TURN
from odocal_ros.estimator.prepare import problem_of
from odocal_ros.estimator.state import BARE, E, IMPERFECT, M, SLOW, WITH_SLOW

pytestmark = pytest.mark.core


@pytest.mark.parametrize('correlation_time', [0.0, 40.0])
def test_bound_is_the_inverse_of_all_rows_stacked(correlation_time):
    drive, config, leg = made(duration=140.0, fix_rate=1.0)
    leg = replace(leg, t_stop=50.0)
    problem = problem_of(leg, config)
    levels = problem.first_levels.but(correlation_time=correlation_time, fix=0.5)
    state = truth(drive, config, leg)
    parts = Equations(problem, state, fitted=True).parts
    motion, fixes = parts['motion'], parts['fixes']
    n, N = (WITH_SLOW if correlation_time else BARE), len(state.t)
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
    every, weighed = slice(None), motion.weighed(levels, M)
    units = motion.noise.columns(every) * weighed.roots()
    a, b, c = weighed.derivatives(every, units)
    Q = motion.noise.covariance(units, every)
    for k in range(N - 1):
        s = 1 / np.sqrt(np.diag(Q[k]))
        root = np.linalg.inv(np.linalg.cholesky(Q[k] * np.outer(s, s))) * s
        add(np.concatenate([a[k], b[k], c[k]], axis=1), (block(k), block(k + 1), border), root)
    J, Jc = fixes.jacobians(n)
    covariance = leg.covariance_n[problem.use]
    white = np.hypot(*np.einsum('kij,kj->ki', problem.root, fixes.raw)[:, :2].T)
    factor = np.array([np.sqrt(0.5), np.sqrt(0.5), 1.0])
    for i, k in enumerate(fixes.k):
        C = covariance[i] * np.outer(factor, factor)
        root = np.linalg.inv(np.linalg.cholesky(C))
        u = root @ fixes.raw[i]
        weight = np.array([min(1.0, 3 / np.hypot(u[0], u[1]))] * 2 + [min(1.0, 3 / abs(u[2]))])
        end = np.zeros((3, n))
        if n == WITH_SLOW:
            end[:, SLOW] = -np.eye(3) * fixes.share[i]
        add(np.concatenate([J[i], end, Jc[i]], axis=1), (block(k), block(k + 1), border),
            np.diag(weight) @ root)
    assert white.max() > 0.0
    single = np.eye(n)
    for k in range(N):
        add(single[[E]], (block(k),),
            np.eye(1) * np.sqrt(parts['travel'].weight[k] / problem.least['travel']))
        if problem.still[k]:
            add(single[3:6], (block(k),), np.eye(3) / STILL_SPEED)
    for k in range(N - 1):
        T = state.t[k + 1] - state.t[k]
        if problem.still[k] and problem.still[k + 1]:
            add(np.concatenate([-single[6:9], single[6:9]], axis=1), (block(k), block(k + 1)),
                np.diag(1 / (STILL_TURN * np.sqrt(T))))
        if n == WITH_SLOW:
            decay = np.exp(-T / correlation_time)
            power = correlation_time / 2 * np.array([levels['slow']] * 2 + [levels['slow_up']])
            add(np.concatenate([-decay * single[SLOW], single[SLOW]], axis=1),
                (block(k), block(k + 1)), np.diag(1 / np.sqrt(power * (1 - decay**2))))
    first = np.concatenate([*(np.broadcast_to(sigma, 3) for _, sigma in START_SIGMAS.values()),
                            problem.priors.gyro_bias, problem.priors.accel_bias])
    add(single[:15], (block(0),), np.diag(1 / first))
    if n == WITH_SLOW:
        add(single[SLOW], (block(0),), np.diag(1 / np.sqrt(power)))
    prior = problem.priors.constants.copy()
    prior[IMPERFECT] *= np.sqrt(SIZE)         # the first sizes
    add(np.eye(M), (border,), np.diag(1 / prior))
    A = np.concatenate(rows)
    # by QR of the rows, which does not square their condition: scaled columns
    scale = np.linalg.norm(A, axis=0)
    R = np.linalg.qr(A / scale, mode='r')
    last = np.linalg.inv(R[-M:, -M:])
    dense = last @ last.T / np.outer(scale[-M:], scale[-M:])
    got = bound(leg, config, state, levels)
    sigma = np.sqrt(np.diag(dense))
    # the normal equations of the chain lose what their condition costs: 1e-6 of a sigma
    np.testing.assert_allclose(got / np.outer(sigma, sigma), dense / np.outer(sigma, sigma),
                               atol=1e-5)
