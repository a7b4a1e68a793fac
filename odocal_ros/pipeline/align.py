# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Alignment of a leg: level, gyro bias and heading at its start, with their sigmas.

The level is estimated at a standstill before the start mark, otherwise over the first seconds of
driving. The heading is from the first source that has one; the last source is the course by fixes.
"""

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple, TypeVar

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.nav import alignment as nav_alignment, rotations
from odocal_ros.nav.alignment import Alignment, LevelAttitude, make_alignment
from odocal_ros.nav.dead_reckoning import dead_reckon, Origin
from odocal_ros.nav.geodesy import C_en
from odocal_ros.nav.strapdown import attitude
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.inputs import Inputs
from odocal_ros.screening.leg_kind import TILT_SIGMA
from odocal_ros.settings import nominal
from odocal_ros.settings.config import Config

MIN_AT_REST = 20     # statistical: IMU rows; a sigma of 20 values has an error of 16 %
Span = TypeVar('Span', Floats, tuple[float, float])      # begin and end, s
# (yaw, sigma), rad, and '', or None and the reason
HeadingOrRefusal = tuple[tuple[float, float] | None, str]


class Heading(NamedTuple):
    """Heading at the epoch of the level: the ENU yaw of the x axis of L, rad."""

    yaw: float
    sigma: float
    source: str     # as the setting alignment.heading_source
    shared: bool    # True: its error is the same in every leg (``Alignment.heading_shared``)


def align(inputs: Inputs, spans: Floats, metres_per_unit: float, fixes_n: Floats, origin: Origin,
          config: Config) -> tuple[Alignment, tuple[Reason, ...]]:
    """Return the alignment of a leg, and reasons; spans: (k, 2) standstills, s."""
    span = choose_standstill(spans)
    noise = {} if span is None else _noise_at_rest(inputs, span)
    grade = nominal.grade_with_turn_on_bias(nominal.with_grade_by_noise(config.imu, {
        name: sigma**2 for name, sigma in noise.items() if sigma}))
    if not inputs.has_accelerometer:
        grade = replace(grade, accel_bias=TILT_SIGMA * nominal.G)
    gyro_noise = max(grade.gyro_noise, noise.get('gyro', 0.0))
    level, reasons = _estimate_level(inputs, span, metres_per_unit, origin.latitude, grade,
                                     gyro_noise)
    reasons += _noise_reasons(noise.get('gyro', 0.0), nominal.grade_of(config.imu))
    level = replace(level, C_np=_enu_to_n_at(inputs, level.standstill, fixes_n, origin))
    heading, refusals = _select_heading(inputs, level, origin.latitude, grade, config)
    reasons += refusals
    if heading is None:
        heading, refusals = _heading_by_course(inputs, level, metres_per_unit, fixes_n, origin,
                                               grade)
        reasons += refusals
    return make_alignment(level, *heading, origin, grade, gyro_noise), reasons


def attitude_of(inputs: Inputs, origin: Origin, t_begin: float, q_nb: Floats,
                gyro_bias: Floats) -> tuple[Floats, Floats]:
    """Return the attitude from ``t_begin``, s, to the end: t (m,) s, q_nb (m, 4)."""
    rows = slice(np.searchsorted(inputs.t_imu, t_begin - 1e-9),
                 np.searchsorted(inputs.t_imu, inputs.t_stop + 1.0, side='right'))
    t = inputs.t_imu[rows]
    rate = (len(t) - 1) / max(t[-1] - t[0], 1e-9)
    epoch_rate = 50.0    # Hz, least rate of attitude epochs
    return attitude(t, inputs.w_b[rows], q_nb, origin.earth_rate_n,
                    max(1, int(rate / epoch_rate)), gyro_bias)


def with_observed_walk(alignment: Alignment, inputs: Inputs, spans: Floats,
                       epochs: tuple[Floats, Floats], earth_rate_n: Floats) -> Alignment:
    """
    Return an alignment whose gyro bias walk is at least that observed at later standstills.

    A gyro warms up. spans : (k, 2) standstills, s.   epochs : attitude, t (m,) s and q_nb (m, 4).
    """
    walk_variances = []
    for begin, end in spans[spans[:, 0] > alignment.t] if alignment.standstill else ():
        edge = nav_alignment.REST_EDGE
        rows = slice(*np.searchsorted(inputs.t_imu, (begin + edge, end - edge)))
        t = inputs.t_imu[rows]
        if len(t) < MIN_AT_REST:
            continue
        C_nb = rotations.matrix_from_quat(rotations.quat_at(np.mean(t, keepdims=True), *epochs))[0]
        residual_rate = inputs.w_b[rows].mean(axis=0) - earth_rate_n @ C_nb - alignment.gyro_bias
        variance = alignment.gyro_noise**2 / (t[-1] - t[0]) + alignment.gyro_bias_sigma**2
        walk_variances.append((residual_rate**2 - variance).mean() / (t.mean() - alignment.t))
    observed = np.sqrt(max(np.median(walk_variances), 0.0)) if walk_variances else 0.0
    return replace(alignment, gyro_bias_walk=max(alignment.gyro_bias_walk, float(observed)))


def choose_standstill(spans: Iterable[Span]) -> Span | None:
    """Return the last standstill that begins at the start mark (t = 0) or before, or None."""
    latest_begin = 0.5    # s: a standstill that begins right after the start mark
    before = [span for span in spans if span[0] <= latest_begin]
    return before[-1] if before else None


def _enu_to_n_at(inputs: Inputs, span: Floats | tuple[float, float] | None, fixes_n: Floats,
                 origin: Origin) -> Floats:
    """Return C_np, from east-north-up at a standstill to n: 0.16 mrad per km from the origin."""
    if span is None or not len(fixes_n):
        return np.eye(3)
    selected = (inputs.t_fix >= span[0]) & (inputs.t_fix <= span[1])
    if not selected.any():
        selected = np.argmin(np.abs(inputs.t_fix - span[1]), keepdims=True)
    place_n = np.nan_to_num(np.median(fixes_n[selected], axis=0))
    latitude, longitude, _ = origin.to_geodetic(place_n)
    return rotations.transpose(C_en(origin.latitude, origin.longitude)) @ C_en(latitude, longitude)


def _estimate_level(inputs: Inputs, span: Floats | None, metres_per_unit: float, latitude: float,
                    grade: nominal.Grade, gyro_noise: float,
                    ) -> tuple[LevelAttitude, tuple[Reason, ...]]:
    """Return the level at a standstill, or at the start of the drive without one, and reasons."""
    if span is not None:
        return nav_alignment.level_at_rest(inputs.t_imu, inputs.w_b, inputs.f_b, span, grade,
                                           gyro_noise), ()
    t = inputs.t_imu
    first = max(0.0, float(t[0]))
    rows = (t >= first) & (t <= min(first + nav_alignment.MOTION_LEVEL, inputs.t_stop))
    if rows.sum() < 2:      # the IMU ends at the mark, which IMU_GAP reports
        rows = np.abs(t - first) <= np.sort(np.abs(t - first))[1]
    _, q_0b = attitude(t[rows], inputs.w_b[rows], np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    # mean speeds over 1 s at both ends, or that part of the second in which the odometer has rows
    begin, end = (np.clip(t[rows][[0, -1]] + half, *inputs.travel.t[[0, -1]])
                  for half in (-0.5, 0.5))
    travel = (inputs.travel.at(end) - inputs.travel.at(begin)) * metres_per_unit
    level = nav_alignment.level_in_motion(t[rows], inputs.f_b[rows], q_0b,
                                          travel / np.maximum(end - begin, 1e-3), latitude, grade)
    reason = Reason(Code.NO_STANDSTILL, 'no standstill before the start mark: level estimated '
                    f'over {t[rows][-1] - t[rows][0]:.0f} s of driving, gyro bias unknown '
                    f'(± {np.rad2deg(grade.gyro_bias) * 3600:.3g} deg/h)')
    return level, (reason,)


def _noise_reasons(noise: float, grade: nominal.Grade) -> tuple[Reason, ...]:
    """Return a caution if the gyro noise at rest far exceeds that of its grade."""
    ratio = noise / max(grade.gyro_noise, 1e-12)
    limit = 10.0    # larger: another gyro, or another unit
    if ratio <= limit:
        return ()
    unit = ', so its unit is probably deg/s' if 30 < ratio < 120 else ''
    return (Reason(Code.IMU_WORSE_THAN_GRADE, f'gyro noise at rest is {ratio:.0f} times that of '
                   f'its grade (limit {limit:.0f}){unit}'),)


def _noise_at_rest(inputs: Inputs, span: Floats) -> dict[str, float]:
    """Return the white noise of gyro and accelerometer, per sqrt(Hz), of the noisiest axis."""
    rows = (inputs.t_imu >= span[0]) & (inputs.t_imu <= span[1])
    t, signals = inputs.t_imu[rows], {'gyro': inputs.w_b[rows], 'accel': inputs.f_b[rows]}
    if len(t) < MIN_AT_REST:
        return {}
    root_hz = np.sqrt((len(t) - 1) / (t[-1] - t[0]))
    return {name: float((np.diff(x, axis=0).std(axis=0) / np.sqrt(2)).max() / root_hz)
            for name, x in signals.items() if inputs.has_accelerometer or name == 'gyro'}


def _select_heading(inputs: Inputs, level: LevelAttitude, latitude: float, grade: nominal.Grade,
                    config: Config) -> tuple[Heading | None, tuple[Reason, ...]]:
    """Return the heading from the first source that has one, and why the others have none."""
    setting = config.alignment.source
    order = [setting] if setting != 'auto' else [] if inputs.is_local else [
        'heading_topic', 'imu_orientation', 'gyrocompass']
    refusals = []
    for source in order if setting != 'course' else ():
        result, refusal = _heading_from_source(source, inputs, level, latitude, grade, config)
        if result is not None:
            return Heading(*result, source, source != 'gyrocompass'), ()
        refusals.append(Reason(Code.GYROCOMPASS_REFUSED if source == 'gyrocompass'
                               else Code.HEADING_UNAVAILABLE, f'heading from {source}: {refusal}'))
    return None, tuple(refusals) if setting != 'auto' else ()


def _heading_from_source(source: str, inputs: Inputs, level: LevelAttitude, latitude: float,
                         grade: nominal.Grade, config: Config) -> HeadingOrRefusal:
    """Return yaw and sigma of the x axis of L from one source."""
    if source == 'heading_topic':
        sent, t = inputs.external['heading']
        return _heading_from_orientations(t, sent.q_ni, sent.yaw_variance, np.eye(3), level,
                                          config, config.alignment.heading_offset)
    if source == 'imu_orientation':
        return _heading_from_orientations(inputs.t_imu, inputs.q_ni, inputs.yaw_variance,
                                          rotations.transpose(inputs.C_bi), level, config)
    if source == 'fixed':
        return _configured_heading(inputs, level, config)
    return _heading_by_gyrocompass(inputs, level, latitude, grade, config)


def _configured_heading(inputs: Inputs, level: LevelAttitude, config: Config) -> HeadingOrRefusal:
    """Return yaw and sigma at the level's epoch from ``alignment.heading``, that at the mark."""
    if np.isnan(config.alignment.heading):
        return None, 'alignment.heading is not set'
    mark_yaw = float(rotations.yaw_from_heading(config.alignment.heading))
    # subtract the turn since the standstill, and the direction of north there
    turn = _turn_since(inputs, level) if level.standstill and level.t < 0.0 else 0.0
    turn += float(np.arctan2(level.C_np[1, 0], level.C_np[0, 0]))
    return (float(rotations.wrap(mark_yaw - turn)), config.alignment.heading_sigma), ''


def _turn_since(inputs: Inputs, level: LevelAttitude) -> float:
    """Return the turn from the epoch of a level to the start mark, rad."""
    rows = (inputs.t_imu >= level.t) & (inputs.t_imu <= 0.0)
    if rows.sum() < 2:
        return 0.0
    rate = inputs.w_b[rows] - level.mean_rate_b
    _, q = attitude(inputs.t_imu[rows], rate, rotations.quat_from_matrix(level.C_Lb), np.zeros(3))
    C = rotations.matrix_from_quat(q[-1])
    return float(np.arctan2(C[1, 0], C[0, 0]))


def _heading_from_orientations(t: Floats, q: Floats, variance: Floats, C_ib: Floats,
                               level: LevelAttitude, config: Config, offset: float = 0.0,
                               ) -> HeadingOrRefusal:
    """Return (yaw, sigma) at the level's epoch from published orientations, or None, reason."""
    heading_reach = 0.5    # s, largest distance of a heading sample from a start in motion
    # a leg may have hours of rows: select the used ones first
    begin, end = level.standstill or (level.t - heading_reach, level.t + heading_reach)
    selected = slice(np.searchsorted(t, begin), np.searchsorted(t, end, side='right'))
    t, q, variance = t[selected], q[selected], variance[selected]
    usable = ~np.isnan(variance) & (np.linalg.norm(q, axis=-1) > 0.5)
    if not level.standstill:      # only the nearest sample
        distance = np.where(usable, np.abs(t - level.t), np.inf)
        usable = (distance <= heading_reach) & (distance == distance.min(initial=np.inf))
    if not usable.any():
        return None, 'no orientation at the start (covariance[0] = -1, or no message)'
    C_nb = rotations.matrix_from_quat(q[usable]) @ C_ib
    yaw = np.arctan2(C_nb[:, 1, 0].mean(), C_nb[:, 0, 0].mean()) + offset
    stated_variance = float(np.median(variance[usable]))
    sigma = np.sqrt(stated_variance) if stated_variance > 0 else config.alignment.heading_sigma
    if sigma > nav_alignment.HEADING_LIMIT:
        return None, (f'its sigma is {np.rad2deg(sigma):.3g} deg; the limit is '
                      f'{np.rad2deg(nav_alignment.HEADING_LIMIT):.3g} deg')
    return (float(rotations.wrap(yaw)), float(sigma)), ''


def _heading_by_gyrocompass(inputs: Inputs, level: LevelAttitude, latitude: float,
                            grade: nominal.Grade, config: Config) -> HeadingOrRefusal:
    """Return yaw and sigma by the Earth rate at a standstill."""
    if inputs.is_local:
        return None, 'the positions are in a local frame, whose y axis does not point to north'
    if level.standstill is None:
        return None, 'needs a standstill'
    yaw, sigma = nav_alignment.gyrocompass(level, latitude, grade)
    if sigma > nav_alignment.COMPASS_LIMIT:
        return None, (f'the gyro bias ({np.rad2deg(grade.gyro_bias) * 3600:.3g} deg/h) causes a '
                      f'heading uncertainty of {np.rad2deg(min(sigma, np.pi)):.1f} deg; '
                      f'the limit is {np.rad2deg(nav_alignment.COMPASS_LIMIT):.1f} deg')
    deviation = nav_alignment.earth_rate_deviation(level, latitude, grade)
    no_earth_sigmas = 4.0    # sigmas: with a larger bias there is no gyrocompass
    if deviation > no_earth_sigmas:
        return None, (f'the turn rate at rest differs from the Earth rate by {deviation:.0f} '
                      f'sigma (limit {no_earth_sigmas:.0f}): the gyro bias exceeds that of the '
                      f'{config.imu.grade} grade')
    return (yaw, sigma), ''


def _heading_by_course(inputs: Inputs, level: LevelAttitude, metres_per_unit: float,
                       fixes_n: Floats, origin: Origin, grade: nominal.Grade,
                       ) -> tuple[Heading, tuple[Reason, ...]]:
    """Return the heading that rotates the first 30 m of track onto the fixes, and reasons."""
    unknown = Heading(0.0, np.pi, 'course', True)
    trial = make_alignment(level, *unknown, origin, grade, 0.0)
    course_time = 300.0    # s within which the path for a course must be driven
    rows = (inputs.t_imu >= level.t) & (inputs.t_imu <= max(0.0, level.t) + course_time)
    t, q_nb = attitude(inputs.t_imu[rows], inputs.w_b[rows] - trial.gyro_bias, trial.q_nb,
                       origin.earth_rate_n)
    track = dead_reckon(t, q_nb, inputs.travel)
    selected = (inputs.t_fix >= max(t[0], 0.0)) & (inputs.t_fix <= t[-1])
    if selected.sum() >= 2:
        by_fixes = fixes_n[selected, :2] - fixes_n[selected][0, :2]
        dead_reckoned = track.P_at(inputs.t_fix[selected])[:, :2, 0] * metres_per_unit
        dead_reckoned = dead_reckoned - dead_reckoned[0]
        sigma_fix = np.sqrt(np.median(inputs.covariance_n[selected, 0, 0]))
        min_distance = max(nav_alignment.COURSE_DISTANCE, 8 * sigma_fix)
        distance = np.hypot(*dead_reckoned.T)
        if (distance >= min_distance).any():
            k = int(np.argmax(distance >= min_distance))
            yaw = np.arctan2(*by_fixes[k, ::-1]) - np.arctan2(*dead_reckoned[k, ::-1])
            sigma = float(np.sqrt(2) * sigma_fix / distance[k])
            return unknown._replace(yaw=float(rotations.wrap(yaw)), sigma=sigma), ()
        cause = f'less than {min_distance:.0f} m from the start within {course_time:.0f} s'
    else:
        cause = f'fewer than 2 fixes within {course_time:.0f} s of the start'
    return unknown, (Reason(Code.HEADING_UNAVAILABLE, f'no course over ground: {cause}',
                            'Drive straight on right after the start mark, under open sky.'),)
