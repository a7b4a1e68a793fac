# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
How calibrations of one vehicle differ, against their sigmas: pure, no files.

The variance of a difference is taken as the sum of both variances. Errors that legs share (a
heading source, a lever arm) may be the same in both calibrations, and then part of them cancels;
but calibration.json has their size only, not their direction on each drive, so that nothing is
taken off. For a source that always acts the same way (the heading on the yaw) the sum is the
cautious side; ``sigmas_if_shared_cancels`` assumes that all of it is common.
"""

from dataclasses import dataclass
import math

from odocal_ros.calib.result import Estimate
from odocal_ros.errors import BadUsage
from odocal_ros.nav.angles import wrap
from odocal_ros.output.stored import Stored
from odocal_ros.settings.levels import REMARK_SIGMAS

# what belongs to a drive (turn-on bias, its heading) or follows from another value
NOT_COMPARED = {'scale_ratio', 'heading_error', 'gyro_bias_x', 'gyro_bias_y', 'gyro_bias_z'}
ANGLES = {'yaw_mounting_angle', 'pitch_mounting_angle'}
ORDER = ('scale_factor', 'scale_factor_left', 'scale_factor_right', 'track_width',
         'yaw_mounting_angle', 'pitch_mounting_angle')


@dataclass(frozen=True)
class Difference:
    """
    A change of one parameter from one calibration to a later one.

    change : in the parameter's unit; sigma : of the change; sigmas : change over sigma, None
    where a sigma is unknown or zero.
    """

    since: int
    change: float
    sigma: float | None
    sigmas: float | None
    sigmas_if_shared_cancels: float | None

    @property
    def beyond(self) -> bool:
        """Return True if the change is significant."""
        return self.sigmas is not None and abs(self.sigmas) > REMARK_SIGMAS


@dataclass(frozen=True)
class Entry:
    """A parameter in one calibration, with its change since the first and the one before."""

    index: int
    estimate: Estimate
    to_first: Difference | None
    to_previous: Difference | None


@dataclass(frozen=True)
class Change:
    """A parameter over all calibrations."""

    parameter: str
    unit: str
    entries: tuple[Entry, ...]


def changes(stored: list[Stored]) -> list[Change]:
    """
    Return each parameter that two usable calibrations have, over all that have it.

    A rejected calibration shows its change, but nothing later is measured from it.

    Raises
    ------
    BadUsage
        A parameter comes in different units: these are not calibrations of one odometer.

    """
    names = sorted({n for s in stored for n, e in s.estimates.items()
                    if e.value is not None} - NOT_COMPARED, key=_order)
    if _differently_mounted(stored):
        names = [n for n in names if n not in ANGLES]
    return [c for c in (_change(name, stored) for name in names)
            if sum(stored[e.index].usable for e in c.entries) > 1]


def notes(stored: list[Stored]) -> list[str]:
    """Return the notes on the compared calibrations."""
    out = []
    for s in stored:
        if not s.usable:
            codes = ', '.join(dict.fromkeys(s.reasons[:3]))
            out.append(f'{s.name} is rejected ({codes}): shown, but not compared')
    for i, a in enumerate(stored):
        for b in stored[i + 1:]:
            if a.bags & b.bags or a.legs & b.legs:
                out.append(f'{a.name} and {b.name} use the same drive: their errors are '
                           'correlated, so a change is more significant than shown')
    if _differently_mounted(stored):
        out.append('imu.mounting_rpy differs: mounting angles are not compared')
    return out


def _order(name: str) -> tuple[int, str]:
    return (ORDER.index(name) if name in ORDER else len(ORDER), name)


def _differently_mounted(stored: list[Stored]) -> bool:
    """Return True if the mounting angles refer to different nominal mountings."""
    return len({str(s.config.get('imu.mounting_rpy')) for s in stored}) > 1


def _change(name: str, stored: list[Stored]) -> Change:
    have = [i for i, s in enumerate(stored) if s.value(name) is not None]
    unit = stored[have[0]].estimates[name].unit
    entries = []
    first = previous = None
    for i in have:
        if stored[i].estimates[name].unit != unit:
            raise BadUsage(f'{stored[i].name}: {name} is in {stored[i].estimates[name].unit}, in '
                           f'{stored[have[0]].name} in {unit}; compare calibrations of the same '
                           'odometer and unit')
        entries.append(Entry(i, stored[i].estimates[name], _difference(name, stored, first, i),
                             _difference(name, stored, previous, i)))
        if stored[i].usable:
            first, previous = i if first is None else first, i
    return Change(name, unit, tuple(entries))


def _difference(name: str, stored: list[Stored], since: int | None,
                index: int) -> Difference | None:
    if since is None:
        return None
    a, b = stored[since], stored[index]
    old, new = a.estimates[name], b.estimates[name]
    assert old.value is not None     # what has no value is no entry
    assert new.value is not None
    change = new.value - old.value
    if name in ANGLES:      # of an IMU that faces backwards they lie about +-pi
        change = float(wrap(change))
    if old.sigma is None or new.sigma is None:
        return Difference(since, change, None, None, None)
    sigma = math.hypot(old.sigma, new.sigma)
    common = sum(2 * share * b.budget[name][source][0]
                 for source, (share, shared) in a.budget.get(name, {}).items()
                 if shared and b.budget.get(name, {}).get(source, (0, False))[1])
    least = math.sqrt(max(sigma**2 - common, 0.0))
    return Difference(since, change, sigma, _over(change, sigma),
                      _over(change, least) if common else None)


def _over(change: float, sigma: float) -> float | None:
    return change / sigma if sigma > 0 else None
