# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Which method's word on slip is the leg's, and slip of a speed in coarse steps."""

from dataclasses import replace

from drives import drive, everything_said, settings
import numpy as np
import pytest

from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.pipeline.method_run import MethodRun
from odocal_ros.pipeline.methods import found_by
from odocal_ros.reasons import Code, Reason

SPUN, SLID = (Reason(Code.WHEEL_SLIP, f'the wheel {what}') for what in ('spun', 'slid'))
REJECTED = (Reason(Code.NOT_CONVERGED, 'it did not'),)
SPEED = {'scenario': 'town', 'odometer': 'speed', 'scale': 1.01, 'nominal_scale': 1.0,
         'duration': 300.0, 'imu_grade': 'industrial', 'seed': 7}


def run(name, odometer, reasons=()):
    method = MethodResult(name, reasons, {'scale_factor': Estimate(1.0, 0.01, '1')}, (), (), {})
    return MethodRun(method, odometer=odometer)


@pytest.mark.parametrize(('smoother', 'said'), [
    (run('smoother', ()), []),                          # it fitted the leg and saw none
    (run('smoother', (SLID,)), [SLID]),
    (run('smoother', None), [SPUN]),                    # it did not look
    (run('smoother', (), REJECTED), [SPUN])])
def test_slip_is_by_the_smoother_where_it_gives_the_value(smoother, said):
    runs = {'smoother': smoother, 'two_point': run('two_point', (SPUN,), REJECTED)}
    assert found_by(runs, None) == said


def test_slip_is_by_two_point_where_it_is_alone():
    assert found_by({'two_point': run('two_point', (SPUN,), REJECTED)}, None) == [SPUN]


def whole_kmh(leg, spun=0.0):
    """Return a leg of speeds in whole km/h, 10 Hz; spun: m in 2 s at 8 m/s and more."""
    sent = leg.odometer
    t, value = (sent.stamp_ns - leg.start_ns) * 1e-9, sent.value.copy()
    fast = t[(value > 8.0) & (t > 60.0)][0]
    value[(t > fast) & (t < fast + 2.0)] += spun / 2.0
    return replace(leg, odometer=replace(sent, value=np.trunc(3.6 * value) / 3.6)), fast


@pytest.mark.parametrize('spun', [0.0, 4.0])
def test_slip_of_a_coarse_speed_is_seen_by_the_smoothers_own_track(spun):
    made = drive(**SPEED)
    leg, at = whole_kmh(made.leg(), spun)
    result = calibrate(leg, settings(made, None, method='auto'))
    said = [r.text for r in result.reasons if r.code is Code.WHEEL_SLIP]
    assert len(said) == (spun > 0)
    if spun:
        assert float(said[0].split('t = ')[1].split(' s')[0]) == pytest.approx(at + 1.0, abs=1.5)
    assert Code.SPEED_COARSE in everything_said(result)
