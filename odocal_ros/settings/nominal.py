# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Nominal values by the settings: scale factor, yaw mounting angle, errors of the IMU grade."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
import math
from math import isnan, tau

from odocal_ros.settings.config import Config, ImuConfig

G = 9.80665          # m/s^2, definition: standard gravity (CGPM 1901), of data sheets


def nominal_scale(config: Config, unit: str) -> float:
    """
    Return the nominal scale factor K0: the setting, else from the settings of the wheel, else 0.

    unit : of the scale factor: m/pulse, m/rad, or 1 for a speed, whose nominal scale factor is 1.
    """
    if config.odometer.nominal_scale:
        return config.odometer.nominal_scale
    wheels = config.wheels
    if unit == 'm/pulse' and wheels.radius and wheels.pulses_per_revolution:
        return tau * wheels.radius / wheels.pulses_per_revolution
    if unit == 'm/rad' and wheels.radius:
        return wheels.radius
    return 1.0 if unit == '1' else 0.0


def nominal_yaw(config: Config) -> float:
    """Return the yaw mounting angle as configured, rad; 0 if it is not."""
    yaw = config.imu.nominal_yaw
    return 0.0 if isnan(yaw) else yaw


@dataclass(frozen=True)
class Grade:
    """Errors of an IMU, of each axis, 1 sigma; the settings ``imu.*`` have the same names."""

    gyro_noise: float       # rad/s/sqrt(Hz)
    gyro_bias: float        # rad/s, at turn-on
    gyro_bias_walk: float   # rad/s/sqrt(s)
    accel_noise: float      # m/s^2/sqrt(Hz)
    accel_bias: float       # m/s^2, at turn-on
    accel_bias_walk: float  # m/s^2/sqrt(s)
    gyro_scale_sigma: float = 0.0       # relative
    accel_scale_sigma: float = 0.0      # relative
    misalignment_sigma: float = 0.0     # rad, of each axis from its nominal direction
    gyro_by_force_sigma: float = 0.0    # rad/s per m/s^2, g-sensitivity of the gyro

    @property
    def axis_error(self) -> float:
        """Return the angle between an axis of the gyro and one of the accelerometer, rad."""
        return math.sqrt(2) * self.misalignment_sigma

    @property
    def level_bias(self) -> float:
        """Return the bias of a level accelerometer, m/s^2: its own and g by axis misalignment."""
        return math.hypot(self.accel_bias, math.sqrt(2) * G * self.misalignment_sigma)


def _from_data_sheet(sheet: Grade) -> Grade:
    """
    Return a grade in SI units from the units of data sheets.

    gyro_noise deg/sqrt(h), gyro_bias deg/h, gyro_bias_walk deg/h/sqrt(h), accel_noise m/s/sqrt(h),
    accel_bias_walk m/s^2/sqrt(h), misalignment_sigma deg, gyro_by_force_sigma deg/s/g.
    """
    hour, root_hour = 3600.0, 60.0
    return replace(
        sheet,
        gyro_noise=math.radians(sheet.gyro_noise) / root_hour,
        gyro_bias=math.radians(sheet.gyro_bias) / hour,
        gyro_bias_walk=math.radians(sheet.gyro_bias_walk) / hour / root_hour,
        accel_noise=sheet.accel_noise / root_hour,
        accel_bias_walk=sheet.accel_bias_walk / root_hour,
        misalignment_sigma=math.radians(sheet.misalignment_sigma),
        gyro_by_force_sigma=math.radians(sheet.gyro_by_force_sigma) / G)


# Gyro scale: data sheets of consumer MEMS give limits of 3 % for a new chip (MPU-6050: +-3 % at
# 25 C, 2 % more over temperature), used as 3 sigma; factory-calibrated MEMS have about 0.3 %,
# fibre gyros some hundred ppm, ring lasers some ppm: orders of magnitude, not of one product.
# Accelerometer scale: 3 % at most for a new consumer chip (MPU-6050); calibrated 0.3 %; combined
# with fibre gyros some hundred ppm, with ring lasers a hundred.
GRADES: dict[str, Grade] = {name: _from_data_sheet(sheet) for name, sheet in {
    'consumer': Grade(                               # from the worst to the best
        gyro_noise=0.3, gyro_bias=100.0, gyro_bias_walk=10.0,
        accel_noise=0.1, accel_bias=0.05, accel_bias_walk=5e-3,
        gyro_scale_sigma=0.01, accel_scale_sigma=0.01,
        misalignment_sigma=0.5, gyro_by_force_sigma=0.06),
    'industrial': Grade(
        gyro_noise=0.15, gyro_bias=20.0, gyro_bias_walk=5.0,
        accel_noise=0.03, accel_bias=0.02, accel_bias_walk=1e-3,
        gyro_scale_sigma=3e-3, accel_scale_sigma=3e-3,
        misalignment_sigma=0.1, gyro_by_force_sigma=0.01),
    'tactical': Grade(
        gyro_noise=0.012, gyro_bias=1.0, gyro_bias_walk=0.5,
        accel_noise=0.02, accel_bias=5e-3, accel_bias_walk=3e-4,
        gyro_scale_sigma=3e-4, accel_scale_sigma=5e-4,
        misalignment_sigma=0.05, gyro_by_force_sigma=4e-4),
    'navigation': Grade(
        gyro_noise=0.001, gyro_bias=0.01, gyro_bias_walk=0.003,
        accel_noise=0.005, accel_bias=5e-4, accel_bias_walk=5e-5,
        gyro_scale_sigma=1e-5, accel_scale_sigma=1e-4,
        misalignment_sigma=2e-3, gyro_by_force_sigma=1e-5),
}.items()}

# Turn-on biases of IMUs as sold, 1 sigma: gyro rad/s, accelerometer m/s^2. Physical: by data
# sheets and measurements (docs/zoo.md), ten and more times those of the grades above, which remain
# if a driver removes the bias or it is measured at a standstill
TURN_ON = {'consumer': (math.radians(1.0), 25e-3 * G), 'industrial': (math.radians(0.1), 3e-3 * G),
           'tactical': (math.radians(5.0) / 3600.0, 1e-3 * G)}


def turn_on_bias(imu: ImuConfig) -> tuple[float, float]:
    """Return the usual turn-on bias of a gyro, rad/s, and an accelerometer, m/s^2: 1 sigma."""
    grade = grade_of(imu)
    gyro, accel = TURN_ON.get(imu.grade, (0.0, 0.0))      # used without a configured bias
    return (max(grade.gyro_bias, gyro if isnan(imu.gyro_bias) else 0.0),
            max(grade.accel_bias, accel if isnan(imu.accel_bias) else 0.0))


def grade_with_turn_on_bias(imu: ImuConfig) -> Grade:
    """Return the grade with the usual turn-on bias of its accelerometer, which tilts alignment."""
    return replace(grade_of(imu), accel_bias=turn_on_bias(imu)[1])


def with_grade_by_noise(imu: ImuConfig, variance: Mapping[str, float]) -> ImuConfig:
    """
    Return the imu settings, with a worse grade if that fits the noise at rest better.

    With too good a grade, priors would be too narrow.   variance : of the white noise at rest of
    'gyro', (rad/s)^2/Hz, and 'accel', (m/s^2)^2/Hz; empty: not known.
    """
    if not variance:
        return imu
    names = list(GRADES)
    candidates = names[names.index(imu.grade)::-1]      # the configured grade, then worse ones

    def misfit(candidate: ImuConfig) -> float:
        """Return the sum of the logarithms of stated over measured noise, without signs."""
        grade = grade_of(candidate)
        stated = {'gyro': grade.gyro_noise, 'accel': grade.accel_noise}
        return sum(abs(math.log(max(sigma, 1e-12) / math.sqrt(variance[name])))
                   for name, sigma in stated.items() if name in variance)

    # if several are equally good, the configured grade, which is the first one
    return min((replace(imu, grade=name) for name in candidates), key=misfit)


def grade_of(imu: ImuConfig) -> Grade:
    """Return the errors of the configured grade, or the configured ones (NaN: not configured)."""
    grade = GRADES[imu.grade]
    configured = {name: getattr(imu, name) for name in asdict(grade)}
    return replace(grade, **{name: value for name, value in configured.items()
                             if not isnan(value)})
