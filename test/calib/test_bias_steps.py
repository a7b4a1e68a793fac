# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A bias that steps in mid-drive: values within their sigmas, and sigmas as without the step."""

from dataclasses import replace
import re

from drives import cached
import numpy as np
import pytest
from smoother_legs import made

from odocal_ros.estimator import smooth
from odocal_ros.reasons import Code

pytestmark = pytest.mark.slow
SENSORS = {'f_b': 'accelerometer', 'w_b': 'gyro'}
AT = 70.0       # s
STEPS = {'f_b': (0.06, 0.06, -0.05), 'w_b': (0.001, -0.001, 0.0014)}     # 10 mg, 0.1 deg/s


@cached
def calibrated(stepping=None):
    """Return a drive and its result, with the bias of one sensor stepping at AT."""
    drive, config, leg = made(duration=200.0, imu_grade='industrial', fix_noise='rtk')
    if stepping:
        step = (leg.t_imu > AT)[:, None] * np.array(STEPS[stepping])
        leg = replace(leg, **{stepping: getattr(leg, stepping) + step})
    return drive, smooth(leg, config)


@pytest.mark.parametrize('stepping', STEPS)
def test_a_step_of_a_bias_is_a_step_and_no_noise(stepping):
    drive, method = calibrated(stepping)
    _, plain = calibrated()
    for name, true in (('scale_factor', drive.truth.scale),
                       ('yaw_mounting_angle', drive.truth.yaw),
                       ('pitch_mounting_angle', drive.truth.pitch)):
        estimate = method.estimates[name]
        assert abs(estimate.value - true) < 3.3 * estimate.sigma
        # one interval without the continuity of the bias, of 200
        assert estimate.sigma < 1.3 * plain.estimates[name].sigma
    said = {r.code: r.text for r in method.reasons}
    assert not {Code.IMU_WORSE_THAN_GRADE, Code.MODEL_MISMATCH, Code.WHEEL_SLIP,
                Code.CHANGE_IN_LEG} & set(said)
    assert Code.IMU_BIAS_STEP not in {r.code for r in plain.reasons}
    found = re.fullmatch(f'the {SENSORS[stepping]} bias changes by ([0-9.]+) (deg/s|m/s\\^2) near '
                         't = ([0-9]+) s; estimated before and after', said[Code.IMU_BIAS_STEP])
    unit = {'deg/s': np.deg2rad(1.0), 'm/s^2': 1.0}[found[2]]
    # two digits; a step within an interval of a second
    assert float(found[1]) * unit == pytest.approx(np.linalg.norm(STEPS[stepping]), rel=0.1)
    assert abs(float(found[3]) - AT) <= 3
