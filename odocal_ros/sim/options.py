# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Options of a simulated drive, their defaults by scenario, and their checks.

Also the kinds of position references (GNSS, motion capture, SLAM ...), with their usual errors.
"""

from collections.abc import Collection
from dataclasses import dataclass, field, fields, replace
import math
from typing import Any

from odocal_ros.errors import BadUsage, unknown_name
from odocal_ros.settings.config import DIFFERENTIAL, DRIVES, MECANUM, MIN_OMNI_WHEELS, OMNI
from odocal_ros.settings.nominal import Grade, GRADES
from odocal_ros.sim.real_effects import RealEffects, Vector, ZEROS3

SIM_GRADES = {**GRADES, 'perfect': Grade(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)}
FIX_NOISES = ('white', 'correlated', 'rtk')
ODOMETERS = ('counts', 'speed', 'angle')
MAX_WHEEL_TOPICS, MAX_WHEELS = 2, 8    # definition: as in odometer.wheels
BY_SCENARIO: Any = None   # filled in by ``resolve``


@dataclass(frozen=True)
class Reference:
    """A kind of position reference: its topic, message type and usual options."""

    topic: str
    encoder: str            # function of ``bagio.encode``
    is_planar: bool = False         # z is 0, as from 2D SLAM
    has_covariance: bool = False
    options: dict[str, Any] = field(default_factory=dict)      # usual SimOptions of this kind


# Judgement, by data sheets and documentation: motion capture 0.1 to 1 mm at 50 to 200 Hz; total
# stations that track a prism 1 to 5 mm; laser scanners 1 to 3 cm of noise, and scan matching that
# drifts by 0.5 to 1 % of a path of some metres; AMCL with the grid of its map, 5 cm
REFERENCES = {
    'fix': Reference('/fix', 'fix', has_covariance=True),
    'pose': Reference('/pose', 'pose'),
    'mocap': Reference('/mocap/pose', 'pose', options={'fix_sigma': 0.001, 'fix_rate': 50.0}),
    'total_station': Reference('/prism', 'point', options={'fix_sigma': 0.002, 'fix_rate': 10.0}),
    'slam': Reference('/slam/pose', 'pose_with_covariance', is_planar=True, has_covariance=True,
                      options={'fix_sigma': 0.02, 'fix_rate': 10.0, 'reference_drift': 0.01,
                               'closure_time': 30.0}),
    'amcl': Reference('/amcl_pose', 'pose_with_covariance', is_planar=True, has_covariance=True,
                      options={'fix_sigma': 0.01, 'fix_rate': 5.0, 'reference_drift': 0.05,
                               'drift_length': 2.0}),
}


@dataclass(frozen=True, kw_only=True)
class SimOptions:
    """
    Options of one drive; BY_SCENARIO: the scenario's own value.

    Lever arms are positions in base_link (rear axle, forward-left-up), m. Mounting angles are
    those of docs/conventions.md; ``mounting_rpy`` is the nominal rotation from the IMU's frame to
    b, applied in addition.
    """

    scenario: str = 'straight'
    duration: float = BY_SCENARIO          # s
    seed: int = 1
    start_ns: int = 1_750_000_000_000_000_000
    latitude: float = math.radians(40.0)
    longitude: float = math.radians(116.0)
    height: float = 50.0                   # m, ellipsoidal
    heading: float = math.radians(45.0)    # of the vehicle at the start, clockwise from north
    slope: float = 0.0                     # rad, steepest part of hills of 1 km length

    imu: bool = True                       # False: the robot has none
    imu_grade: str = BY_SCENARIO
    imu_rate: float = 100.0                # Hz
    yaw: float = BY_SCENARIO               # rad, yaw mounting angle
    pitch: float = BY_SCENARIO             # rad, pitch mounting angle
    roll: float = 0.0                      # rad
    mounting_rpy: Vector = ZEROS3           # rad, nominal, IMU frame to b
    imu_lever_arm: Vector = ZEROS3
    gyro_scale_error: float = 0.0          # relative, of all axes
    accel_scale_error: float = 0.0         # relative, of all axes
    orientation_sigma: float | None = None  # rad; None: the IMU sends no orientation

    odometer: str = 'counts'               # counts, speed or angle (JointState position)
    odometer_rate: float = 50.0            # Hz
    odometer_delay: float = 0.0            # s, delay of the stamps
    odometer_lever_arm: Vector = ZEROS3     # wheel contact point; two wheels: their middle
    scale: float = BY_SCENARIO             # m/pulse, 1 or m/rad: the true value
    nominal_scale: float = BY_SCENARIO     # as configured by the operator
    speed_noise: float = 0.0               # m/s, white; only for odometer = speed
    drive: str = DIFFERENTIAL              # of a robot: or skid, mecanum, omni
    two_wheels: bool = False               # as wheels = 2
    wheels: int = BY_SCENARIO              # more than 2: joints of one JointState
    # K_right / K_left - 1; for more than 2 wheels: sigma of the relative scale error of each
    wheel_difference: float = 0.004
    wheelbase: float = 2.7                 # m, from the odometer's point to the front axle
    front_steers: bool = True              # more than 2 wheels: the front ones steer
    track_width: float = BY_SCENARIO       # m
    slip_walk: float = 0.0                 # m/sqrt(s) while moving
    slip_events: float = 0.0               # per hour of motion
    slip_size: float = 0.1                 # m spun in each event
    start_slip: float = 0.0                # wheel spin as a fraction of travel after each start
    start_slip_time: float = 5.0           # s from each start on
    # m/s, lateral and vertical velocity noise while moving; white, sampled at 10 Hz
    sway: float = 0.0

    # name in REFERENCES, which has defaults of the next seven; others are in COMMON_DEFAULTS
    reference: str = BY_SCENARIO
    fix_rate: float = BY_SCENARIO          # Hz
    fix_noise: str = BY_SCENARIO           # white, correlated or rtk
    fix_sigma: float = BY_SCENARIO   # m, horizontal, each axis; up: twice
    fix_correlation_time: float = BY_SCENARIO    # s, only for fix_noise = correlated
    reference_drift: float = BY_SCENARIO   # m/sqrt(m) of path
    drift_length: float = BY_SCENARIO      # m of path, correlation length; 0: random walk
    closure_time: float = BY_SCENARIO      # s, mean, between loop closures; 0: none
    fix_delay: float = 0.0                 # s, delay of the stamps
    antenna_lever_arm: Vector = ZEROS3
    outliers: float = 0.0                  # share of the fixes
    outlier_size: float = 20.0             # m
    outages: tuple[tuple[float, float], ...] = ()   # s from the start, no fixes in between

    heading_sigma: float | None = None     # rad; None: no heading topic
    heading_rate: float = 10.0             # Hz

    pressure_sigma: float | None = None    # m, of heights by air pressure; None: no sensor

    velocity_sigma: float | None = None    # m/s, each axis; None: no GNSS velocity
    velocity_rate: float = 10.0            # Hz
    velocity_correlation_time: float = 0.0  # s; 0: white
    velocity_delay: float = 0.0            # s, delay of the stamps
    velocity_lag: float = 0.0              # s, time constant of first-order smoothing
    velocity_scale_error: float = 0.0      # relative
    velocity_outliers: float = 0.0         # share of outliers

    real: RealEffects = RealEffects()      # further errors of real sensors

    @property
    def wheel_count(self) -> int:
        """Return the number of wheels with an odometer."""
        return max(self.wheels, 1 + self.two_wheels)


# values of a scenario, if they are not COMMON_DEFAULTS
ROBOT_RUN = {'reference': 'slam', 'wheels': 2, 'track_width': 0.3, 'imu_grade': 'consumer'}
DEFAULTS: dict[str, dict[str, Any]] = {
    'paper': {'duration': 930.0, 'imu_grade': 'navigation', 'pitch': 0.0},
    'straight': {'duration': 720.0, 'imu_grade': 'industrial'},
    'out_and_back': {'imu_grade': 'industrial'}, 'town': {'imu_grade': 'consumer'},
    'motorway': {'imu_grade': 'industrial'}, 'oval': {'imu_grade': 'industrial'},
    'yard': {'imu_grade': 'consumer'},
    'indoor': ROBOT_RUN | {'duration': 150.0}, 'square': ROBOT_RUN | {'duration': 151.0},
}
COMMON_DEFAULTS = {
    'duration': 600.0, 'yaw': math.radians(1.0), 'pitch': math.radians(0.4), 'reference': 'fix',
    'wheels': 1, 'track_width': 1.6, 'fix_rate': 5.0, 'fix_noise': 'white',
    'fix_correlation_time': 60.0, 'reference_drift': 0.0, 'drift_length': 0.0,
    'closure_time': 0.0,
}
ROBOTS = ('indoor', 'square')     # scenarios
# (true, nominal) scale by kind of odometer, of a robot: 70 mm wheels, encoders with 2500 counts
INDOOR_SCALES = {'counts': (8.9e-5, 8.8e-5), 'speed': (1.02, 1.0), 'angle': (0.0354, 0.035)}
SCALES = {'counts': (0.0213, 0.02), 'speed': (1.02, 1.0), 'angle': (0.31, 0.3)}     # of a car
POSITIVE = ('imu_rate', 'odometer_rate', 'fix_rate', 'heading_rate', 'velocity_rate', 'scale',
            'nominal_scale', 'track_width', 'wheelbase', 'fix_correlation_time', 'duration')
NOT_NEGATIVE = ('orientation_sigma', 'heading_sigma', 'fix_sigma', 'speed_noise', 'slip_walk',
                'slip_events', 'slip_size', 'start_slip', 'start_slip_time', 'sway', 'outliers',
                'outlier_size', 'seed', 'pressure_sigma', 'velocity_sigma',
                'velocity_correlation_time', 'velocity_lag', 'velocity_outliers',
                'reference_drift', 'drift_length', 'closure_time')
# largest absolute values; angles are rad in the options and degrees on the command line
LIMITS = {'outliers': 0.5, 'start_slip': 0.5, 'sway': 1.0, 'wheel_difference': 0.5,
          'gyro_scale_error': 0.5, 'accel_scale_error': 0.5, 'odometer_delay': 10.0,
          'fix_delay': 10.0, 'velocity_delay': 10.0, 'velocity_lag': 10.0,
          'velocity_scale_error': 0.5, 'velocity_outliers': 0.5, 'velocity_rate': 1000.0,
          'duration': 36_000.0, 'imu_rate': 10_000.0,
          'odometer_rate': 10_000.0, 'fix_rate': 1000.0, 'heading_rate': 1000.0}
ANGLES = {'latitude': 85.0, 'longitude': 180.0, 'heading': 360.0, 'slope': 20.0, 'yaw': 180.0,
          'pitch': 45.0, 'roll': 180.0, 'orientation_sigma': 90.0, 'heading_sigma': 90.0}


def resolve(options: SimOptions) -> SimOptions:
    """Return options with the scenario's own values; BadUsage for a wrong name or value."""
    _check_choice('--scenario', options.scenario, DEFAULTS)
    _check_choice('--odometer', options.odometer, ODOMETERS)
    defaults: dict[str, Any] = COMMON_DEFAULTS | DEFAULTS[options.scenario]
    _check_choice('--reference', options.reference or defaults['reference'], REFERENCES)
    defaults |= REFERENCES[options.reference or defaults['reference']].options
    options = _with_defaults(options, defaults)
    _check_choice('--fix-noise', options.fix_noise, FIX_NOISES)
    _check_choice('--drive', options.drive, DRIVES)
    if options.drive != DIFFERENTIAL:
        _check_choice(f'--drive {options.drive}: --scenario', options.scenario, ROBOTS)
        options = replace(options, front_steers=False, wheelbase=options.track_width,
                          wheels=4 if options.drive == MECANUM else options.wheels)
    if options.drive == OMNI:
        options = replace(options, wheels=max(options.wheels, MIN_OMNI_WHEELS))
    if options.wheel_count > MAX_WHEEL_TOPICS and options.odometer == 'counts':
        options = replace(options, odometer='angle')
    scale, nominal = (INDOOR_SCALES if options.scenario in ROBOTS else SCALES)[options.odometer]
    if options.scenario == 'paper':
        # fine pulses: quantisation must stay below 1e-6 of the 11.2 km path
        scale = 0.001 if options.odometer == 'counts' else scale
        nominal = 1.2 * (options.scale or scale)
    elif options.scale is not None:
        nominal = options.scale * nominal / scale
    resolved_options = _with_defaults(options, {'scale': scale, 'nominal_scale': nominal,
                                      'fix_sigma': 0.02 if options.fix_noise == 'rtk' else 1.5})
    if isinstance(options.real, dict):      # as in truth.yaml
        resolved_options = replace(resolved_options, real=RealEffects(**options.real))
    _check(resolved_options)
    return resolved_options


def _with_defaults(options: SimOptions, values: dict[str, Any]) -> SimOptions:
    return replace(options, **{name: value for name, value in values.items()
                               if getattr(options, name) is BY_SCENARIO})


def _check(options: SimOptions) -> None:
    _check_choice('--imu-grade', options.imu_grade, SIM_GRADES)
    for option in fields(options):
        value = getattr(options, option.name)
        for number in value if isinstance(value, tuple) else (value,):
            if isinstance(number, (int, float)) and not isinstance(number, bool):
                _check_number(option.name, number)
    if options.wheel_count > 1 and options.odometer == 'speed':
        raise BadUsage('--two-wheels and --wheels require --odometer counts or angle, not speed')
    if not 1 <= options.wheels <= MAX_WHEELS:
        raise BadUsage(f'--wheels {options.wheels}: required: 1 to {MAX_WHEELS}')
    for begin, end in options.outages:
        if not 0 <= begin < end:
            raise BadUsage(f'--outage {begin:g}:{end:g}: required: A:B, seconds with 0 <= A < B')
    max_samples = 20_000_000    # of one topic; more would not fit in memory
    if options.duration * options.imu_rate > max_samples:
        raise BadUsage(f'--duration {options.duration:g} at --imu-rate {options.imu_rate:g}: more '
                       f'than {max_samples:,} samples; lower one of them')


def _check_number(name: str, value: float) -> None:
    """Raise BadUsage for a value of an option that is out of range."""
    in_degrees = name in ANGLES
    flag = '--' + name.replace('_', '-') + ('-deg' if in_degrees else '')
    shown = math.degrees(value) if in_degrees else value
    limit = (ANGLES | LIMITS).get(name, math.inf)
    for is_valid, text in (
            (math.isfinite(value), 'required: a finite number'),
            (name not in POSITIVE or value > 0, 'required: a number above 0'),
            (name not in NOT_NEGATIVE or value >= 0, 'required: 0 or more'),
            (abs(shown) <= limit * (1 + 1e-12), f'the limit is {limit:g}')):
        if not is_valid:
            raise BadUsage(f'{flag} {shown:g}: {text}')


def _check_choice(flag: str, name: str, names: Collection[str]) -> None:
    if name not in names:
        raise BadUsage(f'{flag} {name}: {unknown_name(name, names)}')
