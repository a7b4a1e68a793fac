# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What the IMU's errors multiply: a signal, not the noise of sensor and road."""

import numpy as np
import pytest
from smoother_legs import made, truth

from odocal_ros.calib.smoother.equations import Equations
from odocal_ros.calib.smoother.motion_rows import MotionRows
from odocal_ros.calib.smoother.problem import Problem
from odocal_ros.calib.smoother.signals import lasting
from odocal_ros.calib.smoother.smoother import smooth
from odocal_ros.calib.smoother.state import ACCEL_ERRORS, CONSTANTS, GYRO_ERRORS
from odocal_ros.settings.config import with_settings

pytestmark = pytest.mark.slow
SCALES = [name for name in CONSTANTS if name.startswith(('gyro_scale', 'accelerometer_scale'))]


def scores(fitted):
    """Return what noise alone says of the IMU's errors at the truth, in its sigmas."""
    drive, config, leg = made(duration=300.0, imu_grade='consumer')
    problem, state = Problem.of(leg, config), truth(drive, config, leg)
    weighted = Equations(problem, state, fitted=fitted).at(
        problem.first_levels)
    rows = weighted[MotionRows]
    J = rows.J[:, :, -len(CONSTANTS):]
    score, information = np.einsum('kij,ki->j', J, rows.r), (J**2).sum(axis=(0, 1))
    return {name: score[i] / np.sqrt(information[i]) for i, name in enumerate(CONSTANTS)
            if name in GYRO_ERRORS or name in ACCEL_ERRORS}


def test_at_the_truth_noise_says_nothing_of_the_imus_errors():
    off = scores(fitted=True)
    assert len(off) == len(GYRO_ERRORS) + len(ACCEL_ERRORS)
    # by chance one of 19 lies beyond 3.5 in 1 of 100
    assert {name: x for name, x in off.items() if abs(x) > 3.5} == {}
    # by the signal as measured a scale has one for each degree of freedom that noise has; those
    # of the axes that hardly turn see little else
    measured = scores(fitted=False)
    both = [x['gyro_scale_x'] + x['gyro_scale_y'] for x in (measured, off)]
    assert both[0] - both[1] < -3.0


@pytest.mark.parametrize('sway', [0.0, 0.05])
def test_a_road_that_shakes_makes_no_scale_error(sway):
    _, config, leg = made(duration=1200.0, imu_grade='consumer', sway=sway, odometer='speed',
                          odometer_rate=10.0, speed_noise=0.05)
    graded = with_settings(config, {f'imu.{name}_sigma': np.nan for name in (
        'accel_scale', 'misalignment', 'gyro_by_force')})
    details = smooth(leg, graded).details
    for name in SCALES:
        found = details[name]['value']
        assert abs(found) < 3.3 * details[name]['sigma'], name


def test_what_lasts_is_what_a_running_mean_leaves():
    T = np.full(100, 0.5)
    steady, shaking = np.full(100, 3.0), np.tile([1.0, -1.0], 50)
    x = np.stack([steady, shaking], -1)
    out = lasting(x, T)
    np.testing.assert_allclose(out[:, 0], 3.0)
    # of 21 values, odd in number, one is left over
    np.testing.assert_allclose(np.abs(out[10:-10, 1]), 1 / 21)
