# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Odometer rows to travel: counter widths, rollover in both directions, resets, bursts."""

from dataclasses import replace

from hypothesis import given, settings, strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.data.samples import OdometerForm
from odocal_ros.nav.odometer import make_travel, mean_travel, Travel
from odocal_ros.reasons import Code

pytestmark = pytest.mark.core


def counter(modulus):
    return OdometerForm('cumulative', modulus, 'm/pulse')


def sent(total, modulus, low):
    """Return a running total as a counter of a modulus sends it, the smallest value being low."""
    return np.array([(int(x) - low) % modulus + low for x in total], dtype=np.int64)


def codes(reasons):
    return [r.code for r in reasons]


WIDTHS = [(2**16, -2**15), (2**16, 0), (2**32, -2**31), (2**32, 0), (9000, 0), (9001, 0),
          (65536, 0), (2**62, 0)]


@pytest.mark.parametrize('sign', [1, -1])
@pytest.mark.parametrize(('modulus', 'low'), WIDTHS)
def test_rollover_is_removed_in_both_directions(modulus, low, sign):
    total = low + modulus - 200 + np.arange(100) * 37 if sign > 0 else \
        low + 200 - np.arange(100) * 37
    t = np.arange(100) * 0.02
    found, reasons = make_travel(t, sent(total, modulus, low), counter(modulus))
    # exact in whole numbers; 2^62 leaves no digit behind the point
    assert np.array_equal(found.s, sign * np.arange(100) * 37.0)
    assert codes(reasons) == [Code.COUNTER_ROLLOVER]
    assert f'modulus {modulus}' in reasons[0].text
    assert found.quantum == 1.0


def test_rollover_is_reported_with_number_and_place():
    total = np.arange(1000) * 37
    _, reasons = make_travel(np.arange(1000) * 0.02, sent(total, 9000, 0), counter(9000))
    # 36963 counts pass 9000 four times, first in step 9000 // 37 = 243
    assert '4 times' in reasons[0].text
    assert f't = {244 * 0.02:.2f} s' in reasons[0].text


@pytest.mark.parametrize('sign', [1, -1])
def test_64_bit_arithmetic_removes_its_rollover(sign):
    edge = np.array([2**63 - 10 * sign], dtype=np.uint64)
    steps = np.arange(30, dtype=np.uint64) * 3
    value = (edge + steps if sign > 0 else edge - steps).view(np.int64)
    found, reasons = make_travel(np.arange(30.0), value, counter(2**64))
    assert np.array_equal(found.s, sign * np.arange(30) * 3.0)
    assert reasons == ()


@settings(max_examples=50)
@given(seed=st.integers(0, 10_000), modulus=st.sampled_from([9000, 9001, 2**16, 2**32, 2**64]))
def test_any_steps_below_half_a_modulus_are_recovered(seed, modulus):
    rng = np.random.default_rng(seed)
    steps = rng.integers(-4000, 4001, 60)
    total = int(rng.integers(0, 8000)) + np.concatenate([[0], np.cumsum(steps)])
    value = sent(total, modulus, -2**63 if modulus == 2**64 else 0)
    found, _ = make_travel(np.arange(61) * 0.1, value, counter(modulus))
    assert np.array_equal(found.s, (total - total[0]).astype(float))


def drive(n=400, dt=0.02):
    """Return times and integer counts: at rest, accelerating, at constant speed, at rest."""
    t = np.arange(n) * dt
    rate = 700 * np.interp(t / t[-1], [0, 0.2, 0.4, 0.8, 0.9, 1], [0, 0, 1, 1, 0, 0])
    return t, np.floor(np.concatenate([[0], np.cumsum(rate[1:] * dt)])).astype(np.int64), rate


@pytest.mark.parametrize('modulus', [2**16, 2**32, 2**64])
@pytest.mark.parametrize('at', [150, 250, 380])
def test_a_reset_is_bridged_at_the_adjacent_speed(modulus, at):
    t, total, rate = drive()
    before = total + (30_000 if modulus == 2**16 else 1_500_000_000)     # whole numbers
    value = np.where(np.arange(len(t)) < at, before, total - total[at])
    found, reasons = make_travel(t, value, counter(modulus))
    # one step is interpolated between its neighbours: whole counts, one off at most
    assert np.abs(found.s - total).max() <= 1.0
    assert codes(reasons) == [Code.COUNTER_RESET]
    assert f'jumps by {total[0] - before[at - 1]:+} at' in reasons[0].text
    assert f't = {t[at]:.2f} s' in reasons[0].text


def test_a_wrong_row_affects_two_steps_only():
    t, total, _ = drive()
    value = total.copy() + 30_000
    value[200] = 0
    found, reasons = make_travel(t, value, counter(2**32))
    assert np.abs(found.s - total).max() <= 2.0
    assert '2 such steps' in reasons[0].text


EVEN = np.arange(100_400) * 0.02
SHORT = np.arange(400)
SLOW = np.concatenate([np.full(300, 0.01), np.ones(200), [0.01], np.full(300, 0.01)])


@pytest.mark.parametrize(('t', 'value'), [
    # the count changes in less than 1 % of the rows: changes must not be treated as jumps
    (EVEN, np.concatenate([np.zeros(100_000, dtype=np.int64), drive()[1]])),
    (EVEN[:10_200], np.cumsum(np.concatenate([np.ones(10_000, int), np.full(200, 40)]))),
    # fast zeros at rest, then one count a second, and two at once
    (np.cumsum(SLOW), np.cumsum(np.repeat([0, 1, 2, 0], [300, 200, 1, 300]))),
    # ten rows at once, or one early: the interval of a row does not give the speed
    (np.floor(SHORT / 10) * 0.2 + (SHORT % 10) * 1e-5, drive()[1]),
    (np.where(SHORT % 50 == 1, EVEN[:400] - 0.0199, EVEN[:400]), drive()[1]),
    (EVEN[:500], np.cumsum(np.random.default_rng(1).choice([0, 0, 0, 0, 1, 2], 500))),
    (EVEN[:50], np.full(50, 77))],
    ids=['hour at rest', 'creeping', 'two counts', 'bursts', 'early row', 'seldom', 'standing'])
def test_uneven_counts_and_stamps_are_not_resets(t, value):
    found, reasons = make_travel(t, value, counter(2**32))
    assert reasons == ()
    assert np.array_equal(found.s, (value - value[0]).astype(float))


def test_a_floating_point_angle_is_exact_and_its_reset_is_bridged():
    t = np.arange(100) * 0.02
    angle = 5.0 + 12.0 * t
    form = OdometerForm('cumulative', 0, 'm/rad')
    found, reasons = make_travel(t, angle, form)
    assert_allclose(found.s, 12.0 * t, atol=1e-13)
    assert found.quantum == 0.0
    assert reasons == ()
    restarted = np.where(t < 0.99, angle, angle - 900.0)
    found, reasons = make_travel(t, restarted, form)
    assert_allclose(found.s, 12.0 * t, atol=1e-12)
    assert codes(reasons) == [Code.COUNTER_RESET]


def test_a_counter_in_steps_of_five_has_a_quantum_of_five():
    t = np.arange(400) * 0.1
    s = 30.0 * t + 20.0 * np.sin(t)
    form = OdometerForm('cumulative', 0, 'm/pulse')
    assert make_travel(t, (5 * np.floor(s / 5)).astype(np.int64), form)[0].quantum == 5.0
    assert make_travel(t, np.floor(s).astype(np.int64), form)[0].quantum == 1.0
    assert make_travel(t, 6 * np.arange(400), form)[0].quantum == 1.0        # of one speed only


def test_increments_add_up_and_rates_are_summed_by_trapezoids():
    found, _ = make_travel(np.arange(4.0), np.array([100, 1, 2, -1]),
                           OdometerForm('increment', 0, 'm/pulse'))
    assert_allclose(found.s, [0, 1, 3, 2], atol=0)
    assert found.quantum == 1.0
    t = np.array([0.0, 1.0, 1.5, 4.0])
    found, _ = make_travel(t, 2 + 3 * t, OdometerForm('rate', 0, '1'))
    assert_allclose(found.s, 2 * t + 1.5 * t**2, atol=1e-14)     # exact for a straight line
    assert found.quantum == 0.0
    assert make_travel(t, np.arange(4), OdometerForm('rate', 0, '1'))[0].quantum == 0.0


@pytest.mark.parametrize('form', [counter(2**32), OdometerForm('increment', 0, 'm/pulse'),
                                  OdometerForm('rate', 0, '1')])
def test_reversed_counts_give_negative_travel(form):
    t, value = np.arange(30.0), np.arange(30) ** 2
    assert np.array_equal(make_travel(t, value, form, True)[0].s,
                          -make_travel(t, value, form)[0].s)


@pytest.mark.parametrize('quantity', ['cumulative', 'increment', 'rate'])
@pytest.mark.parametrize('dtype', [np.int64, np.float64])
def test_zero_rows_and_one_row_give_no_travel(quantity, dtype):
    form = OdometerForm(quantity, 2**16, 'm/pulse')
    assert make_travel(np.empty(0), np.empty(0, dtype), form)[0].s.shape == (0,)
    found, reasons = make_travel(np.array([3.0]), np.array([7], dtype), form)
    assert_allclose(found.s, [0.0], atol=0)
    assert reasons == ()


def test_travel_is_linear_between_rows_and_constant_outside():
    found = Travel(np.array([0.0, 1.0, 3.0]), np.array([0.0, 2.0, -2.0]), 1.0)
    assert_allclose(found.at([-9.0, 0.5, 2.0, 9.0]), [0, 1, 0, -2], atol=0)


def test_travel_of_two_wheels_is_their_mean():
    left = Travel(np.arange(5.0), np.arange(5.0) * 10, 1.0)
    right = Travel(np.array([0.5, 3.5]), np.array([0.0, 60.0]), 1.0)     # 20 a second
    found = mean_travel((left, right))
    assert_allclose(found.t, [1, 2, 3], atol=0)
    assert_allclose(found.s, [0, 15, 30], atol=1e-14)
    late, none = (Travel(t, 0 * t, 1.0) for t in (np.arange(5.0, 8.0), np.empty(0)))
    for pair in ((left, late), (late, left), (left, none), (none, left)):     # no common time
        assert mean_travel(pair).s.shape == (0,)


def test_error_of_the_mean_of_two_rounded_wheels_agrees_with_its_quantum():
    """Uniform errors of width q have a sigma of q / sqrt(12)."""
    rng, n = np.random.default_rng(3), 20_000
    t = np.arange(n) * 0.02
    path = np.cumsum(rng.uniform(3, 9, n))
    wheels = [Travel(t, np.floor(path * k + p), 1.0) for k, p in ((1.0, 0.3), (1.003, 0.8))]
    found = mean_travel(wheels)
    error = found.s - path * 1.0015
    # a variance from 20 000 hardly dependent draws: 1 %, five times over
    assert error.std() == pytest.approx(found.quantum / np.sqrt(12), rel=0.05)


def test_steps_too_small_for_a_speed_are_not_resets():
    found, reasons = make_travel(np.arange(100) * 1e9, np.arange(100) * 5e-324,
                                 OdometerForm('cumulative', 0, 'm/rad'))
    assert reasons == ()
    assert np.array_equal(found.s, np.arange(100) * 5e-324)


def test_counter_rounding_is_averaged_by_fitted_parabolas():
    t = np.delete(np.arange(0, 60, 0.02), slice(1500, 1800))      # 30 to 36 s are missing
    true = 5.3 * t + 0.4 * t**2
    raw = Travel(t, np.round(true), 1.0)
    smooth = raw.smoothed()
    off = smooth.s - np.interp(smooth.t, t, true)
    # value in the middle of a parabola through n values with independent errors
    n = 21
    share = np.sqrt(3 * (3 * n**2 - 7) / (4 * n * (n**2 - 4)))
    far = np.abs(t - 33.0) > 3.0 + 0.4
    # of 2600 values in groups of 21: 124 independent ones
    assert off[far].std() * np.sqrt(12) < share * (1 + 4 / np.sqrt(2 * 124))
    assert np.array_equal(smooth.s[1490:1510], raw.s[1490:1510])
    for few in (replace(raw, t=50 * raw.t), replace(raw, quantum=0.0)):
        assert few.smoothed() is few
