# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Whether a calibration is worse than the one that it is to replace."""

import math
from pathlib import Path

from odocal_ros.calib.result import Estimate, wheel_factors
from odocal_ros.errors import BadUsage
from odocal_ros.output.figures import with_sigma, with_unit
from odocal_ros.output.stored import read_stored, Stored
from odocal_ros.reasons import Code, Verdict


def is_worse(old: Stored, new: Stored) -> str:
    """
    Return the objection to replacing an old calibration silently, empty without one.

    The old one is good unless rejected. The new one is worse when it is rejected, when it lacks a
    value that the old one has, or gives it with a sigma more than twice as large. One that holds
    all legs of the old one and more, or carries them on, knows better in any case: legs that
    disagree widen a sigma, and the narrow one was wrong.
    """
    if not old.usable:
        return ''
    if not new.usable:
        rejecting = [name for name in new.reasons if name in Code.__members__
                     and Code[name].gravity is Verdict.REJECTED]
        codes = ', '.join(dict.fromkeys(rejecting[:3] or new.reasons[:3]))
        return f'the new result is rejected ({codes}), the old one is {old.verdict.value}'
    if old.legs and old.legs < new.legs \
            or old.carried and new.carried and new.carried.goes_on_from(old.carried):
        return ''
    for name in ('scale_factor', *wheel_factors(old.estimates), 'yaw_mounting_angle'):
        why = _worse(name.replace('_', ' '), old.estimates.get(name), new.estimates.get(name))
        if why:
            return why
    return ''


def _worse(label: str, old: Estimate | None, new: Estimate | None) -> str:
    if old is None or old.value is None or not old.sigma:
        return ''
    if new is None or new.value is None:
        return f'the new result has no {label}, the old one has {said(old)}'
    clearly = 2.0    # times the sigma: four times as many such legs would be needed
    if new.unit == old.unit and new.sigma and new.sigma > clearly * old.sigma:
        return (f'the uncertainty of the {label} is {new.sigma / old.sigma:.1f} times larger: '
                f'{said(new)}, the old result has {said(old)}')
    return ''


def said(estimate: Estimate) -> str:
    """Return a value with sigma and unit as people read them; angles in deg."""
    if estimate.unit == 'rad':
        return with_sigma(estimate.value, estimate.sigma, math.degrees(1.0), signed=True) + ' deg'
    return with_unit(estimate)


def stored_in(folder: Path) -> Stored | None:
    """Return the calibration in a result folder, None where there is none to lose."""
    try:
        return read_stored(folder)
    except BadUsage:
        return None


def replacing(old: Stored | None, new: Path) -> str:
    """Return ``is_worse`` of a calibration and a result folder, empty without either."""
    found = stored_in(new)
    return is_worse(old, found) if old and found else ''
