# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The road under a vehicle: its slope by distance, of hills and kerbs."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.data.arrays import Floats

KERB_LENGTH = 0.5    # m, judgement: in which a wheel of a robot climbs a kerb


@dataclass(frozen=True)
class Hills:
    """Slope of the road by distance: slope * sin(2 pi s / length), rad, positive uphill; kerbs."""

    slope: float = 0.0
    length: float = 1000.0   # m
    kerbs: tuple[tuple[float, float], ...] = ()    # (distance of its beginning, height) m each

    def __call__(self, travel: Floats) -> tuple[Floats, Floats, Floats]:
        """Return slope and its first and second derivative by distance."""
        k = 2 * np.pi / self.length
        wave, along = self.slope * np.sin(k * travel), self.slope * np.cos(k * travel)
        _, sine, by, by2 = self._over_kerbs(travel)
        cosine = np.sqrt(1 - sine**2)
        return (wave + np.arcsin(sine), k * along + by / cosine,
                -k**2 * wave + by2 / cosine + by**2 * sine / cosine**3)

    def chord(self, travel: Floats, wheelbase: float) -> tuple[Floats, Floats]:
        """Return the slope of a line from there to a wheelbase ahead, and its derivative."""
        k, ahead = 2 * np.pi / self.length, travel + wheelbase
        mean = self.slope * (np.cos(k * travel) - np.cos(k * ahead)) / (k * wheelbase)
        mean_by = self.slope * (np.sin(k * ahead) - np.sin(k * travel)) / wheelbase
        here, there = self._over_kerbs(travel), self._over_kerbs(ahead)
        sine, by = ((there[i] - here[i]) / wheelbase for i in (0, 1))
        return mean + np.arcsin(sine), mean_by + by / np.sqrt(1 - sine**2)

    def _over_kerbs(self, travel: Floats) -> Floats:
        """Return the height by kerbs, m, and its three derivatives by distance: (4, n)."""
        out = np.zeros((4, *np.shape(travel)))
        for begin, height in self.kerbs:
            x = np.clip((travel - begin) / KERB_LENGTH, 0.0, 1.0)
            y = x * (1 - x)
            out += height * np.stack([
                x**4 * (35 + x * (x * (70 - 20 * x) - 84)), 140 * y**3 / KERB_LENGTH,
                420 * y**2 * (1 - 2 * x) / KERB_LENGTH**2,
                840 * y * (1 - 5 * y) / KERB_LENGTH**3])
        return out
