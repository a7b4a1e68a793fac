# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Angles: the seams at pi and at north, and the one compass quantity among ENU ones."""

import math

from hypothesis import given, strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.nav.angles import arctan2, heading_from_yaw, wrap, yaw_from_heading

pytestmark = pytest.mark.core
ANGLES = st.floats(-50.0, 50.0)


@pytest.mark.parametrize(('angle', 'wrapped'), [
    (0.0, 0.0), (np.pi, np.pi), (-np.pi, np.pi), (3 * np.pi, np.pi), (2 * np.pi, 0.0),
    (1.5 * np.pi, -0.5 * np.pi), (-1.5 * np.pi, 0.5 * np.pi), (1e-300, 1e-300)])
def test_wrap(angle, wrapped):
    assert wrap(angle) == pytest.approx(wrapped, abs=1e-15)      # an ulp of 3 pi is 1.8e-15


@pytest.mark.parametrize('turns', range(-4, 5))
@pytest.mark.parametrize('steps', range(-4, 5))
def test_wrap_stays_in_its_interval_beside_every_odd_pi(turns, steps):
    angle = np.float64((2 * turns + 1) * np.pi)
    angle = angle + steps * np.spacing(angle)
    assert -np.pi < wrap(angle) <= np.pi


@given(angle=ANGLES)
def test_wrap_takes_whole_turns_only_and_leaves_the_inside_alone(angle):
    turns = (angle - wrap(angle)) / (2 * np.pi)
    # 50 rad carry 7e-15 of round-off, and so does the remainder
    assert turns == pytest.approx(round(turns), abs=1e-14)
    assert wrap(wrap(angle)) == wrap(angle)
    if -np.pi < angle <= np.pi:
        assert wrap(angle) == angle


def test_wrap_takes_arrays_and_gives_scalars_for_scalars():
    assert wrap(np.array([[0.0, 7.0]])).shape == (1, 2)
    assert f'{wrap(7.0):.3f}' == '0.717'


def test_compass_heading_of_43_3_deg_is_enu_yaw_of_46_7_deg():
    assert np.rad2deg(heading_from_yaw(np.deg2rad(46.7))) == pytest.approx(43.3, abs=1e-12)
    assert np.rad2deg(yaw_from_heading(np.deg2rad(43.3))) == pytest.approx(46.7, abs=1e-12)


@pytest.mark.parametrize(('heading_deg', 'east', 'north'), [
    (0, 0, 1), (90, 1, 0), (180, 0, -1), (270, -1, 0)])
def test_heading_turns_clockwise_from_north(heading_deg, east, north):
    yaw = yaw_from_heading(np.deg2rad(heading_deg))
    np.testing.assert_allclose([np.cos(yaw), np.sin(yaw)], [east, north], atol=1e-15)


@given(yaw=ANGLES)
def test_heading_and_yaw_undo_each_other(yaw):
    heading = heading_from_yaw(yaw)
    assert 0 <= heading < 2 * np.pi
    assert wrap(yaw_from_heading(heading) - yaw) == pytest.approx(0, abs=2e-14)


@pytest.mark.parametrize('steps', range(-4, 5))
def test_heading_stays_below_a_full_turn_beside_north(steps):
    assert 0 <= heading_from_yaw(np.pi / 2 + steps * np.spacing(np.pi / 2)) < 2 * np.pi


def test_the_arc_tangent_of_columns_does_not_hang_on_where_they_lie():
    """With numpy 1.26 a tenth of the copies has other last digits in np.arctan2 itself."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(7001, 3))
    held, seen = [], set()
    for _ in range(200):
        held = [*held[-50:], bytearray(int(rng.integers(60_000)))]      # move what comes after
        x, y, _ = points.copy().T
        seen.add(arctan2(y, x).tobytes())
    assert len(seen) == 1
    assert_allclose(arctan2(y, x), [math.atan2(b, a) for a, b, _ in points], rtol=1e-15)
