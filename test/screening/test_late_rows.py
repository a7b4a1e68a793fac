# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Odometer messages that arrive late in bursts: corrected, reported and not treated as slip."""

from dataclasses import replace

import drives
from drives import changed, delayed_in_bursts, drive, reason_texts, settings, with_increments
import numpy as np
import pytest

from odocal_ros.data.samples import OdometerSamples, take
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.screening import late_rows
from odocal_ros.screening.late_rows import ROUNDING_COUNTS
from odocal_ros.screening.screen import screen

pytestmark = pytest.mark.slow
SLIP_M, SLIP_S = 0.5, 200.0
MADE = {'scenario': 'town', 'duration': 300.0, 'imu_grade': 'industrial', 'odometer_rate': 50.0,
        'seed': 8}


def spun(made, samples):
    """Return rows of a wheel that slips by half a metre within half a second."""
    t = drives.seconds(made.leg(), samples)
    more = SLIP_M / made.truth.scale * np.clip((t - SLIP_S) / 0.5, 0.0, 1.0)
    return replace(samples, value=samples.value + np.round(more).astype(np.int64))


def screened(made, odometer, **more):
    inputs, found = screen(replace(made.leg(), odometer=odometer, **more), settings(made))
    return inputs, {r.code: r.text for r in found}


def since_first(samples):
    return (samples.stamp_ns - samples.stamp_ns[0]) * 1e-9


@pytest.fixture(scope='module')
def true(made):
    return screened(made, made.odometer)[0]


def increments(made):
    leg = with_increments(made.leg())
    return leg.odometer, leg.form


def of_smoother(made, samples):
    leg = replace(made.leg(), odometer=samples)
    result = calibrate(leg, settings(made, heading_sigma=None, method='smoother'))
    return result.methods['smoother'], reason_texts(result)


@pytest.fixture(scope='module')
def straight(made):
    return of_smoother(made, made.odometer)[0].estimates['scale_factor']


@pytest.mark.parametrize(('how_long_s', 'drain_s'), [(0.12, 1e-4), (0.12, 0.01), (1.5, 0.012)],
                         ids=['at once', 'slow line', 'starved'])
def test_late_rows_are_moved_to_their_sampling_times(made, true, how_long_s, drain_s):
    late, held = delayed_in_bursts(made.odometer, how_long_s=how_long_s, drain_s=drain_s)
    inputs, found = screened(made, late)
    assert len(inputs.travel.t) == len(true.travel.t)
    moving = np.abs(np.gradient(true.travel.s, true.travel.t)) * made.truth.scale > 2.0
    at = held & moving
    assert at.sum() > 50
    assert np.abs(inputs.travel.t - true.travel.t)[at].max() < 0.003      # they were 0.12 s late
    np.testing.assert_array_equal(inputs.travel.s, true.travel.s)
    worst = float(found[Code.ODOMETER_LATE].split('by up to ')[1].split(' s')[0])
    assert how_long_s - 0.03 < worst <= how_long_s


def test_late_rows_are_not_slip_and_a_slip_between_them_is_found(made, straight):
    late, _ = delayed_in_bursts(made.odometer)
    method, texts = of_smoother(made, late)
    assert Code.ODOMETER_LATE in texts
    assert Code.WHEEL_SLIP not in texts
    found = method.estimates['scale_factor']
    assert abs(found.value - straight.value) < 0.1 * straight.sigma
    assert found.sigma == pytest.approx(straight.sigma, rel=0.05)
    late, _ = delayed_in_bursts(spun(made, made.odometer))
    method, texts = of_smoother(made, late)
    assert Code.ODOMETER_LATE in texts
    assert Code.WHEEL_SLIP in texts
    largest = method.details['slips'][0]
    assert largest['metres'] == pytest.approx(SLIP_M, rel=0.25)
    assert largest['t'] - 1.5 < SLIP_S < largest['t'] + largest['duration'] + 1.5


def arrivals(samples, seconds, lost=0.0, seed=3):
    """Return rows stamped at arrival, in order, late by an exponential time of that mean."""
    rng = np.random.default_rng(seed)
    late_ns = np.round(rng.exponential(seconds, len(samples.stamp_ns)) * 1e9).astype(np.int64)
    stamps = np.maximum.accumulate(samples.stamp_ns + late_ns)
    kept = rng.random(len(stamps)) >= lost
    return take(OdometerSamples(stamps, stamps, samples.value), kept)


@pytest.mark.parametrize(('seconds', 'off_s'), [(0.005, 0.0005), (0.02, 0.002), (0.05, 0.01)])
def test_rows_with_random_delays_are_corrected_to_the_regular_interval(made, true, seconds, off_s):
    """Up to several intervals late, some together: 1000 rows have a mean to 50 ms / sqrt(100)."""
    late = arrivals(made.odometer, seconds)
    inputs, found = screened(made, late)
    assert len(inputs.travel.t) == len(true.travel.t)
    later = inputs.travel.t - true.travel.t
    assert np.abs(later - np.median(later)).max() < off_s
    assert set(found) == {Code.ODOMETER_LATE}


@pytest.mark.parametrize('lost', [0.0, 0.001])
def test_arrival_jitter_is_measured(made, lost):
    """Of an exponential distribution 95 % in the middle are 3.66 means wide."""
    late = arrivals(made.odometer, 0.005, lost)
    assert late_rows.arrival_jitter(since_first(late)) == pytest.approx(0.005 * 3.66 / 4, rel=0.1)
    t = since_first(made.odometer)
    assert late_rows.arrival_jitter(t) == pytest.approx(0.0, abs=1e-9)
    assert late_rows.arrival_jitter(t[:10]) is None


def test_rows_of_one_stamp_have_an_arrival_jitter():
    t = np.append(np.zeros(3000), np.arange(1, 301) / 10)
    assert 0.0 < late_rows.arrival_jitter(t) < 30.0


def test_arrival_jitter_is_not_slip(made, straight):
    """A jitter of 20 ms at 12 m/s is 0.24 m; a slip of 0.5 m is found as without jitter."""
    method, texts = of_smoother(made, arrivals(made.odometer, 0.02))
    assert Code.WHEEL_SLIP not in texts
    sigma = method.estimates['scale_factor'].sigma
    assert sigma == pytest.approx(straight.sigma, rel=0.1)
    method, texts = of_smoother(made, arrivals(spun(made, made.odometer), 0.02))
    assert Code.WHEEL_SLIP in texts
    assert method.details['slips'][0]['metres'] == pytest.approx(SLIP_M, rel=0.25)


def test_lost_rows_among_late_ones_keep_their_interval(made, true):
    """The rows after a lost one are an interval later: 0.02 s, at 12 m/s 0.24 m."""
    late = arrivals(made.odometer, 0.002, lost=0.002)
    inputs, _ = screened(made, late)
    moving = np.gradient(inputs.travel.s, inputs.travel.t) * made.truth.scale > 2.0
    # the time at which the vehicle was at the position of a row
    at = np.interp(inputs.travel.s, true.travel.s, true.travel.t)
    later = (inputs.travel.t - at)[moving]
    assert np.percentile(np.abs(later - np.median(later)), 95) < 0.006


@pytest.mark.parametrize('share', [0.05, 0.15, 0.25])
@pytest.mark.parametrize('seconds', [0.0, 0.001])
def test_rows_lost_by_chance_do_not_make_the_others_late(made, true, share, seconds):
    """By an arrival jitter of 1 ms no row is 20 ms late, the limit; a lost row would be."""
    late = arrivals(made.odometer, seconds, lost=share)
    inputs, found = screened(made, late)
    assert Code.ODOMETER_LATE not in found
    moved = inputs.travel.t - drives.seconds(made.leg(), late)
    # later by the median delay at most, earlier by the largest
    assert moved.max() <= seconds + 1e-6
    assert -moved.min() <= 20 * seconds + 1e-6


@pytest.mark.parametrize('share', [0.0, 0.05, 0.25])
def test_the_interval_is_that_of_the_sender_with_lost_rows(made, share):
    """Stamps uniform over 6 ms: of 80 times 5 s the interval has a sigma of 0.05 ms."""
    rng = np.random.default_rng(3)
    t = since_first(made.odometer)
    t = (t + rng.uniform(0.0, 0.006, len(t)))[rng.random(len(t)) >= share]
    assert late_rows.intervals(t)[0] == pytest.approx(0.02, abs=2e-5)


def test_increments_that_arrive_together_are_all_counted_also_equal_ones(made):
    steps, form = increments(made)
    inputs, found = screened(made, arrivals(steps, 0.05), form=form)
    assert inputs.travel.s[-1] == steps.value[1:].sum()
    assert Code.STAMPS_NOT_RISING not in found
    steps, form = increments(made)
    k = int(np.flatnonzero((np.diff(steps.value) == 0) & (steps.value[1:] > 0))[100])
    at_once = (k + 1, steps.stamp_ns[k])
    inputs, _ = screened(made, changed(steps, stamp_ns=at_once, received_ns=at_once), form=form)
    assert inputs.travel.s[-1] == steps.value[1:].sum()


def test_rows_with_repeated_header_stamps_are_reported(made):
    k = int(np.flatnonzero(np.diff(made.odometer.value))[1000])
    twice = changed(made.odometer, stamp_ns=(k + 1, made.odometer.stamp_ns[k]))
    _, found = screened(made, twice)
    assert Code.STAMPS_NOT_RISING in found


def test_rows_of_a_changed_rate_or_at_irregular_times_keep_their_stamps(made):
    n = len(made.odometer.stamp_ns)
    rows = take(made.odometer, (np.arange(n) > n // 2) | (np.arange(n) % 2 == 0))
    inputs, found = screened(made, rows)
    np.testing.assert_allclose(inputs.travel.t, drives.seconds(made.leg(), rows), atol=1e-3)
    assert not found
    # stamps and counts agree: no row is moved to a regular interval
    even, counts = made.odometer.stamp_ns, made.odometer.value
    uneven = even + np.round(np.random.default_rng(4).uniform(0.0, 0.0039, len(even)) * 1e9
                             ).astype(np.int64)
    taken = replace(made.odometer, stamp_ns=uneven,
                    value=np.floor(np.interp(uneven, even, counts)).astype(np.int64))
    inputs, found = screened(made, taken)
    np.testing.assert_allclose(inputs.travel.t, drives.seconds(made.leg(), taken), atol=1e-9)
    assert not found


def test_rows_that_are_early_or_late_are_moved_to_the_mean():
    """The earliest of 250 rows is not regular then: 2.8 sigma early, by chance up to 3.2."""
    fine = drive(scenario='town', duration=400.0, odometer_rate=50.0, seed=8, scale=1e-3,
                 nominal_scale=1e-3)
    even_ns, sigma_s = fine.odometer.stamp_ns, 0.003
    late_ns = np.random.default_rng(5).normal(0.0, sigma_s * 1e9, len(even_ns))
    stamps = np.sort(even_ns + np.round(late_ns).astype(np.int64))
    sent = replace(fine.odometer, stamp_ns=stamps)
    true, _ = late_rows.sampling_times(sent, (sent.stamp_ns - even_ns[0]) * 1e-9, fine.leg().form)
    off = true - (even_ns - even_ns[0]) * 1e-9
    # the interval is that of 80 times 5 s, and of each 20 s the middle one of 1000 rows
    interval_s, middle_s = (1.25 * sigma_s * x for x in (np.sqrt(2 / 80) / 5.0, 1 / np.sqrt(1000)))
    assert np.abs(off - np.median(off)).max() < 4 * (10.0 * interval_s + middle_s)
    assert np.abs(late_ns).max() > 1e7


@pytest.mark.filterwarnings('error')
def test_rows_that_arrive_together_are_distributed(made):
    t = since_first(made.odometer)
    held = t % 15.0 < 0.4
    wait_s = np.where(held, 0.4 - t % 15.0, 0.0)
    stamps = made.odometer.stamp_ns + np.round(wait_s * 1e9).astype(np.int64)
    late = replace(made.odometer, stamp_ns=stamps)
    usual = late_rows.intervals(since_first(late))[0]
    assert usual == pytest.approx(0.02, rel=1e-6)
    true, _ = late_rows.sampling_times(late, since_first(late), made.leg().form)
    # at rest times are not observable and have no effect
    speed = np.abs(np.gradient(made.odometer.value.astype(float), t)) * made.truth.scale
    off = true - t + (stamps[0] - made.odometer.stamp_ns[0]) * 1e-9
    assert np.abs(off)[held & (speed > 2.0)].max() < 0.003


def test_lost_rows_within_a_burst(made, true):
    late, held = delayed_in_bursts(made.odometer)
    lost = held & (np.arange(len(held)) % 3 == 0)
    some = take(late, ~lost)
    inputs, _ = screened(made, some)
    raw = drives.seconds(made.leg(), some)
    off = np.abs(inputs.travel.s - true.travel.at(inputs.travel.t)).max() * made.truth.scale
    as_sent = np.abs(inputs.travel.s - true.travel.at(raw)).max() * made.truth.scale
    assert as_sent > 1.0
    assert off < 0.3 * as_sent


def test_increments_that_are_late_are_not_lost(made):
    steps, form = increments(made)
    late, _ = delayed_in_bursts(steps, how_long_s=0.5)
    inputs, found = screened(made, late, form=form)
    straight, _ = screened(made, steps, form=form)
    assert inputs.travel.s[-1] == straight.travel.s[-1]
    assert not len(inputs.uncertain_t)
    assert set(found) == {Code.ODOMETER_LATE}


def test_fresh_counts_at_odd_times_stay_where_they_are(made, true):
    t = since_first(made.odometer)
    odd = take(made.odometer, (t % 15.0 > 0.12) | (np.arange(len(t)) % 7 == 0))
    inputs, _ = screened(made, odd)
    off = np.abs(inputs.travel.s - true.travel.at(inputs.travel.t))
    assert off.max() <= ROUNDING_COUNTS + 0.5
    assert (inputs.travel.t <= drives.seconds(made.leg(), odd)).all()
