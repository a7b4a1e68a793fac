# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Marks of a bag: as asked with --mark, else those that a node stored."""

from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.leg import LegRecorder
from odocal_ros.errors import BadUsage
from odocal_ros.library.legs import leg_statuses
from odocal_ros.pipeline.floor_marks import check_points, FloorMark, marks_at, WITHIN
from odocal_ros.settings.config import Config

if TYPE_CHECKING:
    from odocal_ros.bagio.read import Bag

STILL_SHARE = 0.05      # judgement: of the largest travel in a second: the robot moves


def marks_of(config: Config, bag: 'Bag') -> list[FloorMark]:
    """Return the marks of a bag in order of time, none without points."""
    reference = config.reference
    if reference.marks:
        check_points(config)
        return marks_at(config, [bag.start_ns + round(t * 1e9) for t in reference.marks])
    return _stored_marks(bag, len(reference.points) // 2) if reference.points else []


def _stored_marks(bag: 'Bag', points: int) -> list[FloorMark]:
    """Return the marks in the status of a node."""
    found = set[FloorMark]()
    for values in leg_statuses(bag):
        for word in filter(None, values.get('marks', '').split(',')):
            with suppress(ValueError):      # of another program
                found.add(FloorMark.of(word))
    for mark in found:
        if not 0 <= mark.point < points:
            raise BadUsage(f'the bag has a mark of point {mark.point + 1}, reference.points has '
                           f'{points}: use the points of the recording')
    return sorted(found)


def check_still(marks: Sequence[FloorMark], recorder: LegRecorder, start_ns: int) -> None:
    """
    Raise BadUsage for a mark at which the odometer counts, or that is outside the recording.

    start_ns : of the first message of the bag.
    """
    rows = recorder.rows('odometer')
    t, value = (rows.stamp_ns - start_ns) * 1e-9, np.asarray(rows.value, dtype=float)
    if recorder.form.quantity != 'cumulative':
        value = np.cumsum(value)

    def moved(at: Floats) -> Floats:
        out: Floats = np.abs(np.interp(at + WITHIN, t, value) - np.interp(at - WITHIN, t, value))
        return out
    times = np.array([(mark.stamp_ns - start_ns) * 1e-9 for mark in marks])
    for time in times.tolist():
        if not (len(t) and t[0] <= time - WITHIN and time + WITHIN <= t[-1]):
            raise BadUsage(f'--mark {time:g}: the odometer has no data there; required: seconds '
                           'from the first message of the bag')
    top = float(moved(np.arange(t[0] + WITHIN, t[-1], WITHIN)).max())
    for time, far in zip(times.tolist(), moved(times).tolist(), strict=True):
        if far > STILL_SHARE * top:
            raise BadUsage(f'--mark {time:g}: the wheels turn within {WITHIN:g} s of it; '
                           'required: a time at which the robot stands on a point')
