# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The method ``wheels`` on simulated legs: values, sigmas, refusals."""

from dataclasses import replace
from functools import cache

from drives import drive, settings
import numpy as np
from numpy.testing import assert_allclose
import pytest
from wheel_legs import held_out, true_heading_error, wheel_leg

from odocal_ros.calib.budget import total_covariance
from odocal_ros.calib.combine import combine_method
from odocal_ros.calib.wheels.estimate import solve
from odocal_ros.calib.wheels.leg import positions, wheel_factors
from odocal_ros.calib.wheels.model import PARAMETERS
from odocal_ros.calib.wheels.result import _rows, fit_wheels
from odocal_ros.reasons import Code
from odocal_ros.sim.real import Real

TOWN = {'scenario': 'town', 'duration': 300.0, 'two_wheels': True}
STRAIGHT = {'scenario': 'straight', 'duration': 300.0, 'two_wheels': True}


@cache
def leg_of(known_heading=False, **options):
    """Return drive, settings and leg; equal options give the same ones."""
    made = drive(**options)
    config = settings(made, heading_sigma=1e-3 if known_heading else None)
    return made, config, wheel_leg(made.leg(), config)


@cache
def fitted(known_heading=False, turn_rate=True, **options):
    """Return drive, leg and result."""
    made, config, leg = leg_of(known_heading, **options)
    return made, leg, fit_wheels(leg, config, turn_rate)


def truth(made, leg):
    """Return what each estimate should be."""
    return {'scale_factor': made.truth.scale, 'scale_factor_left': made.truth.wheel_scales[0],
            'scale_factor_right': made.truth.wheel_scales[1],
            'scale_ratio': made.truth.scale_ratio, 'yaw_mounting_angle': made.truth.yaw,
            'heading_error': true_heading_error(made, leg),
            'track_width': made.options.track_width}


def codes(method):
    return {r.code for r in method.reasons}


def test_perfect_sensors_give_the_truth():
    made, leg, method = fitted(True, **TOWN, imu_grade='perfect', fix_sigma=0.01,
                               odometer='angle')
    # fixes of 1 cm, 1400 of them: 1 cm / sqrt(700) over 1.9 km is 0.2 ppm; travel and attitude
    # between samples of 20 and 50 Hz are worth some ppm
    for name, true in truth(made, leg).items():
        if name.startswith('scale'):
            assert method.estimates[name].value == pytest.approx(true, rel=1e-5)
    assert method.estimates['track_width'].value == pytest.approx(1.6, abs=1e-3)
    # the heading is given, to 0 here; the level of point samples is good to 1e-5
    assert method.estimates['heading_error'].value == pytest.approx(-made.truth.yaw, abs=1e-4)


@pytest.mark.parametrize('options', [
    TOWN, TOWN | {'imu_grade': 'industrial', 'seed': 3}, TOWN | {'odometer': 'angle', 'seed': 4},
    TOWN | {'fix_noise': 'correlated', 'seed': 5}, TOWN | {'slope': 0.08, 'seed': 6}, STRAIGHT,
    TOWN | {'slip_walk': 0.01, 'seed': 8}, TOWN | {'yaw': 0.7, 'seed': 9},
    TOWN | {'pitch': 0.065, 'seed': 10}], ids=str)
def test_errors_are_as_large_as_the_sigmas_say(options):
    made, leg, method = fitted(True, **options)
    for name, true in truth(made, leg).items():
        estimate = method.estimates[name]
        if estimate.value is not None:
            # of some 60 normal errors one beyond 4 sigmas is as good as impossible
            assert abs(estimate.value - true) < 4 * estimate.sigma, name
    assert method.estimates['scale_factor'].sigma < 2e-3 * made.truth.scale


def test_the_way_by_the_true_factors_runs_through_the_fixes():
    made, _, leg = leg_of(True, **TOWN, imu_grade='perfect', fix_sigma=0.01, odometer='angle')
    inside = (leg.t_fix >= leg.t_start) & (leg.t_fix <= leg.t_stop)
    way = positions(leg, leg.t_fix[inside], *made.truth.wheel_scales,
                    true_heading_error(made, leg), made.truth.pitch)
    # 1 cm of each fix, a little at the mark, interpolation of a turn at 12 m/s over 50 ms
    assert np.abs(way - leg.fixes_n[inside])[:, :2].max() < 0.06


def test_without_the_turn_rate_only_the_mean_is_stated():
    _, _, with_turns = fitted(**TOWN)
    _, _, method = fitted(turn_rate=False, **TOWN)
    e = method.estimates
    assert Code.WHEELS_NOT_SEPARABLE in codes(method)
    assert e['scale_factor_left'].value is None
    assert e['scale_factor_right'].value is None
    both = with_turns.estimates['scale_factor']
    assert e['scale_factor'].value == pytest.approx(both.value, abs=both.sigma)
    assert with_turns.details['condition_number'] > 1e4


def test_a_straight_way_tells_the_ratio_and_no_track_width():
    made, leg, method = fitted(**STRAIGHT)
    assert Code.TRACK_WIDTH_NOT_DETERMINED in codes(method)
    assert method.estimates['track_width'].value is None
    ratio = method.details['wheel_ratio']
    true = made.truth.wheel_scales[1] / made.truth.wheel_scales[0]
    assert abs(ratio['value'] - true) < 4 * ratio['sigma']
    assert ratio['sigma'] < 1e-4
    assert ratio['sigma_by_fixes_alone'] > 0.1


def test_a_course_holds_the_mounting_angle():
    _, _, method = fitted(**TOWN)
    assert Code.YAW_NOT_SEPARABLE in codes(method)
    assert method.estimates['yaw_mounting_angle'].value is None
    assert method.estimates['heading_error'].value is not None


def test_outliers_neither_pull_nor_widen():
    _, _, clean = fitted(**TOWN)
    made, leg, method = fitted(**TOWN, outliers=0.02, outlier_size=30.0)
    scale, before = method.estimates['scale_factor'], clean.estimates['scale_factor']
    assert method.details['fixes']['dropped'] > 10
    assert abs(scale.value - before.value) < before.sigma
    assert scale.sigma == pytest.approx(before.sigma, rel=0.2)


@pytest.mark.parametrize('late', [0.1, -0.1])
def test_late_fixes_of_a_centimetre_move_nothing(late):
    options = TOWN | {'fix_noise': 'rtk', 'imu_grade': 'industrial', 'seed': 3}
    _, _, right = fitted(**options)
    _, _, method = fitted(**options, fix_delay=late)
    a, b = (m.estimates['scale_factor'] for m in (right, method))
    # the fixes' noise is the same, but they are of other places; linear in the latency they
    # would be off by 4 sigmas
    assert abs(b.value - a.value) < a.sigma
    assert method.details['fix_latency_seen'] == pytest.approx(late, abs=3e-3)   # 2 cm at 12 m/s


@pytest.mark.parametrize('error', [0.02, -0.02])
def test_a_gyro_that_reads_too_much_is_seen_through(error):
    # twice what a consumer's gyro is believed to
    made, leg, method = fitted(**TOWN, gyro_scale_error=error)
    for name, true in truth(made, leg).items():
        estimate = method.estimates[name]
        if estimate.value is not None:
            assert abs(estimate.value - true) < 4 * estimate.sigma, name
    seen = method.details['gyro_scale_seen']
    assert abs(seen['value'] - error) < 4 * seen['sigma']
    assert seen['sigma'] < 2e-3


@pytest.mark.parametrize('options', [TOWN | {'fix_noise': 'rtk'}, STRAIGHT], ids=str)
def test_a_receiver_that_smooths_is_seen_through(options):
    made, leg, method = fitted(True, **options, real=Real(receiver_lag=0.8), seed=2)
    for name, true in truth(made, leg).items():
        estimate = method.estimates[name]
        if estimate.value is not None:
            assert abs(estimate.value - true) < 3.5 * estimate.sigma, name
    # late by its time constant, whatever is believed of stamps (50 ms)
    seen = method.details['fix_latency_seen'], method.details['fix_latency_sigma']
    assert abs(seen[0] - 0.8) < 3 * seen[1] < 0.3
    if 'fix_noise' in options:
        said = next(r for r in method.reasons if r.code is Code.FIXES_SMOOTHED)
        assert '0.80 s' in said.text


def test_where_fixes_tell_no_turn_the_width_is_no_better_than_the_gyro():
    _, config, leg = leg_of(**TOWN, seed=4)
    errors = 150.0 * np.random.default_rng(1).standard_normal(leg.fixes_n.shape)
    loose = replace(leg, covariance_n=leg.covariance_n * 1e4, fixes_n=leg.fixes_n + errors)
    firm = replace(loose, alignment=replace(loose.alignment, gyro_scale_sigma=0.0))
    with_scale, without = (fit_wheels(x, config).estimates['track_width'] for x in (loose, firm))
    added = np.sqrt(with_scale.sigma**2 - without.sigma**2) / with_scale.value
    assert 0.005 < added < 0.01     # of 1 % less what the scale of the way makes up for


def test_sources_add_up_to_the_sigma():
    made, config, leg = leg_of(**TOWN)
    solution, method = solve(leg, config), fit_wheels(leg, config)
    rows = _rows(solution)
    known = [s for s in method.sources if s.name not in ('initial_heading', 'height',
                                                         'second_order')]
    whole = rows @ np.linalg.inv(solution.fit.normal) @ rows.T
    assert_allclose(total_covariance(known), whole, rtol=1e-5,
                    atol=1e-9 * np.abs(whole).max())


def test_rows_are_the_derivatives_of_what_is_stated():
    made, config, leg = leg_of(**TOWN)
    solution = solve(leg, config)

    def stated(step):
        state = solution.state
        scale, ratio = state.scale * np.exp(step[0]), state.log_ratio + step[1]
        return np.array([*np.log([scale, *wheel_factors(scale, ratio)]),
                         -(state.heading + step[2]), state.width + step[5]])

    step = 1e-5 * np.eye(len(PARAMETERS))
    by = np.stack([(stated(x) - stated(-x)) / 2e-5 for x in step], -1)
    assert_allclose(_rows(solution), by, atol=1e-8)


def test_fixes_after_the_stop_are_not_used():
    made, config, leg = leg_of(**TOWN)
    late = leg.t_fix > leg.t_start + 0.8 * (leg.t_stop - leg.t_start)
    spoilt = leg.fixes_n.copy()
    spoilt[late] += 1000.0
    a, b = (fit_wheels(held_out(x, 0.8), config).estimates['scale_factor']
            for x in (leg, replace(leg, fixes_n=spoilt)))
    assert (a.value, a.sigma) == pytest.approx((b.value, b.sigma), rel=1e-9)   # BLAS' last bits


def test_few_fixes_are_refused():
    made, config, leg = leg_of(**TOWN)
    method = fit_wheels(replace(leg, t_stop=leg.t_start + 0.5), config)
    assert codes(method) == {Code.NO_FIX}
    assert all(e.value is None for e in method.estimates.values())


def test_a_wheel_that_does_not_count_is_named():
    made, config, leg = leg_of(**TOWN)
    still = replace(leg.right, s=0 * leg.right.s, P=0 * leg.right.P)
    method = fit_wheels(replace(leg, right=still), config)
    assert codes(method) == {Code.WHEEL_DEAD}
    assert 'right' in method.reasons[0].text


def test_one_wheel_of_half_the_size_is_no_trouble():
    made, leg, method = fitted(**TOWN, wheel_difference=-0.5)
    for name in ('scale_factor', 'scale_factor_left', 'scale_factor_right'):
        estimate = method.estimates[name]
        assert abs(estimate.value - truth(made, leg)[name]) < 4 * estimate.sigma


def test_a_fix_that_is_no_number_is_left_out():
    made, config, leg = leg_of(**TOWN)
    holes = leg.fixes_n.copy()
    holes[100:110] = np.nan
    method = fit_wheels(replace(leg, fixes_n=holes), config)
    whole = fit_wheels(leg, config).estimates['scale_factor']
    assert method.estimates['scale_factor'].value == pytest.approx(whole.value, abs=whole.sigma)


def test_two_legs_combine():
    results = [fitted(**(TOWN | {'seed': seed}))[2] for seed in (1, 2)]
    both = combine_method('wheels', results)
    sigma = [r.estimates['scale_factor_left'].sigma for r in results]
    assert both.estimates['scale_factor_left'].sigma < min(sigma)
    assert both.estimates['track_width'].value == pytest.approx(1.6, abs=0.01)
