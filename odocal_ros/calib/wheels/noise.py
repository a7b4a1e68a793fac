# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Measurement covariance of the wheels' equations, as named parts.

Observations are stacked east (N), north (N), turn (N) of the bins. A part is a root (3N, k), one
column for each independent unit error, or a whole covariance (3N, 3N) where there are many.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.wheels.judge_noise import TurnNoise
from odocal_ros.calib.wheels.leg import WheelLeg
from odocal_ros.calib.wheels.model import Bins, Equations, State
from odocal_ros.calib.wheels.track_width import TRACK_WIDTH
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.alignment import Alignment
from odocal_ros.settings.config import Config


@dataclass(frozen=True, eq=False)
class Part:
    """One named part: root (n, k) or covariance (n, n); shared by all legs of a vehicle."""

    name: str
    root: NDArray[np.float64] | None = None
    covariance: NDArray[np.float64] | None = None
    shared: bool = False

    def whole(self) -> Floats:
        """Return its covariance, (n, n)."""
        if self.covariance is not None:
            return self.covariance
        assert self.root is not None, self.name
        whole: Floats = self.root @ self.root.T
        return whole


def node_covariance(t: Floats, since: float, alignment: Alignment) -> dict[str, Floats]:
    """
    Return the covariance of the gyro's heading drift at nodes, by name: each (N + 1, N + 1).

    Noise makes a Wiener process from ``since`` on, a walking bias its integral.
    """
    x = np.maximum(t - since, 0.0)
    low, high = np.minimum(x[:, None], x), np.maximum(x[:, None], x)
    return {'gyro_noise': alignment.gyro_noise**2 * low,
            'gyro_bias_walk': alignment.gyro_bias_walk**2 * low**2 * (3 * high - low) / 6}


def drift_covariance(alignment: Alignment, bins: Bins, eq: Equations, since: float) -> Floats:
    """Return the covariance Q of the drift at the nodes, docs/method.md (W6): (N + 1, N + 1)."""
    by_bias = eq.phi_axes[:, 2] * alignment.gyro_bias_sigma
    return sum(node_covariance(bins.edges, since, alignment).values()) + by_bias @ by_bias.T


def phi_loading(eq: Equations, width: float) -> Floats:
    """Return what a unit drift of heading at each node makes of the observations, (3N, N + 1)."""
    n = len(eq.turn)
    mean = np.zeros((n, n + 1))
    k = np.arange(n)
    mean[k, k] = mean[k, k + 1] = 0.5
    return np.concatenate([-eq.by_phi[:, :, 1], eq.by_phi[:, :, 0], -width * mean])


def bridge_loading(eq: Equations, width: float) -> Floats:
    """
    Return what a mean drift of 1 rad between the nodes of each bin makes, (3N, N).

    Straight lines between nodes leave out what a random walk does there; without it neighbours
    would look too much alike.
    """
    n = len(eq.turn)
    so_far = np.tril(np.ones((n, n)), -1) + 0.5 * np.eye(n)
    return np.concatenate([-so_far * eq.way[:, 1], so_far * eq.way[:, 0], -width * np.eye(n)])


def walk_root(moving: Floats) -> Floats:
    """
    Return the root of bin means of a walk, 1 a root second, docs/method.md (W8): (N, 2N).

    A mean holds half of its bin's step, and what the walk does between the bin's ends.
    """
    n = len(moving)
    so_far = np.tril(np.ones((n, n)), -1) + 0.5 * np.eye(n)
    return np.concatenate([so_far * np.sqrt(moving), np.diag(np.sqrt(moving / 12))], axis=1)


def known_parts(leg: WheelLeg, eq: Equations, bins: Bins, state: State, since: float,
                turns: TurnNoise, config: Config) -> list[Part]:
    """
    Return all parts but the fixes' own errors, their latency and the gyro's scale.

    since : s, from when on the gyro errs.   turns : TurnNoise, what was judged of the wheels.
    """
    n = len(eq.turn)
    alignment, nothing = leg.alignment, np.zeros(n)
    L = phi_loading(eq, state.width)
    parts = [Part(f'gyro_bias_{axis}', L @ (-eq.phi_axes[:, 2, i:i + 1])
                  * alignment.gyro_bias_sigma[i]) for i, axis in enumerate('xyz')]
    drift = {name: L @ Q @ L.T
             for name, Q in node_covariance(bins.edges, since, alignment).items()}
    within = bridge_loading(eq, state.width) * alignment.gyro_noise * np.sqrt(
        np.diff(bins.edges) / 12)
    drift['gyro_noise'] = drift['gyro_noise'] + within @ within.T
    parts += [Part(name, covariance=whole) for name, whole in drift.items()]

    def stacked(level: Floats, turn: Floats = nothing) -> Floats:
        return np.concatenate([level[:, 0], level[:, 1], turn])

    yaw_rate = np.diff(eq.yaw) / np.diff(bins.edges)
    parts += [
        Part('antenna_lever_arm', np.stack([stacked(eq.lever[:, :, i]) for i in range(3)], -1)
             * config.gnss.lever_arm_sigma, shared=True),
        Part('odometer_delay', stacked(eq.late, -state.width * yaw_rate)[:, None]
             * config.odometer.time_sigma, shared=True),
        Part('quantisation', covariance=quantisation(leg, eq, bins, state, turns.counts))]
    if turns.slip:
        parts.append(Part('wheel_slip', _slip_walk(eq) * np.sqrt(turns.slip)))
    return parts + _events(leg, eq, bins, state)


def quantisation(leg: WheelLeg, eq: Equations, bins: Bins, state: State, level: float) -> Floats:
    """
    Return the covariance of rounding to counts, docs/method.md (W7): (3N, 3N).

    A draw a standstill, many moving.

    Where the disc stands is open, so the rounding of two rows x counts apart has the covariance
    1 / 12 - {x} (1 - {x}) / 2 = sum over m of cos(2 pi m x) / (2 pi^2 m^2), {x} the part beyond
    whole counts. At a steady step of x a row, the mean of n rows has the variance
    sum of |D_n(m x)|^2 / (2 pi^2 m^2), D_n the mean of n unit phasors 2 pi m x apart. Over all x
    that is 1 / (12 n), as if each row were rounded anew; at one speed it is most often less, near
    whole steps up to n times as much. Which, a drive must tell itself: ``level``.

    level : variance of the bin means in motion, of 1 / (12 n).
    """
    n = len(eq.turn)
    size = (leg.quantum * state.scale)**2 / 12         # of one reading of one wheel
    rows = np.diff(bins.edges) / max(leg.interval, 1e-3)
    draws = np.clip(np.minimum(eq.counts, rows), 1.0, None)
    moving = 1 - eq.rests.sum(axis=1)
    of_mean = size * (eq.rests @ eq.rests.T + np.diag(level * moving**2 / draws))
    out = np.zeros((3 * n, 3 * n))
    for axis in range(2):       # of both wheels' mean: half; in whatever direction
        out[axis * n:(axis + 1) * n, axis * n:(axis + 1) * n] = of_mean / 2
    # what is measured at rest is the start's own offset too: a little for the numbers' sake
    out[2 * n:, 2 * n:] = 2 * of_mean + 1e-10 * np.eye(n)
    return out


def _slip_walk(eq: Equations) -> Floats:
    """Return the root of what both wheels slipping by 1 m/sqrt(s) do: (3N, 4N)."""
    walk = walk_root(eq.moving)
    along = [eq.forward[:, axis, None] * walk * np.sqrt(0.5) for axis in range(2)]
    none = np.zeros_like(walk)
    return np.block([[along[0], none], [along[1], none], [none, walk * np.sqrt(2.0)]])


def _events(leg: WheelLeg, eq: Equations, bins: Bins, state: State) -> list[Part]:
    """Return travel in doubt and slips seen, of unknown wheel, as parts."""
    parts = []
    for name, (t, size), unit in (('odometer_gaps', leg.doubt, state.scale),
                                  ('wheel_slip_events', leg.slips, 1.0)):
        keep = (t >= bins.edges[0]) & (t <= bins.edges[-1]) & (size != 0)
        if not keep.any():
            continue
        columns = []
        for at, one in zip(t[keep], np.abs(size[keep]) * unit, strict=True):
            since = np.clip((bins.edges[1:] - at) / np.diff(bins.edges), 0.0, 1.0)
            here = np.searchsorted(bins.edges, at) - 1
            way = since * one * np.sqrt(2.0)        # one wheel has it: twice that of the mean
            axis = eq.forward[np.clip(here, 0, len(since) - 1)]
            for sign in (1.0, -1.0):
                columns.append(np.concatenate([way / 2 * axis[0], way / 2 * axis[1], sign * way]))
        parts.append(Part(name, np.stack(columns, -1)))
    return parts


def tilted(eq: Equations, state: State, tilt_variance: Floats) -> Part:
    """Return what a level not known makes of the turns, as a part: half the tilt squared."""
    n = len(eq.turn)
    variance = (tilt_variance[:-1] + tilt_variance[1:]) / 2
    step = np.sqrt(3) / 2 * variance * np.diff(eq.yaw)
    turn = np.cumsum(step) - step / 2
    return Part('level', np.concatenate([np.zeros(2 * n), state.width * turn])[:, None])


def unknown_width(eq: Equations, drift: Floats) -> Part:
    """Return what keeps turns over a width not known from telling the gyro's drift, as a part."""
    n = len(eq.turn)
    mean = phi_loading(eq, TRACK_WIDTH.of_a_car)[2 * n:]
    whole = np.zeros((3 * n, 3 * n))
    loose = 3.0     # times the gyro's drift, what a width not known makes of turns: judgement
    whole[2 * n:, 2 * n:] = loose**2 * mean @ drift @ mean.T
    return Part('track_width_unknown', covariance=whole)
