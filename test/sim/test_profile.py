# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Piecewise polynomials against closed forms."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.sim.profile import chain, hold, ramp, smooth, turn

pytestmark = pytest.mark.core


def test_a_ramp_gains_its_speed_and_covers_half_the_way():
    speed = chain(hold(3) + ramp(10, 12, 1.0) + hold(5)).integral()
    # symmetric about its middle: mean speed 6 m/s over 10 s, then 12 m/s for 5 s
    assert speed([0, 3, 8, 13, 18, 99]) == pytest.approx([0, 0, 6, 12, 12, 12], abs=1e-13)
    assert speed.integral()(18.0) == pytest.approx(6 * 10 + 12 * 5, abs=1e-12)


def test_a_turn_turns_by_its_angle_whatever_its_flanks():
    for blend in (0.5, 2.0, 4.0):
        assert chain(turn(8, 1.3, blend)).integral()(8.0) == pytest.approx(1.3, abs=1e-14)


def test_derivative_undoes_the_integral():
    rate = chain([smooth(2, 0, 3), smooth(5, 3, -1), *hold(1)])
    t = np.linspace(0.01, 7.99, 1000)
    assert_allclose(rate.integral().derivative()(t), rate(t), atol=1e-14)
    h = 1e-5   # central difference: h^2 / 6 * third derivative (4.5) = 8e-11, rounding 3e-11
    assert_allclose((rate(t + h) - rate(t - h)) / (2 * h), rate.derivative()(t), atol=3e-10)


def test_a_jump_has_the_mean_of_its_sides():
    acceleration = chain(hold(300) + ramp(40, 20, 0.0) + hold(1))
    at = np.array([299.99, 300.0, 300.00000000000006, 300.01, 340.0])
    assert acceleration.mean(at) == pytest.approx([0, 0.25, 0.25, 0.5, 0.25])
    # so a trapezoid rule over samples gives the speed exactly
    t = np.arange(34101) * 0.01
    a = acceleration.mean(t)
    assert np.sum((a[1:] + a[:-1]) / 2) * 0.01 == pytest.approx(20.0, abs=1e-10)


def test_values_hold_outside():
    level = chain([smooth(2, 5, 7)])
    assert level([-1, 0, 2, 3]).tolist() == [5, 5, 7, 7]
