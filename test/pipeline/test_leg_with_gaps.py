# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A leg that is cut at gaps of the IMU: its parts give the values of a leg without gaps."""

from dataclasses import replace

from drives import drive, off, seconds, settings, with_columns, without
import numpy as np
import pytest

from odocal_ros.calib.drive import ferry_intervals
from odocal_ros.data.samples import take
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.time_series import gaps_in_rhythm, gaps_longer
from odocal_ros.pipeline.calibrate import (
    calibrate,
    calibrate_parts,
    combine,
    imu_gaps,
    parts_between,
)
from odocal_ros.reasons import Code, Verdict

pytestmark = pytest.mark.slow
SCALE, YAW, PITCH = 'scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle'
GAP = (200.0, 203.0)
MADE = {'scenario': 'town', 'duration': 300.0, 'imu_grade': 'consumer', 'seed': 8}


def parts_of(leg):
    return parts_between(leg, imu_gaps(leg, 0.5))


def silent(leg, *gaps):
    """Return the leg with no IMU rows within some spans, s since the start mark."""
    for begin, end in gaps:
        leg = without(leg, 'imu', begin, end)
    return leg


def of(leg, *gaps):
    return [((p.start_ns - leg.start_ns) * 1e-9, (p.stop_ns - leg.start_ns) * 1e-9)
            for p in parts_of(silent(leg, *gaps))]


def test_gaps_are_intervals_beyond_a_limit_or_the_usual_interval():
    t = np.array([0.0, 1.0, 2.0, 5.0, 6.0])
    np.testing.assert_array_equal(gaps_longer(t, 1.5), [(2.0, 5.0)])
    assert len(gaps_in_rhythm(t)) == 0                  # too few rows for a usual interval
    t = np.r_[np.arange(20.0), 25.5]
    np.testing.assert_array_equal(gaps_in_rhythm(t), [(19.0, 25.5)])


def test_a_leg_is_cut_at_each_gap_and_nowhere_else(made):
    leg = made.leg()
    stop = (leg.stop_ns - leg.start_ns) * 1e-9
    assert parts_of(leg) == []
    assert of(leg, (50.0, 50.4)) == []
    row = 0.0201      # s, of the IMU
    assert of(leg, (50.0, 53.0), (120.0, 121.0)) == [
        (0.0, pytest.approx(50.0, abs=row)), (pytest.approx(53.0, abs=row),
                                              pytest.approx(120.0, abs=row)),
        (pytest.approx(121.0, abs=row), stop)]
    # no rows until the stop mark: the part before remains
    assert of(leg, (stop - 5.0, stop + 100.0)) == [(0.0, pytest.approx(stop - 5.0, abs=row))]
    # no rows before the start mark: the leg itself, without rows from before the gap
    (one,) = parts_of(silent(leg, (-8.0, -3.0)))
    assert (one.start_ns, one.stop_ns) == (leg.start_ns, leg.stop_ns)
    assert seconds(leg, one.imu).min() == pytest.approx(-3.0, abs=row)


def test_the_parts_of_a_leg_with_a_gap_are_combined(made):
    leg = made.leg()
    # a random walk of 10 % a day of the tyres does not apply between two parts of one leg
    config = settings(made, heading_sigma=None, method='smoother', verdict__max_yaw_sigma=0.0087,
                      verdict__max_scale_sigma=0.001, verdict__scale_drift_per_day=0.1)
    cut = silent(leg, GAP)
    alone = calibrate(cut, config)
    assert Code.IMU_GAP in {r.code for r in alone.reasons}
    stages = []
    results = calibrate_parts(cut, config, progress=lambda stage: stages.append(stage.done))
    assert len(results) == 2
    assert stages == sorted(stages)
    whole = combine(results, config)
    assert whole.verdict is Verdict.ACCEPTED
    assert [r.text for r in whole.reasons if r.code is Code.LEG_CUT][0].startswith(
        'leg 1: no IMU data for more than 0.5 s; this section covers 0.0 to 200.0 s')
    assert off(whole, made, SCALE, YAW, PITCH) < 4
    for name in (SCALE, YAW, PITCH):
        # each part has its own sizes of imperfections; the joint ones are between them, so that
        # an angle that they dominate may be 1 % less certain than in the better part
        assert whole.estimates[name].sigma < 1.02 * min(
            one.methods['smoother'].estimates[name].sigma for one in results), name


def test_a_leg_is_cut_where_its_gyro_is_frozen(made):
    leg, config = made.leg(), settings(made, method='two_point')
    first, last = np.searchsorted(seconds(leg, leg.imu), GAP)
    frozen = with_columns(leg, 'imu', w_i=(slice(first, last + 1), leg.imu.w_i[first]))
    without_rows = replace(leg, imu=take(leg.imu, np.r_[:first + 1, last:len(leg.imu.stamp_ns)]))
    results, expected = (calibrate_parts(one, config) for one in (frozen, without_rows))
    assert len(results) == 2
    assert [(r.start_ns, r.stop_ns) for r in results] == [
        (r.start_ns, r.stop_ns) for r in expected]
    for result in results:
        assert not {Code.IMU_GAP, Code.CHANGE_IN_LEG} & {r.code for r in result.reasons}
        assert result.reasons[-1].code is Code.LEG_CUT
        assert 'its output is frozen; this section covers' in result.reasons[-1].text
    # one row remains that is frozen
    assert off(combine(results, config), made, SCALE) == pytest.approx(
        off(combine(expected, config), made, SCALE), abs=0.01)


@pytest.mark.parametrize('by', [0.6, 3.0])
def test_a_leg_is_not_cut_where_the_imu_clock_is_set_forward(made, by):
    leg, config = made.leg(), settings(made, method='two_point')
    t, step_ns = seconds(leg, leg.imu), round(by * 1e9)
    later = replace(leg, stop_ns=leg.stop_ns + step_ns, imu=replace(
        leg.imu, stamp_ns=leg.imu.stamp_ns + step_ns * (t > 200.0)))
    (alone,), (only,) = (calibrate_parts(one, config) for one in (leg, later))
    codes = [reason.code for reason in only.reasons]
    assert codes.count(Code.CLOCK_SET) == 1
    assert not {Code.LEG_CUT, Code.IMU_GAP} & set(codes)
    assert off(combine([only], config), made, SCALE) == pytest.approx(
        off(combine([alone], config), made, SCALE), abs=1e-3)
    # a real gap of 3 s in addition
    (first,) = calibrate_parts(silent(later, (220.0 + by, 223.0 + by)), config)
    assert 'covers 0.0 to 220.0 s of the 280.0 s leg' in first.reasons[-1].text


def test_the_only_usable_section_is_not_called_the_only_long_one(made, monkeypatch):
    leg, config = made.leg(), settings(made, method='two_point')

    def first_rejected(part, *args, **options):
        result = calibrate(part, *args, **options)
        is_first = part.start_ns == leg.start_ns
        return replace(result, methods={}) if is_first else result

    monkeypatch.setattr('odocal_ros.pipeline.calibrate.calibrate', first_rejected)
    (only,) = calibrate_parts(silent(leg, GAP), config)
    assert only.reasons[-1].text.endswith(', the only section with a usable result')


def test_a_leg_whose_parts_are_all_too_short_is_rejected_as_a_whole(made):
    config = settings(made, heading_sigma=None, method='smoother')
    stop = (made.leg().stop_ns - made.leg().start_ns) * 1e-9
    dead = silent(made.leg(), (3.0, stop - 3.0))
    (only,) = calibrate_parts(dead, config)
    assert Code.IMU_GAP in {r.code for r in only.reasons}
    full = silent(made.leg(), *((t, t + 2.0) for t in np.arange(5.0, stop, 8.0)))
    assert parts_of(full) == []        # a leg with periodic gaps is not cut
    (only,) = calibrate_parts(full, config)
    assert only.verdict is Verdict.REJECTED
    assert Code.IMU_GAP in {r.code for r in only.reasons}


def ferried(leg, at_s, wait_s, metres):
    """Return a leg with a standstill of given time and length on a ship that sails north."""
    wait_ns, window = round(wait_s * 1e9), 2.0      # s of rows that are repeated while it stands

    def later(samples):
        t = seconds(leg, samples)
        rows = np.flatnonzero((t >= at_s - window) & (t < at_s))
        times = int(wait_s / window)
        index = np.r_[np.flatnonzero(t < at_s), np.tile(rows, times), np.flatnonzero(t >= at_s)]
        shift_ns = np.r_[np.zeros((t < at_s).sum(), int),
                         np.repeat(np.arange(1, times + 1), len(rows)) * round(window * 1e9),
                         np.full((t >= at_s).sum(), wait_ns)]
        out = take(samples, index)
        return replace(out, stamp_ns=out.stamp_ns + shift_ns,
                       received_ns=out.received_ns + shift_ns)
    fix = later(leg.fix)
    share = np.clip((seconds(leg, fix) - at_s - 20.0) / (wait_s - 40.0), 0.0, 1.0)
    return replace(leg, stop_ns=leg.stop_ns + wait_ns, imu=later(leg.imu),
                   odometer=later(leg.odometer), fix=replace(
                       fix, latitude=fix.latitude + share * metres / 6.37e6))


@pytest.mark.parametrize('metres', [2000.0, 60.0])      # at sea, and across a canal
def test_a_leg_is_cut_where_a_ferry_carries_the_vehicle(metres):
    made = drive(scenario='town', duration=600.0, imu_grade='industrial', seed=8)
    leg, config = made.leg(), settings(made, heading_sigma=None, method='smoother')
    t = seconds(leg, leg.odometer)
    still = np.interp(np.arange(0.0, 580.0), t[1:], np.diff(leg.odometer.value)) == 0
    at = next(k for k in range(250, 400) if still[k - 4:k + 1].all())
    wait = 200.0
    leg = ferried(leg, at, wait, metres)
    assert Code.ODOMETER_STILL in {r.code for r in calibrate(leg, config).reasons}
    results = calibrate_parts(leg, config)
    assert len(results) == 2
    # cut where the ship moves, within the time until a fix shows 10 sigmas, or a quarter of it
    shown = 5.0 + min(15.0 / metres, 0.25) * (wait - 40.0)
    (_, end), (begin, _) = (((r.start_ns - leg.start_ns) * 1e-9, (r.stop_ns - leg.start_ns) * 1e-9)
                            for r in results)
    assert end == pytest.approx(at + 20.0, abs=shown)
    assert begin == pytest.approx(at + wait - 20.0, abs=shown)
    for one in results:
        assert 'the fixes move by' in {r.code: r.text for r in one.reasons}[Code.LEG_CUT]
        assert Code.NO_STANDSTILL not in {r.code for r in one.reasons}
    found = combine(results, config)
    assert found.verdict is not Verdict.REJECTED
    assert off(found, made) < 3.3


def test_a_counter_that_stops_for_ever_rejects_the_leg(made):
    leg = made.leg()
    value = np.minimum(leg.odometer.value, np.interp(150.0, seconds(leg, leg.odometer),
                                                     leg.odometer.value).astype(np.int64))
    dead = replace(leg, odometer=replace(leg.odometer, value=value))
    (only,) = calibrate_parts(dead, settings(made, heading_sigma=None, method='smoother'))
    assert Code.ODOMETER_STILL in {r.code for r in only.reasons}


def test_a_ferry_begins_where_a_steady_acceleration_starts_from_rest():
    """0.02 m/s^2 for 60 s: the first 0.5 m take 7 s and were part of the standstill."""
    t = np.arange(0.0, 200.0, 0.2)
    depart, arrive, a = 40.0, 160.0, 0.02
    half = (arrive - depart) / 2
    x = a / 2 * np.clip(t - depart, 0.0, half)**2
    x = np.where(t < depart + half, x, a * half**2 - a / 2 * np.clip(arrive - t, 0.0, half)**2)
    travel = Travel(np.array([0.0, 1.0, 199.0, 200.0]), np.array([0.0, 9.0, 9.0, 18.0]), 0.0)
    fixes = np.stack([x, 0 * x, 0 * x], -1) + np.random.default_rng(1).normal(0, 0.01, (len(t), 3))
    span, = ferry_intervals(travel, t, fixes, 0.012)
    # three times the difference of two times of fixes, each 0.2 s off at most
    assert np.abs(span - (depart, arrive)).max() < 1.2
