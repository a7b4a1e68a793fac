# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The body on its springs and the drifting axle: closed forms, and derivatives by differences."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.sim import body
from odocal_ros.sim.motion import attitude, Motion, Start
from odocal_ros.sim.options import resolved, SimOptions
from odocal_ros.sim.profile import chain, hermite, hold, ramp, turn
from odocal_ros.sim.real import Real
from odocal_ros.sim.scenarios import motion_of

SQUAT, ROLL = 0.003, 0.009     # rad per m/s^2


def test_hermite_has_its_values_and_slopes():
    t = np.array([0.0, 0.5, 2.0])
    cubic = hermite(t, t**3 - t, 3 * t**2 - 1)
    x = np.linspace(0, 2, 41)
    assert_allclose(cubic(x), x**3 - x, atol=1e-14)
    assert_allclose(cubic.derivative()(x), 3 * x**2 - 1, atol=1e-13)


def test_springs_answer_a_ramp_as_the_equation_does():
    t = np.arange(0, 5, 0.02)
    y, dy = body.sprung(0.7 + 0.4 * t, 0.02)
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
                  tilt=body.tilts(speed, rate, SQUAT, ROLL))


def test_the_nose_rises_and_the_body_leans_outwards():
    motion = bends()
    t = np.array([3.0, 9.0])        # steady push for some 1.5 s each
    x_n, y_n = (np.moveaxis(attitude(motion.at(t)) @ body.rotation(motion, t), -1, 0)[k]
                for k in (0, 1))
    push, side = 10 / 3, 10 * 0.8 / 3.5
    # what is left of the swing, e^(-z w 1 s) of it, and of the ramp
    assert x_n[0, 2] == pytest.approx(SQUAT * push, rel=0.15)
    assert y_n[1, 2] == pytest.approx(ROLL * side, rel=0.15)      # the left side is up


def test_the_imu_on_the_body_feels_how_its_place_moves():
    motion, h, arm = bends(), 1e-4, np.array([0.7, -0.4, 1.1])
    t = np.arange(1.5, 17.0, 0.01)      # as an IMU of 100 Hz
    stiff = Motion(motion.speed, motion.yaw_rate, motion.start)
    w, f = body.felt(motion, motion.at(t), arm)
    R, before, after = (body.rotation(motion, t + k * h) for k in (0, -1, 1))
    # w = R^T w_v + the axial vector of R^T dR/dt
    spin = np.swapaxes(R, 1, 2) @ (after - before) / (2 * h)
    w_v, _ = body.felt(stiff, stiff.at(t), (0.0, 0.0, 0.0))
    want = np.einsum('nij,ni->nj', R, w_v) + np.stack([spin[:, 2, 1], spin[:, 0, 2],
                                                       spin[:, 1, 0]], -1)
    assert_allclose(w, want, atol=1e-6)
    # f: second difference of the place that the body takes the IMU to, in a stiff vehicle's axes
    a_arm = (after + before - 2 * R) @ arm / h**2
    rate = (after - before) @ arm / (2 * h)
    _, f_0 = body.felt(stiff, stiff.at(t), (0.0, 0.0, 0.0))
    w_0 = w_v
    dw = np.gradient(body.felt(stiff, stiff.at(np.arange(0, 18, 1e-3)), (0, 0, 0))[0], 1e-3,
                     axis=0)[np.rint(t / 1e-3).astype(int)]
    place = R @ arm
    want = np.einsum('nij,ni->nj', R, f_0 + a_arm + 2 * np.cross(w_0, rate)
                     + np.cross(dw, place) + np.cross(w_0, np.cross(w_0, place)))
    # what the turn rate's derivative by differences misses where its flank begins, w" dt / 2,
    # over the up to 4 cm that the IMU is moved; round-off of the second difference is 1e-8
    assert_allclose(f, want, atol=(6 * 0.8 / 3.5 / 1.5**2) * 0.01 / 2 * 0.04)


def test_a_rear_axle_drifts_outwards_by_what_pushes_it():
    options = resolved(SimOptions(scenario='town', duration=200.0, real=Real(sideslip=0.004)))
    motion = motion_of(options)
    state = motion.at(np.arange(0, 200, 0.1))      # where the drift is as computed
    side = state.speed * state.yaw_rate
    assert np.abs(side).max() > 1
    assert_allclose(state.sway[:, 0], -0.004 * side * state.speed, atol=1e-12)
    assert (state.sway[:, 1] == 0).all()
    assert_allclose(state.travel, motion_of(resolved(SimOptions(
        scenario='town', duration=200.0))).at(state.t).travel, atol=1e-9)
