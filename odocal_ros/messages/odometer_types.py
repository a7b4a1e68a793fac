# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Odometer messages: which field has the value, and whether it is a count, an angle or a speed.

In: the message type, the settings and a first message. Out: a plan: the fields to read for each
wheel, and their meaning.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from numbers import Integral
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.data.arrays import Ints
from odocal_ros.data.inputs import WHEELS
from odocal_ros.data.samples import from_columns, OdometerForm, OdometerSamples, Reading, Samples
from odocal_ros.errors import BadConfig, BadData
from odocal_ros.messages import cdr
from odocal_ros.messages.message_fields import Column, MessageView, parts, STAMP, stamp_ns, View
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
    'std_msgs/msg/Int32MultiArray': 'data',
    'std_msgs/msg/Int64MultiArray': 'data',
} | {f'std_msgs/msg/{name}': 'data' for name in cdr.NUMBER_TYPES}
TYPES = tuple(DEFAULT_FIELD)


class OdometerPlan:
    """
    Fields to read from the messages of an odometer topic, and their meaning.

    Some of it is determined by the first message (does a JointState have positions? which of its
    joints are wheels? is a field of an unknown type an integer?): ``complete`` is called with
    messages in order until it returns True. ``keys`` are the wheels in a message, joint names or
    indices; ``form`` is the meaning of their values.
    """

    has_readings = True      # messages can be read as plain numbers

    def __init__(self, slot: str, msgtype: str, config: Config) -> None:
        self.slot, self.msgtype, self.odometer = slot, msgtype, config.odometer
        self.is_known_type = msgtype in DEFAULT_FIELD
        self.field = config.odometer.field or DEFAULT_FIELD.get(msgtype, '')
        self.keys = _wheel_keys(slot, config)
        self.stamped = 'string header.frame_id' in cdr.SCHEMAS.get(msgtype, ())
        self.columns: tuple[Column, ...] = ()
        self.form = OdometerForm('cumulative', self.odometer.wrap, 'm/pulse')
        self.unclear_reason = ''        # reason why the last message did not determine the wheels
        self._check_settings()
        has_key = _split_key(self.field)[1] or self.keys[0]
        self.selects_wheels = self._is_list() and not has_key
        if msgtype == JOINTS and not self.field:
            self.fields: tuple[str, ...] = {
                'auto': ('position', 'velocity'), 'rate': ('velocity',)}.get(
                self.odometer.quantity, ('position',))
        else:
            self.fields = (self.field,)
        if self.is_known_type:
            self.form = self._odometer_form(self.fields[0])
            if len(self.fields) == 1 and not self.selects_wheels:
                self._set_columns(self.field or self.fields[0])

    def _check_settings(self) -> None:
        """Raise an error for settings that must fail, before the first message."""
        if not self.is_known_type and not self.field and len(self.keys) < 2:
            raise BadData(
                f'{self.slot}: {self.msgtype} is not a known odometer type: set '
                f"odometer.field to the path of its value ('ros2 interface show {self.msgtype}' "
                f'lists its fields), or use a topic of type {", ".join(TYPES)}')
        if self.field and not parts(self.field):
            raise BadConfig(f'odometer.field: {self.field!r} is not a path such as '
                            'twist.linear.x, data[0] or position[joint]')
        if not self.is_known_type:
            return
        kinds = _value_types(self.msgtype)
        base, key = _split_key(self.field)
        if self.field and base not in kinds:
            raise BadData(f'odometer.field: {self.msgtype} has no value {self.field!r}; values: '
                          f'{", ".join(kinds)}')
        has_several_wheels = len(self.keys) > 1
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
        for field in self.fields:
            if self.selects_wheels and view.count(field):
                self._select_wheels(field, view)
                return bool(self.columns)
            if not self.selects_wheels and self._paths_of_wheel(field, self.keys[0])(view):
                self._set_columns(field)
                return True
        return False

    def _select_wheels(self, field: str, view: View) -> None:
        """Select the wheels among the values of a list, by their names."""
        choice = select_wheels(view.names, view.count(field))
        if isinstance(choice, str):
            self.unclear_reason = choice
            return
        side = {'odometer_right': 'right'}.get(
            self.slot, 'left' if self.odometer.own_topics else '')
        if side:
            key = key_on_side(choice, side)
            if not key:
                self.unclear_reason = choice.explanation
                return
            self.keys = (key,)
        else:
            self.keys = choice.keys
        self._set_columns(field)
        self.form = replace(self.form, sides_known=choice.sides, selection_text=choice.explanation)

    def _complete_unknown_type(self, view: MessageView) -> None:
        """Determine columns and meaning of an unknown type from its first message."""
        value = None
        for key in self.keys:
            path = self._path(self.field, key)
            try:
                value = view.value(path)
            except (AttributeError, LookupError, TypeError) as error:
                raise BadData(f'odometer.field: {self.msgtype} has no value {path!r} ({error}); '
                              f'its fields are {", ".join(view.fields())}') from None
            if not isinstance(value, (Integral, float, np.floating)):
                raise BadData(f'odometer.field: {path!r} of {self.msgtype} is not a number but '
                              f'{type(value).__name__}; name one value, such as path.to.value[0]')
        self.stamped = hasattr(view.message, 'header')
        self._set_columns(self.field, 'int64' if isinstance(value, Integral) else 'float64')

    def _set_columns(self, field: str, kind: str = '') -> None:
        """Set columns and form for a field; ``kind`` of unknown types is that of their values."""
        self.form = self._odometer_form(field, kind)
        is_integer = 'int' in (kind or self._kind(field))
        dtype = np.int64 if is_integer else np.float64
        self.columns = STAMP * self.stamped + tuple(
            Column(dtype, 1, self._paths_of_wheel(field, key)) for key in self.keys)

    def _kind(self, field: str) -> str:
        return _value_types(self.msgtype)[_split_key(field)[0]].split('[')[0]

    def _odometer_form(self, field: str, kind: str = '') -> OdometerForm:
        """Return the meaning of a field; ``kind``: type of its values in unknown messages."""
        bits = 0
        if self.is_known_type:
            kind = self._kind(field)
            bits = int(re.sub(r'\D', '', kind))      # such as 32 of uint32
        is_integer = 'int' in kind
        joint = self.msgtype == JOINTS and _split_key(field)[0] in ('position', 'velocity')
        quantity = self.odometer.quantity
        if quantity == 'auto':
            quantity = 'cumulative' if is_integer or joint and 'position' in field else 'rate'
        modulus = (self.odometer.wrap or (2**bits if bits else 0)) * (
            is_integer and quantity == 'cumulative')
        unit = 'm/rad' if joint else 'm/pulse' if is_integer or quantity != 'rate' else '1'
        return OdometerForm(quantity, modulus, unit)

    def _path(self, field: str, key: str) -> str:
        """Return the path of a wheel's value: of a key in the field, or the key as path."""
        if not key:
            return field
        return f'{_split_key(field)[0]}[{key}]' if field else key

    def _paths_of_wheel(self, field: str, key: str) -> Callable[[View], Sequence[str] | None]:
        """Return a function that returns the paths of a wheel's values in a message."""
        path = self._path(field, key)
        base, side = _split_key(field)
        if not self.is_known_type or '[' not in _value_types(self.msgtype)[base]:
            return lambda view: (path,)
        key = key or side        # not by parsing the path: a joint may have any name

        def find_paths(view: View) -> Sequence[str] | None:
            n = view.count(base)
            names = view.names
            index = names.index(key) if key in names else int(key) if key.isdigit() else n
            return (f'{base}[{index}]',) if index < n else None
        return find_paths

    def missing(self, view: View) -> str:
        """Return the reason why a message has no value, as text."""
        if self.unclear_reason and not self.columns:
            return self.unclear_reason
        required = ' and '.join(key for key in self.keys if key) or self.field or 'any position'
        names = f'; names: {", ".join(view.names)}' if view.names else ''
        return f'no {required} in a {self.msgtype}{names}'

    @property
    def _slots(self) -> tuple[str, ...]:
        return WHEELS[:len(self.keys)] if len(self.keys) > 1 else (self.slot,)

    def readings(self, received_ns: Sequence[int], values: list[Any]
                 ) -> list[tuple[str, list[Reading]]]:
        """Return (slot, rows in plain numbers) from the values of each message."""
        value_from = 2 * self.stamped
        return [(slot, [
            (row[0][0] * 10**9 + row[1][0] if value_from else received, received, row[wheel][0])
            for received, row in zip(received_ns, values, strict=True)])
            for wheel, slot in enumerate(self._slots, value_from)]

    def build(self, received_ns: Ints, columns: list[NDArray[Any]]) -> list[tuple[str, Samples]]:
        stamps = stamp_ns(columns[0], columns[1]) if self.stamped else received_ns
        values = columns[2:] if self.stamped else columns
        return [(slot, from_columns(OdometerSamples, stamps, received_ns, value[:, 0]))
                for slot, value in zip(self._slots, values, strict=True)]


def _wheel_keys(slot: str, config: Config) -> tuple[str, ...]:
    """Return the keys of the wheels in one message; ('',) if none is configured."""
    odometer = config.odometer
    keys, sides_setting = odometer.keys, (odometer.left, odometer.right)
    if odometer.wheels and any(sides_setting):
        raise BadConfig('odometer.left and odometer.right are the wheels of odometer.wheels: set '
                        'only one of both')
    if odometer.own_topics or not keys:
        return ('',)
    if not odometer.wheels and not all(sides_setting):
        raise BadConfig('odometer.left and odometer.right belong together: set both or neither')
    if len(set(keys)) < len(keys) or '' in keys or len(keys) > len(WHEELS):
        setting_name = 'odometer.wheels' if odometer.wheels else 'odometer.left and odometer.right'
        raise BadConfig(f'{setting_name}: {", ".join(map(repr, keys))}; required: different '
                        f'wheels, {len(WHEELS)} at most')
    return keys if slot == WHEELS[0] else ('',)


def _value_types(msgtype: str) -> dict[str, str]:
    """Return path -> type of the numbers of a known message type."""
    lines = (line.split() for line in cdr.SCHEMAS[msgtype])
    return {path: kind for kind, path in lines if not kind.startswith(('string', 'dim'))}


def _split_key(path: str) -> tuple[str, str]:
    """Split 'position[left]' into ('position', 'left'); without brackets the key is ''."""
    if not path.endswith(']'):
        return path, ''
    base, _, key = path[:-1].rpartition('[')
    return base, key
