# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""What is said of a receiver that smooths its fixes."""

import numpy as np

from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS


def lag_reasons(square: float, sigma: float) -> tuple[Reason, ...]:
    """Return FIXES_SMOOTHED, where so; of the square of its time constant and sigma, s^2."""
    worth = 0.1     # s: a fix at 10 Hz is as old anyway
    if square <= max(REMARK_SIGMAS * sigma, worth**2):
        return ()
    return (Reason(Code.FIXES_SMOOTHED, 'the receiver smooths its fixes over about '
                   f'{np.sqrt(square):.2f} s; accounted for'),)
