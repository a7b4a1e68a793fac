# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The iteration of a fit: sigmas that rise and then fall, steps that turn back."""

from drives import configured
import numpy as np
import pytest

from odocal_ros.estimator import fit
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code
from odocal_ros.sim.draw import drawn
from odocal_ros.sim.scenarios import SimOptions, simulate

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


def test_the_first_step_by_fitted_signals_is_not_shortened(monkeypatch):
    """It takes back what noise in the signals made of the steps before, however much."""
    drive = simulate(SimOptions(scenario='town', duration=140.0, imu_rate=20.0, seed=1))
    passes: list[tuple[bool, bool]] = []      # by fitted signals; compared with a step before

    class Watched(fit.Equations):
        def __init__(self, *args):
            passes.append((args[4], False))
            super().__init__(*args)

    def damped(solved, taken, own=fit.damped):
        passes[-1] = passes[-1][0], bool(taken.any())
        return own(solved, taken)
    monkeypatch.setattr(fit, 'Equations', Watched)
    monkeypatch.setattr(fit, 'damped', damped)
    calibrate(drive.leg(), configured(drive))
    first = passes.index((True, False))
    assert first > 1
    assert all(compared for _, compared in passes[1:first])
    assert all(fitted and compared for fitted, compared in passes[first + 1:])
