# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Drives fed to the odometry as the node feeds them, with the settings of a replay."""

import numpy as np

from odocal_ros.apply.odometry import Odometry
from odocal_ros.apply.vehicle import vehicle_of
from odocal_ros.calib.result import Estimate
from odocal_ros.data.samples import take
from odocal_ros.nav import rotations
from odocal_ros.nav.alignment import Alignment
from odocal_ros.settings.config import with_settings
from odocal_ros.settings.node_configs import ApplyConfig
from odocal_ros.sim.motion import attitude
from odocal_ros.sim.sensors import imu_rotation

SLOTS = ('imu', 'odometer', 'odometer_right')
PIECE_NS = 300_000_000       # as messages that arrive together


def poses_of(odometry, blocks, form, piece_ns=PIECE_NS):
    """Return all poses of samples that are fed in pieces."""
    blocks = {slot: block for slot, block in blocks.items() if len(block.stamp_ns)}
    first = min(int(block.stamp_ns[0]) for block in blocks.values())
    last = max(int(block.stamp_ns[-1]) for block in blocks.values())
    out = []
    for begin in range(first, last + 1, piece_ns):
        for slot, block in blocks.items():
            inside = (block.stamp_ns >= begin) & (block.stamp_ns < begin + piece_ns)
            odometry.feed(slot, take(block, inside), form)
        out += odometry.poses()
    return out


def samples_of(drive, begin_ns=0):
    """Return the samples of a drive by slot, from a time of the IMU on."""
    early = {'imu': begin_ns, 'odometer': begin_ns - 10**9, 'odometer_right': begin_ns - 10**9}
    return {slot: take(block, block.stamp_ns >= early[slot])
            for slot, block in ((slot, getattr(drive, slot)) for slot in SLOTS)}


def true_estimates(drive, sigma=1e-4):
    """Return the estimates of a calibration without errors."""
    truth = drive.truth
    values = {'scale_factor': truth.scale, 'yaw_mounting_angle': truth.yaw,
              'pitch_mounting_angle': truth.pitch}
    if len(truth.wheel_scales) == 2:
        values |= zip(('scale_factor_left', 'scale_factor_right'), truth.wheel_scales, strict=True)
    return {name: Estimate(value, sigma * (value if 'scale' in name else 1.0), '')
            for name, value in values.items()}


def odometry_of(drive, estimates=None, **changes):
    """Return the odometry for the vehicle of a drive; changes: settings as group__name."""
    config = with_settings(ApplyConfig(), {
        'imu.grade': drive.options.imu_grade, 'publish.rate': 10.0} | {
        name.replace('__', '.'): value for name, value in changes.items()})
    return Odometry(vehicle_of(estimates or true_estimates(drive), config), config)


def alignment_of(drive, row, tilt=(0.003, -0.002, 0.01), bias=(2e-5, -1e-5, 3e-5)):
    """Return an alignment at a row of the IMU, s since the start mark; not the true one."""
    stamp_ns = int(drive.imu.stamp_ns[row])
    state = drive.motion.at(np.array([(stamp_ns - drive.options.start_ns) * 1e-9]))
    q = rotations.quat_multiply(
        rotations.quat_from_rotvec(np.array(tilt)),
        rotations.quat_from_matrix(attitude(state)[0] @ imu_rotation(drive.options)))
    return Alignment(
        t=(stamp_ns - drive.truth.start_ns) * 1e-9, C_nb=rotations.matrix_from_quat(q),
        gyro_bias=np.array(bias), level_sigma=0.003, heading_sigma=0.002,
        gyro_bias_sigma=np.full(3, 1e-5), gyro_noise=1e-5, gyro_bias_walk=1e-8,
        heading_source='fixed', heading_shared=True)


def given(alignment, latitude):
    """Return the settings that begin odometry with an alignment, at a latitude in rad."""
    return {'start__attitude': tuple(alignment.q_nb.tolist()), 'levelling': False,
            'start__gyro_bias': tuple(alignment.gyro_bias.tolist()),
            'start__latitude': float(np.rad2deg(latitude))}
