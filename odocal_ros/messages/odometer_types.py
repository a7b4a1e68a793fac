# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Odometer messages: which field has the value, and whether it is a count, an angle or a speed."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from numbers import Integral
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Ints
from odocal_ros.data.inputs import WHEELS
from odocal_ros.data.samples import from_columns, OdometerForm, OdometerSamples, Reading, Samples
from odocal_ros.errors import BadConfig, BadData
from odocal_ros.messages import cdr
from odocal_ros.messages.message_fields import (
    Column,
    MessageView,
    path_parts,
    STAMP,
    stamp_ns,
    View,
)
from odocal_ros.messages.wheel_choice import key_on_side, select_wheels
from odocal_ros.settings.config import Config

JOINTS = 'sensor_msgs/msg/JointState'
TWIST = 'geometry_msgs/msg/Twist'
DEFAULT_FIELD = {
    JOINTS: '',   # position, or velocity if there is no position
    TWIST: 'linear.x',
    f'{TWIST}Stamped': 'twist.linear.x',
    f'{TWIST}WithCovarianceStamped': 'twist.twist.linear.x',
    'nav_msgs/msg/Odometry': 'twist.twist.linear.x',
    'autoware_vehicle_msgs/msg/VelocityReport': 'longitudinal_velocity',
    'autoware_auto_vehicle_msgs/msg/VelocityReport': 'longitudinal_velocity',
    'std_msgs/msg/Int32MultiArray': 'data',
    'std_msgs/msg/Int64MultiArray': 'data',
} | {f'std_msgs/msg/{name}': 'data' for name in cdr.NUMBER_TYPES}
TYPES = tuple(DEFAULT_FIELD)


class OdometerPlan:
    """
    Fields to read from the messages of an odometer topic, and their meaning.

    Some of it is determined by the first message (does a JointState have positions? which of its
    joints are wheels? is a field of an unknown type an integer?): ``complete`` is called with
    messages in order until it returns True.

    wheel_keys : of the wheels in a message, joint names or indices; ('',) for a single value.
    columns : the values to read, () until the plan is complete.   form : their meaning.
    """

    has_readings = True      # messages can be read as plain numbers

    def __init__(self, slot: str, msgtype: str, config: Config) -> None:
        self.slot, self.msgtype, self.odometer = slot, msgtype, config.odometer
        self.is_known_type = msgtype in DEFAULT_FIELD
        self.field = config.odometer.field or DEFAULT_FIELD.get(msgtype, '')
        self.wheel_keys = _configured_wheels(slot, config)
        self.is_stamped = 'string header.frame_id' in cdr.SCHEMAS.get(msgtype, ())
        self.columns: tuple[Column, ...] = ()
        self.form = OdometerForm('cumulative', self.odometer.wrap, 'm/pulse')
        self._unclear_reason = ''       # cause if the last message does not determine the wheels
        self._check_settings()
        has_key = bool(_split_key(self.field)[1] or self.wheel_keys[0])
        self._selects_wheels = self._is_list() and not has_key
        self._fields: tuple[str, ...] = (self.field,)      # the first one with values is used
        if msgtype == JOINTS and not self.field:
            self._fields = {'auto': ('position', 'velocity'), 'rate': ('velocity',)}.get(
                self.odometer.quantity, ('position',))
        if self.is_known_type:
            self.form = self._form_of(self._fields[0], self._value_type(self._fields[0]))
            if len(self._fields) == 1 and not self._selects_wheels:
                self._set_columns(self._fields[0])

    def _check_settings(self) -> None:
        """Raise an error for settings that must fail, before the first message."""
        if not self.is_known_type and not self.field and len(self.wheel_keys) < 2:
            raise BadData(
                f'{self.slot}: {self.msgtype} is not a known odometer type: set '
                f"odometer.field to the path of its value ('ros2 interface show {self.msgtype}' "
                f'lists its fields), or use a topic of type {", ".join(TYPES)}')
        if self.field and not path_parts(self.field):
            raise BadConfig(f'odometer.field: {self.field!r} is not a path such as '
                            'twist.linear.x, data[0] or position[joint]')
        if not self.is_known_type:
            return
        types = _value_types(self.msgtype)
        base, key = _split_key(self.field)
        if self.field and base not in types:
            raise BadData(f'odometer.field: {self.msgtype} has no value {self.field!r}; values: '
                          f'{", ".join(types)}')
        has_several_wheels = len(self.wheel_keys) > 1
        if has_several_wheels and not self._is_list():
            raise BadConfig(f'odometer.wheels: {self.msgtype} holds one value ({self.field}); '
                            "use 'topic' for odometer.left and odometer.right on two topics")
        if self.odometer.field and self._is_list() and not (
                key or has_several_wheels or self.msgtype == JOINTS):
            raise BadConfig(f'odometer.field: {self.field!r} is a list; name one value, such as '
                            f'{base}[0], or set odometer.wheels')

    def _is_list(self) -> bool:
        base, _ = _split_key(self.field)
        return self.is_known_type and (not base or '[' in _value_types(self.msgtype)[base])

    def complete(self, view: View) -> bool:
        """Complete the plan from a message; return False to repeat with the next one."""
        if self.columns:
            return True
        if not self.is_known_type:
            assert isinstance(view, MessageView)
            self._complete_unknown_type(view)
            return True
        for field in self._fields:
            if self._selects_wheels and view.count(field):
                self._select_wheels(field, view)
                return bool(self.columns)
            if not self._selects_wheels and self._paths_of_wheel(field, self.wheel_keys[0])(view):
                self._set_columns(field)
                return True
        return False

    def _select_wheels(self, field: str, view: View) -> None:
        """Select the wheels among the values of a list, by their names."""
        choice = select_wheels(view.names, view.count(field))
        if isinstance(choice, str):
            self._unclear_reason = choice
            return
        keys, is_right = choice.keys, self.slot == WHEELS[1]
        if self.odometer.has_two_topics or is_right:      # one wheel in each topic
            keys = (key_on_side(choice, 'right' if is_right else 'left'),)
            if not keys[0]:
                self._unclear_reason = choice.explanation
                return
        self.wheel_keys = keys
        self._set_columns(field)
        self.form = replace(self.form, sides_known=choice.sides_known,
                            selection_text=choice.explanation)

    def _complete_unknown_type(self, view: MessageView) -> None:
        """Determine columns and meaning of an unknown type from its first message."""
        value = None
        for key in self.wheel_keys:
            path = self._path(self.field, key)
            try:
                value = view.value(path)
            except (AttributeError, LookupError, TypeError) as error:
                raise BadData(f'odometer.field: {self.msgtype} has no value {path!r} ({error}); '
                              f'its fields are {", ".join(view.fields())}') from None
            if not isinstance(value, (Integral, float, np.floating)):
                raise BadData(f'odometer.field: {path!r} of {self.msgtype} is not a number but '
                              f'{type(value).__name__}; name one value, such as path.to.value[0]')
        self.is_stamped = hasattr(view.message, 'header')
        self._set_columns(self.field, 'int64' if isinstance(value, Integral) else 'float64')

    def _set_columns(self, field: str, value_type: str = '') -> None:
        """Set columns and form for a field; ``value_type`` is required for unknown messages."""
        value_type = value_type or self._value_type(field)
        self.form = self._form_of(field, value_type)
        dtype = np.int64 if 'int' in value_type else np.float64
        self.columns = STAMP * self.is_stamped + tuple(
            Column(dtype, 1, self._paths_of_wheel(field, key)) for key in self.wheel_keys)

    def _value_type(self, field: str) -> str:
        """Return the type of the values of a field in a known message, such as 'int32'."""
        return _value_types(self.msgtype)[_split_key(field)[0]].split('[')[0]

    def _form_of(self, field: str, value_type: str) -> OdometerForm:
        """Return the meaning of the values of a field."""
        is_integer = 'int' in value_type
        joint_field = _split_key(field)[0] if self.msgtype == JOINTS else ''
        quantity = self.odometer.quantity
        if quantity == 'auto':
            quantity = 'cumulative' if is_integer or joint_field == 'position' else 'rate'
        modulus = 0
        if is_integer and quantity == 'cumulative':
            modulus = self.odometer.wrap
            if not modulus and self.is_known_type:     # of others the width is not known
                modulus = 2**(8 * np.dtype(cdr.NUMPY_TYPES[value_type]).itemsize)
        unit = ('m/rad' if joint_field in ('position', 'velocity') else
                'm/pulse' if is_integer or quantity != 'rate' else '1')
        return OdometerForm(quantity, modulus, unit)

    def _path(self, field: str, key: str) -> str:
        """Return the path of a wheel's value: a key in the field; without a field, the key."""
        if not key:
            return field
        return f'{_split_key(field)[0]}[{key}]' if field else key

    def _paths_of_wheel(self, field: str, key: str) -> Callable[[View], Sequence[str] | None]:
        """Return a function that returns the paths of a wheel's values in a message."""
        path = self._path(field, key)
        base, key_of_field = _split_key(field)
        if not self.is_known_type or '[' not in _value_types(self.msgtype)[base]:
            return lambda view: (path,)
        key = key or key_of_field     # not by parsing the path: a joint may have any name

        def find_paths(view: View) -> Sequence[str] | None:
            count, names = view.count(base), view.names
            index = names.index(key) if key in names else int(key) if key.isdigit() else count
            return (f'{base}[{index}]',) if index < count else None
        return find_paths

    def missing_reason(self, view: View) -> str:
        """Return the reason why a message has no value, as text."""
        if self._unclear_reason and not self.columns:
            return self._unclear_reason
        wheels = ' and '.join(key for key in self.wheel_keys if key)
        required = wheels or self.field or ' or '.join(self._fields)
        names = f'; names: {", ".join(view.names)}' if view.names else ''
        return f'no {required} in a {self.msgtype}{names}'

    @property
    def _slots(self) -> tuple[str, ...]:
        return WHEELS[:len(self.wheel_keys)] if len(self.wheel_keys) > 1 else (self.slot,)

    def readings(self, received_ns: Sequence[int], values: list[Any]
                 ) -> list[tuple[str, list[Reading]]]:
        """Return (slot, rows in plain numbers) from the values of each message."""
        stamps, first_wheel = received_ns, len(STAMP) * self.is_stamped
        if self.is_stamped:      # columns: s, ns, then the wheels
            stamps = [second * 10**9 + nanosecond for (second,), (nanosecond,), *_ in values]
        return [(slot, [(stamp, received, row[wheel][0]) for stamp, received, row in zip(
            stamps, received_ns, values, strict=True)])
            for wheel, slot in enumerate(self._slots, first_wheel)]

    def build(self, received_ns: Ints, columns: list[NDArray[Any]]) -> list[tuple[str, Samples]]:
        """Return (slot, samples) of each wheel from the values of ``columns``."""
        stamps = stamp_ns(columns[0], columns[1]) if self.is_stamped else received_ns
        values = columns[len(STAMP) * self.is_stamped:]
        return [(slot, from_columns(OdometerSamples, stamps, received_ns, value[:, 0]))
                for slot, value in zip(self._slots, values, strict=True)]


def _configured_wheels(slot: str, config: Config) -> tuple[str, ...]:
    """Return the keys of the wheels in one message; ('',) if none is configured."""
    odometer = config.odometer
    keys, left_right = odometer.wheel_keys, (odometer.left, odometer.right)
    if odometer.wheels and any(left_right):
        raise BadConfig('odometer.left and odometer.right are the wheels of odometer.wheels: set '
                        'only one of both')
    if odometer.has_two_topics or not keys:
        return ('',)
    if not odometer.wheels and not all(left_right):
        raise BadConfig('odometer.left and odometer.right belong together: set both or neither')
    if len(set(keys)) < len(keys) or '' in keys or len(keys) > len(WHEELS):
        setting_name = 'odometer.wheels' if odometer.wheels else 'odometer.left and odometer.right'
        raise BadConfig(f'{setting_name}: {", ".join(map(repr, keys))}; required: different '
                        f'wheels, {len(WHEELS)} at most')
    return keys if slot == WHEELS[0] else ('',)


def _value_types(msgtype: str) -> dict[str, str]:
    """Return path -> type of the numbers of a known message type."""
    fields = (line.split() for line in cdr.SCHEMAS[msgtype])
    return {path: field_type for field_type, path in fields
            if not field_type.startswith(('string', 'dim'))}


def _split_key(path: str) -> tuple[str, str]:
    """Split 'position[left]' into ('position', 'left'); without brackets the key is ''."""
    if not path.endswith(']'):
        return path, ''
    base, _, key = path[:-1].rpartition('[')
    return base, key
