# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A real receiver: filters, correlated errors, multipath, wrong stated sigmas, velocity."""

from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.samples import VelocitySamples
from odocal_ros.nav.earth import radii
from odocal_ros.sim import body
from odocal_ros.sim.motion import Motion, point
from odocal_ros.sim.noise import gauss_markov, PHASE, stamps, stream, TRANSPORT
from odocal_ros.sim.options import SimOptions

# definition: ages, in time constants, and weights of a first-order filter: Gauss-Legendre rule on
# pieces, fine enough for the kinks of a route
EDGES = np.concatenate([np.arange(0.0, 8.0, 0.25), np.arange(8.0, 20.0, 1.0),
                        np.arange(20.0, 41.0, 4.0)])
NODES = (EDGES[:-1, None] + np.diff(EDGES)[:, None] * (0.5 + np.array([-1, 1]) / 12**0.5)).ravel()
AVERAGING = np.exp(-NODES) * np.repeat(np.diff(EDGES) / 2, 2)
AVERAGING /= AVERAGING.sum()
# definition: of a second-order filter of position and velocity, damped by sqrt(1/2)
TRACKING = np.exp(-NODES / 2**0.5) * np.cos(NODES / 2**0.5) * np.repeat(np.diff(EDGES) / 2, 2)
TRACKING /= TRACKING.sum()
UP = 2.0             # judgement: errors of the height over those of east and north
ONSET = (0.5, 1.5)   # judgement: of the mean time in which a burst comes and goes
HALF_STEP = 0.005       # s, judgement: differences of positions are exact to 1e-4 m/s
OUTLIER = 5.0           # m/s, judgement: a wrong Doppler in a street


def places(motion: Motion, t: Floats, options: SimOptions) -> tuple[Floats, Floats, Floats]:
    """Return latitude, longitude (rad), height (m) of a receiver without noise at t."""
    real, true = options.real, _antenna(motion, t, options)
    out = true
    for weights, time in ((AVERAGING, real.receiver_lag), (TRACKING, real.receiver_tracking)):
        if time:
            out = _filtered(motion, t, options, weights, time)
    if real.receiver_odometer:
        mean = _filtered(motion, t, options, AVERAGING, real.receiver_odometer_time)
        share = real.receiver_odometer
        latitude, longitude, height = (x + share * (now - past) for x, now, past in zip(
            out, true, mean, strict=True))
        return latitude, longitude, height
    return out


def _filtered(motion: Motion, t: Floats, options: SimOptions, weights: Floats,
              time: float) -> tuple[Floats, Floats, Floats]:
    """Return positions weighted by age; before the first sample the vehicle is at rest."""
    return tuple(sum(w * x for w, x in zip(weights, row, strict=True)) for row in zip(
        *(_antenna(motion, np.maximum(t - time * node, 0.0), options) for node in NODES),
        strict=True))


def fused(t: Floats, errors: Floats, options: SimOptions) -> Floats:
    """Return (n, 3) satellite errors after fusion with the odometer of the receiver."""
    if not options.real.receiver_odometer:
        return errors
    left = np.exp(-np.diff(t) / options.real.receiver_odometer_time)
    out = errors.copy()
    for k, a in enumerate(left, 1):
        out[k] = a * out[k - 1] + (1 - a) * errors[k]
    return out


def _antenna(motion: Motion, t: Floats, options: SimOptions) -> tuple[Floats, Floats, Floats]:
    tilt = body.rotation(motion, t) if motion.tilt else None
    return point(motion.at(t), options.antenna_lever_arm, tilt)


def errors(t: Floats, options: SimOptions) -> Floats | float:
    """Return slow errors and bursts at (n,) times, ENU, m: (n, 3), or 0.0."""
    real = options.real
    total: Floats | float = 0.0
    for k, (sigma, tau) in enumerate(real.slow_errors):
        slow = gauss_markov(stream(options.seed, f'real slow {k}'), sigma, tau, t)
        total = total + slow * [1.0, 1.0, UP]
    return total + burst_errors(t, options) if real.bursts else total


def burst_errors(t: Floats, options: SimOptions) -> Floats:
    """Return errors by multipath: bursts to any side, of smooth onset: (n, 3)."""
    real, rng = options.real, stream(options.seed, 'real bursts')
    total, hours = np.zeros((len(t), 3)), t[-1] / 3600
    for _ in range(rng.poisson(real.bursts * hours)):
        begin, side = rng.uniform(0.0, t[-1]), rng.uniform(0, 2 * np.pi)
        size, length = (median * np.exp(real.burst_spread * rng.standard_normal())
                        for median in (real.burst_size, real.burst_time))
        onset, up = real.burst_onset * rng.uniform(*ONSET), rng.normal()
        x = np.clip(np.minimum(t - begin, begin + length + onset - t) / onset, 0.0, 1.0)
        shape = size * x**2 * (3 - 2 * x)
        total += shape[:, None] * [np.cos(side), np.sin(side), up]
    return total


def reckoned(t: Floats, error: Floats, place: Floats, options: SimOptions) -> Floats:
    """
    Return errors of a receiver that dead-reckons in tunnels, without effect after them.

    error, place : (n, 3) m, ENU; the error at the entry is kept in the tunnel.
    """
    real, out = options.real, error.copy()
    for begin, length in real.tunnels:
        inside = np.flatnonzero((t >= begin) & (t < begin + length))
        if len(inside) < 2:
            continue
        steps = np.diff(place[inside], axis=0, prepend=place[inside[:1]])
        turned = real.tunnel_heading * (t[inside, None] - begin) / 60
        sideways = np.stack([-steps[:, 1], steps[:, 0], 0 * steps[:, 2]], -1)
        out[inside] = error[inside[0]] + np.cumsum(
            real.tunnel_odometer * steps + turned * sideways, axis=0)
    return out


def true_variance(white: Floats, options: SimOptions) -> Floats:
    """Return the variance of the errors without bursts, ENU: (3,) m^2. white: of the noise."""
    slow = sum(sigma**2 for sigma, _ in options.real.slow_errors)
    return white + slow * np.array([1.0, 1.0, UP**2])


def velocity(motion: Motion, options: SimOptions) -> VelocitySamples:
    """Return the published velocity of the antenna; none without a sigma."""
    sigma = options.velocity_sigma
    if sigma is None:
        return VelocitySamples.none()
    ns, t = stamps(motion.duration, options.velocity_rate, PHASE['fix'])
    smoothed = replace(options, real=replace(options.real, receiver_lag=options.velocity_lag))
    before, after = (np.stack(places(motion, np.maximum(t + by, 0.0), smoothed), -1)
                     for by in (-HALF_STEP, HALF_STEP))
    latitude, _, height = after.T
    meridian, normal = radii(latitude)
    north, east, up = ((after - before) / (2 * HALF_STEP)).T
    true = np.stack([east * (normal + height) * np.cos(latitude), north * (meridian + height), up],
                    -1)
    sent = true * (1 + options.velocity_scale_error) + _velocity_errors(t, options, sigma)
    stamp = options.start_ns + ns + round(options.velocity_delay * 1e9)
    return VelocitySamples(stamp, stamp + round(TRANSPORT['fix'] * 1e9), sent,
                           np.full(sent.shape, sigma**2))


def _velocity_errors(t: Floats, options: SimOptions, sigma: float) -> Floats:
    time, rng = options.velocity_correlation_time, stream(options.seed, 'velocity')
    error = (gauss_markov(rng, sigma, time, t) if time
             else sigma * rng.standard_normal((len(t), 3)))
    far = rng.uniform(size=(len(t), 1)) < options.velocity_outliers
    out: Floats = error + far * OUTLIER * rng.standard_normal((len(t), 3))
    return out
