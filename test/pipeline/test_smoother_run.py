# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The smoother as a method of the pipeline."""

import drives
from drives import ANGLES, drive, off, reason_texts, settings, TOWN, with_columns
import numpy as np
import pytest

from odocal_ros.calib.choice import leg_estimates
from odocal_ros.data.leg import part_of
from odocal_ros.estimator.convergence import CONVERGENCE
from odocal_ros.nav.dead_reckoning import dead_reckon
from odocal_ros.nav.odometer import Travel
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.pipeline.prepared_leg import Stage
from odocal_ros.pipeline.smoother_run import _delayed_path
from odocal_ros.reasons import Code, Verdict

pytestmark = pytest.mark.slow
SIGMAS = 4.0     # 1 in 16 000 of a normal error; the seed is fixed
ASKED = {'method': 'smoother', 'heading_sigma': None}      # no external heading
MADE = {'scenario': 'town', 'duration': 240.0, 'imu_grade': 'industrial', 'seed': 11}


@pytest.fixture(scope='module')
def held(made):
    return calibrate(made.leg(), settings(made, **ASKED), holdout=True)


def test_smoother_gives_the_result_without_a_heading_and_a_standstill(made, held):
    assert off(held.methods['smoother'], made, 'scale_factor', *ANGLES) < SIGMAS
    assert held.after.rms < held.before.rms / 4
    assert held.methods['two_point'].estimates['yaw_mounting_angle'].value is None
    whole = combine([held], settings(made, **ASKED))
    assert whole.estimates['yaw_mounting_angle'].method == 'smoother'
    assert whole.verdict is Verdict.ACCEPTED
    assert 'NO_STANDSTILL' not in {r.code.name for r in whole.reasons}


@pytest.mark.parametrize('method', ['two_point', 'smoother'])
def test_the_path_of_the_antenna_follows_the_mounting_angles(method):
    # with the lever arm in the axes of the IMU, the error is 0.14 rad times the arm, 0.2 m rms
    arm, count_m = (2.0, 0.5, 1.5), 0.02
    made = drive(scenario='town', duration=200.0, seed=2, imu_grade='perfect', fix_sigma=1e-3,
                 antenna_lever_arm=arm, yaw=-0.14, pitch=0.07)
    assert calibrate(made.leg(), settings(made, method=method)).after.rms < count_m


def smoothed(leg, made):
    return calibrate(leg, settings(made, **ASKED)).methods['smoother']


def with_height(made, height):
    """Return the leg of a drive with a height, m, in all fixes, or in each."""
    return with_columns(made.leg(), 'fix', height=(slice(None), height))


def test_fixes_without_altitude_give_all_three_values(made):
    found = smoothed(with_height(made, np.nan), made).estimates
    assert off(found, made, 'scale_factor', *ANGLES) < SIGMAS
    assert found['scale_factor'].sigma < 1e-3 * made.truth.scale
    assert max(found[name].sigma for name in ANGLES) < np.deg2rad(0.25)


@pytest.mark.parametrize('height', [np.nan, 0.0])
def test_unknown_heights_increase_the_sigma_by_the_radius_of_the_earth(height):
    made = drive(**TOWN, height=1600.0)
    result = smoothed(with_height(made, height), made)
    # on the ellipsoid below a road of 1600 m, distances are 1600 m / 6378 km shorter
    assert off(result.estimates, made, 'scale_factor', *ANGLES) < SIGMAS
    assert {s.name: s.effects for s in result.sources}['height'][0, 0] > 1e-4


def test_unknown_heights_of_several_legs_do_not_average():
    legs = []
    for seed in (4, 5, 6):
        made = drive(**TOWN | {'seed': seed}, height=1600.0, start_ns=seed * 10**12,
                     fix_noise='rtk')
        legs.append(calibrate(with_height(made, np.nan), settings(made, **ASKED)))
    config = settings(made, **ASKED)
    earlier = combine(legs[:2], config).carried
    for whole in (combine(legs, config), combine(legs[2:], config, earlier)):
        found = whole.estimates['scale_factor']
        assert found.sigma > 800.0 / 6378137.0 * made.truth.scale
        assert off(whole.estimates, made, 'scale_factor') < SIGMAS
        assert whole.methods['smoother'].details['budget'].get('height', {}).get('shared')


def test_fixes_without_altitude_at_the_start_are_at_the_altitude_of_the_others():
    made = drive(**TOWN, height=1600.0)
    height = made.fix.height.copy()
    height[:300] = np.nan
    result = calibrate(with_height(made, height), settings(made, **ASKED))
    assert result.origin[2] == pytest.approx(1600.0, abs=60.0)
    assert off(result.methods['smoother'].estimates, made, 'scale_factor', *ANGLES) < SIGMAS


def test_heights_stated_far_worse_than_the_level_part_leave_a_result():
    rough = drive(**TOWN, fix_sigma=1.0)
    # m: of a receiver that states 1 km for a height it does not know
    stated = (slice(None), np.diag([0.01, 0.01, 1000.0])**2)
    found = smoothed(with_columns(rough.leg(), 'fix', covariance_n=stated), rough)
    assert off(found, rough, 'scale_factor', 'yaw_mounting_angle') < SIGMAS


def test_a_late_odometer_loses_no_travel_at_a_mark_in_motion():
    made = drive(scenario='motorway', duration=300.0, imu_grade='industrial', fix_noise='rtk',
                 odometer_delay=0.08)
    stop = made.truth.start_ns + 200 * 10**9
    leg = part_of(made.leg(), made.truth.start_ns, stop, None)
    assert made.motion.speed(200.0) > 10.0      # 0.8 m in the delay
    result = calibrate(leg, settings(made, **ASKED))
    assert not {Code.WHEEL_SLIP, Code.TRAVEL_MISSING} & set(reason_texts(result))
    assert off(result.methods['smoother'], made, 'scale_factor', *ANGLES) < SIGMAS


def test_a_start_within_an_odometer_gap_is_not_slip(made):
    leg = made.leg()
    moves = drives.seconds(leg, leg.odometer)[1:][np.diff(leg.odometer.value) > 0]
    start = moves[1:][(np.diff(moves) > 2.0) & (moves[1:] > 30.0)][0]     # after a stop
    lost = drives.without(leg, 'odometer', start - 10.0, start + 10.0)
    found = [calibrate(one, settings(made, **ASKED)) for one in (leg, lost)]
    assert Code.WHEEL_SLIP not in reason_texts(found[1])
    scale, with_gap = (one.methods['smoother'].estimates['scale_factor'] for one in found)
    assert abs(with_gap.value - made.truth.scale) < SIGMAS * with_gap.sigma
    assert with_gap.sigma < 1.1 * scale.sigma       # 20 s of 200 are missing


@pytest.mark.parametrize(('stage', 'words'), [
    (Stage(), ''),
    (Stage('two_point', 0.0), 'two_point'),
    (Stage('smoother', 0.1, 1, 51234.5), 'smoother, 1 pass done, remaining change 51234 sigma'),
    (Stage('smoother', 0.1, 7, 0.4249), 'smoother, 7 passes done, remaining change 0.42 sigma')])
def test_progress_states_passes_and_change_and_no_percentage(stage, words):
    assert stage.as_text() == words


def test_auto_uses_the_smoother_and_computes_two_point_too(made):
    stages = []
    leg = calibrate(made.leg(), settings(made, method='auto', heading_sigma=None),
                    progress=stages.append)
    # the progress after each pass, below 1 until the end
    shares = [stage.done for stage in stages]
    assert shares == sorted(shares)
    assert shares[0] == 0
    assert 0.8 < shares[-1] < 1
    assert list(dict.fromkeys(s.name for s in stages)) == ['two_point', 'smoother', 'tracks']
    passes = [stage for stage in stages if stage.passes]
    assert [stage.passes for stage in passes] == list(range(1, len(passes) + 1))
    assert {(stage.name, stage.done) for stage in passes} == {('smoother', shares[1])}
    # the change falls from some sigmas at the first guess to the limit of convergence
    assert passes[0].change > CONVERGENCE.fitted_below
    assert passes[-1].change < CONVERGENCE.max_step
    assert set(leg.methods) == {'smoother', 'two_point'}
    assert leg_estimates(leg)['yaw_mounting_angle'].method == 'smoother'


def test_all_states_for_each_method_why_it_gives_no_value(made):
    leg = calibrate(made.leg(), settings(made, method='all', heading_sigma=None))
    assert Code.YAW_NOT_SEPARABLE in {r.code for r in leg.methods['two_point'].reasons}
    assert leg.verdict is Verdict.ACCEPTED


def test_tracks_before_and_after_differ_by_the_calibrated_values_only():
    """One is the other rotated by the yaw and scaled by the ratio, except for level and lever."""
    made = drive(scenario='town', duration=240.0, imu_grade='consumer', seed=13)
    leg = calibrate(made.leg(), settings(made, **ASKED))
    found = leg_estimates(leg)
    before, after = (x[:, 0] + 1j * x[:, 1] for x in (
        leg.track_before_n - leg.track_before_n[0], leg.track_n - leg.track_n[0]))
    c = np.vdot(after, before) / np.vdot(after, after)
    assert abs(c) == pytest.approx(1 / found['scale_ratio'].value, rel=1e-3)
    assert np.angle(c) == pytest.approx(found['yaw_mounting_angle'].value, abs=2e-3)
    assert np.abs(before - c * after).max() < 1e-3 * np.abs(after).max()
    # a section as configured ends |c - 1| of its chord away; a chord is at most its path length
    (first, *_) = leg.per_distance
    assert first.after < first.before < np.hypot(abs(c - 1) * first.length, 2 * first.after)


def test_calibrated_dead_reckoning_accounts_for_a_delay_of_the_fixes():
    """A late fix is behind by delay times speed: 0 at rest, 4.5 m at 15 m/s."""
    late = drive(scenario='town', duration=240.0, imu_grade='tactical', fix_noise='rtk',
                 fix_delay=0.3, seed=12)
    leg = calibrate(late.leg(), settings(late, **ASKED))
    evidence = leg.evidence
    assert leg.methods['smoother'].estimates['gnss_delay'].value == pytest.approx(0.3, abs=0.02)
    behind = 0.3 * evidence.speed.max()
    assert behind > 3.0
    assert leg.after.max < behind / 3
    assert np.nanmax(np.abs(evidence.sections.ratio - 1)) < 0.003


def test_the_path_continues_beyond_the_data_for_the_delay():
    t = np.linspace(0.0, 10.0, 101)
    track = dead_reckon(t, np.tile([0.0, 0.0, 0.0, 1.0], (101, 1)), Travel(t, 5.0 * t, 0.0))
    path = _delayed_path(track, np.array([2.0, 0.0, 0.0]), np.zeros(3), -0.3)
    assert path(np.array([0.0, 4.0, 9.9, 10.0]))[:, 0] == pytest.approx([3.0, 43.0, 102.0, 103.0])
    assert path(np.array(12.0))[0] == pytest.approx(103.0), 'no farther than the delay'
