# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The drive of section 3 of Shi et al. 2015, calibrated by the pipeline that also processes bags.

The drive is simulated with perfect sensors. The errors are in the alignment, which the pipeline
receives: attitude errors phi in ENU, computed = (I - [phi x]) true, at the end of the standstill;
and a gyro drift, which is missing in the gyro bias that the pipeline subtracts from there on.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from odocal_reproductions.paper.coefficients import GYRO_DRIFT, HEADING_ERROR, TILT_ERROR
from odocal_reproductions.paper.error_forms import chord_error, plane_error, SpeedProfile
from odocal_reproductions.paper.error_model import LAT, LON, propagate, U
from odocal_reproductions.paper.path import Path, planned_path
from odocal_reproductions.paper.plane import gauss_krueger
from odocal_ros.calib.result import LegResult
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.alignment import Alignment
from odocal_ros.nav.rotations import exp_so3
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.motion import attitude
from odocal_ros.sim.scenarios import Drive, SimOptions, simulate
from odocal_ros.sim.sensors import imu_rotation

GYRO_NOISE = np.deg2rad(0.001) / 60     # definition: rad/s/sqrt(Hz), 0.001 deg/sqrt(h)
# phi at the end of the standstill, ENU, and drift in x right, y forward, z up: multiples of the
# errors in the paper
SOURCES = {
    'none': ((0, 0, 0), (0, 0, 0)),
    'eps_x': ((0, 0, 0), (1, 0, 0)),
    'eps_y': ((0, 0, 0), (0, 1, 0)),
    'eps_z': ((0, 0, 0), (0, 0, 1)),
    'phi_E0': ((1, 0, 0), (0, 0, 0)),
    'phi_N0': ((0, 1, 0), (0, 0, 0)),
    'phi_U0': ((0, 0, 1), (0, 0, 0)),
    'all': ((1, 1, 1), (1, 1, 1)),
}


def errors_of(source: str) -> tuple[Floats, Floats]:
    """Return phi_n (3,), rad, and eps_b (3,), rad/s in forward-left-up, of a row of table 3."""
    phi, eps = SOURCES[source]
    flu_from_rfu = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return (np.multiply(phi, (TILT_ERROR, TILT_ERROR, HEADING_ERROR)),
            flu_from_rfu @ eps * GYRO_DRIFT)


@dataclass(frozen=True, eq=False)
class Outcome:
    """The result of the pipeline with a source of error; errors are estimate - truth."""

    yaw: float             # rad, error
    scale: float           # error relative to K
    yaw_sigma: float       # rad, as stated by the pipeline
    result: LegResult


@dataclass(frozen=True, eq=False)
class Growth:
    """Growth of the errors of a source after the standstill, by the error model."""

    t: NDArray[np.float64]         # (m,) s
    yaw: NDArray[np.float64]       # (m,) rad, error if the leg ended at t; NaN before motion
    across: NDArray[np.float64]    # (m,) m, position error to the right of the chord
    heading: NDArray[np.float64]   # (m,) rad, phi_U


class PaperDrive:
    """The simulated drive of section 3, to be calibrated with any source of error."""

    def __init__(self) -> None:
        pulse = 1e-6    # m: quantisation is 1e-10 of the distance, below the errors of table 3
        self.drive: Drive = simulate(SimOptions(
            scenario='paper', imu_grade='perfect', fix_sigma=0.0, scale=pulse))
        truth, options = self.drive.truth, self.drive.options
        self.config: Config = with_settings(Config(), {
            'method': 'two_point',
            'odometer.nominal_scale': options.nominal_scale, 'imu.grade': 'navigation'})
        self.start = (truth.start_ns - options.start_ns) * 1e-9     # s, end of the standstill
        state = self.drive.motion.at(np.array([self.start]))
        self.C_nb = attitude(state)[0] @ imu_rotation(options)

    def alignment(self, source: str) -> Alignment:
        """Return the true alignment plus the errors of a source."""
        phi_n, eps_b = errors_of(source)
        return Alignment(
            t=0.0, C_nb=exp_so3(-phi_n) @ self.C_nb, gyro_bias=-eps_b, level_sigma=TILT_ERROR,
            heading_sigma=HEADING_ERROR, gyro_bias_sigma=np.full(3, GYRO_DRIFT),
            gyro_noise=GYRO_NOISE, gyro_bias_walk=0.0, heading_source='fixed',
            heading_shared=True, standstill=(-self.start, 0.0))

    def outcome(self, source: str) -> Outcome:
        """Return the pipeline result with the errors of a source."""
        result = calibrate(self.drive.leg(), self.config, self.alignment(source))
        estimates, truth = result.methods['two_point'].estimates, self.drive.truth
        yaw, scale = estimates['yaw_mounting_angle'], estimates['scale_factor']
        # this drive determines both
        assert yaw.value is not None, result.reasons
        assert yaw.sigma is not None, result.reasons
        assert scale.value is not None, result.reasons
        return Outcome(yaw.value - truth.yaw, scale.value / truth.scale - 1, yaw.sigma, result)

    def path(self, step: float = 0.5) -> Path:
        """Return the true drive from the end of the standstill, for the error model."""
        motion = self.drive.motion
        t = np.arange(self.start, motion.duration + step / 2, step)
        state = motion.at(t)
        path = planned_path(t - self.start, state.speed, state.yaw, state.latitude[0],
                            state.longitude[0], state.height[0])
        return replace(path, C_nb=path.C_nb @ imu_rotation(self.drive.options))

    def profile(self) -> SpeedProfile:
        """Return the distribution of distance over time from the end of the standstill."""
        path = self.path()
        return SpeedProfile(path.t, path.travel)

    def growth(self, source: str) -> Growth:
        """Return the growth of the errors of a source: (15)-(23), then (13), (14), (12)."""
        phi_n, eps_b = errors_of(source)
        path = self.path()
        x = propagate(path, [*phi_n, 0.0, 0.0, 0.0], eps_b)     # no position error at the start
        meridian = path.longitude[0]
        north, east = gauss_krueger(path.latitude, path.longitude, meridian)
        north, east = north - north[0], east - east[0]
        dx, dy = plane_error(path.latitude, path.longitude, meridian, x[:, LAT], x[:, LON])
        chord = np.hypot(north, east)
        with np.errstate(invalid='ignore', divide='ignore'):
            _, yaw = chord_error(north, east, dx, dy, chord, 1.0)
            across = (north * dy - east * dx) / chord
        has_moved = chord > 1.0      # m: before, a chord has no direction
        return Growth(path.t, np.where(has_moved, yaw, np.nan), np.where(has_moved, across, 0.0),
                      x[:, U])
