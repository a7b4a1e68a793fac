# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A bus that kneels at its stops has the result of one that does not."""

from dataclasses import replace

from drives import configured
import numpy as np
import pytest
from smoother_legs import made, truth

from odocal_ros.estimator.equations import Equations
from odocal_ros.estimator.factors.point_rows import TAIL_SIGMAS
from odocal_ros.estimator.factors.rests import STILL_TURN
from odocal_ros.estimator.prepare import problem_of
from odocal_ros.estimator.state import M, PHI, WITH_SLOW
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.reasons import Code
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.real import Real
from odocal_ros.sim.scenarios import simulate

pytestmark = pytest.mark.core
BUS = SimOptions(scenario='town', duration=250.0, imu_grade='industrial', imu_rate=50.0,
                 fix_noise='rtk')


def result(kneeling):
    """Return the calibration of a drive, and the leg's result of the smoother."""
    drive = simulate(replace(BUS, real=Real(kneeling=kneeling)))
    config = configured(drive)
    return combine([calibrate(drive.leg(), config)], config), drive.truth


def test_a_bus_that_kneels_has_the_sigmas_of_one_that_does_not():
    (kneels, true), (stands, _) = (result(np.radians(x)) for x in (2.0, 0.0))
    # white noise of the IMU and the standstills that are left without a tilt
    more = 1.2
    for name in ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle'):
        assert kneels.estimates[name].sigma < more * stands.estimates[name].sigma
    scale = kneels.estimates['scale_factor']
    assert abs(scale.value - true.scale) < 4 * scale.sigma
    said = {reason.code for reason in kneels.reasons}
    assert not said & {Code.IMU_WORSE_THAN_GRADE, Code.MODEL_MISMATCH, Code.LEVER_ARM_OFF}


def test_a_turn_at_rest_has_the_variance_that_makes_it_an_outlier_of_three_sigmas():
    drive, config, leg = made(imu_grade='perfect', fix_sigma=0.0, duration=150.0)
    problem, state = problem_of(leg, config), truth(drive, config, leg)
    k = int(np.flatnonzero(problem.still[:-1] & problem.still[1:])[3])
    step, tilt = np.zeros((len(state.t), WITH_SLOW)), 0.01
    step[k + 1:, PHI.start] = tilt
    part = Equations(problem, state.moved(step, np.zeros(M))).parts['rests']
    T = float(np.diff(state.t)[k])
    z2 = (tilt / STILL_TURN[0])**2 / T / 3
    variance = part.turn_variance[k]
    assert variance == pytest.approx(STILL_TURN**2 * T * z2 / TAIL_SIGMAS**2, rel=1e-3)
    assert part.turn_variance[k - 1] == pytest.approx(STILL_TURN**2 * np.diff(state.t)[k - 1])
