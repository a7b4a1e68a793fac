# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Calibrations to write and to tell of, made by hand so that every field is known."""

from dataclasses import replace

import numpy as np
import pytest

from odocal_ros.calib.result import (
    Calibration,
    Estimate,
    LegResult,
    MethodResult,
    Source,
    TrackCheck,
)
from odocal_ros.reasons import Code, Reason

PITCH_LOST = Reason(Code.PITCH_NOT_DETERMINED, 'the heights of the fixes are too inaccurate')
GAP = Reason(Code.TOPIC_GAP, 'odometer gap of 1.2 s at t = 3.1 s')
START_NS = 1_533_200_000_500_000_000        # 2018-08-02 08:53:20.5 UTC
TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])    # Rz(-90 deg)


def estimates(unit='m/pulse', scale=0.05, ratio=1.25):
    """Return what a two-point leg gives."""
    return {
        'scale_factor': Estimate(scale, 1.2e-6, unit),
        'scale_ratio': Estimate(ratio, None if ratio is None else 3e-5, '1'),
        'yaw_mounting_angle': Estimate(-0.0174533, 5e-5, 'rad'),
        'pitch_mounting_angle': Estimate(None, None, 'rad')}


@pytest.fixture
def good():
    """Return an accepted calibration of one leg, K0 = 0.04 m/pulse, pitch not determined."""
    found = estimates()
    method = MethodResult(
        'two_point', (PITCH_LOST,), found, ('scale_factor', 'yaw_mounting_angle'),
        (Source('fixes', np.diag([2e-5, 1e-6])), Source('gyro_bias_z', np.diag([1e-6, 5e-5]))),
        {'budget': {'fixes': {'scale_factor': np.float64(1e-6)}},
         'correlation': {'scale_factor,yaw_mounting_angle': 0.25},
         'heading_source': 'fixed', 'f': np.array([0.05, 0.0, 0.0]), 'odd': float('nan')})
    leg = LegResult(
        start_ns=START_NS, stop_ns=START_NS + 600 * 10**9, distance=11200.3, duration=600.0,
        imu_samples=120_000, pulses=30_000, fixes=3000, rejected_fixes=4, reasons=(GAP,),
        methods={'two_point': method}, before=TrackCheck(1500.0, 2800.0, 1400.0, 2800.0, 25.0),
        after=TrackCheck(0.1, 0.3, 0.09, 0.02, 1.8e-4), track_n=np.zeros((5, 3)), bag='drive',
        C_bi=TURN)
    result = {name: replace(e, method='two_point') for name, e in found.items()}
    return Calibration((GAP, PITCH_LOST), result, {'two_point': method}, (leg,),
                       (0.0, 0.0, -0.0087, 0.99996), (0.0, 0.0, -0.0174533))


@pytest.fixture
def nothing():
    """Return a rejected calibration that found no number at all."""
    reason = Reason(Code.NO_FIX, 'no fix came')
    leg = LegResult(0, 10 * 10**9, 0.0, 10.0, 5, 5, 0, 0, (reason,), {})
    return Calibration((reason,), {}, {}, (leg,))


@pytest.fixture
def rejected(good):
    """Return a calibration that was computed whole and is rejected for another reason."""
    return replace(good, reasons=(*good.reasons, Reason(Code.GYRO_SIGN, 'gyro z is reversed')))
