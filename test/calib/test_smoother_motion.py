# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Equations of the smoother hold at the truth; a kneeling bus does not change the result."""

from dataclasses import replace

from drives import ANGLES, configured, off
import numpy as np
import pytest
from smoother_legs import along_axis, at_truth, made, pitch_increments, truth

from odocal_ros.estimator import state as layout
from odocal_ros.estimator.equations import Equations, preintegrate_at as preintegrated
from odocal_ros.estimator.factors.axle import Axle, mean_square, WALK_SPEED
from odocal_ros.estimator.factors.motion import Motion
from odocal_ros.estimator.factors.point_rows import TAIL_SIGMAS
from odocal_ros.estimator.factors.pseudo_observations import STILL_TURN
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.state import M, PHI, SIZE_WITH_SLOW
from odocal_ros.nav.dead_reckoning import forward_b
from odocal_ros.nav.rotations import matrix_from_rpy, rotate, transpose
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.scenarios import simulate
from odocal_ros.sim.wheels import G

BUS = SimOptions(scenario='town', duration=250.0, imu_grade='industrial', imu_rate=50.0,
                 fix_noise='rtk')


@pytest.fixture(scope='module')
def perfect():
    return at_truth(60.0)[1:]


@pytest.mark.parametrize('turned', [-2 * np.pi, np.pi, 2.0, 0.3])
def test_step_beyond_vertical_pitch_keeps_the_vehicle_upright(perfect, turned):
    _, state = perfect
    step = np.zeros(layout.M)
    step[layout.PITCH] = turned
    moved = state.updated(np.zeros((len(state.t), layout.SIZE_WITHOUT_SLOW)), step)
    assert abs(moved.constants[layout.PITCH]) <= np.pi / 2
    np.testing.assert_allclose(moved.forward, forward_b(
        state.constants[layout.YAW], state.constants[layout.PITCH] + turned), atol=1e-12)
    assert moved.C_bv[2, 2] >= 0


def test_truth_satisfies_the_equations(perfect):
    problem, state = perfect
    parts = Equations(problem, state).factors
    r = np.abs(parts['motion'].raw)
    # trapezoid rule at 50 Hz: kinks of the profile within a step leave a few dt^2 / 12 of a jerk
    # of 3 m/s^3, 1e-4 m/s over an interval
    assert r[:, :6].max() < 2e-4
    assert r[:, 6:9].max() < 1e-7
    # rounding of the odometer: two ends of up to one count of 2 cm, minus their mean
    assert r[:, 15:18].max() < 0.022
    assert np.abs(parts['fixes'].raw).max() < 5e-4


def test_turn_of_a_rolled_body_does_not_pitch_it(perfect):
    problem, state = perfect
    preintegrate_at = preintegrated(problem, state)[0]
    rate_n = rotate(state.C_nb[:-1], preintegrate_at.mean_rate)
    assert np.abs(rate_n[:, 2]).max() > 0.1
    rolled = state.C_nb @ matrix_from_rpy([0.1, 0.0, 0.0])      # level body; mounting of 1 deg
    leaning = replace(state, C_nb=rolled)
    measured = rotate(transpose(rolled[:-1]), rate_n)
    upright, other = (pitch_increments(Motion(problem, one, steps))[:, 0] for one, steps in (
        (state, preintegrate_at), (leaning, replace(preintegrate_at, mean_rate=measured))))
    # an error would make a tenth of a turn of 0.2 rad pitch; the roll changes the heading of the
    # mounting by 0.1 times some degrees, which rotates the real pitch
    assert np.abs(other - upright).max() < 0.01 * np.abs(upright).max() + 1e-5


def test_turn_is_not_treated_as_braking():
    """Tyres slip by 0.8 % per m/s^2 of drive, half of it in braking: a turn has no such slip."""
    stiff = 0.04
    _, problem, state = at_truth(scale=1e-3, nominal_scale=1e-3,
                                 real=RealEffects(tyre_slip=stiff, driven=True))
    c = state.constants.copy()
    c[layout.TYRES][2:4] = 2 * stiff / G, stiff / G
    state = replace(state, constants=c)
    along = Equations(problem, state).factors['motion'].raw[:, 15]
    speed = np.linalg.norm(state.v_n, axis=1)
    even = (np.abs(np.diff(speed)) < 1e-3) & (speed[1:] > 5.0)
    turned = np.abs(problem.imu.over_intervals(problem.imu.turn)[:, 2])
    share = along / np.maximum(speed[1:], 1.0)
    turns, straight = share[even & (turned > 0.1)], share[even & (turned < 1e-3)]
    assert len(turns) > 3 < len(straight)
    # the air resistance at other speeds: 2e-5; if treated as braking, turns deviate by 1e-3
    assert np.abs(turns - np.median(straight)).max() < 1e-4


def test_tyres_and_springs_depend_on_the_axle_acceleration_for_any_imu_position():
    """An IMU 0.6 m to the left measures 0.6 m times the angular acceleration as forward force."""
    found = []
    for arm in ((0.0, 0.0, 0.0), (0.7, 0.6, 0.5)):
        _, problem, state = at_truth(imu_lever_arm=arm)
        signals = Equations(problem, state).factors['motion'].motion
        signals = np.hstack([signals.pitch_lean[:, :2], signals.yaw_lean[:, :1]])
        found.append((signals, Axle(problem, state).traction_acceleration(), problem))
    (at_axle, along, problem), (elsewhere, along_elsewhere, _) = found
    change = np.abs(np.diff(problem.rate_b[:, 2])).max()
    assert change > 0.15
    # a turn that starts within the 0.1 s of a mean rate: a quarter of 0.05 s of its change is
    # missing at both ends, 0.9 m from the axle
    limit = 2 * 0.9 * change * 0.05 / 4
    assert np.abs(elsewhere - at_axle).max() < limit
    assert np.abs(along_elsewhere - along).max() < limit


def test_mean_square_of_a_parabola_equals_its_integral():
    parabola = np.polynomial.Polynomial([0.3, -1.1, 2.4])      # on an interval from 0 to 1
    mean, square = (p.integ()(1.0) for p in (parabola, parabola**2))
    assert mean_square(parabola(0.0), parabola(1.0), mean) == pytest.approx(square, rel=1e-12)


def test_turn_rate_noise_is_not_a_side_force():
    """As a velocity difference of the axle, 3.4 m away, the noise was 0.01 m/s^2."""
    _, problem, state = at_truth(imu_lever_arm=(3.4, 0.0, 0.0))
    noise = 2e-3 * np.random.default_rng(3).standard_normal(len(state.t))
    noisy = replace(problem, rate_b=problem.rate_b + np.outer(noise, state.C_bv[:, 2]))
    left, noisy_left = (Equations(one, state).factors['motion'].motion.yaw_lean[:, 0]
                        for one in (problem, noisy))
    assert np.abs(left).max() > 0.5
    # a path of 7 mm/s to the side, at more than 0.1 m/s, in the mean of the bank
    assert np.abs(noisy_left - left).max() < 1e-4


def test_lean_axes_are_level_with_a_rolled_imu():
    """About the axes of an IMU rolled by 5 deg, a tenth of a squat appeared as sideslip."""
    roll = 0.09
    drive, problem, state = at_truth(roll=roll)
    motion = Equations(problem, state).factors['motion'].motion
    C_nv = state.C_nb[:-1] @ matrix_from_rpy([roll, drive.options.pitch, drive.options.yaw]).T
    by = np.swapaxes(C_nv, 1, 2) @ motion.jacobians(layout.SIZE_WITHOUT_SLOW)[2][:, 15:18]
    # the pitch axis of the mounting is level to second order of yaw and pitch, 1 deg each
    for columns, axis in ((layout.PITCH_LEAN, 1), (layout.YAW_LEAN, 2)):
        sizes = np.linalg.norm(by[..., columns], axis=1).max(axis=0)
        assert (sizes > 0.1).all()
        assert (np.abs(by[:, axis, columns]).max(axis=0) < 0.005 * sizes).all()


def _rms_after_lean(real, axis, lean, counts):
    """Return the rms error along an axis, without and with fitted first columns of a lean."""
    _, problem, state = at_truth(scale=1e-3, nominal_scale=1e-3, real=real)
    error, by = along_axis(problem, state, axis, lean)
    rests = [error - by[:, :n] @ np.linalg.lstsq(by[:, :n], error, rcond=None)[0] for n in counts]
    return [np.sqrt((one**2).mean()) for one in (error, *rests)]


def test_axle_slides_by_speed_times_turn_rate():
    whole, rest = _rms_after_lean(RealEffects(sideslip=0.005), 1, layout.YAW_LEAN, [1])
    # the mean of a product over 1 s is not the product of means; a difference of velocities
    # left 3 %
    assert rest < 1e-3 * whole


def test_body_lean_is_delayed():
    """At least a third of the remaining squat is proportional to the change of acceleration."""
    whole, rest, with_change = _rms_after_lean(
        RealEffects(squat=0.005), 2, layout.PITCH_LEAN, [2, 3])
    assert rest < 0.3 * whole
    assert with_change < 0.7 * rest


def test_tyre_force_on_a_slope_equals_that_of_the_same_acceleration():
    drive, problem, state = at_truth(slope=0.1)
    motion = Equations(problem, state).factors['motion'].motion
    since = (drive.truth.start_ns - drive.options.start_ns) * 1e-9
    there = drive.motion.at(since + (state.t[1:] + state.t[:-1]) / 2)
    fast = there.speed > 2.0
    want = there.acceleration + G * there.slope
    # means over 1 s of an acceleration that changes by up to 1 m/s^3
    assert np.abs(motion.axle.traction_acceleration() - want)[fast].max() < 0.3
    assert np.ptp(G * there.slope[fast]) > 0.5
    # here the body axes are those of the road
    assert np.abs(motion.pitch_lean[:, :2].sum(axis=1) - want)[fast].max() < 0.3


def test_truth_with_an_accelerometer_scale_error_satisfies_the_equations(perfect):
    error = 0.01
    _, problem, state = at_truth(60.0, accel_scale_error=error)
    c = state.constants.copy()
    c[layout.ACCEL.start:layout.ACCEL.start + 2] = error / (1 + error)      # of the measured force
    # on a level road the force along z is gravity, except for tilt: the error is a bias
    bias = state.accel_bias + [0.0, 0.0, error * 9.80154]
    state = replace(state, constants=c, accel_bias=bias)
    r = Equations(problem, state).factors['motion'].raw
    without, straight = perfect
    kinks = Equations(without, straight).factors['motion'].raw
    # not more than the trapezoid rule leaves without a scale error; the error times the mean
    # force of each second would give 1 % of up to 0.2 m
    assert np.abs(r[:, :2] - kinks[:, :2]).max() < 2e-5
    assert np.abs(r[:, 3:5] - kinks[:, 3:5]).max() < 2e-5


def test_scale_is_that_of_the_path_for_any_body_direction():
    """A squat of 0.1 rad per m/s^2 rotates the path in the body frame but keeps its length."""
    _, problem, state = at_truth(scenario='town')
    c = np.zeros(layout.M)
    c[layout.PITCH_LEAN][:2] = 0.1
    unmoved = np.zeros((len(state.t), layout.SIZE_WITHOUT_SLOW))
    level, leaning = (Equations(problem, state.updated(unmoved, step)).factors['motion'].motion
                      for step in (np.zeros(layout.M), c))
    straight = np.abs(level.sums.mean_rate[:, 2]) < 1e-3
    # below walking speed the direction of travel is unknown
    walks = np.linalg.norm(level.displacement_by_state, axis=1) > WALK_SPEED * level.T[:, 0]
    hard = straight & walks & (np.abs(level.pitch_lean[:, :2].sum(axis=1)) > 0.5)
    assert hard.sum() > 10
    ahead = (level.f_n + level.f_n_end) / 2
    length, other = (np.einsum('ki,ki->k', x.wheel_displacement, ahead)[hard]
                     for x in (level, leaning))
    # with the square of the lean it would be (0.05)^2 / 2 = 1e-3 shorter
    np.testing.assert_allclose(other, length, rtol=1e-5)


def result(kneeling):
    """Return the calibration of a drive, and the drive."""
    drive = simulate(replace(BUS, real=RealEffects(kneeling=kneeling)))
    config = configured(drive)
    return combine([calibrate(drive.leg(), config)], config), drive


@pytest.mark.core
def test_kneeling_bus_has_the_sigmas_of_a_bus_that_does_not_kneel():
    (kneels, bus), (stands, _) = (result(np.radians(x)) for x in (2.0, 0.0))
    # white noise of the IMU and the remaining standstills without tilt
    more = 1.2
    for name in ('scale_factor', *ANGLES):
        assert kneels.estimates[name].sigma < more * stands.estimates[name].sigma
    assert off(kneels, bus) < 4
    codes = {reason.code for reason in kneels.reasons}
    assert not codes & {Code.IMU_WORSE_THAN_GRADE, Code.MODEL_MISMATCH, Code.LEVER_ARM_OFF}


@pytest.mark.core
def test_turn_at_rest_gets_the_variance_of_a_three_sigma_outlier():
    drive, config, leg = made(imu_grade='perfect', fix_sigma=0.0, duration=150.0)
    problem, state = make_problem(leg, config), truth(drive, config, leg)
    k = int(np.flatnonzero(problem.at_rest[:-1] & problem.at_rest[1:])[3])
    step, tilt = np.zeros((len(state.t), SIZE_WITH_SLOW)), 0.01
    step[k + 1:, PHI.start] = tilt
    part = Equations(problem, state.updated(step, np.zeros(M))).factors['standstills']
    T = float(np.diff(state.t)[k])
    z2 = (tilt / STILL_TURN[0])**2 / T / 3
    variance = part.turn_variance[k]
    assert variance == pytest.approx(STILL_TURN**2 * T * z2 / TAIL_SIGMAS**2, rel=1e-3)
    assert part.turn_variance[k - 1] == pytest.approx(STILL_TURN**2 * np.diff(state.t)[k - 1])
