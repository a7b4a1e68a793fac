# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""--accept NAME=LOW:HIGH, the short form of the settings accept.*; angles in degrees too."""

import math

from odocal_ros.errors import BadUsage
from odocal_ros.settings.accept_config import ACCEPTED

WANTED = ('--accept NAME=LOW:HIGH, such as --accept scale_ratio=0.995:1.005; either limit can be '
          'omitted')
DEG = '_deg'


def parse_accept(text: str) -> dict[str, float]:
    """
    Return the settings of one ``NAME=LOW:HIGH``; of ``NAME_deg`` the limits are in degrees.

    Raises
    ------
    BadUsage
        Not of that form, or of no result that has limits.

    """
    name, equals, limits = (part.strip() for part in text.partition('='))
    low, colon, high = limits.partition(':')
    plain, factor = name, 1.0
    if name.endswith(f'angle{DEG}'):
        plain, factor = name.removesuffix(DEG), math.radians(1.0)
    if plain not in ACCEPTED:
        raise BadUsage(f'--accept {text}: required: one of '
                       + ', '.join(n + f' (or {n}{DEG})' * n.endswith('angle') for n in ACCEPTED))
    if not (equals and colon and limits != ':'):
        raise BadUsage(f'--accept {text}: required: {WANTED}')
    try:
        return {f'accept.{plain}_{side}': float(value) * factor
                for side, value in (('min', low), ('max', high)) if value.strip()}
    except ValueError:
        raise BadUsage(f'--accept {text}: {limits} are not two numbers; required: '
                       f'{WANTED}') from None
