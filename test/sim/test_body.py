# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Body, road and drifting axle: closed forms, and derivatives by differences."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.sim import body
from odocal_ros.sim.motion import attitude, Motion, Start, velocity_n
from odocal_ros.sim.options import resolve, SimOptions
from odocal_ros.sim.profile import chain, Hills, hold, ramp, turn
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.scenarios import motion_of, simulate
from odocal_ros.sim.vehicle_distributions import G

pytestmark = pytest.mark.core
KERBS = ((5.0, 0.08), (9.0, -0.08))


def test_slopes_are_derivatives_of_the_height_and_chords_are_means():
    road, h = Hills(0.03, 70.0, KERBS), 1e-5
    s = np.linspace(4.9, 9.7, 600)
    _, by, by2 = road(s)
    # h^2 of third derivatives, and round-off of 1e-16 / h
    assert_allclose(by, (road(s + h)[0] - road(s - h)[0]) / (2 * h), atol=1e-6)
    assert_allclose(by2, (road(s + h)[1] - road(s - h)[1]) / (2 * h), atol=2e-4)
    chord, chord_by = road.chord(s, 0.5)
    assert_allclose(chord_by, (road.chord(s + h, 0.5)[0] - road.chord(s - h, 0.5)[0]) / (2 * h),
                    atol=1e-6)
    hill, kerbs = Hills(0.03, 70.0), Hills(kerbs=KERBS)
    ahead = np.linspace(0, 0.5, 2001)[:, None] + s
    assert_allclose(hill.chord(s, 0.5)[0], hill(ahead)[0].mean(axis=0), atol=1e-7)
    rise = np.sin(kerbs(ahead)[0])
    rise = (rise[1:] + rise[:-1]).mean(axis=0) / 4        # trapezia over half a metre
    assert_allclose(np.sin(kerbs.chord(s, 0.5)[0]), rise / 0.5, atol=1e-7)
    assert_allclose(chord, hill.chord(s, 0.5)[0] + kerbs.chord(s, 0.5)[0], atol=1e-15)


def test_the_body_climbs_kerbs_with_both_axles():
    real = RealEffects(kerbs=0.08, kerb_distance=2.0, wheelbase=0.5)
    motion = motion_of(resolve(SimOptions(scenario='yard', duration=120.0, real=real)))
    t = np.arange(0.0, 120.0, 0.05)
    state = motion.at(t)
    assert len(motion.hills.kerbs) > 3
    assert np.ptp(state.height) == pytest.approx(0.08, abs=1e-4)
    x_n = (attitude(state) @ body.rotation(motion, t))[:, :, 0]
    # cubics of 5 ms
    assert_allclose(np.arcsin(x_n[:, 2]), motion.hills.chord(state.travel, 0.5)[0], atol=1e-5)


def test_a_cross_slope_rolls_the_vehicle_and_gives_lateral_gravity():
    lean = np.radians(2.0)
    drive = simulate(SimOptions(scenario='yard', duration=120.0, imu_grade='perfect', pitch=0.0,
                                yaw=0.0, real=RealEffects(alternating_crossfall=lean)))
    t = (drive.imu.stamp_ns - drive.imu.stamp_ns[0]) * 1e-9
    still = np.abs(drive.motion.speed(t)) == 0
    roll = np.arctan2(drive.imu.f_i[still, 1], drive.imu.f_i[still, 2])
    want = lean * np.sin(2 * np.pi * drive.motion.at(t[still]).travel / 20.0)
    assert np.ptp(want) > lean / 2
    assert_allclose(roll, want, atol=1e-5)      # the Earth rate has no force at rest


def test_the_wheel_contact_has_no_sideslip_in_a_banked_curve():
    real = RealEffects(banking=0.5)
    options = resolve(SimOptions(scenario='oval', odometer_lever_arm=(0.0, 0.0, -0.3), real=real))
    motion = motion_of(options)
    t = np.arange(40.0, 120.0, 0.05)
    state = motion.at(t)
    side = np.swapaxes(attitude(state), 1, 2) @ velocity_n(state)[:, :, None]
    w_v, h = body.rotation(motion, t), 1e-3
    before, after = (body.rotation(motion, t + x) for x in (-h, h))
    contact = side[:, :, 0] + (after - before) @ options.odometer_lever_arm / (2 * h)
    assert np.ptp(side[:, 1]) > 0.01
    assert_allclose(contact[:, 1:], 0.0, atol=2e-4)      # cubics of 0.1 s
    curve = state.speed * state.yaw_rate
    k = int(np.argmax(curve))
    assert np.arctan2(w_v[k, 2, 1], w_v[k, 2, 2]) == pytest.approx(-np.arctan(curve[k] / G) / 2)


def test_an_oval_turns_left_by_half_a_turn_at_each_end_and_closes():
    motion = motion_of(resolve(SimOptions(scenario='oval', seed=3)))
    assert motion.duration == 600.0
    t = np.arange(0.0, 600.0, 0.1)
    state = motion.at(t)
    assert (state.yaw_rate >= 0).all()
    halves = (state.yaw[-1] - state.yaw[0]) / np.pi
    assert halves == pytest.approx(round(halves), abs=1e-9)
    assert halves > 10
    assert (np.abs(state.speed * state.yaw_rate) < 4.6).all()


SQUAT, ROLL = 0.003, 0.009     # rad per m/s^2


def test_springs_respond_to_a_ramp_by_the_closed_form():
    t = np.arange(0, 5, 0.02)
    y, dy = body.sprung_response(0.7 + 0.4 * t, 0.02)
    w, z = body.FREQUENCY, body.DAMPING
    wd = w * np.sqrt(1 - z**2)
    decay = np.exp(-z * w * t)
    along = t - 2 * z / w + decay * (2 * z / w * np.cos(wd * t)
                                     + (2 * z**2 - 1) / wd * np.sin(wd * t))
    assert_allclose(y, 0.7 + 0.4 * along, atol=1e-12)      # round-off of 250 steps
    assert_allclose(dy[1:-1], np.gradient(y, 0.02)[1:-1], atol=0.4 * (w * 0.02)**2)


def bends():
    """Return a drive with a start, a turn to the left and a stop, on springs."""
    speed = chain(hold(1) + ramp(4, 10, 1.0) + hold(8) + ramp(4, -10, 1.0) + hold(1)).integral()
    rate = chain(hold(6) + turn(5, 0.8, 1.5) + hold(7))
    return Motion(speed, rate, Start(0.7, 0.2, 0.0, 0.3),
                  tilt=body.tilts(speed, rate, RealEffects(squat=SQUAT, body_roll=ROLL)))


def test_the_body_pitches_up_when_accelerating_and_rolls_outwards_in_turns():
    motion = bends()
    t = np.array([3.0, 9.0])        # constant acceleration for some 1.5 s each
    x_n, y_n = (np.moveaxis(attitude(motion.at(t)) @ body.rotation(motion, t), -1, 0)[k]
                for k in (0, 1))
    push, side = 10 / 3, 10 * 0.8 / 3.5
    # the rest of the oscillation, e^(-z w 1 s) of it, and of the ramp
    assert x_n[0, 2] == pytest.approx(SQUAT * push, rel=0.15)
    assert y_n[1, 2] == pytest.approx(ROLL * side, rel=0.15)      # the left side is up


def test_the_imu_measures_the_motion_of_its_place_on_the_body():
    motion, h, arm = bends(), 1e-4, np.array([0.7, -0.4, 1.1])
    t = np.arange(1.5, 17.0, 0.01)      # like an IMU at 100 Hz
    stiff = Motion(motion.speed, motion.yaw_rate, motion.start)
    w, f = body.imu_output(motion, motion.at(t), arm)
    R, before, after = (body.rotation(motion, t + k * h) for k in (0, -1, 1))
    # w = R^T w_v + the axial vector of R^T dR/dt
    spin = np.swapaxes(R, 1, 2) @ (after - before) / (2 * h)
    w_v, _ = body.imu_output(stiff, stiff.at(t), (0.0, 0.0, 0.0))
    want = np.einsum('nij,ni->nj', R, w_v) + np.stack([spin[:, 2, 1], spin[:, 0, 2],
                                                       spin[:, 1, 0]], -1)
    assert_allclose(w, want, atol=1e-6)
    # f: second difference of the IMU position on the body, in axes of a rigid vehicle
    a_arm = (after + before - 2 * R) @ arm / h**2
    rate = (after - before) @ arm / (2 * h)
    _, f_0 = body.imu_output(stiff, stiff.at(t), (0.0, 0.0, 0.0))
    w_0 = w_v
    dw = np.gradient(body.imu_output(stiff, stiff.at(np.arange(0, 18, 1e-3)), (0, 0, 0))[0], 1e-3,
                     axis=0)[np.rint(t / 1e-3).astype(int)]
    place = R @ arm
    want = np.einsum('nij,ni->nj', R, f_0 + a_arm + 2 * np.cross(w_0, rate)
                     + np.cross(dw, place) + np.cross(w_0, np.cross(w_0, place)))
    # error of the turn rate's derivative by differences at the start of its ramp, w" dt / 2,
    # times the IMU displacement of up to 4 cm; round-off of the second difference is 1e-8
    assert_allclose(f, want, atol=(6 * 0.8 / 3.5 / 1.5**2) * 0.01 / 2 * 0.04)


def test_rear_axle_sideslip_is_outwards_by_the_lateral_acceleration():
    options = resolve(SimOptions(scenario='town', duration=200.0,
                                  real=RealEffects(sideslip=0.004)))
    motion = motion_of(options)
    state = motion.at(np.arange(0, 200, 0.1))      # where the sideslip is at the computed value
    side = state.speed * state.yaw_rate
    assert np.abs(side).max() > 1
    assert_allclose(state.sway[:, 0], -0.004 * side * state.speed, atol=1e-12)
    assert (state.sway[:, 1] == 0).all()
    assert_allclose(state.travel, motion_of(resolve(SimOptions(
        scenario='town', duration=200.0))).at(state.t).travel, atol=1e-9)


def test_on_a_cross_slope_the_body_rolls_and_the_axle_slips_downhill():
    fall, straight = 0.025, {'scenario': 'straight', 'duration': 190.0}
    real = RealEffects(constant_crossfall=fall, body_roll=ROLL, sideslip=0.004)
    motion = motion_of(resolve(SimOptions(**straight, odometer_lever_arm=(0.0, 0.0, 0.0),
                                           real=real)))
    t = np.arange(0.0, 190.0, 0.1)
    state, R = motion.at(t), body.rotation(motion, t)
    force = G * np.sin(fall)
    assert_allclose(np.arctan2(R[:, 2, 1], R[:, 2, 2]), fall + ROLL * force, atol=1e-12)
    assert_allclose(state.sway[:, 0], -0.004 * force * state.speed, atol=1e-12)


def test_a_bus_kneels_only_at_stops_within_the_drive():
    down = np.radians(2.0)
    options = SimOptions(scenario='town', duration=300.0, real=RealEffects(kneeling=down))
    motion = motion_of(resolve(options))
    t = np.arange(0.0, 300.0, 0.02)
    still = np.abs(motion.speed(t)) < 1e-9
    roll = motion.tilt[0](t)
    begin, end = (np.flatnonzero(np.diff(np.r_[0, still, 0]) == sign) for sign in (1, -1))
    assert len(begin) > 3
    assert roll[begin[0]:end[0]].max() < 1e-12
    assert np.abs(roll[begin[-1] + 100:]).max() < 1e-3      # of the last oscillation
    for a, b in zip(begin[1:-1], end[1:-1], strict=True):
        most = min((b - a) * 0.01 / body.KNEELING_TIME, 1.0)
        # springs overshoot by exp(-pi z / sqrt(1 - z^2)) of a step, of a ramp by far less
        assert roll[a:b].max() == pytest.approx(most * down, rel=0.1)
