# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The unknowns of the smoother: states at the keyframes, (S1), and constants, (S2) of docs/method.md.

``State`` has their values. This module also defines where each unknown is in a step: P, V, ...
are its columns in the BLOCK of a keyframe, LN_K, YAW, ... its indices in CONSTANTS, which are the
same at all keyframes of a leg. The attitude has three columns: a rotation vector phi in n, which
multiplies the estimate, C_nb = exp(phi) C_hat.
"""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import accumulate

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.dead_reckoning import forward_b, mounting_from_forward
from odocal_ros.nav.rotations import exp_so3, skew

# unknowns of a keyframe, and their numbers. Travel error: of the odometer reading, in scale units
# (pulses, rad, or m of a speed), bounded by rounding; slow fix error: the time-correlated one
BLOCK = {'position': 3, 'velocity': 3, 'attitude error': 3, 'gyro bias': 3,
         'accelerometer bias': 3, 'travel error': 1, 'slow fix error, ENU': 3}
P, V, PHI, BG, BA, TRAVEL, SLOW = (slice(end - size, end) for size, end in zip(
    BLOCK.values(), accumulate(BLOCK.values()), strict=True))
E = TRAVEL.start
# columns of a block: the slow fix error is an unknown if gnss.correlation_time is not 0
SIZE_WITHOUT_SLOW, SIZE_WITH_SLOW = SLOW.start, SLOW.stop

# Errors of the IMU's axes: (axis with the error, signal that it contains), (S3). Signals of the
# gyro are (w_x, w_y, w_z, f_x, f_y), of the accelerometer (f_x, f_y, f_z); f_z in x and y is a
# bias of a level IMU, not of one mounted at an angle. Three of the 18 are zero by the definition
# of the axes: z is the axis of turns on level ground, x the direction of a force that the y
# accelerometer does not measure.
GYRO_ERRORS = {
    'gyro_scale_z': (2, 2), 'gyro_scale_x': (0, 0), 'gyro_scale_y': (1, 1),
    'gyro_axis_xy': (0, 1), 'gyro_axis_yx': (1, 0), 'gyro_axis_zx': (2, 0), 'gyro_axis_zy': (2, 1),
    'gyro_x_by_force_x': (0, 3), 'gyro_x_by_force_y': (0, 4), 'gyro_y_by_force_x': (1, 3),
    'gyro_y_by_force_y': (1, 4), 'gyro_z_by_force_x': (2, 3), 'gyro_z_by_force_y': (2, 4)}
ACCEL_ERRORS = {
    'accelerometer_scale_x': (0, 0), 'accelerometer_scale_y': (1, 1),
    'accelerometer_scale_z': (2, 2), 'accelerometer_axis_xy': (0, 1),
    'accelerometer_axis_zx': (2, 0), 'accelerometer_axis_zy': (2, 1),
    'accelerometer_axis_xz': (0, 2), 'accelerometer_axis_yz': (1, 2)}
GYRO_AXIS, GYRO_SIGNAL = zip(*GYRO_ERRORS.values(), strict=True)
ACCEL_AXIS, ACCEL_SIGNAL = zip(*ACCEL_ERRORS.values(), strict=True)

CONSTANTS = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle',
             'odometer_lever_arm_x', 'odometer_lever_arm_y', 'odometer_lever_arm_z',
             'antenna_lever_arm_x', 'antenna_lever_arm_y', 'antenna_lever_arm_z',
             'odometer_delay', 'gnss_delay', 'heading_offset', 'fix_motion_time',
             *GYRO_ERRORS, *ACCEL_ERRORS,
             'fix_lag_square', 'fix_error_by_motion', 'gnss_clock_rate', 'odometer_clock_rate',
             'odometer_lag_square',
             'scale_by_speed', 'scale_by_time', 'scale_by_pull', 'scale_by_braking',
             'scale_by_left_force', 'scale_by_curvature', 'scale_by_pitching',
             'squat', 'dive', 'squat_by_jerk', 'sideslip', 'sideslip_by_jerk',
             'pitch_centre', 'pitch_centre_of_bumps', 'pitch_centre_in_turns',
             'body_centre_height', 'sway_by_force', 'lift_by_turning', 'mean_roll',
             'fix_height_drift', 'fix_error_east', 'fix_error_north', 'fix_error_up',
             'speed_offset', 'velocity_delay', 'velocity_lag_square', 'velocity_scale',
             'pressure_offset', 'pressure_drift', 'pressure_by_speed_square', 'pressure_scale')


def constants_from(first: str, last: str | None = None) -> slice:
    """Return the slice of constants from ``first`` to ``last``, included; None: of one."""
    return slice(CONSTANTS.index(first), CONSTANTS.index(first if last is None else last) + 1)


LN_K, YAW, PITCH = map(CONSTANTS.index, ('scale_factor', 'yaw_mounting_angle',
                                         'pitch_mounting_angle'))
# corrections of the configured lever arms, base_link axes, m
ODO_ARM = constants_from('odometer_lever_arm_x', 'odometer_lever_arm_z')
GNSS_ARM = constants_from('antenna_lever_arm_x', 'antenna_lever_arm_z')
# delays of the stamps, s; error of an external heading, rad
ODO_DELAY, GNSS_DELAY, HEADING = map(CONSTANTS.index, ('odometer_delay', 'gnss_delay',
                                                       'heading_offset'))
GYRO = constants_from('gyro_scale_z', 'gyro_z_by_force_y')
ACCEL = constants_from('accelerometer_scale_x', 'accelerometer_axis_yz')
# s^2, filter of the receiver: squared time constant of a mean of the past, or, below zero, of a
# filter of position and velocity, (S16), (S16b) (nav/receiver_filter.py)
FIX_LAG2 = CONSTANTS.index('fix_lag_square')
# m/s: rate of a height error that changes over a longer time than a leg
HEIGHT_DRIFT = CONSTANTS.index('fix_height_drift')
# fix errors per stated sigma, east, north, up: they decrease as a receiver converges (S15a)
FIX_ERROR_BY_SIGMA = constants_from('fix_error_east', 'fix_error_up')
FIX_ERRORS = constants_from('fix_height_drift', 'fix_error_up')
# relative: rate of the clock of its stamps minus that of the IMU
GNSS_CLOCK, ODO_CLOCK = map(CONSTANTS.index, ('gnss_clock_rate', 'odometer_clock_rate'))
# s^2: squared time constant of a low-pass filter of the odometer speed
ODO_LAG2 = CONSTANTS.index('odometer_lag_square')
# an odometer inside the receiver, (S16a): its relative scale error, and the logarithm of the time
# constant, s, with which satellites correct its positions
FIX_BY_MOTION, FIX_MOTION_TIME = map(CONSTANTS.index, ('fix_error_by_motion', 'fix_motion_time'))
# relative change of the scale from its mean over the path, (S11): with the square of the speed
# (its slope at FAST_SPEED, s/m), with time as tyres warm (its rate at the start of the leg, 1/s),
# with traction and braking, 1/(m/s^2): a wheel that is not driven only brakes; with the force to
# the left, as turns load or unload a wheel; and with half the squared curvature, m^2:
# -x^2 of a steered wheel at x ahead, -x^2 / 2 of the mean of four wheels
TYRES = constants_from('scale_by_speed', 'scale_by_curvature')
SCALE_BY_SPEED, SCALE_BY_TIME, SCALE_BY_LEFT_FORCE, SCALE_BY_CURVATURE = map(CONSTANTS.index, (
    'scale_by_speed', 'scale_by_time', 'scale_by_left_force', 'scale_by_curvature'))
FAST_SPEED = 20.0           # m/s, definition: at which the slope is stated, a country road
# relative change of the path per half the mean square of the body pitch in an interval, (S11a): 1
# if the axle keeps its direction, 0 if it follows the body, negative if bumps are shorter than the
# wheelbase
SCALE_BY_PITCHING = CONSTANTS.index('scale_by_pitching')
# pitch and yaw of the forward axis due to acceleration forward (from traction, from braking) and
# left, rad per m/s^2, and to its rate of change, rad per m/s^3, (S12): a body reacts with a delay
PITCH_LEAN = constants_from('squat', 'squat_by_jerk')
YAW_LEAN = constants_from('sideslip', 'sideslip_by_jerk')
# displacements of the axle due to the tilt of the body, (S12): points about which it pitches, m
# ahead of the odometer: on hills; on bumps, in addition; in turns on banked ground, for the
# turn rate about its own left axis. Height above the odometer, m, of the centre about which it
# tilts on its springs; its sway there under lateral force, m per m/s^2. Lift of the axle in turns,
# m/rad: the third point times the mean roll of the ground, (S12)
BODY_TILT = constants_from('pitch_centre', 'lift_by_turning')
LIFT = constants_from('lift_by_turning')
# rad, left side up: mean roll of the ground of a leg. The mean attitude minus this roll determines
# the roll of the IMU in the vehicle
MEAN_ROLL = CONSTANTS.index('mean_roll')
# constants of the ground of a leg
GROUND = constants_from('lift_by_turning', 'mean_roll')
# constants of C_bv, in the order of its derivatives
AXES = (YAW, PITCH, MEAN_ROLL)
# constants that other legs do not share: those of its ground and its fixes
LEG_CONSTANTS = constants_from('lift_by_turning', 'fix_error_up')
# deviations from ideal sensors and an ideal vehicle, (S28)
IMPERFECTIONS = constants_from('gyro_scale_z', 'sway_by_force')
# their kinds, with one common size each: numbers of constants
KIND_SIZES = {'gyro_scale': 3, 'gyro_axis': 4, 'gyro_by_force': 6, 'accelerometer_scale': 3,
              'accelerometer_axis': 5, 'fix_lag_square': 1, 'fix_error_by_motion': 1,
              'clock_rate': 2, 'odometer_lag_square': 1,
              'scale_by_speed': 1, 'scale_by_time': 1, 'scale_by_force': 2,
              'scale_by_left_force': 1, 'scale_by_curvature': 1, 'scale_by_pitching': 1,
              'squat': 2, 'squat_by_jerk': 1, 'sideslip': 1, 'sideslip_by_jerk': 1,
              'pitch_centre': 2, 'pitch_centre_in_turns': 1, 'body_centre_height': 1,
              'sway_by_force': 1}
KIND_OF = np.repeat(np.arange(len(KIND_SIZES)), list(KIND_SIZES.values()))    # of IMPERFECTIONS
# scale units per s: offset of a quantised speed, half a step if it is truncated
SPEED_OFFSET = CONSTANTS.index('speed_offset')
# GNSS velocity: delay of its stamps, s, squared time constant of the receiver's filter, s^2, and
# relative scale error
VELOCITY = constants_from('velocity_delay', 'velocity_scale')
VELOCITY_DELAY, VELOCITY_LAG2, VELOCITY_SCALE = range(VELOCITY.start, VELOCITY.stop)
# heights from air pressure, (S19a): zero, m; weather, m/s; dynamic pressure, m per (m/s)^2; air
# temperature, relative
PRESSURE = constants_from('pressure_offset', 'pressure_scale')
M = len(CONSTANTS)      # number of constants c, (S2): (M,) in the shapes of arrays
NO_ERROR = 1e-12    # definition: prior sigma of a constant that is fixed, in any unit


@dataclass(frozen=True, eq=False)
class State:
    """Values of all unknowns; position, velocity, attitude and biases are those of the IMU."""

    t: Floats             # (N,) s, times of the keyframes
    p_n: Floats           # (N, 3) m
    v_n: Floats           # (N, 3) m/s
    C_nb: Floats          # (N, 3, 3) from b, the IMU's axes, to n: east, north, up at the origin
    gyro_bias: Floats     # (N, 3) rad/s, in b
    accel_bias: Floats    # (N, 3) m/s^2, in b
    travel_error: Floats  # (N,) scale units
    slow_n: Floats        # (N, 3) m, time-correlated fix error
    constants: Floats     # (M,) in the order of CONSTANTS, ln K first
    # (3,) up axis of n in b, mean of the leg, which gives the roll of the IMU in the vehicle
    up_b: Floats = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    @cached_property
    def scale(self) -> float:
        """Return the scale factor K, metres per scale unit."""
        return float(np.exp(self.constants[LN_K]))

    @cached_property
    def forward(self) -> Floats:
        """Return the forward axis in b: (3,)."""
        return forward_b(self.constants[YAW], self.constants[PITCH])

    @cached_property
    def C_bv(self) -> Floats:
        """Return the rotation from vehicle to body axes: (3, 3)."""
        return vehicle_axes(self.forward, self.up_b, self.constants[MEAN_ROLL])

    @cached_property
    def C_bv_level(self) -> Floats:
        """Return C_bv without the mean roll: (3, 3)."""
        return vehicle_axes(self.forward, self.up_b, 0.0)

    def keyframe_arrays(self) -> dict[str, Floats]:
        """Return the arrays with a row for each keyframe, by field name."""
        return {f.name: getattr(self, f.name) for f in fields(self)
                if f.name not in ('constants', 'up_b')}

    def with_mean_up(self) -> 'State':
        """Return the state with ``up_b`` computed from its attitudes."""
        return replace(self, up_b=self.C_nb[:, 2].mean(axis=0))

    @cached_property
    def C_bv_gradient(self) -> tuple[Floats, Floats, Floats]:
        """Return the derivatives of C_bv by AXES: yaw, pitch and mean roll: three (3, 3)."""
        yaw, pitch = self.constants[[YAW, PITCH]]
        cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
        forward, left, _ = self.C_bv_level.T
        length = np.linalg.norm(np.cross(self.up_b, forward))
        roll = exp_so3(np.array([self.constants[MEAN_ROLL], 0.0, 0.0]))

        def gradient(d_forward: Floats) -> Floats:
            """Return the derivative of C_bv from that of the forward axis."""
            d_left = np.cross(self.up_b, d_forward) / length
            d_left = d_left - left * (left @ d_left)
            return np.stack([d_forward, d_left, np.cross(d_forward, left)
                             + np.cross(forward, d_left)], -1) @ roll
        return (gradient(np.array([-sy * cp, -cy, -sy * sp])),
                gradient(np.array([-cy * sp, 0.0, cy * cp])),
                self.C_bv @ skew(np.array([1.0, 0.0, 0.0])))

    def updated(self, step: Floats, step_constants: Floats) -> 'State':
        """Return the state after a step of every unknown: (N, n), (M,)."""
        slow = self.slow_n + step[:, SLOW] if step.shape[1] > SIZE_WITHOUT_SLOW else self.slow_n
        return replace(
            self, p_n=self.p_n + step[:, P], v_n=self.v_n + step[:, V],
            C_nb=exp_so3(step[:, PHI]) @ self.C_nb, gyro_bias=self.gyro_bias + step[:, BG],
            accel_bias=self.accel_bias + step[:, BA],
            travel_error=self.travel_error + step[:, E], slow_n=slow,
            constants=limit_pitch(self.constants + step_constants))


def limit_pitch(constants: Floats) -> Floats:
    """Return constants with the same forward axis and a pitch within 90 deg."""
    # far from the solution a step may move the pitch beyond it, which inverts the lever arms
    if abs(constants[PITCH]) <= np.pi / 2:
        return constants
    out = constants.copy()
    out[YAW], out[PITCH] = mounting_from_forward(forward_b(constants[YAW], constants[PITCH]))
    return out


def vehicle_axes(forward: Floats, up: Floats, roll: float) -> Floats:
    """
    Return the axes forward, left, up of the vehicle in columns, C_bv: (3, 3).

    forward, up : (3,) in b; up : that of n.   roll : rad, left side up.
    """
    left = np.cross(up, forward)
    left = left / np.linalg.norm(left)
    level = np.stack([forward, left, np.cross(forward, left)], -1)
    return level @ exp_so3(np.array([roll, 0.0, 0.0]))


@dataclass(frozen=True, eq=False)
class Priors:
    """Priors of the biases at the first keyframe, with mean zero, and of the constants, (S21)."""

    gyro_bias_sigma: Floats      # (3,) rad/s
    accel_bias_sigma: Floats     # (3,) m/s^2
    sigma: Floats                # (M,) of the constants, inf: no prior, NO_ERROR: fixed
    mean: Floats                 # (M,) of the constants

    @property
    def used_count(self) -> int:
        """Return the number of constants up to the last one that is not fixed."""
        return int(np.flatnonzero(self.sigma > NO_ERROR)[-1]) + 1
