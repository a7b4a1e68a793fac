# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal plan: print the predicted accuracy of a calibration before a drive, and improvements."""

import argparse
import math
from typing import Any

from odocal_ros.data.inputs import INPUTS, topic_option
from odocal_ros.errors import BadUsage
from odocal_ros.offline.cli import print_json, print_text
from odocal_ros.offline.replay import add_settings_arguments, settings_from_arguments

SLOTS = ('imu', 'odometer', 'fix', 'heading')
FIX_CORRELATION_TIMES = {'white': 0.0, 'correlated': 60.0}      # s


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add('--scenario', metavar='NAME', help='scenario of odocal simulate, such as town; '
        'a robot indoors: --indoor')
    add('--duration', type=float, metavar='S', help='duration of the scenario, s')
    add('--gpx', metavar='FILE', help='GPX track (requires --speed if it has no times)')
    add('--bag', metavar='BAG', help='recorded bag, with its own fix accuracy and rate')
    add('--distance', type=float, metavar='M', help='length of a drive, m, with --speed')
    add('--speed', type=float, metavar='M/S', help='speed of the drive')
    add('--standstill', type=float, metavar='S', help='standstill at start and end, s (default '
        '30)')
    add('--turns', type=int, metavar='N', help='number of 90 deg turns, alternating left and '
        'right (default 0)')
    add('--acceleration', type=float, metavar='M/S2', help='default 1')
    add('--imu-grade', metavar='GRADE', help='consumer, industrial, tactical or navigation')
    add('--heading-source', metavar='SOURCE', help='auto, gyrocompass, imu_orientation, '
        'heading_topic, course or fixed (default: fixed with --heading-sigma-deg, else auto)')
    add('--heading-sigma-deg', type=float, metavar='DEG', help='uncertainty of the heading')
    add('--fix-sigma', type=float, metavar='M', help='horizontal error of a fix, each axis '
        '(default 1.5)')
    add('--fix-noise', choices=tuple(FIX_CORRELATION_TIMES), help='fix errors: correlated (60 s, '
        'typical of receivers) or white (default correlated)')
    add('--fix-rate', type=float, metavar='HZ', help='fix rate, Hz (default 5)')
    add('--rtk', action='store_true', help='fixes of 0.02 m')
    add('--pulse', type=float, metavar='M', help='metres per pulse, for the quantisation '
        '(default 0; --bag: from the bag)')
    add('--sway', type=float, metavar='M/S', help='sideways and vertical velocity while driving, '
        '1 sigma, white at 10 Hz (default 0.05: ordinary road)')
    add('--slip-walk', type=float, metavar='M/SQRT(S)', help='wheel slip while driving (default '
        '0.01)')
    add('--indoor', nargs='?', const='all', metavar='RUN', help='run of a small robot on a level '
        'floor: straight, square, figure_eight or spot (default: all)')
    add('--reference', metavar='NAME', help='with --indoor: mocap, total_station, slam, amcl or '
        'marks (default slam)')
    add('--drive', metavar='NAME', help='with --indoor: differential (default), skid, mecanum '
        'or omni')
    add('--no-imu', action='store_true', help='with --indoor: a robot without an IMU')
    add('--size', type=float, metavar='M', help='with --indoor: length of a straight (default 4)')
    add('--rounds', type=int, metavar='N', help='with --indoor: number of repetitions (default 1)')
    add('--track-width', type=float, metavar='M', help='with --indoor: distance between left and '
        'right wheels (default 0.3)')
    add_settings_arguments(parser)
    for slot in SLOTS:
        add(topic_option(slot), metavar='TOPIC',
            help=f'with --bag: topic of the {INPUTS[slot].label}')
    add('--json', action='store_true', help='print JSON, nothing else')


def run(args: argparse.Namespace) -> int:
    if args.indoor:
        return _indoor(args)
    from odocal_ros.library.plan import plan
    from odocal_ros.offline.plan_text import screen
    drive = {name: getattr(args, name) for name in (
        'scenario', 'duration', 'gpx', 'bag', 'distance', 'speed', 'standstill', 'turns',
        'acceleration')}
    topics = {slot: topic for slot in SLOTS if (topic := getattr(args, f'{slot}_topic'))}
    planned = plan(**drive, topics=topics, config=_config(args), **_sigma_options(args))
    if args.json:
        print_json(planned.to_dict())
    else:
        print_text(screen(planned))
    return 0


def _indoor(args: argparse.Namespace) -> int:
    from odocal_ros.library.plan_indoor import plan_indoor
    from odocal_ros.offline.plan_text import indoor_screen
    runs = plan_indoor(args.indoor, imu=not args.no_imu, config=_config(args), **_without_none(
        reference=args.reference, drive=args.drive, size=args.size, rounds=args.rounds,
        speed=args.speed, track_width=args.track_width, slip=args.slip_walk))
    if args.json:
        print_json([run.to_dict() for run in runs])
    else:
        print_text(indoor_screen(runs))
    return 0


def _config(args: argparse.Namespace) -> dict[str, Any]:
    """Return the requested settings: --config < --set < the options of a plan."""
    settings = settings_from_arguments(args)
    if args.imu_grade:
        settings['imu.grade'] = args.imu_grade
    if args.heading_sigma_deg is not None:
        if not (math.isfinite(args.heading_sigma_deg) and 0 < args.heading_sigma_deg <= 180):
            raise BadUsage(f'--heading-sigma-deg {args.heading_sigma_deg:g}: required: more than '
                           '0, up to 180')
        settings['alignment.heading_sigma'] = math.radians(args.heading_sigma_deg)
        settings.setdefault('alignment.heading_source', 'fixed')
    if args.heading_source:
        settings['alignment.heading_source'] = args.heading_source
    if args.fix_noise:
        settings['gnss.correlation_time'] = FIX_CORRELATION_TIMES[args.fix_noise]
    return settings


def _sigma_options(args: argparse.Namespace) -> dict[str, Any]:
    """Return the requested fields of ``forecast.predict.Sigmas``."""
    from odocal_ros.library.plan import RTK_SIGMA
    if args.rtk and args.fix_sigma is not None:
        raise BadUsage('--rtk and --fix-sigma exclude each other')
    return _without_none(fix=RTK_SIGMA if args.rtk else args.fix_sigma, fix_rate=args.fix_rate,
                         quantum=args.pulse, sway=args.sway, slip=args.slip_walk)


def _without_none(**options: Any) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}
