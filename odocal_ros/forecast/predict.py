# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Prediction of the sigmas of the two-point method for a leg, before or during the drive.

In: a planned drive and the errors of its sensors. The drive is converted to the inputs of
``two_point.fit``, a track, two marks and an alignment, so that predictions and results have the
same error budget.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.drive import check_drive
from odocal_ros.calib.marks import MARK_WINDOW, MarkFix, mean_fix, standing_at
from odocal_ros.calib.result import MethodResult
from odocal_ros.calib.two_point import fit, refusal_reasons, refused_result, TwoPointInput
from odocal_ros.calib.value_limits import check_limits
from odocal_ros.data.arrays import Floats
from odocal_ros.errors import BadConfig, BadUsage
from odocal_ros.forecast.forecast import FARTHEST_LIMIT_M
from odocal_ros.forecast.planned_drive import PlannedDrive
from odocal_ros.nav import rotations
from odocal_ros.nav.alignment import (
    Alignment,
    COMPASS_LIMIT,
    COURSE_DISTANCE,
    gyrocompass,
    level_at_rest,
    level_in_motion,
    LevelAttitude,
    make_alignment,
    MOTION_LEVEL,
)
from odocal_ros.nav.dead_reckoning import dead_reckon, Origin, Track
from odocal_ros.nav.geodesy import earth_rate_n, gravity
from odocal_ros.nav.odometer import Travel
from odocal_ros.pipeline.align import choose_standstill
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import AlignmentConfig, Config
from odocal_ros.settings.levels import SWAY
from odocal_ros.settings.nominal import Grade, grade_with_turn_on_bias

SLIP = 0.01                 # m/sqrt(s), judgement: slip, before a drive determines it
EXTERNAL_SOURCES = ('fixed', 'heading_topic', 'imu_orientation')


@dataclass(frozen=True, kw_only=True)
class Sigmas:
    """
    Errors of a planned drive, 1 sigma.

    config : imu.grade, heading source and its sigma (alignment.*; ``auto`` uses the configured
    heading if it is set, else a gyrocompass if the gyro is good enough, else the course), lever
    arms, latencies, gnss.correlation_time (NaN: 60 s; 0: white).
    """

    config: Config = Config()
    fix: float = 1.5                 # m, of one fix, east and north each
    fix_up: float | None = None      # m, of one fix, up; None: twice ``fix``
    fix_rate: float = 5.0            # Hz
    quantum: float = 0.0             # m, size of an odometer count, 0 for speeds
    # for the smoother only: motion of the odometer's point to the side and up, m/s, white at 10
    # Hz; slip of the wheels, m/sqrt(s)
    sway: float = SWAY
    slip: float = SLIP

    def __post_init__(self) -> None:
        for label, value in (('fix sigma', self.fix), ('height sigma of the fixes', self._up),
                             ('fix rate', self.fix_rate),
                             ('heading sigma', self.config.alignment.heading_sigma)):
            if not (np.isfinite(value) and value > 0):
                raise BadConfig(f'{label} {value:g}: required: a number above 0')
        for label, value in (('size of a count', self.quantum), ('sway', self.sway),
                             ('slip', self.slip)):
            if not (np.isfinite(value) and value >= 0):
                raise BadConfig(f'{label} {value:g}: required: 0 or more')

    @property
    def _up(self) -> float:
        """Return the sigma of one fix up, m."""
        return 2 * self.fix if self.fix_up is None else self.fix_up

    @property
    def covariance_n(self) -> Floats:
        """Return the covariance of one fix, (3, 3) m^2."""
        return np.diag([self.fix**2, self.fix**2, self._up**2])

    @property
    def correlation_time(self) -> float:
        """Return the correlation time of fix errors, s; 0: white."""
        configured, single_receiver = self.config.gnss.correlation_time, 60.0    # s
        return single_receiver if np.isnan(configured) else configured


@dataclass(frozen=True, eq=False)
class Prediction:
    """The prediction of a drive by the two-point method."""

    method: MethodResult                  # as in a result; scale factor 1, angles 0
    reasons: tuple[Reason, ...]           # of drive, alignment and method
    alignment: Alignment
    distance: float                       # m, path length between the marks
    chord: float                          # m, distance between the marks
    duration: float                       # s
    rests: tuple[float, float]            # s of standstill at start and stop mark, 0: in motion
    drive_reasons: tuple[Reason, ...]     # the reasons that concern all methods

    def sigma(self, parameter: str) -> float | None:
        """Return the sigma of a parameter, relative or rad; None: it will not be determined."""
        return self.method.estimates[parameter].sigma


def predict(drive: PlannedDrive, sigmas: Sigmas) -> Prediction:
    """Return the two-point prediction; BadUsage if the drive is shorter than one fix interval."""
    config = sigmas.config
    if drive.duration < 1 / sigmas.fix_rate:
        raise BadUsage(f'the leg lasts {drive.duration:.3g} s, less than one fix interval '
                       f'({1 / sigmas.fix_rate:.3g} s); drive longer or raise the fix rate')
    spans = drive.standstills(config.leg.standstill)
    alignment, alignment_reasons = plan_alignment(drive, sigmas.config, sigmas.fix, spans)
    track = dead_reckon(drive.t, rotations.quat_from_matrix(drive.C_nb),
                        Travel(drive.t, drive.travel, sigmas.quantum))
    distance, drive_reasons = check_drive(track, drive.duration, 1.0, config.leg)
    keep = track.t >= alignment.t - 1e-9
    track = Track(track.t[keep], track.q_nb[keep], track.s[keep], track.P[keep])
    start, end = (_expected_mark(t, track, drive, sigmas, spans, limit) for t, limit in (
        (0.0, config.reference.start), (drive.duration, config.reference.end)))
    two_point = TwoPointInput(
        track, start, end, np.zeros(3), _velocity_change(track, (start, end)), alignment)
    reasons = (*alignment_reasons, *drive_reasons)
    if refusals := refusal_reasons(two_point, 1.0):
        method = refused_result(refusals, '1')
    else:
        method = fit(two_point, 1.0, '1', sigmas.quantum, np.ones(3), config)
        reasons += check_limits(method.estimates, 1.0, config)
    return Prediction(method, reasons + method.reasons, alignment, distance,
                      float(np.linalg.norm((end.position_n - start.position_n)[:2])),
                      drive.duration,
                      (_rest_duration(0.0, spans), _rest_duration(drive.duration, spans)),
                      tuple(r for r in drive_reasons if r.code is not Code.LEG_NOT_STRAIGHT))


def find_remaining_distance(drive: PlannedDrive, sigmas: Sigmas, parameter: str, limit: float,
                            lengthen: Callable[[PlannedDrive, float], PlannedDrive]
                            = PlannedDrive.lengthen) -> float | None:
    """
    Return the additional straight distance, m, that brings a sigma down to its limit.

    None if no distance up to FARTHEST_LIMIT_M is enough: a two-point yaw is never better than its
    heading.   lengthen : returns a drive with additional metres.
    """
    def is_enough(metres: float) -> bool:
        longer = lengthen(drive, metres) if metres else drive
        sigma = predict(longer, sigmas).sigma(parameter)
        return sigma is not None and sigma <= limit

    if is_enough(0.0):
        return 0.0
    # gyro drift may cancel the gain of a longer chord: try several lengths, then bisect
    lengths = [FARTHEST_LIMIT_M / 2**k for k in range(14, -1, -1)]
    high: float | None = next((m for m in lengths if is_enough(m)), None)
    if high is None:
        return None
    low = 0.0 if high == lengths[0] else high / 2
    while high - low > max(1.0, 0.01 * high):
        middle = (low + high) / 2
        low, high = (low, middle) if is_enough(middle) else (middle, high)
    return high


def _rest_duration(t: float, spans: Sequence[tuple[float, float]]) -> float:
    """Return the duration of the standstill at a mark, s."""
    begin, end = standing_at(t, spans) or (0.0, 0.0)
    return end - begin


def _expected_mark(t: float, track: Track, drive: PlannedDrive, sigmas: Sigmas,
                   spans: Sequence[tuple[float, float]], surveyed: tuple[float, ...]) -> MarkFix:
    """Return the expected reference position at a mark, surveyed or from the fixes at it."""
    span = standing_at(t, spans)
    forward = np.array([1.0, 0.0, 0.0])
    position_n = (track.P_at(np.array(t)) - track.P_at(np.array(0.0))) @ forward
    if surveyed:
        return MarkFix(t, position_n, np.eye(3) * surveyed[3]**2, span is not None, 0,
                       surveyed=True)
    window = max(MARK_WINDOW, 2.5 / sigmas.fix_rate)
    low, high = span or (t - window, t + window)
    low, high = max(low, drive.t[0]), min(high, drive.duration)
    n = max(1, int((high - low) * sigmas.fix_rate))
    times = low + np.arange(n) / sigmas.fix_rate
    mean = mean_fix(times, np.zeros((n, 3)), np.tile(sigmas.covariance_n, (n, 1, 1)),
                    sigmas.correlation_time)
    return MarkFix(t, position_n, mean.covariance_n, span is not None, mean.fix_count)


def _velocity_change(track: Track, marks: tuple[MarkFix, MarkFix]) -> Floats:
    """Return C_nb s' at the end minus at the start, 0 at resting or surveyed marks: (3, 3)."""
    change = np.zeros((3, 3))
    for mark, sign in zip(marks, (-1.0, 1.0), strict=True):
        if not (mark.standing or mark.surveyed):
            rate = np.interp(mark.t, track.t, np.gradient(track.s, track.t))
            change += sign * track.C_nb_at(np.array(mark.t)) * rate
    return change


class _Heading(NamedTuple):
    """Source of a heading, its sigma, rad, and the reasons for the choice."""

    source: str
    sigma: float
    reasons: tuple[Reason, ...] = ()


def plan_alignment(drive: PlannedDrive, config: Config, fix_sigma: float,
                   spans: list[tuple[float, float]]) -> tuple[Alignment, tuple[Reason, ...]]:
    """
    Return the alignment of a planned drive, and its reasons.

    config : grade, heading source and its sigma.   fix_sigma : of one fix, m, for a course.
    spans : list of (begin, end) standstills, s.
    """
    grade = grade_with_turn_on_bias(config.imu)
    span = choose_standstill(spans)
    level_reasons: tuple[Reason, ...] = ()
    if span is not None:
        level = _level_at_rest(drive, span, grade)
    else:
        level = _level_in_motion(drive, grade)
        level_reasons = (Reason(
            Code.NO_STANDSTILL, 'no standstill before the start mark: level and gyro bias are '
            'estimated from the drive'),)
    heading = _plan_heading(config.alignment, fix_sigma, level, grade, drive.latitude)
    alignment = make_alignment(
        level, float(np.interp(level.t, drive.t, drive.yaw)), heading.sigma, heading.source,
        heading.source != 'gyrocompass', Origin(drive.latitude, drive.longitude, drive.height),
        grade, grade.gyro_noise)
    return alignment, level_reasons + heading.reasons


def _level_at_rest(drive: PlannedDrive, span: tuple[float, float], grade: Grade) -> LevelAttitude:
    """Return the level of a standstill from the mean of its planned samples."""
    span = (span[0], min(span[1], drive.duration))
    C_bn = rotations.transpose(drive.C_nb[int(np.searchsorted(drive.t, span[0]))])
    up_b, earth_b = C_bn[:, 2], C_bn @ earth_rate_n(drive.latitude)
    return level_at_rest(np.array(span), np.tile(earth_b, (2, 1)),
                         np.tile(up_b * gravity(drive.latitude, drive.height), (2, 1)), span,
                         grade, grade.gyro_noise)


def _level_in_motion(drive: PlannedDrive, grade: Grade) -> LevelAttitude:
    """Return the level from the beginning of the drive, MOTION_LEVEL s long."""
    rows = (drive.t >= 0.0) & (drive.t <= MOTION_LEVEL)
    if rows.sum() < 2:
        rows = np.arange(len(drive.t)) < 2
    t, C_nb = drive.t[rows], drive.C_nb[rows]
    velocity_n = C_nb[:, :, 0] * drive.speed[rows][:, None]
    f_n = np.gradient(velocity_n, t, axis=0) + [0.0, 0.0, gravity(drive.latitude, drive.height)]
    q_nb = rotations.quat_from_matrix(C_nb)
    return level_in_motion(t, rotations.rotate_back(C_nb, f_n),
                           rotations.quat_multiply(rotations.quat_conjugate(q_nb[0]), q_nb),
                           drive.speed[rows][[0, -1]], drive.latitude, grade)


def _plan_heading(config: AlignmentConfig, fix_sigma: float, level: LevelAttitude, grade: Grade,
                  latitude: float) -> _Heading:
    """Return the heading that the alignment will use."""
    source = config.source
    if source in EXTERNAL_SOURCES:
        return _Heading(source, config.heading_sigma)
    reasons: tuple[Reason, ...] = ()
    if source in ('auto', 'gyrocompass'):
        problem = 'needs a standstill'
        if level.standstill is not None:
            _, sigma = gyrocompass(level, latitude, grade)
            if sigma <= COMPASS_LIMIT:
                return _Heading('gyrocompass', sigma)
            problem = ('the gyro bias causes a heading uncertainty of '
                       f'{np.rad2deg(min(sigma, np.pi)):.1f} deg; the limit is '
                       f'{np.rad2deg(COMPASS_LIMIT):.1f} deg')
        if source == 'gyrocompass':
            reasons = (Reason(Code.GYROCOMPASS_REFUSED, f'heading from gyrocompass: {problem}'),)
    path_length = max(COURSE_DISTANCE, 8 * fix_sigma)
    return _Heading('course', float(np.sqrt(2) * fix_sigma / path_length), reasons)
