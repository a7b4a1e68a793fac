# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The whole pipeline: pure, with correct sigmas over many drives, robust to faulty data."""

from dataclasses import replace

import drives
import numpy as np
import pytest

from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import take
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
SCALE, YAW, PITCH = 'scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle'


def test_the_same_leg_gives_the_same_result_to_the_last_bit(made):
    first, second = (calibrate(made.leg(), drives.settings(made)) for _ in range(2))
    assert first.methods['two_point'].estimates == second.methods['two_point'].estimates
    assert first.reasons == second.reasons
    np.testing.assert_array_equal(first.track_n, second.track_n)


def test_a_recorded_leg_gives_the_result_of_the_whole_drive(made):
    recorder = LegRecorder()
    for slot in ('fix', 'odometer', 'imu'):
        block = made.leg().rows(slot)
        for first in range(0, len(block.stamp_ns), 997):
            recorder.feed(slot, take(block, slice(first, first + 997)))
    leg = recorder.close(made.truth.start_ns, made.truth.stop_ns)
    results = [calibrate(x, drives.settings(made)) for x in (leg, made.leg())]
    a, b = (r.methods['two_point'].estimates for r in results)
    assert a == b


def test_the_counts_of_a_result_are_those_of_the_leg(made):
    leg = made.leg()
    result = calibrate(leg, drives.settings(made))
    assert (result.start_ns, result.stop_ns) == (leg.start_ns, leg.stop_ns)
    assert result.duration == pytest.approx((leg.stop_ns - leg.start_ns) * 1e-9)
    assert result.distance == pytest.approx(made.truth.distance, rel=0.02)
    assert result.imu_samples == len(leg.imu.stamp_ns)
    # fixes between the marks, each at 0.2 s and 3 ms, half a second of slack at each side
    assert abs(result.fixes - (result.duration + 0.5) * 5) <= 3
    assert result.rejected_fixes == 0


def test_printed_speeds_use_the_calibrated_scale(town):
    # with a stated 15 m the rough scale is from chords of 120 m, across corners of a town
    leg = replace(town.leg(), fix=drives.changed(
        town.fix, covariance_n=lambda c: np.tile(225 * np.eye(3), (len(c), 1, 1))))
    result = calibrate(leg, drives.settings(town, heading_sigma=None, method='smoother',
                                            leg__min_speed=50.0, gnss__max_sigma=0.0))
    text, = (r.text for r in result.reasons if r.code is Code.SPEED_TOO_LOW)
    highest_speed = float(text.split('the highest speed (mean over 1 s) is ')[1].split(' m/s')[0])
    t = (town.odometer.stamp_ns - town.odometer.stamp_ns[0]) * 1e-9
    path_length = town.odometer.value * town.truth.scale
    fastest = (np.interp(t + 0.5, t, path_length) - np.interp(t - 0.5, t,
                                                              path_length))[20:-20].max()
    assert highest_speed == pytest.approx(fastest, rel=2e-3)


def test_notes_of_the_reader_are_kept_and_change_the_verdict(made):
    note = Reason(Code.BAG_TRUNCATED, '3 s are missing at the end')
    result = calibrate(made.leg(), drives.settings(made), notes=(note,))
    assert note in result.reasons
    assert result.verdict.value == 'caution'


def test_a_holdout_checks_data_outside_the_fit(made):
    result = calibrate(made.leg(), drives.settings(made), holdout=True)
    # the last fifth by the nominal scale is 6.1 % short; fixes of 1.5 m, each axis, on top
    short = 0.061 * 0.2 * made.truth.distance
    assert result.before.max == pytest.approx(short, abs=4 * 1.5)
    assert result.before.rms > result.after.rms + 1.0
    assert result.after.rms < 4.0
    assert all(abs(z) < 5 for z in drives.errors_in_sigmas(result, made.truth).values())


@pytest.mark.parametrize(('option', 'value'), [
    ('outliers', 0.05), ('outages', ((70.0, 90.0), (100.0, 104.0))), ('slip_walk', 0.01),
    ('two_wheels', True), ('odometer', 'speed'), ('odometer', 'angle'), ('roll', 0.05),
    ('heading_sigma', 0.002), ('orientation_sigma', 0.002), ('imu_lever_arm', (1.0, 0.4, 0.5))])
def test_values_are_within_sigmas_for_each_kind_of_drive(option, value):
    made = drives.drive(scenario='straight', duration=200.0, imu_grade='tactical', seed=9,
                        **{option: value})
    from_drive = option in ('heading_sigma', 'orientation_sigma')
    config = drives.settings(made, heading_sigma=None if from_drive else 1e-3)
    result = calibrate(made.leg(), config)
    z = drives.errors_in_sigmas(result, made.truth)
    assert set(z) == {SCALE, YAW, PITCH}
    assert not drives.rejecting(result), drives.reason_texts(result)
    assert all(abs(x) < 5 for x in z.values()), z


def test_moving_the_marks_within_the_standstills_changes_little(made):
    config = drives.settings(made)
    base = calibrate(made.leg(), config).methods['two_point'].estimates[SCALE]
    for start, stop in ((-10.0, 0.0), (0.0, -15.0), (-40.0, -30.0)):
        moved = calibrate(drives.shifted(made.leg(), start=start, stop=stop), config)
        e = moved.methods['two_point'].estimates[SCALE]
        assert abs(e.value - base.value) < 0.5 * base.sigma


@pytest.mark.parametrize(('grade', 'noise'), [('tactical', 'white'), ('industrial', 'correlated')])
def test_sigmas_agree_with_errors_over_many_drives(grade, noise):
    """
    60 drives: errors over sigmas have unit variance, and 95 % are within 1.96.

    A mean square of 60 has a sigma of sqrt(2 / 60) = 0.18, a share of 95 % one of 2.8 %: four of
    them on either side; for correlated errors, whose sigma is estimated from the leg, 1.3 times.
    The large run is benchmarks/two_point_monte_carlo.py.
    """
    runs, z, slack = 60, [], 1.0 if noise == 'white' else 1.3
    for seed in range(runs):
        made = simulate(SimOptions(scenario='straight', duration=190.0, seed=seed,
                                   imu_grade=grade, fix_noise=noise, imu_rate=25.0,
                                   odometer_rate=10.0))
        error = 1e-3 * np.random.default_rng(seed).standard_normal()
        config = with_settings(drives.settings(made), {
            'alignment.heading': float(made.truth.heading + error), 'verdict.max_yaw_sigma': 1.0,
            'imu.misalignment_sigma': 0.0})      # the axes of this IMU are square
        z.append(list(drives.errors_in_sigmas(calibrate(made.leg(), config), made.truth).values()))
    z = np.array(z)
    assert z.shape == (runs, 3)
    rms, deviation = np.sqrt((z**2).mean(axis=0)), 4 * np.sqrt(2 / runs)
    assert (rms < slack * np.sqrt(1 + deviation)).all(), rms
    assert (rms > np.sqrt(1 - deviation) / slack).all(), rms
    assert ((np.abs(z) < 1.96 * slack).mean(axis=0) >= 0.95 - 4 * 0.028).all()
    assert (np.abs(z.mean(axis=0)) < 4 / np.sqrt(runs) * slack).all()      # and no bias


COLUMNS = {'imu': ('w_i', 'f_i'), 'odometer': ('value',),
           'fix': ('latitude', 'longitude', 'height', 'covariance_n', 'status')}
ORDERS = {      # of rows: (random numbers, order, rows of the fault)
    'drop': lambda rng, order, rows: np.delete(order, rows),
    'repeat': lambda rng, order, rows: np.sort(np.append(order, order[rows])),
    'shuffle': lambda rng, order, rows: np.r_[order[:rows.start], rng.permutation(order[rows]),
                                              order[rows.stop:]],
    'late block': lambda rng, order, rows: np.append(np.delete(order, rows), order[rows])}
KINDS = [*ORDERS, 'nan', 'huge', 'hang', 'no stamp', 'set clock', 'false stamp']


def corrupted(rng, slot, samples):
    """Return samples with a fault of real recordings, and the name of the fault."""
    n, kind = len(samples.stamp_ns), str(rng.choice(KINDS))
    first, length = int(rng.integers(n)), int(rng.choice([1, 2, 20, 200]))
    rows = slice(first, min(first + length, n))
    what = f'{slot} {kind} {rows.start}:{rows.stop}'
    if kind in ORDERS:
        return take(samples, ORDERS[kind](rng, np.arange(n), rows)), what
    if kind == 'no stamp':
        return drives.changed(samples, stamp_ns=(rows, 0)), what
    jump = int(rng.choice([10**6, 10**8, 10**10, -10**8, -10**10]))
    if kind in ('set clock', 'false stamp'):
        moved = slice(first, None) if kind == 'set clock' else rows
        return drives.changed(samples, stamp_ns=(moved, samples.stamp_ns[moved] + jump)), what

    def values(a):
        if kind == 'hang':
            a[rows] = a[rows.start]
        elif kind == 'nan' and a.dtype == float:
            a[rows] = np.nan
        else:
            big = float(rng.choice([1e4, 1e6, 1e18, 1e300]))
            few = slice(first, first + 2) if a.ndim == 2 else rows
            a[few] = big if a.dtype == float else int(min(big, 9e18))
    return drives.changed(samples, **{str(rng.choice(COLUMNS[slot])): values}), what


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(('which', 'runs'), [('straight', 50), ('town', 30)])
def test_faults_raise_nothing_and_no_wrong_value_is_accepted(made, town, which, runs):
    """80 corrupted legs: an accepted one is within six sigmas, a rejected one has a reason."""
    it = made if which == 'straight' else town
    config, verdicts = drives.settings(it), []
    for seed in range(runs):
        rng, leg, what = np.random.default_rng(seed), it.leg(), []
        for _ in range(rng.integers(1, 4)):
            slot = str(rng.choice(list(COLUMNS)))
            samples, fault = corrupted(rng, slot, leg.rows(slot))
            leg, what = leg.with_rows(**{slot: samples}), [*what, fault]
        result = calibrate(leg, config)
        whole = combine([result], config)
        verdicts.append(whole.verdict.value)
        if verdicts[-1] == 'rejected':
            assert drives.rejecting(result), what
        if verdicts[-1] == 'accepted':
            z = drives.errors_in_sigmas(result, it.truth)
            assert all(abs(x) < 6 for x in z.values()), (seed, what, z)
    # most legs with these faults are usable
    assert verdicts.count('accepted') > runs / 2, verdicts
    # clock steps, in five of the 30 town drives, do not reject
    assert verdicts.count('rejected') >= 3
