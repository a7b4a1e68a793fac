# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The filter of an odometer's speed against closed forms, and what the fit finds of one."""

import numpy as np
import pytest

from odocal_ros.calib.smoother.odometer_filter import as_rolled, REACH
from odocal_ros.calib.smoother.state import M, ODO_DELAY, ODO_LAG2
from odocal_ros.nav.odometer import Travel

SPEED, SWING, RATE = 10.0, 5.0, 0.5     # m/s, m, rad/s: travel SPEED t + SWING sin(RATE t)
T = 0.4                                 # s
FINE = np.arange(-5.0, 65.0, 1e-3)
AT = np.arange(0.0, 60.0, 0.1)
# of the acceleration by differences over REACH, and of the fourth derivative: of the two filters
# below, the mean leaves more of it
ROUNDING = SWING * RATE**4 * T**2 * (REACH**2 / 24 + 0.175 * T**2)


def travel(t, answer=1.0, delay=0.0):
    """Return travel at t behind a filter of that answer to RATE, complex, and mean delay, s."""
    return SPEED * (t - delay) + SWING * np.imag(answer * np.exp(1j * RATE * t))


def rolled(readings, delay, square):
    constants = np.zeros(M)
    constants[ODO_DELAY], constants[ODO_LAG2] = delay, square
    return as_rolled(Travel(FINE, readings, 0.0), constants)(AT)


def test_a_mean_is_undone():
    """The mean over W has a variance of W^2 / 12 and no third moment."""
    W = np.sqrt(12) * T
    answer = np.exp(-0.5j * RATE * W) * np.sinc(RATE * W / 2 / np.pi)
    readings = travel(FINE, answer, W / 2)
    np.testing.assert_allclose(rolled(readings, W / 2, T**2), travel(AT), atol=ROUNDING)
    assert 0.1 * np.abs(rolled(readings, W / 2, 0.0) - travel(AT)).max() > ROUNDING


def test_a_first_order_filter_is_undone_but_for_its_third_moment():
    """2 T^3, a sixth of which times the change of the acceleration is left."""
    found = rolled(travel(FINE, 1 / (1 + 1j * RATE * T), T), T, T**2)
    third = SWING * RATE**3 * T**3 / 3
    assert np.abs(found - travel(AT)).max() == pytest.approx(third, abs=ROUNDING)


@pytest.mark.parametrize('square', [T**2, 0.0, -T**2])
def test_the_derivative_by_the_square_is_half_the_acceleration(square):
    h = 1e-4
    found = (rolled(travel(FINE), T, square + h) - rolled(travel(FINE), T, square - h)) / (2 * h)
    expected = SWING * RATE**2 * np.sin(RATE * (AT + T)) / 2
    np.testing.assert_allclose(found, expected, atol=SWING * RATE**4 * REACH**2 / 24)


def test_a_drive_that_ends_in_motion_has_the_acceleration_of_its_last_second():
    """And one that begins so of its first: beyond the readings nothing is known."""
    push = 2.0                                  # m/s^2
    constants = np.zeros(M)
    constants[ODO_LAG2] = T**2
    readings = Travel(AT, push * AT**2 / 2, 0.0)
    expected = push * (AT**2 - T**2) / 2
    np.testing.assert_allclose(as_rolled(readings, constants)(AT), expected, atol=1e-9)
