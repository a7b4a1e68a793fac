# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The path of a recorded or planned leg, as input of the error model of the paper."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats, running_sum
from odocal_ros.nav.geodesy import radii
from odocal_ros.nav.rotations import matrix_from_rpy


@dataclass(frozen=True, eq=False)
class Path:
    """The path of a leg."""

    t: NDArray[np.float64]             # (m,) s, rising
    latitude: NDArray[np.float64]      # (m,) rad
    longitude: NDArray[np.float64]     # (m,) rad
    height: NDArray[np.float64]        # (m,) m
    velocity_n: NDArray[np.float64]    # (m - 1, 3) m/s, mean of each interval, local ENU
    C_nb: NDArray[np.float64]          # (m, 3, 3) attitude relative to the local level

    @property
    def travel(self) -> NDArray[np.float64]:
        """Return the path length up to each epoch, (m,) m."""
        return running_sum(np.linalg.norm(self.velocity_n, axis=-1) * np.diff(self.t))


def planned_path(t: Floats, speed: Floats, yaw: Floats | float, latitude: float,
                 longitude: float = 0.0, height: float = 0.0) -> Path:
    """
    Return the path of a planned level drive, with b along the vehicle.

    t, speed, yaw : (m,) s, m/s, and ENU yaw of the vehicle, rad, linear between epochs.
    latitude, longitude, height : of the start, rad, rad, m (WGS 84).
    """
    t, speed = np.asarray(t, dtype=float), np.asarray(speed, dtype=float)
    yaw = np.broadcast_to(np.asarray(yaw, dtype=float), t.shape)
    velocity_n = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], -1) * speed[:, None]
    mean_n = (velocity_n[:-1] + velocity_n[1:]) / 2
    step = mean_n * np.diff(t)[:, None]
    latitudes = np.full(len(t), float(latitude))
    for _ in range(4):      # the radii change by 1 % per rad: each round gains four digits
        middle = (latitudes[1:] + latitudes[:-1]) / 2
        meridian, normal = radii(middle)
        latitudes = latitude + running_sum(step[:, 1] / (meridian + height))
    longitudes = longitude + running_sum(step[:, 0] / ((normal + height) * np.cos(middle)))
    C_nb = matrix_from_rpy(np.stack([0 * yaw, 0 * yaw, yaw], -1))
    return Path(t, latitudes, longitudes, np.full(len(t), float(height)), mean_n, C_nb)
