# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
What a real IMU adds: crooked triads, g-sensitivity, warmth, vibration, late stamps.

An IMU has two frames: its housing, and the frame that its own axes make. Gyro and accelerometer
triads are not square with the housing. In the measurement frame only the z gyro measures a turn
about z, and the y accelerometer no acceleration along x. Driving determines the mounting angles
of this frame.
"""

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.sim.noise import gauss_markov, stream
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.real import Real

# physical: Hz, width, share: wheel hop, engine
RESONANCES = ((12.0, 3.0, 1.0), (27.0, 4.0, 0.6))
APART_NS = 50_000    # judgement: between the stamps of one batch


def angles(d_b: Floats) -> tuple[float, float]:
    """Return yaw and pitch mounting angle of the forward axis in b, rad."""
    d = np.asarray(d_b, dtype=float)
    return float(-np.arcsin(d[1])), float(np.arctan2(d[2], d[0]))


def turn_and_push(gyro_matrix: Floats, accel_matrix: Floats) -> Floats:
    """
    Return the rotation that takes the turn-and-push frame to that of the matrices, (3, 3).

    ``I + M`` is what the triads make of a vector. To first order it is ``I + [theta x]`` with
    theta = (M_g,yz, -M_g,xz, -M_a,yx).
    """
    gyro, accel = np.eye(3) + gyro_matrix, np.eye(3) + accel_matrix
    z = np.linalg.solve(gyro, [0.0, 0.0, 1.0])
    z /= np.linalg.norm(z)
    x = np.cross(accel[1], z)      # not measured by the y accelerometer, perpendicular to z
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], -1)


def own_angles(C_vb: Floats, C_bi: Floats, gyro_matrix: Floats,
               accel_matrix: Floats) -> tuple[float, float, float, float]:
    """Return yaw and pitch by the IMU's own axes, then by its housing, rad; matrices in i."""
    d = np.asarray(C_vb)[0]
    R = turn_and_push(C_bi @ gyro_matrix @ C_bi.T, C_bi @ accel_matrix @ C_bi.T)
    return *angles(R.T @ d), *angles(d)


def crooked(w_i: Floats, f_i: Floats, real: Real) -> tuple[Floats, Floats]:
    """Return turn rate and specific force with the errors of the triads: (n, 3) each."""
    gyro, accel, G = (real.matrix(n) for n in ('gyro_matrix', 'accel_matrix', 'g_sensitivity'))
    w_m = w_i + w_i @ gyro.T if gyro.any() else w_i
    if G.any():
        w_m = w_m + f_i @ G.T
    return w_m, f_i + f_i @ accel.T if accel.any() else f_i


def drifts(t: Floats, speed: Floats, options: SimOptions) -> list[Floats | float]:
    """Return gyro and accelerometer errors by temperature, drift and vibration: (n, 3) or 0.0."""
    real = options.real
    warmth = real.warm_rise * -np.expm1(-t / real.warm_time)[:, None]
    added = []
    for name, shake in (('gyro', real.gyro_vibration), ('accel', real.vibration)):
        slope, wander = getattr(real, f'{name}_slope'), getattr(real, f'{name}_wander')
        total = warmth * np.array(slope) if real.warm_rise and any(slope) else 0.0
        if wander:
            total = total + _wander(stream(options.seed, f'real {name} wander'), wander,
                                    real.wander_time, t)
        if shake:
            level = np.abs(speed)[:, None] / (np.abs(speed)[:, None] + 5.0)    # half at 5 m/s
            total = total + level * vibration(stream(options.seed, f'real {name} vibration'),
                                              shake, options.imu_rate, len(t))
            if name == 'accel' and real.rectification:
                total = total + real.rectification * (shake * level)**2
        added.append(total)
    return added


def _wander(rng: np.random.Generator, sigma: float, tau: float, t: Floats) -> Floats:
    """Return a walk about 0 from the bias at the first sample on, straight between draws."""
    knots = np.arange(0.0, t[-1] + 2.0, 1.0)    # s
    x = gauss_markov(rng, sigma, tau, knots)
    return np.stack([np.interp(t, knots, column) for column in (x - x[0]).T], -1)


def vibration(rng: np.random.Generator, rms: float, rate: float, n: int) -> Floats:
    """
    Return shaking of a body that goes nowhere, (n, 3): around its resonances, nothing at 0 Hz.

    Its power falls as f^4 below them, as for the acceleration of a bounded displacement.
    """
    f = np.fft.rfftfreq(n, 1 / rate)
    power = np.zeros_like(f)
    for middle, width, share in RESONANCES:
        at = min(middle, 0.4 * rate)
        power += share * np.minimum(f / at, 1.0)**4 / (1 + ((f - at) / width)**2)
    shape = np.sqrt(power)[:, None]
    x = np.fft.irfft(np.fft.rfft(rng.standard_normal((n, 3)), axis=0) * shape, n, axis=0)
    # both halves of the spectrum: the mean square of the shape is that of the samples
    weight = np.full(len(f), 2.0)
    weight[0] = 1.0
    weight[-1] = 1.0 if n % 2 == 0 else 2.0
    shaking: Floats = rms * x / np.sqrt((weight * power).sum() / n)
    return shaking


def stamped(ns: Ints, rng: np.random.Generator, latency: float, jitter: float,
            batch: int = 1) -> Ints:
    """
    Return stamps (ns) of samples measured at ``ns``: late, in order, and in batches.

    The mean of the jitter is none, but no stamp is before its sample.
    """
    late = np.maximum(latency + jitter * rng.standard_normal(len(ns)), 0.0)
    stamp = ns + np.rint(late * 1e9).astype(np.int64)
    apart = APART_NS * np.arange(len(ns))
    if batch > 1:
        last = np.minimum(np.arange(len(ns)) // batch * batch + batch - 1, len(ns) - 1)
        stamp = stamp[last]
    return np.maximum.accumulate(stamp - apart) + apart
