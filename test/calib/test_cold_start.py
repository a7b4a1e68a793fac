# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The cold start of long legs: parts with biases of their own, joined where fixes are missing."""

from dataclasses import replace

import numpy as np
import pytest
from smoother_legs import made, truth

from odocal_ros.estimator.prepare import problem_of
from odocal_ros.estimator.start import first_state
from odocal_ros.nav.rotations import rotvec, transpose
from odocal_ros.sim.real import Real

# of a consumer gyro that warms up by 10 K: 0.35 deg/s in all, half of it in the first 5 min
WARMS = Real(gyro_slope=(4e-4, -6e-4, 5e-4), warm_rise=10.0, warm_time=400.0)
DRIVE = {'duration': 1860.0, 'imu_rate': 20.0, 'odometer_rate': 10.0, 'imu_grade': 'consumer',
         'real': WARMS}


def errors(leg, drive, config):
    """Return the angles between the first attitudes and the true ones, rad, and the start."""
    problem = problem_of(leg, config)
    start = first_state(leg, problem.imu, problem.priors)
    true = truth(drive, config, leg)
    assert (start.state.t == true.t).all()
    C = transpose(true.C_nb) @ start.state.C_nb
    return np.linalg.norm(rotvec(C), axis=1), start, problem


def test_a_gyro_that_warms_up_is_level_in_each_part():
    drive, config, leg = made(**DRIVE)
    angle, start, problem = errors(leg, drive, config)
    # the bias changes by 2 mrad/s in the first part; a level that swings by it over minutes
    assert np.percentile(angle, 90) < 0.3
    assert np.log(start.state.scale / drive.truth.scale) == pytest.approx(0.0, abs=0.02)
    assert len(np.unique(start.state.gyro_bias, axis=0)) == 3


@pytest.mark.parametrize('gap', [(-20.0, 605.0), (595.0, 1225.0), (1215.0, 1850.0)])
def test_a_part_without_fixes_is_joined_with_its_neighbour(gap):
    drive, config, leg = made(**DRIVE)
    seen = (leg.t_fix < gap[0]) | (leg.t_fix > gap[1])
    sparse = replace(leg, t_fix=leg.t_fix[seen], fixes_n=leg.fixes_n[seen],
                     covariance_n=leg.covariance_n[seen])
    problem = problem_of(sparse, config)
    start = first_state(sparse, problem.imu, problem.priors)
    assert (start.state.t == problem.imu.t[problem.imu.key]).all()
    assert len(np.unique(start.state.gyro_bias, axis=0)) == 2
    assert np.log(start.state.scale / drive.truth.scale) == pytest.approx(0.0, abs=0.05)
