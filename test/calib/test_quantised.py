# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Noise of a coarse IMU output is named quantisation; a delay that differs is no tyre."""

from types import SimpleNamespace

import numpy as np
import pytest

from odocal_ros.calib.smoother.mismatch import _coarse
from odocal_ros.calib.smoother.quantised import explained, steps
from odocal_ros.calib.smoother.several import _disputed

RATE = 100.0


def leg(step_w, step_f, noise=0.5, n=20_000):
    rng = np.random.default_rng(3)
    w, f = (np.cumsum(rng.standard_normal((n, 3)), axis=0) * 1e-3 + noise * 0.05
            * rng.standard_normal((n, 3)) for _ in range(2))
    w, f = (np.round(x / q) * q if q else x for x, q in ((w, step_w), (f, step_f)))
    return SimpleNamespace(t_imu=np.arange(n) / RATE, w_b=w, f_b=f)


def test_the_step_of_a_signal_is_found_and_none_where_there_is_none():
    found = steps(leg(np.deg2rad(0.25), 0.0))
    assert found['gyro'] == pytest.approx(np.deg2rad(0.25), rel=0.01)
    assert found['accel'] == 0.0


def test_quantisation_explains_noise_of_its_own_size_only():
    step = 0.125
    white = step * np.sqrt(1 / 12 / RATE)        # the closed form of rounding
    coarse = leg(0.0, step)
    assert explained(coarse, {'gyro': 1.0, 'accel': 1.4 * white}) == {
        'accel': pytest.approx(step, rel=0.01)}
    assert explained(coarse, {'gyro': 1.0, 'accel': 2.0 * white}) == {}
    text = _coarse({'accel': step}, {'gyro': 'gyro', 'accel': 'accelerometer'})
    assert 'quantisation: the accelerometer has steps of 0.125 m/s^2' in text
    assert _coarse({'gyro': np.deg2rad(0.25)}, {'gyro': 'gyro'}).count('0.25 deg/s') == 1
    assert _coarse({}, {'gyro': 'gyro'}) == ''


@pytest.mark.parametrize(('name', 'tyres'), [('odometer_delay', False), ('scale_factor', True)])
def test_legs_that_differ_in_a_delay_blame_no_tyre(name, tyres):
    found = SimpleNamespace(deviation=np.array([[9.0], [-9.0]]), names=[name], spread=[name],
                            factor=1.0)
    reason, = _disputed(found, [1, 2])
    assert ('tyre' in reason.remedy) == tyres
    assert ('time stamps' in reason.remedy) != tyres
