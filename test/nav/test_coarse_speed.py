# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Quantised speeds: rounded to a step, held, zero in a dead band; filters of a receiver."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.data.samples import OdometerForm
from odocal_ros.nav.coarse_speed import (
    CoarseSpeed,
    find_coarse_speed,
    find_held_speed,
    find_step,
)
from odocal_ros.nav.odometer import make_travel
from odocal_ros.nav.receiver_filter import filter_error, MIN_LAG2, odometer_error
from odocal_ros.screening.odometer_rows import with_gap_uncertainty
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.wheels import hold_speed, published_speed

KMH = 1 / 3.6
T = np.arange(0.0, 600.0, 0.1)
# stops and goes of uneven lengths: 0 to 16 m/s
SPEED = np.maximum(0.0, 8 + 6 * np.sin(T / 9) + 4 * np.sin(T / 4.3))
RATE = OdometerForm('rate', 0, '1')
STEP = 0.5 / 3.6
AT = np.arange(0.0, 400.0, 0.05)


def sent(step, how, t=T, speed=SPEED):
    """Return (times, speeds) as a bus sends them: in steps, truncated or rounded."""
    return t, np.floor(speed / step + {'floor': 0.0, 'round': 0.5}[how]) * step


@pytest.mark.parametrize('how', ['floor', 'round'])
@pytest.mark.parametrize('step', [KMH, 0.1 * KMH, 0.0075 * KMH])
def test_step_of_a_quantised_speed_is_found(step, how):
    found = find_coarse_speed(*sent(step, how))
    assert found.step == pytest.approx(step, rel=1e-6)
    assert not found.interpolated


def test_time_in_motion_is_that_of_the_rows_and_not_of_whole_intervals():
    t = np.arange(0.0, 10.001, 0.02)
    moves = (t > 1.395) & (t < 6.205)
    speed = CoarseSpeed(0.1, t, np.where(moves, np.where(t < 3.995, 0.5, -0.5), 0.0))
    # at a change half of the time between two rows counts, at a reversal none: at most 0.02 s
    want = [0.0, 0.61, 1.0, 1.0, -1.0, -1.0, -0.21, 0.0, 0.0, 0.0]
    assert_allclose(speed.time_in_motion(np.arange(11.0)), want, atol=0.0201)
    assert speed.time_in_motion(np.array([0.0, 10.0])) == pytest.approx(2.6 - 2.21, abs=0.011)


def test_step_is_found_with_noise_and_in_a_slow_drive():
    t, v = sent(KMH, 'floor')
    noisy = v + 0.01 * np.random.default_rng(1).standard_normal(len(v)) * (v != 0)
    # the mean of some hundred places of 0.01 m/s, over a span of tens of steps: below 1e-3
    assert find_step(noisy) == pytest.approx(KMH, rel=1e-3)
    slow = SPEED / 8
    assert find_coarse_speed(*sent(KMH, 'round', speed=slow)).step == pytest.approx(KMH, rel=1e-6)
    assert find_coarse_speed(T, slow) is None


def test_only_the_knots_of_an_interpolated_speed_are_used():
    t, v = sent(KMH, 'floor', T[::10], SPEED[::10])
    found = find_coarse_speed(T[:-9], np.interp(T[:-9], t, v))
    assert found.interpolated
    assert found.step == pytest.approx(KMH, rel=1e-6)
    assert np.isin(found.t[1:-1], t).all()


def test_speeds_have_a_step_also_if_reversed_and_counts_have_none():
    t, v = sent(KMH, 'floor')
    found = make_travel(t, v, RATE, reversed_counts=True)[0].coarse
    np.testing.assert_array_equal(found.value, -v)
    assert make_travel(t, np.cumsum(v), OdometerForm('cumulative', 0, '1'))[0].coarse is None


@pytest.mark.parametrize('rate', [1, 10])
@pytest.mark.parametrize(('how', 'offset'), [('floor', KMH / 2), ('round', 0.0)])
def test_speed_at_step_transitions_is_within_its_sigma(how, offset, rate):
    every = slice(None, None, 10 // rate)
    stated = CoarseSpeed(KMH, *sent(KMH, how, T[every], SPEED[every])).instants
    z = (stated.value + offset - np.interp(stated.t, T, SPEED)) / stated.sigma
    # uniform: sqrt(3) sigma at most, except for the uncertainty of the change within a step
    assert np.abs(z).max() < 2.6
    # uniform: 1, to a tenth from some hundred rows; a slow change is stated with the rate of
    # quicker ones, which the level of the fit reduces by up to a half
    assert 0.5 < np.sqrt((z**2).mean()) < 1.2
    assert np.abs(stated.value).min() > KMH


def test_instants_have_a_sign_in_reverse_and_none_is_next_to_zero():
    t, v = sent(KMH, 'floor')
    np.testing.assert_array_equal(CoarseSpeed(KMH, t, -v).instants.sign, -1.0)
    # a dead band of a step: from 0 to 2 at once
    t, v = sent(KMH, 'floor', speed=SPEED / 8)
    stated = CoarseSpeed(KMH, t, np.where(v < 1.5 * KMH, 0.0, v)).instants
    assert np.abs(stated.value).min() > 1.9 * KMH


def test_a_smooth_start_to_one_cruise_has_no_step():
    # values crowd at rest and at the cruise, and so are multiples of any step of both
    t = np.arange(0.0, 60.0, 0.04)
    x = np.clip((t - 10.0) / 12.0, 0.0, 1.0)
    speed = 11.7647 * (x**3 * (10 - 15 * x + 6 * x**2))      # no jerk at either end
    assert find_coarse_speed(t, speed) is None
    assert find_coarse_speed(t, np.floor(speed * 3.6) / 3.6).step == pytest.approx(1 / 3.6,
                                                                                   rel=1e-6)


@pytest.mark.parametrize('rate', [1.0, 2.0, 10.0])
def test_speed_at_transitions_is_unbiased_where_cruises_begin_and_end(rate):
    # cruises differ, so that their speeds are anywhere within a step: in-between, up, down
    rng = np.random.default_rng(5)
    cruise = rng.uniform(1.0, 3.0, 400)
    corners, v = np.cumsum(rng.uniform(5.0, 10.0, 1600)), np.zeros(1600)
    v[1::4] = v[2::4] = cruise
    corners[1::4], corners[3::4] = corners[0::4] + cruise / 0.7, corners[2::4] + cruise / 0.9
    t = np.arange(corners[0], corners[-1], 1 / rate)
    speed = np.interp(t, corners, v)
    stated = CoarseSpeed(KMH, *sent(KMH, 'floor', t, speed)).instants
    error = stated.value + KMH / 2 - np.interp(stated.t, corners, v)
    assert len(stated.t) > 800
    assert abs((error / stated.sigma).mean()) < 3.3 / np.sqrt(len(stated.t))
    assert np.sqrt(((error / stated.sigma)**2).mean()) < 1.1


def test_rounding_error_persists_in_a_cruise_and_averages_out_in_a_ramp():
    rng, step = np.random.default_rng(4), 0.02
    t = np.arange(0.0, 200.0, 0.05)
    errors, stated = [], None
    for _ in range(200):
        # two cruises of 60 s, a stop, and a ramp that passes a step in every row
        speed = np.interp(t, [0, 60, 100, 160, 161], [*[rng.uniform(1, 2)] * 2,
                                                      *[rng.uniform(6, 7)] * 2, 0.0])
        sent = np.rint(speed / step) * step
        found = CoarseSpeed(step, t, sent)
        stated = found.travel_variance(np.arange(0.0, 200.0))
        errors.append(((sent - speed) * 0.05).sum())
    # zero at rest, and less in the ramp than in 60 s at constant speed
    assert stated[162:].max() == 0.0
    assert stated[60:100].sum() < 0.02 * stated.sum()
    # variance from 200 drives: relative sigma sqrt(2 / 200) = 0.1; three sigmas
    assert np.var(errors) == pytest.approx(stated.sum(), rel=0.15 * 2)


def town(t):
    """Return a speed of unequal stops, ramps and cruises, m/s."""
    stops = np.clip(20 * np.sin(2 * np.pi * t / 97.0), 0.0, 9.0 + 2 * np.sin(t / 61.0))
    return np.where(stops < 0.05, 0.0, stops)


@pytest.mark.parametrize('scale', [1.0, 37.0])
def test_a_held_speed_is_recognised_with_its_step(scale):
    found = find_held_speed(AT, scale * hold_speed(town(AT), STEP))
    # the least of many changes is a step plus the least change within a row
    assert STEP <= found.step / scale < 1.05 * STEP
    assert not found.truncation


@pytest.mark.parametrize('value', [
    town(AT), town(AT) + 0.01 * np.random.default_rng(1).standard_normal(len(AT)),
    np.repeat(town(AT[::5]), 5), published_speed(town(AT), RealEffects(speed_step=1 / 3.6)),
    np.zeros(len(AT)), np.full(len(AT), 5.0)],
    ids=['plain', 'noisy', 'repeated', 'whole km/h', 'standing', 'even'])
def test_other_speeds_are_not_recognised_as_held(value):
    path = make_travel(AT, value, RATE)[0]
    assert path.coarse is None or path.coarse.truncation


def test_a_held_speed_is_exact_at_changes_and_within_half_a_step_elsewhere():
    true = town(AT)
    found = find_held_speed(AT, hold_speed(true, STEP))
    assert_allclose(found.instants.value, np.interp(found.instants.t, AT, true), atol=1e-9)
    off = np.abs(found.value - true)[true > 0]
    # one row more where the speed changes direction within a step
    assert np.percentile(off, 90) < 0.55 * STEP
    assert off.max() < 1.6 * STEP


def test_path_error_of_a_held_speed_is_that_of_its_cruises():
    true = town(AT)
    held = hold_speed(true, STEP)
    middle = make_travel(AT, held, RATE)[0].s[-1]
    whole, sent = (((x[1:] + x[:-1]) / 2 * np.diff(AT)).sum() for x in (true, held))
    # four cruises of 20 s, each uniform within a step: 3 sigmas
    assert abs(middle - whole) < 3 * np.sqrt(4) * 20 * STEP / np.sqrt(12)
    assert abs(middle - whole) < abs(sent - whole)


def test_a_held_speed_with_reversed_counts_has_the_other_side():
    value = hold_speed(town(AT), STEP)
    path, back = make_travel(AT, value, RATE)[0], make_travel(AT, -value, RATE,
                                                              reversed_counts=True)[0]
    assert_allclose(back.s, path.s)
    assert_allclose(back.coarse.value, path.coarse.value)
    assert_allclose(back.coarse.instants.value, path.coarse.instants.value)


# forwards and backwards, with different accelerations at stops and starts
CORNERS = np.cumsum(np.tile([3.0, 1.5, 6.0, 2.1], 20))
BOTH_DIRECTIONS = np.interp(AT, np.r_[0.0, CORNERS], np.r_[0.0, np.tile([0.0, 1.7, 1.7, 0.0], 20)])
BOTH_DIRECTIONS[CORNERS[39] < AT] *= -1
BAND = 0.25


@pytest.mark.parametrize('reversed_counts', [False, True])
def test_travel_lost_in_a_dead_band_is_restored_with_an_uncertainty(reversed_counts):
    zeroed = np.where(np.abs(BOTH_DIRECTIONS) < BAND, 0.0, BOTH_DIRECTIONS)
    raw, _ = make_travel(AT, zeroed, RATE, reversed_counts=reversed_counts)
    path, (t, sigma) = with_gap_uncertainty(raw, zeroed, RATE)
    true, _ = make_travel(AT, BOTH_DIRECTIONS, RATE, reversed_counts=reversed_counts)
    lost = np.abs(np.diff(raw.s)).sum() - np.abs(np.diff(true.s)).sum()
    left = np.abs(np.diff(path.s)).sum() - np.abs(np.diff(true.s)).sum()
    assert lost < -0.8          # 40 times v^2 / 2a
    # a band ends within a row: half a row's speed of 1.1 m/s^2, of 0.25 m/s
    assert abs(left) < 0.11 * abs(lost)
    # the sigma of each is half of its travel, and is at its time
    assert sigma.sum() == pytest.approx(abs(lost) / 2, rel=0.11)
    at = np.interp(t, AT, np.abs(BOTH_DIRECTIONS))
    assert (at < BAND + 0.1).all()


def test_a_speed_without_a_dead_band_is_unchanged():
    exact, _ = make_travel(AT, BOTH_DIRECTIONS, RATE)
    path, (t, _) = with_gap_uncertainty(exact, BOTH_DIRECTIONS, RATE)
    np.testing.assert_array_equal(path.s, exact.s)
    assert not len(t)


W = np.array([0.5, 0.7])


def swaying(t):
    """Return position, m, and velocity, m/s, of a sinusoidal path: (n, 2) each."""
    phase = np.multiply.outer(t, W)
    return [20.0, 3.0] * np.sin(phase), [10.0, 2.1] * np.cos(phase)


@pytest.mark.parametrize('tau', [0.005, 0.3, 1.0, 2.5])
@pytest.mark.parametrize(('square', 'error'), [
    (1, lambda s: np.exp(s) / (1 + s) - 1),                     # of first order
    (-2, lambda s: -s**2 / (s**2 + np.sqrt(2) * s + 1))])       # of position and velocity
def test_filter_error_of_a_sine_is_the_filter_response(square, error, tau):
    t, at, square = np.arange(0.0, 60.0, 0.2), np.linspace(35.0, 50.0, 40), square * tau**2
    off, rate = filter_error(t, *swaying(t), at, square)
    want = [20.0, 3.0] * (np.exp(1j * np.multiply.outer(at, W)) * error(1j * W * tau)).imag
    # a cubic over 0.2 s has a curvature error of (0.2 w)^2 / 12; the initial transient is at
    # exp(-35 / (2.5 sqrt(2)))
    assert_allclose(off, want, rtol=0, atol=3e-3 * np.abs(want).max())
    h = 1e-3 * max(abs(square), MIN_LAG2)
    above, below = (filter_error(t, *swaying(t), at, square + x)[0] for x in (h, -h))
    # the difference in the product is one-sided, over 1e-4 of tau^2
    assert_allclose(rate, (above - below) / (2 * h), rtol=0, atol=1e-3 * np.abs(rate).max())


def test_error_of_an_odometer_in_the_receiver_is_high_pass_filtered():
    t, at, share, time = np.arange(0.0, 200.0, 0.2), np.linspace(150.0, 190.0, 40), 0.02, 8.0
    error, by_share, by_log_time = odometer_error(t, *swaying(t), at, share, np.log(time))
    s = 1j * W * time
    sines = np.exp(1j * np.multiply.outer(at, W)) * s / (1 + s)
    want = share * (np.array([20.0, 3.0]) * sines.imag)
    assert_allclose(error, want, rtol=0, atol=1e-3 * np.abs(want).max())
    assert_allclose(by_share, error / share, rtol=1e-12)
    above, below = (odometer_error(t, *swaying(t), at, share, np.log(time) + x)[0]
                    for x in (1e-3, -1e-3))
    assert_allclose(by_log_time, (above - below) / 2e-3, rtol=0,
                    atol=2e-3 * np.abs(by_log_time).max())


def test_path_is_extrapolated_straight_beyond_its_ends():
    t = np.arange(0.0, 10.0)
    place = np.stack([3.0 * t, 0 * t], -1)
    late, _ = filter_error(t, place, np.tile([3.0, 0.0], (10, 1)), np.array([0.0, 5.0, 9.0]), 4.0)
    # at constant velocity the error is a delay of tau only, which is in the delay parameter
    assert_allclose(late, 0.0, atol=1e-12)
