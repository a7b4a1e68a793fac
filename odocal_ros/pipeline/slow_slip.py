# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
A wheel that slips all along from some moment on, or loses air: what that does to a scale.

It leaves a scale between that of before and that of after; the fixes do not determine which
of them is the vehicle's.
"""

from odocal_ros.calib.result import MethodResult, wheel_factors
from odocal_ros.pipeline.prepared import PreparedLeg
from odocal_ros.pipeline.scale_error import SCALES, with_scale_error

NAME = 'slow_wheel_slip'


def held(method: MethodResult, prepared: PreparedLeg) -> MethodResult:
    """Return a method's result with the change of one wheel in its sigmas, or as it was."""
    change = abs(prepared.wheel_slips.change)
    if not change:
        return method
    # halves of the path half the change apart in the mean of two wheels: the mean is a quarter off
    mean, own = change / 2 / prepared.wheel_slips.count, change / 2
    return with_scale_error(method, prepared, NAME, dict.fromkeys(SCALES, mean)
                            | dict.fromkeys(wheel_factors(method.estimates), own))
