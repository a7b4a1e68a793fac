# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Screening: what is dropped, what is said of it, and that the rest is used."""

from dataclasses import replace

from drives import changed, drive, seconds, settings, STRAIGHT, TOWN
import numpy as np
import pytest

from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import join, OdometerForm, take
from odocal_ros.reasons import Code
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core


def said(leg, config=None):
    inputs, found = screen(leg, config or Config())
    return inputs, {r.code: r.text for r in found}, [r.text for r in found]


def test_a_clean_leg_is_used_to_the_last_row(leg):
    inputs, codes, _ = said(leg)
    assert codes == {}
    assert len(inputs.t_imu) == len(leg.imu.stamp_ns)
    assert len(inputs.travel.t) == len(leg.odometer.stamp_ns)
    assert len(inputs.t_fix) == len(leg.fix.stamp_ns)
    assert inputs.fixes_rejected == 0
    np.testing.assert_array_equal(inputs.w_b, leg.imu.w_i)


@pytest.mark.parametrize(('slot', 'column', 'label'), [
    ('imu', 'w_i', 'IMU'), ('imu', 'f_i', 'IMU'), ('fix', 'latitude', 'fix')])
@pytest.mark.parametrize('value', [np.nan, np.inf, -np.inf, 1e200])
def test_rows_that_hold_no_number_are_dropped_and_counted(leg, slot, column, label, value):
    bad = changed(leg.rows(slot), **{column: lambda a: a.__setitem__(slice(40, 43), value)})
    inputs, _, texts = said(leg.with_rows(**{slot: bad}))
    t = seconds(leg, bad)[40]
    if slot == 'fix' and value == 1e200:
        (text,) = texts
        assert text.startswith(f'3 of {len(bad.stamp_ns)} fixes are not used: 3 at an invalid '
                               'position (the first: latitude ')
    else:
        assert texts == [f'3 of {len(bad.stamp_ns)} {label} messages hold NaN, Inf or an '
                         f'impossible value, first at t = {t:.2f} s; dropped']
    kept = inputs.t_imu if slot == 'imu' else inputs.t_fix
    assert len(kept) == len(bad.stamp_ns) - 3
    assert np.isfinite(inputs.w_b).all()
    assert np.isfinite(inputs.f_b).all()


def test_rows_without_a_stamp_are_dropped_and_found_by_arrival(leg):
    bad = changed(leg.odometer, stamp_ns=lambda a: a.__setitem__(slice(100, 105), 0))
    inputs, codes, texts = said(replace(leg, odometer=bad))
    t = (leg.odometer.received_ns[100] - leg.start_ns) * 1e-9
    assert texts[0] == (f'5 of {len(bad.stamp_ns)} odometer messages have no stamp (zero or '
                        f'negative), first at t = {t:.2f} s; dropped')
    assert len(inputs.travel.t) == len(bad.stamp_ns) - 5
    assert inputs.travel.s[-1] == leg.odometer.value[-1] - leg.odometer.value[0]


def test_one_stamp_in_the_future_costs_one_row(leg):
    bad = changed(leg.imu, stamp_ns=lambda a: a.__setitem__(500, a[500] + 3600 * 10**9))
    inputs, codes, _ = said(replace(leg, imu=bad))
    assert len(inputs.t_imu) == len(bad.stamp_ns) - 1
    assert '1 of' in codes[Code.STAMPS_NOT_RISING]
    assert 'backward step' in codes[Code.STAMPS_NOT_RISING]
    assert Code.CLOCKS_DIFFER not in codes


@pytest.mark.parametrize(('slot', 'by'), [
    ('imu', -2.0), ('imu', -0.02), ('imu', 0.5), ('odometer', -2.0), ('odometer', 0.02),
    ('fix', -2.0), ('fix', 0.5)])
@pytest.mark.parametrize('wrong', ['before', 'after'])
def test_a_clock_that_was_set_runs_on(leg, slot, by, wrong):
    sent = leg.rows(slot)
    at, moved = len(sent.stamp_ns) * 2 // 5, round(by * 1e9)
    part = slice(at, None) if wrong == 'after' else slice(at)
    other = changed(sent, stamp_ns=lambda a: a.__setitem__(
        part, a[part] + (moved if wrong == 'after' else -moved)))
    marks = {}
    if slot == 'imu':       # which has its stamps
        marks = {'stop_ns': leg.stop_ns + moved} if wrong == 'after' else {
            'start_ns': leg.start_ns - moved}
    inputs, codes, _ = said(replace(leg.with_rows(**{slot: other}), **marks))
    alone, *_ = said(leg)
    assert f'set by {by:+.3f} s' in codes[Code.CLOCK_SET]
    assert Code.CLOCKS_DIFFER not in codes
    # arrivals of this leg are exact: what they show is
    for name in ('t_imu', 't_fix'):
        np.testing.assert_allclose(getattr(inputs, name), getattr(alone, name), atol=1e-6)
    np.testing.assert_allclose(inputs.travel.t, alone.travel.t, atol=1e-6)


@pytest.mark.parametrize('rows', [10, 50])
def test_stamps_in_disorder_are_no_clock_that_was_set(leg, rows):
    rng, order = np.random.default_rng(2), np.arange(len(leg.imu.stamp_ns) // rows * rows)
    order = rng.permuted(order.reshape(-1, rows), axis=1).ravel()
    mixed = replace(take(leg.imu, order), received_ns=leg.imu.received_ns[:len(order)])
    assert Code.CLOCK_SET not in said(replace(leg, imu=mixed))[1]


def test_rows_without_a_stamp_or_out_of_order_are_no_clock_that_was_set(leg):
    imu = changed(leg.imu, stamp_ns=lambda a: a.__setitem__(slice(3000, 3200), 0))
    assert Code.CLOCK_SET not in said(replace(leg, imu=imu))[1]
    order = np.arange(len(leg.imu.stamp_ns))
    order[3000:3200] = np.random.default_rng(1).permutation(order[3000:3200])
    inputs, codes, _ = said(replace(leg, imu=take(leg.imu, order)))
    assert set(codes) == {Code.STAMPS_NOT_RISING}
    assert (np.diff(inputs.t_imu) > 0).all()


def test_the_clock_of_the_recorder_is_not_that_of_the_sender(leg):
    lost = take(leg.imu, np.arange(len(leg.imu.stamp_ns)) != 4000)
    set_by = changed(lost, received_ns=lambda a: a.__setitem__(slice(4000), a[:4000] - 10**18))
    assert Code.CLOCK_SET not in said(replace(leg, imu=set_by))[1]


@pytest.mark.parametrize('late_s', [0.05, 0.3])
def test_a_topic_that_arrives_again_later_is_no_clock_that_was_set(leg, late_s):
    again = replace(leg.fix, received_ns=leg.fix.received_ns + round(late_s * 1e9))
    both = join([leg.fix, again])
    inputs, codes, _ = said(replace(leg, fix=take(both, np.argsort(both.received_ns))))
    assert set(codes) == {Code.STAMPS_NOT_RISING}
    np.testing.assert_array_equal(inputs.geodetic[:, 0], leg.fix.latitude)


@pytest.mark.parametrize('packet', [2, 5])
def test_imu_packets_with_one_stamp_are_spread_over_their_time(leg, packet):
    n = len(leg.imu.stamp_ns) // packet * packet
    imu = take(leg.imu, slice(0, n))
    stamp = np.repeat(imu.stamp_ns[packet - 1::packet], packet)
    inputs, codes, _ = said(replace(leg, imu=replace(imu, stamp_ns=stamp)))
    alone, *_ = said(replace(leg, imu=imu))
    assert len(inputs.t_imu) == len(alone.t_imu) == n
    # stamps of IMUs have microseconds
    np.testing.assert_allclose(inputs.t_imu, alone.t_imu, atol=1e-6)
    assert 'packets with one stamp' in codes[Code.STAMPS_NOT_RISING]


@pytest.mark.parametrize(('span', 'scale'), [
    (2**12, 0.02), (2**16, 0.02), (10_000, 0.02), (2**21, 0.0005)])
def test_a_counter_that_rolls_over_within_its_type_was_not_reset(span, scale):
    made = drive(**STRAIGHT | {'duration': 900.0}, odometer='counts', scale=scale)
    alone, *_ = said(made.leg())
    inputs, found = screen(replace(made.leg(), odometer=changed(
        made.leg().odometer, value=lambda value: value % span)), Config())
    codes, remedies = {r.code: r.text for r in found}, [r.remedy for r in found]
    assert np.diff(made.odometer.value[[0, -1]]) > 3 * span
    assert f'rolls over at {span}' in codes[Code.COUNTER_ROLLOVER]
    assert Code.COUNTER_RESET not in codes
    assert f'Set odometer.wrap to {span}.' in remedies
    np.testing.assert_array_equal(inputs.travel.s, alone.travel.s)


def test_jumps_between_values_farther_apart_than_a_span_are_no_rollover():
    """Each count is sent again 0.4 s later: it jumps back and on by much the same amount."""
    leg = drive(**STRAIGHT, odometer='counts', scale=0.001).leg()
    again = replace(leg.odometer, stamp_ns=leg.odometer.stamp_ns + 400_000_001)
    both = join([leg.odometer, again])
    _, codes, _ = said(replace(leg, odometer=take(both, np.argsort(both.stamp_ns))))
    assert Code.COUNTER_ROLLOVER not in codes


def test_duplicates_are_used_once(leg):
    twice = join([take(leg.fix, slice(0, 200)), take(leg.fix, slice(150, None))])
    again = take(leg.fix, np.repeat(np.arange(len(leg.fix.stamp_ns)), 2))
    imu = take(leg.imu, np.repeat(np.arange(len(leg.imu.stamp_ns)), 2))
    inputs, codes, _ = said(replace(leg, imu=imu))
    assert len(inputs.t_imu) == len(leg.imu.stamp_ns)
    for fix, repeats in ((twice, 50), (again, len(leg.fix.stamp_ns))):
        inputs, codes, _ = said(replace(leg, fix=fix))
        np.testing.assert_array_equal(inputs.geodetic[:, 0], leg.fix.latitude)
        assert f'{repeats} of {len(fix.stamp_ns)} messages dropped' in codes[
            Code.STAMPS_NOT_RISING]


def test_messages_that_queue_and_arrive_at_once_are_no_clock_that_differs(leg):
    """A node in simulated time that stands still for 8 s of 10 has them all at the same time."""
    def queued(samples):
        t = seconds(leg, samples)
        late = np.where(t % 10 < 8, t - t % 10 + 8, t)
        return replace(samples, received_ns=leg.start_ns + np.round(late * 1e9).astype(np.int64))
    slots = {slot: queued(leg.rows(slot)) for slot in ('imu', 'odometer', 'fix')}
    assert Code.CLOCKS_DIFFER not in said(replace(leg, **slots))[1]
    slots['fix'] = replace(slots['fix'], stamp_ns=slots['fix'].stamp_ns + 700_000_000)
    assert 'fix stamps differ by +0.7' in said(replace(leg, **slots))[1][Code.CLOCKS_DIFFER]


@pytest.mark.parametrize(('slot', 'setting'), [('odometer', 'odometer.time_offset'),
                                               ('fix', 'gnss.time_offset')])
@pytest.mark.parametrize('late', [0.8, -0.8])
def test_clocks_that_differ_refuse_the_leg_until_an_offset_is_set(leg, slot, setting, late):
    other = changed(leg.rows(slot), stamp_ns=lambda a: a + round(late * 1e9))
    moved = leg.with_rows(**{slot: other})
    _, codes, _ = said(moved)
    seen = float(codes[Code.CLOCKS_DIFFER].split('differ by ')[1].split(' s')[0])
    assert abs(seen - late) < 0.055       # fixes take 0.05 s to arrive, which looks the same
    assert f'to {setting}' in codes[Code.CLOCKS_DIFFER]
    if slot == 'fix':       # positions of marks have IMU stamps
        by_marks = with_settings(Config(), {'reference.points': [0.0, 0.0]})
        assert Code.CLOCKS_DIFFER not in said(moved, by_marks)[1]
    inputs, codes, _ = said(moved, with_settings(Config(), {setting: -late}))
    assert Code.CLOCKS_DIFFER not in codes
    t = inputs.travel.t if slot == 'odometer' else inputs.t_fix
    np.testing.assert_allclose(t, seconds(leg, leg.rows(slot)), atol=1e-9)


def test_a_clock_an_hour_off_names_no_offset_that_cannot_be_set(leg):
    far = changed(leg.fix, stamp_ns=lambda a: a - 3600 * 10**9)
    _, found = screen(replace(leg, fix=far), Config())
    reason, = (r for r in found if r.code is Code.CLOCKS_DIFFER)
    assert '-3600.0' in reason.text
    assert 'gnss.time_offset' not in reason.text + reason.remedy
    assert 'use_sim_time' in reason.remedy


def test_the_imus_own_offset_moves_the_others_since_marks_are_imu_stamps(leg):
    inputs, _, _ = said(leg, with_settings(Config(), {'imu.time_offset': 0.25}))
    np.testing.assert_allclose(inputs.travel.t, seconds(leg, leg.odometer) - 0.25, atol=1e-9)
    np.testing.assert_allclose(inputs.t_fix, seconds(leg, leg.fix) - 0.25, atol=1e-9)
    np.testing.assert_allclose(inputs.t_imu, seconds(leg, leg.imu), atol=1e-9)


def test_an_empty_leg_screens_to_nothing_without_a_fault():
    inputs, codes, _ = said(Leg(start_ns=10**18, stop_ns=10**18 + 10**9))
    assert {Code.NO_IMU, Code.NO_ODOMETER, Code.NO_FIX} <= set(codes)
    assert len(inputs.t_imu) == len(inputs.travel.t) == len(inputs.t_fix) == 0


@pytest.mark.filterwarnings('error')
def test_a_force_that_is_scaled_to_nothing_has_no_direction(leg):
    inputs, _ = screen(leg, with_settings(Config(), {'imu.accel_scale': 0.0}))
    assert not inputs.up_b.any()


def test_fixes_without_a_fix_are_left_out_nan_or_not(leg):
    def lost(fix, rows):
        return changed(fix, status=lambda a: a.__setitem__(rows, -1),
                       latitude=lambda a: a.__setitem__(rows, np.nan),
                       longitude=lambda a: a.__setitem__(rows, np.nan))
    n = len(leg.fix.stamp_ns)
    inputs, codes, _ = said(replace(leg, fix=lost(leg.fix, slice(0, 9))))
    assert codes == {Code.BAD_ROWS_DROPPED: f'9 of {n} fixes are not used: 9 with status below 0'}
    assert inputs.fixes_rejected == 9
    inputs, codes, _ = said(replace(leg, fix=lost(leg.fix, slice(None))))
    assert codes == {
        Code.FIXES_UNUSABLE: f'{n} of {n} fixes are not used: {n} with status below 0'}
    assert 'gnss.min_status' in Code.FIXES_UNUSABLE.remedy
    assert len(inputs.t_fix) == 0
    # asked for, even a fix that is none is no position
    inputs, codes, _ = said(replace(leg, fix=lost(leg.fix, slice(0, 9))),
                            with_settings(Config(), {'gnss.min_status': -1}))
    assert len(inputs.t_fix) == n - 9
    assert np.isfinite(inputs.geodetic).all()


@pytest.mark.parametrize(('columns', 'text'), [
    ({'latitude': 0.0, 'longitude': 0.0}, '4 at an invalid position (the first: '
     'latitude 0, longitude 0 deg, altitude '),
    ({'latitude': 2.0}, '4 at an invalid position (the first: latitude 114.592, '),
    ({'longitude': 1.0}, '4 at an invalid position'),      # half a world from the others
    ({'height': 5e4}, 'altitude 50000 m)'),      # 50 m in mm
    ({'status': -1}, '4 with status below 0')])
def test_fixes_at_no_real_place_are_left_out(leg, columns, text):
    bad = changed(leg.fix, **{k: lambda a, v=v: a.__setitem__(slice(70, 74), v)
                              for k, v in columns.items()})
    inputs, codes, _ = said(replace(leg, fix=bad))
    assert text in codes[Code.BAD_ROWS_DROPPED]
    assert inputs.fixes_rejected == 4


def test_fixes_that_other_reasons_name_are_not_counted_as_invalid(leg):
    bad = changed(leg.fix, latitude=lambda a: a.__setitem__(slice(70, 74), 2.0),
                  stamp_ns=lambda a: a.__setitem__(90, a[89]))
    _, found = screen(replace(leg, fix=bad), Config())
    (text,) = [r.text for r in found if 'are not used' in r.text]
    assert text.startswith(f'4 of {len(bad.stamp_ns)} fixes are not used: 4 at an invalid ')


@pytest.mark.parametrize('how', ['zero', 'nan', 'inf', 'negative', 'type'])
def test_an_unknown_covariance_is_taken_from_the_settings_and_said(leg, how):
    if how == 'type':
        bad = changed(leg.fix, covariance_type=lambda a: a * 0)
    else:
        value = {'zero': 0.0, 'nan': np.nan, 'inf': np.inf, 'negative': -1.0}[how]
        bad = changed(leg.fix, covariance_n=lambda a: a * 0 + value)
    n = len(bad.stamp_ns)
    inputs, codes, _ = said(replace(leg, fix=bad),
                            with_settings(Config(), {'gnss.default_sigma': 4.0}))
    assert codes[Code.COVARIANCE_UNKNOWN] == (
        f'{n} of {n} fixes have no usable covariance; 4 m (gnss.default_sigma) is used')
    np.testing.assert_array_equal(inputs.covariance_n[5], np.diag([16.0, 16.0, 64.0]))
    assert len(inputs.t_fix) == n         # unknown is not above gnss.max_sigma


def test_a_height_without_a_variance_leaves_the_level_part_standing(leg):
    bad = changed(leg.fix, covariance_n=lambda a: a.__setitem__((slice(None), 2, 2), np.nan))
    inputs, codes, _ = said(replace(leg, fix=bad))
    assert codes == {}
    np.testing.assert_array_equal(inputs.covariance_n[:, :2, :2], leg.fix.covariance_n[:, :2, :2])
    np.testing.assert_allclose(inputs.covariance_n[:, 2, 2], 4 * leg.fix.covariance_n[:, 0, 0])


def test_the_limit_of_poor_fixes_rises_with_the_median_of_the_leg(leg):
    usual = changed(leg.fix, covariance_n=lambda a: a * 0 + np.eye(3) * 16.0)
    poor = changed(usual, covariance_n=lambda a: a.__setitem__(slice(20, 26), np.eye(3) * 81.0))
    _, codes, _ = said(replace(leg, fix=poor))
    assert codes[Code.BAD_ROWS_DROPPED].endswith('6 with sigma above 8 m')
    _, codes, _ = said(replace(leg, fix=poor), with_settings(Config(), {'gnss.max_sigma': 3.0}))
    assert codes[Code.FIXES_UNUSABLE].endswith('with sigma above 3 m')


def test_poor_fixes_are_left_out_by_a_setting_no_gap_and_zero_takes_it_off(leg):
    poor = changed(leg.fix, covariance_n=lambda a: a.__setitem__(slice(100, 300), 25 * np.eye(3)))
    inputs, (reason,) = screen(replace(leg, fix=poor), Config())
    assert reason.code is Code.BAD_ROWS_DROPPED
    assert reason.text.endswith('200 with sigma above 3 m')
    assert 'gnss.max_sigma' in reason.remedy
    assert inputs.fixes_rejected == 200
    inputs, codes, _ = said(replace(leg, fix=poor), with_settings(Config(), {'gnss.max_sigma': 0}))
    assert codes == {}
    assert inputs.fixes_rejected == 0


@pytest.mark.parametrize(('slot', 'label'), [('odometer', 'odometer'), ('fix', 'fix')])
def test_a_gap_far_beyond_a_topics_own_rhythm_is_a_note(leg, slot, label):
    t = seconds(leg, leg.rows(slot))
    keep = (t < 30) | (t > 42)
    _, codes, _ = said(leg.with_rows(**{slot: take(leg.rows(slot), keep)}))
    assert set(codes) == {Code.TOPIC_GAP}
    assert codes[Code.TOPIC_GAP].startswith(f'{label} gap of 12.')
    assert Code.TOPIC_GAP.gravity.value == 'accepted'


@pytest.mark.parametrize(('length', 'size'), [(1, 50.0), (2, 5.0), (5, 10.0), (15, 3.0)])
def test_a_burst_of_false_rates_is_left_out(leg, length, size):
    rows = slice(4000, 4000 + length)
    bad = changed(leg.imu, w_i=lambda a: a.__setitem__((rows, 2), size))
    inputs, codes, _ = said(replace(leg, imu=bad))
    assert f'{length} of' in codes[Code.BAD_ROWS_DROPPED]
    assert 'isolated outliers' in codes[Code.BAD_ROWS_DROPPED]
    assert np.abs(inputs.w_b).max() < 0.1


@pytest.mark.parametrize(('slot', 'name', 'axis', 'size'), [
    ('w_i', 'w_b', 2, 0.05), ('w_i', 'w_b', 0, -0.7), ('f_i', 'f_b', 1, 20.0)])
def test_one_row_off_by_what_a_sensor_might_say_is_left_out(leg, slot, name, axis, size):
    """In 0.1 s, 0.4 rad/s turned a track by 2 deg: a scale 13 sigmas off was accepted."""
    def off(column):
        column[[4000, 5000, 6001], axis] += size
    inputs, codes, _ = said(replace(leg, imu=changed(leg.imu, **{slot: off})))
    assert '3 of' in codes[Code.BAD_ROWS_DROPPED]
    rows = np.delete(getattr(said(leg)[0], name), [4000, 5000, 6001], axis=0)
    assert np.array_equal(getattr(inputs, name), rows)


def test_hard_driving_is_no_glitch():
    """
    A robot that spins up by 10 rad/s^2 to 2 rad/s and stops as hard keeps all rows.

    At 50 Hz that is 0.2 rad/s from row to row, a quarter of the least bound of a glitch.
    """
    made = drive(scenario='straight', duration=200.0, imu_grade='consumer', seed=6)
    leg = made.leg()
    t = seconds(leg, leg.imu)
    spin = np.clip(10 * (t - 50.0), 0, 2) - np.clip(10 * (t - 50.3), 0, 2)
    bad = changed(leg.imu, w_i=lambda a: a.__setitem__((slice(None), 2), a[:, 2] + spin))
    inputs, codes, _ = said(replace(leg, imu=bad))
    assert Code.BAD_ROWS_DROPPED not in codes
    assert len(inputs.t_imu) == len(t)


def test_a_gyro_with_coarse_steps_does_not_hang():
    leg, step = drive(**TOWN).leg(), np.radians(0.25)
    coarse = changed(leg.imu, w_i=lambda w: np.round(w / step) * step + step)
    assert Code.IMU_GAP not in said(replace(leg, imu=coarse))[1]


def test_a_gyro_that_hangs_while_the_wheels_roll_is_a_gap(leg):
    t = seconds(leg, leg.imu)
    hung = slice(np.searchsorted(t, 60.0), np.searchsorted(t, 64.0))
    bad = changed(leg.imu, w_i=lambda a: a.__setitem__(hung, a[hung.start]))
    _, codes, _ = said(replace(leg, imu=bad))
    assert codes[Code.IMU_GAP].startswith('the gyro repeats one value for 3.98 s at t = 60.00 s')
    # at rest a quantised gyro may well repeat itself
    rest = slice(np.searchsorted(t, -30.0), np.searchsorted(t, -20.0))
    bad = changed(leg.imu, w_i=lambda a: a.__setitem__(rest, a[rest.start]))
    assert Code.IMU_GAP not in said(replace(leg, imu=bad))[1]


class TestOdometerCare:
    """False counts, lost increments: the travel stays that of the true counter."""

    @staticmethod
    def travelled(leg):
        return said(leg)[0].travel

    @pytest.mark.parametrize('value', [0, -50_000, 2**62, 10**9])
    @pytest.mark.parametrize('length', [1, 20, 300])
    def test_a_counter_that_jumps_away_and_back_is_mended(self, leg, value, length):
        rows = slice(2000, 2000 + length)
        bad = changed(leg.odometer, value=lambda a: a.__setitem__(rows, value))
        inputs, codes, _ = said(replace(leg, odometer=bad))
        assert Code.COUNTER_RESET not in codes
        true = self.travelled(leg)
        assert inputs.travel.s[-1] == true.s[-1]
        assert 'are frozen or isolated outliers' in codes[Code.BAD_ROWS_DROPPED]
        assert inputs.doubt_sigma.sum() == 0

    @pytest.mark.parametrize('first', [1200, 2500])      # from rest, and at 12 m/s
    def test_a_counter_that_hangs_and_catches_up_is_mended(self, leg, first):
        rows = slice(first, first + 150)
        bad = changed(leg.odometer, value=lambda a: a.__setitem__(rows, a[first]))
        inputs, codes, _ = said(replace(leg, odometer=bad))
        assert Code.COUNTER_RESET not in codes
        assert inputs.travel.s[-1] == self.travelled(leg).s[-1]

    def test_a_reset_is_bridged_and_leaves_a_doubt_that_covers_it(self, leg):
        at = 2000     # 12 m/s
        bad = changed(leg.odometer, value=lambda a: a.__setitem__(slice(at, None), a[at:] - a[at]))
        inputs, codes, _ = said(replace(leg, odometer=bad))
        assert 'a reset, not motion' in codes[Code.COUNTER_RESET]
        error = inputs.travel.s[-1] - self.travelled(leg).s[-1]
        speed = 12.0 / drive(scenario='straight', duration=200.0, imu_grade='tactical',
                             seed=5).options.scale
        # one interval at the speed beside it, uniform between none and two of it
        np.testing.assert_allclose(inputs.doubt_sigma, speed * 0.05 / np.sqrt(3), rtol=0.05)
        assert abs(error) < 3 * inputs.doubt_sigma[0]

    def test_lost_increments_are_bridged_at_the_speed_beside(self, leg):
        step = np.diff(leg.odometer.value, prepend=leg.odometer.value[:1])
        form = OdometerForm('increment', 0, 'm/pulse')
        whole = replace(leg, odometer=changed(leg.odometer, value=lambda a: step), form=form)
        keep = np.ones(len(step), bool)
        keep[2000:2040] = False
        inputs, codes, _ = said(replace(whole, odometer=take(whole.odometer, keep)))
        lost = step[2000:2040].sum()
        error = inputs.travel.s[-1] - self.travelled(whole).s[-1]
        # the speed is even there: but for rounding of counts at each side, nothing is lost
        assert abs(error) < 0.01 * lost
        assert abs(error) < 3 * inputs.doubt_sigma[0] < 0.2 * lost
        np.testing.assert_allclose(self.travelled(whole).s[-1], self.travelled(leg).s[-1])

    def test_a_speed_that_jumps_is_left_out(self):
        made = drive(**STRAIGHT, odometer='speed')
        bad = changed(made.odometer, value=lambda a: a.__setitem__([2500, 2900], [90.0, -40.0]))
        inputs, codes, _ = said(replace(made.leg(), odometer=bad))
        assert codes[Code.BAD_ROWS_DROPPED].startswith('2 of')
        np.testing.assert_allclose(inputs.travel.s[-1], self.travelled(made.leg()).s[-1],
                                   rtol=1e-6)


@pytest.mark.parametrize('q', [1e200, np.nan, 5e-324, 0.0, 7.0])
@pytest.mark.parametrize('variance', [0.01, np.nan, 1e300])
def test_an_orientation_that_is_none_is_not_used(leg, q, variance):
    bad = changed(leg.imu, q_ni=lambda a: a.__setitem__(slice(40, 60), q),
                  yaw_variance=lambda a: a.__setitem__(slice(40, 60), variance))
    with np.errstate(all='raise'):
        inputs, _, _ = said(replace(leg, imu=bad))
    assert not np.isfinite(inputs.yaw_variance[40:60]).any()
    assert np.abs(np.nan_to_num(inputs.q_ni)).max() <= 7.0
    assert len(inputs.t_imu) == len(leg.imu.stamp_ns)


@pytest.mark.parametrize('options', [{}, {'two_wheels': True}, {'odometer': 'speed'}])
def test_the_motion_alone_is_that_of_the_whole_screening(options):
    some = drive(scenario='town', duration=120.0, imu_grade='consumer', outliers=0.02, seed=4,
                 **options)
    spoilt = changed(some.imu, w_i=lambda a: a.__setitem__(slice(1500, 3500), 0.5),
                     q_ni=lambda a: a.__setitem__(slice(40, 60), 1e200))
    leg = replace(some.leg(), imu=spoilt)
    whole, found = screen(leg, settings(some))
    alone, _ = screen(leg, settings(some), judged=False)
    assert Code.IMU_GAP in {r.code for r in found}        # which the search for legs does not ask
    for name in ('t_imu', 'w_b', 'f_b', 't_fix', 'geodetic', 'covariance_n'):
        np.testing.assert_array_equal(getattr(alone, name), getattr(whole, name))
    np.testing.assert_array_equal(alone.travel.s, whole.travel.s)
