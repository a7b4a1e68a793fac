# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The wheels of a simulated vehicle against closed forms."""

from dataclasses import replace

import numpy as np
import pytest

from odocal_ros.errors import BadUsage
from odocal_ros.sim.options import resolved, SimOptions
from odocal_ros.sim.scenarios import simulate
from odocal_ros.sim.vehicle_wheels import wheels_of

TOWN = SimOptions(scenario='town', duration=200.0, imu_rate=20.0, wheels=4, seed=5)


@pytest.mark.parametrize('wheels', [1, 2, 3, 4, 6, 7, 8])
def test_the_mean_count_times_the_scale_is_the_path(wheels):
    options = resolved(replace(TOWN, wheels=wheels))
    fixed = [wheel for wheel in wheels_of(options) if not wheel.steered]
    assert np.mean([1 / wheel.scale for wheel in fixed]) == pytest.approx(1 / options.scale)
    assert len(wheels_of(options)) == len({wheel.name for wheel in wheels_of(options)}) == wheels


def test_wheels_without_steering_differ_by_the_turn_and_their_scale():
    drive = simulate(replace(TOWN, front_steers=False))
    state = drive.motion.at((drive.odometer.stamp_ns - drive.options.start_ns) * 1e-9)
    for wheel, samples in zip(wheels_of(drive.options), drive.wheels, strict=True):
        rolled = (samples.value - samples.value[0]) * wheel.scale
        np.testing.assert_allclose(
            rolled, state.travel - wheel.arm[1] * (state.turned - state.turned[0]), atol=1e-9)


def test_a_steered_wheel_rolls_along_its_own_curve():
    """Its path is that of its contact point in the plane, as a polyline of 1 ms has it."""
    drive = simulate(replace(TOWN, odometer_rate=200.0, latitude=0.0, heading=np.pi / 2))
    t = np.arange(0.0, drive.options.duration, 0.001)
    state = drive.motion.at(t)
    wheel = wheels_of(drive.options)[0]
    along, turn = np.gradient(state.travel, t), np.gradient(state.turned, t)
    speed = np.hypot(along - wheel.arm[1] * turn, wheel.arm[0] * turn)
    path = np.append(0.0, np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(t)))
    sent = drive.wheels[0]
    rolled = (sent.value - sent.value[0]) * wheel.scale
    at = (sent.stamp_ns - drive.options.start_ns) * 1e-9
    assert np.ptp(state.turned) > 1.0
    # the derivatives by differences of 1 ms are off by some ppm
    np.testing.assert_allclose(rolled, np.interp(at, t, path), atol=0.01)
    assert rolled[-1] - state.travel[-1] > 0.5        # m: far above that


@pytest.mark.parametrize(('change', 'words'), [
    ({'wheels': 9}, '1 to 8'), ({'wheels': 0}, '1 to 8'),
    ({'odometer': 'speed'}, '--wheels require')], ids=str)
def test_impossible_wheels_are_refused(change, words):
    with pytest.raises(BadUsage, match=words):
        resolved(replace(TOWN, **change))
