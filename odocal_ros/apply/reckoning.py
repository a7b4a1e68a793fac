# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Dead reckoning with the strapdown of the calibration, corrected at stops.

From one IMU sample to the next attitude is turned by the calibration's rotation increments
(``nav/strapdown.py``) and travel summed by the trapezoid rule along the calibrated forward axis,
as ``nav/dead_reckoning.py`` has it: with ``levelling`` off the path of equal samples, start
attitude and bias is that of a replay. With it, the accelerometer holds the tilt, and stops the
gyro bias; the position never jumps.
"""

import numpy as np

from odocal_ros.apply.attitude import cross, matrix_of, product, turned
from odocal_ros.apply.errors import BA, BG, GRAVITY, PHI, SHAKING
from odocal_ros.apply.pose import Pose, pose_covariance, twist_covariance
from odocal_ros.apply.start import Start
from odocal_ros.apply.stream import HOLE_INTERVALS, ImuStream
from odocal_ros.apply.vehicle import Vehicle
from odocal_ros.apply.wheels import Wheels
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.rotations import matrix_from_quat, quat_from_rotvec, quat_multiply
from odocal_ros.nav.standstill import REST_TURN
from odocal_ros.nav.strapdown import rotation_increments
from odocal_ros.settings.apply_config import ApplyConfig
from odocal_ros.settings.levels import FASTEST

# judgement, all in s: between corrections; that a speed is taken over; without odometer, after
# which attitude continues alone; without IMU, that hide motion
CORRECTION_PERIOD, SPEED_SPAN, ODOMETER_SILENCE, IMU_HOLE = 1.0, 0.2, 10.0, 0.1
# judgement: corrections in turn that force and motion disagree at, after which the attitude is
# false; m/s^2 that the force is then as long as gravity to
MOST_APART, AS_GRAVITY = 10, 1.0
GROW_PERIOD = 0.05        # s; judgement: in which a covariance hardly grows
TILT_LOST = 0.5           # rad; judgement: sigma beyond which a straight line levels nothing


class Reckoning:
    """
    A path from a start.

    ``failed`` is the cause why it cannot continue, for people; empty as long as it can.
    """

    def __init__(self, start: Start, imu: ImuStream, wheels: Wheels, vehicle: Vehicle,
                 config: ApplyConfig, notes: list[str], delay_sigma: float) -> None:
        self.imu, self.wheels, self.vehicle, self.config = imu, wheels, vehicle, config
        self._notes, self._delay_sigma, self.failed = notes, delay_sigma, ''
        self.q, self.bias, self.errors = start.q_nb, start.gyro_bias, start.errors
        self.accel_bias = np.zeros(3)
        self.position = np.zeros(3)      # of the odometer's point, from where it began
        self.imu.drop(start.row)
        self._earth_n = start.earth_n
        self._t = self._t_pose = self._t_look = float(self.imu.t[self.imu.at])
        self._s = self._s_pose = float(self.wheels.at(self._t))
        self._C_nb = matrix_of(self.q)
        self._turn_b, self._felt_n, self._felt = np.zeros(3), np.zeros(3), True
        self._T_grow, self._way_grow, self._turn_grow = 0.0, np.zeros(3), np.zeros(3)
        self._w_look: list[Floats] = []
        self._rested, self._apart, self._strange_turn = False, 0, np.zeros(3)
        self._v_look = self._velocity_n(self._t)
        self._swung = self._v_look           # m/s in n, at the start, and what turns added
        self._moved = self._stays = 0.0      # s, by which a clock moved, and for good
        self._arm0_n = matrix_from_quat(self.q) @ self.vehicle.C_vb.T @ self.vehicle.lever_arm

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
        self._moved = max(self._stays, moved)
        while not self.failed and (last := self._next()) is not None:
            received = self.imu.t[last] <= self.wheels.newest()
            self._advance(last)
            if self.failed:
                break
            if received:
                out.append(self._pose())
                if not out[-1].sound():
                    del out[-1]
                    self.failed = 'the pose was not finite'
                    break
            self._look()
            self._leave_behind(last)
        return out

    def due(self) -> bool:
        """Return True if the odometer has reached the next pose."""
        return self.wheels.newest() > self._t_pose + 1 / self.config.publish.rate - 1e-6

    def _next(self) -> int | None:
        """Return the row to advance to: a pose is due and all it needs has come; else None."""
        t, at = self.imu.t, self.imu.at
        period = 1 / self.config.publish.rate
        last = int(np.searchsorted(t, self._t_pose + period - 1e-6))
        last = max(last, at + 1)
        if last > len(t) - 2:            # a cubic needs the sample beyond
            return None
        if t[last] > self.wheels.newest() and t[-1] - t[last] < ODOMETER_SILENCE:
            return None
        return last

    def _advance(self, last: int) -> None:
        """Go to a row of the IMU."""
        imu, at = self.imu, self.imu.at
        low = max(at - 1, 0)
        t = imu.t[low:last + 2]
        phi = rotation_increments(t, imu.w_b[low:last + 2] - self.bias)
        phi = phi[:, at - low:last - low]
        t = imu.t[at:last + 1]
        s, gaps = self.wheels.at(t), np.diff(t)
        lost, self._s = abs(float(s[0]) - self._s), float(s[-1])
        f_b = imu.f_b[at:last + 1] - self.accel_bias
        way_n = np.zeros(3)
        f_n = self._C_nb @ f_b[0]
        for k, (T, step) in enumerate(zip(gaps.tolist(), np.diff(s).tolist(), strict=True)):
            C_before, f_before = self._C_nb, f_n
            self._turn(phi[:, k], T)
            way_n += (C_before + self._C_nb) @ self.vehicle.forward_b * (step / 2)
            f_n = self._C_nb @ f_b[k + 1]
            self._felt_n += (f_before + f_n) * (T / 2)
        self.position = self.position + way_n
        turn_b, strange = phi.sum(axis=1), imu.strange[at + 1:last + 1]
        self._grow(float(t[-1] - t[0]), way_n, turn_b, gaps[gaps > HOLE_INTERVALS * imu.usual],
                   self.wheels.doubt(t[0], t[-1]))
        self._swung = self._swung + cross(self._C_nb @ turn_b, way_n) / float(t[-1] - t[0])
        self._doubt_turn(strange, gaps, self._C_nb)
        if lost > self.wheels.quantum:
            self.errors.lost(lost)
        self._felt &= bool(np.isfinite(f_b).all()) and gaps.max() <= IMU_HOLE and not (
            self._strange_turn.any())
        self._turn_b = self._turn_b + turn_b
        self._w_look.append(imu.w_b[at + 1:last + 1])
        self._t, imu.at = float(t[-1]), last

    def _turn(self, phi: Floats, T: float) -> None:
        """Turn the attitude by a rotation vector of b, rad, over T s."""
        q = turned(self.q, phi)
        if self._earth_n.any():
            q = quat_multiply(quat_from_rotvec(-T * self._earth_n), q)
        self.q, self._C_nb = q, matrix_of(q)

    def _grow(self, T: float, way_n: Floats, turn_b: Floats, gaps: Floats, doubt: float) -> None:
        """Carry the errors over T s, at once where data are uncertain, else every GROW_PERIOD."""
        self._T_grow += T
        self._way_grow = self._way_grow + way_n
        self._turn_grow = self._turn_grow + self._C_nb @ turn_b
        if self._T_grow > GROW_PERIOD - 1e-6 or doubt or len(gaps):
            C_nb = self._C_nb
            self.errors.grow(self._T_grow, C_nb, self._way_grow, self._turn_grow,
                             C_nb @ self.vehicle.C_vb.T, doubt, gaps)
            self._T_grow, self._way_grow, self._turn_grow = 0.0, np.zeros(3), np.zeros(3)

    def _doubt_turn(self, strange: Floats, gaps: Floats, C_nb: Floats) -> None:
        """Add variance for implausible turn rates: (n, 3) rad/s over n gaps of s, in b."""
        if not strange.any():
            self._strange_turn = np.zeros(3)
            return
        if not self._strange_turn.any():
            self._notes.append(f'the gyro jumps in one sample by {strange.max():.2g} rad/s, more '
                              'than a vehicle can turn: the gyro is down-weighted')
        turn = self._strange_turn + gaps @ strange
        self.errors.turned(C_nb @ np.diag(turn**2 - self._strange_turn**2) @ C_nb.T)
        self._strange_turn = turn
        if np.sqrt(self.errors.cov[[3, 4], [3, 4]].max()) > TILT_LOST:
            self.failed = 'the tilt is no longer known'

    def _velocity_n(self, t: float) -> Floats:
        """Return the velocity of the IMU in n, by the odometer's last rows."""
        v, C_nb = self.vehicle, self._C_nb
        now, before = self.wheels.at(np.array([t, t - SPEED_SPAN]))
        arm_b = v.C_vb.T @ (np.asarray(self.config.imu.lever_arm) - v.lever_arm)
        rate = self.imu.w_b[self.imu.at] - self.bias
        velocity: Floats = C_nb @ (
            v.forward_b * (now - before) / SPEED_SPAN + cross(rate, arm_b))
        return velocity

    def _look(self) -> None:
        """Correct tilt and gyro bias, a second after the last time."""
        T = self._t - self._t_look
        if T < CORRECTION_PERIOD - 1e-6:
            return
        velocity, received = self._velocity_n(self._t), self._t <= self.wheels.newest()
        w = np.concatenate(self._w_look)
        resting = received and self.wheels.still(self._t_look, self._t) and bool(
            (w.std(axis=0) < REST_TURN).all()
            and (np.abs(w.mean(axis=0) - self.bias) < REST_TURN).all())
        # a rest that begins with this look may begin with the last of the braking
        standing = resting and self._rested
        if self.config.levelling and received and self._felt:
            off_n = (self._felt_n - velocity + self._v_look) / T - [0.0, 0.0, GRAVITY]
            doubt = self.wheels.doubt(self._t_look, self._t)      # changes the speed in T
            noise = 2 * np.hypot(self.wheels.quantum / SPEED_SPAN / T, np.sqrt(doubt) / T**2)
            by = self.errors.by_gravity(
                self._C_nb, off_n, T,
                0.0 if standing and not doubt else np.hypot(SHAKING, noise))
            if by is None:
                self._take_apart(off_n[:2], velocity, T, w)
            else:
                self._apart = 0
                self._correct(by)
                # what a straight line takes of a large angle it may miss by as much
                self.errors.turned(np.eye(3) * np.sum(by[PHI]**2)**2 / 4)
        if self.config.levelling and standing:
            variance = np.maximum(self.errors.grade.gyro_noise**2 / T, w.var(axis=0) / len(w))
            earth_b = self._C_nb.T @ self._earth_n
            self._correct(self.errors.by_rest(w.mean(axis=0) - self.bias - earth_b, variance))
        self._rested = resting
        self._t_look, self._v_look = self._t, self._velocity_n(self._t)
        self._felt_n, self._felt, self._w_look = np.zeros(3), True, []

    def _take_apart(self, off_n: Floats, velocity: Floats, T: float, w: Floats) -> None:
        """
        Increase the variance of the last T s if IMU and odometer disagree.

        off_n : (2,) m/s^2, force less acceleration.   velocity : (3,) m/s.   w : (n, 3) rad/s.
        """
        self._apart += 1
        self._notes.append('specific force and odometer motion differ by '
                          f'{np.linalg.norm(off_n):.3g} m/s^2: IMU or odometer is faulty; not '
                          'used for levelling')
        self.errors.turned(np.eye(3) * np.sum((w.mean(axis=0) - self.bias)**2) * T**2)
        self.errors.lost(min(float(np.linalg.norm(off_n)) * T**2 / 2,
                             float(np.linalg.norm(velocity - self._v_look)) * T))
        length = float(np.linalg.norm(self._felt_n)) / T
        if self._apart >= MOST_APART and abs(length - GRAVITY) < AS_GRAVITY:
            self.failed = f'specific force and attitude have disagreed for {self._apart} s'

    def _correct(self, by: Floats) -> None:
        self.q = quat_multiply(quat_from_rotvec(by[PHI]), self.q)
        self._C_nb = matrix_of(self.q)
        self.bias = self.bias + by[BG]
        self.accel_bias = self.accel_bias + by[BA]

    def _pose(self) -> Pose:
        """Return the pose at the row reached."""
        v, T = self.vehicle, self._t - self._t_pose
        C_nb, C_vb = self._C_nb, v.C_vb
        arm_n = -C_nb @ C_vb.T @ v.lever_arm
        earth_b = C_nb.T @ self._earth_n
        rate = C_vb @ (self._turn_b / T - earth_b)
        speed = (self._s - self._s_pose) / T
        velocity = cross(v.lever_arm, rate)
        velocity[0] += speed
        if abs(speed) > FASTEST:
            self._notes.append(f'{speed:.0f} m/s is implausible: the calibration belongs to '
                              'another odometer or unit')
        quantum, jitter = self.wheels.quantum, self.wheels.jitter(self._t, T)
        doubt = self.wheels.doubt(self._t - T, self._t)
        pose = Pose(int(self.imu.stamp_ns[self.imu.at]), self.position + arm_n + self._arm0_n,
                    product(self.q, v.q_bv), velocity, rate,
                    self._late(speed, C_nb @ (self._turn_b / T - earth_b)) + pose_covariance(
                        v, self.errors, C_nb, arm_n,
                        quantum**2 / 6 + self.wheels.between(self._t) + jitter / 2),
                    twist_covariance(v, self.errors, speed, rate, T, quantum**2 / 6 + doubt
                                     + jitter))
        self._t_pose, self._s_pose, self._turn_b = self._t, self._s, np.zeros(3)
        return pose

    def _late(self, speed: float, rate_n: Floats) -> Floats:
        """
        Return the covariance of a pose, (6, 6), by the times of odometer and IMU.

        speed : m/s.   rate_n : (3,) rad/s.   A delay shifts travel by what accelerations along
        the path changed of the velocity; a clock that moved shifts the time of the pose too.
        """
        way_n = self._C_nb @ self.vehicle.forward_b * speed - self._swung
        off = np.concatenate([way_n * np.hypot(self._delay_sigma, self._moved),
                              rate_n * self._moved])
        return np.outer(off, off)

    def _leave_behind(self, last: int) -> None:
        """Forget what lies behind."""
        if last > 2000:
            self.imu.drop(last - 2)
            self.wheels.forget(self._t - 2 * CORRECTION_PERIOD)
