# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What the method wheels makes of the way so far: run on the thinned of a leg, as it will be."""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.choice import deciding
from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.data.leg import Leg
from odocal_ros.foresee.forecast import Forecast, Prospect, WheelsForecast
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Verdict
from odocal_ros.screening.force import felt
from odocal_ros.settings.config import Config, with_settings

SOURCE_SHARE = 0.01    # judgement: of the variance; a source of less is not told


def with_wheels(forecast: Forecast, leg: Leg, config: Config) -> Forecast:
    """
    Return an forecast with what two wheels tell so far; scale and yaw too, where that is better.

    leg : the way so far. One counter beside an accelerometer, or a method that takes the mean of
    both, changes nothing.
    """
    one = not len(leg.odometer_right.stamp_ns) and felt(leg.imu.f_i)
    if one or 'wheels' not in deciding(config.method):
        return forecast
    result = calibrate(leg, with_settings(config, {'method': 'wheels'}))
    method = result.methods.get('wheels')
    if method is None or method.verdict is Verdict.REJECTED:
        return replace(forecast, wheels=WheelsForecast(None, None))
    left, right, width = (_relative(method.estimates[name]) for name in (
        'scale_factor_left', 'scale_factor_right', 'track_width'))
    apart = None if left is None or right is None else max(left, right)
    scale = _better(forecast.scale, method, 'scale_factor',
                    _relative(method.estimates['scale_factor']))
    if scale is not forecast.scale and scale.sigma and scale.metres:
        # as all the fixes along the way count, no less is gained than by the length of the way
        more = result.distance * (scale.sigma / scale.asked - 1)
        scale = replace(scale, metres=min(scale.metres, more))
    yaw = _better(forecast.yaw, method, 'yaw_mounting_angle',
                  method.estimates['yaw_mounting_angle'].sigma)
    return replace(forecast, wheels=WheelsForecast(apart, width), scale=scale, yaw=yaw,
                   methods=forecast.methods | {'wheels': method})


def sources_of(method: MethodResult, parameter: str) -> tuple[tuple[str, float], ...]:
    """Return the sources of a parameter's error that matter, the largest first."""
    row = method.parameters.index(parameter)
    sizes = {s.name: float(np.linalg.norm(s.effects[row])) for s in method.sources}
    least = SOURCE_SHARE * sum(size**2 for size in sizes.values())
    return tuple(sorted(((name, size) for name, size in sizes.items() if size**2 > least),
                        key=lambda source: -source[1]))


def _better(prospect: Prospect, method: MethodResult, parameter: str,
            sigma: float | None) -> Prospect:
    """Return a prospect by the method, which is the one that gives the result, if it is better."""
    if sigma is None or prospect.sigma is not None and prospect.sigma <= sigma:
        return prospect
    return replace(prospect, sigma=sigma, sources=sources_of(method, parameter),
                   metres=0.0 if sigma <= prospect.asked else prospect.metres)


def _relative(estimate: Estimate) -> float | None:
    value, sigma = estimate.value, estimate.sigma
    return None if not value or sigma is None else sigma / abs(value)
