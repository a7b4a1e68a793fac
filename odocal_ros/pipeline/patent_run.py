# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The search of patent CN104359492A on one leg, beside method wheels: by positions alone."""

from odocal_ros.calib.wheels.leg import WheelLeg
from odocal_ros.patent.planar import planar_leg, PlanarLeg
from odocal_ros.patent.ranges import ranges_of
from odocal_ros.patent.search import search, SearchResult
from odocal_ros.pipeline.prepared import PreparedLeg


def planar_of(ready: PreparedLeg, leg: WheelLeg, pitch: float) -> PlanarLeg:
    """
    Return a leg as the patent sees it: two tracks in the plane, and fixes.

    ready : PreparedLeg.   leg : WheelLeg of it.   pitch : rad, of the Imu on the vehicle.
    """
    start = ready.nominal or ready.rough
    return planar_leg(leg.left, leg.right, leg.t_fix, leg.fixes_n, leg.covariance_n,
                      (leg.start.t, leg.start.position_n), (start, start), pitch, leg.lever_b)


def search_of(ready: PreparedLeg, leg: WheelLeg, pitch: float) -> SearchResult | None:
    """Return what the search finds, None with too few fixes; arguments as of planar_of."""
    a, wheels = ready.alignment, ready.config.wheels
    course = None if a.heading_separable else a.heading_sigma     # holds the mounting angle too
    return search(planar_of(ready, leg, pitch), ranges_of(wheels, course), wheels.robust)
