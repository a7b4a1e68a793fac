# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Dead reckoning with the strapdown of the calibration, corrected at stops.

From one IMU sample to the next attitude is turned by the calibration's rotation increments
(``apply/attitude.py``) and travel summed by the trapezoid rule along the calibrated forward axis,
as ``nav/dead_reckoning.py`` has it: with ``levelling`` off the path of equal samples, start
attitude and bias is that of a replay. With it, the tilt is corrected by the accelerometer, the
gyro bias at standstill; the position never jumps.
"""

from collections.abc import Sequence
from itertools import pairwise
import math

import numpy as np

from odocal_ros.apply.attitude import (
    cross,
    Matrix,
    matrix_of,
    plus,
    product,
    Quaternion,
    rotated,
    rotation,
    rotation_increment,
    Vector,
    ZERO,
)
from odocal_ros.apply.delay import DelaySearch
from odocal_ros.apply.errors import BA, BG, GRAVITY, PHI, SHAKING
from odocal_ros.apply.pose import covariances, numbers_of, Pose, velocity_variances
from odocal_ros.apply.start import Start
from odocal_ros.apply.stream import HOLE_INTERVALS, ImuStream, INTERVAL_ROWS
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.apply.wheels import Wheels
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.standstill import REST_TURN
from odocal_ros.settings.levels import FASTEST
from odocal_ros.settings.node_configs import ApplyConfig

# judgement, all in s: between corrections; of a speed; without odometer, until attitude continues
# alone; without IMU, that hide motion
CORRECTION_PERIOD, SPEED_SPAN, ODOMETER_SILENCE, IMU_HOLE = 1.0, 0.2, 10.0, 0.1
# judgement: corrections in turn that force and motion disagree at, after which the attitude is
# false; m/s^2 that the force is then as long as gravity to
MOST_APART, AS_GRAVITY = 10, 1.0
ROWS_BEHIND = 200         # judgement: of the IMU, before they are dropped
# judgement: s in which a covariance hardly grows; share that an interval may differ by meanwhile
GROW_PERIOD, AS_LONG = 0.05, 0.1
PLAUSIBLE = np.zeros(3)   # rad: no turn is implausible
TILT_LOST = 0.5           # rad; judgement: sigma beyond which a straight line levels nothing


class Reckoning:
    """
    A path from a start.

    ``failed`` is the cause why it cannot continue, for people; empty as long as it can.
    """

    def __init__(self, start: Start, imu: ImuStream, wheels: Wheels, vehicle: Vehicle,
                 config: ApplyConfig, notes: list[str], delay_sigma: float) -> None:
        self.imu, self.wheels, self.vehicle, self.config = imu, wheels, vehicle, config
        self._notes, self.failed = notes, ''
        self._delay = DelaySearch(SPEED_SPAN, delay_sigma, notes)
        self.q: Quaternion = tuple(start.q_nb.tolist())
        self.bias: Vector = tuple(start.gyro_bias.tolist())
        self.accel_bias, self.errors = ZERO, start.errors
        self.position = ZERO      # of the odometer's point, from where it began
        self.imu.drop(start.row)
        self._earth_n, self._forward_b = start.earth_n.tolist(), vehicle.forward_b.tolist()
        self._arm_b, self._q_bv = vehicle.arm_b.tolist(), vehicle.q_bv.tolist()
        self._t = self._t_pose = self._t_look = self.imu.rows[self.imu.at].t
        self._s = self._s_pose = self.wheels.at(self._t)
        self._C_nb = matrix_of(self.q)
        self._turn_b, self._dv_n, self._levels = ZERO, ZERO, True
        self._T_grow, self._way_grow, self._turn_grow = 0.0, ZERO, ZERO
        self._w_look: list[Vector] = []
        self._rested, self._apart, self._strange_turn = False, 0, PLAUSIBLE
        self._v_look = self._velocity_n(self._t)
        self._swung: Vector = tuple(self._v_look.tolist())      # m/s in n, at the start, by turns
        self._moved = self._stays = 0.0      # s, by which a clock moved, and for good
        self._doubt = self._T_cov = 0.0      # m^2, of the travel since the last pose; s
        self._arm0_n = rotated(self._C_nb, self._arm_b)

    def poses(self, moved: float = 0.0, stays: float = 0.0) -> list[Pose]:
        """
        Return the poses that what has come since the last call allows.

        moved, stays : s, by which a clock moved, as the last rows show it, and for good.
        """
        out: list[Pose] = []
        if stays and not self._stays:
            self._notes.append(f'stamps moved by {stays:.2g} s against their arrival times: a '
                               'clock was set, or messages are late; sigma increased')
        self._stays = max(self._stays, stays)
        moved = max(self._stays, moved)
        self.errors.changed |= moved != self._moved
        self._moved = moved
        while not self.failed and (last := self._next()) is not None:
            received = self.imu.rows[last].t <= self.wheels.newest()
            self._advance(last)
            if self.failed:
                break
            if received:
                pose = self._pose()
                if not pose.sound():
                    self.failed = 'the pose was not finite'
                    break
                out.append(pose)
            self._look()
            if last > ROWS_BEHIND:      # those that determine the usual interval are kept
                self.imu.drop(last - INTERVAL_ROWS)
                self.wheels.forget(self._t - 2 * CORRECTION_PERIOD)
        return out

    def lacking_s(self) -> float:
        """Return by how many s the odometer has not reached the next pose."""
        return self._t_pose + 1 / self.config.publish.rate - 1e-6 - self.wheels.newest()

    def _next(self) -> int | None:
        """Return the row to advance to: a pose is due and all it needs has come; else None."""
        rows, due = self.imu.rows, self._t_pose + 1 / self.config.publish.rate - 1e-6
        last = self.imu.from_time(due, self.imu.at + 1)
        return last if last < len(rows) - 1 and (      # a cubic needs the sample beyond
            rows[last].t <= self.wheels.newest()
            or rows[-1].t - rows[last].t >= ODOMETER_SILENCE) else None

    def _advance(self, last: int) -> None:
        """Go to a row of the IMU."""
        imu, at = self.imu, self.imu.at
        low = max(at - 1, 0)      # a cubic needs the sample before and the one beyond
        rows = imu.rows[low:last + 2]
        own = rows[at - low:-1]
        t, w = [row.t for row in rows], [plus(row.w_b, self.bias, -1.0) for row in rows]
        f = [plus(row.f_b, self.accel_bias, -1.0) for row in own]
        s = [self.wheels.at(row.t) for row in own]
        gaps = [b.t - a.t for a, b in pairwise(own)]
        lost, self._s = abs(s[0] - self._s), s[-1]
        C_nb, turn_b, way_n, dv_n = self._C_nb, ZERO, ZERO, ZERO
        forward_n, f_n = rotated(C_nb, self._forward_b), rotated(C_nb, f[0])
        for k, T in enumerate(gaps):
            phi = rotation_increment(t, w, at - low + k)
            C_nb = self._turn(phi, T)
            forward_before, forward_n = forward_n, rotated(C_nb, self._forward_b)
            f_before, f_n = f_n, rotated(C_nb, f[k + 1])
            turn_b = plus(turn_b, phi)
            way_n = plus(way_n, plus(forward_before, forward_n), (s[k + 1] - s[k]) / 2)
            dv_n = plus(dv_n, plus(f_before, f_n), T / 2)
        self._C_nb, self.position = C_nb, plus(self.position, way_n)
        self._dv_n = plus(self._dv_n, dv_n)
        T, turn_n = t[-2] - self._t, rotated(C_nb, turn_b)
        self._grow(T, way_n, turn_n, [gap for gap in gaps if gap > HOLE_INTERVALS * imu.usual],
                   self.wheels.doubt(self._t, t[-2]))
        self._swung = plus(self._swung, cross(turn_n, way_n), 1 / T)
        self._doubt_turn([row.strange for row in own[1:]], gaps)
        if lost > self.wheels.quantum:
            self.errors.lost(lost)
        calm = self._strange_turn is PLAUSIBLE and max(gaps) <= IMU_HOLE
        self._levels &= calm and math.isfinite(sum(dv_n))
        self._turn_b = plus(self._turn_b, turn_b)
        self._w_look += [row.w_b for row in own[1:]]
        self._t, imu.at = t[-2], last

    def _turn(self, phi: Vector, T: float) -> Matrix:
        """Turn the attitude by a rotation vector of b, rad, over T s; return its matrix."""
        self.q = product(self.q, rotation(phi))
        if any(self._earth_n):
            self.q = product(rotation(plus(ZERO, self._earth_n, -T)), self.q)
        return matrix_of(self.q)

    def _grow(self, T: float, way_n: Vector, turn_n: Vector, gaps: list[float],
              doubt: float) -> None:
        """Carry the errors over T s, at once where data are uncertain, else every GROW_PERIOD."""
        self._T_grow, self._doubt = self._T_grow + T, self._doubt + doubt
        self._way_grow = plus(self._way_grow, way_n)
        self._turn_grow = plus(self._turn_grow, turn_n)
        if self._T_grow > GROW_PERIOD - 1e-6 or doubt or gaps:
            C_nb = np.array(self._C_nb)
            self.errors.grow(self._T_grow, C_nb, self._way_grow, self._turn_grow,
                             C_nb @ self.vehicle.C_vb.T, doubt, gaps)
            self._T_grow, self._way_grow, self._turn_grow = 0.0, ZERO, ZERO

    def _doubt_turn(self, strange: list[Vector], gaps: list[float]) -> None:
        """Add variance for implausible turn rates of b, rad/s, over gaps of s."""
        if all(size is ZERO for size in strange):
            self._strange_turn = PLAUSIBLE
            return
        C_nb = np.array(self._C_nb)
        if self._strange_turn is PLAUSIBLE:
            self._notes.append(f'the gyro jumps in one sample by {np.max(strange):.2g} rad/s, '
                              'more than a vehicle can turn: the gyro is down-weighted')
        turn = self._strange_turn + np.array(gaps) @ strange
        self.errors.turned(C_nb @ np.diag(turn**2 - self._strange_turn**2) @ C_nb.T)
        self._strange_turn = turn
        if np.sqrt(self.errors.cov[[3, 4], [3, 4]].max()) > TILT_LOST:
            self.failed = 'the tilt is no longer known'

    def _velocity_n(self, t: float) -> Floats:
        """Return the velocity of the IMU in n, by the odometer's last rows."""
        v, C_nb = self.vehicle, np.array(self._C_nb)
        moved = self.wheels.at(t) - self.wheels.at(t - SPEED_SPAN)
        arm_b = v.C_vb.T @ self.config.imu.lever_arm + v.arm_b
        rate = plus(self.imu.rows[self.imu.at].w_b, self.bias, -1.0)
        return C_nb @ (v.forward_b * moved / SPEED_SPAN + cross(rate, arm_b.tolist()))

    def _look(self) -> None:
        """Correct tilt and gyro bias, a second after the last time."""
        T = self._t - self._t_look
        if T < CORRECTION_PERIOD - 1e-6:
            return
        velocity, received = self._velocity_n(self._t), self._t <= self.wheels.newest()
        w = np.array(self._w_look)
        resting = received and self.wheels.still(self._t_look, self._t) and bool(
            (w.std(axis=0) < REST_TURN).all()
            and (np.abs(w.mean(axis=0) - self.bias) < REST_TURN).all())
        # a rest that begins with this look may begin with the last of the braking
        standing = resting and self._rested
        if self.config.levelling and received and self._levels:
            off_n = (np.array(self._dv_n) - velocity + self._v_look) / T - [0.0, 0.0, GRAVITY]
            doubt = self.wheels.doubt(self._t_look, self._t)      # changes the speed in T
            noise = 2 * np.hypot(self.wheels.quantum / SPEED_SPAN / T, np.sqrt(doubt) / T**2)
            by = self.errors.by_gravity(
                np.array(self._C_nb), off_n, T,
                0.0 if standing and not doubt else np.hypot(SHAKING, noise))
            if by is None:
                self._take_apart(off_n, velocity, T, w)
            else:
                self._apart = 0
                self._correct(by)
                # what a straight line takes of a large angle it may miss by as much
                self.errors.turned(np.eye(3) * np.sum(by[PHI]**2)**2 / 4)
        if self.config.levelling and standing:
            variance = np.maximum(self.errors.grade.gyro_noise**2 / T, w.var(axis=0) / len(w))
            rate_b = w.mean(axis=0) - self.bias - np.transpose(self._C_nb) @ self._earth_n
            self._correct(self.errors.by_rest(rate_b, variance))
        self.errors.changed |= self._delay.take(
            rotated(self._C_nb, self._forward_b),
            velocity - self._v_look if received and self._levels else None, self._dv_n, T)
        self._rested = resting
        self._t_look, self._v_look = self._t, self._velocity_n(self._t)
        self._dv_n, self._levels, self._w_look = ZERO, True, []

    def _take_apart(self, off_n: Floats, velocity: Floats, T: float, w: Floats) -> None:
        """Increase the variance of the last T s: force less acceleration, m/s^2, is too large."""
        self._apart += 1
        self._notes.append('specific force and odometer motion differ by '
                          f'{np.linalg.norm(off_n):.3g} m/s^2: IMU or odometer is faulty; not '
                          'used for levelling')
        self.errors.turned(np.eye(3) * np.sum((w.mean(axis=0) - self.bias)**2) * T**2)
        self.errors.lost(min(float(np.linalg.norm(off_n[:2])) * T**2 / 2,
                             float(np.linalg.norm(velocity - self._v_look)) * T))
        length = float(np.linalg.norm(self._dv_n)) / T
        if self._apart >= MOST_APART and abs(length - GRAVITY) < AS_GRAVITY:
            self.failed = f'specific force and attitude have disagreed for {self._apart} s'

    def _correct(self, by: Floats) -> None:
        self.q = product(rotation(by[PHI].tolist()), self.q)
        self._C_nb, self.bias = matrix_of(self.q), plus(self.bias, by[BG].tolist())
        self.accel_bias = plus(self.accel_bias, by[BA].tolist())

    def _pose(self) -> Pose:
        """Return the pose at the row reached."""
        T, C_bn = self._t - self._t_pose, tuple(zip(*self._C_nb, strict=True))
        arm_n = rotated(self._C_nb, self._arm_b)
        rate_b = plus(plus(ZERO, self._turn_b, 1 / T), rotated(C_bn, self._earth_n), -1.0)
        swing, speed = self.vehicle.swing(rate_b), (self._s - self._s_pose) / T
        if abs(speed) > FASTEST:
            self._notes.append(f'{speed:.0f} m/s is implausible: the calibration belongs to '
                              'another odometer or unit')
        if self.errors.changed or abs(T - self._T_cov) > AS_LONG * self._T_cov:
            self._T_cov, self._covariances = T, self._uncertainty(T, speed, arm_n, rate_b, swing)
        self._t_pose, self._s_pose, self._turn_b, self._doubt = self._t, self._s, ZERO, 0.0
        return Pose(self.imu.rows[self.imu.at].stamp_ns, numbers_of(
            plus(plus(self.position, arm_n), self._arm0_n, -1.0), product(self.q, self._q_bv),
            (swing[0] + speed, *swing[1:]), self._covariances))

    def _uncertainty(self, T: float, speed: float, arm_n: Vector, rate_b: Vector,
                     swing: Sequence[float]) -> Floats:
        """
        Return the covariances of pose and twist after T s: (2, 36).

        speed : m/s.   arm_n : m.   rate_b : rad/s.   swing : 6 m/s, rad/s, twist by turns.
        A delay shifts travel by what accelerations along the path changed of the velocity; a
        clock that moved shifts the time of the pose too.
        """
        forward_n = rotated(self._C_nb, self._forward_b)
        delay = math.hypot(self._delay.sigma_s, self._moved, self.wheels.delay_s)
        late = (*plus(ZERO, plus(self._swung, forward_n, -speed), delay),
                *plus(ZERO, rotated(self._C_nb, rate_b), self._moved))
        now, since = self.wheels.variances(self._t, T)
        return covariances(
            self.errors.pose_and_twist(self._C_nb, arm_n, self.vehicle.twist_b, T), late,
            plus(ZERO, forward_n, math.sqrt(now)),
            [self.errors.grade.gyro_scale_error * one for one in swing],
            velocity_variances(self.vehicle, speed, T, since + self._doubt))
