# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Messages with a position in a local metric frame: where it lies in each type."""

from collections.abc import Callable, Sequence

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.samples import FixSamples, LOCAL, of_columns
from odocal_ros.messages.fields import array, Column, xyz
from odocal_ros.nav.local_frame import geodetic_of

# format: block of the position in a 6 x 6 covariance, row by row
_COVARIANCE = array('pose.covariance', 0, 1, 2, 6, 7, 8, 12, 13, 14)
# columns of each type: position, and its covariance where the type has one
LOCAL_TYPES: dict[str, Sequence[Column]] = {
    'geometry_msgs/msg/PoseStamped': (xyz('pose.position'),),
    'geometry_msgs/msg/PoseWithCovarianceStamped': (xyz('pose.pose.position'), _COVARIANCE),
    'geometry_msgs/msg/PointStamped': (xyz('point'),),
    'geometry_msgs/msg/TransformStamped': (xyz('transform.translation'),),
    'nav_msgs/msg/Odometry': (xyz('pose.pose.position'), _COVARIANCE),
}


def local_fixes(latitude_deg: float) -> Callable[..., FixSamples]:
    """Return the function that makes fixes of stamps, arrivals, positions and covariances."""
    def build(stamps: Ints, received: Ints, position: Floats, *covariance: Floats) -> FixSamples:
        n = len(stamps)
        known = np.full(n, 3 if covariance else 0)      # zeros and negative ones are unknown too
        given = covariance[0].reshape(n, 3, 3) if covariance else np.zeros((n, 3, 3))
        return of_columns(FixSamples, stamps, received, *geodetic_of(position, latitude_deg),
                          given, known, np.full(n, LOCAL))
    return build
