# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Heights whose error changes over more time than a leg has."""

from dataclasses import replace

import numpy as np
import pytest
from smoother_legs import made

from odocal_ros.estimator.smoother import smooth
from odocal_ros.estimator.state import CONSTANTS, HEIGHT_DRIFT

pytestmark = pytest.mark.slow
STATED, CHANGE = 1.0, 1.5           # m: stated sigma of heights, and change of their error


@pytest.fixture(scope='module')
def drifting():
    """Return the drive and the result of a town whose heights drift, else good to 5 cm."""
    drive, config, leg = made(scenario='town', duration=500.0, fix_noise='white', fix_sigma=0.05)
    covariance = leg.covariance_n.copy()
    covariance[:, 2, 2] = STATED**2
    fixes = leg.fixes_n.copy()
    fixes[:, 2] += CHANGE * leg.t_fix / leg.t_fix[-1]
    return drive, leg, smooth(replace(leg, fixes_n=fixes, covariance_n=covariance), config)


def test_the_drift_is_found_and_the_pitch_is_within_its_sigma(drifting):
    drive, leg, result = drifting
    found = result.details[CONSTANTS[HEIGHT_DRIFT]]
    assert abs(found['value'] - CHANGE / leg.t_fix[-1]) < 3 * found['sigma']
    pitch = result.estimates['pitch_mounting_angle']
    assert abs(pitch.value - drive.truth.pitch) < 3 * pitch.sigma
    # if the rise were the pitch's, it would show
    path = drive.truth.scale * np.abs(np.diff(drive.odometer.value.astype(float))).sum()
    assert pitch.sigma < CHANGE / path / 2
