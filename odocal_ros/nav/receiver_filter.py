# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Errors of fixes due to a filter or an odometer in the receiver, docs/method.md (S16) to (S16b).

A receiver has one of two filters with the time constant tau, described by one unknown, lag_square:

* lag_square = tau^2 > 0: the mean of past positions, weighted by exp(-age / tau) / tau. The delay
  of a stamp is the mean age; this module computes the rest, the mean at t + tau minus the position
  at t.
* lag_square = -2 tau^2 < 0: a filter of position and velocity, which follows a constant velocity
  without delay and overshoots where it changes. Its error e of the position p is
  e'' + sqrt(2) e' / tau + e / tau^2 = -p''.

For small tau both errors are p'' lag_square / 2, the first term of a series that converges slowly:
at 0.6 s in town its next terms are decimetres.
"""

import numpy as np
from scipy.linalg import solve_banded

from odocal_ros.data.arrays import Floats, Ints

# s^2, judgement: the error is proportional to ``lag_square`` below
MIN_LAG2 = 1e-4


def filter_error(t: Floats, position: Floats, velocity: Floats, times: Floats,
                 lag_square: float) -> tuple[Floats, Floats]:
    """
    Return the errors of filtered positions, (k, 3) m, and their derivatives by ``lag_square``.

    t, position, velocity : (n,) s, rising, (n, 3) m and m/s of the antenna, with cubics in
    between.   times : (k,) s, stamps minus their delay.   lag_square : s^2, as above.
    """
    def compute_error(lag_square: float) -> Floats:
        if lag_square > 0:
            track, tau = _Track(t, position, velocity), np.sqrt(lag_square)
            return track.smoothed(times + tau, tau) - track.position_at(times)
        return _tracking_error(t, position, velocity, times, np.sqrt(-lag_square / 2))

    if abs(lag_square) <= MIN_LAG2:
        smallest = -MIN_LAG2 if lag_square < 0 else MIN_LAG2
        gradient = compute_error(smallest) / smallest
        return gradient * lag_square, gradient
    error, step = compute_error(lag_square), 1e-4      # relative, of a difference quotient
    return error, (compute_error(lag_square * (1 + step)) - error) / (lag_square * step)


def _cubic_coefficients(t: Floats, position: Floats,
                        velocity: Floats) -> tuple[Floats, Floats, Floats]:
    """Return (n - 1, 1) lengths of the intervals, (n - 1, 3) p'' / 2 at their start, p''' / 6."""
    T = np.diff(t)[:, None]
    mean = np.diff(position, axis=0) / T
    return (T, (3 * mean - 2 * velocity[:-1] - velocity[1:]) / T,
            (velocity[:-1] + velocity[1:] - 2 * mean) / T**2)


def odometer_error(t: Floats, position: Floats, velocity: Floats, times: Floats,
                   scale_error: float, log_time: float) -> tuple[Floats, Floats, Floats]:
    """
    Return the errors of fixes due to an odometer in the receiver, (k, 3) m, (S16a).

    Also their derivatives by ``scale_error`` and ``log_time``. The error is the scale error times
    the motion before each time, weighted by exp(-age / time): satellites correct the position
    within ``time``.

    t, position, velocity, times : as for ``filter_error``.   scale_error : relative.   log_time :
    logarithm of the time, s.
    """
    track, time, step = _Track(t, position, velocity), np.exp(log_time), 1e-3    # of the logarithm
    motion = track.position_at(times) - track.smoothed(times, time)
    longer = track.position_at(times) - track.smoothed(times, time * np.exp(step))
    return scale_error * motion, motion, scale_error * (longer - motion) / step


class _Track:
    """Cubics between positions and velocities, extrapolated linearly, and means of their past."""

    def __init__(self, t: Floats, position: Floats, velocity: Floats) -> None:
        extrapolation = 10.0       # s of extrapolation at the last velocity
        self.t = np.append(t, t[-1] + extrapolation)
        self.position = np.concatenate([position, position[-1:] + extrapolation * velocity[-1:]])
        self.velocity = np.concatenate([velocity, velocity[-1:]])
        self.T, self.bend, self.twist = _cubic_coefficients(self.t, self.position, self.velocity)

    def _cubic(self, times: Floats) -> tuple[Ints, Floats, Floats]:
        """Return intervals (k,), times in them (k, 1) and positions (k, 3)."""
        k = np.clip(np.searchsorted(self.t, times, side='right') - 1, 0, len(self.T) - 1)
        s = (times - self.t[k])[:, None]
        return k, s, self.position[k] + s * (
            self.velocity[k] + s * (self.bend[k] + s * self.twist[k]))

    def position_at(self, times: Floats) -> Floats:
        """Return the positions, (k, 3)."""
        return self._cubic(times)[2]

    def smoothed(self, times: Floats, tau: float) -> Floats:
        """
        Return the mean of the positions before each time, weighted by exp(-age / tau), (k, 3).

        On a cubic it is the cubic p - tau p' + tau^2 p'' - tau^3 p''' plus a decaying transient.
        """
        T, bend, twist = self.T, self.bend, self.twist
        # where two cubics meet, their responses differ by jumps of p'' and p'''
        start = tau**2 * (2 * bend - 6 * tau * twist)
        end = tau**2 * (2 * bend + 6 * (T - tau) * twist)
        # transients at the starts of the intervals: each is the decayed one before plus the jump
        decay = np.append(-np.exp(-T[:-1, 0] / tau), 0.0)
        transient = solve_banded((1, 0), np.stack([np.ones_like(decay), decay]),
                                 np.concatenate([-start[:1], end[:-1] - start[1:]]))
        k, s, p = self._cubic(times)
        rate = self.velocity[k] + s * (2 * bend[k] + 3 * s * twist[k])
        steady = p - tau * rate + tau**2 * (2 * bend[k] + 6 * (s - tau) * twist[k])
        return np.asarray(steady + transient[k] * np.exp(-np.maximum(s, 0.0) / tau))


def _tracking_error(t: Floats, position: Floats, velocity: Floats, times: Floats,
                    tau: float) -> Floats:
    """Return the errors of a filter of position and velocity, (k, 3)."""
    T, bend, twist = _cubic_coefficients(t, position, velocity)

    def forced_response(k: Ints | slice, s: Floats) -> Floats:
        """Return error and derivative on cubics k at times s in them, without transients."""
        jerk = 6 * twist[k]
        return tau**2 * np.stack([np.sqrt(2) * tau * jerk - 2 * bend[k] - jerk * s, -jerk], 1)

    transition = _transition_matrices(np.append(0.0, T[:-1, 0]), tau)
    start, end = forced_response(slice(None), np.zeros_like(T)), forced_response(slice(None), T)
    transient = -start
    transient[1:] += end[:-1]       # error and derivative are continuous where two cubics meet
    for m in range(1, len(T)):
        transient[m] += transition[m] @ transient[m - 1]
    k = np.clip(np.searchsorted(t, times, side='right') - 1, 0, len(T) - 1)
    s = (times - t[k])[:, None]
    return np.asarray(forced_response(k, s)[:, 0] + np.einsum(
        'ki,kij->kj', _transition_matrices(np.maximum(s[:, 0], 0.0), tau)[:, 0], transient[k]))


def _transition_matrices(s: Floats, tau: float) -> Floats:
    """Return transition matrices of an error and its derivative over s: (k, 2, 2)."""
    w = np.sqrt(0.5) / tau      # decay rate and frequency at a damping of sqrt(1/2)
    decay, sine, cosine = np.exp(-w * s), np.sin(w * s), np.cos(w * s)
    return np.asarray(decay[:, None, None] * np.stack([
        np.stack([cosine + sine, sine / w], -1), np.stack([-2 * w * sine, cosine - sine], -1)], 1))
