# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reference positions at marks: sigmas of means; correlated errors: size, time and share."""

import math

import numpy as np
import pytest

from odocal_ros.calib.marks import (
    fix_at,
    MarkFix,
    mean_fix,
    slow_share,
    slow_variance,
    standing_at,
    with_slow_errors,
)
from odocal_ros.calib.track_check import fix_noise_factor
from odocal_ros.sim.noise import gauss_markov

pytestmark = pytest.mark.core
STATED = np.diag([1.0, 1.0, 4.0])
RUNS = 200
RATE, DRIVES = 0.5, 60        # s between fixes


def slow_errors(rng, t, tau, runs):
    """Return unit first-order Gauss-Markov errors: (n, runs, 3)."""
    return np.stack([gauss_markov(rng, 1.0, tau, t) for _ in range(runs)], axis=1)


def run(n, white, tau, correlation_time=np.nan, stated=STATED):
    """Return (errors / sigma (runs, 3), median level sigma) of means of n fixes at 5 Hz."""
    rng, t = np.random.default_rng(1), np.arange(n) * 0.2
    errors = np.sqrt(1 - white) * slow_errors(rng, t, tau, RUNS) if white < 1 else 0.0
    errors = (errors + np.sqrt(white) * rng.standard_normal((n, RUNS, 3))) * [1.0, 1.0, 2.0]
    z, sigma = [], []
    for k in range(RUNS):
        mean, covariance, _ = mean_fix(t, errors[:, k], np.tile(stated, (n, 1, 1)),
                                       correlation_time)
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
    # sigma of a fix over sqrt(n); chance scatter beyond the stated sigma makes it slightly wider
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(STATED) / n), rtol=0.06)


@pytest.mark.parametrize('white', [0.0, 0.04])
@pytest.mark.parametrize(('n', 'tau'), [(50, 60.0), (300, 60.0), (300, 600.0), (300, 20.0)])
def test_correlated_errors_do_not_average_down(n, tau, white):
    """
    The sigma holds for time-correlated errors without a configured correlation time.

    The correlation time is estimated from one window, so the sigma itself errs by up to a fifth.
    """
    z, _ = run(n, white, tau)
    assert LOW / 1.2 < rms(z[:, :2]) < HIGH * 1.2


@pytest.mark.parametrize('n', [1, 2, 5, 15, 19])
@pytest.mark.parametrize('white', [0.0, 1.0])
def test_few_fixes_have_the_sigma_of_one(n, white):
    """Below twenty fixes, white and correlated errors are not separable: the sigma of one fix."""
    z, sigma = run(n, white, 60.0)
    np.testing.assert_allclose(sigma, np.sqrt(np.diag(STATED)), rtol=1e-9)
    assert rms(z) < HIGH


@pytest.mark.parametrize(('configured', 'white', 'tau', 'stated'), [
    (0.0, 1.0, 1.0, STATED), (30.0, 0.0, 30.0, STATED),
    (np.nan, 1.0, 1.0, STATED / 25)])       # stated sigma five times too small: the scatter widens
def test_configured_correlation_time_and_the_scatter_are_used(configured, white, tau, stated):
    z, _ = run(200, white, tau, configured, stated)
    assert LOW < rms(z[:, :2]) < HIGH


@pytest.mark.parametrize('axis', [0, 1, 2])
def test_outliers_in_level_and_height_are_excluded(axis):
    rng = np.random.default_rng(4)
    p = rng.standard_normal((100, 3))
    p[[7, 50, 51], axis] += 1000.0
    mean, _, used = mean_fix(np.arange(100) * 0.2, p, np.tile(STATED, (100, 1, 1)))
    assert used == 97
    assert np.abs(mean).max() < 0.5                      # five sigmas of a mean of 97


def test_better_fixes_have_more_weight_and_a_single_fix_is_the_mean():
    p = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    mean, _, _ = mean_fix(np.array([0.0, 1.0]), p, np.stack([STATED, STATED / 9]))
    np.testing.assert_allclose(mean, [0.9, 0.0, 0.0])
    mean, covariance, used = mean_fix(np.zeros(1), np.array([[3.0, 4.0, 5.0]]), STATED[None])
    np.testing.assert_array_equal(mean, [3.0, 4.0, 5.0])
    np.testing.assert_array_equal(covariance, STATED)
    assert used == 1


def test_mark_belongs_to_the_standstill_it_overlaps():
    spans = np.array([[0.0, 10.0], [30.0, 40.0]])
    for t, found in ((5.0, (0.0, 10.0)), (10.4, (0.0, 10.0)), (29.6, (30.0, 40.0)), (20.0, None)):
        assert standing_at(t, spans) == found
    assert standing_at(20.0, np.empty((0, 2))) is None


def test_mark_in_motion_is_fitted_with_the_motion_removed():
    t = np.arange(0.0, 20.0, 0.5)
    velocity = np.array([10.0, -4.0, 0.5])
    p = t[:, None] * velocity
    mark = fix_at(10.3, None, (t, p, np.tile(STATED, (len(t), 1, 1))),
                  lambda times: (times - 10.3)[:, None] * velocity, np.nan, 2.0)
    np.testing.assert_allclose(mark.position_n, 10.3 * velocity, atol=1e-12)
    assert not mark.standing
    assert mark.fix_count == 8


def at_rest(mark, span, t, p, correlation_time=np.nan):
    return fix_at(mark, span, (t, p, np.tile(STATED, (len(t), 1, 1))),
                  lambda times: np.zeros((len(times), 3)), correlation_time, 2.0)


def test_mark_without_fixes_is_none_and_without_heights_has_an_unknown_height():
    t, p = np.arange(5.0), np.ones((5, 3))
    assert at_rest(20.0, None, t, p) is at_rest(20.0, (15.0, 25.0), t, p) is None
    assert at_rest(5.5, (5.0, 25.0), t, p).fix_count == 1
    assert at_rest(0.0, (0.0, 1.0), t[:0], p[:0]) is None
    p[3, 2] = np.nan
    mark = at_rest(2.0, (0.0, 4.0), t, p)
    assert not mark.height_known
    assert np.isfinite(mark.position_n).all()
    np.testing.assert_allclose(mark.position_n[:2], 1.0)


def mark(variance, used):
    return MarkFix(0.0, np.zeros(3), variance * STATED, True, used)


@pytest.mark.parametrize('tau', [15.0, 60.0])
def test_size_and_time_of_correlated_errors_are_found(tau):
    rng, t = np.random.default_rng(5), np.arange(0.0, 3600.0, RATE)
    errors = math.sqrt(0.3) * slow_errors(rng, t, tau, DRIVES)[..., 0] \
        + math.sqrt(0.7) * rng.standard_normal((len(t), DRIVES))
    found = np.array([slow_variance(t, e, 10 * t, np.ones(len(t)), 0.0) for e in errors.T])
    x = 20.0 / tau
    expected = 0.3 * 2 * (x - 1 + math.exp(-x)) / x**2
    # an hour has 3600 / (2 tau) or more independent values: 30 at least, so 26 % for one drive and
    # 3.4 % for the mean of 60; the removed line reduces it by 1 %. The limit is five of these
    assert found[:, 0].mean() == pytest.approx(expected, rel=0.17)
    # the ratio of two such values; its mean logarithm within a quarter
    assert math.exp(np.log(found[:, 1]).mean()) == pytest.approx(tau, rel=0.25)


def test_white_errors_are_rarely_treated_as_correlated():
    rng, t = np.random.default_rng(6), np.arange(0.0, 600.0, RATE)
    found = [slow_variance(t, rng.standard_normal(len(t)), 10 * t, np.ones(len(t)), 0.0)[0]
             for _ in range(1000)]
    # three sigmas of chi-square with 28 degrees: 0.6 % of drives; five sigmas of that number
    assert np.mean(np.array(found) > 0) < 0.006 + 5 * math.sqrt(0.006 / 1000)


@pytest.mark.parametrize(('seconds', 'tau'), [(300.0, 60.0), (5.0, 60.0), (60.0, 20.0)])
def test_slow_share_is_that_of_a_mean_of_gauss_markov_errors(seconds, tau):
    def mean_square(span):
        t = np.linspace(0.0, span, 801)
        return np.exp(-np.abs(t[:, None] - t) / tau).mean()

    # a sum of 801^2 terms instead of the integral: the diagonal has a share of 1 / 801
    assert slow_share(seconds, tau) == pytest.approx(
        mean_square(seconds) / mean_square(20.0), rel=3e-3)
    # at one moment, and for constant errors
    assert slow_share(0.0, tau) > 1.0
    assert slow_share(seconds, math.inf) == slow_share(0.0, math.inf) == 1.0


@pytest.mark.parametrize(('sigma', 'used', 'slow', 'tau', 'rest', 'after'), [
    (0.01, 100, 0.2, math.inf, 30.0, 0.2),     # treated as white: widened to the value of the leg
    (0.01, 100, 0.005, math.inf, 30.0, 0.01),  # never narrower
    (0.5, 100, 0.8, math.inf, 30.0, 0.5),      # the mark has found correlated errors: unchanged
    (0.2, 100, 0.8, math.inf, 30.0, 0.8),      # unless the leg shows clearly larger errors
    (0.001, 1000, 0.8, 60.0, 300.0, 0.8 * slow_share(300.0, 60.0))])    # they average down
def test_mark_is_widened_by_correlated_errors_it_cannot_detect(
        sigma, used, slow, tau, rest, after):
    result = with_slow_errors(mark(sigma, used), slow, tau, (-rest, 0.0), 1.0, 4.0)
    np.testing.assert_allclose(result.covariance_n, after * STATED)


def test_noise_factor_excludes_the_mark_errors_in_the_track():
    rng, stated = np.random.default_rng(7), np.tile(STATED, (4000, 1, 1))
    share = np.linspace(0.0, 1.0, 4000)[:, None]
    factors = []
    for true in (1.0, 2.0):
        ends = true * np.sqrt(0.9) * np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        residual = true * rng.standard_normal((4000, 3)) * [1.0, 1.0, 2.0] \
            + (1 - share) * ends[0] + share * ends[1]
        factors.append([fix_noise_factor(residual, stated, 0.0, marks)[0]
                        for marks in ((), (mark(0.9, 10), mark(0.9, 10)))])
    # medians of 4000 have an error of 2 %; each error of a mark is one draw of one sigma
    assert factors[0][1] == 1.0
    assert factors[1][1] == pytest.approx(2.0, rel=0.1)
    assert factors[1][0] > 1.1 * factors[1][1]


def test_chance_scatter_does_not_widen_white_fixes():
    rng, stated = np.random.default_rng(8), np.tile(STATED, (60, 1, 1))
    t, variances = np.arange(60) * RATE, []
    for _ in range(300):
        _, covariance, used = mean_fix(t, rng.standard_normal((60, 3)) * [1.0, 1.0, 2.0], stated)
        variances.append(covariance[0, 0] * used)
    # the larger of 1 and a scatter with error 1 / sqrt(60) would have a mean of 1.05; one drive in
    # a thousand is estimated as correlated or scattered, beyond three sigmas
    assert np.mean(np.isclose(variances, 1.0)) > 0.98
