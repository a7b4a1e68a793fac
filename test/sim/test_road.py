# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0
"""Kerbs, cross slopes and the oval: closed forms, and derivatives by differences."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.sim import body
from odocal_ros.sim.motion import attitude, velocity_n
from odocal_ros.sim.options import resolved, SimOptions
from odocal_ros.sim.real import Real
from odocal_ros.sim.road import Hills
from odocal_ros.sim.scenarios import motion_of, simulate
from odocal_ros.sim.zoo import G

pytestmark = pytest.mark.core
KERBS = ((5.0, 0.08), (9.0, -0.08))
YARD = resolved(SimOptions(scenario='yard', duration=120.0))


def test_slopes_are_derivatives_and_chords_their_means():
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


def test_a_drive_over_kerbs_climbs_them_with_its_body_on_both_axles():
    real = Real(kerbs=0.08, kerb_distance=2.0, wheelbase=0.5)
    motion = motion_of(resolved(SimOptions(scenario='yard', duration=120.0, real=real)))
    t = np.arange(0.0, 120.0, 0.05)
    state = motion.at(t)
    assert len(motion.hills.kerbs) > 3
    assert np.ptp(state.height) == pytest.approx(0.08, abs=1e-4)
    x_n = (attitude(state) @ body.rotation(motion, t))[:, :, 0]
    # cubics of 5 ms
    assert_allclose(np.arcsin(x_n[:, 2]), motion.hills.chord(state.travel, 0.5)[0], atol=1e-5)


def test_a_cross_slope_leans_the_vehicle_and_turns_gravity_into_its_side():
    lean = np.radians(2.0)
    drive = simulate(SimOptions(scenario='yard', duration=120.0, imu_grade='perfect', pitch=0.0,
                                yaw=0.0, real=Real(cross_slope=lean)))
    t = (drive.imu.stamp_ns - drive.imu.stamp_ns[0]) * 1e-9
    still = np.abs(drive.motion.speed(t)) == 0
    roll = np.arctan2(drive.imu.f_i[still, 1], drive.imu.f_i[still, 2])
    want = lean * np.sin(2 * np.pi * drive.motion.at(t[still]).travel / 20.0)
    assert np.ptp(want) > lean / 2
    assert_allclose(roll, want, atol=1e-5)      # the Earth's turn has no force at rest


def test_the_contact_of_the_wheels_does_not_slide_in_a_banked_curve():
    real = Real(banking=0.5)
    options = resolved(SimOptions(scenario='oval', odometer_lever_arm=(0.0, 0.0, -0.3), real=real))
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
    motion = motion_of(resolved(SimOptions(scenario='oval', seed=3)))
    assert motion.duration == 600.0
    t = np.arange(0.0, 600.0, 0.1)
    state = motion.at(t)
    assert (state.yaw_rate >= 0).all()
    halves = (state.yaw[-1] - state.yaw[0]) / np.pi
    assert halves == pytest.approx(round(halves), abs=1e-9)
    assert halves > 10
    assert (np.abs(state.speed * state.yaw_rate) < 4.6).all()
