# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The error budget of the two-point method: every source as one-sigma effects on the parameters.

A leg's end displacement D = M f (M: attitude summed over travel, f: scale times forward axis) is
set equal to the chord, the vector between the reference positions. A chord error e, m, against D
changes f by M^-1 e, and so ln K, yaw and pitch; each source is given by its one-sigma e. An
attitude error phi(t) (computed = (I - [phi x]) true) makes e = sum of phi x dD, and a gyro error
at time tau rotates the remaining displacement: r(tau) = D(end) - D(tau). Epochs may begin before
the start mark, at the alignment: D is zero there, gyro errors already accumulate. The Earth
rotation, which turns an error of one axis into the others by 4 mrad a minute, is omitted.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from odocal_ros.calib.marks import MarkFix
from odocal_ros.calib.result import Estimate, Source
from odocal_ros.data.arrays import Floats, map_windows
from odocal_ros.nav.alignment import Alignment
from odocal_ros.nav.geodesy import SEMI_MAJOR_AXIS
from odocal_ros.nav.rotations import matrix_from_quat, quat_conjugate, quat_multiply, skew

# m, 1 sigma of the height of fixes without one, which are set on the ellipsoid. Physical: 6.4 % of
# people live above 1500 m, 1.9 sigma, 1.0 % above 2500 m, 3.1 sigma (Tremblay and Ainslie, PNAS
# 118, 2021). Its effect on the scale is 125 ppm
HEIGHT_UNKNOWN = 800.0
PARAMETERS = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')


def parameter_gradient(f: Floats) -> Floats:
    """Return the derivative G of (ln K, yaw, pitch) by f, (3, 3): docs/method.md (T8)."""
    K = np.linalg.norm(f)
    x, y, z = f
    xz = np.hypot(x, z) * (-1.0 if x < 0 else 1.0)      # sign as in mounting_from_forward
    return np.array([f / K**2,
                     [x * y / xz / K**2, -xz / K**2, z * y / xz / K**2],
                     [-z / xz**2, 0.0, x / xz**2]])


def drift_sources(t: Floats, D: Floats, q_nb: Floats, alignment: Alignment) -> dict[str, Floats]:
    """
    Return the chord errors of the gyro's error sources, by name, (3, k) m, 1 sigma: (T10).

    t : (m,) epochs from the start of the leg to its end, s.   D : (m, 3) dead-reckoned
    displacement from the start, n, m.   q_nb : (m, 4) attitude, x y z w.   alignment : sigmas.
    """
    r = D[-1] - D
    dt = np.diff(t)
    # e = integral of (C_nb db) x r
    effect = map_windows(_gyro_error_effect, r, q_nb)
    bias = np.einsum('nij,n->ij', effect, dt) * alignment.gyro_bias_sigma
    # a misaligned axis j measures a share of the turn about each axis k
    axes = np.einsum('nij,nk->ijk', effect, map_windows(_step_rotations, q_nb)).reshape(3, 9)
    scale, off_diagonal = np.eye(3, dtype=bool).ravel(), ~np.eye(3, dtype=bool).ravel()
    # R(u): integral of r from u to the end, a sum from the end; a bias step at u acts on all of it
    integrals = (r[:-1] + r[1:]) / 2 * dt[:, None]
    R = np.concatenate([np.cumsum(integrals[::-1], axis=0)[::-1], np.zeros((1, 3))])
    return {f'gyro_bias_{axis}': bias[:, i:i + 1] for i, axis in enumerate('xyz')} | {
            'gyro_scale': axes[:, scale] * alignment.gyro_scale_sigma,
            'gyro_axes': axes[:, off_diagonal] * alignment.gyro_axes_sigma,
            'gyro_noise': alignment.gyro_noise * root_of(_noise_integral(r, dt)),
            'gyro_bias_walk': alignment.gyro_bias_walk * root_of(_noise_integral(R, dt))}


def _gyro_error_effect(r: Floats, q_nb: Floats) -> Floats:
    """
    Return the mean matrix -[r x] C_nb of each step: (n, 3), (n, 4) to (n - 1, 3, 3).

    It maps a gyro error db, rad/s, to (C_nb db) x r, the rate of the chord error, m/s, with r the
    displacement that remains until the end.
    """
    effect = -skew(r) @ matrix_from_quat(q_nb)
    return np.asarray((effect[:-1] + effect[1:]) / 2)


def _step_rotations(q_nb: Floats) -> Floats:
    """Return the rotation of each step about the axes of b: (n, 4) to (n - 1, 3) rad."""
    step = quat_multiply(quat_conjugate(q_nb[:-1]), q_nb[1:])
    return 2 * step[:, :3] * np.sign(step[:, 3:])


def _noise_integral(r: Floats, dt: Floats) -> Floats:
    """Return the integral of [r x][r x]^T over time, (3, 3) m^2 s: the effect of white noise."""
    middle = (r[:-1] + r[1:]) / 2
    outer = np.einsum('ni,nj,n->ij', middle, middle, dt)
    return np.asarray(np.trace(outer) * np.eye(3) - outer)


def root_of(covariance: Floats) -> Floats:
    """Return a square root of a covariance that may be singular: A A^T = covariance."""
    eigenvalues, V = np.linalg.eigh(covariance)
    return np.asarray(V * np.sqrt(np.maximum(eigenvalues, 0.0)))


def _odometer_delay_effect(f: Floats, t: Floats, D: Floats, q_nb: Floats, start: MarkFix,
                           end: MarkFix) -> Floats:
    """Return the chord error per odometer delay, (3,) m/s."""
    # travel is combined with later attitudes: the integral of dC/dt f ds. The travel between the
    # marks is shifted by the delay: minus v(end) - v(start)
    def middle_and_change(q_nb: Floats) -> Floats:
        C_nb = matrix_from_quat(q_nb)
        return np.stack([(C_nb[:-1] + C_nb[1:]) @ f / 2, np.diff(C_nb, axis=0) @ f], axis=1)

    middle, change = map(np.ascontiguousarray, map_windows(middle_and_change, q_nb).swapaxes(0, 1))
    speed = np.einsum('ni,ni->n', middle, np.diff(D, axis=0)) / (f @ f) / np.diff(t)
    effect = (change * speed[:, None]).sum(axis=0)
    v_start = 0.0 if start.standing else _velocity(t, D, start.t, min(start.t + 1.0, end.t))
    v_end = 0.0 if end.standing else _velocity(t, D, max(end.t - 1.0, start.t), end.t)
    return np.asarray(effect - (v_end - v_start))


def _velocity(t: Floats, D: Floats, begin: float, end: float) -> Floats:
    """Return the mean velocity between two times, (3,) m/s."""
    ends = np.stack([np.interp([begin, end], t, axis) for axis in D.T], -1)
    min_duration = 1e-9     # s, shorter than any interval
    return np.asarray((ends[1] - ends[0]) / max(end - begin, min_duration))


@dataclass(frozen=True, kw_only=True, eq=False)
class Uncertainties:
    """Uncertainties of a leg that its marks and its alignment do not contain."""

    fix_scale: Floats           # (3,) factor on the stated sigmas of the fixes, east, north, up
    quantum: float              # m, size of a count of the odometer
    time_sigma: float           # s, of the unknown delay of the fixes
    odometer_time_sigma: float  # s, of the unknown delay of the odometer
    lever_arm_sigma: float      # m, of the antenna, each axis


def budget(f: Floats, M: Floats, start: MarkFix, end: MarkFix, t: Floats, D: Floats, q_nb: Floats,
           alignment: Alignment, velocity_change: Floats, sigmas: Uncertainties,
           ) -> tuple[Source, ...]:
    """
    Return the sources of error of (ln K, yaw, pitch): docs/method.md (T9) to (T12).

    f : (3,) solution, m per unit of travel, in b.   M : (3, 3) attitude summed over travel.
    start, end : reference positions.   t, D, q_nb : (m,) s, (m, 3) m in n, (m, 4), as in
    drift_sources; epochs from the alignment, or the start mark if that is earlier, to the end
    mark.   velocity_change : (3,) velocity at the end mark minus that at the start, m/s, in n;
    zero between standing marks.
    """
    forward = D[-1] / np.linalg.norm(D[-1])
    at_start = int(np.searchsorted(t, start.t - 1e-9))
    # C_first: at the alignment, if that is before the start mark
    C_first, C_start, C_end = matrix_from_quat(q_nb[[0, at_start, -1]])
    height_variance = start.covariance_n[2, 2] + end.covariance_n[2, 2]
    fix_scale = sigmas.fix_scale
    chord = {
        'fix_start': fix_scale[:, None] * root_of(start.covariance_n),
        'fix_end': fix_scale[:, None] * root_of(end.covariance_n),
        'initial_heading': np.cross([0.0, 0.0, alignment.heading_sigma], D[-1])[:, None],
        # about b's own axes: an accelerometer bias tilts the level of every leg equally
        'initial_level': np.stack([np.cross(axis, D[-1]) for axis in C_first.T[:2]], -1)
        * alignment.level_sigma,
        **drift_sources(t, D, q_nb, alignment),
        'quantisation': (forward * sigmas.quantum * np.sqrt(2 / 12))[:, None],
        'fix_latency': (velocity_change * sigmas.time_sigma)[:, None],
        'antenna_lever_arm': (C_end - C_start) * sigmas.lever_arm_sigma,
        'odometer_delay': (_odometer_delay_effect(f, t, D, q_nb, start, end)
                           * sigmas.odometer_time_sigma)[:, None],
        # the height error common to both marks scales the chord as a larger Earth would
        'height': (D[-1] * (np.sqrt(height_variance / 2)
                            if start.height_known and end.height_known
                            else HEIGHT_UNKNOWN) / SEMI_MAJOR_AXIS)[:, None],
    }
    gradient = parameter_gradient(f) @ np.linalg.inv(M)
    # errors that are the same in every leg of a vehicle
    shared = {'fix_latency', 'antenna_lever_arm', 'odometer_delay', 'height', 'initial_level',
              'gyro_scale', 'gyro_axes'}
    if alignment.heading_shared:
        shared.add('initial_heading')
    sources = [Source(name, gradient @ e, name in shared) for name, e in chord.items()]
    return (*sources, _second_order(t, D, alignment, height_variance * fix_scale[2]**2))


def _second_order(t: Floats, D: Floats, alignment: Alignment, height_variance: float) -> Source:
    """Return the second-order error of the scale by attitude drift and heights: (T12)."""
    weight = np.linalg.norm(np.diff(D, axis=0), axis=1)
    weight = weight / max(weight.sum(), 1e-12)
    t_middle = (t[:-1] + t[1:]) / 2 - t[0]
    mean = weight @ t_middle
    by_bias = weight @ (t_middle - mean)**2 * np.max(alignment.gyro_bias_sigma)**2
    # random walk of attitude: variance of a Wiener process over the distance, T / 6 at constant
    # speed
    by_noise = alignment.gyro_noise**2 * (t[-1] - t[0]) / 6
    by_height = height_variance / (D[-1] @ D[-1])
    # the square of one Gaussian: mean m, standard deviation sqrt(2) m, rms sqrt(3) m
    size = 0.5 * np.sqrt(3) * np.linalg.norm([by_bias, by_noise, by_height])
    return Source('second_order', np.array([[size], [0.0], [0.0]]))


def total_covariance(sources: Iterable[Source]) -> Floats:
    """Return the covariance of the parameters from all sources, (p, p): docs/method.md (T13)."""
    return sum((s.effects @ s.effects.T for s in sources), np.zeros(()))


def budget_table(sources: Iterable[Source], parameters: Sequence[str],
                 scale: Sequence[float] | Floats) -> dict[str, dict[str, float | bool]]:
    """Return one-sigma effects by source and parameter, times ``scale``, (p,) (K of ln K)."""
    # shared : the error is the same in all legs
    return {s.name: {p: float(np.linalg.norm(s.effects[i]) * scale[i])
                     for i, p in enumerate(parameters)} | {'shared': s.shared} for s in sources}


def budget_details(sources: Iterable[Source], parameters: Sequence[str],
                   estimates: Mapping[str, Estimate]) -> dict[str, Any]:
    """Return ``budget`` and ``correlation`` of the parameters that have a value."""
    known = [i for i, p in enumerate(parameters) if estimates[p].value is not None]
    names = [parameters[i] for i in known]
    rows = [replace(s, effects=s.effects[known]) for s in sources]
    scale = [estimates[p].value or 0.0 if p.startswith('scale_factor') else 1.0 for p in names]
    return {'budget': budget_table(rows, names, scale),
            'correlation': correlations(total_covariance(rows), names)}


def correlations(covariance: Floats, names: Sequence[str]) -> dict[str, float]:
    """Return the correlation of each pair of parameters, for calibration.json."""
    sigma = np.sqrt(np.diag(covariance))
    rho = covariance / np.maximum(np.outer(sigma, sigma), 1e-300)
    return {f'{names[i]},{names[j]}': float(rho[i, j])
            for i in range(len(names)) for j in range(i + 1, len(names))}
