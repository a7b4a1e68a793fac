"""Where the sigma comes from: each kind of error's share of scale, yaw and pitch."""

import numpy as np

from odocal_ros.calib.result import Source
from odocal_ros.calib.smoother.components import units
from odocal_ros.calib.smoother.noise import INTERVAL
from odocal_ros.calib.smoother.state import (
    ACCEL,
    BA,
    BG,
    E,
    GNSS_ARM,
    GNSS_DELAY,
    GYRO,
    HEADING,
    M,
    ODO_ARM,
    ODO_DELAY,
    SLOW,
    WITH_SLOW,
)

NAMES = {'gyro': 'gyro_noise', 'accel': 'accelerometer_noise', 'gyro_walk': 'gyro_bias_walk',
         'accel_walk': 'accelerometer_bias_walk', 'along': 'travel_noise',
         'along_hard': 'travel_noise', 'side': 'sideslip', 'side_turn': 'sideslip',
         'up': 'vertical_motion'}
# believed of the vehicle, so the same in every leg
SHARED = {'odometer_lever_arm': ODO_ARM, 'antenna_lever_arm': GNSS_ARM,
          'odometer_delay': slice(ODO_DELAY, ODO_DELAY + 1),
          'fix_latency': slice(GNSS_DELAY, GNSS_DELAY + 1),
          'gyro_scale': slice(GYRO.start, GYRO.start + 3),
          'gyro_by_force': slice(GYRO.start + 3, GYRO.stop),
          'accelerometer_scale': slice(ACCEL.start, ACCEL.start + 2),
          'accelerometer_axes': slice(ACCEL.start + 2, ACCEL.stop),
          'heading': slice(HEADING, HEADING + 1)}
P = 3        # parameters: ln K, yaw, pitch


def shares(fit, neighbours) -> tuple[Source, ...]:
    """
    Return the sources of error of (ln K, yaw, pitch); their covariances add up to the whole.

    An error of unit size in a row moves the estimate by the covariance of the estimate with the
    unknowns of that row, times the row's whitened derivative.
    """
    w, n = fit.weighted, fit.weighted.n
    c = slice(2 * n, 2 * n + P)
    with_c = neighbours[:, c, :]                              # (K, 3, 2n + M)
    covariance: dict[str, np.ndarray] = {}

    def add(name, effects):
        """Effects (..., 3, k) of independent unit errors."""
        flat = np.moveaxis(effects, -2, 0).reshape(P, -1)
        covariance[name] = covariance.get(name, 0.0) + flat @ flat.T

    A, Y = units(w)
    X = with_c @ Y
    for i, name in enumerate(INTERVAL):
        add(NAMES[name], X[:, :, w.eq.noise.component == i])
    _add_fixes(w, neighbours, add)
    for rows in w.outside:
        add(rows.source, rows.effects(neighbours, P))
    root = np.sqrt(w.eq.travel_weight / w.travel_variance)
    travel = np.concatenate([with_c[:, :, E], with_c[-1:, :, n + E]]) * root[:, None]
    add('quantisation', travel[:, :, None])
    if n == WITH_SLOW:
        push = (with_c[:, :, n + SLOW.start:n + SLOW.stop]
                - w.decay[:, None, None] * with_c[:, :, SLOW]) / np.sqrt(w.slow_drive)[:, None]
        add('slow_fix_errors', push)
        add('slow_fix_errors', with_c[0, :, SLOW] / np.sqrt(w.slow_power))
    priors = fit.priors
    add('gyro_bias', with_c[0, :, BG] / priors.gyro_bias)
    add('accelerometer_bias', with_c[0, :, BA] / priors.accel_bias)
    border = fit.solved.covariance[:P]
    shared = [Source(name, border[:, where] / priors.constants[where], True)
              for name, where in SHARED.items() if name != 'heading' or _has_heading(w)]
    total = fit.solved.covariance[:P, :P]
    rest = total - sum(covariance.values()) - sum(s.effects @ s.effects.T for s in shared)
    own = [Source(name, _root(value)) for name, value in covariance.items()]
    return (*own, *shared, Source('standstill', _root(rest)))


def _has_heading(w):
    return any(rows.name == 'heading' for rows in w.outside)


def _add_fixes(w, neighbours, add):
    n, k = w.n, w.eq.fixes.k
    present = np.unique(k)
    own = np.r_[0:n, 2 * n:2 * n + M]
    block = neighbours[present][:, 2 * n:2 * n + P]
    X = block[:, :, own] @ np.swapaxes(w.by_interval(w.FJ), 1, 2)
    if n == WITH_SLOW:
        end = slice(n + SLOW.start, n + SLOW.stop)
        X = X + block[:, :, end] @ np.swapaxes(w.by_interval(w.FJ_end), 1, 2)
    add('fixes', X)


def _root(covariance):
    """Return a square root of a covariance, rounding below zero taken for zero."""
    value, vector = np.linalg.eigh(covariance)
    return vector * np.sqrt(np.maximum(value, 0.0))
