# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The block solver against dense algebra."""

import numpy as np
import pytest

from odocal_ros.estimator.chain import Normal, NotPositive, solve

pytestmark = pytest.mark.core
N, SIZE, BORDER = 6, 4, 3
TOTAL = N * SIZE + BORDER


def _dense(seed=0, rows=8):
    """Return a dense normal matrix and right side with the chain's pattern, badly scaled."""
    rng = np.random.default_rng(seed)
    A = np.zeros((0, TOTAL))
    for k in range(N - 1):
        block = np.zeros((rows, TOTAL))
        block[:, k * SIZE:(k + 2) * SIZE] = rng.standard_normal((rows, 2 * SIZE))
        block[:, N * SIZE:] = rng.standard_normal((rows, BORDER))
        A = np.concatenate([A, block])
    A = A * np.exp(5 * rng.standard_normal(TOTAL))
    return A.T @ A, A.T @ rng.standard_normal(len(A))


def _as_chain(H, g):
    b = [slice(k * SIZE, (k + 1) * SIZE) for k in range(N)]
    c = slice(N * SIZE, TOTAL)
    out = Normal(N, SIZE, BORDER)
    out.diagonal[:] = [H[s, s] for s in b]
    out.beside[:] = [H[b[k], b[k + 1]] for k in range(N - 1)]
    out.border[:] = [H[s, c] for s in b]
    out.g[:] = g[:N * SIZE].reshape(N, SIZE)
    out.corner[:], out.g_border[:] = H[c, c], g[c]
    return out


def test_step_and_covariances_are_those_of_a_dense_solve():
    H, g = _dense()
    solved = solve(_as_chain(H, g))
    # the dense inverse of the scaled matrix: its condition is 1e4, so 1e-10 leaves room
    s = 1 / np.sqrt(np.diag(H))
    P = np.linalg.inv(H * np.outer(s, s)) * np.outer(s, s)
    x = P @ g
    np.testing.assert_allclose(np.append(solved.step.ravel(), solved.step_border), x, rtol=1e-9)
    c = np.arange(N * SIZE, TOTAL)
    np.testing.assert_allclose(solved.covariance, P[np.ix_(c, c)], rtol=1e-9)
    assert solved.log_determinant == pytest.approx(np.linalg.slogdet(H)[1], abs=1e-9)
    near = solved.marginals()
    for k in range(N - 1):
        i = np.r_[k * SIZE:(k + 2) * SIZE, c]
        np.testing.assert_allclose(near[k], P[np.ix_(i, i)], rtol=1e-8,
                                   atol=1e-10 * np.sqrt(np.outer(P[i, i], P[i, i])).min())


def test_what_nothing_holds_is_said():
    H, g = _dense()
    H[N * SIZE + 1, :] = H[:, N * SIZE + 1] = 0.0
    with pytest.raises(NotPositive):
        solve(_as_chain(H, g))
