# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
What is wrong with the leg that is recorded, by the functions that will judge it when it is over.

Its rows in cells show most faults, every few seconds in the worker (``pipeline.faults``). A gap of
the IMU is seen in the stamps themselves, at once, and is never forgotten.
"""

from functools import lru_cache
import math

import numpy as np

from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import ImuSamples
from odocal_ros.pipeline.calibrate import faults, Screened, screened
from odocal_ros.reasons import Reason
from odocal_ros.screening.screen import imu_gap
from odocal_ros.settings.config import Config, SETTINGS, with_settings

SILENT_TIME = 0.9    # s; judgement: what comes in no order may be as late; said within a second


class ImuGaps:
    """The IMU stamps of a leg, reduced to those that show its gaps."""

    def __init__(self, start_ns: int, limit_s: float) -> None:
        self._start_ns, self._limit_s = start_ns, limit_s
        self._newest_ns = start_ns
        self._edges_ns: list[int] = []      # on both sides of a gap

    def feed(self, block: ImuSamples) -> int:
        """Take IMU rows; return where they go on after a gap, 0 without one."""
        stamps = block.stamp_ns[block.stamp_ns > self._newest_ns]
        if not len(stamps):
            return 0
        known = np.append(self._newest_ns, np.sort(stamps))
        gaps = np.flatnonzero(np.diff(known) > self._limit_s * 1e9)
        for k in gaps:
            self._edges_ns += known[k:k + 2].tolist()
        self._newest_ns = int(known[-1])
        return self._edges_ns[-1] if len(gaps) else 0

    def reasons(self, silent_s: float = 0.0) -> tuple[Reason, ...]:
        """Return IMU_GAP if there was one; ``silent_s``: time without IMU messages."""
        # between two gaps there is none: rows that close fill it
        t = (np.array([*self._edges_ns, self._newest_ns]) - self._start_ns) * 1e-9
        t = np.concatenate([[0.0], t])
        sound = np.concatenate([np.arange(a, b, self._limit_s / 2)
                                for a, b in t.reshape(-1, 2)] or [t])
        end = t[-1] + (silent_s if silent_s > SILENT_TIME else 0.0)
        return imu_gap(np.union1d(sound, t), 0.0, float(end), self._limit_s)


@lru_cache(maxsize=1)      # faults and running estimate of one look ask of the same leg
def screened_in_cells(leg: Leg, config: Config) -> Screened:
    """Return the inputs of a leg whose IMU rows are means over cells of time."""
    return screened(leg, _with_cells(leg, config))


def faults_in_cells(leg: Leg, config: Config) -> tuple[Reason, ...]:
    """Return the faults of a leg whose IMU rows are means over cells of time."""
    return faults(leg, screened_in_cells(leg, config), _with_cells(leg, config))


def _with_cells(leg: Leg, config: Config) -> Config:
    """Return config with cells to be no gaps of the IMU."""
    cell_s = float(np.median(np.diff(leg.imu.stamp_ns))) * 1e-9 if len(leg.imu.stamp_ns) > 1 \
        else 0.0
    limit_s = min(config.leg.max_gap + 2 * cell_s, SETTINGS['leg.max_gap'].high or math.inf)
    return with_settings(config, {'leg.max_gap': limit_s})
