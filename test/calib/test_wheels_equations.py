# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The wheels' equations: derivatives against differences, noise against closed forms."""

from dataclasses import replace
from functools import cache

from drives import drive, settings
import numpy as np
from numpy.testing import assert_allclose
import pytest
from wheel_legs import wheel_leg

from odocal_ros.calib.wheels.first import near_neighbours
from odocal_ros.calib.wheels.judge_noise import (
    evidence,
    inverse_root,
    judge_turns,
    log_size_prior,
    NOTHING_LASTS_PRIOR,
    slow_means,
)
from odocal_ros.calib.wheels.leg import C_bv, wheel_factors
from odocal_ros.calib.wheels.model import equations, make_bins, State
from odocal_ros.calib.wheels.noise import walk_root
from odocal_ros.calib.wheels.way import turned
from odocal_ros.nav.dead_reckoning import forward_b
from odocal_ros.nav.rotations import exp_so3

BINS = 12


@cache
def case():
    """Return a leg, its bins and a state off the truth."""
    made = drive(scenario='town', duration=200.0, two_wheels=True, slope=0.05, seed=7,
                 antenna_lever_arm=(1.0, 0.4, 1.2))
    leg = wheel_leg(made.leg(), settings(made, heading_sigma=None))
    variance = leg.covariance_n[:, 0, 0]
    bins = make_bins(leg.t_fix, np.ones(len(leg.t_fix), bool), variance, leg.t_start, leg.t_stop,
                     BINS)
    phi = 1e-2 * np.random.default_rng(1).standard_normal((BINS + 1, 3))
    return leg, bins, State(0.0211, 0.003, 0.02, 0.01, leg.start.position_n, 1.5, 0.1, phi, 0.08,
                            0.02)


def observed(state):
    """Return (N, 3) level residuals and (N,) turn residuals at a state."""
    leg, bins, _ = case()
    eq = equations(leg, bins, state, leg.alignment.t)
    return eq.residual, eq.turn


@pytest.mark.parametrize(('name', 'column', 'turn_column'), [
    ('scale', 0, 0), ('log_ratio', 1, 1), ('heading', 2, None), ('pitch', 3, None),
    ('width', None, 2), ('offset', None, 3), ('latency', 4, None), ('gyro_scale', 5, 4)])
def test_derivatives_are_those_of_the_residuals(name, column, turn_column):
    leg, bins, state = case()
    step = 1e-5

    def moved(sign):
        x = getattr(state, name)
        return replace(state, **{name: x * np.exp(sign * step) if name == 'scale'
                                 else x + sign * step})

    (up, turn_up), (down, turn_down) = observed(moved(1)), observed(moved(-1))
    eq = equations(leg, bins, state, leg.alignment.t)
    if column is not None:      # of the model, so minus that of the residual; the arm left out:
        # 1.6 m of it turn with the heading, against ways of 100 m and more
        by = -(up - down) / (2 * step)
        assert_allclose(eq.by[:, :, column], by, atol=4.0 if column > 1 else 1e-4, rtol=1e-6)
    if turn_column is not None:
        # a turn of the heading is taken for one about the vehicle's upright: slope and tilt, 0.05
        # rad, make 1e-3 of 1.5 m
        assert_allclose(eq.turn_by[:, turn_column], -(turn_up - turn_down) / (2 * step),
                        atol=2e-3 if name == 'gyro_scale' else 1e-5, rtol=1e-6)


@pytest.mark.parametrize('node', [0, 5, BINS])
def test_drift_at_a_node_turns_the_way_about_the_vertical(node):
    leg, bins, state = case()
    leg = replace(leg, lever_b=np.zeros(3))
    state = replace(state, phi=np.zeros((BINS + 1, 3)))
    phi = state.phi.copy()
    phi[node, 2] = 1e-6
    before = equations(leg, bins, state, leg.alignment.t)
    after = equations(leg, bins, replace(state, phi=phi), leg.alignment.t)
    moved = -(after.residual - before.residual) / 1e-6
    way = before.by_phi[:, node]
    # a node is a hat in time, the hat is taken at the middle of epochs of 20 ms: 1 % of a bin of
    # 15 s at its corners, 1e-3 of its way
    assert_allclose(moved[:, :2], np.stack([-way[:, 1], way[:, 0]], -1), atol=0.2)


def test_turned_is_the_matrix_of_the_rotation_vector():
    rng = np.random.default_rng(3)
    phi, v = rng.standard_normal((2, 9, 3))
    assert_allclose(turned(phi, v), np.einsum('nij,nj->ni', exp_so3(phi), v), atol=1e-14)


def test_factors_have_the_mean_and_the_ratio():
    left, right = wheel_factors(0.02, 0.01)
    assert right / left == pytest.approx(np.exp(0.01))
    assert 2 / (1 / left + 1 / right) == pytest.approx(0.02)


def test_vehicle_axes_are_a_rotation_whose_first_is_forward():
    C = C_bv(0.3, 0.1)
    assert_allclose(C @ C.T, np.eye(3), atol=1e-15)
    assert np.linalg.det(C) == pytest.approx(1.0)
    assert_allclose(C[:, 0], forward_b(-0.3, 0.1))


def test_bin_means_of_a_walk_have_the_covariance_of_its_integral():
    moving = np.array([2.0, 0.0, 3.0, 1.0])
    # a Wiener process in pieces of 1 ms, its means over each bin
    whole = walk_root(moving) @ walk_root(moving).T
    n = 1000
    weight = np.zeros((4, n * 4))       # of the increments, in the mean of each bin
    step = np.repeat(moving / n, n)
    for k in range(4):
        weight[k, :k * n] = 1.0
        weight[k, k * n:(k + 1) * n] = 1 - (np.arange(n) + 0.5) / n
    assert_allclose(whole, weight * step @ weight.T, atol=1e-5)


def test_slow_means_are_averages_of_the_correlation():
    begin, end, tau = np.array([0.0, 10.0, 30.0]), np.array([10.0, 18.0, 30.5]), 7.0
    t = [np.linspace(a, b, 2001) for a, b in zip(begin, end, strict=True)]
    expected = [[np.exp(-np.abs(x[:-1, None] / 2 + x[1:, None] / 2 - (y[:-1] + y[1:]) / 2)
                        / tau).mean() for y in t] for x in t]
    assert_allclose(slow_means(begin, end, tau), expected, rtol=1e-5)


def test_evidence_is_the_restricted_likelihood_written_out():
    rng = np.random.default_rng(5)
    X, A, B = rng.standard_normal((12, 2)), rng.standard_normal((12, 12)), rng.standard_normal(
        (12, 12))
    known, shape, r = A @ A.T + np.eye(12), B @ B.T, rng.standard_normal(12)

    def written_out(size):
        V = np.linalg.inv(known + size * shape)
        normal = X.T @ V @ X
        left = r - X @ np.linalg.solve(normal, X.T @ V @ r)
        return -0.5 * (-np.linalg.slogdet(V)[1] + np.linalg.slogdet(normal)[1] + left @ V @ left)

    sizes = np.array([0.0, 0.1, 2.0, 50.0])
    found = evidence(r, X, inverse_root(known), shape, sizes)       # but for ln det known
    expected = np.array([written_out(s) for s in sizes])
    assert_allclose(found - found[0], expected - expected[0])
    assert_allclose(found[0] - expected[0], np.linalg.slogdet(known)[1] / 2)


def turns(slip, count_sigma, seed=2, n=100):
    """Return what is judged of turns of known slip, m/sqrt(s), and rounding, m; believed: 1 mm."""
    rng = np.random.default_rng(seed)
    walk = walk_root(np.full(n, 5.0))
    r = (np.sqrt(2) * slip * walk @ rng.standard_normal(walk.shape[1])
         + count_sigma * rng.standard_normal(n))
    return judge_turns(r, np.ones((n, 1)), 1e-12 * np.eye(n), 1e-6 * np.eye(n), 2 * walk @ walk.T)


def test_slip_is_found_as_large_as_it_is():
    # 99 squared steps: the variance to sqrt(2 / 99), three sigmas 43 %
    assert turns(0.01, 1e-3).slip == pytest.approx(1e-4, rel=0.43)


def test_what_is_believed_of_sizes_is_whole_and_least_far_from_the_usual():
    sizes = np.append(0.0, np.geomspace(1e-5, 0.1, 41))
    p = np.exp(log_size_prior(sizes, 3e-3, 1.5))
    assert p.sum() == pytest.approx(1.0, rel=1e-12)
    assert p[0] == NOTHING_LASTS_PRIOR
    # a log-normal law: a factor e^1.5 off the usual is as likely as e^-1.5, and e^-0.5 of it
    near, low, high = (np.interp(np.log(3e-3) + x, np.log(sizes[1:]), np.log(p[1:]))
                       for x in (0.0, -1.5, 1.5))
    # between grid points 0.23 apart a parabola of curvature 1 / 1.5^2 sags by 0.23^2 / 8 of it
    assert [low - near, high - near] == pytest.approx([-0.5, -0.5], abs=2 * 0.23**2 / 8 / 1.5**2)


@pytest.mark.parametrize('level', [0.3, 1.0, 4.0, 20.0])
def test_rounding_is_found_as_large_as_it_is_and_is_no_slip(level):
    found = turns(0.0, 1e-3 * np.sqrt(level))
    # as above, and half a step of the levels tried, 26 %; the prior, 0.7 wide, draws ln(level) by
    # (0.14 / 0.7)^2 = 4 % of itself
    assert found.counts == pytest.approx(level, rel=0.43 + 0.26 + 0.04 * abs(np.log(level)))
    # a slip that moves the track from bin to bin by a tenth of the rounding would go unseen
    assert 5.0 * 2 * found.slip < 0.01 * level * 1e-6


def test_rounding_of_which_a_drive_says_nothing_is_that_of_independent_rows():
    n, walk = 100, walk_root(np.full(100, 5.0))
    found = judge_turns(np.zeros(n), np.ones((n, 1)), np.eye(n), 1e-12 * np.eye(n), walk @ walk.T)
    assert found.counts == pytest.approx(1.0, rel=1e-2)     # mean of the prior on its levels
    # floats and speeds do not round: nothing to judge
    none = judge_turns(np.zeros(n), np.ones((n, 1)), np.eye(n), np.zeros((n, n)), walk @ walk.T)
    assert none.counts == pytest.approx(1.0)


def test_rounding_at_one_speed_is_not_that_of_independent_rows():
    """The closed form in noise.quantisation, against counts of discs that stand anywhere."""
    n, rng = 60, np.random.default_rng(6)
    m = np.arange(1, 2001)
    for x in (23.0, 23.001, 23.25, 23.381966):
        rolled = x * np.arange(n) + rng.uniform(size=(4000, 1))
        mean = (np.floor(rolled) - rolled).mean(axis=1)
        phasors = np.exp(2j * np.pi * x * np.outer(np.arange(n), m)).mean(axis=0)
        expected = (np.abs(phasors)**2 / (2 * np.pi**2 * m**2)).sum()
        # 4000 draws: the variance to 2.2 %, three sigmas 7 %; harmonics cut: 1 / (2 pi^2 2000)
        assert mean.var() == pytest.approx(expected, rel=0.07, abs=1 / (2 * np.pi**2 * 2000))
    steps = rng.uniform(size=(4000, 1))         # over all speeds: 1 / (12 n)
    rolled = steps * np.arange(n) + rng.uniform(size=(4000, 1))
    mean = (np.floor(rolled) - rolled).mean(axis=1)
    # kurtosis up to n: the variance to sqrt(60 / 4000) = 12 %, three sigmas 37 %
    assert mean.var() == pytest.approx(1 / (12 * n), rel=0.37)


def test_outliers_are_told_from_slow_errors():
    rng = np.random.default_rng(4)
    slow = np.cumsum(0.3 * rng.standard_normal((300, 2)), axis=0)
    residual = slow + rng.standard_normal((300, 2))
    residual[[40, 41, 200]] += 25.0
    keep = near_neighbours(residual, np.ones(300))
    assert set(np.flatnonzero(~keep)) == {40, 41, 200}
