# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fixes of a receiver that converges: their errors fall as the sigmas that it states."""

from dataclasses import replace

import numpy as np
import pytest
from smoother_legs import made

from odocal_ros.estimator.smoother import smooth
from odocal_ros.estimator.state import BY_SIGMA, CONSTANTS

pytestmark = pytest.mark.slow
START, WHITE, TIME = 1.2, 0.02, 300.0       # m, m, s
IN_SIGMAS = np.array([0.8, -1.2, 0.5])      # east, north, up


@pytest.fixture(scope='module')
def converging():
    """Return a drive along a motorway whose fixes converge, its leg and its result."""
    drive, config, leg = made(scenario='motorway', duration=500.0, fix_noise='white',
                              fix_sigma=WHITE, imu_grade='industrial')
    stated = np.hypot(WHITE, START * np.exp(-leg.t_fix / TIME))[:, None] * np.ones(3)
    return drive, leg, smooth(replace(
        leg, fixes_n=leg.fixes_n + IN_SIGMAS * stated,
        covariance_n=stated[:, :, None]**2 * np.eye(3)), config)


def test_the_error_is_found_and_the_scale_is_within_its_sigma(converging):
    drive, leg, result = converging
    scale = result.estimates['scale_factor']
    assert abs(scale.value - drive.truth.scale) < 3 * scale.sigma
    # if the error were the scale's, it would show
    path = drive.truth.scale * np.abs(np.diff(drive.odometer.value.astype(float))).sum()
    assert scale.sigma / drive.truth.scale < START / path / 2
    for name, true in zip(CONSTANTS[BY_SIGMA], IN_SIGMAS, strict=True):
        assert abs(result.details[name]['value'] - true) < 3 * result.details[name]['sigma']
