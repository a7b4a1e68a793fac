# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Alignment: level, gyro bias and heading at the start of a leg, each with its sigma.

The specific force gives the ``LevelAttitude``, at rest or in motion. With a heading it becomes the
``Alignment``, an input of the pure pipeline, so that a simulation can put errors in it.
"""

from dataclasses import dataclass, field

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.geodesy import gravity, OMEGA
from odocal_ros.nav.rotations import matrix_from_quat, quat_from_matrix, rotate, transpose, wrap
from odocal_ros.settings.nominal import Grade

# limits of the alignment of a leg, recorded or planned
MOTION_LEVEL = 30.0       # s, judgement: driving time that determines a level without standstill
COURSE_DISTANCE = 30.0    # m, judgement: length of the track that determines a course
HEADING_LIMIT = 0.5      # rad, judgement: limit of the sigma of an orientation used as heading
COMPASS_LIMIT = 0.05      # rad, judgement: limit of the sigma of a gyrocompass
# s, judgement: excluded at each end of a standstill: a slow start tilts the specific force
REST_EDGE = 0.3


@dataclass(frozen=True, eq=False)
class Alignment:
    """Attitude and gyro bias at one epoch; frames n and b as in the package, 1 sigma."""

    t: float                  # s since the start mark, the epoch: start of the strapdown
    C_nb: Floats              # (3, 3) b to n
    gyro_bias: Floats         # (3,) rad/s, in b
    level_sigma: float        # rad, each of east and north
    heading_sigma: float      # rad
    gyro_bias_sigma: Floats   # (3,) rad/s, in b
    gyro_noise: float         # rad/s/sqrt(Hz)
    gyro_bias_walk: float     # rad/s/sqrt(s)
    # setting alignment.source; a heading from ``course`` includes the yaw mounting angle
    heading_source: str
    heading_shared: bool      # True: its error is the same in every leg
    standstill: tuple[float, float] | None = None    # begin and end, s; None: in motion
    gyro_scale_sigma: float = 0.0    # relative
    gyro_axes_sigma: float = 0.0     # rad, of an axis

    @property
    def heading_separable(self) -> bool:
        """Return True if the heading is independent of the direction of the odometer."""
        return self.heading_source != 'course'

    @property
    def q_nb(self) -> Floats:
        """Return C_nb as a quaternion x y z w."""
        return quat_from_matrix(self.C_nb)


@dataclass(frozen=True, eq=False)
class LevelAttitude:
    """
    Attitude without heading, and turn rate.

    Frame L is level; its x axis is the horizontal projection of the x axis of b.
    """

    t: float               # s since the start mark
    C_Lb: Floats           # (3, 3) b to L
    level_sigma: float     # rad, each axis
    mean_rate_b: Floats    # (3,) rad/s over the standstill, zero in motion
    rate_sigma: float      # rad/s, of the mean as bias at t
    standstill: tuple[float, float] | None    # begin and end, s; None: in motion
    # (3, 3) to n from p, east-north-up at the position of the vehicle
    C_np: Floats = field(default_factory=lambda: np.eye(3))


def level_frame(up_b: Floats) -> Floats:
    """Return C_Lb for up in b: x of L is b's x axis on the level; if vertical, y is b's."""
    u = up_b / np.linalg.norm(up_b)
    across = np.hypot(u[1], u[2])
    y = np.array([0.0, u[2], -u[1]]) / across if across else np.array([0.0, 1.0, 0.0])
    return np.stack([np.cross(y, u), y, u])


def level_to_n_rotation(yaw: float) -> Floats:
    """Return the rotation from L to n for the ENU yaw of L's x axis, rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def level_at_rest(t: Floats, w_b: Floats, f_b: Floats, span: Floats | tuple[float, float],
                  grade: Grade, gyro_noise: float) -> LevelAttitude:
    """
    Return the level near the end of a standstill, from its mean specific force.

    t, w_b, f_b : (n,), (n, 3), (n, 3) IMU rows, s, rad/s, m/s^2.   span : (2,) begin and end of
    the standstill, s.   grade : accelerometer bias, axes and noise.   gyro_noise : rad/s/sqrt(Hz).
    An accelerometer bias tilts the level by bias / g. The gyro bias is a random walk: its mean
    differs from its last value by a third of the variance over the standstill.
    """
    edge = min(REST_EDGE, (span[1] - span[0]) / 4)
    inside = (t >= span[0] + edge) & (t <= span[1] - edge)
    if not inside.any():        # rows only at its ends
        inside = (t >= span[0]) & (t <= span[1])
    length = max(span[1] - span[0] - 2 * edge, 1e-3)
    force = f_b[inside].mean(axis=0)
    sigma = np.hypot(grade.level_bias, grade.accel_noise / np.sqrt(length)) / np.linalg.norm(force)
    rate_sigma = np.hypot(gyro_noise / np.sqrt(length), grade.gyro_bias_walk * np.sqrt(length / 3))
    return LevelAttitude(float(t[inside][-1]), level_frame(force), float(sigma),
                         w_b[inside].mean(axis=0), float(rate_sigma),
                         (float(span[0]), float(span[1])))


def level_in_motion(t: Floats, f_b: Floats, q_0b: Floats, speed: Floats, latitude: float,
                    grade: Grade) -> LevelAttitude:
    """
    Return the level from the mean specific force in motion, corrected for the change of velocity.

    In axes fixed at the start 0, the integral of C_0b f is the change of velocity plus g T up;
    the velocity is along b's x axis up to the mounting angles, assumed to be 0.05 rad, 1 sigma.

    t, f_b : (n,), (n, 3) IMU rows of the interval: s, m/s^2.   q_0b : (n, 4) attitude relative to
    the first row, from the gyro.   speed : (2,) speed at the first and the last row, m/s.
    latitude : rad.   grade : sensor errors: without a standstill the attitude includes the turn-on
    gyro bias, and the Earth rate cannot be subtracted before heading is known.
    """
    T = t[-1] - t[0]
    C_0b = matrix_from_quat(q_0b)
    f_0 = rotate(C_0b, f_b)
    f_integral = np.sum((f_0[:-1] + f_0[1:]) / 2 * np.diff(t)[:, None], axis=0)
    up_0 = f_integral - (C_0b[-1][:, 0] * speed[1] - C_0b[0][:, 0] * speed[0])
    g = gravity(latitude, 0.0)
    max_speed = np.abs(speed).max()
    # rotation of the level until half of the interval, and Coriolis acceleration 2 Omega v
    by_earth = OMEGA * (T / 2 + 2 * max_speed / g)
    by_mounting = 0.05 * max_speed / (g * T)
    errors = (grade.level_bias / g, grade.gyro_bias * T / 2, by_earth, by_mounting)
    return LevelAttitude(float(t[0]), level_frame(up_0), float(np.linalg.norm(errors)),
                         np.zeros(3), 0.0, None)


def gyrocompass(level: LevelAttitude, latitude: float, grade: Grade) -> tuple[float, float]:
    """
    Return the ENU yaw of L's x axis and its sigma, rad, from the Earth rate measured at rest.

    The level part of the mean rate points north. An east gyro bias rotates it by
    bias / (Omega cos latitude), and a tilt about north by tilt * tan latitude.
    """
    rate_L = level.C_Lb @ level.mean_rate_b
    yaw = wrap(np.pi / 2 - np.arctan2(rate_L[1], rate_L[0]))
    by_gyro = np.hypot(grade.gyro_bias, level.rate_sigma) / (OMEGA * np.cos(latitude))
    return float(yaw), float(np.hypot(by_gyro, level.level_sigma * np.tan(latitude)))


def earth_rate_deviation(level: LevelAttitude, latitude: float, grade: Grade) -> float:
    """Return the deviation of the rate at rest from the Earth's, level or up, in sigmas."""
    rate_L = level.C_Lb @ level.mean_rate_b
    level_rate, up_rate = OMEGA * np.cos(latitude), OMEGA * np.sin(latitude)
    deviation = np.array([np.hypot(rate_L[0], rate_L[1]) - level_rate, rate_L[2] - up_rate])
    by_tilt = level.level_sigma * np.array([up_rate, level_rate])
    sigma = np.sqrt(grade.gyro_bias**2 + level.rate_sigma**2 + by_tilt**2)
    return float(np.abs(deviation / sigma).max())


def make_alignment(level: LevelAttitude, yaw: float, yaw_sigma: float, source: str, shared: bool,
                   origin: Origin, grade: Grade, gyro_noise: float) -> Alignment:
    """
    Return the Alignment from a level and a heading, with the gyro bias from a standstill.

    yaw : of L's x axis in ENU at the level's position, rad.   yaw_sigma : of ``yaw``, rad.
    """
    C_nb = level.C_np @ level_to_n_rotation(yaw) @ level.C_Lb
    bias_n, sigma_n = _gyro_bias_n(level, C_nb, yaw_sigma, origin, grade)
    sigma_b = np.sqrt(np.einsum('ni,n->i', C_nb**2, sigma_n**2))
    return Alignment(level.t, C_nb, transpose(C_nb) @ bias_n, level.level_sigma, float(yaw_sigma),
                     sigma_b, gyro_noise, grade.gyro_bias_walk, source, shared, level.standstill,
                     grade.gyro_scale_sigma, grade.axis_error)


def _gyro_bias_n(level: LevelAttitude, C_nb: Floats, yaw_sigma: float, origin: Origin,
                 grade: Grade) -> tuple[Floats, Floats]:
    """
    Return gyro bias and its sigma, ENU: the mean rate at rest minus the Earth's.

    A heading error rotates the Earth rate: a yaw error psi changes the east part by psi, the north
    part by psi^2 / 2 of the level rate; a tilt changes all three. In a local frame the Earth rate
    is not known. If the measurement is less certain than the turn-on bias of the grade, or without
    a standstill, the bias is zero; so is the east part after a gyrocompass, which has used it. If
    the grade excludes the measurement, grade or unit is wrong, and the measurement is used.
    """
    if level.standstill is None:
        return np.zeros(3), np.full(3, grade.gyro_bias)
    latitude = origin.latitude
    level_rate, up_rate = OMEGA * np.cos(latitude), abs(OMEGA * np.sin(latitude))
    # rms of psi^2 / 2 for a normal psi: sqrt(3) / 2 sigma^2; for an unknown one sqrt(3 / 2)
    by_yaw = level_rate * np.array(
        [min(yaw_sigma, 1.0), min(np.sqrt(3) / 2 * yaw_sigma**2, np.sqrt(1.5)), 0.0])
    by_tilt = level.level_sigma * np.array([up_rate, up_rate, level_rate])
    unknown = np.array(origin.local_earth_rate.sigma_n) if origin.local_earth_rate else 0.0
    sigma = np.sqrt(level.rate_sigma**2 + by_yaw**2 + by_tilt**2 + unknown**2)
    measured = C_nb @ level.mean_rate_b - origin.earth_rate_n
    max_sigmas = 10.0       # of noise and turn-on bias: with a larger rate the grade is wrong
    is_used = (sigma < grade.gyro_bias) | (
        np.abs(measured) > max_sigmas * np.hypot(sigma, grade.gyro_bias))
    return np.where(is_used, measured, 0.0), np.where(is_used, sigma, grade.gyro_bias)
