# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An IMU that is moved in the vehicle during the leg."""

from dataclasses import replace

from drives import changed, drive, everything_said, rejecting, settings
import numpy as np
import pytest

from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.screening.facing import accelerations
from odocal_ros.screening.moved_imu import turned_about, turned_over
from odocal_ros.screening.screen import screen

pytestmark = pytest.mark.slow
DEG = np.pi / 180
TOWN = {'scenario': 'town', 'duration': 400.0, 'imu_grade': 'consumer', 'seed': 3}


def moved(made, rpy_deg, share=0.5):
    """Return the leg with the IMU turned from a share of its rows on."""
    C = matrix_from_rpy(np.multiply(rpy_deg, DEG))
    begin = int(share * len(made.imu.stamp_ns))

    def turn(x):
        return np.concatenate([x[:begin], x[begin:] @ C.T])
    return replace(made.leg(), imu=changed(made.imu, w_i=turn, f_i=turn))


@pytest.mark.parametrize('share', [0.3, 0.45, 0.7])
@pytest.mark.parametrize(('rpy_deg', 'text'), [
    ((180, 0, 0), 'gravity turns by 180 deg'), ((0, -90, 0), 'gravity turns by 90 deg'),
    ((0, 0, 90), 'the forward direction turns by +90 ± '),
    ((0, 0, -100), 'the forward direction turns by -100 ± ')])
def test_a_moved_imu_rejects_the_leg_with_the_time(rpy_deg, text, share):
    made = drive(**TOWN)
    leg = moved(made, rpy_deg, share)
    result = calibrate(leg, settings(made))
    assert rejecting(result) == {Code.IMU_AXES}
    said = everything_said(result)[Code.IMU_AXES]
    begin, end = (float(x) for x in said.split('t = ')[1].split(' s:')[0].split(' to '))
    at = (leg.imu.stamp_ns[int(share * len(leg.imu.stamp_ns))] - leg.start_ns) * 1e-9
    angle = float(said.split('turns by ')[1].split()[0])
    assert abs(angle - float(text.split('turns by ')[1].split()[0])) < 10.0
    assert said.startswith(text.split(' by ')[0])
    tenth = (leg.stop_ns - leg.start_ns) * 1e-10
    assert begin - tenth < at < end + tenth


@pytest.mark.parametrize('options', [
    {}, {'slope': 0.08}, {'scenario': 'yard', 'seed': 4}, {'scenario': 'straight'},
    {'yaw': 170.0 * DEG}])
def test_slopes_and_turns_move_no_imu(options):
    made = drive(**TOWN | options)
    inputs, _ = screen(made.leg(), settings(made))
    assert turned_over(inputs) == ()
    assert turned_about(accelerations(inputs, made.options.nominal_scale)) == ()


def test_a_bend_of_one_g_moves_no_imu():
    made = drive(**TOWN)
    inputs, _ = screen(made.leg(), settings(made))
    force = inputs.f_b.copy()
    force[len(force) // 2:] += [0.0, 11.0, 0.0]
    assert turned_over(replace(inputs, f_b=force)) == ()
