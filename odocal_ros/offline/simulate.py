# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
odocal simulate: write a bag of a simulated drive, with its truth and its settings as files.

The options are fields of ``sim.options.SimOptions``; --fleet writes the bags of many vehicles.
"""

import argparse
from dataclasses import fields
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

from odocal_ros.errors import BadUsage
from odocal_ros.offline.cli import print_text, show_phase
from odocal_ros.safe_io.text_formats import for_shell
from odocal_ros.settings.levels import DAY_NS

if TYPE_CHECKING:
    from odocal_ros.sim.options import SimOptions

# options that are fields of SimOptions: metavar and help; angles, in degrees, have only the help
NUMBER_OPTIONS = {
    'duration': ('S', "seconds of the whole drive (default: the scenario's)"),
    'imu_rate': ('HZ', 'rate of /imu/data (default 100)'),
    'odometer_rate': ('HZ', 'rate of the odometer (default 50)'),
    'fix_rate': ('HZ', 'rate of the fixes or other positions (default 5)'),
    'heading_rate': ('HZ', 'rate of /heading (default 10)'),
    'gyro_scale_error': ('X', 'gyro scale error, relative (default 0)'),
    'accel_scale_error': ('X', 'accelerometer scale error, relative (default 0)'),
    'scale': ('K', 'true scale factor, m/pulse, m/rad or 1'),
    'nominal_scale': ('K0', 'scale factor as configured'),
    'speed_noise': ('M/S', 'white noise of --odometer speed'),
    'odometer_delay': ('S', 'delay of odometer stamps, s'),
    'wheel_difference': ('X', 'right scale divided by left scale, minus 1 (default 0.004); with '
                         'more than 2 wheels: 1 sigma of each scale'),
    'track_width': ('M', 'distance between left and right wheels (default 1.6; indoor 0.3)'),
    'wheelbase': ('M', 'distance from the odometer point to the front wheels (default 2.7)'),
    'slip_events': ('N', 'wheel spins per hour of motion'),
    'slip_size': ('M', 'metres lost in each spin (default 0.1)'),
    'start_slip': ('SHARE', 'wheel spin after each start, as a fraction of travel'),
    'start_slip_time': ('S', 'duration of this spin, s (default 5)'),
    'sway': ('M/S', 'sideways and vertical velocity while moving, 1 sigma, white at 10 Hz'),
    'fix_sigma': ('M', 'horizontal error of fixes, 1 sigma; up: twice (default 1.5, rtk 0.02, '
                  'mocap 0.001, total_station 0.002, slam 0.02, amcl 0.01)'),
    'fix_correlation_time': ('S', 'correlation time of --fix-noise correlated (default 60)'),
    'reference_drift': ('X', 'drift of the reference, m per square root of a metre (slam '
                        '0.01, amcl 0.05)'),
    'drift_length': ('M', 'correlation length of this drift (amcl 2; 0: it accumulates)'),
    'closure_time': ('S', 'mean time between loop closures of the reference (slam 30; 0: none)'),
    'fix_delay': ('S', 'delay of fix stamps, s'),
    'outliers': ('SHARE', 'fraction of outliers among the fixes, 0 to 0.5'),
    'outlier_size': ('M', 'size of outliers (default 20)'),
    'pressure_sigma': ('M', 'publish the air pressure on /pressure; 1 sigma of its heights'),
    'velocity_sigma': ('M/S', 'publish the GNSS velocity on /fix_velocity; 1 sigma per axis'),
    'velocity_rate': ('HZ', 'rate of /fix_velocity (default 10)'),
    'velocity_correlation_time': ('S', 'correlation time of its errors (default 0: white)'),
    'velocity_delay': ('S', 'delay of its stamps, s'),
    'velocity_lag': ('S', 'time constant of its low-pass filter'),
    'velocity_scale_error': ('X', 'relative scale error; positive: too large (default 0)'),
    'velocity_outliers': ('SHARE', 'fraction of outliers in it, 0 to 0.5'),
    'height': ('M', 'ellipsoidal height at the start (default 50)'),
}
ANGLE_OPTIONS = {
    'yaw': 'yaw mounting angle (default 1)',
    'pitch': 'pitch mounting angle (default 0.4; paper 0)',
    'roll': 'roll mounting angle (default 0)',
    'heading': 'heading of the vehicle at the start, clockwise from north (default 45)',
    'slope': 'steepest slope of the road (default 0: level)',
    'latitude': 'latitude of the start (default 40)',
    'longitude': 'longitude of the start (default 116)',
    'orientation_sigma': 'publish the IMU orientation with a constant heading error, 1 sigma',
    'heading_sigma': 'publish the topic /heading with a constant error, 1 sigma',
}
LEVER_ARMS = ('imu_lever_arm', 'antenna_lever_arm', 'odometer_lever_arm')


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options; the simulator checks their values."""
    add = parser.add_argument
    add('--scenario', required=True, metavar='NAME',
        help='paper, straight, out_and_back, town, motorway, oval, yard, indoor or square')
    add('--out', required=True, metavar='BAG', help='bag to write; truth.yaml and '
        'calibrator.yaml are written next to it')
    add('--seed', type=int, metavar='N', help='seed of all random numbers (default 1); each seed '
        'gives another date')
    add('--imu-grade', metavar='GRADE',
        help='consumer, industrial, tactical, navigation or perfect')
    add('--odometer', metavar='KIND', help='counts (Int64, default), speed (TwistStamped) or '
        'angle (JointState)')
    add('--two-wheels', action='store_true', default=None, help='left and right odometer')
    add('--wheels', type=int, metavar='N', help='number of wheels, 1 to 8 (default 1; indoor '
        '2); more than 2 are joints of one JointState')
    add('--drive', metavar='KIND', help='drive of a robot (indoor, square): differential '
        '(default), skid, mecanum (4 wheels) or omni (3 or more), with sideways moves')
    add('--no-imu', action='store_const', const=False, dest='imu', help='a robot without an IMU')
    add('--front-fixed', action='store_const', const=False, dest='front_steers',
        help='with more than 2 wheels: the front wheels do not steer')
    add('--reference', metavar='KIND', help='fix (NavSatFix on /fix, default), or positions in a '
        'local frame with the usual errors of their kind: mocap, total_station, slam (indoor, '
        'square: default) or amcl; pose: PoseStamped with the errors of fixes')
    add('--fix-noise', metavar='KIND', help='white (default), correlated or rtk')
    add('--slip', type=float, metavar='M', dest='slip_walk',
        help='random slip while moving, m per square root of a second')
    add('--outage', type=_span, action='append', metavar='A:B', dest='outages',
        help='no fixes from A to B seconds; repeatable')
    for name, (metavar, text) in NUMBER_OPTIONS.items():
        add(_flag(name), type=float, metavar=metavar, help=text)
    for name, text in ANGLE_OPTIONS.items():
        add(_flag(name) + '-deg', type=degrees, metavar='DEG', dest=name, help=text)
    for name in LEVER_ARMS:
        add(_flag(name), type=float, nargs=3, metavar=('X', 'Y', 'Z'),
            help='m forward, left, up of the rear axle')
    add('--mounting-rpy-deg', type=degrees, nargs=3, metavar=('R', 'P', 'Y'),
        dest='mounting_rpy', help='nominal rotation from the IMU frame to forward-left-up')
    add('--vehicle', choices=('real', 'clean'), help='random vehicle by seed and IMU grade: real '
        'has all sensor effects (docs/zoo.md), clean has none')
    add('--effect', action='append', metavar='NAME', dest='effects',
        help='random vehicle with only this effect; repeatable')
    add('--real', action='append', default=[], metavar='NAME=VALUE', dest='sensor_parameters',
        help='one parameter of a real sensor, SI and radians; repeatable')
    add('--known-heading-sigma-deg', type=float, metavar='DEG',
        help='set the start heading, with an error of this sigma, in calibrator.yaml')
    add('--storage', default='mcap', metavar='KIND', help='mcap (default), sqlite3 or rosbag1')
    add('--compression', default='none', metavar='KIND',
        help='none (default), message, file or storage (mcap chunks)')
    add('--fleet', type=int, metavar='N', help='simulate this number of vehicles of three '
        'models, with changed tyres, moved IMUs and broken counters; --out is their folder')
    add('--bags', type=int, default=10, metavar='N', help='bags per vehicle of --fleet, one per '
        'week (default 10)')
    add('--force', action='store_true', help='replace the bag and the files written with it')
    add('--quiet', action='store_true', help='print only errors')


def _flag(name: str) -> str:
    return '--' + name.replace('_', '-')


def degrees(text: str) -> float:
    """Return degrees in rad; errors of argparse contain the name of this function."""
    return math.radians(float(text))


def _span(text: str) -> tuple[float, float]:
    begin, _, end = text.partition(':')
    try:
        return float(begin), float(end)
    except ValueError:
        raise argparse.ArgumentTypeError(f'{text}: required: A:B, two numbers of '
                                         'seconds') from None


def options_of(args: argparse.Namespace) -> 'SimOptions':
    """Return the drive's options: the arguments with the name of a field of SimOptions."""
    from odocal_ros.sim.options import SimOptions
    options: dict[str, Any] = {
        field.name: tuple(value) if isinstance(value, list) else value
        for field in fields(SimOptions)
        if (value := getattr(args, field.name, None)) is not None}
    # each seed has its own date, so that drives do not overlap in time
    seed = options.get('seed', SimOptions.seed)
    days = 3650    # then the days of the seeds repeat
    options['start_ns'] = SimOptions.start_ns + (seed - 1) % days * DAY_NS
    return _with_random_vehicle(args, options)


def _with_random_vehicle(args: argparse.Namespace, options: dict[str, Any]) -> 'SimOptions':
    """Return the drive's options with --vehicle, --effect and --real."""
    from odocal_ros.sim.draw import draw_vehicle
    from odocal_ros.sim.options import DEFAULTS, SimOptions
    from odocal_ros.sim.real_effects import parse_parameter, RealEffects
    sensor_parameters = dict(parse_parameter(text) for text in args.sensor_parameters)
    if not (args.vehicle or args.effects):
        return SimOptions(**options, real=RealEffects(**sensor_parameters))
    if 'odometer' in options:
        raise BadUsage(f'--odometer {options["odometer"]}: a random vehicle has its own odometer; '
                       'omit this option, or use --effect coarse_speed')
    if args.vehicle == 'clean' and args.effects:
        raise BadUsage('--vehicle clean excludes --effect; omit one of them')
    effects = () if args.vehicle == 'clean' else args.effects
    seed = options.pop('seed', SimOptions.seed)
    grade = options.pop('imu_grade', DEFAULTS.get(args.scenario, {}).get('imu_grade', 'consumer'))
    scenario = options.pop('scenario')
    return draw_vehicle(seed, scenario, grade, effects, **options, real=sensor_parameters)[0]


def run(args: argparse.Namespace) -> int:
    """Write a simulated bag, its truth and its settings, or those of a fleet; return 0."""
    if args.fleet is not None:
        return _run_fleet(args)
    heading_sigma_deg = args.known_heading_sigma_deg
    if heading_sigma_deg is not None and not 0 <= heading_sigma_deg <= 180:
        raise BadUsage(f'--known-heading-sigma-deg {heading_sigma_deg:g}: required: 0 to 180')
    from odocal_ros.bagio.write import drive_topics
    from odocal_ros.library.simulate import simulate, truth_paths
    from odocal_ros.sim.truth import topic_arguments
    out = Path(args.out)
    truth, settings = truth_paths(out)
    with show_phase('writing', args.quiet) as progress:
        drive = simulate(options_of(args), out, storage=args.storage,
                         compression=args.compression, force=args.force,
                         heading_sigma=None if heading_sigma_deg is None
                         else math.radians(heading_sigma_deg), progress=progress)
    if not args.quiet:
        replay = ['odocal', 'replay', str(out), '--config', str(settings), *topic_arguments(drive)]
        print_text(f'{out}: {drive.motion.duration:g} s, {drive.truth.distance:.1f} m, '
                   f'{sum(len(topic.time_ns) for topic in drive_topics(drive))} messages; '
                   f'truth in {truth}; to calibrate from it: {for_shell(replay)}')
    return 0


def _run_fleet(args: argparse.Namespace) -> int:
    from odocal_ros.library.simulate import simulate_fleet
    out = Path(args.out)
    with show_phase('simulating', args.quiet) as progress:
        manifest = simulate_fleet(
            out, options_of(args), args.fleet, args.bags, storage=args.storage,
            compression=args.compression, force=args.force, progress=progress)
    if not args.quiet:
        print_text(f'{out}: {args.fleet} vehicles, {args.fleet * args.bags} bags; truth in '
                   f'{out}/truth.yaml; to calibrate: odocal fleet {manifest} --output result')
    return 0
