# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Legs without an accelerometer, or with positions in a local frame.

An IMU may send turn rates only: the yaw rate of a car on the bus, the gyro of a robot. Without
gravity in them, or without roll and pitch rate, accelerations cannot be used. The ground is then
assumed level and the IMU upright: gravity replaces the specific force, so that no other code
depends on it. The errors of this assumption are added to the level (``pipeline/align.py``) and to
the scale (``pipeline/beyond_model.py``).

The y axis of a local frame does not point north: sensors that need north are not used.
"""

from dataclasses import replace
import math

import numpy as np

from odocal_ros.data import samples
from odocal_ros.data.arrays import chunks, Floats, thinned
from odocal_ros.data.leg import Leg
from odocal_ros.nav.geodesy import LARGEST_FRAME, OMEGA
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.nominal import G

MIN_GRAVITY = 0.5  # judgement: relative to 9.8 m/s^2 or 1 g; a smaller median is motion only
GRAVITY_ROWS = 20_000  # judgement: largest number of rows in the median
TILT_SIGMA = 0.05    # rad of road and mounting, 1 sigma of each axis; judgement


def has_accelerometer(f_i: Floats) -> bool:
    """Return True if any of the (n, 3) forces is valid, or if there are no rows."""
    if not len(f_i):
        return True
    with np.errstate(invalid='ignore'):      # a signalling NaN
        return any(not (np.isnan(f_i[rows]) | (f_i[rows] == 0)).all() for rows in chunks(len(f_i)))


def missing_force_cause(imu: samples.ImuSamples, accel_scale: float = 1.0) -> str:
    """Return the cause of unusable accelerations of an IMU, '' if they are usable."""
    if not has_accelerometer(imu.f_i):
        return 'publishes turn rates but no acceleration'
    with np.errstate(all='ignore'):
        forces = thinned(imu.f_i, GRAVITY_ROWS)
        forces = forces[np.isfinite(forces).all(axis=1)]
        if len(forces) and np.linalg.norm(np.median(forces, axis=0)) * accel_scale < MIN_GRAVITY:
            return 'publishes accelerations without gravity'
    has_no_gyro = np.logical_and.reduce([      # always zero, by axis
        (imu.w_i[rows] == 0).all(axis=0) for rows in chunks(len(imu.w_i))] or [np.zeros(3, bool)])
    if has_no_gyro.any() and len(forces):
        vertical = int(np.argmax(np.abs(np.median(forces, axis=0))))
        if not has_no_gyro[vertical]:      # else it is reported by ``unit_and_axis_reasons``
            axes = ' and '.join('xyz'[k] for k in np.flatnonzero(has_no_gyro))
            return f'publishes no turn rate about {axes}, so accelerations cannot be levelled'
    return ''


def with_assumed_force(leg: Leg, config: Config) -> tuple[Leg, tuple[Reason, ...]]:
    """Return the leg, with gravity as specific force if it has no usable one, and the reason."""
    cause = missing_force_cause(leg.imu, config.imu.accel_scale)
    if not cause:
        return leg, ()
    up_i = matrix_from_rpy(config.imu.mounting_rpy).T[:, 2]
    scale = config.imu.accel_scale
    gravity_i = np.tile(up_i * G / (scale if scale > 1e-12 else 1.0), (len(leg.imu.f_i), 1))
    return replace(leg, imu=replace(leg.imu, f_i=gravity_i)), (Reason(
        Code.NO_ACCELEROMETER, f'the IMU {cause}. The scale is estimated from gyro, odometer and '
        'fixes; the ground is assumed to be level'),)


def settings_by_frame(fix: samples.FixSamples, config: Config) -> Config:
    """Return the settings for positions in a local frame if the fixes are such, else unchanged."""
    return config.in_local_frame() if is_local(fix) else config


def is_local(fix: samples.FixSamples) -> bool:
    """Return True if the fixes are positions in a local frame."""
    return bool((fix.status == samples.LOCAL_STATUS).any())


def without_north(leg: Leg, config: Config) -> tuple[Leg, tuple[Reason, ...]]:
    """
    Return a leg without sensors that need north, and LOCAL_FRAME, if its positions are local.

    GNSS velocities are removed, and the heading topic unless the settings select it.
    """
    if not is_local(leg.fix):
        return leg, ()
    unused = ['GNSS velocities'] * bool(len(leg.rows('fix_velocity').stamp_ns))
    leg = leg.with_rows(fix_velocity=samples.VelocitySamples.empty())
    if config.alignment.heading_source == 'auto' and len(leg.rows('heading').stamp_ns):
        unused += ['external headings']
        leg = leg.with_rows(heading=samples.HeadingSamples.empty())
    latitude = math.radians(config.reference.latitude_deg)
    earth_rate = OMEGA if math.isnan(latitude) else OMEGA * math.cos(latitude)
    text = ('positions are in a local frame, so north is unknown: up to '
            f'{math.degrees(earth_rate) * 3600:.1f} deg/h of the Earth rate are estimated as gyro '
            'bias')
    if unused:
        text += f'; {" and ".join(unused)} are not used'
    reason = Reason(Code.LOCAL_FRAME, text)
    if not np.isnan(leg.fix.latitude).all():
        return leg, (reason,)
    return leg, (reason, Reason(
        Code.FIXES_UNUSABLE, f'all {len(leg.fix.latitude)} positions are NaN or more than '
        f'{LARGEST_FRAME / 1000:g} km from the origin of their frame, as map coordinates are',
        'Publish positions in a frame with its origin near the site.'))
