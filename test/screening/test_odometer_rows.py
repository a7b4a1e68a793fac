# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Counters that roll over, jump, hang or lose increments: the travel remains correct."""

from dataclasses import replace

from drives import drive, kept, STRAIGHT, with_columns, with_increments
import numpy as np
import pytest
from screening_run import screen_with

from odocal_ros.data.samples import join, take
from odocal_ros.reasons import Code
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config

pytestmark = pytest.mark.core


@pytest.fixture
def true(leg):
    return screen_with(leg)[0].travel.s


@pytest.mark.parametrize(('span', 'scale'), [
    (2**12, 0.02), (2**16, 0.02), (10_000, 0.02), (2**21, 0.0005)])
def test_a_counter_that_rolls_over_within_its_type_was_not_reset(span, scale):
    made = drive(**STRAIGHT | {'duration': 900.0}, odometer='counts', scale=scale)
    alone, _ = screen_with(made.leg())
    leg = with_columns(made.leg(), 'odometer', value=lambda v: v % span)
    inputs, found = screen(leg, Config())
    codes, remedies = {r.code: r.text for r in found}, [r.remedy for r in found]
    assert np.diff(made.odometer.value[[0, -1]]) > 3 * span
    assert f'rolls over at {span}' in codes[Code.COUNTER_ROLLOVER]
    assert Code.COUNTER_RESET not in codes
    assert f'Set odometer.wrap to {span}.' in remedies
    np.testing.assert_array_equal(inputs.travel.s, alone.travel.s)


def test_jumps_larger_than_a_span_are_not_a_rollover():
    """Each count is sent again 0.4 s later: it jumps back and forward by nearly the same."""
    leg = drive(**STRAIGHT, odometer='counts', scale=0.001).leg()
    again = replace(leg.odometer, stamp_ns=leg.odometer.stamp_ns + 400_000_001)
    both = join([leg.odometer, again])
    _, codes = screen_with(replace(leg, odometer=take(both, np.argsort(both.stamp_ns))))
    assert Code.COUNTER_ROLLOVER not in codes


@pytest.mark.parametrize('value', [0, -50_000, 2**62, 10**9])
@pytest.mark.parametrize('length', [1, 20, 300])
def test_a_counter_that_jumps_away_and_back_is_corrected(leg, true, value, length):
    inputs, codes = screen_with(
        with_columns(leg, 'odometer', value=(slice(2000, 2000 + length), value)))
    assert Code.COUNTER_RESET not in codes
    assert inputs.travel.s[-1] == true[-1]
    assert 'are frozen or isolated outliers' in codes[Code.BAD_ROWS_DROPPED]
    assert inputs.uncertain_sigma.sum() == 0


@pytest.mark.parametrize('first', [1200, 2500])      # from rest, and at 12 m/s
def test_a_counter_that_hangs_and_catches_up_is_corrected(leg, true, first):
    hung = (slice(first, first + 150), leg.odometer.value[first])
    inputs, codes = screen_with(with_columns(leg, 'odometer', value=hung))
    assert Code.COUNTER_RESET not in codes
    assert inputs.travel.s[-1] == true[-1]


def test_a_reset_is_bridged_within_the_stated_uncertainty(made, leg, true):
    after = slice(2000, None)     # 12 m/s
    count = leg.odometer.value[after]
    inputs, codes = screen_with(with_columns(leg, 'odometer', value=(after, count - count[0])))
    assert 'a reset, not motion' in codes[Code.COUNTER_RESET]
    # one interval at the adjacent speed, uniform between zero and two of it
    speed = 12.0 / made.options.scale
    np.testing.assert_allclose(inputs.uncertain_sigma, speed * 0.05 / np.sqrt(3), rtol=0.05)
    assert abs(inputs.travel.s[-1] - true[-1]) < 3 * inputs.uncertain_sigma[0]


def test_lost_increments_are_bridged_at_the_adjacent_speed(leg, true):
    whole = with_increments(leg)
    step = whole.odometer.value
    inputs, _ = screen_with(kept(whole, 'odometer', np.r_[:2000, 2040:len(step)]))
    lost, end = step[2000:2040].sum(), screen_with(whole)[0].travel.s[-1]
    # the speed is constant there: the only error is rounding of counts on each side
    error = abs(inputs.travel.s[-1] - end)
    assert error < 0.01 * lost
    assert error < 3 * inputs.uncertain_sigma[0] < 0.2 * lost
    np.testing.assert_allclose(end, true[-1])


def test_a_speed_that_jumps_is_excluded():
    made = drive(**STRAIGHT, odometer='speed')
    leg = made.leg()
    inputs, codes = screen_with(with_columns(leg, 'odometer', value=([2500, 2900], [90.0, -40.0])))
    assert codes[Code.BAD_ROWS_DROPPED].startswith('2 of')
    np.testing.assert_allclose(inputs.travel.s[-1], screen_with(leg)[0].travel.s[-1], rtol=1e-6)
