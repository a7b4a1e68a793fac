# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Cold start: level, gyro bias, scale, heading and yaw mounting angle, without initial values.

The gyro gives the attitude relative to the first keyframe. The mean specific force of the drive
is up; its apparent rotation is the gyro bias about the horizontal axes. In the level frame the
odometer gives the shape of the track. Its fit to the fixes gives the scale and the sum of heading
and mounting angle; a change of this angle is the gyro bias about up. The heading alone is the
rotation from the specific force to the accelerations of the track.
"""

from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.check import steady
from odocal_ros.calib.reversal import pieces
from odocal_ros.data.arrays import Bools, Complexes, Floats
from odocal_ros.data.pieces import by_row
from odocal_ros.estimator.imu_steps import ImuSteps
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.preintegrate import preintegrate
from odocal_ros.estimator.state import LN_K, M, PITCH, Priors, State, YAW
from odocal_ros.estimator.sums import Intervals
from odocal_ros.nav.alignment import C_nL, level_frame
from odocal_ros.nav.angles import wrap
from odocal_ros.nav.earth import gravity
from odocal_ros.nav.rotations import skew

# s each side, for the mean of a speed: some rows of an odometer. Judgement
SPEED_WINDOW = 0.4


@dataclass(frozen=True, eq=False)
class Start:
    """A first state and its uncertainty."""

    state: State
    yaw_sigma: float        # rad, of the heading by acceleration
    fix_spread: float       # m, scatter of the fixes about the track


def standing(leg: SmootherLeg, t: Floats) -> Bools:
    """Return a mask of times in a standstill, half a second from its ends: (N,) bool."""
    def within(t: Floats) -> Bools:
        inside = np.zeros(len(t), bool)
        for begin, end in leg.standstills:
            inside |= (t >= begin + 0.5) & (t <= end - 0.5)
        return inside
    return by_row(within, t)


def rest_bias(leg: SmootherLeg, imu: ImuSteps) -> tuple[Floats, float]:
    """Return the mean turn rate at standstills, (3,), and their total duration, s."""
    inside = standing(leg, imu.t)
    still = inside[:-1] & inside[1:]
    length = float(np.diff(imu.t)[still].sum())
    if length < 1.0:
        return np.zeros(3), 0.0
    return imu.turn[still].sum(axis=0) / length, length


def first_state(leg: SmootherLeg, imu: ImuSteps, priors: Priors,
                yaw: float | None = None) -> Start:
    """
    Return the first state of a cold start.

    leg : the leg.   imu : its IMU steps with the keyframes.   priors : turn-on bias.   yaw :
    initial yaw mounting, rad, instead of the one estimated from accelerations.
    """
    bias, rest = rest_bias(leg, imu)
    sigma = np.full(3, 2e-4) if rest else np.maximum(priors.gyro_bias, 1e-3)
    sums, C_0k = _sums(leg, imu, bias)
    for _ in range(2):
        up, change = _level(leg, sums, C_0k, sigma)
        bias = bias + change
        sums, C_0k = _sums(leg, imu, bias)
        sigma = np.minimum(sigma, 5e-4)
    C_Lk = level_frame(up) @ C_0k
    t = imu.t[imu.key]
    track = _Track(leg, t, C_Lk, sums)
    if track.slope is not None:
        up_b = C_Lk[:, 2].mean(axis=0)
        bias = bias - track.slope * up_b / np.linalg.norm(up_b)
        sums, C_0k = _sums(leg, imu, bias)
        C_Lk = level_frame(up) @ C_0k
        track = _Track(leg, t, C_Lk, sums)
    psi, yaw_sigma = _heading(leg, t, C_Lk, sums, track)
    chi = track.chi
    if yaw is not None:
        psi = chi + yaw
    elif yaw_sigma > 0.2:       # rad: the heading is ambiguous
        psi = chi
    return Start(_state(leg, t, C_nL(psi) @ C_Lk, bias, track, float(wrap(psi - chi))),
                 yaw_sigma, track.spread)


def _sums(leg: SmootherLeg, imu: ImuSteps, bias: Floats) -> tuple[Intervals, Floats]:
    K = len(imu.key) - 1
    sums, _ = preintegrate(imu, np.tile(bias, (K, 1)), np.zeros((K, 3)), leg.travel.at,
                           np.array([1.0, 0.0, 0.0]), np.empty(0))
    C = np.empty((K + 1, 3, 3))
    C[0] = np.eye(3)
    for k in range(K):
        C[k + 1] = C[k] @ sums.R[k]
    return sums, C


def _level(leg: SmootherLeg, sums: Intervals, C_0k: Floats,
           bias_sigma: Floats) -> tuple[Floats, Floats]:
    """Return up in the frame of the first keyframe and the change of the gyro bias: (3,) each."""
    C, T = C_0k[:-1], sums.T
    force = np.einsum('kij,kj->ki', C, sums.dv) / T[:, None]
    turned = np.cumsum(C @ sums.A, axis=0)       # of one rad/s of bias, at interval ends
    turned = turned - C @ sums.A / 2
    g = gravity(leg.origin.latitude, leg.origin.height)
    up = np.median(force, axis=0)
    up = up / np.linalg.norm(up)
    lively = 1.0        # m/s^2, 1 sigma of the acceleration of a car over 1 s: physical
    weight = np.sqrt(T) / lively
    change = np.zeros(3)
    for _ in range(3):
        J = np.concatenate([np.broadcast_to(np.eye(3) * g, (len(T), 3, 3)),
                            -g * skew(up) @ turned], axis=2) * weight[:, None, None]
        r = (force - g * up) * weight[:, None]
        H = np.einsum('kri,krj->ij', J, J) + np.diag(np.r_[np.zeros(3), 1 / bias_sigma**2])
        x = np.linalg.solve(H, np.einsum('kri,kr->i', J, r))
        change = x[3:]
        up = up + x[:3]
        up = up / np.linalg.norm(up)
    return up, change


class _Track:
    """
    The odometer's track in the level frame, x of b taken as forward, fitted to the fixes.

    X : (N,) travel units, complex.   K : m per unit.   chi : rad, rotation to the fixes at the
    first keyframe.   slope : rad/s, its change, None without fixes.   place : (N,) m, east + i
    north.   height : (N,) m.   spread : m, scatter of the fixes about the track.
    """

    def __init__(self, leg: SmootherLeg, t: Floats, C_Lk: Floats, sums: Intervals) -> None:
        step = (C_Lk[:-1] @ sums.S)[:, :2, 0]
        self.X = np.concatenate([[0.0], np.cumsum(step[:, 0] + 1j * step[:, 1])])
        inside = (leg.t_fix >= t[0]) & (leg.t_fix <= t[-1])
        t_fix, fix = leg.t_fix[inside], leg.fixes_n[inside]
        sigma = float(np.sqrt(np.median(leg.covariance_n[:, 0, 0])))
        z = fix[:, 0] + 1j * fix[:, 1]
        at = np.interp(t_fix, t, self.X)
        self.K, self.slope = leg.rough_scale, None
        self.chi = _rotation(np.diff(at), np.diff(z), sigma)
        for _ in range(2):
            laid = self.K * np.exp(1j * self.chi) * at
            apart = np.stack([(laid - z).real, (laid - z).imag], -1)
            keep, noise = steady(apart, sigma)
            flat = np.stack([at.real, at.imag], -1) * self.K
            found = pieces(flat[keep], fix[keep, :2], t_fix[keep], noise)
            middle, off = found.t, -found.off
            if not len(middle):
                break
            centre = float(np.angle(np.exp(1j * off).sum()))
            off = np.unwrap(centre + wrap(off - centre)) if len(off) > 1 else off
            self.chi, slope = _line(middle, off)
            self.slope = slope
            at_mid = np.interp(middle, t_fix, np.arange(len(t_fix)))
            k = np.unique(np.round(at_mid).astype(int))
            run = np.abs(np.diff(at[k]))
            way = np.abs(np.diff(z[k]))
            if (run > 0).any():
                self.K = float(np.median(way[run > 0] / run[run > 0]))
        self.bend = 0.0 if self.slope is None else self.slope
        self.chi_at = self.chi + self.bend * (t - t[0])
        self.place = self._place(t, t_fix, z)
        self.height = _smooth(t, t_fix, np.where(np.isnan(fix[:, 2]), 0.0, fix[:, 2]))
        laid = np.interp(t_fix, t, self.place)
        self.spread = max(float(np.median(np.abs(laid - z))) / 1.18, 1e-3)

    def _place(self, t: Floats, t_fix: Floats, z: Complexes) -> Complexes:
        """Return the track plus the smoothed difference from the fixes: (N,) m, east + i north."""
        steps = np.diff(self.X) * np.exp(1j * (self.chi_at[:-1] + self.chi_at[1:]) / 2) * self.K
        path = np.concatenate([[0.0], np.cumsum(steps)])
        off = z - np.interp(t_fix, t, path)
        return path + _smooth(t, t_fix, off.real) + 1j * _smooth(t, t_fix, off.imag)


def _rotation(moved: Complexes, gone: Complexes, sigma: float) -> float:
    """
    Return the mean angle from steps of the track to those of the fixes, rad.

    moved, gone : (n,) steps, any unit and m.   sigma : m, of a fix. The weight of a step is its
    length by the odometer, so that a jump of the fixes does not get a larger weight.
    """
    return float(np.angle((moved.conj() * gone / np.maximum(np.abs(gone), sigma)).sum()))


def _line(t: Floats, y: Floats) -> tuple[float, float]:
    """Return value at the first time and slope of a line through points, by medians."""
    if len(t) < 3:
        return float(np.median(y)), 0.0
    i, j = np.triu_indices(min(len(t), 400), 1)
    pick = np.linspace(0, len(t) - 1, min(len(t), 400)).astype(int)
    dt = t[pick][j] - t[pick][i]
    far = dt > (t[-1] - t[0]) / 4
    slope = float(np.median((y[pick][j] - y[pick][i])[far] / dt[far]))
    return float(np.median(y - slope * (t - t[0]))), slope


def _smooth(t: Floats, t_fix: Floats, y: Floats, window: float = 20.0) -> Floats:
    """Return medians over windows, interpolated to t, without the effect of outliers."""
    if not len(y):
        return np.zeros(len(t))
    cells = np.floor((t_fix - t_fix[0]) / window).astype(int)
    at = np.unique(cells)
    middle = [np.median(t_fix[cells == c]) for c in at]
    out: Floats = np.interp(t, middle, [np.median(y[cells == c]) for c in at])
    return out


def _speed(leg: SmootherLeg, t: Floats) -> Floats:
    """Return the odometer speed, a mean over 2 SPEED_WINDOW: (N,) units per s."""
    s = leg.travel.at
    return (s(t + SPEED_WINDOW) - s(t - SPEED_WINDOW)) / (2 * SPEED_WINDOW)


def _heading(leg: SmootherLeg, t: Floats, C_Lk: Floats, sums: Intervals,
             track: _Track) -> tuple[float, float]:
    """
    Return the rotation from the level frame to n from accelerations, rad, and its sigma.

    Change of velocity along the track = a times the integral of specific force in the level frame,
    plus a tilt (constant in the level frame) and an accelerometer bias (constant in b).
    """
    direction = C_Lk[:, 0, 0] + 1j * C_Lk[:, 1, 0]
    direction = direction / np.maximum(np.abs(direction), 1e-9)
    v = track.K * _speed(leg, t) * direction * np.exp(1j * track.chi_at)
    F = (C_Lk[:-1] @ sums.dv[:, :, None])[:, :, 0]
    F = F[:, 0] + 1j * F[:, 1]
    bend = np.exp(1j * (track.chi_at[:-1] - track.chi))
    T = sums.T
    lag = min(3, len(T))
    kernel = np.ones(lag)
    columns = [np.convolve(c, kernel, 'valid')
               for c in (F * bend, T.astype(complex), T * direction[:-1] * bend)]
    y = v[lag:] - v[:-lag]
    A = np.stack(columns, -1)
    w = np.ones(len(y))
    x = np.array([1.0, 0.0, 0.0], complex)
    sigma = np.inf
    for _ in range(4):
        H = (A.conj().T * w) @ A + 1e-9 * np.eye(3)
        x = np.linalg.solve(H, (A.conj().T * w) @ y)
        r = np.abs(y - A @ x)
        usual = max(np.median(r) / 1.18, 1e-3)
        w = np.minimum(1.0, 2 * usual / np.maximum(r, 1e-9))
        sigma = usual * np.sqrt(lag * np.linalg.inv(H)[0, 0].real) / max(abs(x[0]), 1e-9)
    if abs(x[0]) < 0.5:
        sigma = np.inf
    return float(np.angle(x[0])), float(sigma)


def _state(leg: SmootherLeg, t: Floats, C_nb: Floats, bias: Floats, track: _Track,
           yaw: float) -> State:
    N = len(t)
    turned = np.exp(1j * (track.chi_at - track.chi))
    c, s = turned.real, turned.imag
    spin = np.zeros((N, 3, 3))
    spin[:, 0, 0], spin[:, 0, 1], spin[:, 1, 0], spin[:, 1, 1], spin[:, 2, 2] = c, -s, s, c, 1.0
    C_nb = spin @ C_nb
    constants = np.zeros(M)
    constants[[LN_K, YAW, PITCH]] = np.log(track.K), yaw, 0.0
    ahead = np.array([np.cos(yaw), -np.sin(yaw), 0.0])
    v_n = (C_nb @ ahead) * (track.K * _speed(leg, t))[:, None]
    v_n[:, 2] = 0.0
    p_n = np.stack([track.place.real, track.place.imag, track.height], -1)
    return State(t, p_n, v_n, C_nb, np.tile(bias, (N, 1)), np.zeros((N, 3)), np.zeros(N),
                 np.zeros((N, 3)), constants)
