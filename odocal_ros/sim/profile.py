# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Profiles of a drive: piecewise polynomials of time with exact derivatives; slope of the road.

Routes are chains of pieces of acceleration and turn rate; speed and yaw are their integrals.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike

from odocal_ros.data.arrays import Floats, Ints

# duration, s, and the factors of time**0 to time**3 since the beginning of the piece
Piece = tuple[float, tuple[float, float, float, float]]
KERB_LENGTH = 0.5    # m, judgement: path in which a wheel of a robot climbs a kerb


class Profile:
    """
    A piecewise polynomial, constant before its first and after its last break.

    breaks : (m + 1,) rising, s.   powers : (m, d) factors of (t - breaks[i]) ** 0, 1, ...
    """

    def __init__(self, breaks: ArrayLike, powers: ArrayLike) -> None:
        self.breaks: Floats = np.asarray(breaks, dtype=float)
        self.powers: Floats = np.asarray(powers, dtype=float)

    @property
    def end(self) -> float:
        """Return the last break, s."""
        return float(self.breaks[-1])

    def __call__(self, t: ArrayLike) -> Floats:
        """Return the values at (...) times; at a jump, the value after it."""
        return self._evaluate(self._piece(t), t)

    def mean(self, t: ArrayLike) -> Floats:
        """Return the values, at a jump the mean of both sides (a trapezoid rule is then exact)."""
        t = np.asarray(t, dtype=float)
        tolerance = 1e-9    # s, a sample so close to a break is on it
        before, after = self._piece(t - tolerance), self._piece(t + tolerance)
        return (self._evaluate(before, t) + self._evaluate(after, t)) / 2

    def derivative(self) -> 'Profile':
        """Return the derivative by time."""
        order = np.arange(1, self.powers.shape[1])
        return Profile(self.breaks, self.powers[:, 1:] * order if len(order)
                       else np.zeros((len(self.powers), 1)))

    def integral(self) -> 'Profile':
        """Return the integral from the first break."""
        order = np.arange(1, self.powers.shape[1] + 1)
        powers = np.concatenate([np.zeros((len(self.powers), 1)), self.powers / order], axis=1)
        powers[1:, 0] = np.cumsum(polyval(np.diff(self.breaks), powers.T, False))[:-1]
        return Profile(self.breaks, powers)

    def _piece(self, t: ArrayLike) -> Ints:
        """Return the index of the piece that contains each time."""
        piece = np.searchsorted(self.breaks, t, side='right') - 1
        return np.clip(piece, 0, len(self.powers) - 1)

    def _evaluate(self, piece: Ints, t: ArrayLike) -> Floats:
        t = np.clip(t, self.breaks[0], self.breaks[-1])
        return np.asarray(polyval(t - self.breaks[piece], self.powers.T[:, piece], False))


def line(duration: float, start: float, end: float) -> Piece:
    """Return a piece that is linear from one value to another."""
    return duration, (start, (end - start) / duration if duration else 0.0, 0.0, 0.0)


def smooth(duration: float, start: float, end: float) -> Piece:
    """Return a piece from one value to another as 3 x^2 - 2 x^3, whose ends have slope 0."""
    rise = end - start
    return duration, (start, 0.0, 3 * rise / duration**2, -2 * rise / duration**3)


def hermite(breaks: Floats, values: Floats, slopes: Floats) -> Profile:
    """Return the cubics that have these values and slopes at the breaks."""
    h, rise = np.diff(breaks), np.diff(values)
    first, last = slopes[:-1] * h, slopes[1:] * h
    square, cube = (3 * rise - 2 * first - last) / h**2, (first + last - 2 * rise) / h**3
    return Profile(breaks, np.stack([values[:-1], slopes[:-1], square, cube], -1))


def chain(pieces: Iterable[Piece]) -> Profile:
    """Return the pieces one after another, from time 0; pieces without duration are dropped."""
    durations, powers = zip(*(piece for piece in pieces if piece[0] > 0), strict=True)
    # breaks rounded to ns, so that a break meant for a sample's stamp is on it
    return Profile(np.round(np.cumsum([0.0, *durations]), 9), powers)


def ramp(duration: float, gain: float, blend: float = 1.0) -> list[Piece]:
    """Return accelerations that change the speed by ``gain``, m/s; blend: s of rise and fall."""
    blend = min(blend, duration / 2)
    peak = gain / (duration - blend)
    return [line(blend, 0.0, peak), line(duration - 2 * blend, peak, peak), line(blend, peak, 0.0)]


def turn(duration: float, angle: float, blend: float) -> list[Piece]:
    """Return turn rates that turn by ``angle``, rad; blend: s of rise and fall."""
    peak = angle / (duration - blend)
    return [smooth(blend, 0.0, peak), line(duration - 2 * blend, peak, peak),
            smooth(blend, peak, 0.0)]


def hold(duration: float) -> list[Piece]:
    """Return pieces of zeros."""
    return [line(duration, 0.0, 0.0)]


@dataclass(frozen=True)
class Hills:
    """Slope of the road by distance s: slope * sin(2 pi s / length), rad, and kerbs."""

    slope: float = 0.0       # rad, positive uphill
    length: float = 1000.0   # m
    kerbs: tuple[tuple[float, float], ...] = ()    # (distance of its beginning, height) m each

    def __call__(self, travel: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the slope at a travel, m, and its first and second derivative by distance."""
        k = 2 * np.pi / self.length
        wave, cosine_wave = self.slope * np.sin(k * travel), self.slope * np.cos(k * travel)
        _, sine, sine_by_path, sine_by_path2 = self._over_kerbs(travel)
        cosine = np.sqrt(1 - sine**2)
        return (wave + np.arcsin(sine), k * cosine_wave + sine_by_path / cosine,
                -k**2 * wave + sine_by_path2 / cosine + sine_by_path**2 * sine / cosine**3)

    def chord(self, travel: Floats, wheelbase: float) -> tuple[Floats, Floats]:
        """Return the slope of the line from ``travel`` to a wheelbase ahead and its derivative."""
        k, ahead = 2 * np.pi / self.length, travel + wheelbase
        mean = self.slope * (np.cos(k * travel) - np.cos(k * ahead)) / (k * wheelbase)
        mean_by_path = self.slope * (np.sin(k * ahead) - np.sin(k * travel)) / wheelbase
        rear, front = self._over_kerbs(travel), self._over_kerbs(ahead)
        sine, sine_by_path = ((front[i] - rear[i]) / wheelbase for i in (0, 1))
        return mean + np.arcsin(sine), mean_by_path + sine_by_path / np.sqrt(1 - sine**2)

    def _over_kerbs(self, travel: Floats) -> Floats:
        """Return the height by kerbs, m, and its three derivatives by distance: (4, n)."""
        out = np.zeros((4, *np.shape(travel)))
        for begin, height in self.kerbs:
            # a smooth step of 7th order: slope, curvature and its change are 0 at both ends
            x = np.clip((travel - begin) / KERB_LENGTH, 0.0, 1.0)
            y = x * (1 - x)
            out += height * np.stack([
                x**4 * (35 + x * (x * (70 - 20 * x) - 84)), 140 * y**3 / KERB_LENGTH,
                420 * y**2 * (1 - 2 * x) / KERB_LENGTH**2,
                840 * y * (1 - 5 * y) / KERB_LENGTH**3])
        return out
