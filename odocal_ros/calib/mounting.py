# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Orientation of an IMU in the vehicle: up from gravity, forward from accelerations.

It gives the setting imu.mounting_rpy, a rotation by quarter turns, for an IMU that is mounted in
another orientation than configured.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from odocal_ros.data.arrays import Complexes, Floats, medians
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import rpy_from_matrix
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.imu_orientation import AXES, bin_accelerations, ORIENTATION_BINS
from odocal_ros.screening.inputs import Inputs

# rad of yaw from nominal: beyond the first the nominal rotation or heading is wrong, beyond the
# second reversed. Judgement: unintended angles are below 20 deg, and quarter turns are configured
FAR_YAW, BACKWARDS_YAW = np.deg2rad(20.0), np.deg2rad(160.0)
# rad, largest angle between a measured axis and the quarter turn assigned to it: a third of a
# quarter turn; the sigma of the axis must be below half of this limit. Judgement
AXIS_LIMIT = np.deg2rad(30.0)


@dataclass(frozen=True, eq=False)
class Mounting:
    """The nominal rotation estimated from a drive."""

    # (3, 3) rotation matrix from IMU frame i to body frame b, quarter turns; None: not observable
    C_bi: Floats | None
    up_i: Floats              # (3,) unit vector in i, measured
    forward_i: Floats | None  # (3,) the same; None: not observable
    forward_sigma: float      # rad
    assumed: bool             # True: forward is assumed to be x, not measured
    deviation: float          # rad, angle between the measured axes and the quarter turns

    @property
    def rpy(self) -> list[float] | None:
        """Return imu.mounting_rpy, rad."""
        return None if self.C_bi is None else _rpy(self.C_bi)

    @property
    def why_unknown(self) -> str:
        """Return the cause if the rotation is not known, '' if it is."""
        sigma, deviation, limit = np.rad2deg([self.forward_sigma, self.deviation, AXIS_LIMIT])
        if self.C_bi is not None:
            return ''
        if self.forward_i is not None:
            return (f'the IMU axes are {deviation:.0f} deg from quarter turns (limit '
                    f'{limit:.0f} deg)')
        sigma_text = f' (sigma {sigma:.0f} deg; the limit is {limit / 2:.0f} deg)' * bool(
            sigma < 180)
        return f'this drive does not determine which IMU axis points forward{sigma_text}'


def remedy(estimate: Mounting) -> str:
    """Return the setting to make; the possible ones if the drive does not determine it."""
    if estimate.C_bi is not None:
        return (f"Set imu.mounting_rpy: --set 'imu.mounting_rpy={_rpy_text(estimate.C_bi)}'"
                + ", if the IMU's x axis points forward" * estimate.assumed + '.')
    cause = estimate.why_unknown[0].upper() + estimate.why_unknown[1:]
    if estimate.forward_i is not None:
        left_i = np.cross(estimate.up_i, estimate.forward_i)
        C = np.stack([estimate.forward_i, left_i, estimate.up_i])
        return f'{cause}. Set imu.mounting_rpy to its angles, about {_rpy_text(C, 2)} rad.'
    upright = [C for C in _quarter_turns()
               if C[2] @ estimate.up_i > np.abs(estimate.up_i).max() - 1e-9]
    by_forward_axis = '; '.join(
        f'{"+" if C[0].sum() > 0 else "-"}{AXES[int(np.argmax(np.abs(C[0])))]}: {_rpy_text(C)}'
        for C in upright)
    return (f'{cause}. Drive with stops, starts and turns, or set imu.mounting_rpy for the IMU '
            f'axis that points forward: {by_forward_axis}.')


def _rpy(C_bi: Floats) -> list[float]:
    """Return roll, pitch, yaw, rad, without rounding errors and -0."""
    return [float(x) for x in np.round(rpy_from_matrix(C_bi), 12) + 0.0]


def _rpy_text(C_bi: Floats, digits: int = 10) -> str:
    return f'[{",".join(f"{x:.{digits}g}" for x in _rpy(C_bi))}]'


def with_mounting_remedy(reasons: Iterable[Reason], inputs: Inputs) -> list[Reason]:
    """Return reasons, with the setting to make in IMU_AXES, estimated from screened inputs."""
    if not any(r.code is Code.IMU_AXES and not r.special_remedy for r in reasons):
        return list(reasons)
    estimate = estimate_mounting(inputs.t_imu, inputs.w_b @ inputs.C_bi, inputs.f_b @ inputs.C_bi,
                                 inputs.travel, 1.0)
    return [replace(r, special_remedy=r.special_remedy or remedy(estimate))
            if r.code is Code.IMU_AXES else r for r in reasons]


def estimate_mounting(t: Floats, w_i: Floats, f_i: Floats, travel: Travel,
                      metres_per_unit: float) -> Mounting:
    """
    Return the mounting of an IMU.

    t, w_i, f_i : (n,), (n, 3), (n, 3) times, s, turn rate, rad/s, and specific force, m/s^2 or g,
    in the sensor's frame.   travel : odometer; positive means forward.   metres_per_unit : its
    approximate scale.
    """
    mean = medians(f_i)
    size = float(np.linalg.norm(mean))
    if size < 1e-3:
        return Mounting(None, np.zeros(3), None, np.pi, True, 0.0)
    up_i = mean / size
    forward_i, sigma = _forward(t, w_i, f_i, up_i, travel, metres_per_unit)
    if forward_i is not None:
        C = np.stack([forward_i, np.cross(up_i, forward_i), up_i])
        nearest = max(_quarter_turns(), key=lambda q: np.trace(q @ C.T))
        deviation = float(np.arccos(np.clip((np.trace(nearest @ C.T) - 1) / 2, -1, 1)))
        C_bi = nearest if deviation < AXIS_LIMIT + sigma else None
        return Mounting(C_bi, up_i, forward_i, sigma, False, deviation)
    if abs(up_i[2]) > np.cos(AXIS_LIMIT):     # upright or upside down: x is forward, most likely
        C_bi = np.diag([1.0, np.sign(up_i[2]), np.sign(up_i[2])])
        return Mounting(C_bi, up_i, None, sigma, True, float(np.arccos(abs(up_i[2]))))
    return Mounting(None, up_i, None, sigma, True, 0.0)


def _forward(t: Floats, w_i: Floats, f_i: Floats, up_i: Floats, travel: Travel,
             metres_per_unit: float) -> tuple[Floats | None, float]:
    """Return the forward axis (level, unit) and its sigma, rad; None if not observable."""
    # level plane as complex numbers: f = e^(i theta) (dv/dt + i v w_up) + bias. If this does not
    # fit, the sign of the turn is inverted (mirrored axis, tested later)
    binned = bin_accelerations(t, w_i, f_i, up_i, travel, metres_per_unit)
    if binned is None:
        return None, np.pi
    A, F = binned.forward + 1j * binned.centripetal, binned.force
    fits = _angle(A, F), _angle(A.conj(), F)
    theta, sigma = next((fit for fit in fits if fit[1] <= AXIS_LIMIT / 2), fits[0])
    if sigma > AXIS_LIMIT / 2:
        return None, sigma
    return np.cos(theta) * binned.e1 + np.sin(theta) * binned.e2, sigma


def _angle(A: Complexes, F: Complexes) -> tuple[float, float]:
    """Return the angle from accelerations A to forces F and its sigma, rad; pi if unknown."""
    A, F = A - A.mean(), F - F.mean()
    power = float(np.vdot(A, A).real)
    min_mean_square = 5e-5      # (m/s^2)^2: hardly any acceleration
    if len(A) < ORIENTATION_BINS or power < min_mean_square * len(A):
        return 0.0, np.pi
    gain = np.vdot(A, F) / power
    if not gain:            # no accelerometer
        return 0.0, np.pi
    residual = F - gain * A
    # half of the residual's variance is across the axis. Adjacent bins share noise: a third of
    # them is independent
    variance = np.vdot(residual, residual).real / (2 * len(A) / 3)
    sigma = float(np.sqrt(variance / power) / abs(gain))
    return float(np.angle(gain)), sigma


def _quarter_turns() -> Iterator[Floats]:
    """Yield the 24 rotations whose axes are those of the other frame, with any sign."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            C = np.zeros((3, 3))
            C[range(3), order] = signs
            if np.linalg.det(C) > 0:
                yield C
