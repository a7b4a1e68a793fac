# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The stated covariance of a wheel twist against the errors of simulated drives."""

from drives import drive, settings
import numpy as np
import pytest

from odocal_ros.calib.result import AS_SENT
from odocal_ros.estimator.result.twist_noise import twist_noise
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.pipeline.combination import combine
from odocal_ros.sim.real import Real

pytestmark = pytest.mark.slow


def errors_over_sigma(made):
    """Return rms error over sigma of the speed, and of the turn rate if two wheels give it."""
    config = settings(made, heading_sigma=None, method='smoother')
    result = combine([calibrate(made.leg(), config)], config)
    noise, estimates = twist_noise(result), result.estimates
    t = (made.odometer.stamp_ns - made.options.start_ns) * 1e-9
    state, T = made.motion.at(t), np.diff(t)
    if made.options.odometer == 'speed':        # of a moment
        factor = estimates.get(AS_SENT, estimates['scale_factor']).value
        v, w, wheels = state.speed[1:], state.yaw_rate[1:], [factor * made.odometer.value[1:]]
    else:                                       # the mean between two messages
        sides = ('_left', '_right') if len(made.wheels) > 1 else ('',)
        v, w = np.diff(state.travel) / T, (state.yaw_rate[1:] + state.yaw_rate[:-1]) / 2
        wheels = [estimates[f'scale_factor{side}'].value * np.diff(wheel.value) / T
                  for side, wheel in zip(sides, made.wheels, strict=True)]
    moving = np.abs(v) > 0.5
    variance = np.array([noise.variances(*row) for row in zip(v[moving], w[moving], strict=True)])
    found = [(np.mean(wheels, axis=0) - v)[moving]**2 / variance[:, 0]]
    if noise.has_turn_rate:
        turned = (wheels[1] - wheels[0]) / estimates['track_width'].value
        found.append((turned - w)[moving]**2 / variance[:, 3])
    return np.sqrt(np.mean(found, axis=1))


@pytest.mark.parametrize('options', [
    {}, {'two_wheels': True, 'slip_walk': 0.01},
    {'two_wheels': True, 'odometer_rate': 50.0, 'scenario': 'yard', 'fix_noise': 'rtk'},
    {'odometer': 'angle', 'slip_walk': 0.01, 'odometer_rate': 20.0},
    {'odometer': 'speed', 'speed_noise': 0.02},
    {'odometer': 'speed', 'seed': 12, 'real': Real(speed_step=1 / 3.6), 'duration': 500.0},
    {'odometer': 'speed', 'speed_noise': 0.005, 'scenario': 'motorway',
     'real': Real(speed_law=0.01)}], ids=str)
def test_errors_over_sigma_are_one(options):
    """
    With 300 s at 10 Hz or more, the rms of independent errors is within 1.3 % of one.

    The tolerance is for what is not independent: constants, one cruise of a quantised speed.
    """
    made = drive(**({'scenario': 'town', 'duration': 300.0, 'seed': 4, 'imu_grade': 'industrial',
                     'odometer_rate': 10.0} | options))
    for ratio in errors_over_sigma(made):
        assert 0.85 < ratio < 1.15
