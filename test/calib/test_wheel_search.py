# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The wheel search: separable wheels, ranges, sigmas, details, orthogonal parameter_sets."""

from dataclasses import replace
from itertools import combinations
import json

import numpy as np
from numpy.testing import assert_allclose
from planar_legs import DRIVES, on_a_plane, simulated, TRUE
import pytest

from odocal_ros.calib.wheel_search import parameter_sets
from odocal_ros.calib.wheel_search.minimisation import least_squares
from odocal_ros.calib.wheel_search.parameter_sets import Ranges, search_ranges, Space
from odocal_ros.calib.wheel_search.planar import inflation
from odocal_ros.calib.wheel_search.search import MAX_ROWS, search
from odocal_ros.errors import BadUsage
from odocal_ros.reasons import Code
from odocal_ros.settings.config import WheelsConfig

FREE, HELD = Space(ratio_is_fixed=False), Space(ratio_is_fixed=True)
RANGES = search_ranges(WheelsConfig())


@pytest.mark.parametrize('name', ['town', 'out and back', 'straight', 'paper'])
def test_left_and_right_scales_of_cars_move_together_with_a_reason(name):
    made, leg = simulated(**DRIVES[name])
    found = search(leg, RANGES)
    assert found.ratio_is_fixed
    ratio = found.surface_set[1] / found.surface_set[0]
    assert ratio == pytest.approx(leg.scale_right / leg.scale_left, rel=1e-12)
    codes = {r.code for r in found.reasons}
    assert Code.WHEELS_NOT_SEPARABLE in codes
    assert Code.SEARCH_NOT_SETTLED not in codes
    assert found.free_minimum.correlation[0, 1] < -0.999
    assert found.free_minimum.condition > 1000
    # the mean is the harmonic mean of both counters; start and end fixes of
    # 1.5 m (straight: averaged at rest) or 2 cm over 2 to 11 km, gyro drift 1e-4 and less
    mean = found.surface_set[:2].mean()
    assert mean == pytest.approx(made.truth.scale, rel=6e-4)
    assert found.surface_scores.rms[0] < 0.1 * found.start_scores.rms[0]


def test_small_lawn_separates_left_and_right():
    leg = on_a_plane()
    found = search(leg, RANGES)
    assert not found.ratio_is_fixed
    assert found.reasons == ()
    z = (found.surface_set - TRUE) / found.free_minimum.sigma
    assert (np.abs(z) < 4).all()
    assert found.best == np.argmin(found.scores.mean)
    assert len(found.sets) == 49
    assert found.surface_scores.rms[0] <= found.scores.rms.min()
    assert_allclose(found.surface_set, found.squares_set, atol=1e-5)
    # levels have equal steps and include zero
    for k, half in enumerate(RANGES.half_range):
        x = np.unique(np.round((found.sets[:, k] - (k < 2)), 12))
        assert_allclose(x, np.linspace(-half, half, 7), atol=1e-11)
    assert set(search(leg, Ranges(RANGES.half_range, RANGES.sources, 1)).sets[:, 0]) == {1.0}


def test_range_is_widened_if_the_minimum_is_on_its_edge():
    leg = on_a_plane()
    far = replace(leg, scale_left=1.3, scale_right=1.3, left_n=leg.left_n @ turned(-60.0),
                  right_n=leg.right_n @ turned(-60.0))
    found = search(far, RANGES)
    widened = next(r for r in found.reasons if r.code is Code.SEARCH_WIDENED)
    assert 'left ± 5 % to ± 40 %' in widened.text
    assert 'heading ± 10 deg to ± 80 deg' in widened.text
    assert_allclose(found.surface_set - [0.0, 0.0, np.deg2rad(60.0)], TRUE, atol=0.01)


def turned(degrees):
    """Return the matrix that turns rows counter-clockwise."""
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, s], [-s, c]])


@pytest.mark.parametrize('heading', [100.0, 179.0, -179.0])
def test_unknown_heading_is_found(heading):
    leg = on_a_plane()
    away = replace(leg, left_n=leg.left_n @ turned(-heading),
                   right_n=leg.right_n @ turned(-heading))
    found = search(away, search_ranges(WheelsConfig(heading_range=np.pi)))
    off = found.surface_set[2] - TRUE[2] - np.deg2rad(heading)
    assert np.angle(np.exp(1j * off)) == pytest.approx(0.0, abs=1e-3)
    assert abs(found.surface_set[2]) <= np.pi


def test_search_without_convergence_stops_and_is_reported():
    leg = on_a_plane()
    found = search(replace(leg, scale_left=0.4, scale_right=0.4), RANGES)
    texts = {r.code: r.text for r in found.reasons}
    assert 'widest range' in texts[Code.SEARCH_NOT_SETTLED]
    assert found.surface_minimum.on_edge
    assert_allclose(found.surface_minimum.half_range[:2], 0.9)
    nothing = replace(leg, left_n=0 * leg.left_n, right_n=0 * leg.right_n)
    blind = search(nothing, RANGES)
    assert blind.ratio_is_fixed
    assert json.loads(json.dumps(blind.as_dict(), allow_nan=False))['condition_number'] is None
    assert search(replace(leg, t=leg.t[:3], left_n=leg.left_n[:3], right_n=leg.right_n[:3],
                          fixes_n=leg.fixes_n[:3], sigma=leg.sigma[:3]), RANGES) is None


def test_robust_fit_is_not_shifted_by_outliers():
    leg = on_a_plane()
    fixes = leg.fixes_n.copy()
    fixes[::20] += [15.0, 5.0]
    hit = replace(leg, fixes_n=fixes)
    plain, robust = (search(hit, RANGES, robust=r) for r in (False, True))
    off = [np.abs(f.surface_set - TRUE)[[0, 1]].mean() for f in (plain, robust)]
    assert off[1] < 0.2 * off[0]


@pytest.mark.parametrize('levels', [2, 7, 15])
def test_values_for_json_are_finite_and_short(levels):
    _, leg = simulated(**DRIVES['straight'])
    found = search(leg, search_ranges(WheelsConfig(levels=levels)))
    entry = json.loads(json.dumps(found.as_dict(), allow_nan=False))
    assert entry['array']['rows'] == len(found.sets) == {2: 8, 7: 49, 15: 289}[levels]
    assert len(entry['array']['shown']) == min(MAX_ROWS, len(found.sets))
    assert entry['best_row'] in entry['array']['shown']
    assert entry['before']['mean'] > entry['after']['mean']
    assert entry['left_and_right_held_together'] is True


def test_ranges_follow_the_settings():
    assert_allclose(RANGES.half_range, [0.05, 0.05, np.deg2rad(10.0)])
    assert RANGES.levels == 7
    required = search_ranges(WheelsConfig(radius_range=0.1, heading_range=0.2, levels=4))
    assert_allclose(required.half_range, [0.1, 0.1, 0.2])
    assert required.levels == 5            # zero is a level
    assert_allclose(search_ranges(WheelsConfig(), heading_sigma=0.01).half_range[2], 0.02)
    assert search_ranges(WheelsConfig(), heading_sigma=3.0).half_range[2] == np.pi
    assert search_ranges(WheelsConfig(levels=2)).levels == 2


def test_formal_sigma_holds_for_white_fixes():
    runs = 300
    z = []
    for seed in range(runs):
        found = least_squares(on_a_plane(seed=seed, k=200), np.zeros(3), FREE)
        z.append((1 + found.x[:2] - TRUE[:2]) / found.sigma[:2])
    z = np.array(z)
    assert (np.abs(z.mean(axis=0)) < 4 / runs**0.5).all()
    # inflation() includes chance correlation of white residuals: sigmas are rather too wide
    assert (z.var(axis=0) < 1 + 4 * (2 / runs)**0.5).all()
    assert (z.var(axis=0) > 0.6).all()


def test_mean_of_both_wheels_is_observable_without_their_difference():
    _, leg = simulated(**DRIVES['straight'])
    free, held = (least_squares(leg, np.zeros(3), space) for space in (FREE, HELD))
    mean = np.array([0.5, 0.5, 0.0])
    assert held.sigma[0] == held.sigma[1]
    assert held.correlation[0, 1] == pytest.approx(1.0)
    # the same straight line, with and without a third parameter that is not observable
    assert held.sigma[0] < 0.01 * free.sigma[0]
    assert held.sigma[0] <= np.sqrt(mean @ free.covariance @ mean) * 1.01
    assert held.condition < 10 < free.condition


def test_correlated_residuals_count_as_fewer():
    rng = np.random.default_rng(6)
    white = rng.normal(size=(2, 20000))
    assert inflation(white) == pytest.approx(1.0, abs=0.1)
    slow = np.empty_like(white)
    slow[:, 0] = 0.0
    for k in range(1, white.shape[1]):
        slow[:, k] = 0.9 * slow[:, k - 1] + white[:, k]
    assert inflation(slow) == pytest.approx(1.9 / 0.1, rel=0.3)      # (1 + r) / (1 - r)
    assert inflation(np.zeros((2, 5))) == 1.0


PRIME_POWERS = [2, 3, 4, 5, 7, 8, 9, 11, 13, 16]


def balanced(array):
    """Return True if each pair of columns contains each pair of levels once."""
    return all(len({tuple(pair) for pair in array[:, [a, b]].tolist()}) == len(array)
               for a, b in combinations(range(array.shape[1]), 2))


def test_arrays_exist_for_prime_powers_only():
    assert [q for q in range(18) if parameter_sets.prime_power(q)] == [*PRIME_POWERS, 17]
    assert parameter_sets.prime_power(49) == (7, 2)
    assert parameter_sets.prime_power(64) == (2, 6)
    assert parameter_sets.prime_power(6) is None
    assert [parameter_sets.next_prime_power(n) for n in (1, 6, 10, 14, 18)] == [2, 7, 11, 16, 19]
    assert [parameter_sets.next_prime_power(n, odd=True) for n in (3, 4, 8, 14, 26, 50)] == [
        3, 5, 9, 17, 27, 53]
    with pytest.raises(BadUsage, match='6 levels'):
        parameter_sets.bose_array(6, 3)
    with pytest.raises(BadUsage, match='5 columns'):
        parameter_sets.bose_array(3, 5)
    with pytest.raises(BadUsage, match='0 levels'):
        parameter_sets.design_for(0)


# therefore the tables are those of a field, and the polynomial is irreducible
@pytest.mark.core
@pytest.mark.parametrize('q', [*PRIME_POWERS, 25, 27, 49])
def test_every_array_is_balanced(q):
    array = parameter_sets.bose_array(q, q + 1)
    assert array.shape == (q * q, q + 1)
    assert balanced(array)
    array[3, 1] = (array[3, 1] + 1) % q     # one wrong cell is found
    assert not balanced(array)
    # three of each level in each column: L9(3^4) of figure 2 of the patent, in another order
    columns = parameter_sets.bose_array(q, q + 1).T
    assert all((np.bincount(column) == q).all() for column in columns)


@pytest.mark.parametrize(('levels', 'rows'), [(1, 1), (2, 8), (3, 9), (4, 16), (7, 49), (9, 81)])
def test_design_follows_the_levels(levels, rows):
    name, array = parameter_sets.design_for(levels)
    assert array.shape == (rows, 3)
    assert levels != 9 or name == 'L81(9^10)'
    assert levels == 2 or balanced(array)
    assert [len(set(column)) for column in array.T.tolist()] == [levels] * 3
