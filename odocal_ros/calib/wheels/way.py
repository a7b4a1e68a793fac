# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Dead reckoning of two wheels and its derivatives, turned by the estimated drift of the gyro."""

from typing import TYPE_CHECKING

import numpy as np

from odocal_ros.calib.wheels.leg import wheel_factors, WheelLeg
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.angles import arctan2
from odocal_ros.nav.dead_reckoning import forward_b, Track
from odocal_ros.nav.rotations import matrix_from_quat

if TYPE_CHECKING:
    from odocal_ros.calib.wheels.model import Bins, State


def turned(phi: Floats, v: Floats) -> Floats:
    """Return vectors turned by rotation vectors, rad: (..., 3); far faster than by matrices."""
    angle = np.linalg.norm(phi, axis=-1, keepdims=True)
    across = _cross(phi, v)
    out: Floats = v + np.sinc(angle / np.pi) * across + np.sinc(angle / 2 / np.pi)**2 / 2 * _cross(
               phi, across)
    return out


def _cross(a: Floats, b: Floats) -> Floats:
    (x, y, z), (u, v, w) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)


class Way:
    """
    Sums along a leg, from the start mark, at the epochs of its tracks.

    t : (m,) s, a little beyond the bins.   weight : (m - 1,) s of each step inside them.
    by_gyro_scale : (m,) derivative of the heading's drift by the gyro's scale error.
    """

    def __init__(self, leg: WheelLeg, bins: 'Bins', state: 'State', since: float) -> None:
        self.bins, self.state = bins, state
        edges = bins.edges
        margin = 1.0        # s of the track beyond the bins, for fixes that are late or early
        inside = slice(max(0, np.searchsorted(leg.left.t, edges[0] - margin) - 1),
                       np.searchsorted(leg.left.t, edges[-1] + margin) + 1)
        self.t = t = leg.left.t[inside]
        self.s = leg.left.s[inside], leg.right.s[inside]
        self.k = wheel_factors(state.scale, state.log_ratio)
        self.step, self.middle = np.diff(t), (t[:-1] + t[1:]) / 2
        self.weight = np.diff(np.clip(t, edges[0], edges[-1]))
        self.of = np.clip(np.searchsorted(edges, self.middle, side='right') - 1, 0,
                          len(edges) - 2)
        d_b = forward_b(-state.heading, state.pitch)
        h = 1e-6            # rad: central differences, to 1e-10 of the derivatives
        by_heading, by_pitch = ((forward_b(-state.heading - a, state.pitch + b)
                                 - forward_b(-state.heading + a, state.pitch - b)) / (2 * h)
                                for a, b in ((h, 0.0), (0.0, h)))
        dP = [np.diff(track.P[inside], axis=0) * k
              for track, k in zip((leg.left, leg.right), self.k, strict=True)]
        self.q_nb, self.d_b = leg.left.q_nb[inside], d_b
        self.by_gyro_scale = self._by_gyro_scale(leg.left, since)[inside]
        if self.turned:
            phi = self.phi(self.middle)
            dP = [turned(phi[:, None], x.swapaxes(1, 2)).swapaxes(1, 2) for x in dP]
        both = (dP[0] + dP[1]) / 2
        self.v = both @ d_b
        ratio = np.exp(state.log_ratio)
        # docs/method.md (W2)
        by_ratio = (dP[1] * ratio - dP[0]) / (1 + ratio) / 2
        self.yaw = self._yaw()
        x = (self.middle - edges[self.of]) / np.diff(edges)[self.of]
        rate = np.diff(self.yaw) / np.maximum(self.step, 1e-9)
        across = np.stack([-self.v[:, 1], self.v[:, 0], 0 * rate], -1)
        late = across * rate[:, None]
        drift = np.interp(self.middle, t, self.by_gyro_scale)
        self.total = {name: np.concatenate([np.zeros((1, 3)), np.cumsum(y, axis=0)]) for name, y in
                      (('v', self.v), ('xv', self.v * x[:, None]), ('ratio', by_ratio @ d_b),
                       ('heading', both @ by_heading), ('pitch', both @ by_pitch), ('late', late),
                       ('gyro_scale', across * drift[:, None]))}
        first = {k: self._interp(v, edges[:1])[0] for k, v in self.total.items()}
        self.total = {k: v - first[k] for k, v in self.total.items()}

    def _interp(self, total: Floats, t: Floats) -> Floats:
        return np.stack([np.interp(t, self.t, c) for c in total.T], -1)

    def at(self, name: str, t: Floats) -> Floats:
        """Return a sum at times: (k, 3)."""
        return self._interp(self.total[name], t)

    @property
    def turned(self) -> bool:
        """Tell whether anything turns the computed attitude."""
        return bool(self.state.phi.any() or self.state.gyro_scale)

    def phi(self, t: Floats) -> Floats:
        """Return the drift of the attitude at times, docs/method.md (W5): (k, 3) rad, n."""
        phi = np.stack([np.interp(t, self.bins.edges, p) for p in self.state.phi.T], -1)
        g = self.state.gyro_scale
        phi[:, 2] += g * (1 + g) * np.interp(t, self.t, self.by_gyro_scale)
        return phi

    def _by_gyro_scale(self, track: Track, since: float) -> Floats:
        """Return -(turn since the gyro counts) / (1 + g)^2 by epoch: drift is g (1 + g) it."""
        x = matrix_from_quat(track.q_nb) @ self.d_b
        yaw = np.unwrap(arctan2(x[:, 1], x[:, 0]))
        return -(yaw - np.interp(since, track.t, yaw)) / (1 + self.state.gyro_scale)**2

    def _yaw(self) -> Floats:
        """Return the turn by gyro at each epoch, (m,): psi of docs/method.md (W4)."""
        x = matrix_from_quat(self.q_nb) @ self.d_b
        if self.turned:
            x = turned(self.phi(self.t), x)
        level = np.hypot(x[:, 0], x[:, 1])
        yaw = np.unwrap(arctan2(x[:, 1], x[:, 0]))
        # the wheels turn about the vehicle's own upright: on a slope less than the heading does
        turn = np.diff(yaw) * (level[:-1] + level[1:]) / 2
        return np.append(0.0, np.cumsum(turn))

    def by_phi(self, t: Floats) -> Floats:
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

    def _bin_mean(self, x: Floats) -> Floats:
        """Return the means over bins of values at epochs, by time: (m, ...) to (N,)."""
        n = len(self.bins.edges) - 1
        time = np.bincount(self.of, self.weight, n)
        return np.bincount(self.of, (x[:-1] + x[1:]) / 2 * self.weight, n) / np.maximum(time, 1e-9)

    def turn(self, state: 'State') -> tuple[Floats, Floats, Floats]:
        """Return residual (N,) m and derivatives (N, 5) of (W4), and the turn at the nodes."""
        left, right = (k * (s - s[0]) for k, s in zip(self.k, self.s, strict=True))
        ratio = np.exp(state.log_ratio)
        by = np.stack([right - left, (right * ratio + left) / (1 + ratio), -self.yaw,
                       -np.ones(len(left)),
                       -state.width * (self.by_gyro_scale - self.by_gyro_scale[0])], -1)
        g = right - left - state.width * self.yaw - state.offset
        means = np.stack([self._bin_mean(c) for c in (*by.T, g)], -1)
        return -means[:, -1], means[:, :-1], np.interp(self.bins.edges, self.t, self.yaw)

    def rests(self) -> tuple[Floats, Floats, Floats]:
        """
        Return the share of bins spent in each standstill, seconds in motion, counts.

        A second without a count on either wheel is a standstill.
        """
        n = len(self.bins.edges) - 1
        stands = (np.diff(self.s[0]) == 0) & (np.diff(self.s[1]) == 0)
        steps = np.diff(np.concatenate([[False], stands, [False]]).astype(int))
        runs = [(a, b) for a, b in zip(np.flatnonzero(steps == 1), np.flatnonzero(steps == -1),
                                       strict=True) if self.t[b] - self.t[a] >= 1.0]
        time = np.maximum(np.bincount(self.of, self.weight, n), 1e-9)
        share = np.zeros((n, len(runs)))
        for r, (a, b) in enumerate(runs):
            share[:, r] = np.bincount(self.of[a:b], self.weight[a:b], n) / time
        left, right = (np.bincount(self.of, np.abs(np.diff(s)) * (self.weight > 0), n)
                       for s in self.s)
        return share, time * (1 - share.sum(axis=1)), (left + right) / 2

    def forward(self) -> Floats:
        """Return the mean forward axis of each bin, (N, 3)."""
        n = len(self.bins.edges) - 1
        x = matrix_from_quat(self.q_nb)[:-1] @ self.d_b
        time = np.maximum(np.bincount(self.of, self.weight, n), 1e-9)[:, None]
        return np.stack([np.bincount(self.of, c * self.weight, n) for c in x.T], -1) / time
