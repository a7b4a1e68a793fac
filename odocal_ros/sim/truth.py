# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Truth of a simulated drive as in truth.yaml, and the settings that its operator would configure.

The settings have the nominal scale and measured lever arms, with their errors, not the true ones.
"""

from dataclasses import asdict
import math
from typing import Any

from odocal_ros.settings.config import DIFFERENTIAL, MECANUM, SIDES, SKID
from odocal_ros.sim.noise import make_rng
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.scenarios import Drive
from odocal_ros.sim.wheels import effective_width, LATERAL_RATIO, wheels_of

BEST_GRADE = 'navigation'   # in the settings of a perfect IMU


def truth_entries(drive: Drive, bag: str) -> dict[str, Any]:
    """Return the content of truth.yaml: true values, then the options of the drive."""
    truth, options = drive.truth, drive.options
    return {
        'bag': bag,
        'scenario': options.scenario,
        'seed': options.seed,
        **_topics(drive),
        'scale': {'value': truth.scale, 'ratio': truth.scale_ratio,
                  'unit': drive.form.scale_unit, 'nominal': options.nominal_scale,
                  'wheels': list(truth.wheel_scales)},
        **_wheels(drive),
        **_robot_entries(options),
        'yaw_mounting_deg': {'value': math.degrees(truth.yaw)},
        'pitch_mounting_deg': {'value': math.degrees(truth.pitch)},
        # above: sensor axes; below: housing. Both are equal if the axes are perpendicular
        'yaw_mounting_housing_deg': {'value': math.degrees(truth.yaw_housing)},
        'pitch_mounting_housing_deg': {'value': math.degrees(truth.pitch_housing)},
        'roll_mounting_deg': {'value': math.degrees(options.roll)},
        'nominal_rpy_deg': [math.degrees(a) for a in options.mounting_rpy],
        # direction of the body frame's x axis, clockwise from north, at the start mark
        'heading': {'rad': truth.heading, 'deg': math.degrees(truth.heading)},
        'distance': {'value': truth.distance, 'unit': 'm'},
        'marks': {'start_ns': truth.start_ns, 'stop_ns': truth.stop_ns},
        'lever_arms': {'imu': list(options.imu_lever_arm),
                       'antenna': list(options.antenna_lever_arm),
                       'odometer': list(options.odometer_lever_arm), 'unit': 'm, base_link'},
        'delays': {'odometer': options.odometer_delay, 'fix': options.fix_delay, 'unit': 's'},
        'gyro_bias': {'value': truth.gyro_bias.tolist(), 'unit': 'rad/s, imu frame, at turn-on'},
        'accel_bias': {'value': truth.accel_bias.tolist(),
                       'unit': 'm/s^2, imu frame, at turn-on'},
        'options': _tuples_to_lists(asdict(options)),
    }


def _topics(drive: Drive) -> dict[str, Any]:
    """Return the topics of the bag, by input."""
    odometer: Any = '/odometer'
    if drive.options.odometer == 'angle':
        odometer = '/joint_states'
    elif len(drive.wheels) > 1:
        odometer = {'left': '/odometer/left', 'right': '/odometer/right'}
    topics = {'imu_topic': '/imu/data'} if drive.options.imu else {}
    topics |= {'odometer_topic': odometer, 'fix_topic': drive.reference.topic}
    return topics | ({'heading_topic': '/heading'} if len(drive.heading.stamp_ns) else {})


def _wheels(drive: Drive) -> dict[str, Any]:
    """Return the truth of each wheel, if several: factor, position in base_link, steering."""
    wheels = wheels_of(drive.options)
    return {'wheels': {wheel.name: {'scale_factor': scale, 'position': wheel.arm.tolist(),
                                    'steered': wheel.steered}
                       for wheel, scale in zip(wheels, drive.truth.wheel_scales, strict=True)}
            } if len(wheels) > 1 else {}


def _robot_entries(options: SimOptions) -> dict[str, Any]:
    """Return track width and lateral scale of a skid-steer, mecanum or omni robot."""
    if options.drive == DIFFERENTIAL:
        return {}
    width = effective_width(options)
    entries = {'track_width': width}
    if options.drive == MECANUM:
        entries |= {'lateral_scale_factor': LATERAL_RATIO * options.scale}
    elif options.drive == SKID:
        entries |= {'track_width_arc': effective_width(options, radius=2 * width)}
    return {'robot': entries}


def _tuples_to_lists(value: Any) -> Any:
    """Return a value with lists in place of tuples, which YAML does not have."""
    if isinstance(value, dict):
        return {key: _tuples_to_lists(v) for key, v in value.items()}
    return [_tuples_to_lists(v) for v in value] if isinstance(value, tuple) else value


def _configured_arm(options: SimOptions, name: str) -> list[float]:
    """Return a lever arm as configured: the true one plus the measurement error."""
    true, error = getattr(options, f'{name}_lever_arm'), getattr(options.real, f'{name}_arm_error')
    return [float(x + e) for x, e in zip(true, error, strict=True)]


def operator_settings(drive: Drive, known_heading_sigma: float | None = None,
                      ) -> dict[str, dict[str, Any]]:
    """Return an operator's settings by group; a known heading has a random error, rad."""
    options = drive.options
    grade = options.real.configured_grade or options.imu_grade
    odometer: dict[str, Any] = {'nominal_scale': float(options.nominal_scale),
                                'lever_arm': _configured_arm(options, 'odometer')}
    if options.drive != DIFFERENTIAL:
        odometer['drive'] = options.drive
    if options.wheel_count > len(SIDES):
        odometer['wheels'] = list(drive.joints)
    elif options.wheel_count > 1:
        left, right = drive.joints if options.odometer == 'angle' else ('topic', 'topic')
        odometer |= {'left': left, 'right': right, 'track_width': float(options.track_width)}
    groups = {
        'odometer': odometer,
        'imu': {'grade': BEST_GRADE if grade == 'perfect' else grade,
                'mounting_rpy': [float(x) for x in options.mounting_rpy],
                'lever_arm': _configured_arm(options, 'imu')},
        'gnss': {'lever_arm': _configured_arm(options, 'antenna')},
    }
    if known_heading_sigma is not None:
        error = known_heading_sigma * make_rng(options.seed, 'known heading').standard_normal()
        groups['alignment'] = {'heading_source': 'fixed',
                               'heading': float(drive.truth.heading + error),
                               'heading_sigma': float(known_heading_sigma)}
    return groups


def topic_arguments(drive: Drive) -> list[str]:
    """Return command-line arguments of replay: the topics, if several have the same type."""
    arguments = []
    if len(drive.wheels) > 1 and drive.options.odometer == 'counts':
        arguments += ['--odometer-topic', '/odometer/left',
                      '--odometer-right-topic', '/odometer/right']
    if len(drive.heading.stamp_ns):
        arguments += ['--imu-topic', '/imu/data', '--heading-topic', '/heading']
    return arguments
