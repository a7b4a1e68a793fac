# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The wheels' search: many sets at once, criteria, response surface, least squares, embodiment."""

from dataclasses import replace
import json

from drives import cached, drive
import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.calib.wheel_search import planar
from odocal_ros.calib.wheel_search.direct import least_squares, repeats
from odocal_ros.calib.wheel_search.planar import (
    course_pieces,
    HUBER,
    loss,
    planar_leg,
    PlanarLeg,
    positions,
    score,
    weights,
)
from odocal_ros.calib.wheel_search.search import MOST_ROWS, search
from odocal_ros.calib.wheel_search.space import Ranges, ranges_of, sets_of, Space
from odocal_ros.calib.wheel_search.surface import fit_surface, minimum_in_box, refine
from odocal_ros.nav.dead_reckoning import dead_reckon
from odocal_ros.pipeline.prepare import prepare
from odocal_ros.reasons import Code
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config, WheelsConfig, with_settings

FREE, HELD = Space(held=False), Space(held=True)
RTK = {'fix_noise': 'rtk', 'imu_grade': 'tactical', 'two_wheels': True}
DRIVES = {
    'town': RTK | {'scenario': 'town', 'duration': 300.0},
    'another town': RTK | {'scenario': 'town', 'duration': 400.0, 'seed': 3},
    'noisy town': {'scenario': 'town', 'two_wheels': True, 'duration': 300.0, 'outliers': 0.02},
    'out and back': RTK | {'scenario': 'out_and_back', 'duration': 400.0},
    'straight': {'scenario': 'straight', 'two_wheels': True, 'duration': 400.0},
    'paper': {'scenario': 'paper', 'two_wheels': True, 'odometer': 'angle'}}
# on the straight ones positions are blind to left against right: nothing to agree on
TURNING = ['town', 'another town', 'noisy town', 'out and back']
TRUE = np.array([0.99, 1.015, 0.03])       # of the drives on a plane
RANGES = ranges_of(WheelsConfig())


@cached
def simulated(heading_error=0.0, **options):
    """Return a simulated drive and its planar leg, heading given wrong by an angle from north."""
    made = drive(**options)
    scale, pitch = made.options.nominal_scale, made.options.pitch
    grade = made.options.imu_grade
    config = with_settings(Config(), {
        'imu.grade': 'navigation' if grade == 'perfect' else grade,
        'alignment.heading_source': 'fixed',
        'alignment.heading': float(made.truth.heading + heading_error)})
    inputs, _ = screen(made.leg(), config)
    found, _ = prepare(made.leg(), inputs, config)
    left, right = (dead_reckon(*found.epochs, s) for s in inputs.travels)
    start = found.fixes_n[inputs.t_fix < 0.0].mean(axis=0)
    lever_v = np.subtract(made.options.antenna_lever_arm, made.options.odometer_lever_arm)
    return made, planar_leg(left, right, inputs.t_fix, found.fixes_n, inputs.covariance_n,
                            (0.0, start), (scale, scale), pitch, lever_v)


def on_a_plane(lanes=8, sigma=0.02, seed=0, length=15.0, k=600):
    """
    Return a robot's leg up and down a lawn: (K_L L + K_R R) / 2 turned by the heading, and noise.

    Not in circles: on a circle left and right differ by a multiple of the position itself.
    """
    way = np.linspace(0.0, lanes * (length + 3.0), 20 * k + 1)
    lane, along = np.divmod(way, length + 3.0)
    turned = np.pi * np.clip((along - length) / 3.0, 0.0, 1.0)       # half turns, left and right
    yaw = np.where(lane % 2 == 0, turned, np.pi - turned)
    ds, dyaw = np.diff(way), np.diff(yaw)
    direction = np.exp(1j * (yaw[1:] + yaw[:-1]) / 2)
    left = np.cumsum((ds - 0.5 * dyaw) / TRUE[0] * direction)[::20]
    right = np.cumsum((ds + 0.5 * dyaw) / TRUE[1] * direction)[::20]
    fixes = np.exp(1j * TRUE[2]) * (TRUE[0] * left + TRUE[1] * right) / 2
    noise = np.random.default_rng(seed).normal(0.0, sigma, (len(fixes), 2))
    p = plane(fixes) + noise
    sigmas = np.full(len(fixes), max(sigma, 1e-3))
    return PlanarLeg(np.arange(len(fixes)) / 5.0, plane(left), plane(right), p, np.zeros(2),
                     sigmas, 1.0, 1.0, pieces=course_pieces(p, sigmas))


def plane(p):
    return np.stack([p.real, p.imag], -1)


def surface_of(leg, x, ranges, space, robust=False):
    return refine(lambda x: score(leg, sets_of(leg, x), robust, course=False).loss, x,
                  ranges.step, ranges.half, space)


# dead reckoning and criteria


def test_positions_are_those_of_the_source_summed_step_by_step():
    rng = np.random.default_rng(1)
    steps, yaw = rng.uniform(0.1, 0.3, (40, 2)), np.cumsum(rng.normal(0, 0.2, 40))
    way = np.cumsum(steps * np.exp(1j * yaw)[:, None], axis=0)
    leg = PlanarLeg(np.arange(40.0), plane(way[:, 0]), plane(way[:, 1]), np.zeros((40, 2)),
                    np.array([5.0, -3.0]), np.ones(40), 1.0, 1.0)
    sets = np.array([[1.0, 1.0, 0.0], [1.1, 0.9, 0.4]])
    found = positions(leg, sets)
    for k, (a, b, h) in enumerate(sets):
        x, y = leg.start_n
        for n in range(40):
            ds = (a * steps[n, 0] + b * steps[n, 1]) / 2      # equation (ii)
            x, y = x + ds * np.cos(yaw[n] + h), y + ds * np.sin(yaw[n] + h)     # (i)
            assert_allclose(found[k, n], [x, y], atol=1e-13)


def test_the_true_set_meets_perfect_fixes_and_only_it():
    made, leg = simulated(scenario='town', duration=300.0, two_wheels=True, odometer='angle',
                          imu_grade='perfect', fix_sigma=0.0, yaw=0.0, odometer_rate=50.0,
                          antenna_lever_arm=(1.0, 0.3, 1.5), pitch=0.0)
    true = np.array([[*made.truth.wheel_scales, 0.0]])
    # trapezoid over 20 ms, 20 ms rows between which travel is linear: acceleration * dt^2 / 8
    # at each of fewer than 50 places where it changes, and turns of 0.4 rad/s on 12 m/s
    assert score(leg, true).max[0] < 0.02
    assert score(leg, leg.start).max[0] > 1.0
    without = replace(leg, lever_n=np.zeros((1, 2)))
    assert score(without, true).max[0] > 0.5


def test_distances_are_those_of_positions_however_they_are_chunked(monkeypatch):
    _, leg = simulated(**DRIVES['town'])
    sets = leg.start + np.random.default_rng(3).normal(0.0, [1e-3, 1e-3, 1.0], (23, 3))
    d = np.hypot(*np.moveaxis(positions(leg, sets) - leg.fixes_n, -1, 0))
    whole = score(leg, sets)
    monkeypatch.setattr(planar, 'CHUNK', 3 * len(leg.t))
    parts = score(leg, sets)
    for found in (whole, parts):
        # 2 km tracks: rounding of some 1e-12 m in each distance
        assert_allclose(found.max, d.max(axis=1), rtol=1e-12)
        assert_allclose(found.mean, d.mean(axis=1), rtol=1e-12)
        assert_allclose(found.rms, np.sqrt((d**2).mean(axis=1)), rtol=1e-12)
        assert_allclose(found.loss, (d**2).mean(axis=1), rtol=1e-12)


def test_fixes_beyond_the_tracks_are_left_out():
    made, leg = simulated(**DRIVES['straight'])
    between = made.fix.stamp_ns >= made.truth.start_ns
    assert leg.t[0] >= 0.0
    assert len(leg.t) <= between.sum() < len(made.fix.stamp_ns)


def test_course_differs_by_what_the_track_is_turned_by():
    leg = on_a_plane(sigma=0.0)
    off = np.deg2rad([0.0, 3.0, -20.0])
    found = score(leg, TRUE + off[:, None] * [0.0, 0.0, 1.0])
    assert_allclose(found.course_mean, off, atol=1e-12)
    assert_allclose(found.course_rms, np.abs(off), atol=1e-12)
    assert score(leg, TRUE + [0.0, 0.0, 2 * np.pi]).course_rms[0] < 1e-12
    half_turned = score(leg, TRUE + [0.0, 0.0, np.pi - 1e-9])
    assert abs(half_turned.course_mean[0]) == pytest.approx(np.pi)
    assert half_turned.course_rms[0] == pytest.approx(np.pi)
    still = replace(leg, pieces=course_pieces(np.zeros((50, 2)), np.ones(50)))
    assert score(still, TRUE).row(0)['course_mean_deg'] is None


def test_course_is_taken_over_a_way_that_fixes_can_tell():
    line = np.stack([np.arange(0.0, 400.0), np.zeros(400)], -1)
    assert np.diff(course_pieces(line, np.full(400, 0.02))).tolist() == [[10]] * 39
    assert np.diff(course_pieces(line, np.full(400, 1.5))).tolist() == [[30]] * 13
    assert course_pieces(line[:0], np.empty(0)).shape == (0, 2)


def test_hubers_loss_and_its_weights_belong_together():
    d2, sigma = np.array([0.0, 1.0, 8.9, 9.1, 400.0]), np.array([1.0, 2.0, 1.5, 1.5, 0.5])
    step = 1e-6
    for robust in (False, True):
        for k in range(len(d2)):
            more = d2 + step * (np.arange(5) == k)
            rise = (loss(more[None], sigma, robust) - loss(d2[None], sigma, robust))[0] / step
            assert rise * 5 == pytest.approx(weights(d2, sigma, robust)[k], rel=1e-4)
    # beyond HUBER sigmas the pull, weight times distance, no longer grows
    far = weights(np.array([1e2, 1e4]), np.ones(2), True) * [10.0, 100.0]
    assert_allclose(far, HUBER)


# the surface


def test_a_quadratic_is_fitted_exactly_and_a_cubic_shows_as_lack_of_fit():
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
    bent = fit_surface(y, values + y[:, 0] * y[:, 1] * y[:, 2])
    assert bent.lack_of_fit == pytest.approx(1.0 / np.ptp(values + y.prod(axis=1)))
    assert bent.r_squared < 1.0


@pytest.mark.parametrize('definite', [True, False])
def test_the_minimum_in_a_box_is_the_least_value_there(definite):
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
        'together' if x.held else 'free'))
@pytest.mark.parametrize('robust', [False, True], ids=['plain', 'robust'])
def test_surface_and_least_squares_agree(name, space, robust):
    _, leg = simulated(**DRIVES[name])
    direct = least_squares(leg, np.zeros(3), space, robust)
    assert direct.settled
    begin = surface_of(leg, np.zeros(3), RANGES, space)
    found = surface_of(leg, begin.x, replace(RANGES, half=begin.half), space, robust)
    assert found.settled
    assert not found.on_edge
    assert (np.abs(found.x - direct.x) <= 1e-4 * 2 * RANGES.half).all()
    # kinks of Huber's function within a box over which it changes by 1e-6 (DROWNED)
    assert found.value == pytest.approx(direct.value, rel=1e-5 if robust else 1e-9)


@pytest.mark.parametrize('criterion', ['mean', 'max'])
def test_a_surface_lowers_the_other_criteria_too(criterion):
    leg = on_a_plane(sigma=0.05)
    def value(x):
        return getattr(score(leg, sets_of(leg, x), course=False), criterion)
    found = refine(value, np.zeros(3), RANGES.step, RANGES.half, FREE)
    direct = least_squares(leg, np.zeros(3), FREE)
    assert found.value <= value(direct.x[None])[0]
    # both have kinks and a long valley along left against right: 5 cm noise over some 10 m
    assert found.x[:2].mean() == pytest.approx(TRUE[:2].mean() - 1, abs=0.005)
    assert found.x[2] == pytest.approx(TRUE[2], abs=0.005)


@pytest.mark.parametrize('space', [FREE, HELD], ids=['free', 'together'])
@pytest.mark.parametrize('beyond', [0.051, 0.06, 0.3])
def test_the_range_is_kept_where_it_may_not_be_widened(space, beyond):
    def cone(x):       # a ridge between wheels that differ, its tip outside the range
        return np.abs(x[:, 0] - beyond) + 3 * np.abs(x[:, 1] - beyond) + np.abs(x[:, 2])**0.5
    found = refine(cone, np.array([0.03, 0.02, 0.01]), RANGES.step, RANGES.half, space,
                   widen=False)
    assert (np.abs(found.x) <= RANGES.half * (1 + 1e-12)).all()
    assert not found.widened


# the whole search


@pytest.mark.parametrize('name', ['town', 'out and back', 'straight', 'paper'])
def test_cars_move_left_and_right_together_and_say_why(name):
    made, leg = simulated(**DRIVES[name])
    found = search(leg, RANGES)
    assert found.held
    ratio = found.refined_set[1] / found.refined_set[0]
    assert ratio == pytest.approx(leg.scale_right / leg.scale_left, rel=1e-12)
    codes = {r.code for r in found.reasons}
    assert Code.WHEELS_NOT_SEPARABLE in codes
    assert Code.SEARCH_NOT_SETTLED not in codes
    assert found.free.correlation[0, 1] < -0.999
    assert found.free.condition > 1000
    # the mean is what two wheels count together: their harmonic mean; start and end fixes of
    # 1.5 m (straight: averaged at rest) or 2 cm over 2 to 11 km, gyro drift 1e-4 and less
    mean = found.refined_set[:2].mean()
    assert mean == pytest.approx(made.truth.scale, rel=6e-4)
    assert found.after.rms[0] < 0.1 * found.before.rms[0]


def test_a_small_lawn_tells_left_from_right():
    leg = on_a_plane()
    found = search(leg, RANGES)
    assert not found.held
    assert found.reasons == ()
    z = (found.refined_set - TRUE) / found.free.sigma
    assert (np.abs(z) < 4).all()
    assert found.best == np.argmin(found.scores.mean)
    assert len(found.sets) == 49
    assert found.after.rms[0] <= found.scores.rms.min()
    assert_allclose(found.refined_set, found.direct_set, atol=1e-5)
    # levels are equal steps, with zero among them
    for k, half in enumerate(RANGES.half):
        x = np.unique(np.round((found.sets[:, k] - (k < 2)), 12))
        assert_allclose(x, np.linspace(-half, half, 7), atol=1e-11)
    assert set(search(leg, Ranges(RANGES.half, RANGES.why, 1)).sets[:, 0]) == {1.0}
    # the accuracy asked for is held against the best row
    reach = found.scores.max[found.best], found.scores.mean[found.best]
    assert found.meets is None
    for more, meets in ((1e-9, True), (-1e-9, False)):
        assert search(leg, RANGES, accuracy=(reach[0] + 1e-9, reach[1] + more)).meets is meets


def test_the_range_is_widened_where_the_minimum_lies_on_its_edge():
    leg = on_a_plane()
    far = replace(leg, scale_left=1.3, scale_right=1.3, left_n=leg.left_n @ turned(-60.0),
                  right_n=leg.right_n @ turned(-60.0))
    found = search(far, RANGES)
    widened = next(r for r in found.reasons if r.code is Code.SEARCH_WIDENED)
    assert 'left ± 5 % to ± 40 %' in widened.text
    assert 'heading ± 10 deg to ± 80 deg' in widened.text
    assert_allclose(found.refined_set - [0.0, 0.0, np.deg2rad(60.0)], TRUE, atol=0.01)


def turned(degrees):
    """Return the matrix that turns rows counter-clockwise."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, s], [-s, c]])


@pytest.mark.parametrize('heading', [100.0, 179.0, -179.0])
def test_a_heading_that_nobody_knows_is_found(heading):
    leg = on_a_plane()
    away = replace(leg, left_n=leg.left_n @ turned(-heading),
                   right_n=leg.right_n @ turned(-heading))
    found = search(away, ranges_of(WheelsConfig(heading_range=np.pi)))
    off = found.refined_set[2] - TRUE[2] - np.deg2rad(heading)
    assert np.angle(np.exp(1j * off)) == pytest.approx(0.0, abs=1e-3)
    assert abs(found.refined_set[2]) <= np.pi


def test_a_search_without_end_ends_and_says_so():
    leg = on_a_plane()
    found = search(replace(leg, scale_left=0.4, scale_right=0.4), RANGES)
    said = {r.code: r.text for r in found.reasons}
    assert 'widest range' in said[Code.SEARCH_NOT_SETTLED]
    assert found.refined.on_edge
    assert_allclose(found.refined.half[:2], 0.9)
    nothing = replace(leg, left_n=0 * leg.left_n, right_n=0 * leg.right_n)
    blind = search(nothing, RANGES)
    assert blind.held
    assert json.loads(json.dumps(blind.as_dict(), allow_nan=False))['condition_number'] is None
    assert search(replace(leg, t=leg.t[:3], left_n=leg.left_n[:3], right_n=leg.right_n[:3],
                          fixes_n=leg.fixes_n[:3], sigma=leg.sigma[:3]), RANGES) is None


def test_robust_is_not_moved_by_outliers():
    leg = on_a_plane()
    fixes = leg.fixes_n.copy()
    fixes[::20] += [15.0, 5.0]
    hit = replace(leg, fixes_n=fixes)
    plain, robust = (search(hit, RANGES, robust=r) for r in (False, True))
    off = [np.abs(f.refined_set - TRUE)[[0, 1]].mean() for f in (plain, robust)]
    assert off[1] < 0.2 * off[0]


@pytest.mark.parametrize('levels', [2, 7, 15])
def test_what_goes_into_json_is_finite_and_short(levels):
    _, leg = simulated(**DRIVES['straight'])
    found = search(leg, ranges_of(WheelsConfig(levels=levels)))
    entry = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert entry['array']['rows'] == len(found.sets) == {2: 8, 7: 49, 15: 289}[levels]
    assert len(entry['array']['shown']) == min(MOST_ROWS, len(found.sets))
    assert entry['best_row'] in entry['array']['shown']
    assert entry['before']['mean'] > entry['after']['mean']
    assert entry['left_and_right_held_together'] is True


def test_ranges_follow_the_settings():
    assert_allclose(RANGES.half, [0.05, 0.05, np.deg2rad(10.0)])
    assert RANGES.levels == 7
    asked = ranges_of(WheelsConfig(radius_range=0.1, heading_range=0.2, levels=4))
    assert_allclose(asked.half, [0.1, 0.1, 0.2])
    assert asked.levels == 5            # zero is a level
    assert_allclose(ranges_of(WheelsConfig(), heading_sigma=0.01).half[2], 0.02)
    assert ranges_of(WheelsConfig(), heading_sigma=3.0).half[2] == np.pi
    assert ranges_of(WheelsConfig(levels=2)).levels == 2


# honesty


def test_the_formal_sigma_holds_for_white_fixes():
    runs = 300
    z = []
    for seed in range(runs):
        found = least_squares(on_a_plane(seed=seed, k=200), np.zeros(3), FREE)
        z.append((1 + found.x[:2] - TRUE[:2]) / found.sigma[:2])
    z = np.array(z)
    assert (np.abs(z.mean(axis=0)) < 4 / runs**0.5).all()
    # repeats() counts chance likeness of white residuals, so sigmas are wide rather than narrow
    assert (z.var(axis=0) < 1 + 4 * (2 / runs)**0.5).all()
    assert (z.var(axis=0) > 0.6).all()


def test_the_mean_of_both_wheels_is_known_where_their_difference_is_not():
    _, leg = simulated(**DRIVES['straight'])
    free, held = (least_squares(leg, np.zeros(3), space) for space in (FREE, HELD))
    mean = np.array([0.5, 0.5, 0.0])
    assert held.sigma[0] == held.sigma[1]
    assert held.correlation[0, 1] == pytest.approx(1.0)
    # the same straight line, fitted with and without a third parameter that it does not see
    assert held.sigma[0] < 0.01 * free.sigma[0]
    assert held.sigma[0] <= np.sqrt(mean @ free.covariance @ mean) * 1.01
    assert held.condition < 10 < free.condition


def test_residuals_alike_in_a_row_count_as_fewer():
    rng = np.random.default_rng(6)
    white = rng.normal(size=(2, 20000))
    assert repeats(white) == pytest.approx(1.0, abs=0.1)
    slow = np.empty_like(white)
    slow[:, 0] = 0.0
    for k in range(1, white.shape[1]):
        slow[:, k] = 0.9 * slow[:, k - 1] + white[:, k]
    assert repeats(slow) == pytest.approx(1.9 / 0.1, rel=0.3)      # (1 + r) / (1 - r)
    assert repeats(np.zeros((2, 5))) == 1.0
