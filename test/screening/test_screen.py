# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Screening: which rows are dropped, what is reported, and that the others are used."""

from drives import drive, seconds, settings, with_columns, without
import numpy as np
import pytest
from screening_run import screen_with

from odocal_ros.data.leg import Leg
from odocal_ros.reasons import Code
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config

pytestmark = pytest.mark.core
FIXES = 'fixes of the leg and its pre-roll'


def test_a_clean_leg_is_used_to_the_last_row(leg):
    inputs, codes = screen_with(leg)
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
    damaged = with_columns(leg, slot, **{column: (slice(40, 43), value)})
    inputs, (reason,) = screen(damaged, Config())
    rows = leg.rows(slot)
    n, t = len(rows.stamp_ns), seconds(leg, rows)[40]
    if slot == 'fix' and value == 1e200:
        assert reason.text.startswith(f'3 of {n} {FIXES} are not used: 3 at an invalid '
                                      'position (the first: latitude ')
    else:
        assert reason.text == (f'3 of {n} {label} messages hold NaN, Inf or an impossible value, '
                               f'first at t = {t:.2f} s; dropped')
    assert len(inputs.t_imu if slot == 'imu' else inputs.t_fix) == n - 3
    assert np.isfinite(inputs.w_b).all()
    assert np.isfinite(inputs.f_b).all()


def test_an_empty_leg_gives_no_rows_and_no_error():
    inputs, codes = screen_with(Leg(start_ns=10**18, stop_ns=10**18 + 10**9))
    assert {Code.NO_IMU, Code.NO_ODOMETER, Code.NO_FIX} <= set(codes)
    assert len(inputs.t_imu) == len(inputs.travel.t) == len(inputs.t_fix) == 0


@pytest.mark.filterwarnings('error')
def test_a_force_that_is_scaled_to_zero_has_no_direction(leg):
    assert not screen_with(leg, imu__accel_scale=0.0)[0].up_b.any()


def test_fixes_with_the_status_no_fix_are_excluded(leg):
    def lost(rows):
        return with_columns(leg, 'fix', status=(rows, -1), latitude=(rows, np.nan),
                            longitude=(rows, np.nan))
    n = len(leg.fix.stamp_ns)
    inputs, codes = screen_with(lost(slice(0, 9)))
    assert codes == {Code.BAD_ROWS_DROPPED: f'9 of {n} {FIXES} are not used: 9 with status '
                     'below 0'}
    assert inputs.fixes_rejected == 9
    inputs, codes = screen_with(lost(slice(None)))
    assert codes == {
        Code.FIXES_UNUSABLE: f'{n} of {n} {FIXES} are not used: {n} with status below 0'}
    assert 'gnss.min_status' in Code.FIXES_UNUSABLE.remedy
    assert len(inputs.t_fix) == 0
    # also as configured, a message without a fix is not a position
    inputs, _ = screen_with(lost(slice(0, 9)), gnss__min_status=-1)
    assert len(inputs.t_fix) == n - 9
    assert np.isfinite(inputs.geodetic).all()


@pytest.mark.parametrize(('columns', 'text'), [
    ({'latitude': 0.0, 'longitude': 0.0}, '4 at an invalid position (the first: '
     'latitude 0, longitude 0 deg, altitude '),
    ({'latitude': 2.0}, '4 at an invalid position (the first: latitude 114.592, '),
    ({'longitude': 1.0}, '4 at an invalid position'),      # thousands of km from the others
    ({'height': 5e4}, 'altitude 50000 m)'),      # 50 m in mm
    ({'status': -1}, '4 with status below 0')])
def test_fixes_at_impossible_places_are_excluded(leg, columns, text):
    inputs, codes = screen_with(with_columns(
        leg, 'fix', **{k: (slice(70, 74), v) for k, v in columns.items()}))
    assert text in codes[Code.BAD_ROWS_DROPPED]
    assert inputs.fixes_rejected == 4


def test_fixes_that_other_reasons_name_are_not_counted_as_invalid(leg):
    bad = with_columns(leg, 'fix', latitude=(slice(70, 74), 2.0),
                       stamp_ns=(90, leg.fix.stamp_ns[89]))
    _, found = screen(bad, Config())
    (text,) = [r.text for r in found if 'are not used' in r.text]
    assert text.startswith(f'4 of {len(leg.fix.stamp_ns)} {FIXES} are not used: 4 at an '
                           'invalid ')


@pytest.mark.parametrize('column', [
    *({'covariance_n': (slice(None), value)} for value in (0.0, np.nan, np.inf, -1.0)),
    {'covariance_type': (slice(None), 0)}])
def test_an_unknown_covariance_is_taken_from_the_settings_and_reported(leg, column):
    inputs, codes = screen_with(with_columns(leg, 'fix', **column), gnss__default_sigma=4.0)
    n = len(leg.fix.stamp_ns)
    assert codes[Code.COVARIANCE_UNKNOWN] == (
        f'{n} of {n} fixes have no usable covariance; 4 m (gnss.default_sigma) is used')
    np.testing.assert_array_equal(inputs.covariance_n[5], np.diag([16.0, 16.0, 64.0]))
    assert len(inputs.t_fix) == n         # unknown is not above gnss.max_sigma


def test_a_height_without_a_variance_keeps_the_horizontal_variances(leg):
    inputs, codes = screen_with(
        with_columns(leg, 'fix', covariance_n=((slice(None), 2, 2), np.nan)))
    assert codes == {}
    np.testing.assert_array_equal(inputs.covariance_n[:, :2, :2], leg.fix.covariance_n[:, :2, :2])
    np.testing.assert_allclose(inputs.covariance_n[:, 2, 2], 4 * leg.fix.covariance_n[:, 0, 0])


def test_poor_fixes_are_excluded_beyond_a_limit_that_rises_with_the_median(leg):
    usual = with_columns(leg, 'fix', covariance_n=(slice(None), np.eye(3) * 16.0))
    poor = with_columns(usual, 'fix', covariance_n=(slice(20, 26), np.eye(3) * 81.0))
    assert screen_with(poor)[1][Code.BAD_ROWS_DROPPED].endswith('6 with sigma above 8 m')
    _, codes = screen_with(poor, gnss__max_sigma=3.0)
    assert codes[Code.FIXES_UNUSABLE].endswith('with sigma above 3 m')
    # a large number in place of an unknown sigma
    _, (reason,) = screen(with_columns(
        leg, 'fix', covariance_n=(slice(None), 1e8 * np.eye(3))), Config())
    assert reason.code is Code.FIXES_UNUSABLE
    assert reason.text.endswith('with sigma above 1000 m')
    assert 'position_covariance_type 0' in reason.remedy
    poor = with_columns(leg, 'fix', covariance_n=(slice(100, 300), 25 * np.eye(3)))
    inputs, (reason,) = screen(poor, Config())
    assert reason.code is Code.BAD_ROWS_DROPPED
    assert reason.text.endswith('200 with sigma above 3 m')
    assert 'gnss.max_sigma' in reason.remedy
    assert inputs.fixes_rejected == 200
    inputs, codes = screen_with(poor, gnss__max_sigma=0)
    assert codes == {}
    assert inputs.fixes_rejected == 0


@pytest.mark.parametrize('slot', ['odometer', 'fix'])
def test_a_gap_far_beyond_the_usual_interval_of_a_topic_is_a_note(leg, slot):
    _, (reason,) = screen(without(leg, slot, 30, 42), Config())
    assert reason.code is Code.TOPIC_GAP
    assert reason.text.startswith(f'{slot} gap of 12.')
    assert ('tunnel' in reason.remedy) == (slot == 'fix')
    assert Code.TOPIC_GAP.severity.value == 'accepted'


@pytest.mark.parametrize(('length', 'size'), [(1, 50.0), (2, 5.0), (5, 10.0), (15, 3.0)])
def test_a_burst_of_wrong_turn_rates_is_excluded(leg, length, size):
    inputs, codes = screen_with(
        with_columns(leg, 'imu', w_i=((slice(4000, 4000 + length), 2), size)))
    assert f'{length} of' in codes[Code.BAD_ROWS_DROPPED]
    assert 'isolated outliers' in codes[Code.BAD_ROWS_DROPPED]
    assert np.abs(inputs.w_b).max() < 0.1


@pytest.mark.parametrize(('slot', 'name', 'axis', 'size'), [
    ('w_i', 'w_b', 2, 0.05), ('w_i', 'w_b', 0, -0.7), ('f_i', 'f_b', 1, 20.0)])
def test_one_row_with_a_wrong_but_possible_rate_is_excluded(leg, slot, name, axis, size):
    """In 0.1 s, 0.4 rad/s turned a track by 2 deg: a scale 13 sigmas off was accepted."""
    rows = [4000, 5000, 6001]
    off = ((rows, axis), getattr(leg.imu, slot)[rows, axis] + size)
    inputs, codes = screen_with(with_columns(leg, 'imu', **{slot: off}))
    assert '3 of' in codes[Code.BAD_ROWS_DROPPED]
    assert np.array_equal(getattr(inputs, name),
                          np.delete(getattr(screen_with(leg)[0], name), rows, axis=0))


def test_hard_driving_is_not_a_glitch():
    """
    All rows are kept of a robot that turns at up to 2 rad/s with 10 rad/s^2 at start and stop.

    At 50 Hz that is 0.2 rad/s from row to row, a quarter of the smallest limit of a glitch.
    """
    leg = drive(scenario='straight', duration=200.0, imu_grade='consumer', seed=6).leg()
    t = seconds(leg, leg.imu)
    spin = np.clip(10 * (t - 50.0), 0, 2) - np.clip(10 * (t - 50.3), 0, 2)
    inputs, codes = screen_with(
        with_columns(leg, 'imu', w_i=lambda w: w + np.outer(spin, [0, 0, 1])))
    assert Code.BAD_ROWS_DROPPED not in codes
    assert len(inputs.t_imu) == len(t)


def test_a_gyro_that_hangs_is_a_gap_and_one_with_coarse_steps_is_not(town, leg):
    step = np.radians(0.25)
    coarse = with_columns(town.leg(), 'imu', w_i=lambda w: np.round(w / step) * step + step)
    assert Code.IMU_GAP not in screen_with(coarse)[1]
    def hung(begin, end):
        first, last = np.searchsorted(seconds(leg, leg.imu), [begin, end])
        return screen_with(
            with_columns(leg, 'imu', w_i=(slice(first, last), leg.imu.w_i[first])))[1]
    assert hung(60.0, 64.0)[Code.IMU_GAP].startswith(
        'the gyro repeats one value for 3.98 s at t = 60.00 s')
    # at rest a quantised gyro may repeat its value
    assert Code.IMU_GAP not in hung(-30.0, -20.0)


@pytest.mark.parametrize('q', [1e200, np.nan, 5e-324, 0.0, 7.0])
@pytest.mark.parametrize('variance', [0.01, np.nan, 1e300])
def test_an_invalid_orientation_is_not_used(leg, q, variance):
    rows = slice(40, 60)
    bad = with_columns(leg, 'imu', q_ni=(rows, q), yaw_variance=(rows, variance))
    with np.errstate(all='raise'):
        inputs, _ = screen_with(bad)
    assert not np.isfinite(inputs.yaw_variance[40:60]).any()
    assert np.abs(np.nan_to_num(inputs.q_ni)).max() <= 7.0
    assert len(inputs.t_imu) == len(leg.imu.stamp_ns)


@pytest.mark.parametrize('options', [{}, {'two_wheels': True}, {'odometer': 'speed'}])
def test_screening_of_motion_only_agrees_with_the_whole_screening(options):
    some = drive(scenario='town', duration=120.0, imu_grade='consumer', outliers=0.02, seed=4,
                 **options)
    leg = with_columns(some.leg(), 'imu', w_i=(slice(1500, 3500), 0.5),
                       q_ni=(slice(40, 60), 1e200))
    whole, found = screen(leg, settings(some))
    alone, _ = screen(leg, settings(some), check_faults=False)
    assert Code.IMU_GAP in {r.code for r in found}        # not needed in the search for legs
    for name in ('t_imu', 'w_b', 'f_b', 't_fix', 'geodetic', 'covariance_n'):
        np.testing.assert_array_equal(getattr(alone, name), getattr(whole, name))
    np.testing.assert_array_equal(alone.travel.s, whole.travel.s)
