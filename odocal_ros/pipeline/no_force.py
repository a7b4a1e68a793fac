# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Additional uncertainty of a result without an accelerometer: ``screening/force.py``."""

from dataclasses import replace

from odocal_ros.calib.result import MethodResult
from odocal_ros.pipeline.prepared import PreparedLeg
from odocal_ros.pipeline.scale_error import SCALES, with_scale_error
from odocal_ros.reasons import Code

NAME = 'hills'


def upright(method: MethodResult, prepared: PreparedLeg) -> MethodResult:
    """Return a method's result as it was, or of an IMU without force: hills in, no angles."""
    if prepared.inputs.felt:
        return method
    hills = 5e-4    # of the scale: half the mean square of slopes of 3 %, which make a path longer
    method = with_scale_error(method, prepared, NAME, dict.fromkeys(SCALES, hills))
    # what NO_ACCELEROMETER says of the angles, with another remedy
    said = {Code.PITCH_NOT_DETERMINED} | (
        set() if prepared.alignment.heading_separable else {Code.YAW_NOT_SEPARABLE})
    return replace(
        method, reasons=tuple(r for r in method.reasons if r.code not in said), estimates={
            name: replace(e, value=None, sigma=None) if name == 'pitch_mounting_angle' else e
            for name, e in method.estimates.items()})
