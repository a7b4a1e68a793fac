# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The two-point method: scale, yaw and pitch from the end of a leg, dead reckoned and by fixes.

Shi et al. 2015 uses the ratio of two chords in a plane and the angle between them, eq. (6)-(10).
The same similarity is solved here in the Earth-fixed Cartesian frame n, where track and truth are
exactly similar. With M the attitude summed over travel and c the chord, the vector between the
reference positions of the marks, M f = c gives f = K forward_b: the scale K times the forward axis
in b, which is scale, yaw and pitch at once.
Frames n, b and v: ``odocal_ros/__init__.py``.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from odocal_ros.calib import budget
from odocal_ros.calib.marks import MarkFix
from odocal_ros.calib.mounting import BACKWARDS_YAW, FAR_YAW
from odocal_ros.calib.number_text import with_limit
from odocal_ros.calib.result import Estimate, MethodResult, Source, unknown_values
from odocal_ros.calib.slip import slip_source
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.alignment import Alignment
from odocal_ros.nav.dead_reckoning import axes_from_forward, mounting_from_forward, Track
from odocal_ros.nav.rotations import wrap
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.nominal import nominal_yaw

# rad, prior sigma of the pitch without information from heights: physical, by holders and loads
PITCH_PRIOR = 0.05
# rad: a pitch above 15 deg is due to wrong heights, not to a mounting. Physical, judgement
PITCH_LIMIT = 0.26
# judgement: of the path length; on a shorter chord the errors of its ends dominate
MIN_CHORD_SHARE = 0.2


@dataclass(frozen=True, eq=False)
class TwoPointInput:
    """Input of the two-point method."""

    track: Track
    start: MarkFix
    end: MarkFix
    lever_v: Floats     # (3,) antenna from the odometer's point, m
    velocity_change: Floats  # (3, 3) end minus start; times f: m/s in n
    alignment: Alignment
    # travel lost in gaps and resets: times, s, and sigmas, scale units
    lost_travel: tuple[Floats, Floats] = (np.empty(0), np.empty(0))
    # wheel slips: times, s, and sizes, m
    slips: tuple[Floats, Floats] = (np.empty(0), np.empty(0))

    @property
    def M(self) -> Floats:
        """Return M of docs/method.md (T3): attitude summed over travel, (3, 3) scale units."""
        return self.track.P_at(self.end.t) - self.track.P_at(self.start.t)


def solve(inputs: TwoPointInput, up_scale: float = 1.0) -> tuple[Floats, Reason | None]:
    """
    Return f of M f = c, (3,) m per unit of travel: (T3), (T4).

    Without usable heights the pitch is zero, and the reason is returned.   up_scale : factor on
    the stated height sigmas.
    """
    height_sigma = np.sqrt(inputs.start.covariance_n[2, 2] + inputs.end.covariance_n[2, 2])
    horizontal = np.hypot(*(inputs.end.position_n - inputs.start.position_n)[:2])
    cause = 'are unknown'
    if inputs.start.height_known and inputs.end.height_known:
        cause = 'are too inaccurate for the pitch'
        if up_scale * height_sigma < PITCH_PRIOR * horizontal:
            f = _solve_chord(inputs, with_heights=True)
            if abs(np.arctan2(f[2], np.hypot(f[0], f[1]))) <= PITCH_LIMIT:
                return f, None
            _, pitch = mounting_from_forward(f / np.linalg.norm(f))
            return solve_level(inputs), Reason(
                Code.TRACK_MISMATCH, 'the heights of the marks give a pitch of '
                f'{np.rad2deg(float(pitch)):+z.0f} deg; the limit is '
                f'{np.rad2deg(PITCH_LIMIT):.0f} deg', 'Set imu.mounting_rpy to the approximate '
                'pitch of the IMU, or check the heights and their unit.')
    return solve_level(inputs), Reason(
        Code.PITCH_NOT_DETERMINED, f'the heights of the marks {cause}; '
        f'0 ± {np.rad2deg(PITCH_PRIOR):.1f} deg is assumed')


def solve_level(inputs: TwoPointInput) -> Floats:
    """Return f as ``solve``, with a pitch of zero and without the heights."""
    return _solve_chord(inputs, with_heights=False)


def _solve_chord(inputs: TwoPointInput, with_heights: bool) -> Floats:
    """Return f of M f = c; without heights, from the horizontal rows and with a pitch of zero."""
    M = inputs.M
    attitude_change = inputs.track.C_nb_at(inputs.end.t) - inputs.track.C_nb_at(inputs.start.t)
    antenna = inputs.end.position_n - inputs.start.position_n
    f = np.array([1.0, 0.0, 0.0])
    # the lever arm turns with the mounting angles: each pass reduces the error by its ratio to
    # the chord, usually below 1 %
    for _ in range(4):
        c = antenna - attitude_change @ axes_from_forward(f) @ inputs.lever_v
        f = (np.linalg.solve(M, c) if with_heights
             else np.append(np.linalg.solve(M[:2, :2], c[:2]), 0.0))
    return f


def refusal_reasons(inputs: TwoPointInput, scale_guess: float) -> tuple[Reason, ...]:
    """Return the reason against the method if the chord is short; scale_guess: m per unit."""
    inside = (inputs.track.t >= inputs.start.t) & (inputs.track.t <= inputs.end.t)
    path = np.abs(np.diff(inputs.track.s[inside])).sum() * scale_guess
    length = np.hypot(*(inputs.end.position_n - inputs.start.position_n)[:2])
    # |det M|^(1/2) is the chord length of the track per unit of scale, for any yaw
    reckoned_length = np.sqrt(abs(np.linalg.det(inputs.M[:2, :2]))) * scale_guess
    for name, chord_length in (('', length), (' of the dead-reckoned track', reckoned_length)):
        if chord_length <= MIN_CHORD_SHARE * path:
            return (Reason(Code.CHORD_TOO_SHORT, f'the line between start and end{name} is '
                           f'{chord_length:.1f} m, less than a fifth of the path length of about '
                           f'{path:.0f} m'),)
    return ()


def _unknown(scale_unit: str) -> dict[str, Estimate]:
    return unknown_values(scale_unit) | {
        f'gyro_bias_{axis}': Estimate(None, None, 'rad/s') for axis in 'xyz'}


def refused_result(reasons: Iterable[Reason], scale_unit: str) -> MethodResult:
    """Return the result of a leg that the method refuses: every value unknown."""
    return MethodResult('two_point', tuple(reasons), _unknown(scale_unit), budget.PARAMETERS)


def fit(inputs: TwoPointInput, nominal_scale: float, scale_unit: str, quantum: float,
        fix_scale: Floats, config: Config) -> MethodResult:
    """
    Return scale, yaw and pitch of one leg with their sigmas and the error budget.

    inputs : track, marks and alignment of the leg.   nominal_scale : K0, 0 where unknown.
    quantum : size of a count in scale units, 0 for speeds.   fix_scale : (3,) factor on the stated
    fix sigmas, east, north, up.   config : limits.
    """
    f, pitch_reason = solve(inputs, fix_scale[2])
    sources = (*_sources(inputs, f, pitch_reason is None, quantum, fix_scale, config),
               *_travel_sources(inputs, f))
    covariance = budget.total_covariance(sources)
    sigma = np.sqrt(np.diag(covariance))
    K = float(np.linalg.norm(f))
    yaw, pitch = (float(a) for a in mounting_from_forward(f / K))
    reasons, yaw_known = _yaw_reasons(inputs.alignment, yaw, sources, config)
    reasons += (pitch_reason,) if pitch_reason else ()
    estimates = _unknown(scale_unit)
    estimates['scale_factor'] = Estimate(K, K * float(sigma[0]), scale_unit)
    if nominal_scale:
        ratio = K / nominal_scale
        estimates['scale_ratio'] = Estimate(ratio, ratio * float(sigma[0]), '1')
    if yaw_known:
        estimates['yaw_mounting_angle'] = Estimate(yaw, float(sigma[1]), 'rad')
    if pitch_reason is None:
        estimates['pitch_mounting_angle'] = Estimate(pitch, float(sigma[2]), 'rad')
    if inputs.alignment.standstill is not None:
        for axis, bias, bias_sigma in zip('xyz', inputs.alignment.gyro_bias,
                                          inputs.alignment.gyro_bias_sigma, strict=True):
            estimates[f'gyro_bias_{axis}'] = Estimate(float(bias), float(bias_sigma), 'rad/s')
    return MethodResult('two_point', reasons, estimates, budget.PARAMETERS, sources, {
        'budget': budget.budget_table(sources, budget.PARAMETERS, (K, 1.0, 1.0)),
        'correlation': budget.correlations(covariance, budget.PARAMETERS),
        'heading_source': inputs.alignment.heading_source, 'f': f})


def _sources(inputs: TwoPointInput, f: Floats, vertical_known: bool, quantum: float,
             fix_scale: Floats, config: Config) -> tuple[Source, ...]:
    """Return the error sources but those of lost travel and slip; arguments as for ``fit``."""
    track = inputs.track
    # gyro errors accumulate from the alignment, with a fixed heading from the start mark
    first = inputs.start.t if inputs.alignment.heading_source == 'fixed' else inputs.alignment.t
    rows = track.rows_between(min(first, inputs.start.t), inputs.end.t)
    t = track.t[rows]
    D = track.displacement(rows, inputs.start.t, f) * (t >= inputs.start.t)[:, None]
    start, end, M = inputs.start, inputs.end, inputs.M
    if not vertical_known:       # the prior of the pitch replaces the heights
        fix_scale = np.append(fix_scale[:2], 1.0)
        rise = PITCH_PRIOR * float(np.linalg.norm(M @ f))
        start, end = _with_height_sigma(start, 0.0), _with_height_sigma(end, rise)
    K = float(np.linalg.norm(f))
    return budget.budget(f, M, start, end, t, D, track.q_nb[rows], inputs.alignment,
                         inputs.velocity_change @ f, budget.Uncertainties(
                             fix_scale=fix_scale, quantum=quantum * K,
                             time_sigma=config.gnss.time_sigma,
                             odometer_time_sigma=config.odometer.time_sigma,
                             lever_arm_sigma=config.gnss.lever_arm_sigma))


def _travel_sources(inputs: TwoPointInput, f: Floats) -> tuple[Source, ...]:
    """Return the sources of travel lost in gaps and resets, and of slip; empty if none."""
    gradient = budget.parameter_gradient(f) @ np.linalg.inv(inputs.M)
    sources: tuple[Source, ...] = ()
    if len(inputs.slips[0]):
        sources += (slip_source(inputs.track, f, gradient, *inputs.slips),)
    t, sigma = inputs.lost_travel
    inside = (t >= inputs.start.t) & (t <= inputs.end.t) & (sigma > 0)
    if inside.any():
        along_n = inputs.track.C_nb_at(t[inside]) @ f * sigma[inside, None]      # (k, 3) m
        sources += (Source('odometer_gaps', gradient @ along_n.T),)
    return sources


def _with_height_sigma(mark: MarkFix, sigma: float) -> MarkFix:
    """Return the mark with another sigma of its height, m, without correlation."""
    covariance = mark.covariance_n.copy()
    covariance[2, :] = covariance[:, 2] = 0.0
    covariance[2, 2] = sigma**2
    return replace(mark, covariance_n=covariance)


def _yaw_reasons(alignment: Alignment, yaw: float, sources: tuple[Source, ...],
                 config: Config) -> tuple[tuple[Reason, ...], bool]:
    """Return the reasons about yaw (rad), from the heading, and True if it is separable."""
    limit = config.verdict.max_yaw_sigma
    heading_source = next(s for s in sources if s.name == 'initial_heading')
    heading_sigma = float(np.linalg.norm(heading_source.effects[1]))
    reasons: tuple[Reason, ...] = ()
    if not alignment.heading_separable:
        reasons += (Reason(Code.YAW_NOT_SEPARABLE, 'the only heading is the course over ground, '
                           'which includes the mounting angle: the end points only constrain the '
                           'sum of heading and yaw'),)
    elif heading_sigma > limit:
        sigma_text = with_limit(float(np.rad2deg(heading_sigma)), float(np.rad2deg(limit)), 'deg')
        reasons += (Reason(Code.YAW_NOT_SEPARABLE, 'heading uncertainty '
                           f'({alignment.heading_source}) is {sigma_text}: the end points only '
                           'constrain the sum of heading and yaw'),)
    deviation = abs(float(wrap(yaw - nominal_yaw(config))))
    if alignment.heading_separable and deviation > BACKWARDS_YAW:
        reasons += (Reason(Code.ODOMETER_REVERSED, 'the track runs opposite to the fixes: '
                           'positive counts mean reverse motion, or the IMU x axis points '
                           f'backwards (yaw {np.rad2deg(yaw):+z.1f} deg)'),)
    elif alignment.heading_separable and deviation > FAR_YAW:
        reasons += (Reason(Code.YAW_FAR_FROM_NOMINAL, f'heading ({alignment.heading_source}) and '
                           f'course give a yaw mounting of {np.rad2deg(yaw):+z.1f} deg, '
                           f'{np.rad2deg(deviation):.1f} deg from its nominal value; the limit is '
                           f'{np.rad2deg(FAR_YAW):.0f} deg'),)
    return reasons, alignment.heading_separable and heading_sigma <= limit
