# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Cold start: the first state of a fit (tilt, gyro bias, scale, heading, yaw mounting) from samples.

The frame L is level, with the heading of the IMU at the first keyframe. Horizontal vectors are
complex, x + i y in L or east + i north in n: a factor exp(i a) rotates by the angle a.

The gyro gives the attitude relative to the first keyframe. The mean specific force of the drive is
up; its apparent rotation is the gyro bias about the horizontal axes. The fit of the odometer's
track in the level frame to the fixes gives the scale and the angle chi, heading psi minus yaw
mounting; a change of chi is the gyro bias about up. psi is the rotation from the specific force to
the accelerations of the track. A gyro warms up: a long leg is divided into sections.
"""

from dataclasses import dataclass, replace

import numpy as np

from odocal_ros.calib.reversals import cut_sections
from odocal_ros.calib.track_check import find_inliers
from odocal_ros.data.arrays import Complexes, Floats
from odocal_ros.estimator.factors.odometer import odometer_speed
from odocal_ros.estimator.imu import gyro_bias_at_rest, ImuSteps
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.preintegrate import Intervals, preintegrate
from odocal_ros.estimator.state import LN_K, M, PITCH, Priors, State, YAW
from odocal_ros.nav.alignment import level_frame
from odocal_ros.nav.dead_reckoning import forward_b
from odocal_ros.nav.geodesy import gravity
from odocal_ros.nav.rotations import exp_so3, skew, wrap
from odocal_ros.nav.time_series import fit_robust_line

MEDIAN_RADIUS = 1.18        # statistical: median of a two-dimensional normal error, in sigmas
SECTION_LENGTH = 600.0      # s, judgement: a gyro that warms up has one bias for this time
# rad, judgement: sigma beyond which a heading from accelerations may be wrong, and is unknown
AMBIGUOUS_HEADING, MAX_HEADING_SIGMA = 0.1, 0.2


class FittedTrack:
    """
    The track of the odometer, with the x axis of b as forward axis, fitted to the fixes.

    X : (N,) track, scale units, complex, in L.   K : metres per unit.   chi : rad, rotation from X
    to the fixes at the first keyframe.   slope : rad/s, change of chi with time, None without
    fixes.   chi_t : (N,) rad, chi at the keyframes.   position : (N,) m, complex, in n.
    height : (N,) m.   scatter : m, of the fixes about the track.
    """

    def __init__(self, leg: SmootherLeg, t: Floats, C_Lk: Floats, sums: Intervals) -> None:
        step = (C_Lk[:-1] @ sums.S)[:, :2, 0]
        self.X = np.concatenate([[0.0], np.cumsum(step[:, 0] + 1j * step[:, 1])])
        inside = (leg.t_fix >= t[0]) & (leg.t_fix <= t[-1])
        t_fix, fix = leg.t_fix[inside], leg.fixes_n[inside]
        z = fix[:, 0] + 1j * fix[:, 1]
        self._fit(t_fix, z, np.interp(t_fix, t, self.X), leg)
        self.chi_t = self.chi + (self.slope or 0.0) * (t - t[0])
        self.position = self._corrected(t, t_fix, z)
        self.height = _window_medians(t, t_fix, np.where(np.isnan(fix[:, 2]), 0.0, fix[:, 2]))
        scatter = np.median(np.abs(np.interp(t_fix, t, self.position) - z))
        self.scatter = max(float(scatter) / MEDIAN_RADIUS, 1e-3)

    def _fit(self, t_fix: Floats, z: Complexes, X: Complexes, leg: SmootherLeg) -> None:
        """Fit K, chi and its slope; z, X : (m,) fixes, m, and track at their times."""
        sigma = float(np.sqrt(np.median(leg.covariance_n[:, 0, 0])))
        self.K, self.slope = leg.rough_scale, None
        # weighted by the odometer path, not by that of the fixes, which may jump
        track_step, fix_step = np.diff(X), np.diff(z)
        self.chi = float(np.angle((
            track_step.conj() * fix_step / np.maximum(np.abs(fix_step), sigma)).sum()))
        xy, fix_xy = (np.stack([x.real, x.imag], -1) for x in (X, z))
        for _ in range(2):
            residual = self.K * np.exp(1j * self.chi) * X - z
            inliers, noise = find_inliers(np.stack([residual.real, residual.imag], -1), sigma)
            sections = cut_sections((xy * self.K)[inliers], fix_xy[inliers], t_fix[inliers], noise)
            rotation = -sections.heading_error
            if not len(rotation):
                break
            mean = float(np.angle(np.exp(1j * rotation).sum()))
            if len(rotation) > 1:
                rotation = np.unwrap(mean + wrap(rotation - mean))
            self.chi, self.slope = fit_robust_line(sections.t, rotation)
            # scale: median ratio of the chords between the fixes nearest to the section times
            nearest = np.interp(sections.t, t_fix, np.arange(len(t_fix)))
            k = np.unique(np.round(nearest).astype(int))
            path, chord = np.abs(np.diff(X[k])), np.abs(np.diff(z[k]))
            if (path > 0).any():
                self.K = float(np.median(chord[path > 0] / path[path > 0]))

    def _corrected(self, t: Floats, t_fix: Floats, z: Complexes) -> Complexes:
        """Return the track plus the smoothed difference from the fixes: (N,) m, complex, in n."""
        steps = np.diff(self.X) * np.exp(1j * (self.chi_t[:-1] + self.chi_t[1:]) / 2) * self.K
        path = np.concatenate([[0.0], np.cumsum(steps)])
        difference = z - np.interp(t_fix, t, path)
        east, north = (_window_medians(t, t_fix, x) for x in (difference.real, difference.imag))
        return path + east + 1j * north


def _window_medians(t: Floats, t_fix: Floats, y: Floats) -> Floats:
    """Return medians of y over windows of 20 s, interpolated to t; zeros without fixes: (N,)."""
    if not len(y):
        return np.zeros(len(t))
    window = np.floor((t_fix - t_fix[0]) / 20.0).astype(int)
    masks = [window == k for k in np.unique(window)]
    t_medians, medians = ([np.median(x[mask]) for mask in masks] for x in (t_fix, y))
    return np.asarray(np.interp(t, t_medians, medians))


@dataclass(frozen=True, eq=False)
class _Section:
    """The estimates in a section of a leg."""

    t: Floats           # (n,) s, times of its keyframes
    C_Lk: Floats        # (n, 3, 3) attitudes, from b to the frame L of the section
    gyro_bias: Floats   # (3,) rad/s
    track: FittedTrack
    psi: float          # rad, rotation from L to n, from accelerations
    psi_sigma: float    # rad


@dataclass(frozen=True, eq=False)
class Start:
    """A first state and its uncertainty."""

    state: State
    yaw_sigma: float        # rad, of the heading from accelerations
    fix_scatter: float      # m, scatter of the fixes about the track


def cold_starts(leg: SmootherLeg, imu: ImuSteps, priors: Priors,
                configured_yaw: float) -> list[Start]:
    """
    Return the first state of a leg, or two if accelerations give an ambiguous heading.

    priors : with the sigma of the gyro bias.   configured_yaw : rad, yaw mounting of the second
    state, or of the only state without an accelerometer.
    """
    sections = _estimate_sections(leg, imu, priors)
    paths = [np.abs(np.diff(section.track.X)).sum() + 1e-9 for section in sections]
    K = float(np.average([section.track.K for section in sections], weights=paths))
    weight = np.array([1 / section.psi_sigma**2 for section in sections])
    sigma = float(1 / np.sqrt(weight.sum())) if weight.any() else np.inf
    yaws = [configured_yaw]
    if leg.has_accelerometer:
        rotations = [np.exp(1j * (section.psi - section.track.chi)) for section in sections]
        yaw = float(np.angle(weight @ rotations)) if sigma <= MAX_HEADING_SIGMA else 0.0
        is_ambiguous = min(sigma, abs(float(wrap(configured_yaw - yaw)))) > AMBIGUOUS_HEADING
        yaws = [yaw, configured_yaw] if is_ambiguous else [yaw]
    scatter = float(np.median([section.track.scatter for section in sections]))
    return [Start(_join_sections(leg, sections, K, yaw), sigma, scatter) for yaw in yaws]


def _estimate_sections(leg: SmootherLeg, imu: ImuSteps, priors: Priors) -> list[_Section]:
    """Return the sections of a leg, each of about SECTION_LENGTH or longer."""
    # a section with too few fixes for a heading is joined with the next one, the last section with
    # the one before it
    count = max(1, round(float(np.ptp(imu.t_keyframes)) / SECTION_LENGTH))
    ends = np.linspace(0, len(imu.keyframes) - 1, count + 1).astype(int).tolist()
    sections, starts = list[_Section](), [0]      # indices of the first keyframes

    def estimate(first: int, last: int) -> _Section:
        part = replace(imu, keyframes=imu.keyframes[first:last + 1])
        bias = sections[-1].gyro_bias if sections else np.zeros(3)
        return _estimate_section(leg, part, priors, bias)

    for last in ends[1:]:
        begin, end = imu.t_keyframes[[starts[-1], last]]
        if np.count_nonzero((leg.t_fix >= begin) & (leg.t_fix <= end)) < 2:
            continue
        section = estimate(starts[-1], last)
        if section.track.slope is not None:
            sections.append(section)
            starts.append(last)
    if starts[-1] < ends[-1]:
        sections[-1:] = [estimate(starts[-2] if sections else 0, ends[-1])]
    return sections


def _estimate_section(leg: SmootherLeg, imu: ImuSteps, priors: Priors, bias: Floats) -> _Section:
    """Return a section; bias : (3,) rad/s, gyro bias of the section before it."""
    bias_at_rest = gyro_bias_at_rest(leg, imu)
    if bias_at_rest is None:
        sigma = np.maximum(priors.gyro_bias_sigma, 1e-3)
    else:       # rad/s, judgement: the drift of a consumer gyro in a leg
        bias, sigma = bias_at_rest, np.full(3, 2e-4)
    count, change = len(imu.keyframes) - 1, np.zeros(3)
    at_bias, _ = preintegrate(imu, np.tile(bias, (count, 1)), np.zeros((count, 3)), leg.travel.at,
                              forward_b(0.0, 0.0), np.empty(0))        # no times within
    sums, C_0k = change_gyro_bias(at_bias, change)
    for _ in range(2):
        up, correction = _find_level(leg, sums, C_0k, sigma)
        change = change + correction
        sums, C_0k = change_gyro_bias(at_bias, change)
        sigma = np.minimum(sigma, 5e-4)
    C_Lk = level_frame(up) @ C_0k
    t = imu.t_keyframes
    track = FittedTrack(leg, t, C_Lk, sums)
    if track.slope is not None:
        up_b = C_Lk[:, 2].mean(axis=0)
        change = change - track.slope * up_b / np.linalg.norm(up_b)
        sums, C_0k = change_gyro_bias(at_bias, change)
        C_Lk = level_frame(up) @ C_0k
        track = FittedTrack(leg, t, C_Lk, sums)
    return _Section(t, C_Lk, bias + change, track, *_find_heading(leg, t, C_Lk, sums, track))


def change_gyro_bias(sums: Intervals, change: Floats) -> tuple[Intervals, Floats]:
    """Return sums with a gyro bias increased by ``change``, and the attitudes C_0k: (N, 3, 3)."""
    # R_by_gyro is the rotation by a smaller bias, the other derivatives are by a larger one
    bias = slice(0, 3)
    S = sums.S.copy()
    S[:, :, 0] += sums.S_by_gyro[:, :, bias] @ change
    sums = replace(sums, R=exp_so3(-sums.R_by_gyro[:, :, bias] @ change) @ sums.R,
                   dv=sums.dv + sums.dv_by_gyro[:, :, bias] @ change, S=S)
    C = np.empty((len(sums.T) + 1, 3, 3))
    C[0] = np.eye(3)
    for k, R in enumerate(sums.R):
        C[k + 1] = C[k] @ R
    return sums, C


def _find_level(leg: SmootherLeg, sums: Intervals, C_0k: Floats,
                bias_sigma: Floats) -> tuple[Floats, Floats]:
    """Return up in the frame of the first keyframe and the change of the gyro bias: (3,) each."""
    C, T = C_0k[:-1], sums.T
    force = np.einsum('kij,kj->ki', C, sums.dv) / T[:, None]
    # rotation by a gyro bias of one rad/s up to the middle of each interval, s
    rotation = np.cumsum(C @ sums.A, axis=0) - C @ sums.A / 2
    g = gravity(leg.origin.latitude, leg.origin.height)
    up = np.median(force, axis=0)
    up = up / np.linalg.norm(up)
    car_acceleration = 1.0      # m/s^2, 1 sigma over 1 s: physical
    weight = np.sqrt(T) / car_acceleration
    change = np.zeros(3)
    for _ in range(3):      # Gauss-Newton: residual r, derivatives J by up and the bias
        J = np.concatenate([np.broadcast_to(np.eye(3) * g, (len(T), 3, 3)),
                            -g * skew(up) @ rotation], axis=2) * weight[:, None, None]
        r = (force - g * up) * weight[:, None]
        H = np.einsum('kri,krj->ij', J, J) + np.diag(np.r_[np.zeros(3), 1 / bias_sigma**2])
        x = np.linalg.solve(H, np.einsum('kri,kr->i', J, r))
        change = x[3:]
        up = up + x[:3]
        up = up / np.linalg.norm(up)
    return up, change


def _find_heading(leg: SmootherLeg, t: Floats, C_Lk: Floats, sums: Intervals,
                  track: FittedTrack) -> tuple[float, float]:
    """Return the rotation from L to n, from accelerations, and its sigma: rad."""
    # least squares: change of velocity along the track = x_0 times the integral of the specific
    # force in L, plus a tilt (constant in L) and an accelerometer bias (constant in b)
    direction = C_Lk[:, 0, 0] + 1j * C_Lk[:, 1, 0]
    direction = direction / np.maximum(np.abs(direction), 1e-9)
    v = track.K * odometer_speed(leg.travel.at, t) * direction * np.exp(1j * track.chi_t)
    F = (C_Lk[:-1] @ sums.dv[:, :, None])[:, :, 0]
    F = F[:, 0] + 1j * F[:, 1]
    drift = np.exp(1j * (track.chi_t[:-1] - track.chi))
    T = sums.T
    lag = min(3, len(T))        # intervals, to average noise: judgement
    columns = [np.convolve(c, np.ones(lag), 'valid')
               for c in (F * drift, T.astype(complex), T * direction[:-1] * drift)]
    y = v[lag:] - v[:-lag]
    A = np.stack(columns, -1)
    w = np.ones(len(y))
    x, sigma = np.array([1.0, 0.0, 0.0], complex), np.inf
    for _ in range(4):
        H = (A.conj().T * w) @ A + 1e-9 * np.eye(3)
        x = np.linalg.solve(H, (A.conj().T * w) @ y)
        r = np.abs(y - A @ x)
        scatter = max(np.median(r) / MEDIAN_RADIUS, 1e-3)
        w = np.minimum(1.0, 2 * scatter / np.maximum(r, 1e-9))
        sigma = scatter * np.sqrt(lag * np.linalg.inv(H)[0, 0].real) / max(abs(x[0]), 1e-9)
    # |x_0| is 1 if the accelerations are those of the track; half: judgement
    return float(np.angle(x[0])), float(sigma) if abs(x[0]) >= 0.5 else np.inf


def _state(leg: SmootherLeg, section: _Section, K: float, yaw: float) -> State:
    """Return the state of a section with scale and yaw mounting of the leg."""
    t, track, N = section.t, section.track, len(section.t)
    rotation, C_nL = np.exp(1j * (track.chi_t + yaw)), np.zeros((N, 3, 3))
    C_nL[:, 0, 0] = C_nL[:, 1, 1] = rotation.real
    C_nL[:, 1, 0], C_nL[:, 0, 1], C_nL[:, 2, 2] = rotation.imag, -rotation.imag, 1.0
    C_nb = C_nL @ section.C_Lk
    constants = np.zeros(M)
    constants[[LN_K, YAW, PITCH]] = np.log(K), yaw, 0.0
    v_n = (C_nb @ forward_b(yaw, 0.0)) * (K * odometer_speed(leg.travel.at, t))[:, None]
    v_n[:, 2] = 0.0
    p_n = np.stack([track.position.real, track.position.imag, track.height], -1)
    return State(t, p_n, v_n, C_nb, gyro_bias=np.tile(section.gyro_bias, (N, 1)),
                 accel_bias=np.zeros((N, 3)), travel_error=np.zeros(N), slow_n=np.zeros((N, 3)),
                 constants=constants)


def _join_sections(leg: SmootherLeg, sections: list[_Section], K: float, yaw: float) -> State:
    """Return the states of adjacent sections as one; their common keyframes appear once."""
    states = [_state(leg, section, K, yaw) for section in sections]
    arrays = [state.keyframe_arrays() for state in states]
    return replace(states[0], **{name: np.concatenate([
        x[name][min(k, 1):] for k, x in enumerate(arrays)]) for name in arrays[0]})
