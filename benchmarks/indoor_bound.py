# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Rows of benchmarks/indoor.py beside their forecast: error over forecast sigma, and both sigmas.

    python benchmarks/indoor_bound.py [--file /tmp/indoor.jsonl]

The forecast (odocal_ros/forecast/planned_indoor.py) has the true motion, wheels and noise of each
run: it is the Cramer-Rao bound of the estimator's model. Printed by kind for each value: runs, the
rms of error over forecast, the median of stated and of forecast sigma.
"""

from pathlib import Path

from harness import parsed, read_rows
import indoor
import numpy as np

PPM, DEG = 1e6, 180 / np.pi
VALUES = {'scale': 'scale_factor', 'width': 'track_width', 'lever': 'rotation_lever',
          'arc': 'track_width_arc', 'lateral': 'lateral_scale_factor',
          'yaw': 'yaw_mounting_angle'}


def forecast(seed):
    """Return the forecast sigma of each value of a run, relative or rad, None: not determined."""
    from drives import robot_motion

    from odocal_ros.forecast.planned_indoor import predict_robot
    from odocal_ros.library.plan_indoor import ratio_sigma, robot_of
    from odocal_ros.settings.config import Config, with_settings
    from odocal_ros.sim.options import resolve
    options = resolve(indoor.options_of(seed))
    config = with_settings(Config(), {'imu.grade': options.imu_grade})
    found = predict_robot(robot_motion(options), robot_of(options), config)
    sigma = {key: None if (one := found.estimates.get(name)) is None or one.value is None
             else one.sigma / (one.value if one.unit != 'rad' else 1.0)
             for key, name in VALUES.items()}
    return sigma | {'ratio': ratio_sigma(found), 'width': sigma['width'] or sigma['lever']}


def main():
    """Print the table."""
    args = parsed(__doc__, file=Path('/tmp/indoor.jsonl'))
    rows = list(read_rows(args.file).values())
    bounds = {row['seed']: forecast(row['seed']) for row in rows}
    for kind in indoor.KINDS:
        print(kind)
        for key, unit, size in (('scale', 'ppm', PPM), ('ratio', 'ppm', PPM),
                                ('width', 'ppm', PPM), ('arc', 'ppm', PPM),
                                ('lateral', 'ppm', PPM), ('yaw', 'mdeg', 1e3 * DEG)):
            both = [(row[f'{key}_error'], row[f'{key}_sigma'], bounds[row['seed']][key])
                    for row in rows if row['kind'] == kind and row['verdict'] != 'rejected'
                    and f'{key}_sigma' in row and bounds[row['seed']].get(key)]
            if both:
                error, sigma, bound = np.array(both).T
                rms = float(np.sqrt(np.mean((error / bound)**2)))
                print(f'    {key:8} {len(both):3}  error / forecast rms {rms:5.2f}  stated '
                      f'{size * np.median(sigma):6.0f}  forecast {size * np.median(bound):6.0f} '
                      f'{unit}  stated / forecast {np.median(sigma / bound):5.2f}')


if __name__ == '__main__':
    main()
