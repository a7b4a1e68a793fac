# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Text of odocal plan: sigmas, budgets and improvements of a planned drive as one screen."""

import math

from odocal_ros.calib.number_text import significant
from odocal_ros.estimator.factors.slow_error import WHITE_SHARE
from odocal_ros.forecast.planned_methods import Plan, SWAY_RATE
from odocal_ros.library.plan import Planned, ranked, SCALE, YAW
from odocal_ros.library.plan_indoor import PlannedRun, SHOWN
from odocal_ros.output.tables import budget_lines
from odocal_ros.output.value_text import (
    duration_text,
    length_text,
    MAIN_VALUES,
    relative_text,
    table_row,
    wrapped,
)


def screen(planned: Planned) -> str:
    return '\n'.join([*_drive_lines(planned), '', *_sigma_lines(planned), '',
                      *_budget_lines(planned), *_improvement_lines(planned),
                      *_reason_lines(planned)])


def indoor_screen(runs: list[PlannedRun]) -> str:
    robot, method = runs[0].robot, runs[0].method
    names = [name for name in SHOWN if name in method.estimates
             and not (name == 'yaw_mounting_angle' and method.name == 'planar')]
    drift = (f', correlated errors {1000 * robot.drift:.2g} mm over {robot.drift_length:g} m'
             if robot.drift else '')
    where = ' at standstills' if robot.at_rests else f' at {robot.rate:g} Hz'
    lines = [f'{robot.drive}, {robot.wheels} wheels, {"with" if robot.imu else "without"} an IMU; '
             f'method {method.name}',
             f'positions {1000 * robot.white:.2g} mm{where}{drift}; wheel slip '
             f'{1000 * robot.slip:.2g} mm/√s', '']
    heads = ['scale', 'right / left', *(SHOWN[name] for name in names[1:])]
    widths = (28, *(max(len(head) + 3, 11) for head in heads))
    lines.append(table_row(('predicted sigma', *heads), widths))
    for one in runs:
        name = f'{one.name}, {one.motion.distance:.0f} m, {one.motion.t[-1]:.0f} s'
        sigmas = [one.sigma(n) for n in (names[0], 'ratio', *names[1:])]
        lines.append(table_row((name, *(_indoor_sigma(sigma, head) for sigma, head in zip(
            sigmas, heads, strict=True))), widths))
    missing = {r.text: r for one in runs for r in one.method.reasons
               if len(runs) == 1 and r.code.name.endswith(('_NOT_DETERMINED', '_SEPARABLE'))}
    for r in missing.values():
        lines += ['', *wrapped(f'{r}. {r.remedy}')]
    return '\n'.join(lines)


def _indoor_sigma(sigma: float | None, head: str) -> str:
    if sigma is None:
        return 'unknown'
    return f'{math.degrees(sigma):.2g} deg' if head == 'yaw' else f'{100 * sigma:.2g} %'


def _drive_lines(plan: Planned) -> list[str]:
    sigmas, two_point = plan.sigmas, plan.two_point
    alignment, tau = two_point.alignment, sigmas.correlation_time
    stands = [f'standing {duration_text(s)}' if s else 'in motion' for s in two_point.standing]
    noise = f'correlation time {tau:g} s' if tau else 'white'
    lines = [f'{length_text(two_point.distance)} in {duration_text(two_point.duration)}, '
             f'{stands[0]} at the start mark, {stands[1]} at the end mark; '
             f'marks {length_text(two_point.chord)} apart',
             f'IMU grade {sigmas.config.imu.grade}, heading from {alignment.heading_source} '
             f'(sigma {math.degrees(alignment.heading_sigma):.3g} deg), fixes {sigmas.fix:.3g} m '
             f'at {sigmas.fix_rate:.3g} Hz, {noise}']
    if 'smoother' in plan.methods:
        slip = 1000 * sigmas.slip
        is_estimated = alignment.heading_source in ('course', 'gyrocompass')
        no_heading_text = ' needs no heading;' * is_estimated
        white = f'; white part of the fix errors {100 * WHITE_SHARE:.0f} %' if tau else ''
        lines.append(f'smoother:{no_heading_text} wheel slip {slip:.2g} mm/√s, sway '
                     f'{sigmas.sway:.2g} m/s (white at {SWAY_RATE:g} Hz){white}')
    return lines


def _sigma_lines(plan: Plan) -> list[str]:
    rows = [('predicted sigma', 'scale', 'yaw', 'pitch'), *(
        (name, *(_sigma_text(p, method.estimates[p].sigma) for p in MAIN_VALUES))
        for name, method in plan.methods.items())]
    return [*(table_row(row, (20, 14, 16, 16)) for row in rows),
            f'  (result: {_method_text(plan)})']


def _method_text(plan: Plan) -> str:
    by_method: dict[str | None, list[str]] = {}
    for parameter, label in MAIN_VALUES.items():
        by_method.setdefault(plan.method_of(parameter), []).append(label)
    return ', '.join(f'{" and ".join(labels) if len(by_method) > 1 else "all values"} '
                     f'{"from " + method if method else "unknown"}'
                     for method, labels in by_method.items())


def _sigma_text(parameter: str, sigma: float | None) -> str:
    if sigma is None:
        return 'unknown'
    return (relative_text(sigma) if parameter == SCALE
            else f'{significant(math.degrees(sigma))} deg')


def _budget_lines(plan: Plan) -> list[str]:
    """Return the main error sources of each method that will provide a value."""
    budgets = []
    min_share = 0.01    # share of the variance from which a source has its row
    for name in plan.methods_used:
        method = plan.methods[name]
        hidden = [p for p in MAIN_VALUES if method.estimates[p].sigma is None]
        lines = budget_lines(method.details.get('budget'), 1.0, min_share, hidden)
        if lines and len(plan.methods) > 1:
            lines[0] = lines[0].replace(f'{"error budget":<20}', f'{"budget, " + name:<20}')
        budgets += [*lines, ''] if lines else []
    return budgets


def _improvement_lines(plan: Planned) -> list[str]:
    lines = []
    for parameter in (SCALE, YAW):
        best, word = ranked(plan.improvements, plan, parameter), MAIN_VALUES[parameter]
        lines.append(f'  largest improvements of the {word}' if best else
                     f'  no tested change improves the {word}')
        lines += [f'    {c.text:<58}{_sigma_text(parameter, plan.sigma(parameter)):>10} -> '
                  f'{_sigma_text(parameter, c.sigmas[parameter])}' for c in best[:4]]
    return lines


def _reason_lines(plan: Plan) -> list[str]:
    lines = []
    for reason in plan.reasons:
        lines += wrapped(f'{reason}. {reason.remedy}', hanging='   ', width=96)
    return ['', *lines] if lines else []
