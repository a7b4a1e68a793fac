# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Dead reckoning with a calibration, sample by sample, corrected by gravity and at standstill.

In: the start, and the streams of IMU and wheels. Out: poses with covariances. Without
``levelling``, equal samples, start attitude and bias give the path of ``nav/dead_reckoning.py``.
With it, the accelerometer corrects the tilt, and standstills correct the gyro bias.
"""

from collections.abc import Sequence
from itertools import pairwise
import math

import numpy as np

from odocal_ros.apply.attitude import (
    add_scaled,
    cross,
    Matrix,
    Quaternion,
    quaternion_product,
    rotate_vector,
    rotation,
    rotation_increment,
    rotation_matrix,
    Vector,
    ZERO,
)
from odocal_ros.apply.delay_search import DelaySearch
from odocal_ros.apply.errors import BA, BG, DRIVING_FORCE, force_mismatch_text, GRAVITY, PHI
from odocal_ros.apply.odometry_start import Start
from odocal_ros.apply.pose import covariances, mean_velocity_variances, pack_pose, Pose
from odocal_ros.apply.stream import IMU_GAP_INTERVALS, ImuStream, INTERVAL_ROWS
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.apply.wheels import Wheels
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.standstill import REST_TURN
from odocal_ros.settings.levels import FASTEST
from odocal_ros.settings.node_configs import ApplyConfig

# judgement, s: between corrections; averaging time of a speed; silence of the odometer after which
# only the attitude continues; longest IMU gap in which the force is used
CORRECTION_PERIOD, SPEED_SPAN, ODOMETER_SILENCE, FORCE_GAP = 1.0, 0.2, 10.0, 0.1
# judgement: number of consecutive mismatches of force and motion after which the attitude is
# invalid, if the size of the force differs from gravity by less than this, m/s^2
MAX_MISMATCHES, GRAVITY_TOLERANCE = 10, 1.0
MAX_OLD_ROWS = 200        # judgement: IMU rows before the path; the oldest are dropped
MAX_PERIOD_CHANGE = 0.1     # judgement: relative; after a larger one covariances are recomputed
NO_TURN = np.zeros(3)     # definition: rad, value of ``_implausible_turn`` if there is none
MAX_TILT_SIGMA = 0.5      # rad; judgement: a larger one is beyond a linearised correction


class DeadReckoning:
    """Path from a start; ``failed`` is the cause if it cannot continue, else empty."""

    def __init__(self, start: Start, imu: ImuStream, wheels: Wheels, vehicle: Vehicle,
                 config: ApplyConfig, notes: list[str], delay_sigma: float) -> None:
        self.imu, self.wheels, self.vehicle, self.config = imu, wheels, vehicle, config
        self._notes, self.failed, self._delay = notes, '', DelaySearch(SPEED_SPAN, delay_sigma)
        imu.drop(start.row)
        # state at the time _t, s, of an IMU row; _s : travel, m
        self._t, self._s = imu.rows[imu.path_row].t, wheels.travel_at(imu.rows[imu.path_row].t)
        self.q: Quaternion = tuple(start.q_nb.tolist())     # attitude of b in n
        self._C_nb = rotation_matrix(self.q)
        self.bias: Vector = tuple(start.gyro_bias.tolist())
        self.accel_bias, self.errors = ZERO, start.errors
        self.position = ZERO      # m, of the odometer's point, relative to the start
        self._earth_rate_n: Vector = start.earth_rate_n.tolist()
        self._forward_b: Vector = vehicle.forward_b.tolist()
        self._arm_b, self._q_bv = vehicle.arm_b.tolist(), vehicle.q_bv.tolist()
        self._start_arm_n = rotate_vector(self._C_nb, self._arm_b)
        # since the last pose: time and travel there, turn, rad, variance of travel, m^2; interval
        # for which the covariances were computed last, s
        self._t_pose, self._s_pose, self._turn_b = self._t, self._s, ZERO
        self._travel_variance = self._covariance_interval = 0.0
        # since the last correction: time and velocity there, integral of the force, m/s, turn
        # rates, rad/s
        self._t_corrected, self._v_corrected = self._t, self._velocity_n()
        self._dv_n, self._force_is_usable = ZERO, True
        self._rates: list[Vector] = []
        self._was_resting, self._mismatch_count, self._implausible_turn = False, 0, NO_TURN
        # m/s in n: velocity at the start plus changes by turns
        self._turned_velocity_n: Vector = tuple(self._v_corrected.tolist())
        self._clock_step = self._permanent_step = 0.0      # s, clock steps: newest, and permanent

    def poses(self, clock_step: float = 0.0, permanent_step: float = 0.0) -> list[Pose]:
        """
        Return the poses that are due and whose samples have arrived.

        clock_step, permanent_step : s, by the last STEP_ROWS and PERMANENT_ROWS of a topic.
        """
        poses: list[Pose] = []
        if permanent_step and not self._permanent_step:
            self._notes.append(f'the stamps are shifted by {permanent_step:.2g} s relative to '
                               'their arrival times; the position sigma is increased. Likely '
                               'cause: a clock was set, or messages are late')
        self._permanent_step = max(self._permanent_step, permanent_step)
        clock_step = max(self._permanent_step, clock_step)
        self.errors.has_changed |= clock_step != self._clock_step
        self._clock_step = clock_step
        while not self.failed and (last := self._next_pose_row()) is not None:
            self._advance(last)
            if self.failed:
                break
            if self._t <= self.wheels.end_time():
                pose = self._pose()
                if not pose.is_valid():
                    self.failed = 'a value of the pose is not finite'
                    break
                poses.append(pose)
            self._correct_periodically()
            if last > MAX_OLD_ROWS:
                self.imu.drop(last - INTERVAL_ROWS)
                self.wheels.forget(self._t - 2 * CORRECTION_PERIOD)
        return poses

    def next_pose_time(self) -> float:
        """Return the earliest time of the next pose, s."""
        return self._t_pose + 1 / self.config.publish.rate - 1e-6

    def _next_pose_row(self) -> int | None:
        """Return the IMU row of the next pose, None until all its samples have arrived."""
        imu, rows = self.imu, self.imu.rows
        last = imu.from_time(self.next_pose_time(), imu.path_row + 1)
        return last if last < len(rows) - 1 and (      # a cubic needs the next sample
            rows[last].t <= self.wheels.end_time()
            or rows[-1].t - rows[last].t >= ODOMETER_SILENCE) else None

    def _advance(self, last: int) -> None:
        """Integrate attitude and travel up to a row of the IMU."""
        imu, first = self.imu, self.imu.path_row
        low = max(first - 1, 0)      # a cubic needs the samples before and after
        rows = imu.rows[low:last + 2]
        path_rows = rows[first - low:-1]
        t, w = [row.t for row in rows], [add_scaled(row.w_b, self.bias, -1.0) for row in rows]
        f = [add_scaled(row.f_b, self.accel_bias, -1.0) for row in path_rows]
        s = [self.wheels.travel_at(row.t) for row in path_rows]
        gaps = [b.t - a.t for a, b in pairwise(path_rows)]
        dropped_travel, self._s = abs(s[0] - self._s), s[-1]
        C_nb, turn_b, travel_n, dv_n = self._C_nb, ZERO, ZERO, ZERO
        forward_n, f_n = rotate_vector(C_nb, self._forward_b), rotate_vector(C_nb, f[0])
        for k, T in enumerate(gaps):
            phi = rotation_increment(t, w, first - low + k)
            C_nb = self._rotate(phi, T)
            forward_before, forward_n = forward_n, rotate_vector(C_nb, self._forward_b)
            f_before, f_n = f_n, rotate_vector(C_nb, f[k + 1])
            turn_b = add_scaled(turn_b, phi)
            travel_n = add_scaled(travel_n, add_scaled(forward_before, forward_n),
                                  (s[k + 1] - s[k]) / 2)
            dv_n = add_scaled(dv_n, add_scaled(f_before, f_n), T / 2)
        self._C_nb, self.position = C_nb, add_scaled(self.position, travel_n)
        self._dv_n = add_scaled(self._dv_n, dv_n)
        T, turn_n = t[-2] - self._t, rotate_vector(C_nb, turn_b)
        long_gaps = [gap for gap in gaps if gap > IMU_GAP_INTERVALS * imu.median_interval]
        travel_variance = self.wheels.variance_between(self._t, t[-2])
        self._travel_variance += travel_variance
        self.errors.add_interval(T, C_nb, travel_n, turn_n, travel_variance, long_gaps)
        self._turned_velocity_n = add_scaled(
            self._turned_velocity_n, cross(turn_n, travel_n), 1 / T)
        self._add_turn_variance([row.implausible_rate for row in path_rows[1:]], gaps)
        if dropped_travel > self.wheels.quantum:
            self.errors.add_travel(dropped_travel)
        is_plausible = self._implausible_turn is NO_TURN and max(gaps) <= FORCE_GAP
        self._force_is_usable &= is_plausible and math.isfinite(sum(dv_n))
        self._turn_b = add_scaled(self._turn_b, turn_b)
        self._rates += [row.w_b for row in path_rows[1:]]
        self._t, imu.path_row = t[-2], last

    def _rotate(self, phi: Vector, T: float) -> Matrix:
        """Rotate the attitude by phi, rad, in b, and by the Earth over T s; return C_nb."""
        self.q = quaternion_product(self.q, rotation(phi))
        if any(self._earth_rate_n):
            self.q = quaternion_product(rotation(add_scaled(ZERO, self._earth_rate_n, -T)), self.q)
        return rotation_matrix(self.q)

    def _add_turn_variance(self, rates: list[Vector], gaps: list[float]) -> None:
        """Add the variance of implausible turn rates in b, rad/s, each over a gap, s."""
        if all(rate is ZERO for rate in rates):
            self._implausible_turn = NO_TURN
            return
        C_nb = np.array(self._C_nb)
        if self._implausible_turn is NO_TURN:
            self._notes.append(f'the turn rate jumps by {np.max(rates):.2g} rad/s in one sample, '
                               'more than a vehicle can turn; the attitude sigma is increased')
        turn = self._implausible_turn + np.array(gaps) @ rates
        self.errors.add_turn(C_nb @ np.diag(turn**2 - self._implausible_turn**2) @ C_nb.T)
        self._implausible_turn = turn
        if np.sqrt(self.errors.cov[[3, 4], [3, 4]].max()) > MAX_TILT_SIGMA:
            self.failed = f'the sigma of the tilt exceeds {MAX_TILT_SIGMA:g} rad'

    def _velocity_n(self) -> Floats:
        """Return the velocity of the IMU by odometer and turn rate, (3,) m/s."""
        vehicle, C_nb = self.vehicle, np.array(self._C_nb)
        travel = self._s - self.wheels.travel_at(self._t - SPEED_SPAN)
        arm_b = vehicle.C_vb.T @ self.config.imu.lever_arm + vehicle.arm_b      # to the IMU
        rate = add_scaled(self.imu.rows[self.imu.path_row].w_b, self.bias, -1.0)
        return C_nb @ (vehicle.forward_b * travel / SPEED_SPAN + cross(rate, arm_b.tolist()))

    def _correct_periodically(self) -> None:
        """Correct tilt by gravity and bias at standstill, and estimate the delay, every period."""
        T = self._t - self._t_corrected
        if T < CORRECTION_PERIOD - 1e-6:
            return
        velocity, w = self._velocity_n(), np.array(self._rates)
        has_travel = self._t <= self.wheels.end_time()
        is_resting = has_travel and self.wheels.are_still(self._t_corrected, self._t) and bool(
            (w.std(axis=0) < REST_TURN).all()
            and (np.abs(w.mean(axis=0) - self.bias) < REST_TURN).all())
        # the first period of a standstill may contain the end of braking
        is_standing = is_resting and self._was_resting
        if self.config.levelling and has_travel and self._force_is_usable:
            self._level(velocity, T, w, is_standing)
        if self.config.levelling and is_standing:
            variance = np.maximum(self.errors.grade.gyro_noise**2 / T, w.var(axis=0) / len(w))
            rate_b = w.mean(axis=0) - self.bias - np.transpose(self._C_nb) @ self._earth_rate_n
            self._correct(self.errors.correct_by_rest(rate_b, variance))
        change_n = velocity - self._v_corrected if has_travel and self._force_is_usable else None
        forward_n = rotate_vector(self._C_nb, self._forward_b)
        if note := self._delay.add(forward_n, change_n, self._dv_n, T):
            self._notes.append(note)
            self.errors.has_changed = True
        self._was_resting = is_resting
        self._t_corrected, self._v_corrected = self._t, self._velocity_n()
        self._dv_n, self._force_is_usable, self._rates = ZERO, True, []

    def _level(self, velocity: Floats, T: float, w: Floats, is_standing: bool) -> None:
        """Correct the tilt by the mean force of the last T s minus the change of ``velocity``."""
        residual_n = (np.array(self._dv_n) - velocity + self._v_corrected) / T - [0, 0, GRAVITY]
        variance = self.wheels.variance_between(self._t_corrected, self._t)
        # m/s^2, of the odometer's acceleration: counts, and travel that is not measured
        noise = 2 * np.hypot(self.wheels.quantum / SPEED_SPAN / T, np.sqrt(variance) / T**2)
        correction = self.errors.correct_by_gravity(
            np.array(self._C_nb), residual_n, T,
            0.0 if is_standing and not variance else np.hypot(DRIVING_FORCE, noise))
        if correction is None:
            self._add_mismatch(residual_n, velocity, T, w)
            return
        self._mismatch_count = 0
        self._correct(correction)
        # error of the linearisation for a large correction
        self.errors.add_turn(np.eye(3) * np.sum(correction[PHI]**2)**2 / 4)

    def _add_mismatch(self, residual_n: Floats, velocity: Floats, T: float, w: Floats) -> None:
        """Note that force and odometer disagree; increase the variances for the last T s."""
        self._mismatch_count += 1
        self._notes.append(force_mismatch_text(residual_n))
        self.errors.add_turn(np.eye(3) * np.sum((w.mean(axis=0) - self.bias)**2) * T**2)
        self.errors.add_travel(min(float(np.linalg.norm(residual_n[:2])) * T**2 / 2,
                                   float(np.linalg.norm(velocity - self._v_corrected)) * T))
        force = float(np.linalg.norm(self._dv_n)) / T
        if self._mismatch_count >= MAX_MISMATCHES and abs(force - GRAVITY) < GRAVITY_TOLERANCE:
            self.failed = f'specific force and attitude disagree for {self._mismatch_count} s'

    def _correct(self, correction: Floats) -> None:
        """Correct attitude and biases by a correction of the error state, (16,)."""
        self.q = quaternion_product(rotation(correction[PHI].tolist()), self.q)
        self._C_nb = rotation_matrix(self.q)
        self.bias = add_scaled(self.bias, correction[BG].tolist())
        self.accel_bias = add_scaled(self.accel_bias, correction[BA].tolist())

    def _pose(self) -> Pose:
        """Return the pose at this time, with the mean twist since the last one."""
        T, C_bn = self._t - self._t_pose, tuple(zip(*self._C_nb, strict=True))
        arm_n = rotate_vector(self._C_nb, self._arm_b)
        rate_b = add_scaled(add_scaled(ZERO, self._turn_b, 1 / T),
                            rotate_vector(C_bn, self._earth_rate_n), -1.0)
        twist_by_turn, speed = self.vehicle.twist_by_turn(rate_b), (self._s - self._s_pose) / T
        if abs(speed) > FASTEST:
            self._notes.append(f'the speed is {speed:.0f} m/s; the limit is {FASTEST:.0f} m/s. '
                               'Likely cause: the calibration is of another odometer or unit')
        change = abs(T - self._covariance_interval)
        if self.errors.has_changed or change > MAX_PERIOD_CHANGE * self._covariance_interval:
            self._covariance_interval = T
            self._covariances = self._uncertainty(T, speed, arm_n, rate_b, twist_by_turn)
        self._t_pose, self._s_pose = self._t, self._s
        self._turn_b, self._travel_variance = ZERO, 0.0
        return Pose(self.imu.rows[self.imu.path_row].stamp_ns, pack_pose(
            add_scaled(add_scaled(self.position, arm_n), self._start_arm_n, -1.0),
            quaternion_product(self.q, self._q_bv),
            (twist_by_turn[0] + speed, *twist_by_turn[1:]), self._covariances))

    def _uncertainty(self, T: float, speed: float, arm_n: Vector, rate_b: Vector,
                     twist_by_turn: Sequence[float]) -> list[bytes]:
        """Return the covariances of pose and twist after T s, as in a message."""
        forward_n = rotate_vector(self._C_nb, self._forward_b)
        # a delay changes the position by delay times the change of velocity by accelerations along
        # the path; a clock step also changes the time of the pose
        delay_sigma = math.hypot(self._delay.sigma_s, self._clock_step, self.wheels.delay_sigma_s)
        delay_effect = (*add_scaled(ZERO, add_scaled(self._turned_velocity_n, forward_n, -speed),
                                    delay_sigma),
                        *add_scaled(ZERO, rotate_vector(self._C_nb, rate_b), self._clock_step))
        travel_variance, increment_variance = self.wheels.variances(self._t, T)
        increment_variance += self._travel_variance
        return covariances(
            self.errors.pose_and_twist(self._C_nb, arm_n, self.vehicle.twist_b, T), delay_effect,
            add_scaled(ZERO, forward_n, math.sqrt(travel_variance)),
            [self.errors.grade.gyro_scale_sigma * component for component in twist_by_turn],
            mean_velocity_variances(self.vehicle, speed, T, increment_variance))
