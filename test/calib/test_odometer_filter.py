# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The filter of an odometer's speed against closed forms, and what the fit finds of one."""

import numpy as np
import pytest

from odocal_ros.estimator.factors.odometer_filter import as_rolled, REACH
from odocal_ros.estimator.state import M, ODO_CLOCK, ODO_DELAY, ODO_LAG2
from odocal_ros.nav.odometer import Travel

SPEED, SWING, RATE = 10.0, 5.0, 0.5     # m/s, m, rad/s: travel SPEED t + SWING sin(RATE t)
T = 0.4                                 # s
FINE = np.arange(-5.0, 65.0, 1e-3)
AT = np.arange(0.0, 60.0, 0.1)
ANGLE = RATE * T
# of derivatives by differences over REACH, and of the next orders of the filters below
ROUNDING = SWING * (ANGLE**2 * (RATE * REACH)**2 * (1 / 24 + ANGLE / 48)
                    + 0.175 * ANGLE**4 + 0.5 * ANGLE**5)


def travel(t, answer=1.0, delay=0.0):
    """Return travel at t behind a filter of that answer to RATE, complex, and mean delay, s."""
    return SPEED * (t - delay) + SWING * np.imag(answer * np.exp(1j * RATE * t))


def rolled(readings, delay, square):
    constants = np.zeros(M)
    constants[ODO_DELAY], constants[ODO_LAG2] = delay, square
    return as_rolled(Travel(FINE, readings, 0.0), constants)(AT)


def test_a_first_order_filter_is_corrected():
    readings = travel(FINE, 1 / (1 + 1j * ANGLE), T)
    np.testing.assert_allclose(rolled(readings, T, T**2), travel(AT), atol=ROUNDING)
    assert 0.1 * np.abs(rolled(readings, T, 0.0) - travel(AT)).max() > ROUNDING


def test_a_mean_is_corrected_except_for_its_third_moment():
    """The mean over W has a variance of W^2 / 12 and no third moment, the filter one of 2 T^3."""
    W = np.sqrt(12) * T
    answer = np.exp(-0.5j * RATE * W) * np.sinc(RATE * W / 2 / np.pi)
    found = rolled(travel(FINE, answer, W / 2), W / 2, T**2)
    assert np.abs(found - travel(AT)).max() == pytest.approx(SWING * ANGLE**3 / 3, abs=ROUNDING)


@pytest.mark.parametrize('square', [T**2, 0.0, -T**2])
def test_the_derivative_by_the_square_is_half_the_acceleration(square):
    """And half of T times its change, which the fit leaves out."""
    h = 1e-4
    found = (rolled(travel(FINE), T, square + h) - rolled(travel(FINE), T, square - h)) / (2 * h)
    lag, angle = np.sqrt(max(square, 0.0)), RATE * (AT + T)
    expected = SWING * RATE**2 * (np.sin(angle) - RATE * lag * np.cos(angle)) / 2
    # differences over REACH; about zero the third moment is that of T^2 = h
    loose = SWING * RATE**4 * REACH**2 * (1 / 24 + RATE * lag / 32) \
        + SWING * RATE**3 * np.sqrt(h)
    np.testing.assert_allclose(found, expected, atol=loose)


def test_a_drive_that_ends_in_motion_has_the_acceleration_of_its_last_second():
    """And one that begins so of its first: beyond the readings nothing is known."""
    push = 2.0                                  # m/s^2
    constants = np.zeros(M)
    constants[ODO_LAG2] = T**2
    readings = Travel(AT, push * AT**2 / 2, 0.0)
    expected = push * (AT**2 - T**2) / 2
    np.testing.assert_allclose(as_rolled(readings, constants)(AT), expected, atol=1e-9)


def test_a_fast_clock_is_corrected():
    """The delay is that at 0, where the clocks agree but for it."""
    fast, constants = 1e-3, np.zeros(M)
    constants[ODO_DELAY], constants[ODO_CLOCK] = T, fast
    readings = Travel(FINE * (1 + fast) + T, travel(FINE), 0.0)
    # readings are straight lines between samples
    loose = SWING * RATE**2 * (FINE[1] - FINE[0])**2 / 8 + 1e-9
    np.testing.assert_allclose(as_rolled(readings, constants)(AT), travel(AT), atol=loose)
