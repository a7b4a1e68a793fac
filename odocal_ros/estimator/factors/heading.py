# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The factor of an external heading, docs/method.md (S19): the yaw in n of the x axis of the IMU.

Its error is a constant of the leg (mounting, declination, compass), which does not average out,
plus white noise. A heading that is configured for the start mark is one sample.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.factors.factor import LinearisationPoint
from odocal_ros.estimator.factors.point_rows import ExternalRows
from odocal_ros.estimator.leg import ExternalSamples, meridian_convergence, SmootherLeg, thinning
from odocal_ros.estimator.preintegrate import Points
from odocal_ros.estimator.state import BG, GYRO, HEADING, M, PHI, SIZE_WITHOUT_SLOW
from odocal_ros.nav.alignment import HEADING_LIMIT
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.rotations import arctan2, matrix_from_quat, transpose, wrap, yaw_from_heading
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import Config

# rad, judgement: white noise of a configured heading, negligible
CONFIGURED_NOISE = 1e-4
MIN_HEADING_NOISE = 5e-4    # rad, physical: the best receivers of today


@dataclass(frozen=True, eq=False)
class Heading(ExternalSamples):
    """Samples of the yaw of the IMU's x axis in n, at times ``t``."""

    yaw: Floats             # (m,) rad
    constant_sigma: float   # rad, of the error that is constant over the leg
    source_name: str        # the heading source, as in the settings


class HeadingRows(ExternalRows):
    """Rows of a heading: measured minus predicted yaw, rad."""

    name, source = 'heading', 'heading_noise'
    level_columns = {'heading': slice(0, 1)}
    constants, min_sigma = slice(HEADING, HEADING + 1), MIN_HEADING_NOISE

    @classmethod
    def prepared(cls, inputs: Inputs, config: Config, origin: Origin) -> Heading | None:
        source, alignment = config.alignment.heading_source, config.alignment
        if not np.isnan(alignment.heading) and source in ('auto', 'fixed'):
            t = np.zeros(1)
            yaw = yaw_from_heading(alignment.heading) + meridian_convergence(inputs, t, origin)
            return Heading(t, np.full(1, CONFIGURED_NOISE), wrap(yaw),
                           alignment.heading_sigma, 'fixed')
        if source in ('auto', 'heading_topic'):
            samples, t = inputs.external['heading']
            return _from_orientations(inputs, t, samples.q_ni, samples.yaw_variance,
                                      alignment.heading_offset, config, origin, np.eye(3),
                                      'heading_topic')
        if source == 'imu_orientation':
            return _from_orientations(inputs, inputs.t_imu, inputs.q_ni, inputs.yaw_variance, 0.0,
                                      config, origin, transpose(inputs.C_bi), 'imu_orientation')
        return None

    @staticmethod
    def prior_sigmas(samples: Heading, config: Config) -> float:
        return samples.constant_sigma

    @classmethod
    def details(cls, samples: Heading, constants: Floats, sigma: Floats) -> dict[str, Any]:
        return {'source': samples.source_name, 'sigma_stated': samples.constant_sigma,
                'error': float(constants[HEADING]), 'error_sigma': float(sigma[HEADING])}

    def rows(self, samples: Heading, points: Points, point: LinearisationPoint,
             leg: SmootherLeg) -> tuple[Floats, Floats, Floats]:
        state, k = point.state, points.interval
        C = state.C_nb[k]
        x = (C @ points.R)[:, :, 0]     # x axis of the IMU in n
        # squared length of its horizontal part
        level2 = np.maximum(x[:, 0]**2 + x[:, 1]**2, 1e-6)
        residual = wrap(samples.yaw - arctan2(x[:, 1], x[:, 0]) - state.constants[HEADING])
        # derivative of the yaw by a rotation vector in n
        yaw_by_rotation = np.stack([-x[:, 2] * x[:, 0] / level2, -x[:, 2] * x[:, 1] / level2,
                                    np.ones(len(k))], -1)
        J, J_c = np.zeros((len(k), 1, SIZE_WITHOUT_SLOW)), np.zeros((len(k), 1, M))
        J[:, 0, PHI] = -yaw_by_rotation
        by_gyro = np.einsum('ki,kij->kj', yaw_by_rotation, C @ points.R_by_gyro)
        J[:, 0, BG], J_c[:, 0, GYRO] = by_gyro[:, :3], by_gyro[:, 3:]
        J_c[:, 0, HEADING] = -1.0
        return residual[:, None], J, J_c


def _from_orientations(inputs: Inputs, t: Floats, q: Floats, variance: Floats, offset: float,
                       config: Config, origin: Origin, C_ib: Floats,
                       source_name: str) -> Heading | None:
    """
    Return the heading of published orientations, or None if they are too few or too uncertain.

    q : (m, 4) orientations.   variance : (m,) rad^2, of the yaw, NaN: not published.   offset :
    rad, added to the yaw.   C_ib : from b to the published frame.
    """
    # a quaternion of zeros is not a published orientation
    is_published = ~np.isnan(variance) & (np.linalg.norm(q, axis=-1) > 0.5)
    t, q, variance = t[is_published], q[is_published], variance[is_published]
    if len(t) < 2 or not len(inputs.t_fix):
        return None
    rows = thinning(t)
    t, q, variance = t[rows], q[rows], variance[rows]
    stated_variance = float(np.median(variance))
    sigma = np.sqrt(stated_variance) if stated_variance > 0 else config.alignment.heading_sigma
    if sigma > HEADING_LIMIT:
        return None
    C = matrix_from_quat(q) @ C_ib
    yaw = arctan2(C[:, 1, 0], C[:, 0, 0]) + offset + meridian_convergence(inputs, t, origin)
    return Heading(t, np.full(len(t), sigma), wrap(yaw), float(max(sigma, 1e-5)), source_name)
