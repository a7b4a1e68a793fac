# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Points on the floor where the robot stood: positions of a leg without GNSS or SLAM."""

from dataclasses import replace
import math

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import FixSamples
from odocal_ros.errors import BadUsage
from odocal_ros.nav.local_frame import local_fixes
from odocal_ros.settings.config import Config

# s before and after a mark, and positions in between. Judgement: a fit needs ten positions
WITHIN, ROWS = 0.5, 5
# s at the mean motion of the wheels, in which a time-correlated error is forgotten: the errors of
# two marks are independent, those of the positions of one mark are equal. Judgement
FORGOTTEN = 5.0
STILL_SHARE = 0.05      # judgement: of the largest travel in a second: the robot moves


def with_marks(config: Config) -> Config:
    """Return the settings of a recording with marks, unchanged without."""
    if not config.reference.marks:
        return config
    if not config.reference.points or len(config.reference.points) % 2:
        raise BadUsage(f'reference.points has {len(config.reference.points)} values; required '
                       'with marks: x and y of each point in the order of the marks, m')
    gnss, sigma = config.gnss, config.reference.points_sigma
    return replace(config, gnss=replace(
        gnss, lever_arm_sigma=min(gnss.lever_arm_sigma, sigma),
        correlation_time=FORGOTTEN if math.isnan(gnss.correlation_time)
        else gnss.correlation_time))


def mark_positions(config: Config, recorder: LegRecorder, start_ns: int) -> FixSamples:
    """
    Return the positions of the marks as a reader gives those of SLAM.

    recorder : with the odometer.   start_ns : of the first message of the bag.

    Raises
    ------
    BadUsage
        The robot moves at a mark, or a mark is outside the recording.

    """
    reference = config.reference
    order = np.argsort(reference.marks)
    marks = np.array(reference.marks)[order]
    _check_still(marks, recorder, start_ns)
    points = np.reshape(reference.points, (-1, 2))[order % (len(reference.points) // 2)]
    position = np.repeat(np.column_stack([points, np.zeros(len(points))]), ROWS, axis=0)
    t = (marks[:, None] + np.linspace(-WITHIN, WITHIN, ROWS)).ravel()
    stamps = start_ns + np.round(t * 1e9).astype(np.int64)
    covariance = np.tile((reference.points_sigma**2 * np.eye(3)).ravel(), (len(t), 1))
    return local_fixes(reference.latitude_deg)(stamps, stamps, position, covariance)


def _check_still(marks: Floats, recorder: LegRecorder, start_ns: int) -> None:
    """Raise BadUsage for a mark at which the odometer counts."""
    rows = recorder.rows('odometer')
    t, value = (rows.stamp_ns - start_ns) * 1e-9, np.asarray(rows.value, dtype=float)
    if recorder.form.quantity != 'cumulative':
        value = np.cumsum(value)

    def moved(at: Floats) -> Floats:
        out: Floats = np.abs(np.interp(at + WITHIN, t, value) - np.interp(at - WITHIN, t, value))
        return out
    for mark in marks.tolist():
        if not (len(t) and t[0] <= mark - WITHIN and mark + WITHIN <= t[-1]):
            raise BadUsage(f'--mark {mark:g}: the odometer has no data there; required: seconds '
                           'from the first message of the bag')
    top = float(moved(np.arange(t[0] + WITHIN, t[-1], WITHIN)).max())
    for mark, far in zip(marks.tolist(), moved(marks).tolist(), strict=True):
        if far > STILL_SHARE * top:
            raise BadUsage(f'--mark {mark:g}: the wheels turn within {WITHIN:g} s of it; '
                           'required: a time at which the robot stands on a point')
