"""
The two equations of the wheels, linearised about a state, on bins of time.

    fix(t)  = p0 + sum of C (K_L dP_L + K_R dP_R) / 2 d + lever arm + fix error
    0       = K_R s_R - K_L s_L - w psi - d0 + count error

d is the forward axis in b, w the track width, psi the turn of the vehicle by gyro. What the gyro
errs by, phi(t) (true attitude = exp(phi) computed), is common to both; it is a random process with
its values at nodes, linear in between. Fixes and turns are averaged over the bins between the
nodes: the equations are linear in what is averaged, so that nothing is approximated but the little
that a bin knows beyond its mean.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.wheels.leg import C_bv, wheel_factors, WheelLeg
from odocal_ros.nav.dead_reckoning import forward_b
from odocal_ros.nav.rotations import exp_so3, matrix_from_quat

Array = NDArray[np.float64]
PARAMETERS = ('scale', 'log_ratio', 'heading', 'east', 'north', 'width', 'turn_offset')
SCALE, RATIO, HEADING, EAST, NORTH, WIDTH, OFFSET = range(7)
STEP = 1e-6     # rad, of the differences that give the derivatives of the forward axis
HALF = 0.25     # s each side that a velocity is taken over
STANDING = 1.0  # s without a count on either wheel: standing


@dataclass(frozen=True, eq=False)
class State:
    """Where the equations are linearised; phi : (nodes, 3) rad, n."""

    scale: float
    log_ratio: float
    heading: float
    pitch: float
    start_n: Array       # (3,) m, antenna at the start mark
    width: float
    offset: float
    phi: Array


@dataclass(frozen=True, eq=False)
class Bins:
    """Bins of time: edges (N + 1,) s; fixes kept (k,), bin of each, share of its bin's mean."""

    edges: Array
    fix: NDArray[np.int64]
    of_fix: NDArray[np.int64]
    share: Array

    def mean(self, x):
        """Return the bins' weighted means of values at the fixes: (k, ...) to (N, ...)."""
        out = np.zeros((len(self.edges) - 1, *x.shape[1:]))
        np.add.at(out, self.of_fix, x * self.share.reshape(-1, *[1] * (x.ndim - 1)))
        return out

    @property
    def filled(self):
        """Tell which bins hold fixes."""
        return np.bincount(self.of_fix, minlength=len(self.edges) - 1) > 0


@dataclass(frozen=True, eq=False)
class Equations:
    """
    The linearised equations, by bin (N) and node (N + 1).

    residual : (N, 3) fix less model, m.     by : (N, 3, 4) derivative of the model's position by
    ln scale, ln ratio, heading, pitch.      by_phi : (N, N + 1, 3) way that turns with each node.
    turn : (N,) residual of the turn equation, m.  turn_by : (N, 4) ln scale, ln ratio, width, d0.
    velocity : (N, 3) m/s at the fixes.      late : (N, 3) what an odometer late by 1 s does, m.
    lever : (N, 3, 3) turn of the antenna's arm since the start.
    forward : (N, 3) forward axis.           moving : (N,) s in motion in each bin.
    rests : (N, r) share of each bin that is spent in each standstill.
    counts : (N,) mean counts of a wheel in each bin.
    phi_axes : (N + 1, 3, 3) attitude summed over time to each node: s, n by axis of b.
    yaw : (N + 1,) turn by gyro.    way : (N, 3) of each bin, m.
    """

    residual: Array
    by: Array
    by_phi: Array
    turn: Array
    turn_by: Array
    velocity: Array
    late: Array
    lever: Array
    forward: Array
    moving: Array
    rests: Array
    counts: Array
    phi_axes: Array
    yaw: Array
    way: Array

    @property
    def length(self):
        """Return the length of the way in each bin, (N,) m."""
        return np.linalg.norm(self.way, axis=1)


def turned(phi, v):
    """Return vectors turned by rotation vectors, rad: (..., 3); far faster than by matrices."""
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    across = _cross(phi, v)
    return v + np.sinc(angle / np.pi) * across + np.sinc(angle / 2 / np.pi)**2 / 2 * _cross(
        phi, across)


def _cross(a, b):
    (x, y, z), (u, v, w) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)


def make_bins(t_fix, keep, variance, t_start, t_stop, n) -> Bins:
    """Return n bins of equal length over a range, s, with the fixes of a mask in them."""
    edges = np.linspace(t_start, t_stop, n + 1)
    fix = np.flatnonzero(keep & (t_fix >= t_start) & (t_fix <= t_stop))
    of_fix = np.clip(np.searchsorted(edges, t_fix[fix], side='right') - 1, 0, n - 1)
    weight = 1 / variance[fix]
    return Bins(edges, fix, of_fix, weight / np.bincount(of_fix, weight, n)[of_fix])


def equations(leg: WheelLeg, bins: Bins, state: State, since: float) -> Equations:
    """
    Return the equations linearised about a state.

    since : s, from when on the gyro's errors count: where the heading holds.
    """
    way = _Way(leg, bins, state)
    t = leg.t_fix[bins.fix]
    C = leg.left.C_nb_at(t) - leg.left.C_nb_at(np.array(leg.start.t))
    turned = exp_so3(np.stack([np.interp(t, bins.edges, p) for p in state.phi.T], -1)) @ C \
        if state.phi.any() else C
    arm = turned @ C_bv(state.heading, state.pitch)
    model = state.start_n + way.at('v', t) + arm @ leg.lever_b
    by = np.stack([way.at(name, t) for name in ('v', 'ratio', 'heading', 'pitch')], -1)
    before, after = (np.clip(t + x, *way.t[[0, -1]]) for x in (-HALF, HALF))
    velocity = (way.at('v', after) - way.at('v', before)) / np.maximum(
        after - before, 1e-6)[:, None]
    turn, turn_by, yaw = way.turn(state)
    rests, moving, counts = way.rests()
    step_n = np.diff(way.at('v', bins.edges), axis=0)
    return Equations(
        bins.mean(leg.fixes_n[bins.fix] - model), bins.mean(by), way.by_phi(t), turn, turn_by,
        bins.mean(velocity), bins.mean(way.at('late', t) - velocity), bins.mean(arm),
        way.forward(), moving, rests, counts, _axes(leg, bins.edges, since), yaw, step_n)


def _axes(leg, edges, since):
    """Return the attitude summed over time from ``since`` to each node, (N + 1, 3, 3) s."""
    track = leg.left
    C = matrix_from_quat(track.q_nb)
    total = np.zeros_like(C)
    np.cumsum((C[:-1] + C[1:]) * (np.diff(track.t) / 2)[:, None, None], axis=0, out=total[1:])
    flat = total.reshape(-1, 9)
    here = np.stack([np.interp(edges, track.t, c) for c in flat.T], -1)
    then = np.array([np.interp(since, track.t, c) for c in flat.T])
    return (here - then).reshape(-1, 3, 3)


class _Way:
    """Sums along a leg, from the start mark, at the epochs of its tracks."""

    def __init__(self, leg, bins, state):
        self.bins = bins
        edges = bins.edges
        inside = slice(max(0, np.searchsorted(leg.left.t, edges[0]) - 1),
                       np.searchsorted(leg.left.t, edges[-1]) + 1)
        self.t = t = leg.left.t[inside]
        self.s = leg.left.s[inside], leg.right.s[inside]
        self.k = wheel_factors(state.scale, state.log_ratio)
        self.step, self.middle = np.diff(t), (t[:-1] + t[1:]) / 2
        self.of = np.clip(np.searchsorted(edges, self.middle, side='right') - 1, 0,
                          len(edges) - 2)
        d_b = forward_b(-state.heading, state.pitch)
        by_heading, by_pitch = ((forward_b(-state.heading - a, state.pitch + b)
                                 - forward_b(-state.heading + a, state.pitch - b)) / (2 * STEP)
                                for a, b in ((STEP, 0.0), (0.0, STEP)))
        dP = [np.diff(track.P[inside], axis=0) * k
              for track, k in zip((leg.left, leg.right), self.k, strict=True)]
        if state.phi.any():
            phi = np.stack([np.interp(self.middle, edges, p) for p in state.phi.T], -1)
            dP = [turned(phi[:, None], x.swapaxes(1, 2)).swapaxes(1, 2) for x in dP]
        both = (dP[0] + dP[1]) / 2
        self.v = both @ d_b
        ratio = np.exp(state.log_ratio)
        by_ratio = (dP[1] * ratio - dP[0]) / (1 + ratio) / 2
        self.q_nb, self.d_b = leg.left.q_nb[inside], d_b
        self.yaw, self.cos = self._yaw(state)
        x = (self.middle - edges[self.of]) / np.diff(edges)[self.of]
        rate = np.diff(self.yaw) / np.maximum(self.step, 1e-9)
        late = np.stack([-self.v[:, 1], self.v[:, 0], 0 * rate], -1) * rate[:, None]
        self.total = {name: np.concatenate([np.zeros((1, 3)), np.cumsum(y, axis=0)]) for name, y in
                      (('v', self.v), ('xv', self.v * x[:, None]), ('ratio', by_ratio @ d_b),
                       ('heading', both @ by_heading), ('pitch', both @ by_pitch), ('late', late))}
        first = {k: self._interp(v, edges[:1])[0] for k, v in self.total.items()}
        self.total = {k: v - first[k] for k, v in self.total.items()}

    def _interp(self, total, t):
        return np.stack([np.interp(t, self.t, c) for c in total.T], -1)

    def at(self, name, t):
        """Return a sum at times: (k, 3)."""
        return self._interp(self.total[name], t)

    def _yaw(self, state):
        """Return the turn by gyro at each epoch and the cosine of the climb, (m,)."""
        x = matrix_from_quat(self.q_nb) @ self.d_b
        if state.phi.any():
            phi = np.stack([np.interp(self.t, self.bins.edges, p) for p in state.phi.T], -1)
            x = turned(phi, x)
        level = np.hypot(x[:, 0], x[:, 1])
        yaw = np.unwrap(np.arctan2(x[:, 1], x[:, 0]))
        # the wheels turn about the vehicle's own upright: on a slope less than the heading does
        turn = np.diff(yaw) * (level[:-1] + level[1:]) / 2
        return np.append(0.0, np.cumsum(turn)), level

    def by_phi(self, t):
        """Return what of the way turns with each node, (N, N + 1, 3) m."""
        bins, n = self.bins, len(self.bins.edges) - 1
        whole, late = (np.diff(self.at(name, bins.edges), axis=0) for name in ('v', 'xv'))
        part, part_late = (bins.mean(self.at(name, t) - self.at(name, bins.edges[bins.of_fix]))
                           for name in ('v', 'xv'))
        before = np.tril(np.ones((n, n)), -1)[..., None]
        k = np.arange(n)
        out = np.zeros((n, n + 1, 3))
        out[:, :n] += before * (whole - late)
        out[:, 1:] += before * late
        out[k, k] += part - part_late
        out[k, k + 1] += part_late
        return out

    def _bin_mean(self, x):
        """Return the means over bins of values at epochs, by time: (m, ...) to (N,)."""
        n = len(self.bins.edges) - 1
        time = np.bincount(self.of, self.step, n)
        return np.bincount(self.of, (x[:-1] + x[1:]) / 2 * self.step, n) / np.maximum(time, 1e-9)

    def turn(self, state):
        """Return residual (N,) m and derivatives (N, 4) of the turn equation, yaw at the nodes."""
        left, right = (k * (s - s[0]) for k, s in zip(self.k, self.s, strict=True))
        ratio = np.exp(state.log_ratio)
        by = np.stack([right - left, (right * ratio + left) / (1 + ratio), -self.yaw,
                       -np.ones(len(left))], -1)
        g = right - left - state.width * self.yaw - state.offset
        means = np.stack([self._bin_mean(c) for c in (*by.T, g)], -1)
        return -means[:, 4], means[:, :4], np.interp(self.bins.edges, self.t, self.yaw)

    def rests(self):
        """Return the share of bins spent in each standstill, seconds in motion, counts."""
        n = len(self.bins.edges) - 1
        stands = (np.diff(self.s[0]) == 0) & (np.diff(self.s[1]) == 0)
        steps = np.diff(np.concatenate([[False], stands, [False]]).astype(int))
        runs = [(a, b) for a, b in zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1),
                                       strict=True) if self.t[b] - self.t[a] >= STANDING]
        time = np.maximum(np.bincount(self.of, self.step, n), 1e-9)
        share = np.zeros((n, len(runs)))
        for r, (a, b) in enumerate(runs):
            share[:, r] = np.bincount(self.of[a:b], self.step[a:b], n) / time
        counts = sum(np.bincount(self.of, np.abs(np.diff(s)), n) for s in self.s) / 2
        return share, time * (1 - share.sum(axis=1)), counts

    def forward(self):
        """Return the mean forward axis of each bin, (N, 3)."""
        n = len(self.bins.edges) - 1
        x = matrix_from_quat(self.q_nb)[:-1] @ self.d_b
        time = np.maximum(np.bincount(self.of, self.step, n), 1e-9)[:, None]
        return np.stack([np.bincount(self.of, c * self.step, n) for c in x.T], -1) / time
