# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Smoothing of a receiver: the mean of past positions, weighted by exp(-age / tau) / tau.

A stamp's delay is the mean age; what is computed here is the rest of it, by the square of tau: the
smoothed place at t + tau less the place at t. Of small tau that is a tau^2 / 2, a series that does
not end soon: of 0.6 s in town its next terms are decimetres.
"""

import numpy as np

from odocal_ros.data.arrays import Floats, Ints

# s^2, judgement: below, as much in proportion (and of an estimate below zero)
LEAST_LAG2 = 1e-4


def smoothing(t: Floats, place: Floats, velocity: Floats, at: Floats, square: float,
              ) -> tuple[Floats, Floats]:
    """
    Return the error of smoothed positions, and the derivative by ``square``.

    t, place, velocity : (n,) s, (n, 3) m and m/s, rising; cubics lie between.
    at : (k,) s, mean age of what a fix holds taken off its stamp.   square : s^2, of tau.
    """
    def late(square: float) -> Floats:
        return _late(t, place, velocity, at, np.sqrt(square))

    if square <= LEAST_LAG2:
        rate = late(LEAST_LAG2) / LEAST_LAG2
        return rate * square, rate
    here = late(square)
    lag2_step = 1e-4    # relative, of the difference that gives a derivative
    return here, (late(square * (1 + lag2_step)) - here) / (square * lag2_step)


def _late(t: Floats, place: Floats, velocity: Floats, at: Floats, tau: float) -> Floats:
    """
    Return the smoothed places at ``at + tau`` less those at ``at``, (k, 3).

    On a cubic the filter's answer is one too, p - tau p' + tau^2 p'' - tau^3 p''', and what is
    left of before dies away.
    """
    track_beyond = 10.0    # s of extrapolation at the last velocity
    t = np.append(t, t[-1] + track_beyond)
    place = np.concatenate([place, place[-1:] + track_beyond * velocity[-1:]])
    velocity = np.concatenate([velocity, velocity[-1:]])
    T = np.diff(t)[:, None]
    mean = np.diff(place, axis=0) / T
    bend = (3 * mean - 2 * velocity[:-1] - velocity[1:]) / T             # p'' / 2 at its begin
    twist = (velocity[:-1] + velocity[1:] - 2 * mean) / T**2             # p''' / 6
    # where two cubics meet, their answers differ by jumps of p'' and p'''
    first = tau**2 * (2 * bend - 6 * tau * twist)
    last = tau**2 * (2 * bend + 6 * (T - tau) * twist)
    left = np.concatenate([-first[:1], last[:-1] - first[1:]])
    for m, decay in enumerate(np.exp(-T[:-1] / tau), 1):
        left[m] += decay * left[m - 1]

    def cubics(at: Floats) -> tuple[Ints, Floats]:
        k = np.clip(np.searchsorted(t, at, side='right') - 1, 0, len(T) - 1)
        return k, (at - t[k])[:, None]

    k, s = cubics(at)
    before = place[k] + s * (velocity[k] + s * (bend[k] + s * twist[k]))
    k, s = cubics(at + tau)
    p = place[k] + s * (velocity[k] + s * (bend[k] + s * twist[k]))
    rate = velocity[k] + s * (2 * bend[k] + 3 * s * twist[k])
    after = p - tau * rate + tau**2 * (2 * bend[k] + 6 * (s - tau) * twist[k])
    off: Floats = after + left[k] * np.exp(-np.maximum(s, 0.0) / tau) - before
    return off
