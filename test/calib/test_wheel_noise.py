# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Increments of a random walk and reading errors: against dense algebra and closed forms."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.estimator.result.wheels import _leave_one_out, _solve, fit_line, Increments

K = 300             # increments of a drive of five minutes
PATH = 10.0          # m in each
NO_READING = 1e-16      # m^2


def increments(seed=0, walk=1e-3**2, reading=0.0, k=K, ratio=1e-3):
    """Return increments of a constant way, walk m^2 a second and readings' variance, m^2."""
    draw = np.random.default_rng(seed)
    error = np.sqrt(walk) * draw.standard_normal(k) + np.diff(
        np.sqrt(reading) * draw.standard_normal(k + 1))
    path = np.full(k, PATH)
    return Increments(ratio * path + error, path[:, None], np.array([np.inf]), np.zeros(1),
                      max(reading, NO_READING), np.ones(k), np.zeros(k, int),
                      np.array([2e-3**2]))


def uneven():
    """Return increments of three kinds with two unknowns, one with a prior."""
    draw = np.random.default_rng(3)
    k = 40
    return Increments(
        draw.standard_normal(k), draw.standard_normal((k, 2)), np.array([np.inf, 0.3]),
        np.array([0.0, 0.7]), 0.2, draw.uniform(0.1, 1.0, k), draw.integers(0, 3, k),
        np.array([0.5, 1.0, 2.0])), draw.uniform(1.0, 3.0, k), np.array([0.3, -0.2, 0.1, 0.4])


def dense(seen, spread, log_levels):
    """Return the whole covariance, from how readings and walk make increments."""
    k = len(seen.y)
    D = np.diff(np.eye(k + 1), axis=0)
    walk = (seen.walk * np.exp(log_levels[:-1]))[seen.kind] * seen.share * spread
    return np.diag(walk) + seen.reading * np.exp(log_levels[-1]) * D @ D.T


def test_it_is_least_squares_with_the_whole_covariance():
    seen, spread, levels = uneven()
    V = dense(seen, spread, levels)
    x, covariance, cost, banded, root = _solve(levels, seen, spread)
    information = seen.X.T @ np.linalg.solve(V, seen.X) + np.diag(1 / seen.prior**2)
    expected = seen.mean + np.linalg.solve(
        information, seen.X.T @ np.linalg.solve(V, seen.y - seen.X @ seen.mean))
    assert_allclose(covariance, np.linalg.inv(information), rtol=1e-10)
    assert_allclose(x, expected, rtol=1e-10)
    off, before = seen.y - seen.X @ x, x - seen.mean
    quadratic = off @ np.linalg.solve(V, off) + before @ (before / seen.prior**2)
    assert cost == pytest.approx(np.linalg.slogdet(V)[1] + np.linalg.slogdet(information)[1]
                                 + quadratic, rel=1e-10)
    inverse = np.linalg.inv(V)
    assert_allclose(_leave_one_out(banded, root, off), inverse @ off / np.sqrt(np.diag(inverse)),
                    rtol=1e-9)
    assert_allclose(banded[1], np.diag(V))


def test_of_a_walk_alone_the_ratio_is_that_of_the_ends():
    line = fit_line(seen := increments(walk=1e-3**2))
    assert line.x[0] == pytest.approx(seen.y.sum() / seen.X.sum(), rel=1e-6)
    # the logarithm of a variance by k increments is known to sqrt(2 / k), the prior is far wider
    level, = line.levels
    assert abs(np.log(level / 1e-3**2)) < 4 * np.sqrt(2 / K)
    assert np.sqrt(line.covariance[0, 0]) == pytest.approx(np.sqrt(level / K) / PATH, rel=1e-4)


@pytest.mark.parametrize(('walk', 'reading'), [
    (1e-3**2, 0.0), (0.0, 0.01**2), (1e-3**2, 0.01**2), (0.02**2, 1e-3**2)])
def test_sigmas_hold_whatever_errs(walk, reading):
    """40 drives: their rms is good to 1 / sqrt(80), four times that to 0.45."""
    lines = [fit_line(increments(seed, walk, reading)) for seed in range(40)]
    off = np.array([(line.x[0] - 1e-3) / np.sqrt(line.covariance[0, 0]) for line in lines])
    assert np.sqrt((off**2).mean()) == pytest.approx(1.0, abs=0.45)


def test_kinds_have_walks_of_their_own():
    draw = np.random.default_rng(1)
    kind = np.arange(900) % 3
    walk = np.array([0.5e-3, 1e-3, 4e-3])**2
    seen = increments(k=900)
    seen = replace(seen, kind=kind, walk=np.full(3, 2e-3**2),
                   y=1e-3 * PATH + np.sqrt(walk[kind]) * draw.standard_normal(900))
    # each by 300 increments; the prior that holds them together has a spread of 1 and takes
    # (2 / 300) of their distance from the mean, which is 2.2 at most
    assert np.abs(np.log(fit_line(seen).levels / walk)).max() < 4 * np.sqrt(2 / 300) + 0.02


def test_increments_far_out_are_weighed_less():
    seen = increments()
    jumps = np.zeros(K)
    jumps[[50, 120, 200]] = 0.3, 0.2, -0.1       # m, of a walk of 1 mm
    line, clean = fit_line(replace(seen, y=seen.y + jumps)), fit_line(seen)
    sigma = np.sqrt(clean.covariance[0, 0])
    # all of it would be 0.4 m in 3000 m, 2300 sigma
    assert abs(line.x[0] - clean.x[0]) < 2 * sigma
    assert np.sqrt(line.covariance[0, 0]) < 2 * sigma


def test_an_increment_that_says_nothing_is_as_good_as_none():
    seen = increments(reading=1e-3**2)
    share, y = seen.share.copy(), seen.y.copy()
    share[100:103], y[100:103] = 1e10, 5.0
    line, clean = fit_line(replace(seen, share=share, y=y)), fit_line(seen)
    assert abs(line.x[0] - clean.x[0]) < np.sqrt(clean.covariance[0, 0])


def test_the_gain_is_what_increments_make_of_x_and_mirrored_wheels_have_its_negative():
    """What lies along the unknowns comes out as it is, where no prior holds it."""
    seen = increments(reading=1e-3**2)
    line = fit_line(seen)
    assert_allclose(line.gain @ seen.X, np.eye(1), rtol=1e-9)
    assert line.gain @ seen.y == pytest.approx(line.x, rel=1e-9)
    other = fit_line(replace(seen, y=-seen.y))
    assert_allclose(other.x, -line.x, rtol=1e-12)
    assert_allclose(other.covariance, line.covariance, rtol=1e-12)
