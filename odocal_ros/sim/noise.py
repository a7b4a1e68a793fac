# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Sample times, a random generator for each sensor, and processes of noise and drift."""

import zlib

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.sim.options import SimOptions

# s from the first IMU sample, so that no two topics sample together
PHASE = {'odometer': 0.002, 'fix': 0.003, 'heading': 0.004, 'pressure': 0.005}
CLOSURE_REMAINDER = 0.2     # judgement: share of the drift that remains after a loop closure
# judgement: from measurement to arrival
TRANSPORT_DELAY_NS = {'imu': 500_000, 'fix': 50_000_000, 'heading': 10_000_000}


def make_rng(seed: int, name: str) -> np.random.Generator:
    """Return a generator by seed and name, so that options of one sensor affect no other one."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def white(rng: np.random.Generator, root_psd: float, rate: float,
          shape: tuple[int, int]) -> Floats:
    """Return samples at ``rate`` Hz of white noise of a root PSD, unit/sqrt(Hz)."""
    return np.asarray(root_psd * rate**0.5 * rng.standard_normal(shape))


def random_walk(rng: np.random.Generator, root_rate: float, rate: float,
                shape: tuple[int, int]) -> Floats:
    """Return a random walk from 0 that grows by ``root_rate`` unit/sqrt(s): (n, ...)."""
    steps = root_rate / rate**0.5 * rng.standard_normal(shape)
    steps[:1] = 0.0
    return np.cumsum(steps, axis=0)


def gauss_markov(rng: np.random.Generator, sigma: float, tau: float, t: Floats) -> Floats:
    """Return a stationary first-order Gauss-Markov process in three axes: (n,) s to (n, 3)."""
    decay = np.exp(-np.diff(t, prepend=t[:1]) / tau)
    disturbances = sigma * np.sqrt(1 - decay**2)[:, None] * rng.standard_normal((len(t), 3))
    disturbances[:1] = sigma * rng.standard_normal((1, 3))
    values: Floats = np.empty_like(disturbances)
    value = np.zeros(3)
    for k, disturbance in enumerate(disturbances):
        values[k] = value = decay[k] * value + disturbance
    return values


def stamps(duration: float, rate: float, phase: float = 0.0) -> tuple[Ints, Floats]:
    """Return sample times at a rate, Hz, from a phase, s: whole ns (n,), and the same in s."""
    n = int(np.floor((duration - phase) * rate + 1e-9)) + 1
    ns = np.rint(phase * 1e9 + np.arange(n) * (1e9 / rate)).astype(np.int64)
    return ns, ns * 1e-9


def reference_drift(t: Floats, travel: Floats, options: SimOptions) -> Floats | float:
    """Return errors (n, 3) m, ENU, that change with travel (n,), m, and jump at loop closures."""
    if not options.reference_drift:
        return 0.0
    rng, length = make_rng(options.seed, 'reference drift'), options.drift_length
    path = np.abs(np.diff(travel, prepend=travel[:1]))
    remaining = np.exp(-path / length) if length else np.ones(len(t))     # share of the last error
    is_closed = make_rng(options.seed, 'loop closures').uniform(size=len(t)) < np.diff(
        t, prepend=t[:1]) / (options.closure_time or np.inf)
    sigma = stationary_sigma(options)
    step_sigma = (sigma * np.sqrt(1 - remaining**2) if length
                  else options.reference_drift * np.sqrt(path))
    remaining = np.where(is_closed, CLOSURE_REMAINDER, remaining)
    errors = np.zeros((len(t), 3))
    steps = step_sigma[:, None] * rng.standard_normal((len(t), 2))
    errors[0, :2] = sigma * rng.standard_normal(2)
    for k in range(1, len(t)):
        errors[k, :2] = remaining[k] * errors[k - 1, :2] + steps[k]
    return errors


def stationary_sigma(options: SimOptions) -> float:
    """Return the stationary sigma of a correlated drift, m; 0 for a random walk."""
    return float(options.reference_drift * np.sqrt(options.drift_length / 2))
