# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Predicted alignment of a planned drive, by the functions that align a recorded one."""

import numpy as np

from odocal_ros.forecast.planned_drive import PlannedDrive
from odocal_ros.nav.alignment import (
    Alignment,
    COMPASS_LIMIT,
    complete,
    COURSE_DISTANCE,
    gyrocompass,
    Level,
    level_at_rest,
    level_in_motion,
    MOTION_LEVEL,
)
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.earth import earth_rate_n, gravity
from odocal_ros.nav.rotations import quat_conjugate, quat_from_matrix, quat_multiply, transpose
from odocal_ros.pipeline.align import choose_standstill
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import AlignmentConfig, Config
from odocal_ros.settings.grades import Grade, with_turn_on_level

OWN_SOURCES = ('fixed', 'heading_topic', 'imu_orientation')


def plan_alignment(drive: PlannedDrive, config: Config, fix_sigma: float,
                   spans: list[tuple[float, float]]) -> tuple[Alignment, tuple[Reason, ...]]:
    """
    Return the alignment of a planned drive, and its reasons.

    drive : as planned.   config : grade, heading source and its sigma.   fix_sigma : of one fix,
    m, for a course.   spans : list of (begin, end) standstills, s.
    """
    grade = with_turn_on_level(config.imu)
    span = choose_standstill(spans)
    found: tuple[Reason, ...] = ()
    if span is not None:
        level = _level_at_rest(drive, span, grade)
    else:
        level = _level_in_motion(drive, grade)
        found = (Reason(Code.NO_STANDSTILL, 'no standstill before the start mark: level and gyro '
                        'bias are estimated from the drive'),)
    yaw, sigma, source, why = _heading(drive, config.alignment, fix_sigma, level, grade)
    alignment = complete(level, yaw, sigma, source, source != 'gyrocompass',
                         Origin(drive.latitude, drive.longitude, drive.height), grade,
                         grade.gyro_noise)
    return alignment, found + why


def _level_at_rest(drive: PlannedDrive, span: tuple[float, float], grade: Grade) -> Level:
    """Return the level of a standstill from the mean of its planned samples."""
    span = (span[0], min(span[1], drive.duration))
    C_bn = transpose(drive.C_nb[int(np.searchsorted(drive.t, span[0]))])
    up_b, earth_b = C_bn[:, 2], C_bn @ earth_rate_n(drive.latitude)
    return level_at_rest(np.array(span), np.tile(earth_b, (2, 1)),
                         np.tile(up_b * gravity(drive.latitude, drive.height), (2, 1)), span,
                         grade, grade.gyro_noise)


def _level_in_motion(drive: PlannedDrive, grade: Grade) -> Level:
    """Return the level from the first half minute of driving."""
    pick = (drive.t >= 0.0) & (drive.t <= MOTION_LEVEL)
    if pick.sum() < 2:
        pick = np.arange(len(drive.t)) < 2
    t, C_nb = drive.t[pick], drive.C_nb[pick]
    velocity_n = C_nb[:, :, 0] * drive.speed[pick][:, None]
    f_n = np.gradient(velocity_n, t, axis=0) + [0.0, 0.0, gravity(drive.latitude, drive.height)]
    q_nb = quat_from_matrix(C_nb)
    return level_in_motion(t, np.einsum('nij,ni->nj', C_nb, f_n),
                           quat_multiply(quat_conjugate(q_nb[0]), q_nb),
                           drive.speed[pick][[0, -1]], drive.latitude, grade)


def _heading(drive: PlannedDrive, config: AlignmentConfig, fix_sigma: float, level: Level,
             grade: Grade) -> tuple[float, float, str, tuple[Reason, ...]]:
    """Return yaw, sigma and source of the heading, and its reasons."""
    yaw = float(np.interp(level.t, drive.t, drive.yaw))
    source = config.source
    why: tuple[Reason, ...] = ()
    if source in ('auto', 'gyrocompass'):
        unable = 'needs a standstill'
        if level.standstill is not None:
            _, sigma = gyrocompass(level, drive.latitude, grade)
            if sigma <= COMPASS_LIMIT:
                return yaw, sigma, 'gyrocompass', ()
            unable = ('the gyro bias causes a heading uncertainty of '
                      f'{np.rad2deg(min(sigma, np.pi)):.1f} deg')
        if source == 'gyrocompass':
            why = (Reason(Code.GYROCOMPASS_REFUSED, f'heading from gyrocompass: {unable}'),)
        source = 'course'
    if source in OWN_SOURCES:
        return yaw, config.heading_sigma, source, ()
    path_length = max(COURSE_DISTANCE, 8 * fix_sigma)
    return yaw, float(np.sqrt(2) * fix_sigma / path_length), 'course', why
