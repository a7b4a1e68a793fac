# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Covariance of dead reckoning: position, attitude, sensors and calibration.

True attitude is exp(phi) the reckoned one, in n (the odom frame); true rate (reading - bias) less
g times itself; true path (1 + k) on an axis turned by m in b. Position, scale, mounting and gyro
scale are considered, never corrected: the pose does not jump, the calibration stands.
"""

from collections.abc import Sequence
import math

import numpy as np

from odocal_ros.apply.attitude import Matrix, plus, skewed, Vector, ZERO
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.settings.grades import Grade
from odocal_ros.settings.levels import FAULT_SIGMAS

# definition: where the unknowns stand in the error state
P, PHI, BG, BA = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
K, M, G, N = 12, slice(13, 15), 15, 16    # m: about the y and z axis of b
BY_GRAVITY = [3, 4, 6, 7, 9, 10]    # observable by it, of a body nearly level: no heading
BY_REST = np.r_[3:9]
POSITIONS, ROTATIONS, BIASES, ALL = np.r_[P], np.r_[PHI], np.r_[BG], np.arange(N)
EYE, AXES = np.eye(N), np.eye(3)
POSE = np.eye(6, N)       # definition: position and attitude of the IMU in the error state
# judgement: m/sqrt(m) along, left, up, slip and slide of any road
ROAD_PER_METRE = (0.005, 0.01, 0.01)
# rad/s, s; judgement: of a turn that may hide in a gap of the IMU; a shorter gap hides its cube
HIDDEN_IN_GAP, HIDING_GAP = 0.1, 0.1
# m/s^2; judgement: of driving, that a second of odometer, or more, does not show
SHAKING = 0.4
# physical: rad/sqrt(s) of tilt where the Earth's turn, left in the gyro bias, turns with the
# vehicle: 11 deg/h constant for about half a minute
EARTH_LEFT = 6e-4
# definition: m that a straight line is too long by, per m and rad^2: rms of a normal angle's
# square over 2; per m: no more, of a direction that is not known
BEND, MOST_BENT = 3**0.5 / 2, 2.0
GRAVITY = 9.81    # m/s^2; physical: its last digits tilt nothing
MOST_FORCE_OFF = 5.0       # m/s^2; physical: half of g, that driving may add over a second or two


class Errors:
    """
    The covariance of the errors, (16, 16), and its updates by stops and gravity.

    bent : m in n, what attitude errors do to travel in second order.   changed : since
    ``pose_and_twist``.
    grade : of the IMU.   tilt, bias_sigma : rad, rad/s, sigmas at the start.   earth_left : the
    Earth's turn is in the gyro's bias.
    """

    def __init__(self, grade: Grade, vehicle: Vehicle, tilt: float, bias_sigma: float | Floats,
                 earth_left: bool = True) -> None:
        self.grade = grade
        self._walks = np.zeros(N)      # variance per s
        self._walks[PHI] = grade.gyro_noise**2
        self._walks[3:5] += (EARTH_LEFT * earth_left)**2
        self._walks[BG], self._walks[BA] = grade.gyro_bias_walk**2, grade.accel_bias_walk**2
        self.cov = np.zeros((N, N))
        sigma = np.concatenate([
            np.zeros(3), [tilt, tilt, 0.0], np.broadcast_to(bias_sigma, 3),
            np.full(3, grade.accel_bias), [vehicle.scale_sigma, vehicle.pitch_sigma,
                                           vehicle.yaw_sigma, grade.gyro_scale_error]])
        self.cov[ALL, ALL] = sigma**2
        self.bent, self.changed = ZERO, True
        # x of odom is where the vehicle heads: what the yaw errs by is in the attitude, reversed
        self.cov[5, 5] = vehicle.yaw_sigma**2
        self.cov[5, 14] = self.cov[14, 5] = -vehicle.yaw_sigma**2

    def grow(self, T: float, C_nb: Floats, way_n: Vector, turn_n: Vector, axes_n: Floats,
             doubt: float = 0.0, gaps: Sequence[float] = ()) -> None:
        """
        Carry the errors over an interval.

        T : s.   C_nb : (3, 3) in its middle.   way_n, turn_n : m, rad.
        axes_n : (3, 3) columns forward, left, up.   doubt : m^2, variance of uncertain travel.
        gaps : s, parts of the interval without IMU data.
        """
        F = EYE.copy()
        cross = skewed(way_n)
        F[P, PHI], F[P, K], F[P, M] = -cross, way_n, -cross @ C_nb[:, 1:]
        F[PHI, BG], F[PHI, G] = C_nb * -T, plus(ZERO, turn_n, -1.0)
        F[P, BG], F[P, G] = cross @ C_nb * (T / 2), cross @ turn_n / 2
        tilts = self.cov[ROTATIONS, ROTATIONS].tolist()
        self.bent = plus(self.bent, way_n, min(BEND * sum(tilts), MOST_BENT))
        cov = F @ self.cov @ F.T
        along, left, up = self.road(math.hypot(*way_n))
        hidden = sum(HIDDEN_IN_GAP * gap * min(1.0, gap / HIDING_GAP)**2 for gap in gaps)
        cov[P, P] += axes_n * [along + doubt, left, up] @ axes_n.T
        if hidden:
            cov[P, P] += cross @ cross.T * hidden**2
        cov[ALL, ALL] += self._walks * T
        cov[ROTATIONS, ROTATIONS] += hidden**2
        self.cov, self.changed = cov, True

    @staticmethod
    def road(path_length: float) -> Vector:
        """Return the variance of travel by slip and sideslip along, left and up, m^2."""
        along, left, up = ROAD_PER_METRE
        return along**2 * abs(path_length), left**2 * abs(path_length), up**2 * abs(path_length)

    def lost(self, path_length: float) -> None:
        """Add travel, m, of unknown direction."""
        self.cov[POSITIONS, POSITIONS] += path_length**2
        self.changed = True

    def turned(self, variance: Floats) -> None:
        """Add the variance of an unknown turn, (3, 3) rad^2 in n."""
        self.cov[PHI, PHI] += variance / max(1.0, float(np.trace(variance)) / np.pi**2)
        self.changed = True

    def by_gravity(self, C_nb: Floats, off_n: Floats, T: float, sigma: float) -> Floats | None:
        """
        Return the correction, (16,), by the level part of force less acceleration, m/s^2.

        off_n : (3,).   C_nb : (3, 3) over the T s that it is the mean of.   sigma : m/s^2, beside
        the sensor's. At rest sigma is 0: a force that the errors do not explain then has
        driving's. None, and nothing is taken, where not even that explains it, or the upward part
        is not that of gravity.
        """
        if abs(off_n[2]) > MOST_FORCE_OFF:      # in g, without gravity, upside down
            return None
        H = np.zeros((2, N))
        H[0, 4], H[1, 3] = -GRAVITY, GRAVITY
        H[:, BA] = C_nb[:2]
        noise = self.grade.accel_noise**2 / T
        explained = np.diag(H @ self.cov @ H.T) + noise + sigma**2
        if not (off_n[:2]**2 < FAULT_SIGMAS**2 * explained).all():
            sigma = max(sigma, SHAKING)
            if not (off_n[:2]**2 < FAULT_SIGMAS**2 * (explained + sigma**2)).all():
                return None
        return self._correction(H, off_n[:2], np.eye(2) * (noise + sigma**2), BY_GRAVITY)

    def by_rest(self, rate_b: Floats, variance: Floats) -> Floats:
        """
        Return the correction by a mean turn rate at rest, rad/s, bias taken out.

        One that is off by more than the errors explain says first that the bias may be off so.
        """
        H = np.zeros((3, N))
        H[:, BG] = np.eye(3)
        off = rate_b**2 > FAULT_SIGMAS**2 * (np.diag(self.cov)[BG] + variance)
        self.cov[BIASES, BIASES] += np.where(off, rate_b**2, 0.0)
        return self._correction(H, rate_b, np.diag(variance), BY_REST)

    def _correction(self, H: Floats, z: Floats, R: Floats, observed: list[int] | Ints) -> Floats:
        cov = self.cov
        S = H @ cov @ H.T + R
        gain = np.zeros((N, len(z)))
        gain[observed] = np.linalg.solve(S, H @ cov)[:, observed].T
        keep = np.eye(N) - gain @ H
        self.cov, self.changed = keep @ cov @ keep.T + gain @ R @ gain.T, True
        return gain @ z

    def pose_and_twist(self, C_nb: Matrix, arm_n: Vector, twist_b: Floats, T: float) -> Floats:
        """
        Return the covariances of pose and twist of the vehicle by the errors: (2, 6, 6).

        Of the pose those of position, m, and rotation, rad, in n.   arm_n : m, from the odometer's
        point to what the position is of.   twist_b : (6, 3), from a turn rate in b to the twist,
        the mean over T s.
        """
        J, out = POSE.copy(), np.empty((2, 6, 6))
        J[3:, M] = [row[1:] for row in C_nb]
        J[:3, 3:] = -skewed(arm_n) @ J[3:, 3:]
        out[0] = J @ self.cov @ J.T
        out[0, :3, :3] += np.outer(self.bent, self.bent)
        # two rotations leave half their product about the third axis
        a, b, c = self.cov[ROTATIONS, ROTATIONS].tolist()
        out[0, ROTATIONS, ROTATIONS] += [b * c / 4, a * c / 4, a * b / 4]
        out[1] = twist_b @ (self.cov[BG, BG] + AXES * (self.grade.gyro_noise**2 / T)) @ twist_b.T
        self.changed = False
        return out
