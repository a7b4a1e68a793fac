# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The base of the sensors besides IMU, odometer and fixes: rows with a sigma for each component.

To the estimator such a sensor is one subclass, listed in ``equations.FACTORS``.
"""

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.factors.factor import LinearisationPoint
from odocal_ros.estimator.factors.point_rows import PointRows
from odocal_ros.estimator.leg import Outside
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.state import BARE, CONSTANTS
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import Config


@dataclass(frozen=True, eq=False)
class Rows:
    """Rows of one kind at one state: (m, d), (m, d, BARE), (m, d, M), (m, d) 1 / sigma."""

    raw: np.ndarray
    J: np.ndarray
    c: np.ndarray
    root: np.ndarray


class OutsideRows(PointRows):
    """Rows of one of ``problem.outside``, its own constants and their prior sigmas."""

    constants: ClassVar[slice]      # of state.CONSTANTS

    def __init__(self, problem: Problem, point: LinearisationPoint) -> None:
        self._rows = self.rows(problem, point)
        super().__init__(problem, point.points[self.name])
        self.raw = self._rows.raw

    @classmethod
    def prepared(cls, inputs: Inputs, config: Config, origin: Origin) -> Outside | None:
        """Return the rows of screened inputs in frame n; None without any, or unused."""
        raise NotImplementedError

    @staticmethod
    def prior_sigmas(sent: Any, config: Config) -> Floats | float:
        """Return the prior sigmas of its constants."""
        raise NotImplementedError

    @classmethod
    def details(cls, sent: Any, constants: Floats, sigma: Floats) -> dict[str, Any]:
        """Return details of a result: its constants by name, and their sigmas."""
        return {CONSTANTS[i]: {'value': float(constants[i]), 'sigma': float(sigma[i])}
                for i in range(cls.constants.start, cls.constants.stop)}

    def rows(self, problem: Problem, point: LinearisationPoint) -> Rows:
        """Return the rows at a state."""
        raise NotImplementedError

    @classmethod
    def there(cls, problem: Problem) -> bool:
        return cls.name in problem.outside

    @classmethod
    def times(cls, problem: Problem, constants: Floats) -> Floats:
        return problem.outside[cls.name].t

    @classmethod
    def first_levels(cls, problem: Problem) -> tuple[dict[str, float], dict[str, float]]:
        return dict.fromkeys(cls.levels_of, 1.0), cls.least(problem.outside[cls.name])

    @staticmethod
    def least(sent: Any) -> dict[str, float]:
        """Return the least levels."""
        raise NotImplementedError

    def jacobians(self, n: int) -> tuple[Floats, Floats]:
        J = self._rows.J
        return np.pad(J, ((0, 0), (0, 0), (0, n - BARE))), self._rows.c

    def stated(self, rows: Floats, some: slice = slice(None)) -> Floats:
        out: Floats = rows * self._rows.root[some, :, None]
        return out
