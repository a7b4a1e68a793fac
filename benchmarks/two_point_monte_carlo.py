# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Monte Carlo of the two-point method over whole simulated drives: whether stated sigmas hold.

    python benchmarks/two_point_monte_carlo.py [--drives 100] [--first-seed 1000] [--only TEXT]

Each case is driven N times, with new random route, sensors and fixes, at low sensor rates, with a
heading known to 1 mrad. Printed for scale, yaw and pitch: mean of error / sigma, its RMS, and the
share of drives within 1.96 sigmas. At N drives the mean varies by 1 / sqrt(N), the RMS by
1 / sqrt(2 N), the share by sqrt(0.0475 / N), 1 sigma. ``partly slow`` fixes are white but for a
seventh of their variance: the hardest to see. benchmarks/two_point_cells.py runs thousands of
drives over three routes with the motion computed once.
"""

from time import perf_counter

from harness import parsed
import numpy as np

from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim import sensors
from odocal_ros.sim.scenarios import SimOptions, simulate

HEADING_SIGMA = 1e-3
RATES = {'imu_rate': 50.0, 'odometer_rate': 20.0}
PARTLY_SLOW = 2.5       # white sigmas to a slow one
CASES = {
    'straight tactical white': {'scenario': 'straight', 'imu_grade': 'tactical'},
    'straight tactical correlated': {'scenario': 'straight', 'imu_grade': 'tactical',
                                     'fix_noise': 'correlated'},
    'straight tactical partly slow': {'scenario': 'straight', 'imu_grade': 'tactical',
                                      'fix_noise': 'correlated', 'fix_sigma': 0.5},
    'straight consumer rtk': {'scenario': 'straight', 'imu_grade': 'consumer',
                              'fix_noise': 'rtk'},
    'paper navigation white': {'scenario': 'paper', 'imu_grade': 'navigation'},
    'town industrial white': {'scenario': 'town', 'imu_grade': 'industrial'},
    'town industrial correlated': {'scenario': 'town', 'imu_grade': 'industrial',
                                   'fix_noise': 'correlated'},
}


def drive(options, seed):
    """Return errors over sigmas of scale, yaw and pitch, and the sigmas, of one drive."""
    made = simulate(SimOptions(seed=seed, **RATES, **options))
    heading = made.truth.heading + HEADING_SIGMA * np.random.default_rng(seed).standard_normal()
    config = with_settings(Config(), {
        'method': 'two_point',
        'odometer.nominal_scale': made.options.nominal_scale,
        'imu.grade': made.options.imu_grade, 'alignment.heading': float(heading),
        'alignment.heading_sigma': HEADING_SIGMA, 'verdict.max_yaw_sigma': 1.0})
    result = calibrate(made.leg(), config)
    if 'two_point' not in result.methods:
        return None
    e = result.methods['two_point'].estimates
    truth = {'scale_factor': made.truth.scale, 'yaw_mounting_angle': made.truth.yaw,
             'pitch_mounting_angle': made.truth.pitch}
    if any(e[name].value is None for name in truth):
        return None
    return [((e[name].value - true) / e[name].sigma,
             e[name].sigma / (true if name == 'scale_factor' else 1.0))
            for name, true in truth.items()]


def run(name, drives, first_seed):
    """Drive one case and print its lines."""
    begin, white = perf_counter(), sensors.WHITE_SHARE
    sensors.WHITE_SHARE = PARTLY_SLOW if 'partly' in name else white
    try:
        found = [drive(CASES[name], first_seed + k) for k in range(drives)]
    finally:
        sensors.WHITE_SHARE = white
    done = np.array([f for f in found if f is not None])
    print(f'{name}: {len(done)} of {drives} drives gave all three, '
          f'{perf_counter() - begin:.0f} s')
    if not len(done):
        return
    for i, (parameter, unit, scale) in enumerate((('scale', 'ppm', 1e6), ('yaw', 'mdeg', 1e3),
                                                  ('pitch', 'mdeg', 1e3))):
        z, sigma = done[:, i, 0], np.median(done[:, i, 1])
        sigma = sigma * scale if unit == 'ppm' else np.rad2deg(sigma) * scale
        print(f'    {parameter:5}  sigma {sigma:8.1f} {unit:4}  mean {z.mean():+.2f}  '
              f'rms {np.sqrt((z**2).mean()):.3f}  '
              f'within 95 %: {100 * (np.abs(z) < 1.96).mean():.1f} %')


def main():
    """Run the cases asked for."""
    args = parsed(__doc__, drives=100, first_seed=1000,
                  only=('', 'cases whose name holds this text'))
    for name in CASES:
        if args.only in name:
            run(name, args.drives, args.first_seed)


if __name__ == '__main__':
    main()
