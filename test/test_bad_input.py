# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Bad input in the whole pipeline: nothing raises, each fault has its message and its remedy.

Every test ends in ``sound``: values are within their sigmas, a rejected leg has a reason.
"""

from dataclasses import replace
from functools import partial
import json
import re

import drives
from drives import kept, rejecting, seconds, settings, with_columns, without
import numpy as np
import pytest

from odocal_ros.data.samples import join, take
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code


def run(leg, made, **changes):
    """Calibrate and combine with the settings of a drive; check that the result is sound."""
    config = settings(made, **changes)
    result = calibrate(leg, config)
    whole = combine([result], config)
    said = drives.reason_texts(result)
    if whole.verdict.value == 'rejected':
        assert rejecting(result), 'rejected without a reason'
    for code, text in said.items():
        assert len(text) > 10
        assert code.remedy.endswith('.')
        assert 'nan' not in text.lower().split()
    for e in whole.estimates.values():
        assert (e.value is None) == (e.sigma is None)
        assert e.value is None or (np.isfinite(e.value) and e.sigma > 0)
    return result, said


def sound(result, truth, sigmas=5.0):
    """Check that values are within their sigmas."""
    assert result.verdict.value != 'rejected', drives.reason_texts(result)
    z = drives.errors_in_sigmas(result, truth)
    assert all(abs(x) < sigmas for x in z.values()), z


def sideways(a):
    return a[:, [2, 1, 0]] * [1, 1, -1]


def first(a):
    return np.full_like(a, a[0])


UNUSABLE = [
    (partial(with_columns, slot='imu', w_i=lambda a: a * np.nan), Code.NO_IMU,
     'none of the 10001 IMU messages is usable'),
    (partial(with_columns, slot='imu', stamp_ns=lambda a: 0 * a), Code.NO_IMU,
     'none of the 10001 IMU messages is usable: 10001 have no stamp (0)'),
    (partial(with_columns, slot='odometer', value=lambda a: a * np.nan), Code.NO_ODOMETER,
     'none of the 4000 odometer messages is usable'),
    (partial(with_columns, slot='fix', latitude=lambda a: a * np.nan), Code.FIXES_UNUSABLE,
     'none of the 1000 fix messages is usable'),
    (partial(without, slot='imu'), Code.NO_IMU, 'no IMU message between the marks'),
    (partial(without, slot='odometer'), Code.NO_ODOMETER, 'no odometer message between the marks'),
    (partial(without, slot='fix'), Code.NO_FIX, 'no fix message between the marks'),
    (partial(kept, slot='fix', rows=slice(500, 501)), Code.NO_FIX,
     '1 usable fix between the marks'),
    (partial(with_columns, slot='imu', w_i=lambda a: 0 * a), Code.NO_IMU,
     'all turn rates are zero'),
    (partial(with_columns, slot='imu', w_i=lambda a: a * [1.0, 1.0, 0.0]), Code.NO_IMU,
     'angular_velocity.z is always zero'),
    (partial(with_columns, slot='imu', w_i=sideways, f_i=sideways), Code.IMU_AXES,
     'gravity is on +x (up should be +z)'),
    (lambda leg: replace(leg, stop_ns=leg.start_ns + 14 * 10**9), Code.LEG_TOO_SHORT,
     'm between the marks; the limit is 100 m'),
    (lambda leg: replace(leg, stop_ns=leg.start_ns), Code.LEG_TOO_SHORT,
     'the stop mark is not after the start mark'),
    (partial(with_columns, slot='fix', latitude=first, longitude=first), Code.LEG_TOO_SHORT,
     'the odometer counts, but the fixes do not move')]
AT_REST = [
    (partial(drives.shifted, start=-55.0, stop=-145.0), Code.LEG_TOO_SHORT,
     'the vehicle did not move'),
    (partial(with_columns, slot='odometer', value=first), Code.ODOMETER_STILL,
     'the fixes move, but the odometer does not')]


@pytest.mark.parametrize(('spoil', 'code', 'text', 'nominal'), [
    *((*row, 0.02) for row in UNUSABLE + AT_REST), *((*row, 0.0) for row in AT_REST)],
    ids=lambda x: x[:40] if isinstance(x, str) else '')
def test_an_unusable_leg_is_rejected_for_its_cause(made, leg, spoil, code, text, nominal):
    with np.errstate(divide='raise', over='raise', invalid='raise'):
        result, said = run(spoil(leg), made, odometer__nominal_scale=nominal, method='auto')
    assert text in said[code]
    assert rejecting(result) == {code}


def test_two_counters_on_one_topic_are_reported_as_the_cause(made, leg):
    half_ns = int(np.diff(leg.odometer.stamp_ns).min()) // 2
    two = with_columns(leg, 'odometer', value=lambda a: a + 10**6, stamp_ns=lambda a: a + half_ns,
                       received_ns=lambda a: a + half_ns)
    both = join([leg.odometer, two.odometer])
    order = np.argsort(both.stamp_ns, kind='stable')
    result, said = run(replace(leg, odometer=take(both, order)), made)
    assert 'two publishers on the topic' in said[Code.COUNTER_ROLLOVER]
    assert rejecting(result)


@pytest.mark.parametrize('spoil', [
    *(partial(kept, slot=slot, rows=slice(first, first + n))
      for slot, first in (('imu', 5000), ('odometer', 700), ('fix', 700)) for n in (1, 2, 3)),
    *(partial(drives.shifted, start=by, stop=by) for by in (-3600.0, 3600.0))])
def test_a_few_rows_or_marks_outside_the_data_are_rejected(made, leg, spoil):
    assert rejecting(run(spoil(leg), made)[0])


def test_a_leg_with_ten_seconds_without_imu_is_reported(made, leg):
    result, said = run(without(leg, 'imu', 40, 50), made)
    assert said[Code.IMU_GAP].endswith('for 10.04 s at t = 39.98 s (1 gap; the limit is 0.5 s)')
    # straight ahead no turn is lost: the values are kept and correct
    assert max(map(abs, drives.errors_in_sigmas(result, made.truth).values())) < 5
    # a gap long before the leg has no effect
    result, said = run(without(leg, 'imu', -55, -50), made)
    assert Code.IMU_GAP not in said
    sound(result, made.truth)


def test_an_imu_that_starts_late_or_ends_early_is_reported(made, leg):
    assert 'at t = 49.98 s' in run(without(leg, 'imu', 50.0), made)[1][Code.IMU_GAP]
    assert Code.IMU_GAP in rejecting(run(without(leg, 'imu', -10.0), made)[0])
    assert 'no IMU data for 20.0' in run(without(leg, 'imu', end=20.0), made)[1][Code.IMU_GAP]


@pytest.mark.parametrize(('gone', 'text'), [
    ({'end': 20}, 'begins 20.0 s after the start mark'),
    ({'begin': 50}, 'ends 90.0 s before the stop mark'),
    ({'begin': 80}, 'ends 60.0 s before the stop mark'),
    ({'begin': 35, 'end': 45}, 'odometer gap of 10.')])
def test_missing_odometer_rows_do_not_reject_the_leg(made, leg, gone, text):
    result, said = run(without(leg, 'odometer', **gone), made)
    assert text in said[Code.TOPIC_GAP]
    assert Code.BAD_ROWS_DROPPED not in said       # and later fixes are not far from the track
    assert not result.evidence.excluded
    sound(result, made.truth)


@pytest.mark.parametrize('kind', ['increment', 'rate'])
def test_a_gap_of_increments_or_speeds_increases_the_sigma(made, leg, kind):
    made = drives.drive(**drives.STRAIGHT, odometer='speed') if kind == 'rate' else made
    leg = made.leg() if kind == 'rate' else drives.with_increments(leg)
    whole, _ = run(leg, made)
    result, said = run(without(leg, 'odometer', 20, 30), made)  # at the end of the acceleration
    assert Code.TOPIC_GAP in said
    sound(result, made.truth)
    sigma = [r.methods['two_point'].estimates['scale_factor'].sigma for r in (whole, result)]
    assert sigma[1] > 3 * sigma[0]


@pytest.mark.parametrize('heading_sigma', [1e-3, None])
def test_a_counter_that_counts_down_is_reported(made, leg, heading_sigma):
    down = with_columns(leg, 'odometer', value=lambda a: -a)
    result, _ = run(down, made, heading_sigma=heading_sigma)
    assert Code.ODOMETER_REVERSED in rejecting(result)
    assert 'odometer.reversed' in Code.ODOMETER_REVERSED.remedy
    scale = result.methods['two_point'].estimates['scale_factor']
    assert scale.value == pytest.approx(made.truth.scale, rel=2e-3)      # always above zero
    sound(run(down, made, heading_sigma=heading_sigma, odometer__reversed=True)[0], made.truth)


@pytest.mark.parametrize(('drive', 'spoil', 'setting', 'value'), [
    ('made', partial(with_columns, slot='imu', f_i=lambda a: a / 9.80665), 'imu.accel_scale',
     9.80665),
    ('town', partial(with_columns, slot='imu', w_i=np.degrees), 'imu.gyro_scale', np.pi / 180)])
def test_units_other_than_si_are_reported_with_a_setting(request, drive, spoil, setting, value):
    made = request.getfixturevalue(drive)
    leg = spoil(made.leg())
    result, said = run(leg, made)
    assert Code.IMU_UNITS in rejecting(result)
    remedy = next(r.remedy for r in result.reasons if r.code is Code.IMU_UNITS)
    assert f'Set {setting} to {value:.10g}, or publish' in remedy
    sound(run(leg, made, **{setting: value})[0], made.truth)


def test_degrees_on_a_straight_road_are_found_from_the_noise_at_rest(made, leg):
    leg = with_columns(leg, 'imu', w_i=np.degrees)
    result, said = run(leg, made)
    assert 'so its unit is probably deg/s' in said[Code.IMU_WORSE_THAN_GRADE]
    assert 'imu.gyro_scale' in Code.IMU_WORSE_THAN_GRADE.remedy
    assert result.verdict.value == 'caution'
    # the bias at rest is used, not that of a wrong grade, which gives 50 sigmas
    sound(result, made.truth, sigmas=6)
    sound(run(leg, made, imu__gyro_scale=np.pi / 180)[0], made.truth)


def test_an_imu_with_z_down_is_detected_and_used(town):
    def down(a):
        return a * [1.0, -1.0, -1.0]
    result, said = run(with_columns(town.leg(), 'imu', w_i=down, f_i=down), town)
    assert 'forward-right-down is assumed' in said[Code.IMU_LOOKS_Z_DOWN]
    assert result.verdict.value == 'caution'
    sound(result, town.truth)
    clean, _ = run(town.leg(), town)
    e, c = (r.methods['two_point'].estimates for r in (result, clean))
    for name in e:
        assert e[name].value == pytest.approx(c[name].value, rel=1e-9)
    # the published rotation includes the roll of 180 deg
    rpy = combine([result], settings(town)).imu_rotation_rpy
    assert abs(rpy[0]) == pytest.approx(np.pi, abs=0.05)
    assert rpy[2] == pytest.approx(town.truth.yaw, abs=0.01)


def test_a_gyro_with_the_wrong_sign_and_a_rotation_by_90_deg_are_reported(town):
    _, said = run(with_columns(town.leg(), 'imu', w_i=lambda a: a * [1.0, 1.0, -1.0]), town)
    assert set(said) == {Code.GYRO_SIGN}, 'one cause, and nothing that follows from it'
    result, _ = run(with_columns(town.leg(), 'imu', w_i=sideways, f_i=sideways), town)
    (reason,) = (r for r in result.reasons if r.code is Code.IMU_AXES)
    rpy = json.loads(re.search(r"--set 'imu.mounting_rpy=(\[.*?\])'", reason.remedy)[1])
    np.testing.assert_allclose(matrix_from_rpy(rpy), [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-8)
    # a rejected leg has a distance: a path by fixes cuts corners by some per cent
    assert result.distance == pytest.approx(town.truth.distance, rel=0.05)


def test_outlier_fixes_do_not_change_the_distance_of_a_rejected_leg(town):
    leg = with_columns(town.leg(), 'imu', f_i=lambda a: a[:, [2, 1, 0]])       # on its side
    plain, _ = run(leg, town)

    def with_outliers(latitude):
        latitude[[400, 401, 900]] += np.deg2rad([4.0, 4.0, -0.01])      # 445 km, 1.1 km
    result, said = run(with_columns(leg, 'fix', latitude=with_outliers), town)
    assert Code.IMU_AXES in said
    assert result.distance == pytest.approx(plain.distance, rel=0.01)


def test_an_odometer_that_stops_counting_rejects_the_leg(made, leg):
    """A loss of some metres is slip of a sliding wheel; more is a counter that stops."""
    t = seconds(leg, leg.odometer)

    def stands(begin, end):
        def value(counts):
            here = counts[(t >= begin) & (t < end)]
            return np.where(t < end, np.minimum(counts, here[0]), counts - np.ptp(here))
        return run(with_columns(leg, 'odometer', value=value), made)
    result, said = stands(40.0, np.inf)
    assert rejecting(result) == {Code.ODOMETER_STILL}
    assert re.fullmatch(r'the fixes move by \d+ m from t = 40 s to \d+ s, but the odometer does '
                        'not count', said[Code.ODOMETER_STILL])
    assert Code.ODOMETER_STILL in stands(40.0, 65.0)[1]
    assert Code.ODOMETER_STILL not in stands(40.0, 41.0)[1]


def test_fix_errors_at_a_standstill_are_not_motion(made, leg):
    t = seconds(leg, leg.fix)
    end = t[-1]
    for knots, north in (([100, 100.1], [0, 200]), ([91, 97, 100, 104], [0, 200, 200, 0]),
                         ([end - 40, end], [0, 60])):       # parked between walls
        off = np.interp(t, knots, north) * np.deg2rad(1 / 111e3)
        moved = replace(leg.fix, latitude=leg.fix.latitude + off)
        assert Code.ODOMETER_STILL not in run(replace(leg, fix=moved), made)[1]


def begun_moving(leg):
    """Return a leg without rows before its start mark, which is in motion."""
    leg = drives.shifted(leg, start=30.0)
    for slot in ('imu', 'odometer', 'fix'):
        leg = without(leg, slot, end=0.0)
    return leg


@pytest.mark.parametrize(('spoil', 'options', 'code', 'text'), [
    (begun_moving, {}, Code.NO_STANDSTILL, 'no standstill before the start mark'),
    (lambda leg: leg, {'odometer__nominal_scale': 1.0}, Code.SCALE_FAR_FROM_NOMINAL,
     '-97.9 % from the nominal value 1')])
def test_values_with_a_caution_are_within_their_sigmas(made, leg, spoil, options, code, text):
    result, said = run(spoil(leg), made, **options)
    assert text in said[code]
    assert result.verdict.value == 'caution'
    sound(result, made.truth)


def test_fixes_at_both_standstills_only_are_sufficient(made, leg):
    # standstills at both ends: fixes between are not needed, but then nothing checks the drive
    sound(run(without(leg, 'fix', 0, 85), made)[0], made.truth)
    for gone in ({'begin': 0}, {'end': 85}):
        result, said = run(without(leg, 'fix', **gone), made)
        assert rejecting(result) <= {Code.NO_FIX, Code.LEG_TOO_SHORT}, said
        assert rejecting(result)


@pytest.mark.parametrize('at', [250, 300, 310, 500, 700])    # one exactly at the start mark
def test_one_outlier_fix_does_not_change_the_result(made, leg, at):
    wild = with_columns(leg, 'fix', latitude=(at, leg.fix.latitude[at] + 0.05),
                        height=(at, 9000.0))
    sound(run(wild, made)[0], made.truth)
