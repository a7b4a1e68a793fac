# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs of simulated drives in cells of time, as the node keeps them."""

from odocal_ros.data.samples import take
from odocal_ros.forecast.thinned_leg import ThinnedLeg

SLOTS = ('imu', 'odometer', 'odometer_right', 'fix')
SECOND = 10**9


def thinned(leg, stop_s=float('inf'), begin_s=float('-inf'), into=None):
    """Return the cells of a leg between times after its start mark, s, added to ``into``."""
    cells = into or ThinnedLeg(leg.form)
    for slot in SLOTS:
        rows = leg.rows(slot)
        t = (rows.stamp_ns - leg.start_ns) / SECOND
        cells.feed(slot, take(rows, (t > begin_s) & (t <= stop_s)))
    return cells
