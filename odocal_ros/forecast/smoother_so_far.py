# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Running estimate of the smoother on a thinned leg, each update from the previous one."""

from collections.abc import Callable, Iterable
import time

from odocal_ros.calib.smoother import (
    GrowingFit,
    Running,
    smoother_leg,
    SmootherLeg,
    too_little,
    too_little_of,
)
from odocal_ros.data.leg import Leg
from odocal_ros.errors import BadData
from odocal_ros.forecast.forecast import Abandoned
from odocal_ros.forecast.leg_so_far import screened_in_cells
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.reasons import Reason
from odocal_ros.screening.facing import axes_reasons, facing, UNUSABLE
from odocal_ros.screening.inputs import place
from odocal_ros.settings.config import Config


class SmootherSoFar:
    """The smoother on one leg while it grows."""

    def __init__(self) -> None:
        self._growing = GrowingFit(time.thread_time)
        self._origin: Origin | None = None

    @property
    def once_s(self) -> float:
        """Return the seconds of CPU in the last look for what is done ever less often."""
        return self._growing.once_s

    def look(self, leg: Leg, config: Config, wanted: Callable[[], bool] = lambda: True) -> Running:
        """
        Return the running estimate.

        leg : the data so far: the earlier data, and more.   config : as frozen into the leg.
        wanted : asked between passes; Abandoned is raised when it says no.

        Raises OdocalError: too little of the drive, or no fit; the next update is a cold start.
        """
        def trace(*_: object) -> None:
            if not wanted():
                raise Abandoned

        try:
            view = self._view(leg, config)
        except BaseException:
            self._growing.forget()
            raise
        return self._growing.fit(view, config, trace)

    def _view(self, leg: Leg, config: Config) -> SmootherLeg:
        seen = screened_in_cells(leg, config)
        inputs = seen.inputs
        if len(inputs.t_imu) < 4 or len(inputs.travel.t) < 2:
            raise BadData('the smoother needs IMU and odometer samples')
        few = too_little(len(inputs.t_fix), float(inputs.t_imu[-1] - inputs.t_imu[0]))
        if few:
            raise BadData(few.text)
        _refuse_unusable(seen.reasons)
        placed = place(inputs, config)
        if not placed.rough:
            raise BadData('the scale is not known yet')
        _refuse_unusable(axes_reasons(
            facing(inputs, placed.rough), config.imu.nominal_yaw))
        if vars(placed.origin) != (self._origin and vars(self._origin)):
            self._origin = placed.origin
            self._growing.forget()
        spans = inputs.standstills(placed.rough, config)
        # travel beyond the last odometer row would be a slip
        t_stop = min(inputs.t_stop, float(inputs.travel.t[-1]))
        view = smoother_leg(inputs, config, placed.origin, placed.fixes_n, spans,
                            placed.rough, t_stop)
        few = too_little_of(view)
        if few:
            raise BadData(few.text)
        return view


def _refuse_unusable(found: Iterable[Reason]) -> None:
    why = [r.text for r in found if r.code in UNUSABLE]
    if why:
        raise BadData(why[0])
