"""
Alignment: level, gyro bias and heading at the start of a leg, each with its sigma.

An ``Alignment`` is an input of the pure pipeline, so that a simulation can put errors in it.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.nav.earth import earth_rate_n, gravity, OMEGA
from odocal_ros.nav.rotations import matrix_from_quat, quat_from_matrix, transpose


@dataclass(frozen=True, eq=False)
class Alignment:
    """
    Attitude and gyro bias at one epoch.

    t : s since the start mark, where C_nb holds and the strapdown begins.
    C_nb : (3, 3) takes b to n.      gyro_bias : (3,) rad/s, in b.
    level_sigma, heading_sigma : rad, 1 sigma (level: each of east and north).
    gyro_bias_sigma : (3,) rad/s.    gyro_noise : rad/s/sqrt(Hz).   gyro_bias_walk : rad/s/sqrt(s)
    heading_source : where the heading is from; ``course`` holds the mounting angle itself.
    heading_shared : its error is the same in every leg.
    standstill : begin and end, s, of the standstill used, None when aligned in motion.
    """

    t: float
    C_nb: NDArray[np.float64]
    gyro_bias: NDArray[np.float64]
    level_sigma: float
    heading_sigma: float
    gyro_bias_sigma: NDArray[np.float64]
    gyro_noise: float
    gyro_bias_walk: float
    heading_source: str
    heading_shared: bool
    standstill: tuple[float, float] | None = None

    @property
    def heading_separable(self) -> bool:
        """Tell whether the heading knows nothing of the odometer's direction."""
        return self.heading_source != 'course'

    @property
    def q_nb(self) -> NDArray[np.float64]:
        """Return C_nb as a quaternion x y z w."""
        return quat_from_matrix(self.C_nb)


@dataclass(frozen=True, eq=False)
class Level:
    """Level and turn rate before heading is known: L is level, its x axis below b's x axis."""

    t: float
    C_Lb: NDArray[np.float64]           # (3, 3)
    level_sigma: float                  # rad, each axis
    mean_rate_b: NDArray[np.float64]    # (3,) rad/s over the standstill, zero in motion
    rate_sigma: float                   # rad/s, of the mean from noise
    standstill: tuple[float, float] | None


def level_frame(up_b):
    """Return C_Lb for the up direction in b: x of L is b's x axis projected on the level."""
    u = up_b / np.linalg.norm(up_b)
    x = np.array([1.0, 0.0, 0.0]) - u[0] * u
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(u, x), u])


def C_nL(yaw):
    """Return the rotation that takes level axes to n for the ENU yaw of L's x axis, rad."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def level_at_rest(t, w_b, f_b, span, grade, gyro_noise) -> Level:
    """
    Level from the mean specific force of a standstill.

    Parameters
    ----------
    t, w_b, f_b : (n,), (n, 3), (n, 3) arrays
        Imu rows, s, rad/s, m/s^2.
    span : (2,)
        Begin and end of the standstill, s.
    grade : Grade
        Accelerometer bias and noise.
    gyro_noise : float
        rad/s/sqrt(Hz).

    Returns
    -------
    Level at the end of the standstill; an accelerometer bias tilts it by bias / g.

    """
    inside = (t >= span[0]) & (t <= span[1])
    length = max(span[1] - span[0], 1e-3)
    up_b = f_b[inside].mean(axis=0)
    g = np.linalg.norm(up_b)
    sigma = np.hypot(grade.accel_bias, grade.accel_noise / np.sqrt(length)) / g
    end = t[inside][-1]
    return Level(float(end), level_frame(up_b), float(sigma), w_b[inside].mean(axis=0),
                 gyro_noise / np.sqrt(length), (float(span[0]), float(span[1])))


def level_in_motion(t, w_b, f_b, q_0b, speed, latitude, grade) -> Level:
    """
    Level from the mean specific force of a stretch of driving, the odometer's speed taken out.

    In axes fixed at the start 0, the integral of C_0b f is the change of velocity plus g T up;
    the velocity lies along b's x axis but for the mounting angles, taken as within 3 deg.

    Parameters
    ----------
    t, w_b, f_b : (n,), (n, 3), (n, 3) arrays
        Imu rows of the stretch.
    q_0b : (n, 4) array
        Attitude against the first row, from the gyro.
    speed : (2,) array
        Speed at the first and the last row, m/s.
    latitude : float
        rad.
    grade : Grade
        Sensor figures: without a standstill the turn-on gyro bias is still in the attitude.

    """
    T = t[-1] - t[0]
    C_0b = matrix_from_quat(q_0b)
    f_0 = np.einsum('nij,nj->ni', C_0b, f_b)
    lift = np.sum((f_0[:-1] + f_0[1:]) / 2 * np.diff(t)[:, None], axis=0)
    change = C_0b[-1][:, 0] * speed[1] - C_0b[0][:, 0] * speed[0]
    up_0 = lift - change
    g = gravity(latitude, 0.0)
    parts = (grade.accel_bias / g, grade.gyro_bias * T / 2,
             np.abs(speed).max() * 0.05 / (g * T))
    return Level(float(t[0]), level_frame(up_0), float(np.linalg.norm(parts)), np.zeros(3),
                 0.0, None)


def gyrocompass(level: Level, latitude, grade) -> tuple[float, float]:
    """
    Return the ENU yaw of L's x axis and its sigma, rad, from the Earth rate seen at rest.

    The level part of the mean rate points north. A gyro bias east turns it by
    bias / (Omega cos latitude): the sigma is that of the turn-on bias and the noise.
    """
    rate_L = level.C_Lb @ level.mean_rate_b
    yaw = np.pi / 2 - np.arctan2(rate_L[1], rate_L[0])
    sigma = np.hypot(grade.gyro_bias, level.rate_sigma) / (OMEGA * np.cos(latitude))
    return float(yaw), float(sigma)


def complete(level: Level, yaw, yaw_sigma, source, shared, latitude, grade, gyro_noise):
    """
    Return the Alignment of a level and a heading; the gyro bias from rest, Earth rate taken out.

    With a heading of its own source all three axes are found; a gyrocompass has already used up
    the east part, which keeps the turn-on sigma.
    """
    C_nb = C_nL(yaw) @ level.C_Lb
    if level.standstill is None:
        bias, sigma = np.zeros(3), np.full(3, grade.gyro_bias)
    else:
        bias = level.mean_rate_b - transpose(C_nb) @ earth_rate_n(latitude)
        noise = np.hypot(level.rate_sigma, 1e-12)
        if source == 'gyrocompass':
            along_n = np.array([grade.gyro_bias, noise, noise])
            sigma = np.sqrt(np.einsum('ni,n->i', C_nb**2, along_n**2))
        else:
            turn = yaw_sigma * OMEGA * np.cos(latitude)      # Earth rate put on a wrong axis
            level_part = np.hypot(noise, min(turn, grade.gyro_bias))
            sigma = np.sqrt(np.einsum('ni,n->i', C_nb**2,
                                      np.array([level_part, level_part, noise])**2))
    return Alignment(level.t, C_nb, bias, level.level_sigma, float(yaw_sigma), sigma,
                     gyro_noise, grade.gyro_bias_walk, source, shared, level.standstill)
