# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the screening of a leg gives and says, for tests."""

from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config, with_settings


def said(leg, **changes):
    """Return the inputs of a leg and what is said, by code; changes of settings: group__name."""
    inputs, found = screen(leg, with_settings(
        Config(), {name.replace('__', '.'): value for name, value in changes.items()}))
    return inputs, {r.code: r.text for r in found}
