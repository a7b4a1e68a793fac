# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The settings that differ with the frame of the positions."""

from dataclasses import replace

from odocal_ros.settings.config import Config


def in_local_frame(config: Config) -> Config:
    """Return the settings of a leg whose positions are in a local frame."""
    reference, leg = config.reference, config.leg
    return replace(
        config, gnss=replace(config.gnss, default_sigma=reference.default_sigma),
        leg=replace(leg, min_distance=min(leg.min_distance, reference.min_distance),
                    min_speed=min(leg.min_speed, reference.min_speed)))
