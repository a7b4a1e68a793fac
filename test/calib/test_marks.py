# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reference positions at marks: honest sigmas of means, whatever the noise of the fixes."""

import numpy as np
import pytest

from odocal_ros.calib.marks import fix_at, mean_fix, standing_at

pytestmark = pytest.mark.core
STATED = np.diag([1.0, 1.0, 4.0])
RUNS = 200


def gauss_markov(rng, t, tau, runs):
    """Return unit first-order Gauss-Markov errors: (n, runs, 3)."""
    keep = np.exp(-np.diff(t) / tau)
    x = np.empty((len(t), runs, 3))
    x[0] = rng.standard_normal((runs, 3))
    for k, a in enumerate(keep):
        x[k + 1] = a * x[k] + np.sqrt(1 - a**2) * rng.standard_normal((runs, 3))
    return x


def run(n, white, tau, seed=1, correlation_time=np.nan, step=0.2):
    """Return (errors / sigma (runs, 3), median level sigma) of means of n fixes at 5 Hz."""
    rng, t = np.random.default_rng(seed), np.arange(n) * step
    errors = np.sqrt(1 - white) * gauss_markov(rng, t, tau, RUNS) if white < 1 else 0.0
    errors = (errors + np.sqrt(white) * rng.standard_normal((n, RUNS, 3))) * [1.0, 1.0, 2.0]
    stated = np.tile(STATED, (n, 1, 1))
    z, sigma = [], []
    for k in range(RUNS):
        mean, covariance, _, _ = mean_fix(t, errors[:, k], stated, correlation_time)
        sigma.append(np.sqrt(np.diag(covariance)))
        z.append(mean / sigma[-1])
    return np.array(z), np.median(sigma, axis=0)


def rms(z):
    return float(np.sqrt((z**2).mean()))


# 400 squared normals have a mean within 5 * sqrt(2 / 400) = 0.35 of one: rms 0.80 to 1.17
LOW, HIGH = np.sqrt(1 - 5 * np.sqrt(2 / 400)), np.sqrt(1 + 5 * np.sqrt(2 / 400))


@pytest.mark.parametrize('n', [25, 100, 400])
def test_white_fixes_average_down_by_their_number(n):
    z, sigma = run(n, white=1.0, tau=1.0)
    assert LOW < rms(z[:, :2]) < HIGH
    # a fix's own sigma over root n; the odd set that scatters more than stated is a bit wider
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(STATED) / n), rtol=0.06)


@pytest.mark.parametrize('white', [0.0, 0.04])
@pytest.mark.parametrize(('n', 'tau'), [(50, 60.0), (300, 60.0), (300, 600.0), (300, 20.0)])
def test_slow_errors_do_not_average_down(n, tau, white):
    """
    The sigma holds where errors stay alike, without being told how long.

    How fast they move is judged from one window, so the sigma itself errs: by up to a fifth.
    """
    z, _ = run(n, white, tau)
    assert LOW / 1.2 < rms(z[:, :2]) < HIGH * 1.2


@pytest.mark.parametrize('n', [1, 2, 5, 15, 19])
@pytest.mark.parametrize('white', [0.0, 1.0])
def test_a_few_fixes_are_no_better_than_one(n, white):
    """Below twenty fixes nothing tells white from slow errors: the sigma is that of one."""
    z, sigma = run(n, white, 60.0)
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(STATED)), rtol=1e-9)
    assert rms(z) < HIGH


@pytest.mark.parametrize(('told', 'white', 'tau'), [(0.0, 1.0, 1.0), (30.0, 0.0, 30.0)])
def test_a_correlation_time_that_is_told_is_used(told, white, tau):
    z, _ = run(200, white, tau, correlation_time=told)
    assert LOW < rms(z[:, :2]) < HIGH


def test_scatter_beyond_the_stated_sigma_widens():
    rng = np.random.default_rng(3)
    stated = np.tile(STATED / 25, (200, 1, 1))           # five times too sure
    z = []
    for _ in range(100):
        mean, covariance, _, _ = mean_fix(np.arange(200) * 0.2, rng.standard_normal((200, 3)),
                                          stated)
        z.append(mean[:2] / np.sqrt(np.diag(covariance)[:2]))
    assert 0.7 < rms(np.array(z)) < 1.25                 # 200 squares: 1 +- 5 * 0.05, rounded up


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_outliers_are_left_out_in_the_level_and_in_height(axis):
    rng = np.random.default_rng(4)
    p = rng.standard_normal((100, 3))
    p[[7, 50, 51], axis] += 1000.0
    mean, _, used, dropped = mean_fix(np.arange(100) * 0.2, p, np.tile(STATED, (100, 1, 1)))
    assert (used, dropped) == (97, 3)
    assert np.abs(mean).max() < 0.5                      # five sigmas of a mean of 97


def test_better_fixes_weigh_more():
    p = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    mean, _, _, _ = mean_fix(np.array([0.0, 1.0]), p, np.stack([STATED, STATED / 9]))
    np.testing.assert_allclose(mean, [0.9, 0.0, 0.0])


def test_a_single_fix_is_itself():
    mean, covariance, used, dropped = mean_fix(np.zeros(1), np.array([[3.0, 4.0, 5.0]]),
                                               STATED[None])
    np.testing.assert_array_equal(mean, [3.0, 4.0, 5.0])
    np.testing.assert_array_equal(covariance, STATED)
    assert (used, dropped) == (1, 0)


def test_a_mark_belongs_to_the_standstill_it_touches():
    spans = np.array([[0.0, 10.0], [30.0, 40.0]])
    assert standing_at(5.0, spans) == (0.0, 10.0)
    assert standing_at(10.4, spans) == (0.0, 10.0)
    assert standing_at(29.6, spans) == (30.0, 40.0)
    assert standing_at(20.0, spans) is None
    assert standing_at(20.0, np.empty((0, 2))) is None


def test_a_mark_in_motion_is_fitted_with_the_motion_taken_out():
    t = np.arange(0.0, 20.0, 0.5)
    velocity = np.array([10.0, -4.0, 0.5])
    p = t[:, None] * velocity
    mark = fix_at(10.3, None, (t, p, np.tile(STATED, (len(t), 1, 1))),
                  lambda times: (times - 10.3)[:, None] * velocity, np.nan, 2.0)
    np.testing.assert_allclose(mark.position_n, 10.3 * velocity, atol=1e-12)
    assert not mark.standing
    assert mark.used == 8


def test_no_fix_near_a_mark_is_none():
    t, p, c = np.arange(5.0), np.zeros((5, 3)), np.tile(STATED, (5, 1, 1))
    still = lambda times: np.zeros((len(times), 3))      # noqa: E731
    assert fix_at(20.0, None, (t, p, c), still, np.nan, 2.0) is None
    assert fix_at(20.0, (15.0, 25.0), (t, p, c), still, np.nan, 2.0) is None
    assert fix_at(5.5, (5.0, 25.0), (t, p, c), still, np.nan, 2.0).used == 1
    assert fix_at(0.0, (0.0, 1.0), (t[:0], p[:0], c[:0]), still, np.nan, 2.0) is None


def test_one_fix_without_height_leaves_the_height_unknown():
    t, p = np.arange(5.0), np.ones((5, 3))
    p[3, 2] = np.nan
    mark = fix_at(2.0, (0.0, 4.0), (t, p, np.tile(STATED, (5, 1, 1))),
                  lambda times: np.zeros((len(times), 3)), np.nan, 2.0)
    assert not mark.height_known
    assert np.isfinite(mark.position_n).all()
    np.testing.assert_allclose(mark.position_n[:2], 1.0)


def test_a_mark_is_no_better_than_the_slow_errors_seen_elsewhere():
    mark = fix_at(0.0, (0.0, 100.0), (np.arange(0.0, 100.0, 0.2), np.zeros((500, 3)),
                                      np.tile(STATED, (500, 1, 1))),
                  lambda times: np.zeros((len(times), 3)), 0.0, 2.0)
    wider = mark.at_least(0.25, 4.0)
    np.testing.assert_allclose(np.diag(wider.covariance_n), [0.25, 0.25, 1.0], rtol=0.01)
    np.testing.assert_array_equal(wider.at_least(0.1, 4.0).covariance_n, wider.covariance_n)
