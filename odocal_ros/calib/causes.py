# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Likely causes of a scale change as text, for the comparison of results and for single legs."""

from odocal_ros.settings.levels import TYRE_SPREAD

ANOTHER_SCALE = 2 * TYRE_SPREAD    # relative change larger than tyres cause: physical
TYRES = 'tyre pressure, wear, load or another tyre'
OTHER = 'another vehicle, gear, counter or unit: tyres do not change this much'


def cause_of_change(relative: float) -> str:
    """Return the likely cause of a relative change of the scale."""
    return OTHER if abs(relative) > ANOTHER_SCALE else TYRES


def change_in_words(relative: float) -> str:
    """Return a relative change as text, in ppm or per cent."""
    if abs(relative) < 1e-3:
        return f'{1e6 * relative:+z.0f} ppm'
    return f'{100 * relative:+.3g} %'
