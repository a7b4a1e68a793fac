# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A delay that the methods saw and estimated: say it, with the setting that takes it out."""

from collections.abc import Mapping

import numpy as np

from odocal_ros.pipeline.prepared import PreparedLeg
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS

WHAT = {'gnss': 'fix', 'odometer': 'odometer'}


def delay_notes(prepared: PreparedLeg, seen: Mapping[str, tuple[float, float]],
                scale: float) -> list[Reason]:
    """
    Return DELAY_SEEN for each delay that is there for certain and matters at the speed driven.

    prepared : the leg.   seen : 'gnss' or 'odometer' -> by how many s its stamps are late, with
    what is set, and sigma.   scale : as the method that saw them found it.
    """
    speed = _speed(prepared) * scale
    notes = []
    least_delay_path = 0.1    # m: a lever arm need not be known better either
    hidden_by_fix = 0.25    # of a fix's sigma: what a delay makes of less, no fix shows
    for name, (late, sigma) in seen.items():
        metres = abs(late) * speed
        worth = max(least_delay_path, hidden_by_fix * prepared.fix_sigma)
        if not (abs(late) > REMARK_SIGMAS * sigma and metres > worth):
            continue
        set_to = getattr(prepared.config, name).time_offset
        notes.append(Reason(
            Code.DELAY_SEEN, f'{WHAT[name]} stamps are {abs(late):.3f} s (+-{sigma:.3f} s) '
            f'{"late" if late > 0 else "early"} relative to the other sensors, {metres:.2g} m at '
            f'{speed:.1f} m/s; accounted for. To remove the delay, set {name}.time_offset to '
            f'{set_to - late:.3f}'
            + (f' (now {set_to:g})' if set_to else '')))
    return notes


def _speed(prepared: PreparedLeg) -> float:
    """Return the speed driven, scale units per s: nine tenths of the leg are slower."""
    travel = prepared.inputs.travel
    grid = np.arange(max(0.0, travel.t[0]), min(prepared.inputs.t_stop, travel.t[-1]), 1.0)
    if len(grid) < 2:
        return 0.0
    return float(np.percentile(np.abs(np.diff(travel.at(grid))), 90))
