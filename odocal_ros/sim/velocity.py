# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Velocity of a simulated receiver: of the antenna, east, north, up."""

from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.samples import VelocitySamples
from odocal_ros.nav.earth import radii
from odocal_ros.sim import real_fixes, sensors
from odocal_ros.sim.motion import Motion
from odocal_ros.sim.noise import gauss_markov, stream
from odocal_ros.sim.options import SimOptions

HALF_STEP = 0.005       # s, judgement: differences of positions are exact to 1e-4 m/s
OUTLIER = 5.0           # m/s, judgement: a wrong Doppler in a street


def velocity(motion: Motion, options: SimOptions) -> VelocitySamples:
    """Return the published velocity of the antenna; none without a sigma."""
    sigma = options.velocity_sigma
    if sigma is None:
        return VelocitySamples.none()
    ns, t = sensors.stamps(motion.duration, options.velocity_rate, sensors.PHASE['fix'])
    smoothed = replace(options, real=replace(options.real, receiver_lag=options.velocity_lag))
    before, after = (np.stack(real_fixes.places(motion, np.maximum(t + by, 0.0), smoothed), -1)
                     for by in (-HALF_STEP, HALF_STEP))
    latitude, _, height = after.T
    meridian, normal = radii(latitude)
    north, east, up = ((after - before) / (2 * HALF_STEP)).T
    true = np.stack([east * (normal + height) * np.cos(latitude), north * (meridian + height), up],
                    -1)
    sent = true * (1 + options.velocity_scale_error) + _errors(t, options, sigma)
    stamp = options.start_ns + ns + round(options.velocity_delay * 1e9)
    return VelocitySamples(stamp, stamp + round(sensors.TRANSPORT['fix'] * 1e9), sent,
                           np.full(sent.shape, sigma**2))


def _errors(t: Floats, options: SimOptions, sigma: float) -> Floats:
    time, rng = options.velocity_correlation_time, stream(options.seed, 'velocity')
    error = (gauss_markov(rng, sigma, time, t) if time
             else sigma * rng.standard_normal((len(t), 3)))
    far = rng.uniform(size=(len(t), 1)) < options.velocity_outliers
    out: Floats = error + far * OUTLIER * rng.standard_normal((len(t), 3))
    return out
