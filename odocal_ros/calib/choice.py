# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Selection of the method that gives each value: the first in METHOD_ORDER that is not rejected.

The methods on one leg are compared: differences beyond the sigmas, with their likely cause.
"""

from collections.abc import Iterable, Mapping
import math

from odocal_ros.calib.number_text import format_change
from odocal_ros.calib.result import Estimate, LegResult, MethodResult
from odocal_ros.nav.rotations import wrap
from odocal_ros.reasons import Code, Reason, Verdict
from odocal_ros.settings.levels import REMARK_SIGMAS

METHOD_ORDER = ('smoother', 'two_point')
PLANAR = 'planar'        # the only method of legs that the others cannot compute
ALWAYS_COMPUTED = 'two_point'     # for comparison, with every setting: by the operator's marks
# setting ``method``: the method that gives the values, if it has another name
VALUES_FROM = {'patent': 'smoother', 'wheels': 'smoother'}
# method and parameter: without a value there, no other method gives one. The pitch of two_point
# is based on the level by the accelerometer alone
REFUSED_FOR_ALL = 'smoother', 'pitch_mounting_angle'
# value that a reason is about: left out if another method gives the value
REASON_ESTIMATES = {
    Code.SCALE_NOT_DETERMINED: 'scale_factor', Code.SCALE_SIGMA_TOO_LARGE: 'scale_factor',
    Code.SCALE_FAR_FROM_NOMINAL: 'scale_factor',
    Code.YAW_NOT_SEPARABLE: 'yaw_mounting_angle', Code.YAW_NOT_DETERMINED: 'yaw_mounting_angle',
    Code.YAW_SIGMA_TOO_LARGE: 'yaw_mounting_angle',
    Code.YAW_FAR_FROM_NOMINAL: 'yaw_mounting_angle',
    Code.PITCH_NOT_DETERMINED: 'pitch_mounting_angle',
    Code.WHEELS_NOT_SEPARABLE: 'scale_factor_left',
    Code.TRACK_WIDTH_NOT_DETERMINED: 'track_width',
}
# methods are compared as if they were independent: those that share data differ less. Parameter:
# its name in texts, and the likely cause in two_point, the last of METHOD_ORDER
COMPARED = {
    'scale_factor': ('scale', 'slip or bad fixes at one of the marks'),
    'yaw_mounting_angle': ('yaw', 'an error of the configured heading (alignment.heading_source) '
                           'of about this size'),
    'pitch_mounting_angle': ('pitch', 'wrong heights of the fixes at the marks, a slope, or an '
                             'accelerometer bias')}


def deciding_methods(method_setting: str | tuple[str, ...]) -> tuple[str, ...]:
    """Return the methods that may give the result, best first."""
    if not isinstance(method_setting, str):
        return method_setting
    return METHOD_ORDER if method_setting in ('auto', 'all') else (
        VALUES_FROM.get(method_setting, method_setting),)


def computed_methods(method_setting: str) -> set[str]:
    return {*deciding_methods(method_setting), ALWAYS_COMPUTED}


def choose(methods: Mapping[str, MethodResult],
           method_setting: str | tuple[str, ...]) -> tuple[dict[str, Estimate], tuple[str, ...]]:
    """
    Return each parameter from the first method that has it and is not rejected.

    Also returns the names of the methods that gave a value; if none did, the name of the first
    usable one.

    methods : by name.   method_setting : the setting ``method``, or the names of methods.
    """
    results = [methods[name] for name in dict.fromkeys((*deciding_methods(method_setting), PLANAR))
               if name in methods]
    usable = [m for m in results if m.verdict is not Verdict.REJECTED] or results
    estimates: dict[str, Estimate] = {}
    for method in usable:
        for name, estimate in method.estimates.items():
            first = estimates.get(name)
            if first is None or (first.value is None and estimate.value is not None
                                 and (first.method, name) != REFUSED_FOR_ALL):
                estimates[name] = Estimate(estimate.value, estimate.sigma, estimate.unit,
                                           method.name)
    sources = dict.fromkeys(e.method for e in estimates.values() if e.value is not None)
    return estimates, tuple(sources) or tuple(m.name for m in usable[:1])


def rejected_method_reasons(methods: Mapping[str, MethodResult], method_setting: str
                            | tuple[str, ...],
                            stated_codes: Iterable[Code] = ()) -> list[Reason]:
    """Return METHOD_REJECTED of rejected methods better than a usable one, except stated_codes."""
    # a method without its data, such as of a second wheel, is not reported
    results = [methods[name] for name in deciding_methods(method_setting) if name in methods]
    usable = [i for i, m in enumerate(results) if m.verdict is not Verdict.REJECTED]
    causes = [(m.name, next(r for r in m.reasons if r.code.severity is Verdict.REJECTED))
              for m in results[:max(usable, default=0)] if m.verdict is Verdict.REJECTED]
    return [Reason(Code.METHOD_REJECTED, f'{name} is not used, because of {cause}',
                   f'{cause.remedy} The values come from another method, which may not detect '
                   'this problem.')
            for name, cause in causes if cause.code not in (Code.NO_METHOD, *stated_codes)]


def leg_estimates(leg: LegResult) -> dict[str, Estimate]:
    """Return the estimates of a LegResult, each from the method that gives it."""
    return choose(leg.methods, leg.deciding or METHOD_ORDER)[0]


def relevant_reasons(reasons: Iterable[Reason], method: str,
                     estimates: Mapping[str, Estimate]) -> tuple[Reason, ...]:
    """Return a method's reasons, without those about values that another method gives."""
    def is_relevant(parameter: str) -> bool:
        return parameter not in estimates or estimates[parameter].method == method
    return tuple(r for r in reasons if is_relevant(REASON_ESTIMATES.get(r.code, '')))


def disagreements(methods: dict[str, MethodResult]) -> list[Reason]:
    """
    Return METHODS_DISAGREE for each parameter in which the two methods of METHOD_ORDER differ.

    They differ by more than REMARK_SIGMAS of both together; a rejected method is not compared.
    """
    usable = [methods[name] for name in METHOD_ORDER if name in methods
              and methods[name].verdict is not Verdict.REJECTED]
    if len(usable) < len(METHOD_ORDER):
        return []
    (first, second), reasons = usable, []
    for name, (label, cause) in COMPARED.items():
        a, b = (m.estimates.get(name) for m in usable)
        if a is None or b is None or a.value is None or b.value is None \
                or a.sigma is None or b.sigma is None:
            continue
        sigma = math.hypot(a.sigma, b.sigma)
        difference = b.value - a.value
        if name != 'scale_factor':
            difference = float(wrap(difference))
        if abs(difference) > REMARK_SIGMAS * sigma:
            text = (format_change(difference / a.value) if name == 'scale_factor' else
                    f'{math.degrees(difference):+z.3f} deg')
            reasons.append(Reason(
                Code.METHODS_DISAGREE, f'{label}: {second.name} minus {first.name} is {text} '
                f'({abs(difference) / sigma:.1f} sigma; limit {REMARK_SIGMAS:g}); likely cause: '
                f'{cause}'))
    return reasons
