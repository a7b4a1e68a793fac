# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The running estimate: its cost, its difference from the result, and what it refuses."""

from dataclasses import replace
import math
import warnings

from forecast_drives import drive_of, fit_updates
import numpy as np
import pytest

from odocal_ros.data.samples import take
from odocal_ros.errors import BadData, OdocalError
from odocal_ros.estimator import growing
from odocal_ros.estimator.growing import extend_warm_start, make_imu_steps, UPDATE_PASSES
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.forecast.forecast import LegEnded
from odocal_ros.forecast.leg_so_far import SmootherSoFar
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.settings.config import with_settings

pytestmark = pytest.mark.slow
NAMES = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')


def compared(one, other):
    """Return differences of estimates in sigmas of the other, and the ratios of sigmas."""
    return [((one[n].value - other[n].value) / other[n].sigma, one[n].sigma / other[n].sigma)
            for n in NAMES]


def errors_in_sigmas(running, drive):
    true = (drive.truth.scale, drive.truth.yaw, drive.truth.pitch)
    return [(running.method.estimates[n].value - t) / running.method.estimates[n].sigma
            for n, t in zip(NAMES, true, strict=True)]


def test_estimate_is_always_within_its_sigma_and_ends_as_the_result(town_drive, exact, updates):
    result = calibrate(town_drive.leg(), exact).methods['smoother'].estimates
    for off, ratio in compared(updates[-1].running.method.estimates, result):
        assert abs(off) < 0.5
        assert 0.9 < ratio < 1.3       # slightly larger: noise levels from 150 s of driving
    for seen in updates:
        off = errors_in_sigmas(seen.running, town_drive)
        assert np.abs(off).max() < 4    # 24: 1 in 700 by chance


def test_an_update_starts_from_the_last_and_agrees_with_a_cold_start(exact, updates):
    passes = [x.running.method.details['iterations'] for x in updates]
    assert passes[0] > UPDATE_PASSES
    # of 4, with driving, stops and turns in between; the others are cold starts
    assert passes.count(UPDATE_PASSES) >= 2
    cold = SmootherSoFar().update(updates[-1].leg, exact).method.estimates
    assert cold['scale_factor'].value != updates[-1].running.method.estimates['scale_factor'].value
    for off, ratio in compared(updates[-1].running.method.estimates, cold):
        # both stop within 0.1 sigma and levels within 10 % of where they would end
        assert abs(off) < 0.2
        assert ratio == pytest.approx(1.0, abs=0.1)


def test_decisions_are_made_again_after_the_leg_has_grown_by_half(updates):
    # from the standstill 20 s before the mark on: 50 s, 80 s, 128 s, 192 s
    assert [x.cold_start_cpu_s > 0 for x in updates] == [False, False, True, False, True, False,
                                                         True, False]


def test_a_long_leg_is_estimated_in_windows(town_drive, exact, updates, monkeypatch):
    monkeypatch.setattr(growing, 'LONG_WINDOW', 70.0)
    monkeypatch.setattr(growing, 'NEXT_WINDOW', 100.0)
    thinned, so_far = updates[-1].leg, SmootherSoFar()
    for seen in updates:
        windowed = so_far.update(seen.leg, exact)
    past, t_end = so_far._growing._finished
    assert t_end == pytest.approx(60.0, abs=0.2)
    assert so_far._growing._last.state.t[0] == pytest.approx(t_end, abs=0.11)      # of a cell
    whole = updates[-1].running
    assert windowed.distance == pytest.approx(whole.distance, rel=0.01)
    assert windowed.agility == pytest.approx(whole.agility, rel=0.1)
    assert (windowed.sigmas < past.sigmas).all()
    for off, ratio in compared(windowed.method.estimates, whole.method.estimates):
        # a window ends where the next begins, with unknown states
        assert abs(off) < 1.0
        assert 0.9 < ratio < 1.6
    assert np.abs(errors_in_sigmas(windowed, town_drive)).max() < 4
    # a window that cannot be fitted leaves the finished ones
    monkeypatch.setattr(growing, 'make_result', lambda *_: np.linalg.inv(np.zeros((2, 2))))
    assert so_far.update(thinned, exact) is past


def test_a_diverged_fit_is_reported_and_a_cold_start_follows(exact, updates, monkeypatch):
    so_far = SmootherSoFar()

    def wild(*_):
        return np.exp(np.full(3, 1e3))
    with monkeypatch.context() as broken, warnings.catch_warnings():
        warnings.simplefilter('error')       # warnings are not visible in a node
        broken.setattr(growing, 'best_fit', wild)
        with pytest.raises(BadData, match='cannot solve the data so far: overflow'):
            so_far.update(updates[-1].leg, exact)
    assert so_far.update(updates[-1].leg, exact).method.estimates['scale_factor'].value is not None


def test_the_state_is_extrapolated_to_the_current_position(town_drive, exact, updates):
    so_far = SmootherSoFar()
    so_far.update(updates[-3].leg, exact)      # 7 s of dead reckoning, at speed
    view = so_far._smoother_leg(updates[-2].leg, exact)
    state = extend_warm_start(so_far._growing._last,
                              make_problem(view, exact, make_imu_steps(view, 1.0))).state
    later = SmootherSoFar()
    later.update(updates[-2].leg, exact)
    last = later._growing._last.state
    assert np.linalg.norm(last.v_n[-1]) > 5.0
    # 0.1 % of a path of 70 m; the position has a sigma of 1.5 m / sqrt(fixes)
    assert state.p_n[-1, :2] == pytest.approx(last.p_n[-1, :2], abs=0.5)
    assert state.v_n[-1, :2] == pytest.approx(last.v_n[-1, :2], abs=0.1)
    assert state.C_nb[-1] == pytest.approx(last.C_nb[-1], abs=2e-3)
    # not with other keyframes or another constant: the error as a factor of the stated sigma
    stated = view.covariance_n * np.linspace(1.0, 2.0, len(view.t_fix))[:, None, None]
    varies = replace(view, covariance_n=stated)
    for leg, spacing in ((view, 0.7), (varies, 1.0)):
        other = make_problem(leg, exact, make_imu_steps(leg, spacing))
        assert extend_warm_start(so_far._growing._last, other) is None


def test_accelerometer_priors_are_kept_and_estimated_again(exact):
    drive = drive_of(fix_noise='correlated')     # then the accelerometer determines the distance
    graded = with_settings(exact, {'imu.accel_scale_sigma': math.nan})
    first, later, last = (x.running for x in fit_updates(drive, graded, (100.0, 112.0, 165.0)))
    # the same priors and 10 % more data: by the squared path length 1.2 times smaller at most
    assert 1 / 1.2 < later.sigmas[0] / first.sigmas[0] < 1.02
    assert later.method.details['posterior_to_prior']['accelerometer_scale_x'] < 1.0
    leg = fit_updates(drive, graded, (165.0,))[0].running
    # both stop within 0.1 sigma, so the log odds z^2 / 2 of scale errors 1 to 2 sigmas off differ
    # by 0.2 at most, the mean square of both priors by a tenth; noise levels by another tenth
    assert last.sigmas[0] == pytest.approx(leg.sigmas[0], rel=0.15)
    blind = fit_updates(drive, exact, (165.0,))[0].running
    assert last.sigmas[0] > 1.5 * blind.sigmas[0]      # the prior matters


def test_the_size_of_an_imperfection_is_carried_on(exact):
    graded = with_settings(exact, {'imu.accel_scale_sigma': math.nan})

    def size(running):
        return running.method.details['noise']['size_accelerometer_scale']

    offs, ratios = [], []
    for seed in range(3, 11):
        # a usual size
        drive = drive_of(accel_scale_error=3e-3, seed=seed, duration=130.0)
        first, later = fit_updates(drive, graded, (40.0, 60.0))
        assert (first.cold_start_cpu_s, later.cold_start_cpu_s) == (0.0, 0.0)
        leg = SmootherSoFar().update(later.leg, graded)
        # two passes instead of a converged level: within a tenth of its own sigma of about 1
        assert size(later.running) == pytest.approx(size(leg), rel=0.1)
        (off, ratio), *_ = compared(later.running.method.estimates, leg.method.estimates)
        offs.append(off)
        ratios.append(ratio)
    # as in each update from the last; in 80 s the level of slow errors is known to a factor
    # of e in its variance, and still falls by 10 % per pass where a fit may end
    assert np.sqrt(np.mean(np.square(offs))) < 0.3
    assert np.sqrt(np.mean(np.square(np.log(ratios)))) < 0.15


@pytest.mark.parametrize('allowed', [0, 3])
def test_an_update_stops_between_passes_and_the_next_is_a_cold_start(exact, updates, allowed):
    so_far, required = SmootherSoFar(), []

    def is_needed():
        required.append(True)
        return len(required) <= allowed

    with pytest.raises(LegEnded):
        so_far.update(updates[0].leg, exact, is_needed)
    assert len(required) == allowed + 1
    assert so_far.update(updates[0].leg, exact).sigmas.shape == (3,)


def test_slow_errors_are_in_the_sigma_before_they_are_observable(exact, updates):
    whites = with_settings(exact, {'gnss.correlation_time': 0.0})

    def seen(leg, exact):
        return SmootherSoFar().update(leg, exact)

    drive = drive_of(fix_noise='correlated', seed=58)
    leg = fit_updates(drive, exact, (30.0,))[0].leg       # including the standstill
    slow, white = (e.method.estimates['scale_factor'] for e in (seen(leg, exact),
                                                                seen(leg, whites)))
    assert abs(slow.value - drive.truth.scale) < 3 * slow.sigma
    assert abs(white.value - drive.truth.scale) > 5 * white.sigma
    # a possible slow part of white fixes increases the sigma, and never decreases it
    assert (seen(updates[0].leg, exact).sigmas >= 0.95 * seen(updates[0].leg, whites).sigmas).all()


def test_an_imu_mounted_upside_down_gives_the_same_values(exact, updates):
    leg = updates[1].leg
    down = np.array([1.0, -1.0, -1.0])
    over = replace(leg, imu=replace(leg.imu, w_i=leg.imu.w_i * down, f_i=leg.imu.f_i * down))
    both = [SmootherSoFar().update(one, exact).method.estimates for one in (leg, over)]
    for off, ratio in compared(*both):
        assert (off, ratio) == (pytest.approx(0.0, abs=1e-3), pytest.approx(1.0, abs=1e-3))


@pytest.mark.parametrize(('changed', 'words'), [
    ({'fix': slice(0, 5)},
     '^5 fixes and [0-9.]+ s of data; the smoother needs at least 10 fixes and 20 s'),
    ({'imu': slice(0, 0)}, 'needs IMU'), ({'imu': slice(0, 2)}, 'needs IMU'),
    ({'odometer': slice(0, 1)}, 'and odometer')])
def test_too_little_data_is_reported_and_later_updates_work(exact, updates, changed, words):
    leg, so_far = updates[0].leg, SmootherSoFar()
    less = leg.with_rows(**{slot: take(leg.rows(slot), rows) for slot, rows in changed.items()})
    with pytest.raises(OdocalError, match=words):
        so_far.update(less, exact)
    assert so_far.update(leg, exact).distance > 50.0


@pytest.mark.parametrize(('yaw', 'turn_rates', 'why'), [
    (math.pi / 2, 1.0, 'accelerations of the vehicle point to the right'),
    (0.0, 0.0, 'all turn rates are zero')])
def test_an_unusable_imu_is_reported_at_once(exact, yaw, turn_rates, why):
    drive = drive_of(yaw=yaw)
    leg = drive.leg()
    leg = replace(leg, imu=replace(leg.imu, w_i=turn_rates * leg.imu.w_i))
    with pytest.raises(OdocalError, match=why):
        SmootherSoFar().update(leg, exact)
