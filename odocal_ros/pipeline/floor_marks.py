# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Points on the floor where the robot stood: positions of a leg without GNSS or SLAM."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from odocal_ros.data.samples import FixSamples
from odocal_ros.errors import BadUsage
from odocal_ros.nav.geodesy import local_fixes
from odocal_ros.settings.config import Config

# s before and after a mark, and positions in between. Judgement: a fit needs ten positions
HALF_MARK, MARK_POSITIONS = 0.5, 5
# s, correlation time of position errors, at the mean motion of the wheels: the errors of two marks
# are independent, those of the positions of one mark are equal. Judgement
MARK_ERROR_TIME = 5.0


@dataclass(frozen=True, order=True)
class FloorMark:
    """The robot stands on a point of ``reference.points``."""

    stamp_ns: int
    point: int          # its number from 0
    received_ns: int    # arrival of a message sent at the end of the mark

    def __str__(self) -> str:
        """Return the mark as in the status of the node."""
        return f'{self.stamp_ns}:{self.point}:{self.received_ns}'

    @classmethod
    def of(cls, text: str) -> 'FloorMark':
        """Return the mark from the text of ``__str__``, or raise ValueError."""
        stamp_ns, point, received_ns = map(int, text.split(':'))
        return cls(stamp_ns, point, received_ns)


def marks_at(config: Config, stamps_ns: Sequence[int]) -> list[FloorMark]:
    """Return marks in order of time, from stamps in the order of the points."""
    late_ns = round(HALF_MARK * 1e9)
    return sorted(FloorMark(t, next_point(config, k), t + late_ns)
                  for k, t in enumerate(stamps_ns))


def check_points(config: Config) -> None:
    """Raise BadUsage if ``reference.points`` are not pairs."""
    if not config.reference.points or len(config.reference.points) % 2:
        raise BadUsage(f'reference.points has {len(config.reference.points)} values; required '
                       'with marks: x and y of each point in the order of the marks, m')


def next_point(config: Config, marks: int) -> int:
    """Return the number of the point of the next mark, after ``marks`` marks."""
    return marks % (len(config.reference.points) // 2)


def point_position(config: Config, point: int) -> tuple[float, float]:
    """Return x and y of a point, m."""
    x, y = config.reference.points[2 * point:2 * point + 2]
    return x, y


def settings_with_marks(config: Config) -> Config:
    """Return the settings for a recording with marks; a second call changes nothing."""
    check_points(config)
    gnss, sigma = config.gnss, config.reference.points_sigma
    return replace(config, gnss=replace(
        gnss, lever_arm_sigma=min(gnss.lever_arm_sigma, sigma),
        correlation_time=MARK_ERROR_TIME if math.isnan(gnss.correlation_time)
        else gnss.correlation_time))


def mark_positions(config: Config, marks: Sequence[FloorMark]) -> FixSamples:
    """Return the positions of marks as samples, as those of SLAM."""
    places = np.array([(*point_position(config, mark.point), 0.0) for mark in marks])
    stamps = np.array([mark.stamp_ns for mark in marks])[:, None] + np.round(
        1e9 * np.linspace(-HALF_MARK, HALF_MARK, MARK_POSITIONS)).astype(np.int64)
    covariance = np.tile((config.reference.points_sigma**2 * np.eye(3)).ravel(), (stamps.size, 1))
    received = np.repeat([mark.received_ns for mark in marks], MARK_POSITIONS)
    return local_fixes(config.reference.latitude_deg)(
        stamps.ravel(), received, np.repeat(places, MARK_POSITIONS, axis=0), covariance)
