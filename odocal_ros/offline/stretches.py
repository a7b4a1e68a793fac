# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Path length, stops and straight sections of a recording."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.drive import white_noise
from odocal_ros.screening.inputs import Inputs, place
from odocal_ros.settings.config import Config


@dataclass(frozen=True, eq=False)
class Drive:
    """
    A recording seen as a drive.

    scale : m per unit of travel, rough; None if the fixes do not determine it.
    stops : (k, 2) s, begin and end of standstills.
    sigma : m, of a fix, horizontally, as sent.    white : m, what differs from fix to fix.
    t_fix, fixes_n : (n,), (n, 3) s and m, usable fixes, east-north-up about the first.
    slowest, fastest : m/s.
    """

    scale: float | None
    sigma: float
    white: float
    stops: NDArray[np.float64]
    t_fix: NDArray[np.float64]
    fixes_n: NDArray[np.float64]
    slowest: float
    fastest: float


def survey_drive(inputs: Inputs, config: Config) -> Drive:
    """Return the drive that screened inputs show."""
    placed = place(inputs, config)
    fixes_n, sigma, scale = placed.fixes_n, placed.fix_sigma, placed.rough or None
    stops, slowest, fastest = np.empty((0, 2)), 0.0, 0.0
    if len(inputs.travel.t) > 1 and len(inputs.t_imu) > 3:
        stops = inputs.standstills(scale or 1.0, config)
        at_speed = 1.0    # s, over which a speed is taken
        t = np.arange(inputs.travel.t[0], inputs.travel.t[-1] - at_speed, at_speed / 2)
        if scale and len(t):
            speed = np.abs(inputs.travel.at(t + at_speed) - inputs.travel.at(t)) * scale / at_speed
            slowest, fastest = float(speed.min()), float(speed.max())
    return Drive(scale, sigma, white_noise(fixes_n), stops, inputs.t_fix, fixes_n, slowest,
                 fastest)


def straight_stretches(inputs: Inputs, drive: Drive, shortest: float) -> list[tuple[float, float]]:
    """Return (start, stop) of stretches at least ``shortest`` m long, the longest first; s."""
    if drive.scale is None or len(drive.t_fix) < 3:
        return []
    points = 600    # fixes looked at for straight stretches, evenly taken
    pick = np.unique(np.linspace(0, len(drive.t_fix) - 1, points).astype(int))
    t, p = drive.t_fix[pick], drive.fixes_n[pick, :2]
    travel = np.abs(inputs.travel.at(t[None]) - inputs.travel.at(t[:, None]))
    chord = np.hypot(*(p[None] - p[:, None]).transpose(2, 0, 1))
    far = chord >= shortest
    # the rough scale cuts corners; the straightest sections determine it best
    ratio = chord[far] / np.maximum(travel[far], 1e-12)
    best = float(np.percentile(ratio, 95)) if len(ratio) else 0.0
    path_length = travel * max(drive.scale, min(best, 1.2 * drive.scale))
    # chord over path length: a section at least this straight suits the two-point method
    straight = 0.97
    # fixes are off by sigma at both ends: what that hides is given, not demanded
    fit = np.triu((chord >= straight * path_length - drive.sigma) & (path_length >= shortest)
                  & (chord <= path_length / straight + 4 * drive.sigma))
    found: list[tuple[float, float]] = []
    while fit.any():
        i, j = np.unravel_index(np.argmax(np.where(fit, path_length, 0)), fit.shape)
        found.append((float(t[i]), float(t[j])))
        fit[:j + 1, i:] = False            # whatever overlaps it
    return found
