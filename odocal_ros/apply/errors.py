# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Covariance of dead reckoning: position, attitude, sensors and calibration.

Error model, with the estimates on the right: true attitude = exp(phi) * attitude, phi in n (the
odom frame); true turn rate = (1 - g) * (reading - bias); true travel = (1 + k) * travel, along an
axis rotated by m in b. The errors of position, scale, mounting and gyro scale contribute to the
covariance, but are never corrected: the pose does not jump, and the calibration stays unchanged.
"""

from collections.abc import Sequence
import math

import numpy as np

from odocal_ros.apply.attitude import add_scaled, Matrix, Vector, ZERO
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.nav.rotations import skew
from odocal_ros.settings.levels import FAULT_SIGMAS
from odocal_ros.settings.nominal import Grade

# definition: indices in the error state of position, attitude, gyro and accelerometer bias
P, PHI, BG, BA = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
# definition: of scale, mounting (pitch, yaw) and gyro scale; number of errors
K, M, G, N = 12, slice(13, 15), 15, 16
# definition: indices of errors that gravity corrects (not heading), and a turn rate at rest
GRAVITY_ERRORS, REST_ERRORS = [3, 4, 6, 7, 9, 10], np.r_[3:9]
# definition: P, PHI, BG and all as index arrays, for entries of the diagonal
POSITIONS, ROTATIONS, BIASES, ALL = np.r_[P], np.r_[PHI], np.r_[BG], np.arange(N)
EYE, AXES = np.eye(N), np.eye(3)
POSE_JACOBIAN = np.eye(6, N)       # definition: position and attitude of the IMU by error state
PROPAGATION_PERIOD = 0.05      # s, judgement: between propagations of the covariance
# judgement: m/sqrt(m), slip and sideslip: along, left, up
SLIP_PER_METRE = (0.005, 0.01, 0.01)
# judgement: rad/s, sigma of an unmeasured turn rate in a gap of the IMU; s, in shorter gaps the
# turn decreases with the cube of the gap
GAP_RATE, GAP_TIME = 0.1, 0.1
# m/s^2; judgement: sigma of accelerations that odometer data over a second or more do not measure
DRIVING_FORCE = 0.4
# physical: rad/sqrt(s), random walk of the tilt if the gyro bias contains the Earth rate, whose
# direction in b changes as the vehicle turns: 11 deg/h, constant for about half a minute
EARTH_TILT_WALK = 6e-4
# definition: error of travel by the cosine of an attitude error: m per m and rad^2, the rms of
# angle^2 / 2 of a normal angle; m per m, its limit, reached if the direction is unknown
SHORTENING, LARGEST_SHORTENING = 3**0.5 / 2, 2.0
GRAVITY = 9.81    # m/s^2; physical: more digits have no effect on the tilt
MAX_ACCELERATION = 5.0    # m/s^2; physical: half of g, largest mean over 1 s or 2 s


class Errors:
    """
    Covariance of the errors, (16, 16), and its updates by gravity and at standstill.

    grade : of the IMU.   tilt_sigma, bias_sigma : rad, rad/s, at the start.   earth_in_bias : True
    if the gyro bias contains the Earth rate.

    Attributes: shortening : (3,) m in n, second-order effect of attitude errors on the position.
    has_changed : True if the covariance has changed since the last ``pose_and_twist``.
    """

    def __init__(self, grade: Grade, vehicle: Vehicle, tilt_sigma: float,
                 bias_sigma: float | Floats, *, earth_in_bias: bool) -> None:
        self.grade, self._C_bv = grade, vehicle.C_vb.T
        # s, m, rad: duration, travel and turn since the last propagation
        self._pending_s, self._pending_travel, self._pending_turn = 0.0, ZERO, ZERO
        self._walks = np.zeros(N)      # variance per s
        self._walks[PHI] = grade.gyro_noise**2
        self._walks[3:5] += (EARTH_TILT_WALK * earth_in_bias)**2
        self._walks[BG], self._walks[BA] = grade.gyro_bias_walk**2, grade.accel_bias_walk**2
        self.cov = np.zeros((N, N))
        sigma = np.concatenate([
            np.zeros(3), [tilt_sigma, tilt_sigma, 0.0], np.broadcast_to(bias_sigma, 3),
            np.full(3, grade.accel_bias), [vehicle.scale_sigma, vehicle.pitch_sigma,
                                           vehicle.yaw_sigma, grade.gyro_scale_sigma]])
        self.cov[ALL, ALL] = sigma**2
        self.shortening, self.has_changed = ZERO, True
        # x of odom is the vehicle's forward axis at the start: the attitude has the error of the
        # mounting yaw with opposite sign
        self.cov[5, 5] = vehicle.yaw_sigma**2
        self.cov[5, 14] = self.cov[14, 5] = -vehicle.yaw_sigma**2

    def add_interval(self, T: float, C_nb: Matrix, travel_n: Vector, turn_n: Vector,
                     travel_variance: float = 0.0, gaps: Sequence[float] = ()) -> None:
        """
        Add an interval; propagate every PROPAGATION_PERIOD, or at once if data are uncertain.

        T : s.   C_nb : (3, 3), at its end.   travel_n, turn_n : (3,) m, (3,) rad.
        travel_variance : m^2, of travel that is not measured.   gaps : s, parts of the interval
        without IMU data.
        """
        self._pending_s += T
        self._pending_travel = add_scaled(self._pending_travel, travel_n)
        self._pending_turn = add_scaled(self._pending_turn, turn_n)
        if self._pending_s > PROPAGATION_PERIOD - 1e-6 or travel_variance or gaps:
            self._propagate(self._pending_s, np.array(C_nb), self._pending_travel,
                            self._pending_turn, travel_variance, gaps)
            self._pending_s, self._pending_travel, self._pending_turn = 0.0, ZERO, ZERO

    def _propagate(self, T: float, C_nb: Floats, travel_n: Vector, turn_n: Vector,
                   travel_variance: float, gaps: Sequence[float]) -> None:
        """Propagate the covariance over an interval; arguments as ``add_interval``."""
        F, axes_n = EYE.copy(), C_nb @ self._C_bv      # columns forward, left, up
        cross = skew(travel_n)
        F[P, PHI], F[P, K], F[P, M] = -cross, travel_n, -cross @ C_nb[:, 1:]
        F[PHI, BG], F[PHI, G] = C_nb * -T, add_scaled(ZERO, turn_n, -1.0)
        F[P, BG], F[P, G] = cross @ C_nb * (T / 2), cross @ turn_n / 2
        tilts = self.cov[ROTATIONS, ROTATIONS].tolist()
        self.shortening = add_scaled(self.shortening, travel_n,
                                     min(SHORTENING * sum(tilts), LARGEST_SHORTENING))
        cov = F @ self.cov @ F.T
        along, left, up = self.slip_variances(math.hypot(*travel_n))
        turn_sigma = sum(GAP_RATE * gap * min(1.0, gap / GAP_TIME)**2 for gap in gaps)
        cov[P, P] += axes_n * [along + travel_variance, left, up] @ axes_n.T
        if turn_sigma:
            cov[P, P] += cross @ cross.T * turn_sigma**2
        cov[ALL, ALL] += self._walks * T
        cov[ROTATIONS, ROTATIONS] += turn_sigma**2
        self.cov, self.has_changed = cov, True

    @staticmethod
    def slip_variances(path_length: float) -> Vector:
        """Return the variances of travel by slip and sideslip: along, left and up, m^2."""
        along, left, up = SLIP_PER_METRE
        return along**2 * abs(path_length), left**2 * abs(path_length), up**2 * abs(path_length)

    def add_travel(self, path_length: float) -> None:
        """Add the variance of travel, m, in an unknown direction."""
        self.cov[POSITIONS, POSITIONS] += path_length**2
        self.has_changed = True

    def add_turn(self, variance: Floats) -> None:
        """Add the variance of an unknown turn, (3, 3) rad^2 in n, at most half a turn."""
        self.cov[PHI, PHI] += variance / max(1.0, float(np.trace(variance)) / np.pi**2)
        self.has_changed = True

    def correct_by_gravity(self, C_nb: Floats, residual_n: Floats, T: float,
                           sigma: float) -> Floats | None:
        """
        Return the correction of the error state, (16,), by the measured direction of gravity.

        residual_n : (3,) m/s^2, mean of specific force minus acceleration minus gravity; its
        horizontal part is used.   C_nb : (3, 3).   T : s, duration of the mean.   sigma : m/s^2,
        of the acceleration, 0 at rest. A residual that exceeds its limit is tested again with
        DRIVING_FORCE as sigma. Returns None, without a correction, if it exceeds this limit too,
        or if the upward part is not gravity.
        """
        if abs(residual_n[2]) > MAX_ACCELERATION:      # unit g, no gravity, or upside down
            return None
        H = np.zeros((2, N))
        H[0, 4], H[1, 3] = -GRAVITY, GRAVITY
        H[:, BA] = C_nb[:2]
        noise = self.grade.accel_noise**2 / T
        explained = np.diag(H @ self.cov @ H.T) + noise + sigma**2
        if not (residual_n[:2]**2 < FAULT_SIGMAS**2 * explained).all():
            sigma = max(sigma, DRIVING_FORCE)
            if not (residual_n[:2]**2 < FAULT_SIGMAS**2 * (explained + sigma**2)).all():
                return None
        return self._correction(H, residual_n[:2], np.eye(2) * (noise + sigma**2), GRAVITY_ERRORS)

    def correct_by_rest(self, rate_b: Floats, variance: Floats) -> Floats:
        """
        Return the correction, (16,), by a mean turn rate at rest, (3,) rad/s, bias removed.

        If the rate exceeds its limit, the variance of the bias is increased first.
        """
        H = np.zeros((3, N))
        H[:, BG] = AXES
        is_inconsistent = rate_b**2 > FAULT_SIGMAS**2 * (np.diag(self.cov)[BG] + variance)
        self.cov[BIASES, BIASES] += np.where(is_inconsistent, rate_b**2, 0.0)
        return self._correction(H, rate_b, np.diag(variance), REST_ERRORS)

    def _correction(self, H: Floats, z: Floats, R: Floats, corrected: list[int] | Ints) -> Floats:
        """Return the Kalman correction, (16,), by z = H x with covariance R; others remain 0."""
        cov = self.cov
        S = H @ cov @ H.T + R
        gain = np.zeros((N, len(z)))
        gain[corrected] = np.linalg.solve(S, H @ cov)[:, corrected].T
        I_KH = EYE - gain @ H      # Joseph's form, valid for any gain
        self.cov, self.has_changed = I_KH @ cov @ I_KH.T + gain @ R @ gain.T, True
        return gain @ z

    def pose_and_twist(self, C_nb: Matrix, arm_n: Vector, twist_b: Floats, T: float) -> Floats:
        """
        Return the covariances of pose and twist of the vehicle by these errors: (2, 6, 6).

        The pose has position, m, and rotation, rad, in n.   arm_n : m, from the odometer's point
        to the point of the pose.   twist_b : (6, 3), turn rate in b to twist.   T : s, duration of
        the mean twist.
        """
        J = POSE_JACOBIAN.copy()
        J[3:, M] = [row[1:] for row in C_nb]
        J[:3, 3:] = -skew(arm_n) @ J[3:, 3:]
        pose = J @ self.cov @ J.T
        pose[:3, :3] += np.outer(self.shortening, self.shortening)
        # rotations about two axes cause half their product about the third
        a, b, c = self.cov[ROTATIONS, ROTATIONS].tolist()
        pose[ROTATIONS, ROTATIONS] += [b * c / 4, a * c / 4, a * b / 4]
        twist = twist_b @ (self.cov[BG, BG] + AXES * (self.grade.gyro_noise**2 / T)) @ twist_b.T
        self.has_changed = False
        return np.stack([pose, twist])


def force_mismatch_text(residual_n: Floats) -> str:
    """Return the text for a residual, (3,) m/s^2, that ``Errors.correct_by_gravity`` rejects."""
    return (f'IMU and odometer disagree: accelerations differ by {np.linalg.norm(residual_n):.3g} '
            f'm/s^2 (limits: {FAULT_SIGMAS:g} sigma horizontal, {MAX_ACCELERATION:g} m/s^2 '
            'vertical). Likely cause: slip or a sensor fault. This interval is not used for '
            'levelling')
