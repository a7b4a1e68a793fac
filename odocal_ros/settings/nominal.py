# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Nominal values by the settings: scale factor, yaw mounting angle, errors of the IMU grade."""

from collections.abc import Mapping
import dataclasses
from dataclasses import dataclass
import math
from math import isnan, tau

from odocal_ros.settings.config import Config, ImuConfig


def nominal_scale(config: Config, unit: str) -> float:
    """Return K0: as configured, from the size of the wheel, or 1 for speeds; 0: unknown."""
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


G = 9.80665          # m/s^2, definition: standard gravity (CGPM 1901), of data sheets


@dataclass(frozen=True)
class Grade:
    """Error figures of an IMU, each axis, 1 sigma."""

    gyro_noise: float       # rad/s/sqrt(Hz)
    gyro_bias: float        # rad/s, at turn-on
    gyro_bias_walk: float   # rad/s/sqrt(s)
    accel_noise: float      # m/s^2/sqrt(Hz)
    accel_bias: float       # m/s^2, at turn-on
    accel_bias_walk: float  # m/s^2/sqrt(s)
    gyro_scale_error: float = 0.0    # relative
    accel_scale_error: float = 0.0   # relative
    misalignment: float = 0.0        # rad, of each axis from its nominal direction
    gyro_by_force: float = 0.0       # rad/s per m/s^2, g-sensitivity of the gyro

    @property
    def axis_error(self) -> float:
        """Return the angle between an axis of the gyro and one of the accelerometer, rad."""
        return math.sqrt(2) * self.misalignment

    @property
    def level_bias(self) -> float:
        """Return the bias of a level accelerometer, m/s^2: its own and g by axis misalignment."""
        return math.hypot(self.accel_bias, math.sqrt(2) * G * self.misalignment)


def _from_data_sheet(gyro_noise: float, gyro_bias: float, gyro_bias_walk: float,
                     accel_noise: float, accel_bias: float, accel_bias_walk: float,
                     gyro_scale_error: float, accel_scale_error: float, misalignment: float,
                     gyro_by_force: float) -> Grade:
    """
    Return the grade with the figures of a data sheet, converted to SI units.

    Units: deg/sqrt(h), deg/h, deg/h/sqrt(h); m/s/sqrt(h), m/s^2, m/s^2/sqrt(h); scale errors
    relative; misalignment deg; gyro_by_force deg/s/g.
    """
    hour, root_hour = 3600.0, 60.0
    return Grade(
        gyro_noise=math.radians(gyro_noise) / root_hour,
        gyro_bias=math.radians(gyro_bias) / hour,
        gyro_bias_walk=math.radians(gyro_bias_walk) / hour / root_hour,
        accel_noise=accel_noise / root_hour,
        accel_bias=accel_bias,
        accel_bias_walk=accel_bias_walk / root_hour,
        gyro_scale_error=gyro_scale_error, accel_scale_error=accel_scale_error,
        misalignment=math.radians(misalignment),
        gyro_by_force=math.radians(gyro_by_force) / G)


# Gyro scale: data sheets of consumer MEMS give limits of 3 % for a new chip (MPU-6050: +-3 % at
# 25 C, 2 % more over temperature), used as 3 sigma; factory-calibrated MEMS have about 0.3 %,
# fibre gyros some hundred ppm, ring lasers some ppm: orders of magnitude, not of one product.
# Accelerometer scale: 3 % at most for a new consumer chip (MPU-6050); calibrated 0.3 %; combined
# with fibre gyros some hundred ppm, with ring lasers a hundred. Columns: gyro noise, bias and walk
# of the bias; the same of the accelerometer; scale errors of both; misalignment; g-sensitivity
GRADES: dict[str, Grade] = {      # from the worst to the best
    'consumer': _from_data_sheet(0.3, 100.0, 10.0, 0.1, 0.05, 5e-3, 0.01, 0.01, 0.5, 0.06),
    'industrial': _from_data_sheet(0.15, 20.0, 5.0, 0.03, 0.02, 1e-3, 3e-3, 3e-3, 0.1, 0.01),
    'tactical': _from_data_sheet(0.012, 1.0, 0.5, 0.02, 5e-3, 3e-4, 3e-4, 5e-4, 0.05,
                                 4e-4),
    'navigation': _from_data_sheet(0.001, 0.01, 0.003, 0.005, 5e-4, 5e-5, 1e-5, 1e-4,
                                   2e-3, 1e-5),
}

# Turn-on biases of IMUs as sold, 1 sigma: gyro rad/s, accelerometer m/s^2. Physical: by data
# sheets and measurements (docs/zoo.md), ten and more times those of the grades above, which remain
# if a driver removes the bias or it is measured at a standstill
TURN_ON = {'consumer': (math.radians(1.0), 25e-3 * G), 'industrial': (math.radians(0.1), 3e-3 * G),
           'tactical': (math.radians(5.0) / 3600.0, 1e-3 * G)}


def turn_on_bias(imu: ImuConfig) -> tuple[float, float]:
    """Return the usual turn-on bias of a gyro, rad/s, and an accelerometer, m/s^2: 1 sigma."""
    grade = grade_of(imu)
    turn_on = TURN_ON.get(imu.grade, (0.0, 0.0))
    return (max(grade.gyro_bias, turn_on[0] if math.isnan(imu.gyro_bias) else 0.0),
            max(grade.accel_bias, turn_on[1] if math.isnan(imu.accel_bias) else 0.0))


def grade_with_turn_on_bias(imu: ImuConfig) -> Grade:
    """Return the grade with the usual turn-on bias of its accelerometer, which tilts the level."""
    return dataclasses.replace(grade_of(imu), accel_bias=turn_on_bias(imu)[1])


# figure of a Grade: its setting, if the name differs
SETTING_OF_FIGURE = {'gyro_scale_error': 'gyro_scale_sigma',
                     'accel_scale_error': 'accel_scale_sigma',
                     'misalignment': 'misalignment_sigma',
                     'gyro_by_force': 'gyro_by_force_sigma'}


def with_grade_by_noise(imu: ImuConfig, variance: Mapping[str, float]) -> ImuConfig:
    """
    Return the imu settings, with a worse grade if that fits the noise at rest better.

    With too good a grade, priors would be too narrow.   variance : white noise of 'gyro' and
    'accel' at rest, per s; empty: not known.
    """
    if not variance:
        return imu
    names = list(GRADES)
    candidates = [dataclasses.replace(imu, grade=name)
                  for name in names[:names.index(imu.grade) + 1]]

    def misfit(candidate: ImuConfig) -> float:
        grade = grade_of(candidate)
        return sum(abs(math.log(max(sigma, 1e-12) / math.sqrt(variance[name])))
                   for name, sigma in (('gyro', grade.gyro_noise), ('accel', grade.accel_noise))
                   if name in variance)

    return min(reversed(candidates), key=misfit)


def grade_of(imu: ImuConfig) -> Grade:
    """Return the grade of the imu settings, with the single figures that the settings give."""
    grade = GRADES[imu.grade]
    names = [f.name for f in dataclasses.fields(Grade)]
    configured = {name: getattr(imu, SETTING_OF_FIGURE.get(name, name)) for name in names}
    return dataclasses.replace(grade, **{k: v for k, v in configured.items() if not math.isnan(v)})
