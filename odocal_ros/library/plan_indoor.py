# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Predicted accuracy of runs of a small robot: patterns, references and drives."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from odocal_ros.calib.result import MethodResult
from odocal_ros.errors import BadUsage, unknown_name
from odocal_ros.forecast.planned_indoor import predict_robot, Robot
from odocal_ros.forecast.robot_motion import pattern_motion, PATTERNS, RobotMotion
from odocal_ros.library.arguments import config_of, Settings
from odocal_ros.settings.config import DRIVES, SIDES, SKID
from odocal_ros.sim.options import REFERENCES, SimOptions
from odocal_ros.sim.wheels import effective_width, STRAIGHT_RATIO

MARKS = 'marks'
REFERENCE_KINDS = ('mocap', 'total_station', 'slam', 'amcl', MARKS)
MARKS_LENGTH = 1.0     # m of path, judgement: correlation length of position errors at marks
SHOWN = {'scale_factor': 'scale', 'track_width': 'track width', 'rotation_lever':
         'rotation lever', 'track_width_arc': 'width on arcs', 'lateral_scale_factor': 'lateral',
         'yaw_mounting_angle': 'yaw'}


@dataclass(frozen=True, eq=False)
class PlannedRun:
    """The prediction of a run: its pattern and motion, the robot, the predicted result."""

    name: str
    motion: RobotMotion
    robot: Robot
    method: MethodResult

    def sigma(self, name: str) -> float | None:
        """Return the sigma of an estimate or of ``ratio``, relative, or rad; None: unknown."""
        if name == 'ratio':
            return ratio_sigma(self.method)
        estimate = self.method.estimates.get(name)
        if estimate is None or estimate.value is None or estimate.sigma is None:
            return None
        return estimate.sigma if estimate.unit == 'rad' else estimate.sigma / abs(estimate.value)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of ``odocal plan --indoor --json``."""
        return {'run': self.name, 'duration': float(self.motion.t[-1]),
                'distance': self.motion.distance, 'method': self.method.name,
                'sigmas': {name: self.sigma(name) for name in (
                    *(shown for shown in SHOWN if shown in self.method.estimates), 'ratio')},
                'reasons': [reason.as_dict() for reason in self.method.reasons]}


def plan_indoor(run: str = 'all', *, reference: str = 'slam', drive: str = 'differential',
                imu: bool = True, size: float = 4.0, rounds: int = 1, speed: float = 0.5,
                track_width: float = 0.3, wheels: int | None = None, slip: float = 1e-3,
                points_sigma: float | None = None, config: Settings = None,
                ) -> list[PlannedRun]:
    """
    Predict the sigmas of runs of a small robot on a level floor.

    run : of PATTERNS, or ``all``.   reference : of REFERENCE_KINDS.   drive : as odometer.drive.
    imu : the robot has an IMU.   size, rounds, speed : m of a straight, repetitions, m/s.
    track_width : m between the wheels; the effective one of skid steering is 1.7 times as large
    in turns on the spot and 1.4 times on a straight.   wheels : number.   slip : m/sqrt(s) of
    each.   points_sigma : m, accuracy of the robot on its marks; None: ``reference.points_sigma``.
    config : as ``calibrate_bag``.

    Raises BadUsage, BadConfig: a name is unknown, or a value is out of range.
    """
    for flag, value, names in (('--indoor', run, ('all', *PATTERNS)), ('--drive', drive, DRIVES),
                               ('--reference', reference, REFERENCE_KINDS)):
        if value not in names:
            raise BadUsage(f'{flag} {value}: {unknown_name(value, names)}')
    if not track_width > 0 or not slip > 0:
        raise BadUsage('--track-width and --slip-walk: required: numbers above 0')
    settings = config_of(config)
    options = SimOptions(scenario='indoor', drive=drive, track_width=track_width, imu=imu,
                         slip_walk=slip, wheels=wheels or (4 if drive != DRIVES[0] else 2),
                         reference='mocap' if reference == MARKS else reference)
    robot = robot_of(options)
    if reference == MARKS:
        sigma = settings.reference.points_sigma if points_sigma is None else points_sigma
        robot = replace(robot, position_sigma=sigma, drift_sigma=sigma,
                        drift_length=MARKS_LENGTH, position_rate=10.0, at_rests=True)
    motions = {name: pattern_motion(name, size, rounds, drive, speed)
               for name in (PATTERNS if run == 'all' else (run,))}
    return [PlannedRun(name, motion, robot, predict_robot(motion, robot, settings))
            for name, motion in motions.items()]


def robot_of(options: SimOptions) -> Robot:
    """Return robot and reference of a simulated drive."""
    defaults = REFERENCES[options.reference].options
    drift, length = defaults.get('reference_drift', 0.0), defaults.get('drift_length', 0.0)
    # the sigma of a correlated error; for a random walk that of the model with the same increments
    stationary = drift * np.sqrt((length or Robot.drift_length) / 2)
    straight = STRAIGHT_RATIO * options.track_width if options.drive == SKID else 0.0
    return Robot(drive=options.drive, imu=options.imu, width=effective_width(options),
                 straight_width=straight, wheels=max(options.wheels or 2, 2),
                 slip=options.slip_walk, position_sigma=defaults['fix_sigma'],
                 position_rate=defaults['fix_rate'], drift_sigma=float(stationary))


def ratio_sigma(method: MethodResult) -> float | None:
    """Return the sigma of right over left wheel, relative; None: not determined."""
    if 'ratio_sigma' in method.details:
        return float(method.details['ratio_sigma'])
    left, right = (method.estimates.get(f'scale_factor_{side}') for side in SIDES)
    rho = method.details.get('correlation', {}).get('scale_factor_left,scale_factor_right')
    a, b = (wheel.relative_sigma if wheel else None for wheel in (left, right))
    if a is None or b is None or rho is None:
        return None
    return float(np.sqrt(a**2 + b**2 - 2 * rho * a * b))      # of a quotient, relative
