# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""odocal plan: how good a calibration will be, before it is driven, and what would help."""

import argparse
import json
import math
from pathlib import Path
import sys
from typing import Any

from odocal_ros.errors import BadUsage
from odocal_ros.offline.say import say

SLOTS = ('imu', 'odometer', 'fix', 'heading')
NOISE = {'white': 0.0, 'correlated': 60.0}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add = parser.add_argument
    add('--scenario', metavar='NAME', help='drive of a scenario: paper, straight, out_and_back or '
        'town')
    add('--duration', type=float, metavar='S', help='seconds of the scenario')
    add('--gpx', metavar='FILE', help='drive of a GPX track (one without times at --speed)')
    add('--bag', metavar='BAG', help='drive of a recorded bag, with its own fix figures')
    add('--distance', type=float, metavar='M', help='drive of so many metres, with --speed')
    add('--speed', type=float, metavar='M/S', help='speed of the drive')
    add('--standstill', type=float, metavar='S', help='rest before the start and at the end '
        '(default 30)')
    add('--turns', type=int, metavar='N', help='turns of 90 deg on the way, left and right by '
        'turns (default 0)')
    add('--acceleration', type=float, default=1.0, metavar='M/S2', help='default 1')
    add('--imu-grade', metavar='GRADE', help='consumer, industrial, tactical or navigation')
    add('--heading-source', metavar='SOURCE', help='auto, gyrocompass, imu_orientation, '
        'heading_topic, course or fixed (default: fixed with --heading-sigma-deg, else auto)')
    add('--heading-sigma-deg', type=float, metavar='DEG', help='how well the heading is known')
    add('--fix-sigma', type=float, metavar='M', help='horizontal error of a fix, each axis '
        '(default 1.5)')
    add('--fix-noise', choices=tuple(NOISE), help='do fix errors stay alike for a minute or '
        'change from fix to fix (default correlated: what receivers do)')
    add('--fix-rate', type=float, metavar='HZ', help='fixes a second (default 5)')
    add('--rtk', action='store_true', help='fixes of 0.02 m')
    add('--pulse', type=float, metavar='M', help='metres a pulse, for the quantisation (default '
        '0; of --bag, its own)')
    add('--sway', type=float, metavar='M/S', help='velocity to the side and up while driving, 1 '
        'sigma, white at 10 Hz (default 0.05: an ordinary road)')
    add('--slip-walk', type=float, metavar='M/SQRT(S)', help='slip of the wheels while driving '
        '(default 0.01)')
    add('--config', metavar='FILE', help='ROS parameter file, as replay takes it')
    add('--set', action='append', default=[], metavar='KEY=VALUE', dest='settings',
        help='any setting by its parameter name; repeatable')
    for slot in SLOTS:
        add(f'--{slot}-topic', metavar='TOPIC', help=f'of --bag, topic of the {slot}')
    add('--json', action='store_true', help='print JSON, nothing else')


def run(args: argparse.Namespace) -> int:
    """Predict and print; return 0."""
    from odocal_ros.library.plan import plan
    from odocal_ros.offline.plan_text import screen
    drive = {name: getattr(args, name) for name in (
        'scenario', 'duration', 'gpx', 'bag', 'distance', 'speed', 'standstill', 'turns',
        'acceleration')}
    topics = {slot: topic for slot in SLOTS if (topic := getattr(args, f'{slot}_topic'))}
    planned = plan(**drive, topics=topics, config=_config(args), **_figures(args))
    if args.json:
        json.dump(planned.to_dict(), sys.stdout, indent=2, allow_nan=False)
        say('')
    else:
        say(screen(planned))
    return 0


def _config(args: argparse.Namespace) -> dict[str, Any]:
    """Return the settings asked for: --config < --set < the options named for a plan."""
    from odocal_ros.settings.config_file import parse_set, read_config_file
    from_file = read_config_file(Path(args.config)) if args.config else {}
    asked = dict(parse_set(text) for text in args.settings)
    if args.imu_grade:
        asked['imu.grade'] = args.imu_grade
    if args.heading_sigma_deg is not None:
        if not (math.isfinite(args.heading_sigma_deg) and 0 < args.heading_sigma_deg <= 180):
            raise BadUsage(f'--heading-sigma-deg {args.heading_sigma_deg:g}: want more than 0, '
                           'up to 180')
        asked['alignment.heading_sigma'] = math.radians(args.heading_sigma_deg)
        asked.setdefault('alignment.heading_source', 'fixed')
    if args.heading_source:
        asked['alignment.heading_source'] = args.heading_source
    if args.fix_noise:
        asked['gnss.correlation_time'] = NOISE[args.fix_noise]
    return from_file | asked


def _figures(args: argparse.Namespace) -> dict[str, Any]:
    """Return the error figures that are asked for."""
    from odocal_ros.library.what_helps import RTK
    if args.rtk and args.fix_sigma is not None:
        raise BadUsage('--rtk and --fix-sigma both give the error of a fix; give one')
    asked = {'fix': RTK if args.rtk else args.fix_sigma, 'fix_rate': args.fix_rate,
             'quantum': args.pulse, 'sway': args.sway, 'slip': args.slip_walk}
    return {name: value for name, value in asked.items() if value is not None}
