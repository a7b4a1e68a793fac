# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The methods of a leg: each a pure function of it, and what becomes of one that breaks."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial

from odocal_ros.calib.failed import failed, raised_if_wild
from odocal_ros.calib.result import MethodResult
from odocal_ros.calib.two_point import unsolved
from odocal_ros.data.mapped import let_go
from odocal_ros.errors import OdocalError
from odocal_ros.pipeline.beyond_model import delay_notes, held, held_steps, upright
from odocal_ros.pipeline.method_run import MethodRun, Passed
from odocal_ros.pipeline.prepared import PreparedLeg
from odocal_ros.pipeline.two_point_run import two_point
from odocal_ros.reasons import Code, Reason, Verdict
from odocal_ros.screening.inputs import Inputs


def _smoother(prepared: PreparedLeg, passed: Passed) -> MethodRun:
    from odocal_ros.pipeline.smoother_run import smoother
    return smoother(prepared, passed)


def _no_smoother(inputs: Inputs, why: Reason) -> MethodResult:
    from odocal_ros.calib.smoother.refusal import refused
    return refused((why,), inputs.scale_unit, inputs.travels)


# as they are shown; two_point, the operator's own marks, is always computed
METHODS: dict[str, Callable[[PreparedLeg, Passed], MethodRun]] = {
    'two_point': two_point, 'smoother': _smoother}
# what each gives where it refuses: (inputs, reason) to MethodResult
UNKNOWN: dict[str, Callable[[Inputs, Reason], MethodResult]] = {
           'two_point': lambda inputs, why: unsolved((why,), inputs.scale_unit),
           'smoother': _no_smoother}


def run_methods(names: Iterable[str], prepared: PreparedLeg,
                begun: Callable[[str], Passed]) -> dict[str, MethodRun]:
    """
    Run methods on a leg; what breaks in one costs this method, not the leg.

    names : in any order.   begun : called with the name of each before it runs, returns what to
    call with each pass of its fit.

    Returns
    -------
    What each found.

    """
    runs = {}
    for name in names:
        passed = begun(name)
        let_go()
        runs[name] = _guarded(name, prepared, partial(METHODS[name], prepared, passed))
    return {name: _guarded(name, prepared, partial(_doubted, run, prepared))
            for name, run in runs.items()}


def found_by(runs: dict[str, MethodRun], prepared: PreparedLeg) -> list[Reason]:
    """
    Return the reasons of methods on the data, each once.

    Delays are by the best method that sees them, what the odometer does beside the IMU by the best
    that looked and is not rejected, else by the first.
    """
    found: list[Reason] = []
    notes: list[Reason] = []
    odometer: tuple[Reason, ...] | None = None
    for run in (runs[name] for name in METHODS if name in runs):
        found += run.found
        scale = run.result.estimates['scale_factor'].value
        if run.delays is not None and scale is not None:
            notes = delay_notes(prepared, run.delays, scale)
        sound = odometer is None or run.result.verdict is not Verdict.REJECTED
        if run.odometer is not None and sound:
            odometer = run.odometer
    return [*found, *(odometer or ()), *notes]


def _doubted(run: MethodRun, prepared: PreparedLeg) -> MethodRun:
    """Return a method's run with the errors that its own model does not hold."""
    result = upright(held_steps(held(run.result, prepared), prepared), prepared)
    about = (*prepared.about_alignment, *prepared.of_ends) if result.name == 'two_point' else ()
    return run._replace(result=replace(result, reasons=(*about, *result.reasons)))


def _guarded(name: str, prepared: PreparedLeg, work: Callable[[], MethodRun]) -> MethodRun:
    inputs = prepared.inputs
    try:
        # divergence is detected by non-finite numbers, not by warnings
        with raised_if_wild():
            return work()
    except (OdocalError, MemoryError):
        raise
    except FloatingPointError as error:
        return MethodRun(UNKNOWN[name](inputs, Reason(
            Code.NOT_CONVERGED, f'{name} diverged ({error}). Likely cause: invalid or missing '
            'samples')))
    except Exception as error:      # what it said of the data may be as wrong: nothing of it stays
        return MethodRun(failed(lambda why: UNKNOWN[name](inputs, why), name, error))
