# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The running estimate of a leg of the planar estimator: its fit of the data so far."""

from collections.abc import Callable
import math

from odocal_ros.calib.choice import ABOUT, choose, PLANAR
from odocal_ros.calib.result import LegResult
from odocal_ros.data.leg import Leg
from odocal_ros.errors import BadData
from odocal_ros.forecast.forecast import Abandoned, FARTHEST_M, Forecast, Prospect
from odocal_ros.forecast.smoother_forecast import digits, relative, wheels_of
from odocal_ros.pipeline.calibrate import NOT_YET
from odocal_ros.pipeline.planar_run import planar_leg
from odocal_ros.pipeline.prepared import Stage
from odocal_ros.reasons import Code, Verdict
from odocal_ros.screening.leg_kind import settings_by_frame
from odocal_ros.settings.config import Config

OPEN_YET = NOT_YET | {Code.ODOMETER_STILL}     # codes that disappear with more driving
DRIVE_ON = 'drive straights, and turn on the spot in both directions'


def planar_forecast(leg: Leg, config: Config, wanted: Callable[[], bool]) -> Forecast:
    """
    Return the forecast of a leg of the planar estimator that ends here.

    Arguments and errors as for ``forecast_of``. The sigma of the scale falls with the root of the
    distance.
    """
    def passed(_: Stage) -> None:
        if not wanted():
            raise Abandoned
    result = planar_leg(leg, settings_by_frame(leg.fix, config), (), passed)
    if not wanted():
        raise Abandoned
    method = result.methods[PLANAR]
    if result.track_n is None:
        raise BadData(method.reasons[0].text)
    faults = tuple(r for r in (*result.reasons, *method.reasons)
                   if r.code.gravity is Verdict.REJECTED and r.code not in {*ABOUT, *OPEN_YET})
    estimates, _ = choose(result.methods, config.method)
    return Forecast(
        _scale(result, config.verdict.max_scale_sigma),
        Prospect(None, config.verdict.max_yaw_sigma, None, why='not estimated on this robot'),
        wheels=wheels_of(method), methods={PLANAR: method}, estimates=estimates,
        until_ns=leg.stop_ns, faults=faults)


def _scale(result: LegResult, asked: float) -> Prospect:
    """Return the prospect of the scale."""
    scale = result.methods[PLANAR].estimates['scale_factor']
    sigma = relative(scale)
    if sigma is None or scale.value is None or scale.sigma is None:
        return Prospect(None, asked, None, lack=DRIVE_ON)
    metres = result.distance * max((sigma / asked)**2 - 1, 0.0) if asked else math.inf
    return Prospect(
        sigma, asked, metres if metres <= FARTHEST_M else None,
        why=f'even {FARTHEST_M / 1000:.0f} km more do not reach the limit',
        now=digits(scale.value, scale.sigma))
