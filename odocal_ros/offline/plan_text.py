# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Text of odocal plan: sigmas, budgets and improvements of a planned drive as one screen."""

import math

from odocal_ros.calib.number_text import significant
from odocal_ros.forecast.planned_methods import Plan, SWAY_RATE, WHITE_SIGMA_SHARE
from odocal_ros.library.plan import Planned, SCALE, YAW
from odocal_ros.library.plan_indoor import PlannedRun, SHOWN
from odocal_ros.output import value_text as texts
from odocal_ros.output.tables import budget_lines


def screen(planned: Planned) -> str:
    return '\n'.join([*_drive_lines(planned), '', *_sigma_lines(planned), '',
                      *_budget_lines(planned), *_improvement_lines(planned),
                      *_reason_lines(planned)])


def indoor_screen(runs: list[PlannedRun]) -> str:
    robot, method = runs[0].robot, runs[0].method
    names = [name for name in SHOWN if name in method.estimates
             and not (name == 'yaw_mounting_angle' and method.name == 'planar')]
    drift = (f', correlated errors {1000 * robot.drift_sigma:.2g} mm '
             f'(correlation length {robot.drift_length:g} m)' if robot.drift_sigma else '')
    where = ' at standstills' if robot.at_rests else f' at {robot.position_rate:g} Hz'
    lines = [f'{robot.drive}, {robot.wheels} wheels, {"with" if robot.imu else "without"} an IMU; '
             f'method {method.name}',
             f'position sigma {1000 * robot.position_sigma:.2g} mm{where}{drift}; wheel slip '
             f'{1000 * robot.slip:.2g} mm/√s', '']
    heads = ['scale', 'right / left', *(SHOWN[name] for name in names[1:])]
    widths = (28, *(max(len(head) + 3, 11) for head in heads))
    lines.append(texts.table_row(('predicted sigma', *heads), widths))
    for run in runs:
        name = f'{run.name}, {run.motion.distance:.0f} m, {run.motion.t[-1]:.0f} s'
        sigmas = [run.sigma(quantity) for quantity in (names[0], 'ratio', *names[1:])]
        lines.append(texts.table_row((name, *(_indoor_sigma(sigma, head) for sigma, head in zip(
            sigmas, heads, strict=True))), widths))
    for reason in dict.fromkeys(runs[0].method.reasons if len(runs) == 1 else ()):
        if reason.code.name.endswith(('_NOT_DETERMINED', '_SEPARABLE')):
            lines += ['', *texts.wrapped(f'{reason}. {reason.remedy}')]
    return '\n'.join(lines)


def _indoor_sigma(sigma: float | None, head: str) -> str:
    if sigma is None:
        return '-'
    return f'{math.degrees(sigma):.2g} deg' if head == 'yaw' else f'{100 * sigma:.2g} %'


def _drive_lines(plan: Planned) -> list[str]:
    sigmas, two_point = plan.sigmas, plan.two_point
    alignment, tau = two_point.alignment, sigmas.correlation_time
    at_start, at_end = (f'standing {texts.duration_text(rest)}' if rest else 'in motion'
                        for rest in two_point.rests)
    noise = f'correlation time {tau:g} s' if tau else 'white'
    lines = [f'{texts.length_text(two_point.distance)} in '
             f'{texts.duration_text(two_point.duration)}, {at_start} at the start mark, {at_end} '
             f'at the end mark; marks {texts.length_text(two_point.chord)} apart',
             f'IMU grade {sigmas.config.imu.grade}, heading from {alignment.heading_source} '
             f'(sigma {math.degrees(alignment.heading_sigma):.3g} deg), fix sigma '
             f'{sigmas.fix:.3g} m at {sigmas.fix_rate:.3g} Hz, {noise}']
    if 'smoother' in plan.methods:
        slip = 1000 * sigmas.slip
        is_estimated = alignment.heading_source in ('course', 'gyrocompass')
        no_heading_text = ' estimates the heading;' * is_estimated
        white = f'; white part of the fix errors {100 * WHITE_SIGMA_SHARE:.0f} %' if tau else ''
        lines.append(f'smoother:{no_heading_text} wheel slip {slip:.2g} mm/√s, sway '
                     f'{sigmas.sway:.2g} m/s (white at {SWAY_RATE:g} Hz){white}')
    return lines


def _sigma_lines(plan: Plan) -> list[str]:
    rows = [('predicted sigma', 'scale', 'yaw', 'pitch'), *(
        (name, *(_sigma_text(parameter, method.estimates[parameter].sigma)
                 for parameter in texts.MAIN_VALUES))
        for name, method in plan.methods.items())]
    widths = 20, 14, 16, 16
    return [*(texts.table_row(row, widths) for row in rows),
            f'  (result: {_method_text(plan)})']


def _method_text(plan: Plan) -> str:
    by_method: dict[str | None, list[str]] = {}
    for parameter, label in texts.MAIN_VALUES.items():
        by_method.setdefault(plan.method_of(parameter), []).append(label)
    return ', '.join(f'{" and ".join(labels) if len(by_method) > 1 else "all values"} '
                     f'{"from " + method if method else "not determined"}'
                     for method, labels in by_method.items())


def _sigma_text(parameter: str, sigma: float | None) -> str:
    if sigma is None:
        return 'not determined'
    return (texts.relative_text(sigma) if parameter == SCALE
            else f'{significant(math.degrees(sigma))} deg')


def _budget_lines(plan: Plan) -> list[str]:
    """Return the main error sources of each method that gives a value of the result."""
    budgets = []
    min_share = 0.01    # share of the variance from which a source has its row
    for name in plan.methods_used:
        method = plan.methods[name]
        hidden = [parameter for parameter in texts.MAIN_VALUES
                  if method.estimates[parameter].sigma is None]
        lines = budget_lines(method.details.get('budget'), 1.0, min_share, hidden)
        if lines and len(plan.methods) > 1:
            lines[0] = lines[0].replace(f'{"error budget":<20}', f'{"budget, " + name:<20}')
        budgets += [*lines, ''] if lines else []
    return budgets


def _improvement_lines(plan: Planned) -> list[str]:
    lines = []
    for parameter in (SCALE, YAW):
        best, label = plan.best_improvements(parameter), texts.MAIN_VALUES[parameter]
        lines.append(f'  largest improvements of the {label}' if best else
                     f'  no tested change improves the {label}')
        lines += [f'    {change.text:<58}{_sigma_text(parameter, plan.sigma(parameter)):>10} -> '
                  f'{_sigma_text(parameter, change.sigmas[parameter])}' for change in best[:4]]
    return lines


def _reason_lines(plan: Plan) -> list[str]:
    lines = []
    for reason in plan.reasons:
        lines += texts.wrapped(f'{reason}. {reason.remedy}', hanging='   ', width=96)
    return ['', *lines] if lines else []
