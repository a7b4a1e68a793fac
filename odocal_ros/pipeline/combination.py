# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Combination of the results of legs to a calibration: usable legs, methods, values, reasons."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import chain
import math
from operator import attrgetter
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.choice import choose, leg_estimates, relevant_reasons
from odocal_ros.calib.combine import combine_method
from odocal_ros.calib.marginal_information import CarriedInformation
from odocal_ros.calib.result import Calibration, Estimate, has_local_fixes, LegResult, MethodResult
from odocal_ros.calib.value_limits import check_limits
from odocal_ros.data.arrays import Floats
from odocal_ros.nav.rotations import matrix_from_rpy, quat_from_matrix, rpy_from_matrix, wrap
from odocal_ros.reasons import Code, Reason, rejecting, Verdict
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import DAY_NS, FAULT_SIGMAS, TYRE_SPREAD
from odocal_ros.settings.nominal import nominal_scale

MOUNTING_PLAY = 0.087    # rad, 5 deg, judgement: mountings of one vehicle bend less
MAX_OVERLAP = 0.1        # judgement: share of a leg's time that is also in an earlier leg
# reasons of a single leg that do not hold for several
SINGLE_LEG_CODES = {Code.SCALE_SIGMA_TOO_LARGE, Code.YAW_SIGMA_TOO_LARGE,
                    Code.SCALE_FAR_FROM_NOMINAL}
# the same for legs combined by marginal information: together they may determine more
COMBINED_CODES = {Code.YAW_NOT_DETERMINED, Code.PITCH_NOT_DETERMINED,
                  Code.PARAMETER_NOT_DETERMINED, Code.YAW_FAR_FROM_NOMINAL}
SMOOTHER = 'smoother'      # the method whose legs are combined on their shared constants
ACROSS_LEGS_CODES = {Code.LEGS_DISAGREE, Code.SCALE_CHANGED}


def combine(legs: Sequence[LegResult], config: Config, carried: CarriedInformation | None = None,
            imu: CarriedInformation | None = None) -> Calibration:
    """
    Return the calibration of one vehicle from its legs.

    legs : at least one. Rejected legs are reported and left out, unless all are rejected.
    config : limits, frames.   carried : information of earlier legs on the vehicle, from an
    earlier result.   imu : information of other legs on its IMU, used without ``carried``.
    """
    legs = tuple(legs)
    usable = [leg for leg in legs if leg.verdict is not Verdict.REJECTED]
    overlapping = overlapping_legs(usable)
    usable = [leg for leg in usable if leg not in overlapping]
    used = usable if usable else legs
    method_names = dict.fromkeys(name for leg in used for name in leg.methods)
    carried = carried if carried and _precedes(carried, used) else None
    # the IMU constants must be from other legs than these
    earlier = carried or (imu if imu and not any(
        imu.first_ns <= leg.start_ns <= imu.last_ns for leg in used) else None)
    methods = {name: _combine_method(name, [
        _LegMethod(leg.methods[name], leg.drive_start_ns, number)
        for number, leg in enumerate(legs, 1) if leg in used and name in leg.methods],
        config, earlier, has_local_fixes(used)) for name in method_names}
    with_marginal = {name for leg in used for name, method in leg.methods.items()
                     if method.marginal}
    estimates, estimating_methods = choose(methods, config.method)
    reasons = _leg_reasons(legs, usable, overlapping, estimating_methods, estimates,
                           earlier is not None)
    if estimating_methods:
        method_reasons = [
            reason for name in estimating_methods
            for reason in relevant_reasons(methods[name].reasons, name, estimates)
            if len(legs) == 1 or reason.code in ACROSS_LEGS_CODES
            or name in with_marginal and reason.code in COMBINED_CODES]
        nominal = nominal_scale(config, estimates['scale_factor'].unit)
        reasons = _join_reasons(reasons, (*method_reasons,
                                          *check_limits(estimates, nominal, config)))
    reasons += inconsistent_legs([(i, leg) for i, leg in enumerate(legs, 1) if leg in usable])
    if len(usable) < config.verdict.min_legs and usable:
        reasons.append(Reason(Code.MORE_LEGS_NEEDED, f'{len(usable)} usable leg'
                              f'{"s" * (len(usable) > 1)}; required: {config.verdict.min_legs}'))
    if not estimating_methods and not rejecting(reasons):
        reasons.append(Reason(Code.NO_METHOD, 'no method could be run'))
    quaternion, rpy = _imu_rotation(estimates, used[0].C_bi)
    return Calibration(tuple(reasons), estimates, methods, legs, quaternion, rpy,
                       _information_for_later_legs(methods, usable, carried))


def _join_reasons(reasons: Sequence[Reason], further: Sequence[Reason]) -> list[Reason]:
    """Return reasons, and further ones that are not known and whose code does not reject yet."""
    known = {(reason.code, reason.text) for reason in reasons}
    rejecting_codes = {reason.code for reason in rejecting(reasons)}
    return list(dict.fromkeys([*reasons, *(
        reason for reason in further
        if (reason.code, reason.text) not in known and reason.code not in rejecting_codes)]))


def _precedes(carried: CarriedInformation, legs: Sequence[LegResult]) -> bool:
    """Return True if the information is from earlier legs, in the same unit of the scale."""
    return carried.last_ns < min(leg.start_ns for leg in legs) and all(
        leg.methods[SMOOTHER].estimates['scale_factor'].unit == carried.unit
        for leg in legs if SMOOTHER in leg.methods)


def _information_for_later_legs(methods: Mapping[str, MethodResult], usable: Sequence[LegResult],
                                carried: CarriedInformation | None) -> CarriedInformation | None:
    """Return the information of earlier legs and these for later ones, None without any."""
    combined = methods.get(SMOOTHER)
    times = [leg.start_ns for leg in usable if SMOOTHER in leg.methods
             and leg.methods[SMOOTHER].verdict is not Verdict.REJECTED]
    if combined is None or combined.marginal is None or not times:
        return None
    return CarriedInformation(combined.marginal, combined.estimates['scale_factor'].unit,
                              carried.first_ns if carried else min(times), max(times),
                              len(times) + (carried.legs if carried else 0))


def overlapping_legs(legs: Sequence[LegResult]) -> list[LegResult]:
    """Return the legs that overlap an earlier one by more than MAX_OVERLAP: not independent."""
    independent: list[LegResult] = []
    overlapping: list[LegResult] = []
    for leg in legs:
        shared_ns = [min(leg.stop_ns, earlier.stop_ns) - max(leg.start_ns, earlier.start_ns)
                     for earlier in independent]
        is_overlapping = any(ns > MAX_OVERLAP * (leg.stop_ns - leg.start_ns) for ns in shared_ns)
        (overlapping if is_overlapping else independent).append(leg)
    return overlapping


def combine_results(name: str, results: Sequence[MethodResult], times_ns: Sequence[int],
                    config: Config, numbers: Sequence[int] | None = None,
                    carried: CarriedInformation | None = None,
                    local: bool = False) -> MethodResult:
    """
    Return the result of a method for several legs, combined with earlier ones if possible.

    times_ns : start of the drive of each leg.   numbers : of the legs, for texts; by default from
    1.   carried : information of earlier legs.   local : positions are in a local frame.
    """
    if carried and all(result.marginal for result in results):
        unknown = {parameter: Estimate(None, None, estimate.unit)
                   for parameter, estimate in results[0].estimates.items()}
        results = [MethodResult(name, (), unknown, marginal=carried.marginal), *results]
        numbers = [0, *(numbers or range(1, len(results)))]
        times_ns = [min(carried.last_ns, *times_ns), *times_ns]      # the scale is the last leg's
    if len(results) > 1 and all(result.marginal for result in results):
        from odocal_ros.estimator.several import combine_legs
        return combine_legs(results, times_ns, config, numbers, local)
    ago_ns = max(times_ns) - np.asarray(times_ns)
    drift_variances = config.verdict.scale_drift_per_day**2 * ago_ns / DAY_NS
    return combine_method(name, results, drift_variances)


class _LegMethod(NamedTuple):
    """The result of a method on one leg."""

    result: MethodResult
    start_ns: int    # of the drive of the leg
    number: int      # of the leg, from 1


def _combine_method(name: str, legs: Sequence[_LegMethod], config: Config,
                    carried: CarriedInformation | None, local: bool) -> MethodResult:
    """Return the combination of results that are not rejected, or of all if all are rejected."""
    usable = [leg for leg in legs if leg.result.verdict is not Verdict.REJECTED]
    results, times_ns, numbers = zip(*(usable or legs), strict=True)
    combined = combine_results(name, list(results), times_ns, config, numbers,
                               carried if usable else None, local)
    if usable or len(results) == 1:
        return combined
    rejections = dict.fromkeys(rejecting(chain(*(result.reasons for result in results))))
    return replace(combined, reasons=(*combined.reasons, *rejections))


def _leg_reasons(legs: Sequence[LegResult], usable: Sequence[LegResult],
                 overlapping: Sequence[LegResult], estimating_methods: Sequence[str],
                 estimates: Mapping[str, Estimate], has_earlier: bool) -> list[Reason]:
    """Return the reasons of the legs; has_earlier: the result includes earlier legs."""
    is_single = len(legs) == 1 and not has_earlier
    reasons = []
    for number, leg in enumerate(legs, 1):
        prefix = f'leg {number}: ' if len(legs) > 1 else ''
        methods = [leg.methods[name] for name in estimating_methods if name in leg.methods]
        leg_reasons = [*leg.reasons, *(
            reason for method in methods for reason in relevant_reasons(
                _additional_reasons(method, leg), method.name, estimates)
            if is_single or reason.code not in SINGLE_LEG_CODES
            and not (method.marginal and reason.code in COMBINED_CODES))]
        if leg in overlapping:
            reasons.append(Reason(
                Code.LEGS_OVERLAP, f'{prefix}overlaps an earlier leg by more than '
                f'{100 * MAX_OVERLAP:.0f} % of its duration; not used'))
        elif usable and leg not in usable:
            all_reasons = [*leg.reasons, *(reason for method in leg.methods.values()
                                           for reason in _additional_reasons(method, leg))]
            reasons.append(Reason(Code.LEG_REJECTED, f'{prefix}rejected and not used: '
                                  + _rejection_text(all_reasons)))
        else:
            rejected = [method for method in methods
                        if usable and method.verdict is Verdict.REJECTED]
            reasons += [Reason(Code.LEG_REJECTED, f'{prefix}not used for {method.name}: '
                               + _rejection_text(method.reasons)) for method in rejected]
            reasons += [replace(reason, text=prefix + reason.text) for reason in leg_reasons
                        if not any(reason in method.reasons for method in rejected)
                        and not (rejected and reason.code is Code.METHOD_REJECTED)]
    return reasons


def _additional_reasons(method: MethodResult, leg: LegResult) -> list[Reason]:
    """Return a method's reasons, except those whose code already rejects the leg."""
    known = {reason.code for reason in rejecting(leg.reasons)}
    return [reason for reason in method.reasons if reason.code not in known]


def _rejection_text(reasons: Sequence[Reason]) -> str:
    """Return the texts of the rejecting reasons."""
    return '; '.join(dict.fromkeys(reason.text for reason in rejecting(reasons)))


def _imu_rotation(estimates: Mapping[str, Estimate], C_bi: Floats | None,
                  ) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Return the static rotation base_link <- imu frame, x y z w and rpy, None without a yaw."""
    yaw, pitch = (None if (e := estimates.get(f'{name}_mounting_angle')) is None else e.value
                  for name in ('yaw', 'pitch'))
    if C_bi is None or yaw is None:
        return None, None
    C_vi = matrix_from_rpy([0.0, pitch or 0.0, yaw]) @ C_bi
    return (tuple(float(x) for x in quat_from_matrix(C_vi)),
            tuple(float(x) for x in rpy_from_matrix(C_vi)))


def inconsistent_legs(numbered: Sequence[tuple[int, LegResult]]) -> tuple[Reason, ...]:
    """Return LEGS_UNLIKE if scale or yaw of legs differ by more than those of one vehicle."""
    differences = []
    estimates = [(number, leg_estimates(leg)) for number, leg in numbered]
    scales = [scale for scale in _values_by_leg('scale_factor', estimates) if scale.value]
    units = dict.fromkeys(scale.unit for scale in scales)
    if len(units) > 1:
        legs_by_unit = '; '.join(f'{unit} in leg ' + ', '.join(
            str(s.leg) for s in scales if s.unit == unit) for unit in units)
        return (Reason(Code.LEGS_UNLIKE, 'the odometers have different units, so their scales '
                       f'cannot be combined: {legs_by_unit}'),)
    extremes = _significant_extremes(scales)
    if extremes and (excess := extremes[1].value / extremes[0].value - 1) > TYRE_SPREAD:
        low, high = extremes
        differences.append(f'the scale of leg {high.leg} is {100 * excess:.1f} % above '
                           f'that of leg {low.leg} (limit {100 * TYRE_SPREAD:.0f} %)')
    yaws = _values_by_leg('yaw_mounting_angle', estimates)
    # within half a turn of the first: those of a reversed IMU are near +-180 deg
    extremes = _significant_extremes([yaw._replace(value=float(wrap(yaw.value - yaws[0].value)))
                                      for yaw in yaws])
    if extremes and (excess := extremes[1].value - extremes[0].value) > MOUNTING_PLAY:
        low, high = extremes
        differences.append(f'the yaw mounting of leg {high.leg} is {math.degrees(excess):.1f} deg '
                           f'above that of leg {low.leg} (limit '
                           f'{math.degrees(MOUNTING_PLAY):.0f} deg)')
    return (Reason(Code.LEGS_UNLIKE, f'{" and ".join(differences)}: larger than changes of one '
                   'vehicle with one mounting'),) if differences else ()


class _LegValue(NamedTuple):
    """The estimate of one value by one leg."""

    leg: int    # number of the leg, from 1
    value: float
    sigma: float
    unit: str


def _values_by_leg(name: str,
                   estimates: Sequence[tuple[int, dict[str, Estimate]]]) -> list[_LegValue]:
    """Return the estimates of a value by the legs that determine it."""
    return [_LegValue(number, e.value, e.sigma, e.unit) for number, leg_values in estimates
            if (e := leg_values.get(name)) is not None and e.value is not None
            and e.sigma is not None]


def _significant_extremes(values: list[_LegValue]) -> tuple[_LegValue, _LegValue] | None:
    """Return the lowest and the highest value if they differ significantly."""
    if len(values) < 2:
        return None
    low, *_, high = sorted(values, key=attrgetter('value'))
    sigma = math.hypot(high.sigma, low.sigma)
    return (low, high) if high.value - low.value > FAULT_SIGMAS * sigma else None
