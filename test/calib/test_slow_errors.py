# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Slow fix errors: how large, how long, and what they leave in a mark's mean."""

import math

import numpy as np
import pytest

from odocal_ros.calib.check import fix_noise_factor
from odocal_ros.calib.marks import MarkFix, mean_fix
from odocal_ros.calib.slow_errors import no_better, slow_share, slow_variance

RATE, RUNS = 0.5, 60        # s between fixes, drives


def gauss_markov(rng, n, tau):
    keep = math.exp(-RATE / tau)
    x = np.empty((n, RUNS))
    x[0] = rng.standard_normal(RUNS)
    for k in range(1, n):
        x[k] = keep * x[k - 1] + math.sqrt(1 - keep**2) * rng.standard_normal(RUNS)
    return x


def mark(variance, used):
    return MarkFix(0.0, np.zeros(3), variance * np.diag([1.0, 1.0, 4.0]), True, used, 0)


@pytest.mark.parametrize('tau', [15.0, 60.0])
def test_size_and_time_of_slow_errors_are_found(tau):
    rng, t = np.random.default_rng(5), np.arange(0.0, 3600.0, RATE)
    errors = math.sqrt(0.3) * gauss_markov(rng, len(t), tau) \
        + math.sqrt(0.7) * rng.standard_normal((len(t), RUNS))
    found = np.array([slow_variance(t, e, 10 * t, np.ones(len(t)), 0.0) for e in errors.T])
    x = 20.0 / tau
    expected = 0.3 * 2 * (x - 1 + math.exp(-x)) / x**2
    # an hour holds 3600 / (2 tau) or more independent values: 30 at least, so 26 % a drive, 3.4 %
    # the mean of 60; the line taken out of each leaves 1 % less. Five of these
    assert found[:, 0].mean() == pytest.approx(expected, rel=0.17)
    # a ratio of two such; its log-mean within a quarter
    assert math.exp(np.log(found[:, 1]).mean()) == pytest.approx(tau, rel=0.25)


def test_white_errors_are_seldom_taken_for_slow_ones():
    rng, t = np.random.default_rng(6), np.arange(0.0, 600.0, RATE)
    found = [slow_variance(t, rng.standard_normal(len(t)), 10 * t, np.ones(len(t)), 0.0)[0]
             for _ in range(1000)]
    # three sigmas of chi-square with 28 degrees: 0.6 % of drives; five sigmas of that count
    assert np.mean(np.array(found) > 0) < 0.006 + 5 * math.sqrt(0.006 / 1000)


@pytest.mark.parametrize(('seconds', 'tau'), [(300.0, 60.0), (5.0, 60.0), (60.0, 20.0)])
def test_the_share_is_that_of_a_mean_of_gauss_markov_errors(seconds, tau):
    def mean_square(span):
        t = np.linspace(0.0, span, 801)
        return np.exp(-np.abs(t[:, None] - t) / tau).mean()

    # the sum of 801^2 against the integral: the diagonal weighs 1 / 801
    assert slow_share(seconds, tau) == pytest.approx(
        mean_square(seconds) / mean_square(20.0), rel=3e-3)


def test_a_share_at_a_moment_and_of_lasting_errors():
    assert slow_share(0.0, 60.0) > 1.0
    assert slow_share(300.0, math.inf) == 1.0
    assert slow_share(0.0, math.inf) == 1.0


@pytest.mark.parametrize(('own', 'used', 'slow', 'after'), [
    (0.01, 100, 0.2, 0.2),     # took them for white: as wide as the leg says
    (0.01, 100, 0.005, 0.01),  # never narrower
    (0.5, 100, 0.8, 0.5),      # has seen slow errors itself: its own figure stands
    (0.2, 100, 0.8, 0.8)])     # unless the leg clearly says more
def test_a_mark_is_widened_where_it_cannot_know_better(own, used, slow, after):
    result = no_better(mark(own, used), slow, math.inf, (-30.0, 0.0), 1.0, 4.0)
    np.testing.assert_allclose(result.covariance_n, after * np.diag([1.0, 1.0, 4.0]))


def test_long_rest_lets_slow_errors_average_down():
    result = no_better(mark(0.001, 1000), 0.8, 60.0, (-300.0, 0.0), 1.0, 4.0)
    assert result.covariance_n[0, 0] == pytest.approx(0.8 * slow_share(300.0, 60.0))
    assert result.covariance_n[0, 0] < 0.4


def test_the_noise_factor_leaves_out_what_the_marks_put_into_the_track():
    rng, stated = np.random.default_rng(7), np.tile(np.diag([1.0, 1.0, 4.0]), (4000, 1, 1))
    share = np.linspace(0.0, 1.0, 4000)[:, None]
    factors = []
    for true in (1.0, 2.0):
        ends = true * np.sqrt(0.9) * np.array([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
        residual = true * rng.standard_normal((4000, 3)) * [1.0, 1.0, 2.0] \
            + (1 - share) * ends[0] + share * ends[1]
        factors.append([fix_noise_factor(residual, stated, 0.0, marks)[0]
                        for marks in ((), (mark(0.9, 10), mark(0.9, 10)))])
    # medians of 4000 err by 2 %; each error of a mark is one draw here, of one sigma
    assert factors[0][1] == 1.0
    assert factors[1][1] == pytest.approx(2.0, rel=0.1)
    assert factors[1][0] > 1.1 * factors[1][1]


def test_chance_scatter_does_not_widen_white_fixes():
    rng, stated = np.random.default_rng(8), np.tile(np.diag([1.0, 1.0, 4.0]), (60, 1, 1))
    t, variances = np.arange(60) * RATE, []
    for _ in range(300):
        _, covariance, used, _ = mean_fix(t, rng.standard_normal((60, 3)) * [1.0, 1.0, 2.0],
                                          stated)
        variances.append(covariance[0, 0] * used)
    # the larger of 1 and a scatter that errs by 1 / sqrt(60) would make 1.05 on the mean; one
    # drive in a thousand is judged slow or scattered, beyond three sigmas
    assert np.mean(np.isclose(variances, 1.0)) > 0.98
