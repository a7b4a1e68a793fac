# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Decoding of messages: the samples of each type, and refused types."""

from contextlib import nullcontext
import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest
import ros_messages as make

from odocal_ros.data.inputs import WHEELS
from odocal_ros.errors import BadConfig, BadData
from odocal_ros.messages.decode import make_reader
from odocal_ros.settings.config import Config, with_settings

STD = ('Int16', 'UInt16', 'Int32', 'UInt32', 'Int64', 'UInt64')


def config(**settings_):
    """Return a configuration; odometer__left='x' sets odometer.left."""
    return with_settings(Config(), {k.replace('__', '.'): v for k, v in settings_.items()})


def read(slot, messages, **settings_):
    """Read messages of one type in one block; return slot -> rows, and the reader."""
    msgtype = messages[0].__msgtype__
    reader = make_reader(slot, msgtype, config(**settings_))
    pairs = reader.rows([make.cdr(m) for m in messages], range(7, 7 + len(messages)),
                        make.deserializer(msgtype))
    return dict(pairs), reader


def test_an_imu_message_gives_rates_forces_and_orientation():
    covariance = np.zeros(9)
    covariance[8] = 0.25
    found, reader = read('imu', [
        make.imu(1_500_000_000, w=(1, 2, 3), f=(4, 5, 6), q=(0.1, 0.2, 0.3, 0.9),
                 covariance=covariance),
        make.imu(-1, w=(math.nan, 0, 0)),
        make.imu(2, q=(0, 0, 0, 0), covariance=np.zeros(9))])
    block = found['imu']
    assert reader.form is None
    assert block.stamp_ns.tolist() == [1_500_000_000, -1, 2]
    assert block.received_ns.tolist() == [7, 8, 9]
    assert block.w_i[0].tolist() == [1, 2, 3]
    assert block.f_i[0].tolist() == [4, 5, 6]
    assert block.q_ni[0].tolist() == [0.1, 0.2, 0.3, 0.9]
    assert np.isnan(block.w_i[1, 0])
    assert block.yaw_variance[0] == 0.25
    assert np.isnan(block.yaw_variance[1:]).all()   # -1 and the all-zero quaternion: none


@pytest.mark.parametrize(('slot', 'group', 'message'), [
    ('imu', 'imu', make.imu(0, w=(1, 2, 3))), ('fix', 'gnss', make.fix(5, 48.0, 11.0, 500.0)),
    ('odometer', 'odometer', make.twist_stamped(3, 1, 2, 3))])
def test_arrival_times_replace_stamps_if_set(slot, group, message):
    assert read(slot, [message] * 2)[0][slot].stamp_ns.tolist() != [7, 8]
    found, reader = read(slot, [message] * 2, **{f'{group}__arrival_time': True})
    assert found[slot].stamp_ns.tolist() == found[slot].received_ns.tolist() == [7, 8]
    raw, deserialize = make.cdr(message), make.deserializer(message.__msgtype__)
    for _ in range(2):      # also once the layout is known
        (_, (row,)), = reader.readings([raw], [9], deserialize)
        assert row[:2] == (9, 9)


@pytest.mark.parametrize(('slot', 'message', 'expected'), [
    ('heading', make.imu(5, q=(0, 0, 1, 0), covariance=np.full(9, 0.1)),
     {'q_ni': [0, 0, 1, 0], 'yaw_variance': 0.1}),
    ('fix', make.fix(10**9, 180.0, -90.0, 12.5, sigma=2.0, status=-1, known=3),
     {'latitude': math.pi, 'longitude': -math.pi / 2, 'height': 12.5, 'status': -1,
      'covariance_type': 3, 'covariance_n': [[4, 0, 0], [0, 4, 0], [0, 0, 16]]}),
    ('fix_velocity', make.twist_stamped(3, 1, 2, 3),
     {'velocity_n': [1, 2, 3], 'variance_n': [0, 0, 0]}),
    ('fix_velocity', make.twist_covariance(3, 1, 2, 3, (0.5, -1.0, math.nan)),
     {'variance_n': [0.5, 0, 0]})])      # unknown is 0
def test_heading_fix_and_velocity_messages_give_their_values(slot, message, expected):
    block = read(slot, [message])[0][slot]
    assert {name: getattr(block, name)[0].tolist() for name in expected} == expected


def span(name):
    """Return the least and the largest number of a type."""
    bits_ = int(name.lstrip('UInt'))
    return (0, 2**bits_ - 1) if name[0] == 'U' else (-2**(bits_ - 1), 2**(bits_ - 1) - 1)


@pytest.mark.parametrize('name', STD)
def test_counters_have_the_modulus_of_their_type(name):
    low, high = span(name)
    found, reader = read('odometer', [make.whole(v, name) for v in (low, 5, high)])
    assert dataclasses.astuple(reader.form)[:3] == ('cumulative', high - low + 1, 'm/pulse')
    block = found['odometer']
    assert block.value.dtype == np.int64
    # unsigned 64-bit values are stored as their int64 bits, others unchanged
    assert block.value.tolist() == [low, 5, -1 if name == 'UInt64' else high]
    assert block.stamp_ns.tolist() == block.received_ns.tolist() == [7, 8, 9]


COUNTER, SPEED = ('cumulative', 0, 'm/pulse'), ('rate', 0, '1')
ANGLE, TURNING = ('cumulative', 0, 'm/rad'), ('rate', 0, 'm/rad')
BOTH = {'odometer__left': 'topic', 'odometer__right': 'topic'}
TWO, FIVE = make.joints(1, ['l', 'r'], [1, 2]), make.joints(1, list('xabcd'), [0, 1, 2, 3, 4])
ARM, WHEEL = ['elbow', 'wrist'], ['left_wheel', 'right_wheel']
# message or messages, settings, values by wheel, quantity with modulus and unit, stamps
ODOMETERS = {
    'a span': (make.whole(3, 'Int32'), {'odometer__wrap': 9000}, [[3]],
               ('cumulative', 9000, 'm/pulse'), [7]),
    'increments': (make.whole(3), {'odometer__quantity': 'increment'}, [[3]],
                   ('increment', 0, 'm/pulse'), [7]),
    'a sum': (make.real(1.0), {'odometer__quantity': 'cumulative'}, [[1.0]], COUNTER, [7]),
    'double': (make.real(1.5), {}, [[1.5]], SPEED, [7]),
    'float': (make.real(1.5, 'Float32'), {}, [[1.5]], SPEED, [7]),
    'twist': (make.twist(1.5), {}, [[1.5]], SPEED, [7]),
    'stamped': (make.twist_stamped(99, 1.5), {}, [[1.5]], SPEED, [99]),
    'covariance': (make.twist_covariance(99, 1.5), {}, [[1.5]], SPEED, [99]),
    'odometry': (make.odometry(99, 1.5), {}, [[1.5]], SPEED, [99]),
    'the only value': (make.whole_array([4], 'Int64', labels=['wheel']), {}, [[4]],
                       ('cumulative', 2**64, 'm/pulse'), [7]),
    'the value named': (make.whole_array([4, 5]), {'odometer__field': 'data[1]'}, [[5]],
                        ('cumulative', 2**32, 'm/pulse'), [7]),
    'a sensor': ([make.imu(k, w=(k, 0, 0)) for k in (1, 2)],
                 {'odometer__field': 'angular_velocity.x'}, [[1.0, 2.0]], SPEED, [1, 2]),
    'joints by name': (make.joints(
        9, ['left_steering_joint', 'right_steering_joint', 'wheel_left', 'wheel_right'],
        [1, 2, 3, 4], [7, 7, 7, 7]), {}, [[3.0], [4.0]], ANGLE, [9]),
    'velocities': ([make.joints(9, 'ab', velocity=[1, 2]), make.joints(10, 'ab', [5, 5], [3, 4])],
                   {}, [[1, 3], [2, 4]], TURNING, [9, 10]),
    'a speed of a joint named position': (
        make.joints(9, ['position'], [1], [2]), {'odometer__field': 'velocity[position]'}, [[2.0]],
        TURNING, [9]),
    'two topics': (make.whole(1, 'Int32'), BOTH, [[1]], ('cumulative', 2**32, 'm/pulse'), [7]),
    'left and right': (TWO, {'odometer__left': 'l', 'odometer__right': 'r'}, [[1], [2]], ANGLE,
                       [1]),
    'two as a list': (TWO, {'odometer__wheels': ('l', 'r')}, [[1], [2]], ANGLE, [1]),
    'two of an array': (make.whole_array([1, 2]), {'odometer__left': '0', 'odometer__right': '1'},
                        [[1], [2]], ('cumulative', 2**32, 'm/pulse'), [7]),
    'four joints': (FIVE, {'odometer__wheels': tuple('abcd')}, [[1], [2], [3], [4]], ANGLE, [1]),
    'four of an array': (make.whole_array([0, 1, 2, 3, 4]), {'odometer__wheels': tuple('1234')},
                         [[1], [2], [3], [4]], ('cumulative', 2**32, 'm/pulse'), [7])}


@pytest.mark.parametrize('case', ODOMETERS)
def test_each_kind_of_odometer_gives_values_form_and_stamps(case):
    messages, more, values, form, stamps = ODOMETERS[case]
    found, reader = read('odometer', messages if isinstance(messages, list) else [messages],
                         **more)
    assert {slot: block.value.tolist() for slot, block in found.items()} == dict(
        zip(WHEELS, values, strict=False))
    assert dataclasses.astuple(reader.form)[:3] == form
    assert all(block.stamp_ns.tolist() == stamps for block in found.values())
    keys = more.get('odometer__wheels')
    assert keys is None or reader.wheels == keys


def test_two_unnamed_wheels_are_averaged_and_four_require_a_setting():
    # each counter rolls over separately: the mean of raw counts would be wrong
    found, reader = read('odometer', [make.whole_array([4, 5])])
    assert [block.value.tolist() for block in found.values()] == [[4], [5]]
    assert not reader.form.sides_known
    assert 'the mean of 0 and 1 is used' in reader.form.selection_text
    found, reader = read('odometer', [make.whole_array([4, 5, 6, 7])])
    assert found == {}
    assert 'a list of 4 values' in reader.error
    assert 'odometer.wheels (indices from 0)' in reader.error


@pytest.mark.parametrize(('messages', 'more', 'values', 'error'), [
    ([make.joints(1, ARM, [9, 9]), make.joints(2, WHEEL, [1, 2]), make.joints(3, ARM, [9, 9]),
      make.joints(4, WHEEL, [3, 4])], {}, [1, 3], 'names: elbow, wrist'),
    ([make.joints(1, ['arm'], [9.0]), make.joints(2, ['l', 'r'], [1, 2]),
      make.joints(3, ['arm'], [9.0]), make.joints(4, ['r', 'l'], [4, 3])],
     {'odometer__field': 'position[l]'}, [1, 3], 'names: arm')])
def test_messages_without_the_wheel_are_omitted_and_counted(messages, more, values, error):
    found, reader = read('odometer', messages, **more)
    assert found['odometer'].value.tolist() == values
    assert found['odometer'].stamp_ns.tolist() == [2, 4]
    assert reader.unreadable == 2
    assert error in reader.error


@pytest.mark.parametrize(('slot', 'value'), [('odometer', 1.0), ('odometer_right', 2.0)])
def test_the_joint_of_the_side_of_the_topic_is_used_if_it_has_both(slot, value):
    found, _ = read(slot, [make.joints(1, ['l_wheel', 'r_wheel'], [1, 2])], **BOTH)
    assert found[slot].value.tolist() == [value]


@pytest.mark.parametrize('name', ['left[', 'left]', 'left[0]', 'left].x[1', '[left'])
def test_a_joint_may_have_any_name(name):
    found, reader = read('odometer', [make.joints(1, [name, 'right'], [1.0, 5.0])] * 2)
    assert reader.wheels == (name, 'right')
    assert [block.value.tolist() for block in found.values()] == [[1.0] * 2, [5.0] * 2]


def test_two_wheels_as_a_list_are_left_and_right():
    assert config(odometer__wheels=('l', 'r')).odometer.names(2) == ('left', 'right')
    # YAML reads a list of indices as numbers
    assert config(odometer__wheels=[0, 1]).odometer.wheel_keys == ('0', '1')


@pytest.mark.parametrize(('field', 'value', 'form'), [
    ('wheels[0].ticks', 10, COUNTER), ('wheels[1].ticks', 20.5, SPEED),
    ('wheel', 'its fields are header, wheels', None),
    ('wheels', 'is not a number but list', None)])
def test_a_field_of_a_foreign_type_is_read_by_its_path(field, value, form):
    class Ticks:
        __dataclass_fields__ = {'header': 0, 'wheels': 0}

        def __init__(self, stamp):
            self.header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=stamp))
            self.wheels = [SimpleNamespace(ticks=10), SimpleNamespace(ticks=20.5)]

    reader = make_reader('odometer', 'my_msgs/msg/Ticks', config(odometer__field=field))
    with nullcontext() if form else pytest.raises(BadData, match=value):
        (_, block), = reader.rows([b'0', b'1'], range(2), lambda raw: Ticks(int(raw)))
        assert block.value.tolist() == [value] * 2
        assert block.stamp_ns.tolist() == [10**9, 10**9 + 1]
        assert dataclasses.astuple(reader.form)[:3] == form


JOINTS, COUNT = 'sensor_msgs/msg/JointState', 'std_msgs/msg/Int64'
LEFT, RIGHT, LIST, FIELD = (f'odometer__{name}' for name in ('left', 'right', 'wheels', 'field'))


@pytest.mark.parametrize(('slot', 'msgtype', 'settings_', 'error', 'words'), [
    ('imu', 'std_msgs/msg/String', {}, BadData, 'supported: sensor_msgs/msg/Imu'),
    ('fix', 'sensor_msgs/msg/Imu', {}, BadData, 'sensor_msgs/msg/NavSatFix'),
    ('fix_velocity', 'geometry_msgs/msg/Twist', {}, BadData, 'TwistWithCovarianceStamped'),
    ('odometer', 'std_msgs/msg/String', {}, BadData, 'set odometer.field'),
    ('odometer', COUNT, {FIELD: 'value'}, BadData, 'values: data'),
    ('odometer', COUNT, {FIELD: 'a..b]'}, BadConfig, 'is not a path'),
    ('odometer', 'std_msgs/msg/Int32MultiArray', {FIELD: 'data'}, BadConfig, r'data\[0\]'),
    ('odometer', COUNT, {LEFT: 'a', RIGHT: 'b'}, BadConfig, "use 'topic'"),
    ('odometer', JOINTS, {LEFT: 'a'}, BadConfig, 'together'),
    ('odometer', JOINTS, {LIST: ('a', 'b'), LEFT: 'a'}, BadConfig, 'only one of both'),
    ('odometer', JOINTS, {LIST: tuple('abcdefghi')}, BadConfig, '8 at most'),
    ('odometer', JOINTS, {LIST: ('a', 'a')}, BadConfig, "'a', 'a'; required: different wheels"),
    ('odometer', JOINTS, {LEFT: 'a', RIGHT: 'a'}, BadConfig, 'required: different wheels')])
def test_unsupported_types_and_settings_are_refused(slot, msgtype, settings_, error, words):
    with pytest.raises(error, match=words):
        make_reader(slot, msgtype, config(**settings_))


def test_a_short_type_name_is_accepted():
    assert make_reader('imu', 'sensor_msgs/Imu', Config()).msgtype == 'sensor_msgs/msg/Imu'


def test_damaged_messages_are_omitted_and_counted():
    good = make.cdr(make.imu(1))
    text = 'a message of {} bytes cannot be read as sensor_msgs/msg/Imu: {}'.format
    stamp, frame = (f'too short or damaged from header.{x} on' for x in ('stamp.sec', 'frame_id'))
    for bad, why in (
            (good[:-9], 'too short or damaged from linear_acceleration_covariance on'),
            (b'', 'Invalid or unsupported CDR encapsulation.'),
            (b'\x00\x01\x00\x00\xff\xff', stamp), (good[:12] + b'\xff' * 4 + good[16:], frame)):
        reader = make_reader('imu', 'sensor_msgs/msg/Imu', Config())
        (_, block), = reader.rows([good, bad, good], [1, 2, 3],
                                  make.deserializer('sensor_msgs/msg/Imu'))
        assert block.received_ns.tolist() == [1, 3]
        assert reader.unreadable == 1
        assert reader.error == text(len(bad), why)
    assert reader.rows([], [], None) == []
    assert reader.rows([bad], [1], make.deserializer('sensor_msgs/msg/Imu')) == []


def test_a_missing_joint_gives_no_rows_and_the_reason():
    found, reader = read('odometer', [make.joints(1, ['a'], [1.0])], odometer__field='velocity[b]')
    assert found == {}
    assert reader.error == 'no velocity[b] in a sensor_msgs/msg/JointState; names: a'
