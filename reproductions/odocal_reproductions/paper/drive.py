# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Section 3 of Shi et al. 2015: its drive, through the pipeline that a user's bag goes through.

The drive is simulated with perfect sensors; the errors are put into the alignment that the
pipeline is handed: phi in ENU, computed = (I - [phi x]) true, at the end of the
standstill; drift as what the pipeline takes too little off the gyro from there on.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_reproductions.paper.coefficients import DRIFT, HEADING, LEVEL
from odocal_reproductions.paper.error_forms import chord_error, plane_error, SpeedProfile
from odocal_reproductions.paper.error_model import propagate
from odocal_reproductions.paper.path import Path, planned_path
from odocal_ros.calib.result import LegResult
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.alignment import Alignment
from odocal_ros.nav.geodesy import plane_for
from odocal_ros.nav.rotations import exp_so3
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.motion import attitude
from odocal_ros.sim.scenarios import Drive, SimOptions, simulate
from odocal_ros.sim.sensors import imu_rotation

GYRO_NOISE = np.deg2rad(0.001) / 60     # definition: rad/s/sqrt(Hz), 0.001 deg/sqrt(h)
# phi at the end of the standstill, ENU; drift in x right, y forward, z up: in units of the paper's
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
    right_forward_up = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    return np.multiply(phi, (LEVEL, LEVEL, HEADING)), right_forward_up @ eps * DRIFT


@dataclass(frozen=True, eq=False)
class Outcome:
    """What the pipeline makes of a source of error; errors are estimate - truth."""

    yaw: float             # rad
    scale: float           # relative to K
    yaw_sigma: float       # rad, what the pipeline itself says
    result: LegResult


@dataclass(frozen=True, eq=False)
class Growth:
    """
    How a source's errors grow after the standstill, by the error model.

    t : (m,) s.   yaw : (m,) yaw error if the leg ended there, rad, NaN before it moves.
    across : (m,) m to the right of the true position.   heading : (m,) phi_U, rad.
    """

    t: NDArray[np.float64]
    yaw: NDArray[np.float64]
    across: NDArray[np.float64]
    heading: NDArray[np.float64]


class PaperDrive:
    """The simulated drive of section 3, to be calibrated with any source of error."""

    def __init__(self) -> None:
        # m; a count hides 1e-10 of the distance, less than the errors looked for
        pulse = 1e-6
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
        """Return the true alignment with the errors of a source in it."""
        phi_n, eps_b = errors_of(source)
        return Alignment(
            t=0.0, C_nb=exp_so3(-phi_n) @ self.C_nb, gyro_bias=-eps_b, level_sigma=LEVEL,
            heading_sigma=HEADING, gyro_bias_sigma=np.full(3, DRIFT), gyro_noise=GYRO_NOISE,
            gyro_bias_walk=0.0, heading_source='fixed', heading_shared=True,
            standstill=(-self.start, 0.0))

    def outcome(self, source: str) -> Outcome:
        """Return the pipeline result with the errors of a source."""
        result = calibrate(self.drive.leg(), self.config, self.alignment(source))
        found, truth = result.methods['two_point'].estimates, self.drive.truth
        yaw, scale = found['yaw_mounting_angle'], found['scale_factor']
        # nothing in this drive is there to be refused
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
        C_vb = imu_rotation(self.drive.options)
        return Path(path.t, path.latitude, path.longitude, path.height, path.velocity_n,
                    path.C_nb @ C_vb)

    def profile(self) -> SpeedProfile:
        """Return the distribution of distance over time from the end of the standstill."""
        path = self.path()
        return SpeedProfile(path.t, path.travel)

    def growth(self, source: str) -> Growth:
        """Return the growth of the errors of a source: (15)-(23), then (13), (14), (12)."""
        phi_n, eps_b = errors_of(source)
        path = self.path()
        x = propagate(path, [*phi_n, 0.0, 0.0, 0.0], eps_b)
        meridian = path.longitude[0]
        north, east = plane_for(self.config.projection, meridian).forward(
            path.latitude, path.longitude)
        north, east = north - north[0], east - east[0]
        dx, dy = plane_error(path.latitude, path.longitude, meridian, x[:, 3], x[:, 4])
        chord = np.hypot(north, east)
        with np.errstate(invalid='ignore', divide='ignore'):
            _, yaw = chord_error(north, east, dx, dy, chord, 1.0)
            across = (north * dy - east * dx) / chord
        moved = chord > 1.0      # m: before, a chord has no direction
        return Growth(path.t, np.where(moved, yaw, np.nan), np.where(moved, across, 0.0), x[:, 2])
