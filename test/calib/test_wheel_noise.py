# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Increments of a random walk with reading errors: against dense algebra and closed forms."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.estimator.result.wheels import _leave_one_out, _solve, fit_line, Increments

K = 300             # increments of a drive of five minutes
PATH = 10.0          # m, per increment
NO_READING = 1e-16      # m^2


def increments(seed=0, walk=1e-3**2, reading=0.0, k=K, ratio=1e-3):
    """Return equal increments with random walk, m^2 per second, and reading variance, m^2."""
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
    """Return the full covariance of increments from readings and random walk."""
    k = len(seen.y)
    D = np.diff(np.eye(k + 1), axis=0)
    walk = (seen.walk * np.exp(log_levels[:-1]))[seen.kind] * seen.share * spread
    return np.diag(walk) + seen.reading * np.exp(log_levels[-1]) * D @ D.T


def test_fit_equals_least_squares_with_the_full_covariance():
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


def test_ratio_with_a_random_walk_only_is_that_of_the_end_points():
    line = fit_line(seen := increments(walk=1e-3**2))
    assert line.x[0] == pytest.approx(seen.y.sum() / seen.X.sum(), rel=1e-6)
    # the logarithm of a variance from k increments has sigma sqrt(2 / k); the prior is far wider
    level, = line.levels
    assert abs(np.log(level / 1e-3**2)) < 4 * np.sqrt(2 / K)
    assert np.sqrt(line.covariance[0, 0]) == pytest.approx(np.sqrt(level / K) / PATH, rel=1e-4)


@pytest.mark.parametrize(('walk', 'reading'), [
    (1e-3**2, 0.0), (0.0, 0.01**2), (1e-3**2, 0.01**2), (0.02**2, 1e-3**2)])
def test_sigmas_hold_for_walk_and_reading_errors(walk, reading):
    """40 drives: their rms has an error of 1 / sqrt(80), four times that is 0.45."""
    lines = [fit_line(increments(seed, walk, reading)) for seed in range(40)]
    off = np.array([(line.x[0] - 1e-3) / np.sqrt(line.covariance[0, 0]) for line in lines])
    assert np.sqrt((off**2).mean()) == pytest.approx(1.0, abs=0.45)


def test_each_kind_has_a_separate_walk_level():
    draw = np.random.default_rng(1)
    kind = np.arange(900) % 3
    walk = np.array([0.5e-3, 1e-3, 4e-3])**2
    seen = increments(k=900)
    seen = replace(seen, kind=kind, walk=np.full(3, 2e-3**2),
                   y=1e-3 * PATH + np.sqrt(walk[kind]) * draw.standard_normal(900))
    # each from 300 increments; the common prior has a sigma of 1 and moves them by (2 / 300)
    # of their distance from the mean, which is 2.2 at most
    assert np.abs(np.log(fit_line(seen).levels / walk)).max() < 4 * np.sqrt(2 / 300) + 0.02


def test_outlying_increments_have_less_weight():
    seen = increments()
    jumps = np.zeros(K)
    jumps[[50, 120, 200]] = 0.3, 0.2, -0.1       # m, with a walk of 1 mm
    line, clean = fit_line(replace(seen, y=seen.y + jumps)), fit_line(seen)
    sigma = np.sqrt(clean.covariance[0, 0])
    # with full weight 0.4 m in 3000 m, 2300 sigma
    assert abs(line.x[0] - clean.x[0]) < 2 * sigma
    assert np.sqrt(line.covariance[0, 0]) < 2 * sigma


def test_increment_with_a_very_large_sigma_has_no_effect():
    seen = increments(reading=1e-3**2)
    share, y = seen.share.copy(), seen.y.copy()
    share[100:103], y[100:103] = 1e10, 5.0
    line, clean = fit_line(replace(seen, share=share, y=y)), fit_line(seen)
    assert abs(line.x[0] - clean.x[0]) < np.sqrt(clean.covariance[0, 0])


def test_gain_maps_increments_to_x_and_mirrored_wheels_have_negative_x():
    """Increments proportional to X return x unchanged, without a prior."""
    seen = increments(reading=1e-3**2)
    line = fit_line(seen)
    assert_allclose(line.gain @ seen.X, np.eye(1), rtol=1e-9)
    assert line.gain @ seen.y == pytest.approx(line.x, rel=1e-9)
    other = fit_line(replace(seen, y=-seen.y))
    assert_allclose(other.x, -line.x, rtol=1e-12)
    assert_allclose(other.covariance, line.covariance, rtol=1e-12)
