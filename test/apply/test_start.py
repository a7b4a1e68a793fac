# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The start of odometry, where the first rows have gaps or a wheel is late."""

from functools import cache

import pytest
from streams import odometry_of, poses_of, samples_of

from odocal_ros.data.samples import take
from odocal_ros.sim.scenarios import SimOptions, simulate

SECOND = 10**9


@cache
def drive():
    """Simulate a drive that begins with 20 s at rest."""
    return simulate(SimOptions(scenario='town', duration=135.0, imu_rate=50.0, odometer_rate=20.0,
                               imu_grade='industrial'))


@pytest.mark.core
@pytest.mark.parametrize('from_s', [1.0, 4.0, 6.0, 9.0])
def test_it_does_not_start_across_a_gap_of_the_imu(from_s):
    made = drive()
    blocks = samples_of(made)
    t = (blocks['imu'].stamp_ns - made.imu.stamp_ns[0]) / SECOND
    blocks['imu'] = take(blocks['imu'], (t < 5.0) | (t > 10.0))
    begins = blocks['odometer'].stamp_ns > made.imu.stamp_ns[0] + int(from_s * SECOND)
    blocks['odometer'] = take(blocks['odometer'], begins)
    odometry, end_ns = odometry_of(made), made.imu.stamp_ns[0] + 20 * SECOND
    poses = poses_of(odometry, {slot: take(block, block.stamp_ns < end_ns)
                                for slot, block in blocks.items()}, made.form)
    assert odometry.restarts == 0
    since = (poses[0].stamp_ns - made.imu.stamp_ns[0]) / SECOND
    # two seconds of rows without a gap
    assert since == pytest.approx(3.1 if from_s < 3.0 else 12.1, abs=0.15)
    assert all(pose.sound() for pose in poses)
