# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The pipeline: one pure function from a leg to its result, one from results to a calibration.

No state, no clock, no files: the live node and the replay call these and nothing else.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.mounting import with_axes
from odocal_ros.calib.result import LegResult
from odocal_ros.data.arrays import Floats
from odocal_ros.data.leg import Leg
from odocal_ros.data.mapped import let_go
from odocal_ros.nav.alignment import Alignment
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.pipeline.combination import combine
from odocal_ros.pipeline.leg_run import leg_result, run_leg
from odocal_ros.pipeline.method_run import Stage
from odocal_ros.pipeline.planar_run import is_planar, planar_leg
from odocal_ros.pipeline.prepare import prepare
from odocal_ros.reasons import Code, Reason, Verdict
from odocal_ros.screening.facing import imu_sanity, UNUSABLE
from odocal_ros.screening.inputs import Inputs
from odocal_ros.screening.leg_kind import settings_by_frame
from odocal_ros.screening.reversing import BY_FIT, doubled, said_of
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config

__all__ = ['calibrate', 'combine', 'faults', 'Screened', 'screened']
# of a leg that is not over
NOT_YET = {Code.LEG_TOO_SHORT, Code.SPEED_TOO_LOW, Code.NO_ODOMETER, Code.NO_FIX}


class Screened(NamedTuple):
    """Inputs, what is said of them, and whether a leg can be made of them."""

    inputs: Inputs
    reasons: tuple[Reason, ...]
    usable: bool


def calibrate(leg: Leg, config: Config, alignment: Alignment | None = None,
              notes: tuple[Reason, ...] = (), holdout: bool = False,
              progress: Callable[[Stage], None] | None = None) -> LegResult:
    """
    Take one leg from samples to result.

    leg : raw samples between two marks, with pre-roll.   config : settings in force.   alignment :
    used instead of the leg's own (a simulation puts errors in it).   notes : what the door knows
    of the data already (a truncated bag).   holdout : keep the last fifth of the distance back
    from the fit and check the correction on it.   progress : called with each stage of the work,
    and with each pass of a fit.

    Returns
    -------
    LegResult; a leg that cannot be calibrated says why in its reasons.

    """
    progress, config = progress or (lambda stage: None), settings_by_frame(leg.fix, config)
    if is_planar(leg, config):
        return planar_leg(leg, config, notes, progress)
    seen = screened(leg, config, notes)
    inputs = seen.inputs

    def result_of(inputs: Inputs, reasons: Sequence[Reason]) -> LegResult:
        prepared, found = prepare(leg, inputs, config, reasons, alignment, holdout)
        return leg_result(leg, inputs, found) if prepared is None else run_leg(prepared, progress)

    if not seen.usable:
        return leg_result(leg, inputs, seen.reasons)
    result = result_of(inputs, seen.reasons)
    back, scale = _reversed(result, inputs)
    if not len(back):
        return result
    return result_of(inputs.mirrored(back), (
        *seen.reasons, *said_of(back, inputs.travel, scale, BY_FIT, config.odometer.signed)))


def faults(leg: Leg, seen: Screened, config: Config) -> tuple[Reason, ...]:
    """
    Return the reasons of a leg as in ``calibrate``, without those of its methods.

    A leg that is not over may be given, as ``screened`` has it: what more of a drive cures is left
    out.
    """
    reasons = seen.reasons
    if seen.usable:
        _, reasons = prepare(leg, seen.inputs, settings_by_frame(leg.fix, config), reasons)
    return tuple(r for r in reasons
                 if r.code.gravity is not Verdict.ACCEPTED and r.code not in NOT_YET)


def screened(leg: Leg, config: Config, notes: Sequence[Reason] = ()) -> Screened:
    """Return the inputs of a leg, z up."""
    config = settings_by_frame(leg.fix, config)
    inputs, found = screen(leg, config)
    reasons = (*notes, *found)
    missing = _missing(leg, inputs)
    if missing or not len(inputs.t_fix):
        seen = {r.code for r in reasons}
        return Screened(inputs, (*reasons, *(r for r in missing if r.code not in seen)), False)
    sanity, z_down = imu_sanity(inputs.usual_f_b, inputs.w_b, inputs.C_bi, config.imu)
    reasons += tuple(with_axes(sanity, inputs))
    let_go()
    if z_down:
        inputs = _turned_over(inputs)
    return Screened(inputs, reasons, not UNUSABLE & {r.code for r in sanity})


def _reversed(result: LegResult, inputs: Inputs) -> tuple[Floats, float | None]:
    """Return intervals of an unsigned counter in the smoother's slips, (m, 2) s, and the scale."""
    smoother = result.methods.get('smoother')
    scale = None if smoother is None else smoother.estimates['scale_factor'].value
    if smoother is None or not scale:
        return np.empty((0, 2)), None
    return doubled(smoother.details['slips'], inputs.travel, scale), scale


def _missing(leg: Leg, inputs: Inputs) -> list[Reason]:
    """Return the data that a leg lacks for any method."""
    missing = []
    if leg.stop_ns <= leg.start_ns:
        missing.append(Reason(Code.LEG_TOO_SHORT, 'the stop mark is not after the start mark'))
    for n, least, code, what in (
            (len(inputs.t_imu), 4, Code.NO_IMU, 'IMU'),
            (len(inputs.travel.t), 2, Code.NO_ODOMETER, 'odometer')):
        if n < least:
            missing.append(Reason(code, f'{n} usable {what} messages'))
    if not len(inputs.t_fix) and len(leg.fix.stamp_ns):     # none sent is said already
        missing.append(Reason(Code.FIXES_UNUSABLE, 'no usable fix'))
    return missing


def _turned_over(inputs: Inputs) -> Inputs:
    """Return inputs with a forward-right-down IMU read as what it is."""
    C = matrix_from_rpy([np.pi, 0.0, 0.0])
    return replace(inputs, w_b=inputs.w_b @ C.T, f_b=inputs.f_b @ C.T, C_bi=C @ inputs.C_bi)
