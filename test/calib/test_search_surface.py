# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Criteria of many parameter sets at once, response surface and least squares of the search."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
from planar_legs import DRIVES, on_a_plane, plane, simulated, TRUE
import pytest

from odocal_ros.calib.wheel_search import planar
from odocal_ros.calib.wheel_search.minimisation import (
    fit_surface,
    least_squares,
    minimum_in_box,
    refine,
)
from odocal_ros.calib.wheel_search.parameter_sets import parameter_sets, search_ranges, Space
from odocal_ros.settings.config import WheelsConfig

FREE, HELD = Space(ratio_is_fixed=False), Space(ratio_is_fixed=True)
# on straight drives, left against right is not observable: nothing to compare
TURNING = ['town', 'another town', 'noisy town', 'out and back']
RANGES = search_ranges(WheelsConfig())


def test_distances_equal_those_of_the_source_summed_step_by_step(monkeypatch):
    rng = np.random.default_rng(1)
    steps, yaw = rng.uniform(0.1, 0.3, (40, 2)), np.cumsum(rng.normal(0, 0.2, 40))
    path = np.cumsum(steps * np.exp(1j * yaw)[:, None], axis=0)
    leg = planar.PlanarLeg(np.arange(40.0), plane(path[:, 0]), plane(path[:, 1]),
                    rng.normal(0.0, 3.0, (40, 2)), np.array([5.0, -3.0]), np.ones(40), 1.0, 1.0)
    sets, d = np.array([[1.0, 1.0, 0.0], [1.1, 0.9, 0.4], [0.9, 1.0, -2.0]]), np.empty((3, 40))
    for k, (a, b, h) in enumerate(sets):
        x, y = leg.start_n
        for n in range(40):
            ds = (a * steps[n, 0] + b * steps[n, 1]) / 2      # equation (ii)
            x, y = x + ds * np.cos(yaw[n] + h), y + ds * np.sin(yaw[n] + h)     # (i)
            d[k, n] = np.hypot(x - leg.fixes_n[n, 0], y - leg.fixes_n[n, 1])
    whole = planar.score(leg, sets)
    monkeypatch.setattr(planar, 'CHUNK', len(leg.t))
    for found in (whole, planar.score(leg, sets)):
        assert_allclose(found.max, d.max(axis=1), rtol=1e-12)
        assert_allclose(found.mean, d.mean(axis=1), rtol=1e-12)
        assert_allclose(found.rms, np.sqrt((d**2).mean(axis=1)), rtol=1e-12)
        assert_allclose(found.loss, (d**2).mean(axis=1), rtol=1e-12)


def test_only_the_true_set_fits_perfect_fixes():
    made, leg = simulated(scenario='town', duration=300.0, two_wheels=True, odometer='angle',
                          imu_grade='perfect', fix_sigma=0.0, yaw=0.0, odometer_rate=50.0,
                          antenna_lever_arm=(1.0, 0.3, 1.5), pitch=0.0)
    true = np.array([[*made.truth.wheel_scales, 0.0]])
    # trapezoid rule over 20 ms; 20 ms rows with linear travel between: acceleration * dt^2 / 8
    # at each of fewer than 50 changes of acceleration, and turns of 0.4 rad/s at 12 m/s
    assert planar.score(leg, true).max[0] < 0.02
    assert planar.score(leg, leg.start).max[0] > 1.0
    without = replace(leg, lever_n=np.zeros((1, 2)))
    assert planar.score(without, true).max[0] > 0.5


def test_fixes_beyond_the_tracks_are_left_out():
    made, leg = simulated(**DRIVES['straight'])
    between = made.fix.stamp_ns >= made.truth.start_ns
    assert leg.t[0] >= 0.0
    assert len(leg.t) <= between.sum() < len(made.fix.stamp_ns)


def test_course_difference_equals_the_rotation_of_the_track():
    leg = on_a_plane(sigma=0.0)
    off = np.deg2rad([0.0, 3.0, -20.0])
    found = planar.score(leg, TRUE + off[:, None] * [0.0, 0.0, 1.0])
    assert_allclose(found.course_mean, off, atol=1e-12)
    assert_allclose(found.course_rms, np.abs(off), atol=1e-12)
    assert planar.score(leg, TRUE + [0.0, 0.0, 2 * np.pi]).course_rms[0] < 1e-12
    half_turned = planar.score(leg, TRUE + [0.0, 0.0, np.pi - 1e-9])
    assert abs(half_turned.course_mean[0]) == pytest.approx(np.pi)
    assert half_turned.course_rms[0] == pytest.approx(np.pi)
    still = replace(leg, pieces=planar.course_pieces(np.zeros((50, 2)), np.ones(50)))
    assert planar.score(still, TRUE).row(0)['course_mean_deg'] is None


def test_course_uses_a_path_length_that_fixes_can_resolve():
    line = np.stack([np.arange(0.0, 400.0), np.zeros(400)], -1)
    assert np.diff(planar.course_pieces(line, np.full(400, 0.02))).tolist() == [[10]] * 39
    assert np.diff(planar.course_pieces(line, np.full(400, 1.5))).tolist() == [[30]] * 13
    assert planar.course_pieces(line[:0], np.empty(0)).shape == (0, 2)


def test_weights_are_those_of_the_huber_loss():
    d2, sigma = np.array([0.0, 1.0, 8.9, 9.1, 400.0]), np.array([1.0, 2.0, 1.5, 1.5, 0.5])
    step = 1e-6
    for robust in (False, True):
        for k in range(len(d2)):
            more = d2 + step * (np.arange(5) == k)
            (rise,) = np.diff([planar.loss(x[None], sigma, robust)[0] for x in (d2, more)]) / step
            assert rise * 5 == pytest.approx(planar.weights(d2, sigma, robust)[k], rel=1e-4)
    # beyond HUBER sigmas the influence, weight times distance, is constant
    far = planar.weights(np.array([1e2, 1e4]), np.ones(2), True) * [10.0, 100.0]
    assert_allclose(far, planar.HUBER)


def test_quadratic_is_fitted_exactly_and_a_cubic_shows_as_lack_of_fit():
    rng = np.random.default_rng(4)
    H, g = rng.normal(size=(3, 3)), rng.normal(size=3)
    H = H + H.T
    y = np.stack([a.ravel() for a in np.meshgrid(*[[-1.0, 0.0, 1.0]] * 3)], -1)
    values = 7.0 + y @ g + np.einsum('mi,ij,mj->m', y, H, y) / 2
    fit = fit_surface(y, values)
    assert_allclose(fit.hessian, H, atol=1e-13)
    assert_allclose(fit.gradient, g, atol=1e-13)
    assert fit.value == pytest.approx(7.0)
    assert fit.r_squared == pytest.approx(1.0)
    assert fit.lack_of_fit < 1e-14
    cubic = fit_surface(y, values + y[:, 0] * y[:, 1] * y[:, 2])
    assert cubic.lack_of_fit == pytest.approx(1.0 / np.ptp(values + y.prod(axis=1)))
    assert cubic.r_squared < 1.0


@pytest.mark.parametrize('definite', [True, False])
def test_minimum_in_a_box_is_the_least_value_there(definite):
    rng = np.random.default_rng(5)
    grid = np.stack([a.ravel() for a in np.meshgrid(*[np.linspace(0, 1, 21)] * 3)], -1)
    for _ in range(50):
        A, g = rng.normal(size=(3, 3)), 2 * rng.normal(size=3)
        H = A @ A.T if definite else A + A.T
        low = rng.uniform(-2.0, 0.0, 3)
        high = low + rng.uniform(0.1, 3.0, 3)
        found = minimum_in_box(g, H, low, high)
        assert ((low <= found) & (found <= high)).all()
        y = low + grid * (high - low)
        values = y @ g + np.einsum('mi,ij,mj->m', y, H, y) / 2
        assert g @ found + found @ H @ found / 2 <= values.min() + 1e-12


@pytest.mark.parametrize(('name', 'space'), [(name, HELD) for name in DRIVES] + [
    (name, FREE) for name in TURNING], ids=lambda x: x if isinstance(x, str) else (
        'together' if x.ratio_is_fixed else 'free'))
@pytest.mark.parametrize('robust', [False, True], ids=['plain', 'robust'])
def test_surface_and_least_squares_agree(name, space, robust):
    _, leg = simulated(**DRIVES[name])
    direct = least_squares(leg, np.zeros(3), space, robust)
    assert direct.converged

    def surface_of(x, half, robust):
        return refine(
            lambda x: planar.score(leg, parameter_sets(leg, x), robust, course=False).loss, x,
            replace(RANGES, half_range=half).step, half, space)

    begin = surface_of(np.zeros(3), RANGES.half_range, False)
    found = surface_of(begin.x, begin.half_range, robust)
    assert found.converged
    assert not found.on_edge
    assert (np.abs(found.x - direct.x) <= 1e-4 * 2 * RANGES.half_range).all()
    # kinks of the Huber function within a box over which it changes by 1e-6 (DROWNED)
    assert found.value == pytest.approx(direct.value, rel=1e-5 if robust else 1e-9)


@pytest.mark.parametrize('space', [FREE, HELD], ids=['free', 'together'])
@pytest.mark.parametrize('beyond', [0.051, 0.06, 0.3])
def test_range_is_kept_if_it_may_not_be_widened(space, beyond):
    def cone(x):       # a ridge between wheels that differ, with its peak outside the range
        return np.abs(x[:, 0] - beyond) + 3 * np.abs(x[:, 1] - beyond) + np.abs(x[:, 2])**0.5
    found = refine(cone, np.array([0.03, 0.02, 0.01]), RANGES.step, RANGES.half_range, space,
                   widen=False)
    assert (np.abs(found.x) <= RANGES.half_range * (1 + 1e-12)).all()
    assert not found.widened
