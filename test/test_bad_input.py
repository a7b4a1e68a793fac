# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Bad input through the whole pipeline: nothing raises, each fault has its sentence and its remedy.

Every test ends in ``sound``: what is given holds within its sigma, what is rejected says why.
"""

from dataclasses import fields, replace
import json
import re

import drives
import numpy as np
import pytest

from odocal_ros.data.samples import FixSamples, ImuSamples, OdometerForm, OdometerSamples, take
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code

RAD_TO_DEG = 180 / np.pi


def run(leg, config):
    """Calibrate and combine; whatever comes must be sound."""
    result = calibrate(leg, config)
    whole = combine([result], config)
    said = drives.everything_said(result)
    if whole.verdict.value == 'rejected':
        assert drives.rejecting(result), 'rejected without a reason'
    for code, text in said.items():
        assert len(text) > 10
        assert code.remedy.endswith('.')
        assert 'nan' not in text.lower().split()
    for e in whole.estimates.values():
        assert (e.value is None) == (e.sigma is None)
        assert e.value is None or (np.isfinite(e.value) and e.sigma > 0)
    return result, said


def sound(result, truth, sigmas=5.0):
    """Check that a result that is given holds."""
    assert result.verdict.value != 'rejected', drives.everything_said(result)
    z = drives.errors_in_sigmas(result, truth)
    assert all(abs(x) < sigmas for x in z.values()), z


def spoilt(slot, **columns):
    """Return a function that changes columns of a topic of a leg."""
    return lambda leg: leg.with_rows(**{slot: drives.changed(leg.rows(slot), **columns)})


def sideways(a):
    return a[:, [2, 1, 0]] * [1, 1, -1]


def first(a):
    return np.full_like(a, a[0])


UNUSABLE = [
    (spoilt('imu', w_i=lambda a: a * np.nan), Code.NO_IMU,
     'none of the 10001 IMU messages is usable'),
    (lambda leg: replace(leg, odometer=replace(leg.odometer, value=np.full(4000, np.nan))),
     Code.NO_ODOMETER, 'none of the 4000 odometer messages is usable'),
    (spoilt('fix', latitude=lambda a: a * np.nan), Code.FIXES_UNUSABLE,
     'none of the 1000 fix messages is usable'),
    (lambda leg: replace(leg, imu=ImuSamples.none()), Code.NO_IMU,
     'no IMU message between the marks'),
    (lambda leg: replace(leg, odometer=OdometerSamples.none()), Code.NO_ODOMETER,
     'no odometer message between the marks'),
    (lambda leg: replace(leg, fix=FixSamples.none()), Code.NO_FIX,
     'no fix message between the marks'),
    (lambda leg: replace(leg, fix=take(leg.fix, slice(500, 501))), Code.NO_FIX,
     '1 usable fix between the marks'),
    (spoilt('imu', w_i=lambda a: 0 * a), Code.NO_IMU, 'all turn rates are zero'),
    (spoilt('imu', w_i=lambda a: a * [1.0, 1.0, 0.0]), Code.NO_IMU,
     'angular_velocity.z is always zero'),
    (spoilt('imu', w_i=sideways, f_i=sideways), Code.IMU_AXES,
     'gravity is on +x (up should be +z)'),
    (lambda leg: replace(leg, stop_ns=leg.start_ns + 14 * 10**9), Code.LEG_TOO_SHORT,
     'm between the marks; the limit is 100 m'),
    (lambda leg: replace(leg, stop_ns=leg.start_ns), Code.LEG_TOO_SHORT,
     'the stop mark is not after the start mark'),
    (spoilt('fix', latitude=first, longitude=first), Code.LEG_TOO_SHORT,
     'the odometer counts, but the fixes do not move')]
AT_REST = [
    (lambda leg: drives.shifted(leg, start=-55.0, stop=-145.0), Code.LEG_TOO_SHORT,
     'the vehicle did not move'),
    (spoilt('odometer', value=first), Code.ODOMETER_STILL,
     'the fixes move, but the odometer does not')]


@pytest.mark.parametrize(('spoil', 'code', 'text', 'nominal'), [
    *((*row, 0.02) for row in UNUSABLE + AT_REST), *((*row, 0.0) for row in AT_REST)],
    ids=lambda x: x[:40] if isinstance(x, str) else '')
def test_an_unusable_leg_is_rejected_for_its_cause(made, leg, spoil, code, text, nominal):
    with np.errstate(divide='raise', over='raise', invalid='raise'):
        result, said = run(spoil(leg), drives.settings(made, odometer__nominal_scale=nominal,
                                                       method='auto'))
    assert text in said[code]
    assert drives.rejecting(result) == {code}


def test_two_counters_on_one_topic_are_a_named_cause(made, leg):
    one, half_ns = leg.odometer, int(np.diff(leg.odometer.stamp_ns).min()) // 2
    two = drives.changed(one, value=lambda a: a + 10**6, stamp_ns=lambda a: a + half_ns,
                         received_ns=lambda a: a + half_ns)
    order = np.argsort(np.r_[one.stamp_ns, two.stamp_ns], kind='stable')
    both = OdometerSamples(*(np.concatenate([getattr(some, field.name) for some in (one, two)])[
        order] for field in fields(one)))
    result, said = run(replace(leg, odometer=both), drives.settings(made))
    assert 'two publishers on one topic' in said[Code.COUNTER_ROLLOVER]
    assert drives.rejecting(result)


@pytest.mark.parametrize('keep', [1, 2, 3])
@pytest.mark.parametrize('slot', ['imu', 'odometer', 'fix'])
def test_a_handful_of_rows(made, leg, slot, keep):
    few = take(leg.rows(slot), slice(5000, 5000 + keep) if slot == 'imu' else
               slice(700, 700 + keep))
    result, _ = run(leg.with_rows(**{slot: few}), drives.settings(made))
    assert drives.rejecting(result)


def test_ten_seconds_without_imu(made, leg):
    t = drives.seconds(leg, leg.imu)
    result, said = run(replace(leg, imu=take(leg.imu, (t < 40) | (t > 50))), drives.settings(made))
    assert said[Code.IMU_GAP].endswith('for 10.04 s at t = 39.98 s (1 gap; the limit is 0.5 s)')
    # straight on, nothing was lost: the values are kept and hold
    assert max(map(abs, drives.errors_in_sigmas(result, made.truth).values())) < 5
    # a gap long before the leg is none of its business
    result, said = run(replace(leg, imu=take(leg.imu, (t < -55) | (t > -50))),
                       drives.settings(made))
    assert Code.IMU_GAP not in said
    sound(result, made.truth)


def test_an_imu_that_ends_early(made, leg):
    t = drives.seconds(leg, leg.imu)
    result, said = run(replace(leg, imu=take(leg.imu, t < 50.0)), drives.settings(made))
    assert 'at t = 49.98 s' in said[Code.IMU_GAP]
    result, said = run(replace(leg, imu=take(leg.imu, t < -10.0)), drives.settings(made))
    assert Code.IMU_GAP in drives.rejecting(result)
    result, said = run(replace(leg, imu=take(leg.imu, t > 20.0)), drives.settings(made))
    assert 'no IMU data for 20.0' in said[Code.IMU_GAP]


def test_an_odometer_that_starts_late_or_ends_early_shortens_the_leg(made, leg):
    t = drives.seconds(leg, leg.odometer)
    for keep, text in ((t > 20, 'begins 20.0 s after the start mark'),
                       (t < 50, 'ends 90.0 s before the stop mark'),
                       (t < 80, 'ends 60.0 s before the stop mark')):
        result, said = run(replace(leg, odometer=take(leg.odometer, keep)), drives.settings(made))
        assert text in said[Code.TOPIC_GAP]
        assert Code.BAD_ROWS_DROPPED not in said       # nor are later fixes far off the track
        assert not result.evidence.excluded
        sound(result, made.truth)


def test_a_gap_in_the_odometer_lowers_the_weight_not_the_leg(made, leg):
    t = drives.seconds(leg, leg.odometer)
    result, said = run(replace(leg, odometer=take(leg.odometer, (t < 35) | (t > 45))),
                       drives.settings(made))
    assert Code.TOPIC_GAP in said
    sound(result, made.truth)


@pytest.mark.parametrize('kind', ['increment', 'rate'])
def test_a_gap_of_increments_or_speeds_widens_the_sigma(made, leg, kind):
    base = leg
    if kind == 'increment':
        step = np.diff(leg.odometer.value, prepend=leg.odometer.value[:1])
        base = replace(leg, odometer=drives.changed(leg.odometer, value=lambda a: step),
                       form=OdometerForm('increment', 0, 'm/pulse'))
        source = made
    else:
        source = drives.drive(**drives.STRAIGHT, odometer='speed')
        base = source.leg()
    t = drives.seconds(base, base.odometer)
    whole, _ = run(base, drives.settings(source))
    result, said = run(replace(base, odometer=take(base.odometer, (t < 20) | (t > 30))),
                       drives.settings(source))       # across the end of speeding up
    assert Code.TOPIC_GAP in said
    sound(result, source.truth)
    sigma = [r.methods['two_point'].estimates['scale_factor'].sigma for r in (whole, result)]
    assert sigma[1] > 3 * sigma[0]


@pytest.mark.parametrize('known', [True, False])
def test_a_counter_that_counts_down(made, leg, known):
    down = replace(leg, odometer=drives.changed(leg.odometer, value=lambda a: -a))
    config = drives.settings(made, heading_sigma=1e-3 if known else None)
    result, said = run(down, config)
    assert Code.ODOMETER_REVERSED in drives.rejecting(result)
    assert 'odometer.reversed' in Code.ODOMETER_REVERSED.remedy
    scale = result.methods['two_point'].estimates['scale_factor']
    assert scale.value == pytest.approx(made.truth.scale, rel=2e-3)      # always above zero
    result, _ = run(down, drives.settings(made, heading_sigma=1e-3 if known else None,
                                          odometer__reversed=True))
    sound(result, made.truth)


def test_g_instead_of_metres_per_second_squared(made, leg):
    in_g = replace(leg, imu=drives.changed(leg.imu, f_i=lambda a: a / 9.80665))
    result, said = run(in_g, drives.settings(made))
    assert Code.IMU_UNITS in drives.rejecting(result)
    assert 'set imu.accel_scale to 9.80665' in said[Code.IMU_UNITS]
    result, _ = run(in_g, drives.settings(made, imu__accel_scale=9.80665))
    sound(result, made.truth)


@pytest.mark.parametrize('scenario', ['town', 'straight'])
def test_degrees_instead_of_radians(made, town, scenario):
    it = town if scenario == 'town' else made
    leg = replace(it.leg(), imu=drives.changed(it.imu, w_i=lambda a: a * RAD_TO_DEG))
    result, said = run(leg, drives.settings(it))
    if scenario == 'town':
        assert Code.IMU_UNITS in drives.rejecting(result)
        assert 'set imu.gyro_scale to 0.017453292519943295' in said[Code.IMU_UNITS]
    else:      # a straight road turns nothing to tell it by, but at rest the noise does
        assert 'so its unit is probably deg/s' in said[Code.IMU_WORSE_THAN_GRADE]
        assert 'imu.gyro_scale' in Code.IMU_WORSE_THAN_GRADE.remedy
        assert result.verdict.value == 'caution'
        # the bias read at rest is believed, not that of a grade so clearly wrong: 50 sigmas else
        assert all(abs(z) < 6 for z in drives.errors_in_sigmas(result, it.truth).values())
    result, _ = run(leg, drives.settings(it, imu__gyro_scale=1 / RAD_TO_DEG))
    sound(result, it.truth)


def test_a_z_down_imu_is_read_as_what_it_is(town):
    leg = replace(town.leg(), imu=drives.changed(town.imu, w_i=lambda a: a * [1.0, -1.0, -1.0],
                                                 f_i=lambda a: a * [1.0, -1.0, -1.0]))
    result, said = run(leg, drives.settings(town))
    assert 'forward-right-down is assumed' in said[Code.IMU_LOOKS_Z_DOWN]
    assert result.verdict.value == 'caution'
    sound(result, town.truth)
    clean, _ = run(town.leg(), drives.settings(town))
    e, c = (r.methods['two_point'].estimates for r in (result, clean))
    for name in e:
        assert e[name].value == pytest.approx(c[name].value, rel=1e-9)
    # the whole rotation, roll of half a turn and all, is what goes out
    rpy = combine([result], drives.settings(town)).imu_rotation_rpy
    assert abs(rpy[0]) == pytest.approx(np.pi, abs=0.05)
    assert rpy[2] == pytest.approx(town.truth.yaw, abs=0.01)


def test_a_gyro_with_the_wrong_sign_is_named(town):
    leg = replace(town.leg(), imu=drives.changed(town.imu, w_i=lambda a: a * [1.0, 1.0, -1.0]))
    result, said = run(leg, drives.settings(town))
    assert set(said) == {Code.GYRO_SIGN}, 'one cause, and nothing that follows from it'


def test_a_quarter_turn_is_told_with_the_setting_that_undoes_it(town):
    result, _ = run(spoilt('imu', w_i=sideways, f_i=sideways)(town.leg()), drives.settings(town))
    (reason,) = (r for r in result.reasons if r.code is Code.IMU_AXES)
    rpy = json.loads(re.search(r"--set 'imu.mounting_rpy=(\[.*?\])'", reason.remedy)[1])
    np.testing.assert_allclose(matrix_from_rpy(rpy), [[0, 0, -1], [0, 1, 0], [1, 0, 0]], atol=1e-8)
    # refused, it still knows how far it was: knots on fixes cut corners by some per cent
    assert result.distance == pytest.approx(town.truth.distance, rel=0.05)


def test_a_stray_fix_is_no_way_of_a_leg_that_is_refused(town):
    on_its_side = replace(town.imu, f_i=town.imu.f_i[:, [2, 1, 0]])
    leg = replace(town.leg(), imu=on_its_side)
    plain, _ = run(leg, drives.settings(town))

    def stray(latitude):
        latitude[[400, 401, 900]] += np.deg2rad([4.0, 4.0, -0.01])      # 445 km, 1.1 km
        return latitude
    result, said = run(replace(leg, fix=drives.changed(leg.fix, latitude=stray)),
                       drives.settings(town))
    assert Code.IMU_AXES in said
    assert result.distance == pytest.approx(plain.distance, rel=0.01)


def test_an_odometer_that_stops_counting_on_the_way(made, leg):
    """What a wheel loses as it slides for some metres is slip; more is a counter that stands."""
    t = drives.seconds(leg, leg.odometer)

    def stands(begin, end):
        def value(counts):
            here = counts[(t >= begin) & (t < end)]
            return np.where(t < end, np.minimum(counts, here[0]), counts - np.ptp(here))
        return run(replace(leg, odometer=drives.changed(leg.odometer, value=value)),
                   drives.settings(made))
    result, said = stands(40.0, np.inf)
    assert drives.rejecting(result) == {Code.ODOMETER_STILL}
    assert re.fullmatch(r'the fixes move by \d+ m from t = 40 s to \d+ s, but the odometer does '
                        'not count', said[Code.ODOMETER_STILL])
    assert Code.ODOMETER_STILL in stands(40.0, 65.0)[1]
    assert Code.ODOMETER_STILL not in stands(40.0, 41.0)[1]
    # nor do fixes move that jump by 200 m while the vehicle waits, or stray and come back
    t = drives.seconds(leg, leg.fix)
    end = t[-1]
    for knots, north in (([100, 100.1], [0, 200]), ([91, 97, 100, 104], [0, 200, 200, 0]),
                         ([end - 40, end], [0, 60])):       # parked among walls
        latitude = leg.fix.latitude + np.interp(t, knots, north) * np.deg2rad(1 / 111e3)
        assert Code.ODOMETER_STILL not in run(
            replace(leg, fix=replace(leg.fix, latitude=latitude)), drives.settings(made))[1]


def test_no_standstill_before_the_start(made, leg):
    t = drives.seconds(leg, leg.imu)
    moving = drives.shifted(leg, start=30.0)
    cut = {slot: take(leg.rows(slot), drives.seconds(leg, leg.rows(slot)) > 30.0)
           for slot in ('imu', 'odometer', 'fix')}
    assert (t > 30.0).any()
    result, said = run(replace(moving, **cut), drives.settings(made))
    assert 'no standstill before the start mark' in said[Code.NO_STANDSTILL]
    assert result.verdict.value == 'caution'
    sound(result, made.truth)


def test_fixes_only_outside_the_drive(made, leg):
    t = drives.seconds(leg, leg.fix)
    # standing at both ends: the middle is not needed, but nothing checks the drive then
    result, _ = run(replace(leg, fix=take(leg.fix, (t < 0) | (t > 85))), drives.settings(made))
    sound(result, made.truth)
    for keep in (t < 0, t > 85):
        result, said = run(replace(leg, fix=take(leg.fix, keep)), drives.settings(made))
        assert drives.rejecting(result) <= {Code.NO_FIX, Code.LEG_TOO_SHORT}, said
        assert drives.rejecting(result)


@pytest.mark.parametrize('shift', [-3600, 3600])
def test_marks_outside_the_data(made, leg, shift):
    result, _ = run(drives.shifted(leg, start=float(shift), stop=float(shift)),
                    drives.settings(made))
    assert drives.rejecting(result)


def test_one_wild_fix_costs_nothing(made, leg):
    for at in (250, 300, 310, 500, 700):       # one at the very start mark, too
        wild = drives.changed(leg.fix, latitude=lambda a, at=at: a.__setitem__(at, a[at] + 0.05),
                              height=lambda a, at=at: a.__setitem__(at, 9000.0))
        result, _ = run(replace(leg, fix=wild), drives.settings(made))
        sound(result, made.truth)


def test_a_nominal_scale_of_another_world_is_a_caution(made, leg):
    result, said = run(leg, drives.settings(made, odometer__nominal_scale=1.0))
    assert '-97.9 % from the nominal value 1' in said[Code.SCALE_FAR_FROM_NOMINAL]
    assert result.verdict.value == 'caution'
    sound(result, made.truth)
