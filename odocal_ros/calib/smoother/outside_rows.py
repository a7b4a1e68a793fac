"""Velocity and heading from outside as rows: residuals, derivatives, weights, shares."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.smoother.fixes import FAR, heavy, weights
from odocal_ros.calib.smoother.motion import gravity_n
from odocal_ros.calib.smoother.preintegrate import turn
from odocal_ros.calib.smoother.state import (
    ACCEL,
    BA,
    BARE,
    BG,
    C_bv_gradient,
    GNSS_ARM,
    GNSS_DELAY,
    GYRO_SCALE,
    HEADING,
    M,
    PHI,
    PITCH,
    V,
    YAW,
)
from odocal_ros.nav.angles import arctan2, wrap
from odocal_ros.nav.rotations import skew

LEAST_SPEED, LEAST_TURN = 0.005, 5e-4     # m/s, rad: no receiver is better
FEWEST_ROWS = 5        # of which one may be an outlier
FEWEST_BINS = 12       # to judge by, over how long errors are alike
CUT = 3.0              # robust sigmas at which a residual is cut for that
# level of each column, and the name in the budget
LEVELS = {'velocity': ('velocity', 'velocity', 'velocity_up'), 'heading': ('heading',)}
SOURCES = {'velocity': 'fix_velocity', 'heading': 'heading_noise'}


def used(leg, t) -> dict:
    """Return velocity and heading within the keyframes, those that there are."""
    found = {'velocity': leg.velocity.between(t[0], t[-1]),
             'heading': leg.heading.between(t[0], t[-1])}
    return {name: x for name, x in found.items() if len(x.t)}


def first_values(outside):
    """Return first levels (factors on stated variances) and their least."""
    first = {level: 1.0 for name in outside for level in LEVELS[name]}
    least = {}
    if 'velocity' in outside:
        sigma = np.median(outside['velocity'].sigma, axis=0)
        least |= {'velocity': (LEAST_SPEED / sigma[0])**2,
                  'velocity_up': (LEAST_SPEED / sigma[2])**2}
    if 'heading' in outside:
        least['heading'] = (LEAST_TURN / float(np.median(outside['heading'].noise)))**2
    return first, least


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of one kind at one state: (m,), (m, d), (m, d, BARE), (m, d, M), (m, d) 1 / sigma."""

    name: str
    k: np.ndarray
    raw: np.ndarray
    J: np.ndarray
    c: np.ndarray
    root: np.ndarray


def outside_rows(problem, state, points, later):
    """
    Return the rows of what there is.

    points : by name, the sums to the times.   later : s, as for ``Fixes``.
    """
    out = []
    if 'velocity' in points:
        out.append(_velocity(problem, state, points['velocity'], later))
    if 'heading' in points:
        out.append(_heading(problem.outside['heading'], state, points['heading']))
    return out


def _velocity(problem, state, points, later):
    leg, sent, k = problem.leg, problem.outside['velocity'], points.interval
    C, tau = state.C_nb[k], points.tau[:, None]
    C_t = C @ points.R
    arm_v = leg.antenna_arm - leg.imu_arm + state.constants[GNSS_ARM]
    arm_b = state.C_bv @ arm_v
    dv, g = turn(C, points.dv), gravity_n(state.p_n[k], leg.origin)
    swing = turn(C_t, np.cross(points.rate, arm_b))
    faster = turn(C, points.force) + g
    raw = sent.velocity_n - (state.v_n[k] + dv + g * tau + swing) + faster * later
    m, t = len(k), tau[:, :, None]
    J, c = np.zeros((m, 3, BARE)), np.zeros((m, 3, M))
    J[:, :, V] = -np.eye(3)
    J[:, :, PHI] = skew(dv + swing)
    J[:, :, BA] = C * t
    # a turn rate less by the bias: half the turn acts on what force did, all of it on the arm
    J[:, :, BG] = -(skew(dv) / 2 + skew(swing)) @ C * t - C_t @ skew(arm_b)
    by_yaw, by_pitch = C_bv_gradient(state.constants[YAW], state.constants[PITCH])
    W = C_t @ skew(points.rate)
    c[:, :, YAW], c[:, :, PITCH] = (-W @ (x @ arm_v) for x in (by_yaw, by_pitch))
    c[:, :, GNSS_ARM] = -W @ state.C_bv
    c[:, :, GNSS_DELAY] = faster
    c[:, :, GYRO_SCALE] = J[:, :, BG.start + 2] * points.rate[:, 2:]
    c[:, :, ACCEL] = C @ points.F
    return Rows('velocity', k, raw, J, c, 1 / sent.sigma)


def _heading(sent, state, points):
    k = points.interval
    C = state.C_nb[k]
    x = (C @ points.R)[:, :, 0]
    level2 = np.maximum(x[:, 0]**2 + x[:, 1]**2, 1e-6)
    raw = wrap(sent.yaw - arctan2(x[:, 1], x[:, 0]) - state.constants[HEADING])
    turns = np.stack([-x[:, 2] * x[:, 0] / level2, -x[:, 2] * x[:, 1] / level2,
                      np.ones(len(k))], -1)
    J, c = np.zeros((len(k), 1, BARE)), np.zeros((len(k), 1, M))
    J[:, 0, PHI] = -turns
    J[:, 0, BG] = np.einsum('ki,kij->kj', turns, C) * points.tau[:, None]
    c[:, 0, GYRO_SCALE] = J[:, 0, BG.start + 2] * points.rate[:, 2]
    c[:, 0, HEADING] = -1.0
    return Rows('heading', k, raw[:, None], J, c, 1 / sent.noise[:, None])


class WeightedRows:
    """
    Rows at given levels.

    thin : of how many neighbours the errors are one: each row counts by so much less.
    """

    def __init__(self, rows: Rows, levels, thin, n):
        self.name, self.source, self.k, self.thin = rows.name, SOURCES[rows.name], rows.k, thin
        root = rows.root / np.sqrt([levels[name] for name in LEVELS[rows.name]])
        white = rows.raw * root
        if len(white) < FEWEST_ROWS:
            self.weight = np.ones_like(white)
        elif white.shape[1] == 3:
            self.weight = weights(white)
        else:
            self.weight = np.minimum(1.0, FAR / np.maximum(np.abs(white), 1e-12))**2
        root = root * np.sqrt(self.weight / thin)
        self.r = rows.raw * root
        m, d = white.shape
        J = np.zeros((m, d, n + M))
        J[:, :, :BARE], J[:, :, n:] = rows.J, rows.c
        self.J, self.n = J * root[:, :, None], n
        self.log_R = -2 * float(np.log(root / np.sqrt(self.weight / thin)).sum()) / thin

    def after(self, step, constants):
        """Bring the residuals to where the step leads."""
        own = np.concatenate([step[self.k], np.broadcast_to(constants, (len(self.k), M))], axis=1)
        self.r = self.r + np.einsum('kij,kj->ki', self.J, own)

    def cost(self) -> float:
        """Return the robust sum of squares."""
        white = self.r / np.sqrt(self.weight / self.thin)
        if white.shape[1] == 1:
            white = np.pad(white, ((0, 0), (0, 2)))
        return heavy(white) / self.thin

    def components(self, neighbours):
        """Return for each level its quadratic sum and what is expected of it."""
        if len(self.k) < FEWEST_ROWS:
            return {}
        own = np.r_[0:self.n, 2 * self.n:2 * self.n + M]
        X = self.J @ neighbours[self.k[:, None, None], own[:, None], own]
        taken = (X * self.J).sum(axis=2)
        names, quadratic = np.array(LEVELS[self.name]), self.r**2 * self.thin
        return {str(name): (float(quadratic[:, names == name].sum()),
                            float((1 - taken[:, names == name]).sum()))
                for name in np.unique(names)}

    def effects(self, neighbours, parameters):
        """Return what a unit error of each row does to the first constants: (m, p, d)."""
        own = np.r_[0:self.n, 2 * self.n:2 * self.n + M]
        first = 2 * self.n
        block = neighbours[self.k, first:first + parameters][:, :, own]
        return block @ np.swapaxes(self.J, 1, 2)


def alike(rows: WeightedRows) -> float:
    """Return how many neighbouring errors are as good as one, by the spread of their means."""
    r = rows.r / np.sqrt(rows.weight)
    r = (r - np.median(r, axis=0))[:, :2]       # the level ones tell scale and yaw
    scale = np.median(np.abs(r), axis=0) / 0.6745
    r = np.clip(r, -CUT * scale, CUT * scale)
    r = r - r.mean(axis=0)
    power = (r**2).mean()
    most, length = 1.0, 2
    while len(r) >= FEWEST_BINS * length and power > 0:
        bins = r[:len(r) // length * length].reshape(-1, length, r.shape[1])
        most = max(most, float(length * (bins.mean(axis=1)**2).mean() / power))
        length *= 2
    return most


def by_interval(k, rows):
    """Return rows (m, d, c) of intervals k (m,) by interval, padded: (present, d most, c)."""
    present, first, count = np.unique(k, return_index=True, return_counts=True)
    place = np.arange(len(k)) - np.repeat(first, count)
    out = np.zeros((len(present), int(count.max(initial=1)), *rows.shape[1:]))
    out[np.repeat(np.arange(len(present)), count), place] = rows
    return out.reshape(len(present), -1, rows.shape[2])


def add_rows(out, k, rows, residual):
    """Add rows (m, d, n + M) to normal equations; return them by interval."""
    n = out.g.shape[1]
    J, r = by_interval(k, rows), by_interval(k, residual[:, :, None])
    present = np.unique(k)
    H = np.swapaxes(J, 1, 2) @ J
    g = -(np.swapaxes(J, 1, 2) @ r)[:, :, 0]
    out.diagonal[present] += H[:, :n, :n]
    out.border[present] += H[:, :n, n:]
    out.corner += H[:, n:, n:].sum(axis=0)
    out.g[present] += g[:, :n]
    out.g_border += g[:, n:].sum(axis=0)
    return present, J, r
