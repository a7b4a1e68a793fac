# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""An error of the scale beyond a method's own model, put into its sigmas and budget."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from odocal_ros.calib.judge import judge
from odocal_ros.calib.result import MethodResult, Source, wheel_factors
from odocal_ros.pipeline.prepared import PreparedLeg
from odocal_ros.reasons import Code

SCALES = ('scale_factor', 'scale_ratio')


def with_scale_error(method: MethodResult, prepared: PreparedLeg, name: str,
                     relative: Mapping[str, float], shared: bool = False) -> MethodResult:
    """
    Return a method's result with an error in the sigmas of its scales.

    Parameters
    ----------
    method, prepared : MethodResult, PreparedLeg
        The result, and the leg.
    name : str
        Of the source.
    relative : dict
        1 sigma of each of SCALES, relative; of a wheel by default that of the scale factor.
    shared : bool
        The same in every leg of the vehicle.

    """
    relative = dict.fromkeys(wheel_factors(method.estimates),
                             relative['scale_factor']) | dict(relative)
    K = method.estimates['scale_factor'].value
    if not K:
        return method
    effects = np.array([[relative.get(name_, 0.0)] for name_ in method.parameters])
    estimates = {name_: replace(e, sigma=float(np.hypot(e.sigma, relative[name_] * e.value)))
                 if name_ in relative and e.value is not None and e.sigma is not None else e
                 for name_, e in method.estimates.items()}
    row = {name_: relative.get(name_, 0.0) * (method.estimates[name_].value or 0.0)
           for name_ in method.parameters} | {'shared': shared}
    judged = [r for r in judge(estimates, prepared.nominal, prepared.config)
              if r.code is Code.SCALE_SIGMA_TOO_LARGE]
    return replace(
        method, estimates=estimates, sources=(*method.sources, Source(name, effects, shared)),
        details=method.details | {'budget': method.details.get('budget', {}) | {name: row}},
        border=method.border and method.border.loosened({'scale_factor':
                                                         relative['scale_factor']}),
        reasons=(*(r for r in method.reasons if r.code is not Code.SCALE_SIGMA_TOO_LARGE),
                 *judged))
