# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The search of patent CN104359492A on one leg, beside the smoother: by positions alone."""

import numpy as np

from odocal_ros.calib.wheel_search.planar import planar_leg, PlanarLeg
from odocal_ros.calib.wheel_search.search import search, SearchResult
from odocal_ros.calib.wheel_search.space import ranges_of
from odocal_ros.pipeline.prepared import PreparedLeg


def planar_of(ready: PreparedLeg, pitch: float) -> PlanarLeg | None:
    """
    Return a leg as the patent sees it: two tracks in the plane, and fixes.

    ready : PreparedLeg.   pitch : rad, of the IMU on the vehicle.   None without two wheels, or
    without a fix at the start.
    """
    inputs = ready.inputs
    two = 2
    if len(inputs.travels) != two:
        return None
    left, right = inputs.travels
    begin, end = (pick([float(x.t[at]) for x in (ready.track, left, right)])
                  for pick, at in ((max, 0), (min, -1)))
    begin, end = max(0.0, begin), min(ready.t_fit, end)
    start = ready.mark(begin, ready.path(np.array([ready.rough, 0.0, 0.0])), 'start')
    if start is None or end <= begin:
        return None
    between = (inputs.t_fix >= begin) & (inputs.t_fix <= end)
    scale = ready.nominal or ready.rough
    return planar_leg(ready.reckon(left), ready.reckon(right), inputs.t_fix[between],
                      ready.fixes_n[between], inputs.covariance_n[between],
                      (start.t, start.position_n), (scale, scale), pitch, ready.lever_b)


def search_of(ready: PreparedLeg, pitch: float) -> SearchResult | None:
    """Return the result of the search, None with too few fixes; arguments as in planar_of."""
    leg = planar_of(ready, pitch)
    if leg is None:
        return None
    a, wheels = ready.alignment, ready.config.wheels
    course = None if a.heading_separable else a.heading_sigma     # holds the mounting angle too
    return search(leg, ranges_of(wheels, course), wheels.robust)
