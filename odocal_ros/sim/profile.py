# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Piecewise polynomials of time: speeds and turn rates with exact derivatives and integrals."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from odocal_ros.data.arrays import Floats, Ints

Piece = tuple[float, tuple[float, float, float, float]]    # duration, powers of time in it


class Profile:
    """
    A piecewise polynomial, held constant before its first and after its last break.

    breaks : (m + 1,) rising, s.   powers : (m, d) coefficients of (t - breaks[i]) ** 0, 1, ...
    """

    def __init__(self, breaks: ArrayLike, powers: ArrayLike) -> None:
        self.breaks: Floats = np.asarray(breaks, dtype=float)
        self.powers: Floats = np.asarray(powers, dtype=float)

    @property
    def end(self) -> float:
        """Return the last break."""
        return float(self.breaks[-1])

    def __call__(self, t: ArrayLike) -> Floats:
        """Return the values at (...) times; at a jump, the value after it."""
        return self._on(self._piece(t), t)

    def mean(self, t: ArrayLike) -> Floats:
        """Return the values, at a jump the mean of both sides (a trapezoid rule is then exact)."""
        t = np.asarray(t, dtype=float)
        near = 1e-9    # s, a sample this near a break lies on it
        before, after = self._piece(t - near), self._piece(t + near)
        return (self._on(before, t) + self._on(after, t)) / 2

    def derivative(self) -> 'Profile':
        """Return the derivative."""
        order = np.arange(1, self.powers.shape[1])
        return Profile(self.breaks, self.powers[:, 1:] * order if len(order)
                       else np.zeros((len(self.powers), 1)))

    def integral(self) -> 'Profile':
        """Return the integral from the first break."""
        order = np.arange(1, self.powers.shape[1] + 1)
        powers = np.concatenate([np.zeros((len(self.powers), 1)), self.powers / order], axis=1)
        gains = _horner(powers.T, np.diff(self.breaks))
        powers[1:, 0] = np.cumsum(gains)[:-1]
        return Profile(self.breaks, powers)

    def _piece(self, t: ArrayLike) -> Ints:
        piece = np.searchsorted(self.breaks, t, side='right') - 1
        return np.clip(piece, 0, len(self.powers) - 1)

    def _on(self, piece: Ints, t: ArrayLike) -> Floats:
        t = np.clip(t, self.breaks[0], self.breaks[-1])
        return _horner(self.powers.T[:, piece], t - self.breaks[piece])


def _horner(powers: Floats, x: Floats) -> Floats:
    value: Floats = powers[-1]
    for power in powers[-2::-1]:
        value = value * x + power
    return value


def line(duration: float, start: float, end: float) -> Piece:
    """Return one piece: (duration, powers), straight from one value to another."""
    return duration, (start, (end - start) / duration if duration else 0.0, 0.0, 0.0)


def smooth(duration: float, start: float, end: float) -> Piece:
    """Return one piece with level ends: 3 x^2 - 2 x^3 between the values."""
    rise = end - start
    return duration, (start, 0.0, 3 * rise / duration**2, -2 * rise / duration**3)


def hermite(breaks: Floats, values: Floats, slopes: Floats) -> Profile:
    """Return the cubics that have these values and slopes at the breaks."""
    h, rise = np.diff(breaks), np.diff(values)
    first, last = slopes[:-1] * h, slopes[1:] * h
    square, cube = (3 * rise - 2 * first - last) / h**2, (first + last - 2 * rise) / h**3
    return Profile(breaks, np.stack([values[:-1], slopes[:-1], square, cube], -1))


def chain(pieces: Iterable[Piece]) -> Profile:
    """Join pieces end to end from time 0; pieces of no duration vanish."""
    kept = [(d, p) for d, p in pieces if d > 0]
    # breaks rounded to ns, so that a break meant for a sample's stamp is on it
    breaks = np.round(np.cumsum([0.0] + [d for d, _ in kept]), 9)
    return Profile(breaks, [p for _, p in kept])


def ramp(duration: float, gain: float, blend: float = 1.0) -> list[Piece]:
    """
    Return the acceleration pieces that change speed by ``gain`` within ``duration``.

    It rises and falls in straight lines of ``blend`` seconds (0: at once, as in the paper).
    """
    peak = gain / (duration - blend)
    return [line(blend, 0.0, peak), line(duration - 2 * blend, peak, peak),
            line(blend, peak, 0.0)]


def turn(duration: float, angle: float, blend: float) -> list[Piece]:
    """Return the turn-rate pieces that turn by ``angle``, with smooth flanks of ``blend`` s."""
    peak = angle / (duration - blend)
    return [smooth(blend, 0.0, peak), line(duration - 2 * blend, peak, peak),
            smooth(blend, peak, 0.0)]


def hold(duration: float) -> list[Piece]:
    """Return pieces of zeros."""
    return [line(duration, 0.0, 0.0)]
