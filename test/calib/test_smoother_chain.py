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


def test_absent_constants_have_their_priors_as_if_they_were_in_the_border():
    H, g = _dense()
    solved = solve(_as_chain(H, g))
    normal, weights = _as_chain(H, g), np.array([4.0, 0.25])
    normal.absent = weights
    some = solve(normal)
    whole, part = Normal(N, SIZE, BORDER + 2), _as_chain(H, g)
    for to, of in zip((whole.diagonal, whole.beside, whole.g),
                      (part.diagonal, part.beside, part.g), strict=True):
        to[:] = of
    whole.border[:, :, :BORDER], whole.corner[:BORDER, :BORDER] = part.border, part.corner
    whole.corner[[-2, -1], [-2, -1]], whole.g_border[:BORDER] = weights, part.g_border
    all_of = solve(whole)
    for name in ('step', 'step_border', 'covariance', 'reduced', 'g_reduced'):
        np.testing.assert_allclose(getattr(some, name), getattr(all_of, name), rtol=1e-9,
                                   atol=1e-12, err_msg=name)
    assert some.log_determinant == pytest.approx(all_of.log_determinant, abs=1e-9)
    sides, border = np.ones((N, SIZE, 2)), np.ones((BORDER, 2))
    squares, moves = some.products(sides, border)
    wide = np.concatenate([border, np.zeros((2, 2))])
    for found, want in zip((squares, moves), all_of.products(sides, wide), strict=True):
        np.testing.assert_allclose(found, want, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(some.marginals()[1], solved.marginals()[1], rtol=1e-12)


def test_what_nothing_holds_is_said():
    H, g = _dense()
    H[N * SIZE + 1, :] = H[:, N * SIZE + 1] = 0.0
    with pytest.raises(NotPositive):
        solve(_as_chain(H, g))
