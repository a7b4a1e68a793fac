# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Slip of one wheel that a method's own model does not hold: its sigma is widened by the size known.

A wheel that slips all along from some moment on, or loses air, leaves a scale between that of
before and that of after; the fixes of the leg do not tell which of them is the vehicle's. A slip
drawn out over tens of seconds is no step, and hides in the smoother's road noise.
"""

import numpy as np

from odocal_ros.calib.result import MethodResult
from odocal_ros.calib.wheels.wheel_slips import WheelSlips
from odocal_ros.data.arrays import Floats
from odocal_ros.pipeline.prepared import PreparedLeg
from odocal_ros.pipeline.scale_error import SCALES, WHEELS, with_scale_error

NAME = 'slow_wheel_slip'


def held(method: MethodResult, prepared: PreparedLeg, slips: WheelSlips) -> MethodResult:
    """
    Return a method's result with the slip of one wheel in its sigmas, as it was without any.

    method : MethodResult.   prepared : PreparedLeg.   slips : WheelSlips, of all that was found.
    """
    # halves of the way half the change apart in the mean of the wheels: the mean is a quarter off
    mean, wheel = abs(slips.change) / 4, abs(slips.change) / 2
    if prepared.distance > 0:
        part = float(np.linalg.norm(_not_held(method, slips))) / prepared.distance
        mean, wheel = float(np.hypot(mean, part / 2)), float(np.hypot(wheel, part))
    if not mean:
        return method
    return with_scale_error(method, prepared, NAME,
                            dict.fromkeys(SCALES, mean) | dict.fromkeys(WHEELS, wheel))


def _not_held(method: MethodResult, slips: WheelSlips) -> Floats:
    """Return the sizes, m, of the slips of one wheel that are not in the method's sigmas yet."""
    longest_step = 8.0    # s: method wheels takes a slip for a step, which a longer one is not
    long = slips.end - slips.begin > longest_step
    own = [(s['t'], s['t'] + s['duration']) for s in method.details.get('slips', ())]
    seen = np.array([any(a <= end and b >= begin for a, b in own)
                     for begin, end in zip(slips.begin, slips.end, strict=True)], bool)
    # two_point sees only the ends: there the whole slip is in, however long it took
    left = {'wheels': long, 'smoother': ~seen}.get(method.name, np.zeros(len(long), bool))
    size: Floats = slips.size[left]
    return size
