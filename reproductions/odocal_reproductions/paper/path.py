# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A leg as the error model of the paper sees it: recorded, or planned."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Floats
from odocal_ros.nav.geodesy import radii
from odocal_ros.nav.rotations import matrix_from_rpy


@dataclass(frozen=True, eq=False)
class Path:
    """
    A leg as the error model sees it, recorded or planned.

    t : (m,) s, rising.    latitude, longitude : (m,) rad.    height : (m,) m.
    velocity_n : (m - 1, 3) mean velocity over ground of each interval, local ENU, m/s.
    C_nb : (m, 3, 3) attitude against the local level at each epoch.
    """

    t: NDArray[np.float64]
    latitude: NDArray[np.float64]
    longitude: NDArray[np.float64]
    height: NDArray[np.float64]
    velocity_n: NDArray[np.float64]
    C_nb: NDArray[np.float64]

    @property
    def travel(self) -> NDArray[np.float64]:
        """Return the metres travelled by each epoch, (m,)."""
        step = np.linalg.norm(self.velocity_n, axis=-1) * np.diff(self.t)
        return np.concatenate([[0.0], np.cumsum(step)])


def planned_path(t: Floats, speed: Floats, yaw: Floats | float, latitude: float,
                 longitude: float = 0.0, height: float = 0.0) -> Path:
    """
    Return the path of a level drive that is not driven yet.

    t, speed, yaw : (m,) epochs, s; speed, m/s, and ENU yaw of the vehicle, rad, there (straight in
    between).   latitude, longitude, height : start, rad, rad, m (WGS 84).

    Returns
    -------
    Path, b lying along the vehicle.

    """
    t, speed = np.asarray(t, dtype=float), np.asarray(speed, dtype=float)
    yaw = np.broadcast_to(np.asarray(yaw, dtype=float), t.shape)
    flat = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], -1) * speed[:, None]
    velocity = (flat[:-1] + flat[1:]) / 2
    step = velocity * np.diff(t)[:, None]

    def run(first: float, steps: Floats) -> Floats:
        return first + np.concatenate([[0.0], np.cumsum(steps)])

    along = np.full(len(t), float(latitude))
    for _ in range(4):      # the radii change by 1 % per rad: each round gains four digits
        middle = (along[1:] + along[:-1]) / 2
        meridian, normal = radii(middle)
        along = run(latitude, step[:, 1] / (meridian + height))
    east = step[:, 0] / ((normal + height) * np.cos(middle))
    C_nb = matrix_from_rpy(np.stack([0 * yaw, 0 * yaw, yaw], -1))
    return Path(t, along, run(longitude, east), np.full(len(t), float(height)), velocity, C_nb)
