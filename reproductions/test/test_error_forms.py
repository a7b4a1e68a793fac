# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Closed forms of the error analysis against the projection, the chord and the full model."""

from types import SimpleNamespace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_reproductions.paper.error_forms import chord_error, plane_error, SpeedProfile
from odocal_reproductions.paper.error_model import PAPER_RADIUS, propagate
from odocal_reproductions.paper.path import planned_path
from odocal_reproductions.paper.plane import gauss_krueger
from odocal_ros.nav.rotations import wrap

DRIFT = np.deg2rad(0.01) / 3600     # 0.01 deg/h
PHI_U = np.deg2rad(0.06)            # 3.6'


def straight_leg(phi_U0, eps_z, T, velocity_E, velocity_N, latitude):
    """Return phi_U, dL, dlam, dalpha, rad, and dK / K at the end of a leg: (29)-(33)."""
    phi_integral = phi_U0 * T - eps_z * T**2 / 2
    return SimpleNamespace(
        phi_U=phi_U0 - eps_z * T, dL=-velocity_E / PAPER_RADIUS * phi_integral,
        dlam=velocity_N / np.cos(latitude) / PAPER_RADIUS * phi_integral,
        dalpha=-phi_integral / T, dK=eps_z**2 * T**2 / 24)      # in place of (32)


def papers_profile(n=4001):
    """Return the profile of section 3: 40 s up to 20 m/s, 520 s, 40 s down."""
    t = np.linspace(0.0, 600.0, n)
    speed = np.interp(t, [0, 40, 560, 600], [0, 20, 20, 0])
    s = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(t))])
    return SpeedProfile(t, s), speed


@pytest.mark.parametrize('latitude_deg', [20.0, 35.0, 50.0])
@pytest.mark.parametrize('from_meridian_deg', [-3.0, -1.5, 0.5, 3.0])
def test_plane_error_is_the_derivative_of_the_projection(latitude_deg, from_meridian_deg):
    latitude, meridian = np.deg2rad([latitude_deg, 117.0])
    longitude, h = meridian + np.deg2rad(from_meridian_deg), 1e-6
    by_L, by_lam = (np.subtract(gauss_krueger(latitude + a, longitude + b, meridian, 'krass'),
                                gauss_krueger(latitude - a, longitude - b, meridian, 'krass'))
                    / (2 * h) for a, b in ((h, 0), (0, h)))
    L = plane_error(latitude, longitude, meridian, 1.0, 0.0)
    lam = plane_error(latitude, longitude, meridian, 0.0, 1.0)
    # (13), (14) against the derivative of (4), (5), within 3 deg, at 20 to 50 deg
    assert L[0] == pytest.approx(by_L[0], rel=1.25e-5)
    assert L[1] == pytest.approx(by_L[1], rel=0.0095)
    assert lam[0] == pytest.approx(by_lam[0], rel=0.0035)
    assert lam[1] == pytest.approx(by_lam[1], rel=0.0035)


@pytest.mark.parametrize('bearing_deg', [-170.0, -45.0, 0.0, 45.0, 120.0])
def test_chord_error_is_the_derivative_of_scale_and_bearing(bearing_deg):
    S1, K0, bearing = 9000.0, 0.024, np.deg2rad(bearing_deg)
    x, y = 10800 * np.cos(bearing), 10800 * np.sin(bearing)

    def calibrate(x, y):      # eq. (6)-(10), the true chord along north
        return np.array([K0 * S1 / np.hypot(x, y), wrap(-np.arctan2(y, x))])

    h = 0.1      # m: third order leaves (h / S2)^2 = 1e-10
    for dx, dy in ((1.0, 0.0), (0.0, 1.0), (-0.6, 0.8)):
        change = calibrate(x + h * dx, y + h * dy) - calibrate(x - h * dx, y - h * dy)
        derivative = wrap(change) / (2 * h)
        # round-off: 1e-16 of K0, 4e-16 of a bearing of 3, over 0.2 m
        assert_allclose(chord_error(x, y, dx, dy, S1, K0), derivative, rtol=1e-9, atol=3e-15)


def test_straight_leg_is_the_model_without_earth_rate_and_tilt():
    speed, yaw, latitude, T = 20.0, np.pi / 4, np.deg2rad(40.0), 600.0
    t = np.linspace(0.0, T, 601)
    path = planned_path(t, np.full(601, speed), yaw, latitude)
    phi_U0, eps_z = PHI_U, 20 * DRIFT
    closed = straight_leg(phi_U0, eps_z, T, speed * np.cos(yaw), speed * np.sin(yaw), latitude)
    x = propagate(path, [0, 0, phi_U0, 0, 0, 0], [0, 0, eps_z], PAPER_RADIUS)[-1]
    # omitted in (24)-(31): phi_E grows by w cos L phi_U t and feeds back w cos L phi_E: half of
    # (5.6e-5 t)^2 = 5.6e-4; vN tan L / R phi_U: 1.8e-6 t = 1.1e-3; dL by 5.96e-5 t v t / 2R: 3e-5
    assert x[2] == pytest.approx(closed.phi_U, rel=2e-3)
    assert x[3] == pytest.approx(closed.dL, rel=2e-3)
    # the latitude changes by 1.3e-3 rad along the path: half of it times tan L in the secant
    assert x[4] == pytest.approx(closed.dlam, rel=3e-3)
    # estimate less truth: phi_U > 0 turns the track clockwise, which (33) takes from alpha
    assert closed.dL < 0 < closed.dlam
    assert closed.dalpha < 0


def test_end_error_through_plane_and_chord_is_minus_the_mean_heading_error():
    profile, speed = papers_profile()
    latitude, longitude = np.deg2rad([40.0, 116.0])
    path = planned_path(profile.t, speed, np.pi / 4, latitude, longitude)
    x = propagate(path, [0, 0, PHI_U, 0, 0, 0], [0, 0, DRIFT])[-1]
    (n0, n1), (e0, e1) = gauss_krueger(path.latitude[[0, -1]], path.longitude[[0, -1]], longitude)
    dx, dy = plane_error(path.latitude[-1], path.longitude[-1], longitude, x[3], x[4])
    dK, dalpha = chord_error(n1 - n0, e1 - e0, dx, dy, np.hypot(n1 - n0, e1 - e0), 1.0)
    expected, _ = profile.heading_and_drift(PHI_U, DRIFT)
    # C instead of N in plane_error: 0.3 %; the rest of the model: 0.1 % (test above)
    assert dalpha == pytest.approx(expected, rel=4e-3)
    # a common rotation changes no length; radii in dx and dy differ by 0.6 %: phi / 2 times that
    assert abs(dK) < PHI_U * 0.0035


def test_profile_of_constant_speed_gives_the_forms_of_the_paper():
    t = np.linspace(0.0, 600.0, 301)
    closed = straight_leg(PHI_U, DRIFT, 600.0, 14.0, 14.0, 0.7)
    dalpha, dK = SpeedProfile(t, 20 * t).heading_and_drift(PHI_U, DRIFT)
    assert dalpha == pytest.approx(closed.dalpha, rel=1e-12)
    assert dK == pytest.approx(closed.dK, rel=1e-9)      # a difference of squares 2e3 times larger


def test_profile_of_the_paper_gives_independently_computed_errors():
    profile, _ = papers_profile()
    # computed independently: eps_z +8.33e-4 deg and 3e-11 K (symmetric profile: mean time 300 s),
    # phi_U0 -0.0600 deg and 0; three digits and one
    dalpha, dK = profile.heading_and_drift(0.0, DRIFT)
    assert np.rad2deg(dalpha) == pytest.approx(8.33e-4, abs=0.005e-4)
    assert dK == pytest.approx(3e-11, abs=0.5e-11)
    dalpha, dK = profile.heading_and_drift(PHI_U, 0.0)
    assert np.rad2deg(dalpha) == pytest.approx(-0.06, abs=1e-12)
    assert dK == pytest.approx(0.0, abs=1e-18)
    # and 2.4e-4 deg of 0.001 deg/sqrt(h)
    noise = np.rad2deg(profile.noise_sigma(np.deg2rad(0.001) / 60))
    assert noise == pytest.approx(2.4e-4, abs=0.05e-4)


def test_mounting_error_is_that_of_a_track_with_varying_heading():
    """Sum a straight track with a varying heading, and measure its chord."""
    profile, _ = papers_profile()
    t, ds = profile.t, np.diff(profile.s)
    phi = 2e-3 * np.sin(t / 90) + 1e-5 * t
    # phi > 0: computed axes are rotated counterclockwise in n, the computed track clockwise
    east_north = np.exp(1j * (np.pi / 4 - phi))
    end = np.sum((east_north[1:] + east_north[:-1]) / 2 * ds)
    dalpha, dK = profile.mounting_error(phi)
    # third and fourth order: phi^3 = 5e-7 of 1e-2 rad at most, phi^4 of 1e-8; sums over 4000 steps
    assert np.angle(end) - np.pi / 4 == pytest.approx(dalpha, rel=1e-4)
    assert profile.s[-1] / abs(end) - 1 == pytest.approx(dK, rel=1e-4)


def test_noise_sigma_is_the_scatter_of_drawn_random_walks():
    profile, _ = papers_profile(601)
    density, rng = 1e-5, np.random.default_rng(11)
    steps = density * rng.standard_normal((4000, 600))     # of 1 s
    walk = np.concatenate([np.zeros((4000, 1)), np.cumsum(steps, axis=1)], axis=1)
    errors = [profile.mounting_error(w)[0] for w in walk]
    # a sigma from 4000 draws is known to 1 / sqrt(8000) = 1.1 %; four of them
    assert np.std(errors) == pytest.approx(profile.noise_sigma(density), rel=0.045)
