# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A fit whose sigmas rise and then fall does not end between."""

from drives import configured
import numpy as np
import pytest

from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code
from odocal_ros.sim.draw import drawn
from odocal_ros.sim.scenarios import simulate

pytestmark = pytest.mark.core


def test_noise_of_rtk_at_one_hz_is_not_taken_for_correlated_errors():
    made, _ = drawn(109_000_002, 'motorway', 'industrial', ('squat', 'sideslip'), duration=300.0,
                    fix_noise='rtk', fix_sigma=0.02)
    assert made.fix_rate == 1.0
    drive = simulate(made)
    config = configured(drive)
    result = combine([calibrate(drive.leg(), config)], config)
    scale = result.estimates['scale_factor']
    # both ends of the drive are known by half a minute of white errors, beside the limit of 6 ppm
    ends = made.fix_sigma * np.sqrt(2 / 30) / drive.truth.distance
    assert scale.sigma / scale.value < 2 * np.hypot(ends, 6e-6)
    assert Code.FIXES_NOISIER_THAN_SAID not in {reason.code for reason in result.reasons}
