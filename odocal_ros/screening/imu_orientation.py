# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Orientation of an IMU in the vehicle by its accelerations, and checks of its units and axes.

The body frame must be forward-left-up within some degrees. If it is rotated by 90 or 180 deg, the
odometer disagrees with the IMU at each start, as if wheels spun. Forward is the direction of the
specific force when the vehicle accelerates; up is the direction of its median.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import bin_means, chunks, Complexes, Floats, lengths, map_rows, medians
from odocal_ros.nav.dead_reckoning import forward_b, mounting_from_forward
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import wrap
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import ImuConfig
from odocal_ros.settings.levels import RAD_PER_DEG
from odocal_ros.settings.nominal import G

BIN_S = 1.0                        # s, judgement: accelerations are compared as means over it
ORIENTATION_BINS = 20              # judgement: fewest bins; the sigma then has an error of 1/6
DIRECTIONS = 'forwards', 'to the right', 'backwards', 'to the left'     # by quarters of the yaw
AXES = 'xyz'
# no result from such an IMU; further reasons would repeat the cause
UNUSABLE = {Code.NO_IMU, Code.IMU_AXES, Code.IMU_UNITS}
ROUNDING = 1e-9                 # rad/s, definition: rounding of a zero rate by rotations
MAX_RATE = 8.0                  # rad/s, physical: vehicles on wheels turn more slowly
NO_GRAVITY = 0.01               # m/s^2, physical: far below gravity, in any unit


@dataclass(frozen=True, eq=False)
class Accelerations:
    """Specific force in the level plane and accelerations of the wheels, means over BIN_S."""

    e1: Floats           # (3,) level axes, in the frame of the IMU's data
    e2: Floats           # (3,)
    t: Floats            # (m,) s, middle of the bin
    force: Complexes     # (m,) m/s^2, by the IMU: along e1 + i times along e2
    forward: Floats      # (m,) m/s^2, acceleration by the odometer
    centripetal: Floats  # (m,) m/s^2, acceleration by odometer and gyro, positive to the left

    def __getitem__(self, rows: slice) -> 'Accelerations':
        return Accelerations(self.e1, self.e2, self.t[rows], self.force[rows],
                             self.forward[rows], self.centripetal[rows])

    def changes(self) -> 'Accelerations':
        """Return the changes from bin to adjacent bin: slopes, which change slowly, cancel."""
        adjacent = np.diff(self.t) < 1.5 * BIN_S
        return Accelerations(self.e1, self.e2, self.t[1:][adjacent], np.diff(self.force)[adjacent],
                             np.diff(self.forward)[adjacent], np.diff(self.centripetal)[adjacent])


@dataclass(frozen=True)
class ImuOrientation:
    """Yaw mounting angle by the accelerations, rad, and its sigma."""

    yaw: float
    sigma: float
    # ratio of force to centripetal acceleration, over that of force to forward acceleration, and
    # its sigma: 1 is correct, -1 if gyro or accelerometer has a mirrored axis
    centripetal: float = np.nan
    centripetal_sigma: float = np.nan


def bin_accelerations(t: Floats, w: Floats, f: Floats, up: Floats, travel: Travel,
                      metres_per_unit: float) -> Accelerations | None:
    """
    Return the accelerations of a drive, None if it is too short.

    t, w, f : (n,), (n, 3), (n, 3) times, s, turn rate, rad/s, and specific force, in any one frame
    fixed to the IMU.   up : (3,) unit vector, by gravity.   travel : odometer; positive means
    forward.   metres_per_unit : its approximate scale.
    """
    t0, t1 = max(t[0], travel.t[0]) + BIN_S, min(t[-1], travel.t[-1]) - BIN_S
    if t1 - t0 < ORIENTATION_BINS * BIN_S:
        return None
    edges = np.arange(t0, t1, BIN_S)
    count, (f, w) = bin_means(t, edges, f, w)
    turn_rate = w @ up
    speed = np.diff(travel.at(edges)) * metres_per_unit / BIN_S
    middle = (edges[:-1] + edges[1:]) / 2
    forward = (travel.at(middle + BIN_S) - 2 * travel.at(middle) + travel.at(middle - BIN_S)) \
        * metres_per_unit / BIN_S**2
    e1 = np.cross(up, np.eye(3)[int(np.argmin(np.abs(up)))])
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(up, e1)
    filled = np.flatnonzero(count)      # bins with rows
    return Accelerations(e1, e2, middle[filled], (f @ e1 + 1j * (f @ e2))[filled],
                         forward[filled], (speed * turn_rate)[filled])


def accelerations(inputs: Inputs, metres_per_unit: float) -> Accelerations | None:
    """Return the changes of the accelerations of a leg, None if it is too short."""
    up_b = inputs.up_b
    binned = bin_accelerations(inputs.t_imu, inputs.w_b, inputs.f_b, up_b, inputs.travel,
                               metres_per_unit) if up_b.any() else None
    return None if binned is None else binned.changes()


def estimate_orientation(inputs: Inputs, metres_per_unit: float) -> ImuOrientation | None:
    """Return the IMU orientation in the vehicle, None if the drive does not determine it."""
    binned = accelerations(inputs, metres_per_unit)
    return None if binned is None else orientation_of(binned)


def orientation_of(binned: Accelerations) -> ImuOrientation | None:
    """
    Return the IMU orientation in the vehicle, None if the accelerations do not determine it.

    force = gain[0] forward + gain[1] i centripetal, complex; the argument of gain[0] is the
    forward direction. As centripetal has its own gain, the sign of the gyro has no effect.
    """
    force = binned.force
    design = np.stack([binned.forward, 1j * binned.centripetal], -1)
    normal = design.conj().T @ design
    if len(design) < ORIENTATION_BINS or np.linalg.cond(normal) > 1e9:
        return None
    inverse = np.linalg.inv(normal)
    gain = inverse @ (design.conj().T @ force)
    residual = force - design @ gain
    # half of the residual is across, and every other change is independent (they share bins)
    variances = np.vdot(residual, residual).real / len(design) * np.diag(inverse).real
    sigma, centripetal_sigma = np.sqrt(variances) / max(abs(gain[0]), 1e-9)
    max_sigma = np.deg2rad(10.0)    # of the direction
    min_gain, max_gain = 0.5, 2.0    # of a valid fit: the right one is 1
    if sigma > max_sigma or not min_gain < abs(gain[0]) < max_gain:
        return None
    forward = gain[0].real * binned.e1 + gain[0].imag * binned.e2
    return ImuOrientation(float(-np.arctan2(forward[1], forward[0])), float(sigma),
                          float((gain[1] / gain[0]).real), float(centripetal_sigma))


def corrected_forward_axis(orientation: ImuOrientation | None, forward: Floats) -> Floats:
    """Return scale times forward axis, (3,), rotated to the IMU orientation if far from it."""
    yaw, pitch = mounting_from_forward(forward)
    min_difference = np.deg2rad(10.0)    # a smaller one has no effect on the search for slips
    if orientation is None or abs(float(wrap(orientation.yaw - yaw))) < max(
            min_difference, 3 * orientation.sigma):
        return forward
    return np.linalg.norm(forward) * forward_b(orientation.yaw, pitch)


def orientation_reasons(orientation: ImuOrientation | None,
                        nominal_yaw: float) -> tuple[Reason, ...]:
    """Return IMU_AXES or ODOMETER_REVERSED if the yaw of the IMU is far from nominal, rad."""
    if orientation is None:
        return ()
    nominal = 0.0 if np.isnan(nominal_yaw) else nominal_yaw
    difference = abs(float(wrap(orientation.yaw - nominal)))
    direction = DIRECTIONS[round(orientation.yaw / (np.pi / 2)) % 4]
    yaw_deg, sigma_deg = np.rad2deg([orientation.yaw, orientation.sigma])
    yaw_text = f'{yaw_deg:+z.0f} deg, ± {max(sigma_deg, 1):.0f}'
    if nominal:
        yaw_text += f', nominal {np.rad2deg(nominal):+z.0f} deg'
    observed = (f'forward accelerations of the vehicle point {direction} in the IMU frame (yaw '
                f'mounting {yaw_text}). Likely cause')
    reversed_limit = np.deg2rad(150.0)    # a reversed odometer looks the same
    if difference > reversed_limit:
        return (Reason(Code.ODOMETER_REVERSED, f'{observed}: positive counts mean reverse motion, '
                       'the IMU x axis points backwards, or the whole leg was driven in reverse '
                       'with an unsigned counter'),)
    axes_limit = np.deg2rad(75.0)    # beyond any intended mounting
    if difference < axes_limit + 3 * orientation.sigma:
        return ()
    return (Reason(Code.IMU_AXES, f'{observed}: the body frame is not forward-left-up'),)


def unit_and_axis_reasons(median_f_b: Floats, w_b: Floats, C_bi: Floats,
                          imu: ImuConfig) -> tuple[tuple[Reason, ...], bool]:
    """
    Return reasons about units and axes of an IMU, and True if it must be turned over (z down).

    median_f_b : (3,) median specific force, m/s^2, in the configured body frame.   w_b : (n, 3)
    turn rate in it, rad/s.   C_bi : (3, 3) configured nominal rotation.   imu : settings, whose
    scales are already applied. With a reason of UNUSABLE no result is possible.
    """
    reasons, size = _unit_reasons(median_f_b, w_b, imu), float(np.linalg.norm(median_f_b))
    if size < NO_GRAVITY:
        return tuple(reasons), False
    up = median_f_b / size
    upright = int(np.argmax(np.abs(up @ C_bi)))
    if not reasons and not any((np.abs(w_b[rows] @ C_bi[:, upright]) > ROUNDING).any()
                               for rows in chunks(len(w_b))):
        reasons.append(Reason(Code.NO_IMU, f'angular_velocity.{AXES[upright]} is always zero: the '
                              'IMU publishes no turn rate about its upright axis', 'Publish all '
                              'three turn rates, or use an IMU that measures them.'))
    max_tilt = np.deg2rad(30.0)    # a body frame more tilted than this is not forward-left-up
    if up[2] > np.cos(max_tilt):
        return tuple(reasons), False
    axis = int(np.argmax(np.abs(up)))
    text = f'gravity is on {"+" if up[axis] > 0 else "-"}{AXES[axis]} (up should be +z)'
    if up[2] < -np.cos(max_tilt) and np.allclose(C_bi, np.eye(3)):
        reasons.append(Reason(Code.IMU_LOOKS_Z_DOWN, f'{text}: forward-right-down is assumed'))
        return tuple(reasons), True
    reasons.append(Reason(Code.IMU_AXES, f'{text}: the body frame is not forward-left-up'))
    return tuple(reasons), False


def _unit_reasons(median_f_b: Floats, w_b: Floats, imu: ImuConfig) -> list[Reason]:
    """Return reasons about missing or wrongly scaled signals; as ``unit_and_axis_reasons``."""
    bias, size = medians(w_b), float(np.linalg.norm(median_f_b))
    top_rate = float(np.percentile(map_rows(lambda w: lengths(w - bias), w_b), 99.9,
                                   overwrite_input=True))
    reasons = []
    if not any(w_b[rows].any() for rows in chunks(len(w_b))):
        reasons.append(Reason(Code.NO_IMU, 'all turn rates are zero: the IMU publishes none, or '
                              'imu.gyro_scale is 0', 'Check the gyro in the IMU driver, or name '
                              'another topic with --imu-topic.'))
    if size < NO_GRAVITY:
        return [*reasons, Reason(
            Code.NO_IMU, 'the acceleration contains no gravity: the IMU publishes none or removes '
            'gravity, or imu.accel_scale is 0',
            'Publish accelerations that include gravity (REP-145).')]
    if not 0.85 * G < size < 1.15 * G:
        if 0.85 < size < 1.15:
            text = f'gravity is {size:.3f} instead of 9.8 m/s^2: the unit is probably g'
            remedy = (f'Set imu.accel_scale to {9.80665 * imu.accel_scale:.10g}, or publish m/s^2 '
                      '(REP-145).')
        else:
            text = f'the IMU measures a gravity of {size:.3g} m/s^2 instead of 9.8 m/s^2'
            remedy = ''
        reasons.append(Reason(Code.IMU_UNITS, text, remedy))
    if top_rate > MAX_RATE:
        reasons.append(Reason(
            Code.IMU_UNITS, f'the gyro measures {top_rate:.3g} rad/s; the limit for a vehicle is '
            f'{MAX_RATE:g} rad/s: the unit is probably deg/s',
            f'Set imu.gyro_scale to {imu.gyro_scale * RAD_PER_DEG:.10g}, or publish rad/s '
            '(REP-145).'))
    return reasons
