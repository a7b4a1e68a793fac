# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Screening of a leg with changed settings, for tests."""

from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config, with_settings


def screen_with(leg, **changes):
    """Return inputs and texts of reasons by code; changes of settings: group__name."""
    inputs, found = screen(leg, with_settings(
        Config(), {name.replace('__', '.'): value for name, value in changes.items()}))
    return inputs, {r.code: r.text for r in found}
