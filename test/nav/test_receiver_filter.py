# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Position error by the filter of a receiver, against its response to a sine."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.nav.receiver_filter import filter_error, MIN_LAG2, odometer_error

W = np.array([0.5, 0.7])


def swaying(t):
    """Return position, m, and velocity, m/s, of a sinusoidal path: (n, 2) each."""
    phase = np.multiply.outer(t, W)
    return [20.0, 3.0] * np.sin(phase), [10.0, 2.1] * np.cos(phase)


@pytest.mark.parametrize('tau', [0.005, 0.3, 1.0, 2.5])
@pytest.mark.parametrize(('square', 'error'), [
    (1, lambda s: np.exp(s) / (1 + s) - 1),                     # of first order
    (-2, lambda s: -s**2 / (s**2 + np.sqrt(2) * s + 1))])       # of position and velocity
def test_filter_error_of_a_sine_is_the_filter_response(square, error, tau):
    t, at, square = np.arange(0.0, 60.0, 0.2), np.linspace(35.0, 50.0, 40), square * tau**2
    off, rate = filter_error(t, *swaying(t), at, square)
    want = [20.0, 3.0] * (np.exp(1j * np.multiply.outer(at, W)) * error(1j * W * tau)).imag
    # a cubic over 0.2 s has a curvature error of (0.2 w)^2 / 12; the initial transient is at
    # exp(-35 / (2.5 sqrt(2)))
    assert_allclose(off, want, rtol=0, atol=3e-3 * np.abs(want).max())
    h = 1e-3 * max(abs(square), MIN_LAG2)
    above, below = (filter_error(t, *swaying(t), at, square + x)[0] for x in (h, -h))
    # the difference in the product is one-sided, over 1e-4 of tau^2
    assert_allclose(rate, (above - below) / (2 * h), rtol=0, atol=1e-3 * np.abs(rate).max())


def test_error_of_an_odometer_in_the_receiver_is_high_pass_filtered():
    t, at, share, time = np.arange(0.0, 200.0, 0.2), np.linspace(150.0, 190.0, 40), 0.02, 8.0
    error, by_share, by_log_time = odometer_error(t, *swaying(t), at, share, np.log(time))
    s = 1j * W * time
    sines = np.exp(1j * np.multiply.outer(at, W)) * s / (1 + s)
    want = share * (np.array([20.0, 3.0]) * sines.imag)
    assert_allclose(error, want, rtol=0, atol=1e-3 * np.abs(want).max())
    assert_allclose(by_share, error / share, rtol=1e-12)
    above, below = (odometer_error(t, *swaying(t), at, share, np.log(time) + x)[0]
                    for x in (1e-3, -1e-3))
    assert_allclose(by_log_time, (above - below) / 2e-3, rtol=0,
                    atol=2e-3 * np.abs(by_log_time).max())


def test_path_is_extrapolated_straight_beyond_its_ends():
    t = np.arange(0.0, 10.0)
    place = np.stack([3.0 * t, 0 * t], -1)
    late, _ = filter_error(t, place, np.tile([3.0, 0.0], (10, 1)), np.array([0.0, 5.0, 9.0]),
                              4.0)
    # at constant velocity the error is a delay of tau only, which is in the delay parameter
    assert_allclose(late, 0.0, atol=1e-12)
