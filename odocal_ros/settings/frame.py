# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

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
