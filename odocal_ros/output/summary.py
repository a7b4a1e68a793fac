# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A calibration as text: one screen for a terminal, one sentence for an answer."""

from datetime import datetime, UTC
import math
import textwrap

import numpy as np

from odocal_ros.calib import result
from odocal_ros.calib.choice import leg_estimates, PLANAR
from odocal_ros.output import tables, value_text as texts
from odocal_ros.reasons import Verdict

DEG = math.degrees(1.0)    # definition
SIDE_TEXTS = {'lateral': ('left', 'right'), 'forward': ('ahead', 'behind')}    # positive, negative
ARMS = {'odometer_lever_arm': 'odometer at', 'antenna_lever_arm': 'antenna at'}
BIASES = tuple(f'gyro_bias_{axis}' for axis in 'xyz')
DEG_PER_HOUR = DEG * 3600    # definition
LABEL_WIDTH = 19      # judgement: columns of the label of a value
MEANING = {Verdict.ACCEPTED: 'ready to use', Verdict.CAUTION: 'usable; read the warnings first',
           Verdict.REJECTED: 'do not use these values'}


def screen(calibration: result.Calibration, styled: bool = False, width: int = texts.WIDTH,
           rows: int | None = None, brief: bool = False) -> str:
    """
    Return the summary of a calibration as plain text.

    calibration : of all legs.   styled : the verdict in bold and in colour, for a terminal.
    width : columns; below 98 redundant or less useful parts are omitted.   rows : lines of the
    screen. If they are too few, small errors, notes and the whole budget are omitted, in this
    order; verdict, values and actions are not.   brief : omit these, and tables of legs and
    methods that repeat the values.
    """
    for omitted in (3,) if brief else range(4):      # number of kinds of parts that are omitted
        parts = [_head_lines(calibration, styled), _value_lines(calibration, width),
                 [] if brief and len(calibration.legs) == 1 else _leg_table(calibration.legs,
                                                                            width),
                 [] if brief else tables.method_lines(calibration),
                 tables.search_lines(calibration.legs),
                 tables.track_lines(calibration.legs, width),
                 _budget_lines(calibration, width, name_small=omitted < 1) if omitted < 3 else [],
                 texts.reason_lines(calibration.reasons, width, brief=omitted > 1)]
        text = '\n\n'.join('\n'.join(part) for part in parts if part)
        if rows is None or text.count('\n') < rows:
            break
    return text


def sentence(calibration: result.Calibration) -> str:
    """Return the result as one line: verdict, values with sigma, legs."""
    used = sum(leg.verdict is not Verdict.REJECTED for leg in calibration.legs)
    legs = f'{used} of {texts.counted(len(calibration.legs), "leg")} usable'
    return f'{calibration.verdict.value}: {values_in_words(calibration.estimates)}; {legs}'


def values_in_words(estimates: dict[str, result.Estimate]) -> str:
    """Return scale, angles and, if known, wheel factors and track width, with sigmas."""
    scale = texts.finite_estimate(estimates, 'scale_factor')
    parts = ['scale factor not determined']
    if scale.value is not None:
        counts = f' ({texts.inverse_text(scale)})' if scale.unit in texts.COUNTS else ''
        parts = [f'scale factor {texts.with_unit(scale)}{counts}']
    labels = {name: name.removeprefix(result.WHEEL_PREFIX)
              for name in result.wheel_factors(estimates)}
    for name, label in (labels | {'track_width': 'track width'}).items():
        wheel = texts.finite_estimate(estimates, name)
        if wheel.value is not None:
            parts.append(f'{label} {texts.with_unit(wheel)}')
    for name, label in _angles_of(estimates).items():
        angle = texts.finite_estimate(estimates, name)
        parts.append(f'{label} mounting {texts.angle_text(angle)}')
    return ', '.join(parts)


def _head_lines(calibration: result.Calibration, styled: bool) -> list[str]:
    verdict = calibration.verdict.value.upper()
    if styled:
        colours = {Verdict.ACCEPTED: 32, Verdict.CAUTION: 33, Verdict.REJECTED: 31}
        verdict = f'\x1b[1;{colours[calibration.verdict]}m{verdict}\x1b[0m'
    return [f'{verdict}: {MEANING[calibration.verdict]}', driven_text(calibration.legs)]


def driven_text(legs: tuple[result.LegResult, ...]) -> str:
    """Return the number of legs, their length and duration, as text."""
    distance = texts.length_text(sum(leg.distance for leg in legs))
    duration = texts.duration_text(sum(leg.duration for leg in legs))
    return f'{texts.counted(len(legs), "leg")}, {distance} in {duration}'


def _value_lines(calibration: result.Calibration, width: int) -> list[str]:
    estimates, local = calibration.estimates, result.has_local_fixes(calibration.legs)
    wheels, rotation = _wheel_lines(estimates), rotation_text(calibration, width)
    lines = _scale_lines(calibration)
    for name, label in _angles_of(estimates).items():
        angle = texts.finite_estimate(estimates, name)
        rad = '' if angle.value is None or width < texts.WIDTH else (
            f'   ({texts.with_sigma(angle.value, angle.sigma, signed=True)} rad)')
        lines.append(_line(f'{label} mounting', texts.angle_text(angle) + rad))
    lines += [*_largest_error_lines(calibration, width), *wheels.values(),
              *_other_lines(estimates, wheels),
              *(_lever_arm_line(estimates, name, result.name_antenna(label, local), width)
                for name, label in ARMS.items()),
              _gyro_scale_line(calibration), _gyro_bias_line(estimates),
              rotation and _line('IMU on the vehicle', rotation)]
    return [line for line in lines if line]


def _scale_lines(calibration: result.Calibration) -> list[str]:
    """Return the lines of the scale factor, its ratios and its inverse."""
    scale, ratio, raw = (texts.finite_estimate(calibration.estimates, name) for name in (
        'scale_factor', 'scale_ratio', result.RAW_SCALE))
    lines = [_line('scale factor', _scale_text(scale))]
    if scale.value and scale.unit in texts.COUNTS:
        lines.append(_line('', texts.inverse_text(scale)))
    if ratio.value is not None:
        lines.append(_line('  ratio to nominal', f'{texts.with_sigma(ratio.value, ratio.sigma)}   '
                           f'({texts.deviation_text(ratio.value, ratio.sigma)})'))
    if raw.value is not None:
        lines.append(_line('  of the raw speed', _scale_text(raw)))
    return [*lines, _path_ratio_line(calibration, scale, raw)]


def _other_lines(estimates: dict[str, result.Estimate], wheels: dict[str, str]) -> list[str]:
    """Return the lines of estimates without a format of their own, such as delays."""
    lines = []
    for name in estimates:
        estimate = texts.finite_estimate(estimates, name)
        quantity = name.rpartition('_')[0]      # without the axis
        if name not in ('scale_factor', 'scale_ratio', result.RAW_SCALE, *texts.ANGLES, *BIASES,
                        *wheels) and quantity not in ARMS and estimate.value is not None:
            lines.append(_line(tables.source_label(name), texts.with_unit(estimate)))
    return lines


def _gyro_bias_line(estimates: dict[str, result.Estimate]) -> str:
    """Return the line of the gyro bias, empty if an axis is not known."""
    biases = [texts.finite_estimate(estimates, name) for name in BIASES]
    values = ', '.join(texts.with_sigma(bias.value, bias.sigma, DEG_PER_HOUR, signed=True)
                       for bias in biases)
    is_known = all(bias.value is not None for bias in biases)
    return _line('gyro bias x, y, z', f'{values} deg/h') if is_known else ''


def rotation_text(calibration: result.Calibration, width: int = texts.WIDTH) -> str:
    """Return roll, pitch and yaw of the IMU on the vehicle, empty without them."""
    angles = ', '.join(f'{angle * DEG:z.3f}' for angle in calibration.imu_rotation_rpy or ())
    note = f'   ({not_estimated(calibration)} as configured)' * (width >= texts.WIDTH)
    return angles and f'roll, pitch, yaw {angles} deg{note}'


def not_estimated(calibration: result.Calibration) -> str:
    """Return the mounting angles that are not estimated; the roll never is."""
    pitch = texts.finite_estimate(calibration.estimates, 'pitch_mounting_angle').value
    return 'roll and pitch' if pitch is None else 'roll'


def _angles_of(estimates: dict[str, result.Estimate]) -> dict[str, str]:
    """Return the mounting angles that the method estimates; the planar method estimates none."""
    method = texts.finite_estimate(estimates, 'scale_factor').method
    return {} if method == PLANAR else texts.ANGLES


def _wheel_lines(estimates: dict[str, result.Estimate]) -> dict[str, str]:
    """Return factor -> line of the wheel, and position -> '', for more than two wheels."""
    lines: dict[str, str] = {}
    for name in result.wheel_factors(estimates):
        wheel = name.removeprefix(result.WHEEL_PREFIX)
        positions = {f'{axis}_position_{wheel}': sides for axis, sides in SIDE_TEXTS.items()}
        if any(position in estimates for position in positions):
            places = [f'{abs(place.value):.3f} m {sides[place.value < 0]}'
                      for position, sides in positions.items()
                      if (place := texts.finite_estimate(estimates, position)).value is not None]
            text = '   '.join((texts.with_unit(estimates[name]), *places))
            lines |= dict.fromkeys(positions, '') | {name: _line(f'wheel {wheel}', text)}
    return lines


def _path_ratio_line(calibration: result.Calibration, scale: result.Estimate,
                     raw: result.Estimate) -> str:
    """Return the line that compares the path ratio of the legs with the scale factor."""
    ratios = [(leg.path_ratio, leg.distance) for leg in calibration.legs if leg.path_ratio]
    path = sum(distance for _, distance in ratios)
    factor, label = (
        (scale, 'scale factor') if raw.value is None else (raw, 'factor of the raw speed'))
    if not factor.value or not path:
        return ''
    ratio = sum(leg_ratio * distance for leg_ratio, distance in ratios) / path
    unit = '' if scale.unit == '1' else f' {scale.unit}'
    four_digits = f'{ratio:.{max(0, 3 - int(np.floor(np.log10(ratio))))}f}'
    return _line('  path ratio', f'{four_digits}{unit}   fixes / odometer, '
                 f'{100 * (ratio / factor.value - 1):+z.1f} % from the {label}')


def _gyro_scale_line(calibration: result.Calibration) -> str:
    """Return the factor for the yaw rate of the gyro, '' if it is near 1."""
    scale = texts.finite_estimate(calibration.estimates, 'scale_factor')
    method = calibration.methods.get(scale.method)
    error = method.details.get('gyro_scale_z') if method else None
    min_error = 0.005    # also of cheap gyros: their data sheets allow 1 %
    if not error or abs(error['value']) < max(min_error, 3 * error['sigma']):
        return ''
    return _line('gyro scale z', texts.with_sigma(1 - error['value'], error['sigma']))


def _lever_arm_line(estimates: dict[str, result.Estimate], arm: str, label: str,
                    width: int) -> str:
    """Return the line with the known coordinates of a lever arm, '' without any."""
    coordinates = {axis: texts.finite_estimate(estimates, f'{arm}_{axis}') for axis in 'xyz'}
    known = {axis: length for axis, length in coordinates.items() if length.value is not None}
    lengths = ', '.join(texts.with_sigma(length.value, length.sigma, signed=True)
                        for length in known.values())
    note = '   (assumes no sideslip)' * (arm.startswith('odometer') and width >= texts.WIDTH)
    axes = ', '.join(known)
    if len(f'{label} {axes}') > LABEL_WIDTH:
        lengths = f'{axes}: {lengths}'
    else:
        label = f'{label} {axes}'
    return _line(label, f'{lengths} m{note}') if known else ''


def _largest_error_lines(calibration: result.Calibration, width: int) -> list[str]:
    """Return the largest error source of scale, yaw and pitch as lines; none without sources."""
    largest = []
    for name, short_name in texts.MAIN_VALUES.items():
        estimate = texts.finite_estimate(calibration.estimates, name)
        source, share = tables.largest_source(calibration.methods.get(estimate.method), name)
        if source and estimate.value is not None:
            label = tables.source_label(source, result.has_local_fixes(calibration.legs))
            largest.append(f'{short_name}: {label} ({100 * share:.0f} %)')
    # lines are broken between the values only; 3: indent, and space after the label
    lines = textwrap.wrap('; '.join(largest).replace(' ', '\xa0').replace(';\xa0', '; '),
                          width - LABEL_WIDTH - 3)
    return [_line('' if k else 'largest error', line.replace('\xa0', ' '))
            for k, line in enumerate(lines)]


def _line(label: str, text: str) -> str:
    return f'  {label:<{LABEL_WIDTH}} {text}'.rstrip()


def _scale_text(scale: result.Estimate) -> str:
    if scale.value is None:
        return 'not determined'
    relative = scale.relative_sigma
    return texts.with_unit(scale) + (f'   ({texts.relative_text(relative)})' if relative else '')


def _leg_table(legs: tuple[result.LegResult, ...], width: int) -> list[str]:
    if not legs:
        return []
    is_wide = width >= texts.WIDTH
    rows = [{'leg': str(number), **_leg_cells(leg, is_wide), 'verdict': verdict}
            for number, (leg, verdict) in enumerate(
                zip(legs, tables.leg_verdicts(legs), strict=True), 1)]
    heads = [head for head in rows[0] if is_wide or head not in ('min:s', 'fixes')]
    return texts.table_lines([heads, *([row[head] for head in heads] for row in rows)]) \
        + texts.lines_of_bags(legs, width)


def _leg_cells(leg: result.LegResult, has_date: bool) -> dict[str, str]:
    estimates = leg_estimates(leg)
    scale, yaw = (texts.finite_estimate(estimates, name)
                  for name in ('scale_factor', 'yaw_mounting_angle'))
    started = datetime.fromtimestamp(leg.start_ns // 10**9, UTC)
    minutes, seconds = divmod(round(leg.duration), 60)
    return {'start, UTC': f'{started:%m-%d }' * has_date + f'{started:%H:%M:%S}',
            'distance': texts.length_text(leg.distance), 'min:s': f'{minutes}:{seconds:02d}',
            'fixes': str(leg.fixes), 'scale factor': tables.cell(scale),
            'yaw, deg': tables.cell(yaw, DEG, signed=True)}


def _budget_lines(calibration: result.Calibration, width: int, name_small: bool) -> list[str]:
    """Return the lines of the error budget of the method that gives the scale."""
    estimates = calibration.estimates
    scale = texts.finite_estimate(estimates, 'scale_factor')
    method = calibration.methods.get(scale.method)
    if method is None or not scale.value:
        return []
    hidden = {name for name in estimates if texts.finite_estimate(estimates, name).value is None}
    min_share = 0.01    # of a variance: smaller sources have no line
    return tables.budget_lines(method.details.get('budget'), scale.value, min_share, hidden,
                               width, name_small, result.has_local_fixes(calibration.legs))
