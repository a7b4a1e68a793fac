# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Piecewise polynomials and true motion: closed forms, and an integrated IMU."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.nav.geodesy import C_en, E2, ecef_from_geodetic, gravity, OMEGA, SEMI_MAJOR_AXIS
from odocal_ros.nav.rotations import exp_so3, skew
from odocal_ros.sim import motion as true_motion
from odocal_ros.sim.profile import chain, hold, ramp, smooth, turn

pytestmark = pytest.mark.core


def test_ramps_and_turns_have_the_requested_speed_path_and_angle():
    speed = chain(hold(3) + ramp(10, 12, 1.0) + hold(5)).integral()
    # symmetric about its middle: mean speed 6 m/s over 10 s, then 12 m/s for 5 s
    assert speed([0, 3, 8, 13, 18, 99]) == pytest.approx([0, 0, 6, 12, 12, 12], abs=1e-13)
    assert speed.integral()(18.0) == pytest.approx(6 * 10 + 12 * 5, abs=1e-12)
    # blends are shorter if both exceed the duration: the gain is the same
    assert chain(ramp(1.5, 3, 1.0)).integral()([0.75, 1.5]) == pytest.approx([1.5, 3.0])
    for blend in (0.5, 2.0, 4.0):
        assert chain(turn(8, 1.3, blend)).integral()(8.0) == pytest.approx(1.3, abs=1e-14)


def test_derivative_is_the_inverse_of_the_integral():
    rate = chain([smooth(2, 0, 3), smooth(5, 3, -1), *hold(1)])
    t = np.linspace(0.01, 7.99, 1000)
    assert_allclose(rate.integral().derivative()(t), rate(t), atol=1e-14)
    h = 1e-5   # central difference: h^2 / 6 * third derivative (4.5) = 8e-11, rounding 3e-11
    assert_allclose((rate(t + h) - rate(t - h)) / (2 * h), rate.derivative()(t), atol=3e-10)


def test_a_step_has_the_mean_of_both_sides():
    acceleration = chain(hold(300) + ramp(40, 20, 0.0) + hold(1))
    at = np.array([299.99, 300.0, 300.00000000000006, 300.01, 340.0])
    assert acceleration.mean(at) == pytest.approx([0, 0.25, 0.25, 0.5, 0.25])
    # so a trapezoid rule over samples gives the speed exactly
    t = np.arange(34101) * 0.01
    a = acceleration.mean(t)
    assert np.sum((a[1:] + a[:-1]) / 2) * 0.01 == pytest.approx(20.0, abs=1e-10)


HOME = true_motion.Start(np.radians(40), 0.2, 50.0, 0.7)
ARM = (1.5, -0.5, 1.0)


def lively(start=HOME, slope=0.05, **sway):
    """Return 20 s with a ramp, a turn of 100 deg, a hill and a stop."""
    speed = chain(hold(1) + ramp(6, 15, 1.0) + hold(6) + ramp(6, -15, 1.0) + hold(1)).integral()
    rate = chain(hold(4) + turn(8, np.radians(100), 2.0) + hold(8))
    return true_motion.Motion(speed, rate, start, true_motion.Hills(slope, 200.0), **sway)


def swaying():
    """Return ``lively`` with sideslip of up to 1 m/s and half as much vertical velocity."""
    side = chain(hold(2) + turn(8, 4.0, 2.0) + hold(10))
    rise = chain(hold(4) + turn(6, 1.5, 2.0) + hold(10))
    return lively(sway=(side, rise))


def paper():
    pieces = hold(300) + ramp(40, 20, 0.0) + hold(520) + ramp(40, -20, 0.0) + hold(30)
    return true_motion.Motion(chain(pieces).integral(), chain(hold(930)),
                              true_motion.Start(np.radians(40), 0.2, 0.0, np.pi / 4))


def test_the_papers_drive_is_11200_m_of_loxodrome():
    """Northing is a meridian arc; longitude goes with the isometric latitude."""
    pyproj = pytest.importorskip('pyproj')
    motion = paper()
    end = motion.at([motion.duration])
    assert motion.distance == pytest.approx(11_200, abs=1e-9)
    north = pyproj.Geod(ellps='WGS84').inv(0, 40, 0, np.degrees(end.latitude[0]))[2]
    # summed rounding, 1e-12 of 11 km, and some nanometres of Geod
    assert north == pytest.approx(11_200 * np.sqrt(0.5), abs=2e-8)

    def isometric(latitude):
        e, s = np.sqrt(E2), np.sin(latitude)
        return np.arctanh(s) - e * np.arctanh(e * s)
    east = (end.longitude[0] - 0.2) - (isometric(end.latitude[0]) - isometric(np.radians(40)))
    assert east * SEMI_MAJOR_AXIS == pytest.approx(0, abs=2e-8)


def integrate(motion, rate, arm):
    """
    Return the errors of an Earth-fixed strapdown navigation over the drive, m and rad.

    Second order in the step: mean rate as rotation vector, force turned by the mean attitude,
    trapezoid for the rest. Independent of the navigation in the package.
    """
    from odocal_ros.nav.geodesy import geodetic_from_ecef
    n = int(motion.duration * rate) + 1
    h = 1 / rate
    state = motion.at(np.arange(n) * h)
    w, f = true_motion.rigid_imu_output(state, arm)
    C_ev = C_en(state.latitude, state.longitude) @ true_motion.attitude(state)
    latitude, longitude, height = true_motion.point_geodetic(state, arm)
    truth = ecef_from_geodetic(latitude, longitude, height)
    C, r, v = C_ev[0], truth[0], np.zeros(3)
    earth = np.array([0, 0, OMEGA])
    turn_back, W = exp_so3(-earth * h), skew(earth)

    def acceleration(C, f, r, v):
        place = geodetic_from_ecef(r)
        up = C_en(place[0], place[1])[:, 2]
        return C @ f - gravity(place[0], place[2]) * up - 2 * W @ v
    for k in range(n - 1):
        C_next = turn_back @ C @ exp_so3((w[k] + w[k + 1]) / 2 * h)
        a = acceleration(C, f[k], r, v)
        a_next = acceleration(C_next, f[k + 1], r + v * h, v + a * h)
        r = r + v * h + (2 * a + a_next) * h**2 / 6
        v = v + (a + a_next) * h / 2
        C = C_next
    twist = C_ev[-1].T @ C
    return r - truth[-1], np.array([twist[2, 1], twist[0, 2], twist[1, 0]])


@pytest.mark.parametrize(('arm', 'drive'), [
    ((0.0, 0.0, 0.0), lively), (ARM, lively), (ARM, swaying)])
def test_integrated_imu_converges_to_the_truth_with_second_order(arm, drive):
    misses = [integrate(drive(), rate, arm) for rate in (25, 50, 100)]
    for coarse, fine in zip(misses, misses[1:], strict=False):
        # half of the step leaves a quarter of the error; a wrong term leaves a constant error
        assert np.linalg.norm(coarse[0]) / np.linalg.norm(fine[0]) == pytest.approx(4, rel=0.1)
        assert np.linalg.norm(coarse[1]) / np.linalg.norm(fine[1]) == pytest.approx(4, rel=0.1)
    # Richardson: step length zero. The next term, of fourth order, is 1.6e-3 m of the coarse
    # run times (0.5 rad/s * 0.02 s)^2 = 1e-4, for the attitude 4e-6 rad times as much
    (_, _), (r2, p2), (r4, p4) = misses
    assert np.linalg.norm(r4 + (r4 - r2) / 3) < 3e-7
    assert np.linalg.norm(p4 + (p4 - p2) / 3) < 4e-10


def test_going_east_turns_the_vehicle_against_the_earth():
    pieces = ramp(10, 20, 0.0) + hold(980) + ramp(10, -20, 0.0)
    motion = true_motion.Motion(chain(pieces).integral(), chain(hold(1000)),
                                true_motion.Start(np.radians(60), 0.0, 0.0, 0.0))
    end = motion.at([1000.0])
    # the level turns by dlon * sin(lat); a parallel is a curve to the left, 19.8 km: 0.0054 rad
    assert end.turn_angle[0] == pytest.approx(end.longitude[0] * np.sin(np.radians(60)), rel=1e-9)
    rolled = [true_motion.contact_travel(end, (0.0, y, 0.0))[0] for y in (0.8, -0.8)]
    assert rolled[1] - rolled[0] == pytest.approx(1.6 * end.turn_angle[0], rel=1e-8)
    assert end.turn_angle[0] > 0.005


@pytest.mark.parametrize('arm', [(0.0, 0.8, 0.0), (0.3, -0.8, -0.3)])
def test_a_wheels_travel_is_the_integral_of_its_speed(arm):
    state = lively().at(np.arange(0, 20.0005, 1e-3))
    speed = true_motion.contact_speed(state, arm)
    # trapezoid: h^2 / 12 * summed change of slope (25 m/s^2) = 2e-6; tilt couples the level's
    # own turn in the second order, 0.05 * 2e-6 rad/s * 20 s * 1 m
    total = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 1e-3)])
    rolled = true_motion.contact_travel(state, arm)
    assert_allclose(rolled - rolled[0], total, atol=5e-6)


def test_any_times_give_the_same_states():
    motion = lively()
    t = np.array([0.0, 3.3333, 7.0, 7.1, 19.99, 20.0])
    whole = motion.at(np.sort(np.concatenate([t, np.linspace(0, 20, 57)])))
    alone = motion.at(t)
    pick = np.searchsorted(whole.t, t)
    assert np.array_equal(whole.latitude[pick], alone.latitude)
    assert np.array_equal(whole.turn_angle[pick], alone.turn_angle)
