# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
The GNSS / IMU / odometer smoother: a batch maximum likelihood over all samples of a leg.

``smooth`` takes a leg that is over, ``GrowingFit`` one that grows; ``smoother_leg`` makes either
of screened samples, where ``too_little_of`` says no. ``bound`` is the covariance without a fit.
"""

from odocal_ros.calib.smoother.growing import GrowingFit, SoFar
from odocal_ros.calib.smoother.leg import smoother_leg, SmootherLeg
from odocal_ros.calib.smoother.smoother import (
    bound,
    keyframe_times,
    smooth,
    too_little,
    too_little_of,
)

__all__ = ['GrowingFit', 'SmootherLeg', 'SoFar', 'bound', 'keyframe_times', 'smooth',
           'smoother_leg', 'too_little', 'too_little_of']
