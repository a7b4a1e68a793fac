# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Calibrations with constant values, so that every written field is known."""

from dataclasses import replace

from calibration_parts import GAP
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
START_NS = 1_533_200_000_500_000_000        # 2018-08-02 08:53:20.5 UTC
TURN = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])    # Rz(-90 deg)


def estimates(unit='m/pulse', scale=0.05, ratio=1.25):
    return {
        'scale_factor': Estimate(scale, 1.2e-6, unit),
        'scale_ratio': Estimate(ratio, None if ratio is None else 3e-5, '1'),
        'yaw_mounting_angle': Estimate(-0.0174533, 5e-5, 'rad'),
        'pitch_mounting_angle': Estimate(None, None, 'rad')}


@pytest.fixture
def good():
    """Return an accepted calibration of one leg, K0 = 0.04 m/pulse, pitch not determined."""
    values = estimates()
    method = MethodResult(
        'two_point', (PITCH_LOST,), values, ('scale_factor', 'yaw_mounting_angle'),
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
    result = {name: replace(e, method='two_point') for name, e in values.items()}
    return Calibration((GAP, PITCH_LOST), result, {'two_point': method}, (leg,),
                       (0.0, 0.0, -0.0087, 0.99996), (0.0, 0.0, -0.0174533))


SMOOTHED = {
    'widened': 1.0, 'noise': {
        'along': 0.003, 'along_hard': 0.004, 'side': 0.002, 'side_turn': 0.005, 'up': 0.002},
    'odometer': {'reading': 0.25, 'period': 0.1, 'speed_step': 0.0, 'hard': 0.25, 'speed': 8.0,
                 'fastest': 14.0, 'turn_rate': 0.06, 'fastest_turn': 0.3, 'square_speed': 80.0},
    'wheels': {side: {'ratio': 1.0, 'ratio_sigma': 1e-6, 'y': 0.8, 'y_sigma': 3e-4,
                      'walk': (1e-3, 2e-3, 3e-3)} for side in ('left', 'right')},
    **{name: {'value': 0.0, 'sigma': 0.0} for name in (
        'scale_by_speed', 'scale_by_curvature', 'sideslip', 'speed_offset')},
    'gyro_scale_z': {'value': 0.002, 'sigma': 1e-4}, 'gyro_scale_x': {'value': 0.0, 'sigma': 1e-2},
    'posterior_to_prior': {'gyro_scale_z': 0.1, 'gyro_scale_x': 0.99},
    'accelerometer_bias': {axis: {'value': 0.01, 'sigma': 0.02, 'ratio': ratio}
                           for axis, ratio in (('x', 0.2), ('y', 0.9), ('z', 1.0))}}


@pytest.fixture
def smoothed(good):
    """Return an accepted calibration of two wheels by the smoother, 0.05 m/pulse."""
    method = replace(good.methods['two_point'], name='smoother', details=SMOOTHED)
    leg = replace(good.legs[0], methods={'smoother': method}, origin=(0.8, 0.2, 100.0))
    values = {**good.estimates, 'track_width': Estimate(1.6, 1e-3, 'm'),
              **{f'scale_factor_{side}': Estimate(0.05, 1e-6, 'm/pulse')
                 for side in ('left', 'right')},
              **{f'gyro_bias_{axis}': Estimate(0.1, 1e-5, 'rad/s') for axis in 'xyz'}}
    return replace(good, methods={'smoother': method}, legs=(leg,), estimates={
        name: replace(e, method='smoother') for name, e in values.items()})


@pytest.fixture
def nothing():
    reason = Reason(Code.NO_FIX, 'no fix came')
    leg = LegResult(0, 10 * 10**9, 0.0, 10.0, 5, 5, 0, 0, (reason,), {})
    return Calibration((reason,), {}, {}, (leg,))


@pytest.fixture
def rejected(good):
    return replace(good, reasons=(*good.reasons, Reason(Code.GYRO_SIGN, 'gyro z is reversed')))
