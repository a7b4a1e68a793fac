# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
ROS parameters of the nodes: settings, checked, and the result as ``result.*``.

In: the overrides of a node (command line, YAML). Out: its configuration, and the result of an
earlier session if ``result.*`` are among them: so a saved calibration.yaml restores it.
"""

from collections.abc import Callable, Iterable
import difflib
import math
from operator import attrgetter
from typing import Any

from rcl_interfaces import msg
from rclpy.exceptions import InvalidParameterTypeException, ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from odocal_ros.calib.result import Calibration, Estimate
from odocal_ros.errors import BadConfig
from odocal_ros.live.session import RestoredResult
from odocal_ros.output.stored import check_estimate
from odocal_ros.reasons import Verdict
from odocal_ros.safe_io.text_formats import one_line
from odocal_ros.settings.config import Config, SETTINGS, settings_of, with_settings
from odocal_ros.settings.setting import REMOVED_GROUPS, Setting

SCALE_UNIT = 'm/pulse, m/rad or 1'      # by the kind of odometer
# estimates in ``result.*`` of the calibrator, and their units
ESTIMATE_UNITS = {
    'scale_factor': SCALE_UNIT, 'scale_ratio': '1', 'yaw_mounting_angle': 'rad',
    'pitch_mounting_angle': 'rad', 'scale_factor_left': SCALE_UNIT,
    'scale_factor_right': SCALE_UNIT, 'track_width': 'm'}
# those in ``result.*`` of the odometry node, which restores more of a calibration
ODOMETRY_UNITS = ESTIMATE_UNITS | {'scale_factor_as_sent': SCALE_UNIT} | {
    f'gyro_bias_{axis}': 'rad/s' for axis in 'xyz'} | {
    f'odometer_lever_arm_{axis}': 'm' for axis in 'xyz'}
PREFIX = 'result.'
# format: values that rclpy accepts for each policy in an override of QoS; (): a whole number
QOS_VALUES: dict[str, tuple[str, ...]] = {
    'reliability': ('reliable', 'best_effort', 'system_default', 'best_available'),
    'history': ('keep_last', 'keep_all', 'system_default'), 'depth': ()}
UNKNOWN_DATE = 'an unknown date'
FILE_REMEDY = 'load the unedited file written by ~/save'


def _result_defaults(names: Iterable[str]) -> dict[str, Any]:
    numbers: dict[str, Any] = {
        PREFIX + name + end: math.nan for name in names for end in ('', '_sigma')}
    return numbers | {PREFIX + 'legs': 0, PREFIX + 'valid': False, PREFIX + 'stamp': '',
                      PREFIX + 'vehicle': ''}


RESULTS = _result_defaults(ESTIMATE_UNITS)


def descriptor(setting: Setting) -> msg.ParameterDescriptor:
    """
    Return the descriptor of a setting.

    Limits that rclpy cannot check (arrays, choices, NaN as default) are only text here; the on-set
    callback checks them. Lists that may be empty are typed dynamically: an empty list in YAML has
    no type. Settings fixed at start-up are not declared read-only: the on-set callback refuses
    them with a remedy, rclpy without.
    """
    text = f'{setting.about} [{setting.unit}]' if setting.unit else setting.about
    text += ' Fixed at start-up.' if setting.read_only else ''
    result = msg.ParameterDescriptor(description=text)
    result.dynamic_typing = setting.kind in ('floats', 'strs') and not (
        setting.read_only and setting.default)
    limits = []
    if setting.choices:
        limits.append('one of ' + ', '.join(setting.choices))
    if setting.low is not None and setting.high is not None:
        limits.append(f'{setting.low:g} to {setting.high:g}')
        if setting.kind == 'int':
            result.integer_range = [msg.IntegerRange(from_value=setting.low,
                                                     to_value=setting.high)]
        elif setting.kind == 'float' and not math.isnan(setting.default):
            result.floating_point_range = [msg.FloatingPointRange(
                from_value=float(setting.low), to_value=float(setting.high))]
    if setting.kind == 'floats':
        limits.append('0 or 4 values' if not setting.default else f'{len(setting.default)} values')
    result.additional_constraints = '; '.join(limits)
    return result


def declare_settings(node: Node, kind: type = Config) -> Any:
    """Declare all settings, return the configuration; raise BadConfig for a wrong override."""
    values, settings = {}, settings_of(kind)
    for name, setting in settings.items():
        default = setting.default
        if setting.kind in ('floats', 'strs'):
            default = list(default) or None      # None: rclpy reads an empty list as bytes
        try:
            value = node.declare_parameter(name, default, descriptor(setting)).value
            if value is None:
                array = 'STRING_ARRAY' if setting.kind == 'strs' else 'DOUBLE_ARRAY'
                node.set_parameters([Parameter(name, Parameter.Type[array], [])])
        except ParameterException as error:
            text = ' '.join(str(error).split()).removesuffix(f': {name}').split('Reason: ')[-1]
            is_whole = setting.kind in ('float', 'floats') and isinstance(
                error, InvalidParameterTypeException)
            remedy = ('write it as a decimal number such as 3.0' if is_whole else
                      'correct the parameter and restart')
            raise BadConfig(f'{text}; {remedy}') from None
        values[name] = setting.default if value is None else _python_value(value)
    _warn_of_unknown(node, settings)
    return with_settings(kind(), values)


def _warn_of_unknown(node: Node, settings: dict[str, Setting]) -> None:
    """Warn of overrides that ROS ignores: unknown ones in a group or with a similar name."""
    groups = REMOVED_GROUPS | {name.partition('.')[0] for name in settings if '.' in name}
    for name in getattr(node, '_parameter_overrides', {}):  # rclpy has no public access to them
        group, dot, _ = name.partition('.')
        similar = difflib.get_close_matches(name, settings, 1, 0.8)
        if name not in settings and (similar or dot and group in groups):
            suggestion = f': did you mean {similar[0]}?' if similar else '.'
            node.get_logger().warning(f'no parameter {name}{suggestion} It is ignored.')


def check_qos(node: Node, topics: Iterable[str]) -> None:
    """Raise BadConfig for QoS overrides that rclpy refuses, but not before the subscription."""
    overrides = getattr(node, '_parameter_overrides', {})
    for topic in topics:
        for policy, allowed in QOS_VALUES.items():
            name = f'qos_overrides.{topic}.subscription.{policy}'
            value = overrides[name].value if name in overrides else None
            is_depth = policy == 'depth' and type(value) is int and 0 < value < 2**31
            if value is not None and not is_depth and value not in allowed:
                requirement = (f'one of {", ".join(allowed)}' if allowed else
                               'a whole number above 0')
                raise BadConfig(f'{name}: {value!r} is not {requirement}; correct the parameter '
                                'and restart')


def with_parameters(config: Config, parameters: list[Parameter]) -> Config:
    """Return config with the settings among the parameters applied and checked."""
    return with_settings(config, {
        p.name: _python_value(p.value) for p in parameters if p.name in SETTINGS})


def change_refusal(config: Config, results: dict[str, Any], parameters: list[Parameter]) -> str:
    """Return the refusal of parameters that only the node or its start may set, or ''."""
    for parameter in parameters:
        name, value, result = parameter.name, parameter.value, results.get(parameter.name)
        if name in RESULTS and not (value == result or str(value) == str(result) == 'nan'):
            return (f'{name} is set by the node after each leg; to restore a result, start the '
                    'node with --params-file calibration.yaml')
        if name in SETTINGS and SETTINGS[name].read_only and (
                _python_value(value) != attrgetter(name)(config)):
            return (f'{name} is fixed at start-up: restart the node with '
                    f'"--ros-args -p {name}:=VALUE"')
    return ''


def refuse_after_start(kind: type) -> Callable[[list[Parameter]], msg.SetParametersResult]:
    """Return the on-set callback of a node that reads its settings, a ``kind``, at start-up."""
    def refuse(parameters: list[Parameter]) -> msg.SetParametersResult:
        names = [p.name for p in parameters
                 if p.name.startswith(PREFIX) or p.name in settings_of(kind)]
        return msg.SetParametersResult(successful=not names, reason=(
            f'{names[0]} is only read at start-up: restart the node with it') if names else '')
    return refuse


def declare_results(node: Node, units: dict[str, str] = ESTIMATE_UNITS) -> RestoredResult | None:
    """Declare ``result.*``; return the result in overrides, if any; units : by estimate."""
    for name, default in _result_defaults(units).items():
        unit = units.get(name.removeprefix(PREFIX).removesuffix('_sigma'), '')
        value = node.declare_parameter(name, default, msg.ParameterDescriptor(
            dynamic_typing=True, description=(
                'Set by the node after each leg' + (f' [{unit}]' if unit else '')))).value
        kind = type(default)
        is_whole = kind is float and type(value) is int
        if type(value) is not kind and not is_whole:
            raise BadConfig(f'{name}: {value!r} is not of type {kind.__name__}; {FILE_REMEDY}')
        if is_whole:
            node.set_parameters([Parameter(name, value=float(value))])
    result = restored_from({name: node.get_parameter(name).value
                            for name in _result_defaults(units)}, units)
    vehicle = node.get_parameter('vehicle').value
    if result is not None and result.vehicle and vehicle and result.vehicle != vehicle:
        raise BadConfig(f"the result belongs to vehicle '{one_line(result.vehicle)}', but this "
                        f"node to '{one_line(vehicle)}': give the calibration.yaml of this "
                        'vehicle, or none')
    return result


def result_values(calibration: Calibration, stamp: str, vehicle: str) -> dict[str, Any]:
    """Return the parameters ``result.*`` of a calibration; NaN for what it does not determine."""
    values = RESULTS | {
        PREFIX + 'legs': len(calibration.legs), PREFIX + 'stamp': stamp,
        PREFIX + 'valid': calibration.verdict is not Verdict.REJECTED, PREFIX + 'vehicle': vehicle}
    for name in ESTIMATE_UNITS:
        estimate = calibration.estimates.get(name) or Estimate(None, None, '')
        for key, number in ((name, estimate.value), (f'{name}_sigma', estimate.sigma)):
            values[PREFIX + key] = math.nan if number is None else float(number)
    return values


def restored_from(results: dict[str, Any],
                  units: dict[str, str] = ESTIMATE_UNITS) -> RestoredResult | None:
    """Return the result in ``result.*``, None without one; raise BadConfig if it is impossible."""
    legs, stamp = results[PREFIX + 'legs'], results[PREFIX + 'stamp']
    if legs < 0:
        raise BadConfig(f'result.legs is {legs}; it must be 0 or more; {FILE_REMEDY}')
    if one_line(stamp) != stamp:
        raise BadConfig(f"result.stamp: '{one_line(stamp)}' is not a date; {FILE_REMEDY}")
    estimates = {}
    for name, unit in units.items():
        value, sigma = (None if math.isnan(x) else x for x in (
            results[PREFIX + name], results[PREFIX + name + '_sigma']))
        try:
            check_estimate(name, value, sigma)
        except ValueError as error:
            raise BadConfig(f'{error}; {FILE_REMEDY}') from None
        estimates[name] = Estimate(value, sigma, '1' if unit == SCALE_UNIT else unit)
    if all(estimate.value is None for estimate in estimates.values()):
        return None
    return RestoredResult(estimates, legs, results[PREFIX + 'valid'], stamp or UNKNOWN_DATE,
                          results[PREFIX + 'vehicle'])


def _python_value(value: Any) -> Any:
    """Return a parameter's value, an array as a tuple."""
    return value if value is None or isinstance(value, int | float | str) else tuple(value)
