# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Hold the covariance of the node ``odometry`` against the spread of simulated drives.

    python benchmarks/odometry_spread.py [--drives 50] [--scenario town] [--minutes 10]

Each drive has its own route, gyro, accelerometer and road; the applied calibration has errors
according to its sigmas. Output: error over sigma of the last pose, rms over the drives (1: correct
sigma), and the size of both. The pure core runs with the same input as in the node.
"""

import math

from harness import parsed
import numpy as np

from odocal_ros.apply.odometry import Odometry
from odocal_ros.apply.vehicle import vehicle_of
from odocal_ros.calib.result import Estimate
from odocal_ros.data.samples import take
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.rotations import matrix_from_quat
from odocal_ros.settings.config import with_settings
from odocal_ros.settings.node_configs import ApplyConfig
from odocal_ros.sim.motion import attitude
from odocal_ros.sim.scenarios import SimOptions, simulate

SCALE_SIGMA, YAW_SIGMA, PITCH_SIGMA = 3e-4, 2e-3, 2e-3     # relative, rad, rad
ROWS = ('along', 'across', 'up', 'tilt about along', 'tilt about across', 'heading')


def calibration(truth, rng):
    """Return estimates that err as their sigmas say."""
    true = {'scale_factor': (truth.scale, SCALE_SIGMA * truth.scale),
            'yaw_mounting_angle': (truth.yaw, YAW_SIGMA),
            'pitch_mounting_angle': (truth.pitch, PITCH_SIGMA)}
    return {name: Estimate(value + sigma * rng.standard_normal(), sigma, '')
            for name, (value, sigma) in true.items()}


def poses_of(drive, odometry, seconds=0.5):
    """Return all poses of a drive that comes in pieces."""
    out, begin = [], drive.options.start_ns
    slots = [slot for slot in ('imu', 'odometer', 'odometer_right')
             if len(getattr(drive, slot).stamp_ns)]
    for edge in np.arange(0.0, drive.motion.duration + seconds, seconds):
        for slot in slots:
            rows = getattr(drive, slot)
            a, b = np.searchsorted(rows.stamp_ns, begin + np.rint([edge * 1e9,
                                                                   (edge + seconds) * 1e9]))
            odometry.feed(slot, take(rows, slice(a, b)), drive.form)
        out += odometry.poses()
    return out


def error_of(drive, poses):
    """Return error and covariance of the last pose, ``ROWS``, against the truth in odom."""
    state = drive.motion.at(np.array([(p.stamp_ns - drive.options.start_ns) * 1e-9
                                      for p in (poses[0], poses[-1])]))
    origin = Origin(state.latitude[0], state.longitude[0], state.height[0])
    way_n = origin.to_n(np.array([state.latitude[1], state.longitude[1], state.height[1]]))
    c, s = math.cos(state.yaw[0]), math.sin(state.yaw[0])
    C_on = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    last = poses[-1]
    a = math.atan2(*(C_on @ way_n)[1::-1])       # along: from start to end
    turn = np.array([[math.cos(a), math.sin(a), 0], [-math.sin(a), math.cos(a), 0], [0, 0, 1.0]])
    off = matrix_from_quat(last.q) @ (C_on @ attitude(state)[1]).T
    off = np.array([off[2, 1] - off[1, 2], off[0, 2] - off[2, 0], off[1, 0] - off[0, 1]]) / 2
    J = np.zeros((6, 6))
    J[:3, :3] = J[3:, 3:] = turn
    error = np.concatenate([turn @ (last.position - poses[0].position - C_on @ way_n), turn @ off])
    return error, J @ last.pose_cov @ J.T


def main():
    """Print the table."""
    args = parsed(__doc__, drives=50, scenario='town', minutes=10.0, grade='consumer')
    errors, sigmas = [], []
    for seed in range(1, args.drives + 1):
        rng = np.random.default_rng(seed)
        drive = simulate(SimOptions(
            scenario=args.scenario, duration=60 * args.minutes, seed=seed, imu_rate=50.0,
            odometer_rate=25.0, imu_grade=args.grade, slope=0.03, slip_walk=0.005, sway=0.02,
            gyro_scale_error=float(_grade(args.grade).gyro_scale_sigma * rng.standard_normal())))
        config = with_settings(ApplyConfig(), {'imu.grade': args.grade, 'publish.rate': 2.0})
        odometry = Odometry(vehicle_of(calibration(drive.truth, rng), config), config)
        error, cov = error_of(drive, poses_of(drive, odometry))
        errors.append(error)
        sigmas.append(np.sqrt(np.diag(cov)))
    errors, sigmas = np.array(errors), np.array(sigmas)
    print(f'{args.drives} drives of {args.minutes:g} min, {args.scenario}, {args.grade} IMU')
    print(f'{"":18}{"error, rms":>12}{"sigma, rms":>12}{"error/sigma":>13}{"beyond 2":>10}')
    for k, name in enumerate(ROWS):
        ratio = errors[:, k] / sigmas[:, k]
        unit, factor = ('m', 1.0) if k < 3 else ('deg', 180 / np.pi)
        print(f'{name:18}{factor * _rms(errors[:, k]):9.3f} {unit:3}'
              f'{factor * _rms(sigmas[:, k]):8.3f} {unit:3}{_rms(ratio):13.2f}'
              f'{(np.abs(ratio) > 2).mean():10.0%}')


def _grade(name):
    from odocal_ros.settings.nominal import GRADES
    return GRADES[name]


def _rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


if __name__ == '__main__':
    main()
