# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Settings: each one is defined once with its default, unit, range and meaning.

ROS parameters, ``config/calibrator.yaml``, ``--config``, ``--set`` and docs/settings.md are all
made from these dataclasses. The name of a setting and of its ROS parameter is ``group.field``.
"""

from dataclasses import dataclass, replace
import math
from operator import attrgetter
from typing import Any

from odocal_ros.data.inputs import TOPICS
from odocal_ros.settings import config_groups
from odocal_ros.settings.setting import (
    setting,
    settings_of as settings_of,  # re-exported: the functions on these dataclasses
    with_settings as with_settings,
)

GRADES = ('consumer', 'industrial', 'tactical', 'navigation')
HEADING_SOURCES = ('auto', 'gyrocompass', 'imu_orientation', 'heading_topic', 'course', 'fixed')
NAN = math.nan
SIDES = ('left', 'right')     # names of two wheels
DRIVES = DIFFERENTIAL, SKID, MECANUM, OMNI = 'differential', 'skid', 'mecanum', 'omni'
HOLONOMIC, MIN_OMNI_WHEELS = (MECANUM, OMNI), 3    # definition: drives that move sideways

TYPICAL = 'typical value of IMUs sold in this grade'


def _place(about: str) -> Any:
    """Declare a position in base_link."""
    return setting((0.0, 0.0, 0.0), 'm', -100.0, 100.0, read_only=True, about=about)


def _arrival_time() -> Any:
    """Declare whether messages are stamped by their arrival."""
    return setting(False, read_only=True, about=(
        'Use the arrival time of messages instead of their stamp: for stamps that are 0 or from '
        'another clock (time since boot).'))


def _figure(unit: str, high: float, about: str, nan: str = 'value of the grade') -> Any:
    """Declare an error of an IMU, 1 sigma; ``nan`` : meaning of NaN, its default."""
    return setting(NAN, unit, 0.0, high, about=f'{about}; NaN: {nan}.')


@dataclass(frozen=True, kw_only=True)
class OdometerConfig:
    type: str = setting('auto', read_only=True, about=(
        "Message type 'pkg/msg/Type'; auto: type of the first publisher, or of the only "
        'candidate in a bag.'))
    field: str = setting('', read_only=True, about=(
        "Dotted path to the value, with [i] or [name]; empty: the type's default."))
    quantity: str = setting('auto', read_only=True, about=(
        'Meaning of the value: running count, count since the last message, or speed; auto: the '
        "type's default."), choices=('auto', 'cumulative', 'increment', 'rate'))
    wrap: int = setting(0, 'counts', 0, 2**62, read_only=True, about=(
        'Counter modulus; 0: that of the integer type (65536 for 16 bits sent in an Int32).'))
    signed: bool = setting(True, read_only=True, about=(
        'False for pulses without direction: reversing is then detected from IMU and fixes, '
        'or rejects the leg.'))
    reversed: bool = setting(False, read_only=True, about='Positive counts mean reverse motion.')
    nominal_scale: float = setting(0.0, 'm/pulse, m/rad or 1', 0.0, 1e6, about='Scale factor as '
                                   'configured, K0; 0: unknown for counts, 1 for speeds.')
    max_scale_deviation: float = setting(0.35, '1', 0.0, 1.0, about='Limit of the deviation from '
                                         'the nominal scale; beyond it the verdict is caution.')
    lever_arm: tuple[float, ...] = _place('Wheel contact point in base_link (forward, left, up).')
    time_offset: float = setting(0.0, 's', -1.0, 1.0, about='Added to odometer stamps.')
    arrival_time: bool = _arrival_time()
    # latency of a bus and a middleware is rarely less; u-blox requires 10 ms or better
    time_sigma: float = setting(0.01, 's', 0.0, 1.0, about='Unknown delay of the odometer, 1 '
                                'sigma; matters in turns and at marks set in motion.')
    wheels: tuple[str, ...] = setting((), read_only=True, item=str, about=(
        'Wheels in one message: joint names or array indices, the left and the right one of each '
        'axle in turn.'))
    left: str = setting('', read_only=True, about=(
        "Left one of two wheels: joint name, array index, or 'topic' if it has its own topic."))
    right: str = setting('', read_only=True, about=(
        "Right one of two wheels: joint name, array index, or 'topic' (odometer_right)."))
    drive: str = setting(DIFFERENTIAL, choices=DRIVES, read_only=True, about=(
        'Kinematics: differential (cars too), skid (wheels or tracks that slide in turns), '
        'mecanum (four odometer.wheels: front left, front right, rear left, rear right) or '
        'omni (three or more, counter-clockwise in a circle).'))
    wheel_offset: float = setting(0.0, 'rad', -6.3, 6.3, read_only=True, about=(
        'Omni wheels: angle from the x axis to the first wheel, seen from the centre.'))
    track_width: float = setting(0.0, 'm', 0.0, 20.0, about='Distance between the left and the '
                                 'right wheel; 0: unknown.')

    @property
    def wheel_keys(self) -> tuple[str, ...]:
        """Return the configured keys of the wheels, () if they are selected by name."""
        return self.wheels or tuple(filter(None, (self.left, self.right)))

    @property
    def has_two_topics(self) -> bool:
        """Return True if the left and the right wheel have a topic each."""
        return 'topic' in (self.left, self.right)

    @property
    def needs_imu(self) -> bool:
        """Return False for several wheels, which are sufficient on a level floor."""
        return len(self.wheel_keys) < len(SIDES) and self.drive == DIFFERENTIAL

    def names(self, count: int) -> tuple[str, ...]:
        """Return the names of ``count`` wheels in texts and results: '' for a single one."""
        if count <= len(SIDES):
            return SIDES if count == len(SIDES) else ('',)
        keys = self.wheel_keys
        return keys if len(keys) == count else tuple(str(k) for k in range(1, count + 1))


@dataclass(frozen=True, kw_only=True)
class ImuConfig:
    grade: str = setting('consumer', choices=GRADES, about=(
        'Quality of the IMU by its gyro noise (angle random walk): 0.3, 0.15, 0.012, 0.001 '
        'deg/√h. Tactical MEMS such as STIM300 and HG1700 (0.15, 0.125) are industrial here. '
        'The settings below override values.'))
    frame_id: str = setting('', read_only=True, about=(
        "Use only messages of the IMU topic with this frame_id; '': the topic must carry one "
        'IMU.'))
    use_pressure: bool = setting(True, read_only=True, about='Use the air pressure (pressure) as '
                                 'height if it is published.')
    gyro_noise: float = _figure('rad/s/sqrt(Hz)', 1.0, 'White gyro noise')
    gyro_bias: float = _figure('rad/s', 1.0, 'Turn-on gyro bias, 1 sigma', TYPICAL)
    gyro_bias_walk: float = _figure('rad/s/sqrt(s)', 1.0, 'Random walk of the gyro bias')
    accel_noise: float = _figure('m/s^2/sqrt(Hz)', 10.0, 'White accelerometer noise')
    accel_bias: float = _figure('m/s^2', 10.0, 'Turn-on accelerometer bias, 1 sigma', TYPICAL)
    accel_bias_walk: float = _figure('m/s^2/sqrt(s)', 10.0, 'Random walk of the accelerometer '
                                     'bias')
    gyro_scale_sigma: float = _figure('1', 1.0, 'Error of the gyro scale, relative, 1 sigma')
    accel_scale_sigma: float = _figure('1', 1.0, 'Error of the accelerometer scale, relative, 1 '
                                       'sigma')
    misalignment_sigma: float = _figure('rad', 0.1, 'Axis misalignment of gyro and accelerometer '
                                        '(non-orthogonality), 1 sigma')
    gyro_by_force_sigma: float = _figure('rad/s/(m/s^2)', 0.01, 'g-sensitivity of the gyro, 1 '
                                         'sigma')
    gyro_scale: float = setting(1.0, '1', 0.0, 1e3, about='Factor on the published turn rates; '
                                '0.017453292519943295 for an IMU in deg/s.')
    accel_scale: float = setting(1.0, '1', 0.0, 1e3, about='Factor on the published specific '
                                 'force; 9.80665 for an IMU in g.')
    mounting_rpy: tuple[float, ...] = setting((0.0, 0.0, 0.0), 'rad', -6.3, 6.3, about=(
        'Nominal rotation from the IMU frame to the body frame b (forward, left, up), fixed axes '
        'roll, pitch, yaw.'), read_only=True)
    constants: str = setting('', read_only=True, about=(
        'calibration.json of an earlier result of this vehicle, or its folder: its IMU scales '
        'and axes (not the mounting) are used like one more leg of the smoother.'))
    lever_arm: tuple[float, ...] = _place('IMU position in base_link.')
    time_offset: float = setting(0.0, 's', -1.0, 1.0, about='Added to IMU stamps.')
    arrival_time: bool = _arrival_time()
    nominal_yaw: float = setting(NAN, 'rad', about='Expected yaw mounting angle; a result far '
                                 'from it is a caution. NaN: not checked.')


@dataclass(frozen=True, kw_only=True)
class GnssConfig:
    lever_arm: tuple[float, ...] = _place('Antenna position in base_link; 10 cm accuracy is '
                                         'sufficient.')
    lever_arm_sigma: float = setting(0.1, 'm', 0.0, 10.0, about='Uncertainty of the antenna '
                                     'position, each axis.')
    time_offset: float = setting(0.0, 's', -1.0, 1.0, about='Added to fix stamps.')
    arrival_time: bool = _arrival_time()
    time_sigma: float = setting(0.05, 's', 0.0, 1.0, about='Unknown delay of fixes, 1 sigma; '
                                'matters at marks set in motion.')
    min_status: int = setting(0, '', -1, 2, about='Minimum NavSatStatus of a used fix.')
    max_sigma: float = setting(NAN, 'm', 0.0, 1e4, about='Limit of the horizontal 1 sigma of a '
                               'used fix; NaN: 3 m, or twice the median of the leg if that is '
                               'larger; 0: no limit.')
    default_sigma: float = setting(2.5, 'm', 1e-4, 1e4, about='Horizontal 1 sigma of fixes '
                                   'without a covariance.')
    correlation_time: float = setting(NAN, 's', 0.0, 1e4, about='Correlation time of fix errors; '
                                      '0: white; NaN: estimated from the data.')
    use_velocity: bool = setting(True, read_only=True, about=(
        'Use the GNSS velocity (fix_velocity) if it is published.'))
    velocity_scale_sigma: float = setting(1e-3, '1', 0.0, 0.1, about='Relative scale error of the '
                                          'GNSS velocity, 1 sigma. Pure Doppler: 1e-5. A receiver '
                                          'that fuses wheel speeds: 0.05.')


@dataclass(frozen=True, kw_only=True)
class LegConfig:
    min_distance: float = setting(100.0, 'm', 1.0, 1e5, about='Shorter legs are rejected.')
    min_speed: float = setting(2.78, 'm/s', 0.1, 50.0, about='A leg that never reaches this '
                               'speed is a caution.')
    max_yaw_rate: float = setting(0.02, 'rad/s', 0.0, 1.0, about='Turn rate up to which the '
                                  'vehicle counts as driving straight.')
    max_duration: float = setting(7200.0, 's', 10.0, 14400.0, about='A longer live leg is '
                                  'stopped automatically.')
    max_gap: float = setting(0.5, 's', 0.05, 10.0, about='Limit of an IMU gap; at a longer gap '
                             'the leg is cut.')
    standstill: float = setting(2.0, 's', 0.2, 600.0, about='Minimum duration of a standstill.')
    preroll: float = setting(600.0, 's', 0.0, 7200.0, about='Duration of the data that are '
                             'used from before the start mark.')
    compute_limit: int = setting(40, 'passes', 5, 1000, about='Largest number of passes of a fit; '
                                 'a pass processes one keyframe per second of the leg. At the '
                                 'limit the best estimate is used, with a sigma of four times '
                                 'the remaining change.')
    automatic: bool = setting(False, about='Legs start and end automatically at standstills, '
                              'otherwise every leg.automatic_minutes; a scale change beyond 3 '
                              'sigma is reported.')
    automatic_minutes: float = setting(10.0, 'min', 1.0, 120.0, about='Largest '
                                       'duration of an automatic leg; after half of it, a '
                                       'standstill ends the leg.')


@dataclass(frozen=True, kw_only=True)
class AlignmentConfig:
    heading_source: str = setting('auto', choices=HEADING_SOURCES, about='Source of the heading '
                                  "of the IMU's x axis.")
    heading: float = setting(NAN, 'rad', about="Heading of the IMU's x axis at the start mark, "
                             'clockwise from north (a compass quantity).')
    heading_sigma: float = setting(0.0175, 'rad', 0.0, 3.2, about='Uncertainty of a fixed heading '
                                   'and of sources without a stated sigma, 1 sigma.')
    heading_offset: float = setting(0.0, 'rad', -6.3, 6.3, about='Added to the ENU yaw of the '
                                    'heading topic.')

    @property
    def source(self) -> str:
        """Return the heading source; ``auto`` is ``fixed`` if a heading is configured."""
        return 'fixed' if self.heading_source == 'auto' and not math.isnan(self.heading) else \
            self.heading_source


@dataclass(frozen=True, kw_only=True)
class WheelsConfig:
    radius: float = setting(0.0, 'm', 0.0, 10.0, about='Nominal wheel radius; 0: unknown.')
    pulses_per_revolution: float = setting(0.0, 'pulses', 0.0, 1e9, about='Pulses per turn of the '
                                           'wheel; with the radius it gives the nominal scale.')
    radius_range: float = setting(0.0, '1', 0.0, 0.9, about='Half width of the search range '
                                  "around each wheel's nominal scale factor, relative, such as "
                                  'twice its tolerance; 0: 0.05 is used.')
    heading_range: float = setting(0.0, 'rad', 0.0, 3.2, about='Half width of the search range '
                                   'of the initial heading; 0: twice its sigma, or 0.17 rad if '
                                   'that is unknown.')
    levels: int = setting(7, '', 1, 49, about='Levels of each parameter in the first search, 3 '
                          'or more: rounded up to an odd prime power (with zero as a level) for '
                          'the orthogonal array.')
    robust: bool = setting(False, about='Weight fixes by their covariance and limit the '
                           'influence of outliers in the search.')


@dataclass(frozen=True, kw_only=True)
class Config:
    """All settings of the calibrator; the module docstring defines their names."""

    method: str = setting('auto', choices=(
        'auto', 'two_point', 'wheels', 'smoother', 'all', 'patent'), about=(
        'Method that gives the result; auto, all: each value from smoother if available, '
        'otherwise from two_point; patent: smoother, plus the search of CN104359492A for two '
        'wheels; wheels: alias of smoother.'))
    vehicle: str = setting('', read_only=True, about=(
        'Name of the vehicle, shown in results and as title of the report; a result of '
        'another vehicle is not restored.'))
    odometer: OdometerConfig = OdometerConfig()
    imu: ImuConfig = ImuConfig()
    gnss: GnssConfig = GnssConfig()
    leg: LegConfig = LegConfig()
    alignment: AlignmentConfig = AlignmentConfig()
    reference: config_groups.ReferenceConfig = config_groups.ReferenceConfig()
    wheels: WheelsConfig = WheelsConfig()
    verdict: config_groups.VerdictConfig = config_groups.VerdictConfig()
    accept: config_groups.AcceptConfig = config_groups.AcceptConfig()
    output: config_groups.OutputConfig = config_groups.OutputConfig()
    journal: config_groups.JournalConfig = config_groups.JournalConfig()
    publish: config_groups.PublishConfig = config_groups.PublishConfig()
    frames: config_groups.FramesConfig = config_groups.FramesConfig()
    diagnostic_updater: config_groups.UpdaterConfig = config_groups.UpdaterConfig()

    @property
    def inputs(self) -> tuple[str, ...]:
        """Return the inputs that these settings use, including optional ones."""
        used = {'odometer_right': self.odometer.has_two_topics,
                'fix_velocity': self.gnss.use_velocity, 'pressure': self.imu.use_pressure,
                'heading': self.alignment.heading_source in ('auto', 'heading_topic')}
        return tuple(slot for slot in TOPICS if used.get(slot, True))

    def in_local_frame(self) -> 'Config':
        """Return the settings of a leg whose positions are in a local frame."""
        local = self.reference
        leg = replace(self.leg, min_distance=min(self.leg.min_distance, local.min_distance),
                      min_speed=min(self.leg.min_speed, local.min_speed))
        return replace(self, leg=leg, gnss=replace(self.gnss, default_sigma=local.default_sigma))


SETTINGS = settings_of(Config)


def flat(config: Config) -> dict[str, Any]:
    """Return every setting by its dotted name."""
    return {name: attrgetter(name)(config) for name in SETTINGS}
