# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Small robots indoors, without GNSS: does the sigma hold for each kind of position reference.

    python benchmarks/indoor.py [--drives 40] [--only KIND] [--jobs 1] [--file F]

Differential robots with two counters on a level floor, 30 s to 3 min at 0.2 to 1.2 m/s with turns
on the spot (odocal_ros/sim/routes.py), references with their usual errors (sim/options.py).
IMUs are those of the zoo (docs/zoo.md) with their effects, by turns consumer and industrial; each
wheel has a random slip of 1 mm/sqrt(s). Settings are the defaults, except for the grade of the
IMU and the nominal scale. Drive k of kind e has seed 193_000_000 + 1_000_000 e + k, fixed before
the first run; the estimator was developed with other seeds. Rows go to the file line by line: an
interrupted run continues where it stopped.

Printed by kind for the scale of the mean (wheel radius), the ratio of right to left, the track
width, yaw and pitch of the IMU: in how many drives that are not rejected it is given, the share
within 1.96 sigma, the rms and the largest of error over sigma, the largest of accepted drives, and
the median sigma; verdicts; in how many drives each reason was given.

Kinds ROBOT_REFERENCE have no IMU: ``wheels`` is the differential robot, ``skid`` slides in turns
on four wheels, and ``mecanum`` (four wheels) and ``omni`` (three or four) move sideways
(sim/wheels.py). Their values: width is that on the spot (of the last two the rotation lever), arc
at a radius of two widths. Kinds fused_REFERENCE are the robots with an IMU, and a reference that
contains their wheels with a scale error of 2 to 5 %, corrected within 5 to 20 s:
FIXES_FOLLOW_ODOMETER is true there, and false in all others.
"""

from collections import Counter
import math
import os

os.environ.setdefault('OMP_NUM_THREADS', '1')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

from harness import configured, run_by_name
from zoo_table import print_errors

FIRST_SEED, SEEDS_A_KIND = 193_000_000, 1_000_000
REFERENCES = ('mocap', 'total_station', 'slam', 'amcl')
# planar estimator: what SimOptions has of each, without an IMU
PLANAR = {'wheels': {}, 'skid': {'drive': 'skid', 'wheels': 4}, 'mecanum': {'drive': 'mecanum'},
          'omni': {'drive': 'omni'}}
SHORTEST = {'wheels': 30.0, 'skid': 30.0, 'mecanum': 70.0, 'omni': 70.0}     # s
# two wheels and an IMU; the reference is fused with the uncalibrated wheels
FUSED = ('fused_slam', 'fused_amcl')
KINDS = (*REFERENCES, *(f'{robot}_{reference}' for robot in PLANAR
                        for reference in REFERENCES), *FUSED)
GRADES = ('consumer', 'industrial')
IMU_EFFECTS = ('triads', 'g_sensitivity', 'bias', 'temperature', 'vibration', 'imu_stamps')
SLIP = 1e-3     # m/sqrt(s) of each wheel
FIGURES = (('scale', 'ppm', 1e6), ('ratio', 'ppm', 1e6), ('width', 'ppm', 1e6),
           ('arc', 'ppm', 1e6), ('lateral', 'ppm', 1e6),
           ('yaw', 'mdeg', 1e3 * 180 / math.pi), ('pitch', 'mdeg', 1e3 * 180 / math.pi))


def options_of(seed):
    """Return the SimOptions of a drive."""
    from odocal_ros.sim.draw import draw_vehicle
    from odocal_ros.sim.noise import make_rng
    e, k = divmod(seed - FIRST_SEED, SEEDS_A_KIND)
    rng = make_rng(seed, 'robot')
    options = {'duration': round(float(rng.uniform(30, 180)), 1),
           'track_width': float(rng.uniform(0.15, 0.6)),
           'wheel_difference': float(rng.normal(0, 0.01)),
           'imu_lever_arm': tuple(map(float, rng.normal(0, 0.05, 3))),
           'scale': 8.9e-5 * (1 + 0.03 * float(rng.standard_normal()))}
    robot, _, reference = KINDS[e].partition('_') if e >= len(REFERENCES) else ('', '', KINDS[e])
    if robot == 'fused':
        side = 1 if k % 4 < 2 else -1       # of both grades
        options['real'] = {'receiver_odometer': side * float(rng.uniform(0.02, 0.05)),
                       'receiver_odometer_time': float(rng.uniform(5.0, 20.0))}
    elif robot == 'omni':
        options['wheels'] = 3 + k % 2
    if robot in PLANAR:       # the first sideways move of a robot ends within a minute
        options |= PLANAR[robot] | {
            'imu': False, 'duration': max(options['duration'], SHORTEST[robot])}
    return draw_vehicle(seed, 'indoor', GRADES[k % 2], IMU_EFFECTS, **options,
                        nominal_scale=8.9e-5, slope=0.0, odometer_lever_arm=(0.0, 0.0, 0.0),
                        antenna_lever_arm=(0.0, 0.0, 0.0), slip_walk=SLIP, reference=reference,
                        **dict.fromkeys(('fix_rate', 'fix_noise', 'fix_sigma')))[0]


def run_drive(seed):
    """Draw, drive, calibrate; return a row."""
    from odocal_ros.pipeline.calibrate import calibrate, combine
    from odocal_ros.settings.config import with_settings
    from odocal_ros.sim.scenarios import simulate
    from odocal_ros.sim.wheels import effective_width, LATERAL_RATIO
    drive = simulate(options_of(seed))
    config = with_settings(configured(drive), {'odometer.track_width': 0.0})
    calibration = combine([calibrate(drive.leg(), config)], config)
    row = {'seed': seed, 'kind': KINDS[(seed - FIRST_SEED) // SEEDS_A_KIND],
           'grade': drive.options.imu_grade, 'duration': drive.options.duration,
           'distance': drive.truth.distance,
           'verdict': calibration.verdict.value,
           'codes': sorted({r.code.name for r in calibration.reasons})}
    truth, found = drive.truth, calibration.estimates
    width = effective_width(drive.options)
    arc = effective_width(drive.options, 2 * width)
    lateral = LATERAL_RATIO * truth.scale
    for key, name, true, size in (
            ('scale', 'scale_factor', truth.scale, truth.scale),
            ('width', 'track_width', width, width),
            ('width', 'rotation_lever', width / 2, width / 2),
            ('arc', 'track_width_arc', arc, arc),
            ('lateral', 'lateral_scale_factor', lateral, lateral),
            ('yaw', 'yaw_mounting_angle', truth.yaw, 1.0),
            ('pitch', 'pitch_mounting_angle', truth.pitch, 1.0)):
        if name in found and found[name].value is not None:
            row |= {f'{key}_error': (found[name].value - true) / size,
                    f'{key}_sigma': found[name].sigma / size}
    left, right = (found.get(f'scale_factor_{side}') for side in ('left', 'right'))
    if left is not None and left.value is not None and len(truth.wheel_scales) == 2:
        true = truth.wheel_scales[1] / truth.wheel_scales[0]
        row |= {'ratio_error': right.value / left.value / true - 1,
                'ratio_sigma': _ratio_sigma(calibration.legs[0].methods, left, right)}
    return row


def _ratio_sigma(methods, left, right):
    """Return the sigma of right over left."""
    if 'smoother' in methods:
        return 2 * methods['smoother'].details['wheels']['left']['ratio_sigma']
    a, b = left.sigma / left.value, right.sigma / right.value
    rho = methods['planar'].details['correlation']['scale_factor_left,scale_factor_right']
    return (a**2 + b**2 - 2 * rho * a * b)**0.5


def table(rows):
    """Print by kind how far values are off, and what is said."""
    for kind in KINDS:
        of_kind = [row for row in rows if row['kind'] == kind]
        if not of_kind:
            continue
        print(f'{kind}: {len(of_kind)} drives, {dict(Counter(row["verdict"] for row in of_kind))}')
        for key, unit, size in FIGURES:
            print_errors(key, unit, size, of_kind)
        print(f'    {dict(Counter(code for row in of_kind for code in row["codes"]))}')


def main():
    """Run what the file does not hold yet, print the table."""
    run_by_name(__doc__, run_drive, KINDS, (FIRST_SEED, SEEDS_A_KIND), table,
                '/tmp/indoor.jsonl')


if __name__ == '__main__':
    main()
