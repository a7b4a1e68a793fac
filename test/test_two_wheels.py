# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Two wheels with different counters: spans, types, rates and gaps of each."""

from dataclasses import replace

from drives import changed, drive, kept, seconds, settings, with_columns, without
import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.data.samples import OdometerForm, take
from odocal_ros.reasons import Code
from odocal_ros.screening.screen import screen
from odocal_ros.screening.wheel_travel import correct_rollovers

MADE = {'scenario': 'town', 'duration': 300.0, 'two_wheels': True, 'seed': 4}


def screened(leg, made, **more):
    inputs, found = screen(leg, settings(made, **more))
    return inputs, {r.code: r.text for r in found}


@pytest.fixture(scope='module')
def clean(made):
    inputs, said = screened(made.leg(), made)
    assert not said
    return inputs


def with_right(made, change, **more):
    return replace(with_columns(made.leg(), 'odometer_right', value=change), **more)


@pytest.mark.parametrize('span', [65536, 4096, 256, 10_000, 9000])
@pytest.mark.parametrize('signed', [False, True])
def test_a_hidden_span_is_found_and_unwrapped_exactly(made, clean, span, signed):
    half = span // 2 * signed
    leg = with_right(made, lambda a: (a + half) % span - half)
    inputs, found = screen(leg, settings(made))
    reason, = (r for r in found if r.code is Code.WHEEL_COUNTERS_DIFFER)
    assert f"right wheel's counter rolls over at {span}," in reason.text
    assert f'have this modulus, set odometer.wrap to {span}.' in reason.remedy
    # bridging would lose counts; none is lost here
    assert np.array_equal(inputs.travels[1].s, clean.travels[1].s)
    assert not len(inputs.uncertain_t)


def test_a_hidden_span_of_one_or_both_wheels_is_reported_and_unwrapped(made, clean):
    leg = with_columns(made.leg(), 'odometer', value=lambda a: a % 32768)
    rolled = np.flatnonzero(np.diff(leg.odometer.value) < 0)
    _, said = screened(leg, made)
    text = said[Code.WHEEL_COUNTERS_DIFFER]
    assert text.startswith("the left wheel's counter")
    assert f't = {seconds(leg, leg.odometer)[rolled[0] + 1]:.2f} s' in text
    assert f'{len(rolled)} jump' in text
    leg = with_columns(with_right(made, lambda a: a % 4096), 'odometer', value=lambda a: a % 4096)
    inputs, _ = screened(leg, made)
    assert np.array_equal(inputs.travel.s, clean.travel.s)


def test_a_span_that_is_not_a_power_of_two_has_an_uncertainty(made, clean):
    inputs, said = screened(with_right(made, lambda a: a % 4321), made)
    assert 'about' in said[Code.WHEEL_COUNTERS_DIFFER]
    off = inputs.travels[1].s[-1] - clean.travels[1].s[-1]
    doubt = np.linalg.norm(inputs.uncertain_sigma)          # of the mean: half the right wheel's
    assert 0 < doubt < 1e-3 * clean.travel.s[-1]
    assert abs(off / 2) < 3 * doubt


def test_damaged_counts_are_not_a_span(made):
    count = take(made.odometer, slice(1000))
    value = 10 * np.arange(1000)
    for row in (200, 400, 600):
        value[row:row + 2] = 2**63 - 1, -2**63
    count = changed(count, value=lambda _: value)
    step = np.diff(value.astype(float))
    same, found, uncertain = correct_rollovers(count.stamp_ns * 1e-9, count, step, 'odometer')
    assert same is count
    assert not found
    assert not len(uncertain.t)


@pytest.mark.parametrize(('span', 'found'), [(256, True), (260, False), (2**16, True)])
@pytest.mark.parametrize('per_row', [0.5, 1.0])
def test_one_rollover_between_dense_rows_is_unwrapped(made, span, found, per_row):
    total = span - 100 + np.floor(per_row * np.arange(300)).astype(np.int64)
    count = changed(take(made.odometer, slice(300)), value=lambda _: total % span)
    step = np.diff(count.value.astype(float))
    same, why, *_ = correct_rollovers(count.stamp_ns * 1e-9, count, step, 'odometer')
    assert [r.code for r in why] == [Code.COUNTER_ROLLOVER] * found
    assert np.array_equal(np.diff(same.value), np.diff(total)) == found


def test_angles_wrapped_at_a_turn_are_unwrapped():
    made = drive(**MADE | {'odometer': 'angle', 'odometer_rate': 50.0})
    inputs, said = screened(with_right(made, lambda a: np.angle(np.exp(1j * a))), made)
    clean, _ = screened(made.leg(), made)
    assert 'rolls over at 2 pi' in said[Code.COUNTER_ROLLOVER]
    assert Code.WHEEL_COUNTERS_DIFFER not in said, 'no setting removes a caution for it'
    assert_allclose(inputs.travels[1].s, clean.travels[1].s, atol=1e-6)


def test_a_reset_is_not_a_rollover_and_is_reported_with_the_wheel(made):
    def reset(a):
        a[3000:] -= a[3000]

    _, said = screened(with_right(made, reset), made)
    assert Code.WHEEL_COUNTERS_DIFFER not in said
    assert said[Code.COUNTER_RESET].startswith("the right wheel's counter jumps")


def test_one_wheel_of_another_integer_type_rolls_over_at_its_own_span(made, clean):
    leg = with_right(made, lambda a: a % 2**16,
                     form_right=OdometerForm('cumulative', 2**16, 'm/pulse'))
    inputs, said = screened(leg, made)
    assert Code.WHEEL_COUNTERS_DIFFER not in said
    assert np.array_equal(inputs.travels[1].s, clean.travels[1].s)


def test_a_count_and_a_speed_have_no_mean(made):
    leg = with_right(made, lambda a: a.astype(float), form_right=OdometerForm('rate', 0, '1'))
    inputs, said = screened(leg, made)
    text = said[Code.WHEEL_COUNTERS_DIFFER]
    assert 'a speed (1)' in text
    assert 'a running count (m/pulse)' in text
    assert inputs.travels == ()
    assert_allclose(inputs.travel.s[-1], np.diff(made.odometer.value).sum())


def test_a_right_wheel_without_messages_or_numbers_is_dead(made):
    silent = without(made.leg(), 'odometer_right')
    _, said = screened(silent, made, odometer__left='topic', odometer__right='topic')
    assert 'right wheel has no message' in said[Code.WHEEL_DEAD]
    assert not screened(silent, made)[1]     # one odometer
    inputs, said = screened(with_right(made, lambda a: a * np.nan), made)
    assert 'right wheel has no usable value' in said[Code.WHEEL_DEAD]
    assert inputs.travels == ()
    assert len(inputs.travel.t)


def test_wheels_with_other_rates_and_ends_are_used_where_both_have_rows(made, clean):
    """Linear between rows: the mean errs by at most a(dt/2)^2/2 + a count, here 3 m/s^2, 0.1 s."""
    # a row stamped early by 7 ms: as a wheel read 7 ms late
    leg = with_columns(kept(made.leg(), 'odometer_right', slice(101, 5001, 2)), 'odometer_right',
                       stamp_ns=lambda a: a - 7_000_000)
    inputs, _ = screened(leg, made)
    t, sent = inputs.travel.t, seconds(leg, leg.odometer_right)
    assert sent[0] <= t[0]
    assert t[-1] <= sent[-1]
    late = clean.travels[1].at(t + 0.007)
    want = (clean.travels[0].at(t) + late - clean.travels[0].at(t[0]) - late[0]) / 2
    bound = 3.0 / 8 * 0.1**2 / 0.02 / 2 + 1.5
    assert np.abs(inputs.travel.s - want).max() < bound


def test_a_gap_of_the_right_wheel_only_is_reported(made, clean):
    some = np.r_[0:2000, 2060:len(made.odometer_right.value)]
    inputs, said = screened(kept(made.leg(), 'odometer_right', some), made)
    assert said[Code.TOPIC_GAP].startswith('right odometer gap of 3.05 s')
    assert_allclose(inputs.travel.s[-1], clean.travel.s[-1])      # counts are not lost in a gap
