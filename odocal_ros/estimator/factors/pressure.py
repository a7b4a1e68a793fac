# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The factor of heights from air pressure, docs/method.md (S19a).

A pressure sensor measures height differences to a decimetre. Its zero, the weather, the dynamic
pressure and the air temperature are constants of the leg.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.factors.factor import LinearisationPoint
from odocal_ros.estimator.factors.point_rows import ExternalRows
from odocal_ros.estimator.leg import ExternalSamples, SmootherLeg
from odocal_ros.estimator.preintegrate import Points
from odocal_ros.estimator.state import BA, BG, GYRO, M, P, PHI, PRESSURE, SIZE_WITHOUT_SLOW, V
from odocal_ros.nav.dead_reckoning import gravity_n, Origin
from odocal_ros.nav.rotations import rotate, skew
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import Config

# physical, of the standard atmosphere at the ground: R T / g, m
SCALE_HEIGHT = 8435.0
# of its constants, physical: zero, m; weather, m/s, 1 hPa/h; dynamic pressure, m per (m/s)^2, a
# pressure coefficient of 0.3; air temperature, relative, 15 K
PRIOR_SIGMAS = 1e4, 8.4 / 3600, 0.015, 0.05
EARTH_RADIUS = 6.371e6      # m, physical: mean radius
HEIGHT_SIGMA = 0.15     # m, physical: noise of a sample, if the sensor states none
MIN_HEIGHT_NOISE = 0.02    # m, physical: the best sensors of today
RATE = 1.0              # Hz, judgement: of means; heights of a vehicle change more slowly


@dataclass(frozen=True, eq=False)
class Pressure(ExternalSamples):
    """Heights above an unknown zero."""

    height: Floats      # (m,) m


class PressureRows(ExternalRows):
    """Rows of the heights: from pressure minus predicted, m."""

    name, source = 'pressure', 'air_pressure'
    level_columns = {'pressure': slice(0, 1)}
    constants, min_sigma = PRESSURE, MIN_HEIGHT_NOISE

    @classmethod
    def prepared(cls, inputs: Inputs, config: Config, origin: Origin) -> Pressure | None:
        samples, t = inputs.external['pressure']
        if not (config.imu.use_pressure and len(t) and inputs.has_accelerometer):
            return None
        # means of the samples in each cell of 1 / RATE
        first = np.r_[0, np.flatnonzero(np.diff(np.floor(t * RATE))) + 1]
        count = np.diff(np.r_[first, len(t)])
        t_mean, p_mean, v_mean = (np.add.reduceat(x, first) / count
                                  for x in (t, samples.value, samples.variance))
        stated = np.sqrt(np.maximum(v_mean, 0.0) / count) * (SCALE_HEIGHT / p_mean)
        sigma = np.where(stated > 0, stated, HEIGHT_SIGMA / np.sqrt(count))
        return Pressure(t_mean, sigma, -SCALE_HEIGHT * np.log(p_mean / p_mean[0]))

    @staticmethod
    def prior_sigmas(samples: Pressure, config: Config) -> Floats:
        return np.array(PRIOR_SIGMAS)

    def rows(self, samples: Pressure, points: Points, point: LinearisationPoint,
             leg: SmootherLeg) -> tuple[Floats, Floats, Floats]:
        state, k, tau = point.state, points.interval, points.tau
        C, g = state.C_nb[k], gravity_n(state.p_n[k], leg.origin)
        dp, dv = rotate(C, points.dp), rotate(C, points.dv)
        velocity_n = state.v_n[k] + dv + g * tau[:, None]
        by_velocity = (2 * state.constants[PRESSURE][2] * velocity_n)[:, None]
        by_constants = np.stack([np.ones(len(k)), samples.t, (velocity_n**2).sum(axis=1),
                                 samples.height - samples.height.mean()], -1)
        p_n = state.p_n[k] + state.v_n[k] * tau[:, None] + dp + g * (tau**2 / 2)[:, None]
        height = p_n[:, 2] + (p_n[:, :2]**2).sum(axis=1) / (2 * EARTH_RADIUS)
        raw = samples.height - height - by_constants @ state.constants[PRESSURE]
        J, J_c = np.zeros((len(k), 1, SIZE_WITHOUT_SLOW)), np.zeros((len(k), 1, M))
        up = np.concatenate([p_n[:, :2] / EARTH_RADIUS, np.ones((len(k), 1))], axis=1)[:, None]
        t = tau[:, None, None]
        J[:, :, P], J[:, :, V] = -up, -up * t - by_velocity
        J[:, :, PHI] = up @ skew(dp) + by_velocity @ skew(dv)
        J[:, :, BA] = up @ C @ points.AA + by_velocity @ C @ points.A
        by_gyro = -up @ C @ points.dp_by_gyro - by_velocity @ C @ points.dv_by_gyro
        J[:, :, BG], J_c[:, :, GYRO] = by_gyro[:, :, :3], by_gyro[:, :, 3:]
        J_c[:, 0, PRESSURE] = -by_constants
        return raw[:, None], J, J_c
