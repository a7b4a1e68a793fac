# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The methods, each a pure function of a prepared leg, and the leg's result from theirs."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from odocal_ros.calib import choice
from odocal_ros.calib.drive import path_and_chord
from odocal_ros.calib.result import failure, LegResult, MethodResult, raise_on_overflow, RAW_SCALE
from odocal_ros.calib.two_point import refused_result
from odocal_ros.data.arrays import release_mapped_memory
from odocal_ros.data.leg import Leg
from odocal_ros.errors import OdocalError
from odocal_ros.pipeline import beyond_model
from odocal_ros.pipeline.prepare import checked_with_scale
from odocal_ros.pipeline.prepared_leg import (
    MethodRun,
    PassCallback,
    path_check,
    PreparedLeg,
    Stage,
    track_results,
)
from odocal_ros.pipeline.two_point_run import two_point
from odocal_ros.reasons import Code, Reason, Verdict
from odocal_ros.screening.inputs import Inputs, median_origin

# judgement: relative computing time of the methods, and of the tracks after them
METHOD_EFFORT = {'two_point': 1, 'smoother': 20}
TRACKS_EFFORT = 2


def _smoother(prepared: PreparedLeg, report_pass: PassCallback) -> MethodRun:
    from odocal_ros.pipeline.smoother_run import smoother
    return smoother(prepared, report_pass)


def _no_smoother(inputs: Inputs, reason: Reason) -> MethodResult:
    from odocal_ros.estimator.result.estimates import refused_result
    return refused_result((reason,), inputs.scale_unit, inputs.travels)


# in the order of the output; two_point, by the operator's own marks, is always computed
METHODS: dict[str, Callable[[PreparedLeg, PassCallback], MethodRun]] = {
    'two_point': two_point, 'smoother': _smoother}
# the result of a method that cannot estimate: (inputs, reason) to MethodResult
REFUSED_RESULTS: dict[str, Callable[[Inputs, Reason], MethodResult]] = {
    'two_point': lambda inputs, reason: refused_result((reason,), inputs.scale_unit),
    'smoother': _no_smoother}


def run_methods(names: Iterable[str], prepared: PreparedLeg,
                report_start: Callable[[str], PassCallback]) -> dict[str, MethodRun]:
    """Return the runs of methods on a leg; an error in one rejects this method, not the leg."""
    runs = {}
    for name in names:
        report_pass = report_start(name)
        release_mapped_memory()
        runs[name] = _run_guarded(name, prepared, partial(METHODS[name], prepared, report_pass))
    return {name: _run_guarded(name, prepared, partial(_add_model_errors, run, prepared))
            for name, run in runs.items()}


def reasons_on_data(runs: dict[str, MethodRun], prepared: PreparedLeg) -> list[Reason]:
    """
    Return the reasons on the data of a leg that the methods found, without duplicates.

    DELAY_SEEN is from the last method in METHODS that estimates delays. Reasons on slip and delay
    of the odometer are from the last one that checks them and is not rejected, else the first.
    """
    reasons: list[Reason] = []
    delay_reasons: list[Reason] = []
    odometer_reasons: tuple[Reason, ...] | None = None
    for run in (runs[name] for name in METHODS if name in runs):
        reasons += run.data_reasons
        scale = run.result.estimates['scale_factor'].value
        if run.delays is not None and scale is not None:
            delay_reasons = beyond_model.delay_notes(prepared, run.delays, scale)
        is_usable = odometer_reasons is None or run.result.verdict is not Verdict.REJECTED
        if run.odometer_reasons is not None and is_usable:
            odometer_reasons = run.odometer_reasons
    return [*reasons, *(odometer_reasons or ()), *delay_reasons]


def _add_model_errors(run: MethodRun, prepared: PreparedLeg) -> MethodRun:
    """Return a run whose sigmas include errors that no method models."""
    result = run.result
    for add in (beyond_model.with_wheel_change, beyond_model.with_truncation,
                beyond_model.with_hills):
        result = add(result, prepared)
    if result.name == 'two_point':
        result = replace(result, reasons=(
            *prepared.alignment_reasons, *prepared.end_point_reasons, *result.reasons))
    return run._replace(result=result)


def _run_guarded(name: str, prepared: PreparedLeg, work: Callable[[], MethodRun]) -> MethodRun:
    """Return the result of ``work``; if it raises, a run without estimates."""
    inputs = prepared.inputs
    try:
        # divergence is detected by non-finite numbers, not by warnings
        with raise_on_overflow():
            return work()
    except (OdocalError, MemoryError):
        raise
    except FloatingPointError:
        return MethodRun(REFUSED_RESULTS[name](inputs, Reason(
            Code.NOT_CONVERGED, f'{name} did not converge: an estimate became infinite or '
            'NaN. Likely cause: invalid or missing samples')))
    except Exception as error:      # its reasons may be wrong too and are dropped
        return MethodRun(failure(partial(REFUSED_RESULTS[name], inputs), name, error))


def leg_result(leg: Leg, inputs: Inputs, reasons: Sequence[Reason],
               methods: dict[str, MethodResult] | None = None, **fields: Any) -> LegResult:
    """Return the result of a leg: counts, reasons, methods, and further fields of LegResult."""
    between = (inputs.t_fix >= -0.5) & (inputs.t_fix <= inputs.t_stop + 0.5)
    if 'distance' not in fields:      # of a leg that is refused: by the fixes
        t_fix, geodetic = inputs.t_fix[between], inputs.geodetic[between]
        fields['distance'] = path_and_chord(
            t_fix, median_origin(t_fix, geodetic).to_n(np.nan_to_num(geodetic)),
            inputs.min_motion)[0] if len(t_fix) else 0.0
    return LegResult(
        start_ns=leg.start_ns, stop_ns=leg.stop_ns, duration=inputs.t_stop,
        imu_samples=len(inputs.t_imu),
        pulses=len(inputs.travel.t), fixes=int(between.sum()),
        rejected_fixes=inputs.fixes_rejected, reasons=tuple(reasons), methods=methods or {},
        C_bi=inputs.C_bi, **fields)


def run_leg(prepared: PreparedLeg, progress: Callable[[Stage], None]) -> LegResult:
    """Return the result of a leg; ``progress`` is called as in ``calibrate``."""
    leg, inputs, selected_method = prepared.leg, prepared.inputs, prepared.config.method
    names = [name for name in METHODS if name in choice.computed_methods(selected_method)]
    runs = run_methods(names, prepared, _progress_reporter(names, progress))
    progress(Stage('tracks', 1.0 - TRACKS_EFFORT / _effort(names)))
    methods = {name: run.result for name, run in runs.items()}
    reasons = [*reasons_on_data(runs, prepared), *choice.disagreements(methods)]
    reasons += choice.rejected_method_reasons(methods, selected_method,
                                            {r.code for r in (*prepared.reasons, *reasons)})
    estimates, _ = choice.choose(methods, selected_method)
    scale = estimates.get('scale_factor')
    paths = None if scale is None else runs[scale.method].paths
    track_fields: dict[str, Any] = {}
    if scale is not None and paths is not None:
        distance_sigma = 0.05    # largest relative sigma of a scale for the distance
        # more accurate than the approximate scale; the travel is the integral of the raw speed
        if scale.value and scale.sigma is not None and scale.sigma < distance_sigma * scale.value:
            prepared = checked_with_scale(
                prepared, estimates.get(RAW_SCALE, scale).value or scale.value)
        track_fields, track_reasons = track_results(prepared, paths)
        reasons += track_reasons
        for name, run in runs.items():
            if run.paths is not None:
                check, track_reasons = path_check(prepared, run.paths.after)
                methods[name] = replace(run.result, details=run.result.details | check)
                reasons += track_reasons
    # outlier fixes are reported once, by the first method or track
    outlier_reasons = [k for k, reason in enumerate(reasons)
                       if reason.code is Code.BAD_ROWS_DROPPED]
    reasons = [reason for k, reason in enumerate(reasons) if k not in outlier_reasons[1:]]
    return leg_result(leg, inputs, (*prepared.reasons, *reasons), methods,
                      deciding=choice.deciding_methods(selected_method),
                      distance=prepared.distance, path_ratio=prepared.path_ratio, **track_fields)


def _effort(names: Iterable[str]) -> int:
    return sum(METHOD_EFFORT[name] for name in names) + TRACKS_EFFORT


def _progress_reporter(names: Iterable[str],
                       progress: Callable[[Stage], None]) -> Callable[[str], PassCallback]:
    """Return a callback that reports the start of a method and returns one for its passes."""
    done = 0.0

    def report_start(name: str) -> PassCallback:
        nonlocal done
        stage = Stage(name, done)
        progress(stage)
        done += METHOD_EFFORT[name] / _effort(names)
        return lambda passes, change: progress(replace(stage, passes=passes, change=change))
    return report_start
