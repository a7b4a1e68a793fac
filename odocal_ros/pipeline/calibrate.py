# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The pipeline: ``calibrate`` from a leg to its result, ``combine`` from results to a calibration.

Pure functions without state, clock or files, called by the node and the replay. A leg is cut at
gaps of the IMU, and at sections where its gyro is frozen or the vehicle was carried
(``calibrate_parts``); its parts are legs of the same vehicle.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.drive import ferry_intervals
from odocal_ros.calib.mounting import with_mounting_remedy
from odocal_ros.calib.result import LegResult
from odocal_ros.data.arrays import Floats, Ints, map_windows, release_mapped_memory
from odocal_ros.data.leg import Leg, part_of
from odocal_ros.nav.alignment import Alignment
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.pipeline.combination import combine
from odocal_ros.pipeline.methods import leg_result, run_leg
from odocal_ros.pipeline.planar_run import is_planar, planar_leg
from odocal_ros.pipeline.prepare import prepare
from odocal_ros.pipeline.prepared_leg import Stage
from odocal_ros.reasons import Code, Reason, Verdict
from odocal_ros.screening.clocks import stamp_offsets, with_delay_sigmas, without_clock_steps
from odocal_ros.screening.glitches import frozen_gyro_spans
from odocal_ros.screening.imu_faults import gravity_turn_reasons, unit_change_reasons
from odocal_ros.screening.imu_orientation import unit_and_axis_reasons, UNUSABLE
from odocal_ros.screening.inputs import Inputs, locate_fixes
from odocal_ros.screening.leg_kind import settings_by_frame
from odocal_ros.screening.reversing import BY_FIT, reversing_reasons, sections_slipped_twice
from odocal_ros.screening.screen import screen_aligned
from odocal_ros.settings.config import Config

__all__ = ['calibrate', 'calibrate_parts', 'combine', 'find_faults', 'screen_leg',
           'ScreenedLeg']
# reasons that disappear with more driving
PROVISIONAL_CODES = {Code.LEG_TOO_SHORT, Code.SPEED_TOO_LOW, Code.NO_ODOMETER, Code.NO_FIX}


class ScreenedLeg(NamedTuple):
    """A leg after the screening of its data."""

    leg: Leg          # with its clocks aligned
    inputs: Inputs    # its usable rows
    reasons: tuple[Reason, ...]
    usable: bool      # True: it can be calibrated


def calibrate(leg: Leg, config: Config, alignment: Alignment | None = None,
              notes: tuple[Reason, ...] = (), holdout: bool = False,
              progress: Callable[[Stage], None] | None = None) -> LegResult:
    """
    Return the result of one leg; if it cannot be calibrated, with the reasons for that.

    leg : raw samples between two marks, with pre-roll.   config : settings in force.   alignment :
    used instead of the leg's own (in simulations with errors).   notes : reasons of the caller on
    the data (a truncated bag).   holdout : hold the last fifth of the distance out of the fit and
    check the correction on it.   progress : called with each stage of the work, and with each pass
    of a fit.
    """
    progress, config = progress or (lambda stage: None), settings_by_frame(leg.fix, config)
    if is_planar(leg, config):
        return planar_leg(leg, config, notes, progress)
    screened = screen_leg(leg, config, notes)
    leg, inputs = screened.leg, screened.inputs
    config = with_delay_sigmas(config, inputs.clock_differences)

    def result_of(inputs: Inputs, reasons: Sequence[Reason]) -> LegResult:
        prepared, refusals = prepare(leg, inputs, config, reasons, alignment, holdout)
        return leg_result(leg, inputs, refusals) if prepared is None else run_leg(
            prepared, progress)

    if not screened.usable:
        return leg_result(leg, inputs, screened.reasons)
    result = result_of(inputs, screened.reasons)
    reversed_spans, scale = _reversed_sections(result, inputs)
    if not len(reversed_spans):
        return result
    reasons = (*screened.reasons, *reversing_reasons(
        reversed_spans, inputs.travel, scale, BY_FIT, config.odometer.signed))
    return result_of(inputs.mirrored(reversed_spans), reasons)


def find_faults(screened: ScreenedLeg, config: Config) -> tuple[Reason, ...]:
    """Return the faults of a leg's data, without reasons that disappear with more driving."""
    reasons = screened.reasons
    if screened.usable:
        config = settings_by_frame(screened.leg.fix, config)
        _, reasons = prepare(screened.leg, screened.inputs, config, reasons)
    return tuple(r for r in reasons
                 if r.code.severity is not Verdict.ACCEPTED and r.code not in PROVISIONAL_CODES)


def screen_leg(leg: Leg, config: Config, notes: Sequence[Reason] = ()) -> ScreenedLeg:
    """Return a leg with its usable inputs, z of b up, and the reasons of the screening."""
    config = settings_by_frame(leg.fix, config)
    leg, inputs, screening_reasons = screen_aligned(leg, config)
    reasons = (*notes, *screening_reasons)
    missing = missing_data_reasons(leg, inputs)
    if missing or not len(inputs.t_fix):
        known = {r.code for r in reasons}
        return ScreenedLeg(leg, inputs, (*reasons, *(r for r in missing if r.code not in known)),
                        False)
    imu_reasons, z_down = unit_and_axis_reasons(inputs.median_f_b, inputs.w_b, inputs.C_bi,
                                                config.imu)
    # a turn of gravity takes precedence: the mean gravity of the other test is then meaningless
    if gravity_turns := gravity_turn_reasons(inputs):
        imu_reasons, z_down = gravity_turns, False
    if not imu_reasons:
        imu_reasons = unit_change_reasons(inputs)
    reasons += tuple(with_mounting_remedy(imu_reasons, inputs))
    release_mapped_memory()
    if z_down:      # forward-right-down: rotated to forward-left-up
        C = matrix_from_rpy([np.pi, 0.0, 0.0])
        inputs = replace(inputs, w_b=inputs.w_b @ C.T, f_b=inputs.f_b @ C.T, C_bi=C @ inputs.C_bi)
    return ScreenedLeg(leg, inputs, reasons, not UNUSABLE & {r.code for r in imu_reasons})


def _reversed_sections(result: LegResult, inputs: Inputs) -> tuple[Floats, float | None]:
    """Return reversed sections by the smoother's slips, (m, 2) s, and the smoother's scale."""
    smoother = result.methods.get('smoother')
    scale = None if smoother is None else smoother.estimates['scale_factor'].value
    if smoother is None or not scale:
        return np.empty((0, 2)), None
    return sections_slipped_twice(smoother.details['slips'], inputs.travel, scale), scale


def missing_data_reasons(leg: Leg, inputs: Inputs) -> list[Reason]:
    """Return the reasons for data that every method needs and that a leg lacks."""
    missing = []
    if leg.stop_ns <= leg.start_ns:
        missing.append(Reason(Code.LEG_TOO_SHORT, 'the stop mark is not after the start mark',
                              'Set the start mark first, then the stop mark.'))
    for n, required, code, topic in (
            (len(inputs.t_imu), 4, Code.NO_IMU, 'IMU'),
            (len(inputs.travel.t), 2, Code.NO_ODOMETER, 'odometer')):
        if n < required:
            missing.append(Reason(code, f'{n} usable {topic} message{"s" * (n != 1)}; '
                                  f'required: {required} or more'))
    if not len(inputs.t_fix) and len(leg.fix.stamp_ns):     # none received: reported already
        missing.append(Reason(Code.FIXES_UNUSABLE, 'no usable fix'))
    return missing


def parts_between(leg: Leg, gaps: Ints) -> list[Leg]:
    """Return the parts of a leg between gaps, (k, 2) ns; none if there are no or too many gaps."""
    max_parts = 20    # with more gaps the leg is rejected
    if not 0 < len(gaps) < max_parts:
        return []
    gap_ends, part_ends = [None, *gaps[:, 1].tolist()], [*gaps[:, 0].tolist(), leg.stop_ns]
    spans = [(max(gap_end or leg.start_ns, leg.start_ns), part_end, gap_end)
             for gap_end, part_end in zip(gap_ends, part_ends, strict=True)]
    shortest_ns = 10**9    # of a part: shorter ones are dropped
    return [part_of(leg, *span) for span in spans if span[1] - span[0] >= shortest_ns]


def imu_gaps(leg: Leg, limit_s: float) -> Ints:
    """Return begin and end of the gaps of the IMU, ns: (k, 2), including those at the marks."""
    near_start_ns = 60 * 10**9    # before the start mark, for the search for gaps
    stamps, first_ns = leg.imu.stamp_ns, leg.start_ns - near_start_ns
    if map_windows(lambda x: np.diff(x) > 0, stamps).all():      # a view of them
        stamps = stamps[slice(*np.searchsorted(stamps, [first_ns, leg.stop_ns + 1]))]
    else:
        stamps = np.unique(stamps[(stamps >= first_ns) & (stamps <= leg.stop_ns)])
    if len(stamps) < 2:
        return np.empty((0, 2), np.int64)
    gap_margin_ns = 1000    # below the limit: larger than the rounding of seconds
    min_ns = round(limit_s * 1e9) - gap_margin_ns
    k = np.flatnonzero(map_windows(lambda x: np.diff(x) > min_ns, stamps))
    begin, end = np.append(stamps[k], stamps[-1]), np.append(stamps[k + 1], leg.stop_ns)
    if ((begin < leg.start_ns) & (leg.start_ns < end)).any():
        begin, end = (np.sort(np.append(x, leg.start_ns)) for x in (begin, end))
    t = (np.stack([begin, end], -1) - leg.start_ns) * 1e-9
    return np.stack([begin, end], -1)[t[:, 1] - t[:, 0] > limit_s]


def _carried_sections(leg: Leg, config: Config) -> Ints:
    """Return begin and end of motion without counts, ns: (k, 2)."""
    inputs = screen_leg(leg, config).inputs
    located = locate_fixes(inputs, settings_by_frame(leg.fix, config))
    spans = ferry_intervals(inputs.travel, inputs.t_fix, located.fixes_n, located.fix_sigma)
    return leg.start_ns + np.round(spans * 1e9).astype(np.int64)


def _frozen_sections(leg: Leg, config: Config) -> Ints:
    """Return begin and end of the sections with a frozen gyro, ns: (k, 2)."""
    inputs = screen_leg(leg, config).inputs
    spans = frozen_gyro_spans(inputs.t_imu, inputs.w_b, inputs.travel, config.leg.max_gap)
    return leg.start_ns + np.round((spans - stamp_offsets(config)['imu']) * 1e9).astype(np.int64)


def calibrate_parts(leg: Leg, config: Config, notes: tuple[Reason, ...] = (),
                    holdout: bool = False,
                    progress: Callable[[Stage], None] | None = None) -> list[LegResult]:
    """Return the results of a leg's parts that can be calibrated, otherwise that of the leg."""
    def usable_results(parts: list[Leg]) -> list[LegResult]:
        results = []
        for k, part in enumerate(parts):
            def report(stage: Stage, k: int = k) -> None:
                if progress is not None:
                    progress(replace(stage, done=(k + stage.done) / len(parts)))
            results.append(calibrate(part, config, notes=notes, holdout=holdout, progress=report))
        return [result for result in results if result.verdict is not Verdict.REJECTED]

    leg, clock_steps = without_clock_steps(leg)      # a step forward is not a gap
    notes = (*notes, *clock_steps)
    usable = usable_results(parts_between(leg, imu_gaps(leg, config.leg.max_gap)))
    cause, remedy = f'no IMU data for more than {config.leg.max_gap:g} s', ''
    if not usable:
        whole_leg = calibrate(leg, config, notes=notes, holdout=holdout, progress=progress)
        texts = {reason.code: reason.text for reason in whole_leg.reasons}
        if Code.ODOMETER_STILL in texts:
            usable = usable_results(parts_between(leg, _carried_sections(leg, config)))
            cause, remedy = texts[Code.ODOMETER_STILL], (
                'If the vehicle was carried (ferry, train), ignore. Otherwise check the wheel '
                'sensor and the odometer topic.')
        elif Code.IMU_GAP in texts:
            usable = usable_results(parts_between(leg, _frozen_sections(leg, config)))
            cause = texts[Code.IMU_GAP]
        if not usable:
            return [whole_leg]
    if [(part.start_ns, part.stop_ns) for part in usable] == [(leg.start_ns, leg.stop_ns)]:
        return usable      # the gap is before the mark
    return [replace(part, cut_from_ns=leg.start_ns, reasons=(*part.reasons, Reason(
        Code.LEG_CUT, f'{cause}; {_section_text(leg, part, len(usable))}', remedy)))
        for part in usable]


def _section_text(leg: Leg, part: LegResult, count: int) -> str:
    """Return the span of one of ``count`` usable parts of a leg, as text."""
    begin, end = ((t - leg.start_ns) * 1e-9 for t in (part.start_ns, part.stop_ns))
    return (f'this section covers {begin:.1f} to {end:.1f} s of the '
            f'{(leg.stop_ns - leg.start_ns) * 1e-9:.1f} s leg'
            + (f', one of {count} usable sections' if count > 1 else
               ', the only section with a usable result'))
