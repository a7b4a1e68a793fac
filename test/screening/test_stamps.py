# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Screening of stamps and counts: missing, repeated, out of order; steps, rollovers and jumps."""

from dataclasses import replace

from drives import changed, drive, kept, seconds, STRAIGHT, with_columns, with_increments
import numpy as np
import pytest
from screening_run import screen_with

from odocal_ros.data.samples import join, take
from odocal_ros.reasons import Code
from odocal_ros.screening.clocks import MAX_CLOCK_OFFSET, with_delay_sigmas
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config

pytestmark = pytest.mark.core


def test_rows_without_a_stamp_are_dropped_and_located_by_arrival(leg):
    inputs, codes = screen_with(with_columns(leg, 'odometer', stamp_ns=(slice(100, 105), 0)))
    n, t = len(leg.odometer.stamp_ns), (leg.odometer.received_ns[100] - leg.start_ns) * 1e-9
    assert codes[Code.BAD_ROWS_DROPPED] == (
        f'5 of {n} odometer messages have no stamp (zero or negative), first at t = {t:.2f} s '
        '(arrival); dropped')
    assert len(inputs.travel.t) == n - 5
    assert inputs.travel.s[-1] == leg.odometer.value[-1] - leg.odometer.value[0]


def test_one_stamp_in_the_future_excludes_one_row(leg):
    inputs, codes = screen_with(with_columns(
        leg, 'imu', stamp_ns=(500, leg.imu.stamp_ns[500] + 3600 * 10**9)))
    assert len(inputs.t_imu) == len(leg.imu.stamp_ns) - 1
    assert '1 of' in codes[Code.STAMPS_NOT_RISING]
    assert 'backward step' in codes[Code.STAMPS_NOT_RISING]
    assert Code.CLOCKS_DIFFER not in codes


@pytest.mark.parametrize(('slot', 'by'), [
    ('imu', -2.0), ('imu', -0.02), ('imu', 0.5), ('odometer', -2.0), ('odometer', 0.02),
    ('fix', -2.0), ('fix', 0.5)])
@pytest.mark.parametrize('wrong', ['before', 'after'])
def test_stamps_are_continuous_after_a_clock_step(leg, slot, by, wrong):
    stamps, moved = leg.rows(slot).stamp_ns, round(by * 1e9)
    at = len(stamps) * 2 // 5
    part, moved, mark = ((slice(at, None), moved, 'stop_ns') if wrong == 'after' else
                         (slice(at), -moved, 'start_ns'))
    other = with_columns(leg, slot, stamp_ns=(part, stamps[part] + moved))
    if slot == 'imu':       # whose stamps are used
        other = replace(other, **{mark: getattr(leg, mark) + moved})
    inputs, codes = screen_with(other)
    alone, _ = screen_with(leg)
    assert f'set by {by:+.3f} s' in codes[Code.CLOCK_SET]
    assert Code.CLOCKS_DIFFER not in codes
    # arrivals of this leg are exact, and with them the step
    for name in ('t_imu', 't_fix'):
        np.testing.assert_allclose(getattr(inputs, name), getattr(alone, name), atol=1e-6)
    np.testing.assert_allclose(inputs.travel.t, alone.travel.t, atol=1e-6)


@pytest.mark.parametrize('rows', [10, 50])
def test_stamps_out_of_order_are_not_a_clock_step(leg, rows):
    rng, order = np.random.default_rng(2), np.arange(len(leg.imu.stamp_ns) // rows * rows)
    order = rng.permuted(order.reshape(-1, rows), axis=1).ravel()
    mixed = replace(take(leg.imu, order), received_ns=leg.imu.received_ns[:len(order)])
    assert Code.CLOCK_SET not in screen_with(replace(leg, imu=mixed))[1]


def test_unstamped_or_disordered_rows_and_a_recorder_clock_are_no_clock_step(leg):
    unstamped = with_columns(leg, 'imu', stamp_ns=(slice(3000, 3200), 0))
    assert Code.CLOCK_SET not in screen_with(unstamped)[1]
    order = np.arange(len(leg.imu.stamp_ns))
    order[3000:3200] = np.random.default_rng(1).permutation(order[3000:3200])
    inputs, codes = screen_with(replace(leg, imu=take(leg.imu, order)))
    assert set(codes) == {Code.STAMPS_NOT_RISING}
    assert (np.diff(inputs.t_imu) > 0).all()
    lost = take(leg.imu, np.arange(len(leg.imu.stamp_ns)) != 4000)
    set_by = changed(lost, received_ns=(slice(4000), lost.received_ns[:4000] - 10**18))
    assert Code.CLOCK_SET not in screen_with(replace(leg, imu=set_by))[1]


def test_queued_messages_with_a_gap_are_not_a_clock_step(leg):
    """After a loss the lag is that of a queue, or it was before; soon it is the usual one."""
    imu, t = leg.imu, seconds(leg, leg.imu)
    queued = (t >= 101.0) & (t < 103.0)       # arrive together at 103 s, 10 us apart
    arrival = np.where(queued, leg.start_ns + 103 * 10**9 + 10_000 * np.cumsum(queued),
                       imu.received_ns)
    burst = take(replace(imu, received_ns=arrival), (t < 100.0) | (t >= 101.0))
    growing = np.where((t > 80.0) & (t < 100.0), (t - 80.0) / 10.0, 0.0)       # lag, s
    full = take(replace(imu, received_ns=imu.received_ns + np.round(growing * 1e9).astype(int)),
                (t < 100.0) | (t >= 102.0))
    for other in (burst, full):
        codes = screen_with(replace(leg, imu=other))[1]
        assert Code.CLOCK_SET not in codes
        assert Code.CLOCKS_DIFFER not in codes


@pytest.mark.parametrize('late_s', [0.05, 0.3])
def test_a_topic_that_arrives_again_later_is_not_a_clock_step(leg, late_s):
    again = replace(leg.fix, received_ns=leg.fix.received_ns + round(late_s * 1e9))
    both = join([leg.fix, again])
    inputs, codes = screen_with(replace(leg, fix=take(both, np.argsort(both.received_ns))))
    assert set(codes) == {Code.STAMPS_NOT_RISING}
    np.testing.assert_array_equal(inputs.geodetic[:, 0], leg.fix.latitude)


@pytest.mark.parametrize('packet', [2, 5])
def test_imu_packets_with_one_stamp_are_distributed_over_their_interval(leg, packet):
    n = len(leg.imu.stamp_ns) // packet * packet
    imu = take(leg.imu, slice(0, n))
    stamp = np.repeat(imu.stamp_ns[packet - 1::packet], packet)
    inputs, codes = screen_with(replace(leg, imu=replace(imu, stamp_ns=stamp)))
    alone, _ = screen_with(replace(leg, imu=imu))
    assert len(inputs.t_imu) == len(alone.t_imu) == n
    # stamps of IMUs have microseconds
    np.testing.assert_allclose(inputs.t_imu, alone.t_imu, atol=1e-6)
    assert 'all messages of a packet have one stamp' in codes[Code.STAMPS_NOT_RISING]


def test_duplicates_are_used_once(leg):
    twice = join([take(leg.fix, slice(0, 200)), take(leg.fix, slice(150, None))])
    again = take(leg.fix, np.repeat(np.arange(len(leg.fix.stamp_ns)), 2))
    imu = take(leg.imu, np.repeat(np.arange(len(leg.imu.stamp_ns)), 2))
    assert len(screen_with(replace(leg, imu=imu))[0].t_imu) == len(leg.imu.stamp_ns)
    for fix, repeats in ((twice, 50), (again, len(leg.fix.stamp_ns))):
        inputs, codes = screen_with(replace(leg, fix=fix))
        np.testing.assert_array_equal(inputs.geodetic[:, 0], leg.fix.latitude)
        assert f'{repeats} of {len(fix.stamp_ns)} messages dropped' in codes[
            Code.STAMPS_NOT_RISING]


def test_queued_messages_that_arrive_together_are_not_a_clock_offset(leg):
    """In simulated time that pauses for 8 s of 10, all arrive at the same time."""
    def queued(samples):
        t = seconds(leg, samples)
        late = np.where(t % 10 < 8, t - t % 10 + 8, t)
        return replace(samples, received_ns=leg.start_ns + np.round(late * 1e9).astype(np.int64))
    held = leg.with_rows(**{slot: queued(leg.rows(slot)) for slot in ('imu', 'odometer', 'fix')})
    assert Code.CLOCKS_DIFFER not in screen_with(held)[1]
    late = with_columns(held, 'fix', stamp_ns=lambda a: a + 700_000_000)
    assert 'fix stamps differ by +0.7' in screen_with(late)[1][Code.DELAY_SEEN]


@pytest.mark.parametrize(('slot', 'group'), [('odometer', 'odometer'), ('fix', 'gnss')])
@pytest.mark.parametrize('late', [0.8, -0.8, 1.2, -1.2])
def test_a_clock_offset_is_a_possible_delay_up_to_the_range_of_the_setting(leg, slot, group, late):
    moved = with_columns(leg, slot, stamp_ns=lambda a: a + round(late * 1e9))
    inputs, codes = screen_with(moved)
    is_delay = abs(late) < MAX_CLOCK_OFFSET
    text = codes[Code.DELAY_SEEN if is_delay else Code.CLOCKS_DIFFER]
    assert (Code.CLOCKS_DIFFER in codes) != is_delay
    seen = float(text.split('differ by ')[1].split(' s')[0])
    assert abs(seen - late) < 0.055       # the 0.05 s until fixes arrive looks the same
    assert (f'{group}.time_sigma was increased' in text) == is_delay
    config = with_delay_sigmas(Config(), inputs.clock_differences)
    changed_sigmas = {name for name in ('odometer', 'gnss') if getattr(config, name).time_sigma
                      != getattr(Config(), name).time_sigma}
    assert changed_sigmas == ({group} if is_delay else set())
    if is_delay:
        assert getattr(config, group).time_sigma == pytest.approx(abs(seen), abs=1e-3)
    if slot == 'fix':       # positions of marks have IMU stamps
        assert not {Code.CLOCKS_DIFFER, Code.DELAY_SEEN} & set(screen_with(
            moved, reference__points=[0.0, 0.0])[1])


@pytest.mark.parametrize(('slot', 'setting'), [('odometer', 'odometer.time_offset'),
                                               ('fix', 'gnss.time_offset')])
@pytest.mark.parametrize('late', [0.8, -0.8])
def test_a_configured_offset_corrects_the_stamps(leg, slot, setting, late):
    moved = with_columns(leg, slot, stamp_ns=lambda a: a + round(late * 1e9))
    inputs, codes = screen_with(moved, **{setting: -late})
    assert not {Code.CLOCKS_DIFFER, Code.DELAY_SEEN} & set(codes)
    t = inputs.travel.t if slot == 'odometer' else inputs.t_fix
    np.testing.assert_allclose(t, seconds(leg, leg.rows(slot)), atol=1e-9)


def test_an_offset_of_an_hour_suggests_no_setting_beyond_its_range(leg):
    _, found = screen(with_columns(leg, 'fix', stamp_ns=lambda a: a - 3600 * 10**9), Config())
    reason, = (r for r in found if r.code is Code.CLOCKS_DIFFER)
    assert '-3600.0' in reason.text
    assert 'gnss.time_offset' not in reason.text + reason.remedy
    assert 'use_sim_time' in reason.remedy


def test_the_imu_offset_moves_other_topics_as_marks_are_imu_stamps(leg):
    inputs, _ = screen_with(leg, imu__time_offset=0.25)
    np.testing.assert_allclose(inputs.travel.t, seconds(leg, leg.odometer) - 0.25, atol=1e-9)
    np.testing.assert_allclose(inputs.t_fix, seconds(leg, leg.fix) - 0.25, atol=1e-9)
    np.testing.assert_allclose(inputs.t_imu, seconds(leg, leg.imu), atol=1e-9)


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
