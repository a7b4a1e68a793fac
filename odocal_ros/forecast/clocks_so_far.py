# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whose clock differs from the IMU's, from the blocks as they come, and how it is said."""

from collections import deque

import numpy as np

from odocal_ros.data.arrays import Ints
from odocal_ros.data.samples import Samples
from odocal_ros.screening.clocks import offsets, remedy
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import CLOCK_APART, DAY_NS

IMU_BLOCKS = 40       # judgement: newest, that rows of others are laid beside: some seconds
CLOCK_ROWS = 10       # judgement: newest of a topic that determine its clock


class Clocks:
    """
    Compares the stamps of rows that arrived together: whose clock differs from the IMU's.

    simulated : arrivals are times of the node's clock at reception, not at sending.
    """

    def __init__(self, simulated: bool = False) -> None:
        self._simulated = simulated
        self._imu: deque[tuple[Ints, Ints]] = deque(maxlen=IMU_BLOCKS)
        self._waiting: dict[str, tuple[int, int]] = {}      # newest row of others, till the IMU's
        self._ahead_s: dict[str, deque[float]] = {}

    def feed(self, slot: str, block: Samples) -> None:
        """Take a block."""
        if slot != 'imu':
            self._waiting[slot] = int(block.received_ns[-1]), int(block.stamp_ns[-1])
            return
        self._imu.append((block.received_ns, block.stamp_ns))
        if not self._waiting:
            return
        # differences first: float64 seconds since 1970 have a grain of 238 ns, ns fit
        received, stamps = (np.concatenate(column) for column in zip(*self._imu, strict=True))
        first_received, first_stamp = int(received[0]), int(stamps[0])
        received, stamps = received - first_received, stamps - first_stamp
        # messages that queued for a node in simulated time arrive late, the IMU's more so than
        # others': which of them belong together is not known then
        queued = self._simulated and np.ptp(received - stamps) > CLOCK_APART * 1e9
        for name, (row_ns, stamp_ns) in list(self._waiting.items()):
            row = row_ns - first_received
            if row > received.max():
                continue
            del self._waiting[name]
            if row >= received.min() and not queued:
                ahead = (stamp_ns - first_stamp - np.interp(row, received, stamps)) * 1e-9
                self._ahead_s.setdefault(name, deque(maxlen=CLOCK_ROWS)).append(float(ahead))

    def differing(self, config: Config) -> list[tuple[str, float]]:
        """Return (slot, s ahead of the IMU) of topics whose clock differs, offsets applied."""
        result = []
        for slot, ahead in self._ahead_s.items():
            offset = offsets(config)[slot]
            # latency makes a row look older: only a clock whose freshest row is behind, is behind;
            # that of an IMU's row makes others look newer: ahead are those of whom most are
            value = max(min(max(ahead) + offset, 0.0), float(np.median(ahead)) + offset)
            if abs(value) > CLOCK_APART:
                result.append((slot, value))
        return result


def clocks_differ(clocks: list[tuple[str, float]]) -> str:
    """Return the sentence about clocks that differ from the IMU's."""
    seen = ', '.join(f'{slot} stamps are {_apart(abs(s))} {"ahead of" if s > 0 else "behind"} '
                     'the IMU stamps' for slot, s in clocks)
    return f'CLOCKS_DIFFER: {seen}. {remedy(max((s for _, s in clocks), key=abs))}'


def _apart(seconds: float) -> str:
    days = seconds / (DAY_NS * 1e-9)
    return f'{seconds:.3g} s' if days < 2 else f'{days:.0f} days'
