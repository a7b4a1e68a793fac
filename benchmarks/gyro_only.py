# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Monte Carlo of legs whose IMU has no accelerometer: does the stated sigma of the scale hold.

    python benchmarks/gyro_only.py [--drives 30]

Drives of ten minutes through a town, fixes of 1.5 m, consumer gyro: with one counter and with two
wheels, on flat ground and on hills of 4.5 % (a sine; 3.2 % rms), with three gyros and with a yaw
rate alone. Printed: error of the scale, its stated sigma, error / sigma, all rms over the drives.
"""

from dataclasses import replace

from harness import parsed
import numpy as np

from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

CELLS = {'one counter, flat': {}, 'two wheels, flat': {'two_wheels': True},
         'one counter, hills': {'slope': 0.045},
         'one counter, hills, yaw rate alone': {'slope': 0.045, 'planar': True}}


def drive(seed, planar=False, **options):
    """Return relative error and sigma of the scales of a drive: those of the mean, left, right."""
    made = simulate(SimOptions(scenario='town', seed=seed, imu_rate=50.0, odometer_rate=20.0,
                               **options))
    leg = made.leg()
    w_i = leg.imu.w_i * ([0.0, 0.0, 1.0] if planar else 1.0)
    leg = replace(leg, imu=replace(leg.imu, w_i=w_i, f_i=np.zeros_like(leg.imu.f_i)))
    config = with_settings(Config(), {'odometer.nominal_scale': made.options.nominal_scale})
    found = combine([calibrate(leg, config)], config).estimates
    true = {'scale_factor': made.truth.scale} | dict(zip(
        ('scale_factor_left', 'scale_factor_right'), made.truth.wheel_scales, strict=False))
    return [(e.value / true[name] - 1, e.sigma / true[name]) for name, e in found.items()
            if name in true and e.value is not None]


def main():
    """Print the table."""
    args = parsed(__doc__, drives=30)
    print(f'{args.drives} drives each{"":22}error, ppm  sigma, ppm  error/sigma')
    for name, options in CELLS.items():
        rows = np.array([drive(seed, **options) for seed in range(1, args.drives + 1)])
        for k in range(rows.shape[1]):
            error, sigma = rows[:, k].T
            side = ('', ', left', ', right')[k]
            print(f'{name + side:38}{_rms(error) * 1e6:8.0f}{_rms(sigma) * 1e6:12.0f}'
                  f'{_rms(error / sigma):13.2f}', flush=True)


def _rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


if __name__ == '__main__':
    main()
