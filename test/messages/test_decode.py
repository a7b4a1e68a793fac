# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages to samples: every type, block path equal to message path, and what is refused."""

import dataclasses
import math
from types import SimpleNamespace

from hypothesis import given, HealthCheck, settings, strategies as st
import numpy as np
import pytest
import ros_messages as make

from odocal_ros.data.inputs import WHEELS
from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import readings_of
from odocal_ros.errors import BadConfig, BadData
from odocal_ros.messages import cdr
from odocal_ros.messages.decode import make_reader
from odocal_ros.messages.sensor_types import _fix, _heading
from odocal_ros.settings.config import Config, with_settings

STD = ('Int16', 'UInt16', 'Int32', 'UInt32', 'Int64', 'UInt64')


def config(**settings_):
    """Return a configuration; odometer__left='x' sets odometer.left."""
    return with_settings(Config(), {k.replace('__', '.'): v for k, v in settings_.items()})


def read(slot, messages, settings_=None, received=None):
    """Read messages of one type in one block; return the pairs and the reader."""
    msgtype = messages[0].__msgtype__
    reader = make_reader(slot, msgtype, settings_ or Config())
    received = received or [7 + i for i in range(len(messages))]
    return reader.rows([make.cdr(m) for m in messages], received,
                       make.deserializer(msgtype)), reader


def one(slot, messages, settings_=None):
    pairs, reader = read(slot, messages, settings_)
    assert [s for s, _ in pairs] == [slot]
    return pairs[0][1], reader.form


def bits(pairs):
    """Return all rows of (slot, block) pairs as bytes, so that NaN and -0.0 count."""
    rows: dict = {}
    for slot, block in pairs:
        for f in dataclasses.fields(block):
            array = getattr(block, f.name)
            rows.setdefault((slot, f.name, array.dtype.str), []).append(array.tobytes())
    return {key: b''.join(parts) for key, parts in rows.items()}


# ---- what each type says -------------------------------------------------------------------

def test_imu():
    covariance = np.zeros(9)
    covariance[8] = 0.25
    block, form = one('imu', [
        make.imu(1_500_000_000, w=(1, 2, 3), f=(4, 5, 6), q=(0.1, 0.2, 0.3, 0.9),
                 covariance=covariance),
        make.imu(-1, w=(math.nan, 0, 0)),
        make.imu(2, q=(0, 0, 0, 0), covariance=np.zeros(9))])
    assert form is None
    assert block.stamp_ns.tolist() == [1_500_000_000, -1, 2]
    assert block.received_ns.tolist() == [7, 8, 9]
    assert block.w_i[0].tolist() == [1, 2, 3]
    assert block.f_i[0].tolist() == [4, 5, 6]
    assert block.q_ni[0].tolist() == [0.1, 0.2, 0.3, 0.9]
    assert np.isnan(block.w_i[1, 0])
    assert block.yaw_variance[0] == 0.25
    assert np.isnan(block.yaw_variance[1:]).all()   # -1 and the all-zero quaternion: none


def test_heading_is_an_imu_read_for_its_orientation():
    block, _ = one('heading', [make.imu(5, q=(0, 0, 1, 0), covariance=np.full(9, 0.1))])
    assert block.q_ni.tolist() == [[0, 0, 1, 0]]
    assert block.yaw_variance.tolist() == [0.1]


def test_fix_is_in_radians_and_keeps_status_and_covariance():
    block, _ = one('fix', [make.fix(10**9, 180.0, -90.0, 12.5, sigma=2.0, status=-1, known=3)])
    assert block.latitude.tolist() == [math.pi]
    assert block.longitude.tolist() == [-math.pi / 2]
    assert block.height.tolist() == [12.5]
    assert block.covariance_n[0].tolist() == [[4, 0, 0], [0, 4, 0], [0, 0, 16]]
    assert (block.status.tolist(), block.covariance_type.tolist()) == ([-1], [3])


def test_fix_velocity():
    block, _ = one('fix_velocity', [make.twist_stamped(3, 1, 2, 3)])
    assert block.velocity_n.tolist() == [[1, 2, 3]]
    assert block.variance_n.tolist() == [[0, 0, 0]]
    block, _ = one('fix_velocity', [make.twist_covariance(3, 1, 2, 3, (0.5, -1.0, math.nan))])
    assert block.variance_n.tolist() == [[0.5, 0, 0]]   # unknown is 0


@pytest.mark.parametrize('name', STD)
def test_counters(name):
    bits_ = int(name.lstrip('UInt'))
    low, high = (0, 2**bits_ - 1) if name[0] == 'U' else (-2**(bits_ - 1), 2**(bits_ - 1) - 1)
    block, form = one('odometer', [make.whole(v, name) for v in (low, 5, high)])
    assert (form.quantity, form.modulus, form.scale_unit) == ('cumulative', 2**bits_, 'm/pulse')
    assert block.value.dtype == np.int64
    # 64 bits without sign come as their int64 bits, the rest as they are
    assert block.value.tolist() == [low, 5, -1 if name == 'UInt64' else high]
    assert block.stamp_ns.tolist() == block.received_ns.tolist() == [7, 8, 9]


def test_settings_change_what_a_counter_means():
    message = [make.whole(3, 'Int32')]
    _, form = one('odometer', message, config(odometer__wrap=9000))
    assert form.modulus == 9000
    _, form = one('odometer', message, config(odometer__quantity='increment'))
    assert (form.quantity, form.modulus, form.scale_unit) == ('increment', 0, 'm/pulse')
    _, form = one('odometer', [make.real(1.0)], config(odometer__quantity='cumulative'))
    assert (form.quantity, form.modulus, form.scale_unit) == ('cumulative', 0, 'm/pulse')


@pytest.mark.parametrize(('message', 'stamped'), [
    (make.real(1.5), False), (make.real(1.5, 'Float32'), False), (make.twist(1.5), False),
    (make.twist_stamped(99, 1.5), True), (make.twist_covariance(99, 1.5), True),
    (make.odometry(99, 1.5), True)])
def test_speeds(message, stamped):
    block, form = one('odometer', [message])
    assert (form.quantity, form.modulus, form.scale_unit) == ('rate', 0, '1')
    assert block.value.tolist() == [1.5]
    assert block.stamp_ns.tolist() == [99 if stamped else 7]


def test_arrays_give_their_only_value_the_one_named_or_two_for_a_mean():
    block, form = one('odometer', [make.whole_array([4], 'Int64', labels=['wheel'])])
    assert block.value.tolist() == [4]
    assert (form.modulus, form.chosen) == (2**64, '')
    block, _ = one('odometer', [make.whole_array([4, 5])], config(odometer__field='data[1]'))
    assert block.value.tolist() == [5]
    # counters roll over each for itself: a mean of raw counts would not
    pairs, reader = read('odometer', [make.whole_array([4, 5])])
    assert [(slot, block.value.tolist()) for slot, block in pairs] == [
        ('odometer', [4]), ('odometer_right', [5])]
    assert not reader.form.sides
    assert 'the mean of 0 and 1 is used' in reader.form.chosen
    pairs, reader = read('odometer', [make.whole_array([4, 5, 6, 7])])
    assert pairs == []
    assert 'a list of 4 values' in reader.trouble
    assert 'odometer.wheels (indices from 0)' in reader.trouble


def test_joint_state_gives_the_two_wheels_by_name():
    names = ['left_steering_joint', 'right_steering_joint', 'wheel_left', 'wheel_right']
    pairs, reader = read('odometer', [make.joints(9, names, [1, 2, 3, 4], [7, 7, 7, 7])])
    assert [(slot, block.value.tolist()) for slot, block in pairs] == [
        ('odometer', [3.0]), ('odometer_right', [4.0])]
    form = reader.form
    assert (form.quantity, form.scale_unit, form.sides) == ('cumulative', 'm/rad', True)
    assert pairs[0][1].stamp_ns.tolist() == [9]


def test_joint_state_without_positions_gives_velocities():
    messages = [make.joints(9, 'ab', velocity=[1, 2]), make.joints(10, 'ab', [5, 5], [3, 4])]
    pairs, reader = read('odometer', messages)
    assert [block.value.tolist() for _, block in pairs] == [[1, 3], [2, 4]]
    assert (reader.form.quantity, reader.form.scale_unit) == ('rate', 'm/rad')


def test_messages_before_the_first_that_shows_wheels_are_left_out_and_counted():
    arm, wheels = ['elbow', 'wrist'], ['left_wheel', 'right_wheel']
    messages = [make.joints(1, arm, [9, 9]), make.joints(2, wheels, [1, 2]),
                make.joints(3, arm, [9, 9]), make.joints(4, wheels, [3, 4])]
    pairs, reader = read('odometer', messages)
    assert [block.stamp_ns.tolist() for _, block in pairs] == [[2, 4], [2, 4]]
    assert reader.unreadable == 2


@pytest.mark.parametrize(('slot', 'value'), [('odometer', 1.0), ('odometer_right', 2.0)])
def test_of_two_joints_on_a_topic_of_one_side_that_side_is_taken(slot, value):
    settings_ = config(odometer__left='topic', odometer__right='topic')
    block, _ = one(slot, [make.joints(1, ['l_wheel', 'r_wheel'], [1, 2])], settings_)
    assert block.value.tolist() == [value]


def test_joint_by_name_wherever_it_stands_and_not_in_messages_without_it():
    messages = [make.joints(1, ['arm'], [9.0]), make.joints(2, ['l', 'r'], [1, 2]),
                make.joints(3, ['r', 'l'], [3, 4]), make.joints(4, ['arm'], [9.0])]
    pairs, reader = read('odometer', messages, config(odometer__field='position[l]'))
    assert pairs[0][1].value.tolist() == [1, 4]
    assert pairs[0][1].stamp_ns.tolist() == [2, 3]
    assert reader.unreadable == 2
    assert 'names: arm' in reader.trouble


TWO, FIVE = make.joints(1, ['l', 'r'], [1, 2]), make.joints(1, list('xabcd'), [0, 1, 2, 3, 4])


@pytest.mark.parametrize(('message', 'more', 'keys'), [
    (TWO, {'odometer__left': 'l', 'odometer__right': 'r'}, 'lr'),
    (TWO, {'odometer__wheels': ('l', 'r')}, 'lr'),
    (make.whole_array([1, 2]), {'odometer__left': '0', 'odometer__right': '1'}, '01'),
    (FIVE, {'odometer__wheels': tuple('abcd')}, 'abcd'),
    (make.whole_array([0, 1, 2, 3, 4]), {'odometer__wheels': tuple('1234')}, '1234')], ids=str)
def test_wheels_in_one_message(message, more, keys):
    pairs, reader = read('odometer', [message], config(**more))
    assert [(slot, block.value.tolist()) for slot, block in pairs] == [
        (slot, [i]) for i, slot in enumerate(WHEELS[:len(keys)], 1)]
    assert reader.wheels == tuple(keys)


def test_two_wheels_as_a_list_are_left_and_right():
    assert config(odometer__wheels=('l', 'r')).odometer.names(2) == ('left', 'right')
    # a list of indices is one of numbers in YAML
    assert config(odometer__wheels=[0, 1]).odometer.keys == ('0', '1')


@pytest.mark.parametrize(('more', 'words'), [
    ({'odometer__wheels': ('a', 'b'), 'odometer__left': 'a'}, 'only one of both'),
    ({'odometer__wheels': tuple('abcdefghi')}, '8 at most'),
    ({'odometer__wheels': ('a', 'a')}, "'a', 'a'; required: different wheels"),
    ({'odometer__left': 'a', 'odometer__right': 'a'}, "'a', 'a'; required: different wheels")],
    ids=str)
def test_impossible_lists_of_wheels_are_refused(more, words):
    with pytest.raises(BadConfig, match=words):
        read('odometer', [make.joints(1, ['a', 'b'], [1, 2])], config(**more))


def test_two_wheels_on_two_topics():
    settings_ = config(odometer__left='topic', odometer__right='topic')
    assert one('odometer', [make.whole(1)], settings_)[0].value.tolist() == [1]
    assert one('odometer_right', [make.whole(2)], settings_)[0].value.tolist() == [2]


def test_foreign_type_by_field_path():
    class Ticks:
        __dataclass_fields__ = {'header': 0, 'wheels': 0}

        def __init__(self, stamp):
            self.header = SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=stamp))
            self.wheels = [SimpleNamespace(ticks=10), SimpleNamespace(ticks=20.5)]

    def rows(field, n=3):
        reader = make_reader('odometer', 'my_msgs/msg/Ticks', config(odometer__field=field))
        return reader.rows([b'%d' % i for i in range(n)], range(n), lambda raw: Ticks(int(raw))), \
            reader.form

    pairs, form = rows('wheels[0].ticks')
    assert pairs[0][1].value.tolist() == [10, 10, 10]
    assert pairs[0][1].stamp_ns.tolist() == [10**9, 10**9 + 1, 10**9 + 2]
    assert (form.quantity, form.modulus, form.scale_unit) == ('cumulative', 0, 'm/pulse')
    pairs, form = rows('wheels[1].ticks')
    assert pairs[0][1].value.tolist() == [20.5] * 3
    assert (form.quantity, form.scale_unit) == ('rate', '1')
    with pytest.raises(BadData, match='its fields are header, wheels'):
        rows('wheel')
    with pytest.raises(BadData, match='is not a number but list'):
        rows('wheels')


@pytest.mark.parametrize('name', ['left[', 'left]', 'left[0]', 'left].x[1', '[left'])
def test_a_joint_may_have_any_name(name):
    messages = [make.joints(10**9 + i, [name, 'right'], [1.0 + i, 5.0]) for i in range(3)]
    pairs, reader = read('odometer', messages)
    assert reader.wheels == (name, 'right')
    assert [block.value.tolist() for _, block in pairs] == [[1.0, 2.0, 3.0], [5.0] * 3]


def test_a_sensors_type_as_an_odometer_is_read_by_its_field():
    """Its layout is known, and yet what to take from it only a message tells."""
    messages = [make.imu(10**9 + i, w=(i, 0, 0)) for i in range(3)]
    block, form = one('odometer', messages, config(odometer__field='angular_velocity.x'))
    assert block.value.tolist() == [0.0, 1.0, 2.0]
    assert block.stamp_ns.tolist() == [10**9, 10**9 + 1, 10**9 + 2]
    assert (form.quantity, form.scale_unit) == ('rate', '1')
    with pytest.raises(BadData, match="has no value 'ticks'"):
        one('odometer', messages, config(odometer__field='ticks'))


# ---- what is refused -----------------------------------------------------------------------

@pytest.mark.parametrize(('slot', 'msgtype', 'settings_', 'error', 'says'), [
    ('imu', 'std_msgs/msg/String', {}, BadData, 'give a topic of type sensor_msgs/msg/Imu'),
    ('fix', 'sensor_msgs/msg/Imu', {}, BadData, 'sensor_msgs/msg/NavSatFix'),
    ('fix_velocity', 'geometry_msgs/msg/Twist', {}, BadData, 'TwistWithCovarianceStamped'),
    ('odometer', 'std_msgs/msg/String', {}, BadData, 'set odometer.field'),
    ('odometer', 'std_msgs/msg/Int64', {'odometer.field': 'value'}, BadData, 'values: data'),
    ('odometer', 'std_msgs/msg/Int64', {'odometer.field': 'a..b]'}, BadConfig, 'is not a path'),
    ('odometer', 'std_msgs/msg/Int32MultiArray', {'odometer.field': 'data'}, BadConfig,
     r'data\[0\]'),
    ('odometer', 'std_msgs/msg/Int64', {'odometer.left': 'a', 'odometer.right': 'b'}, BadConfig,
     "use 'topic'"),
    ('odometer', 'sensor_msgs/msg/JointState', {'odometer.left': 'a'}, BadConfig, 'together')])
def test_refused(slot, msgtype, settings_, error, says):
    with pytest.raises(error, match=says):
        make_reader(slot, msgtype, with_settings(Config(), settings_))


def test_short_type_name_is_understood():
    assert make_reader('imu', 'sensor_msgs/Imu', Config()).msgtype == 'sensor_msgs/msg/Imu'


def test_damaged_messages_are_left_out_and_counted():
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
        assert reader.trouble == text(len(bad), why)
    assert reader.rows([], [], None) == []
    assert reader.rows([bad], [1], make.deserializer('sensor_msgs/msg/Imu')) == []


def test_a_joint_no_message_has_gives_no_rows_but_the_reason():
    pairs, reader = read('odometer', [make.joints(1, ['a'], [1.0])],
                         config(odometer__field='velocity[b]'))
    assert pairs == []
    assert reader.trouble == 'no velocity[b] in a sensor_msgs/msg/JointState; names: a'


# ---- block path == message path ------------------------------------------------------------

floats = st.floats(width=64, allow_nan=True)
stamps = st.integers(-2**31 * 10**9, 2**31 * 10**9 - 1)
frames = st.sampled_from(['', 'a', 'imu_link', 'gps/äö'])
# near the frame's origin and anywhere
positions = st.tuples(*[st.one_of(st.floats(-2e4, 2e4), floats)] * 3)
joint_lists = st.sampled_from([['l', 'r'], ['r', 'l'], ['left', 'l', 'r'], ['arm'],
                               ['a', 'b', 'l']])


@st.composite
def joint_states(draw):
    names = draw(joint_lists)
    lists = [draw(st.lists(floats, min_size=n, max_size=n))
             for n in (draw(st.sampled_from([0, len(names)])) for _ in range(3))]
    return make.joints(draw(stamps), names, *lists, frame=draw(frames))


MESSAGES = {
    'imu': (st.builds(lambda t, w, f, q, c, name: make.imu(t, w, f, q, c, name), stamps,
                      *(st.tuples(*[floats] * n) for n in (3, 3, 4, 9)), frames), {}),
    'heading': (st.builds(lambda t, q, c: make.imu(t, q=q, covariance=c), stamps,
                          st.tuples(*[floats] * 4), st.tuples(*[floats] * 9)), {}),
    'fix': (st.builds(make.fix, stamps, floats, floats, floats, st.floats(0, 1e3),
                      st.integers(-1, 2), st.integers(0, 3)), {}),
    'fix_velocity stamped': (st.builds(make.twist_stamped, stamps, *[floats] * 3, frames), {}),
    'fix_velocity': (st.builds(make.twist_covariance, stamps, *[floats] * 3,
                               st.tuples(*[floats] * 3), frames), {}),
    'fix pose': (st.builds(make.pose, stamps, positions, frames), {}),
    'fix pose_covariance': (st.builds(make.pose_covariance, stamps, positions, st.lists(
        floats, min_size=36, max_size=36), frames), {}),
    'fix point': (st.builds(make.point, stamps, positions, frames), {}),
    'fix transform': (st.builds(make.transform, stamps, positions, frames, frames), {}),
    'fix odometry': (st.builds(make.odometry, stamps, floats, frames, frames), {}),
    'odometer twist': (st.builds(make.twist, *[floats] * 3), {}),
    'odometer twist_stamped': (st.builds(make.twist_stamped, stamps, floats), {}),
    'odometer odometry': (st.builds(make.odometry, stamps, floats, frames, frames), {}),
    'odometer joints': (joint_states(), {}),
    'odometer joint': (joint_states(), {'odometer.field': 'velocity[l]'}),
    'odometer two joints': (joint_states(), {'odometer.left': 'l', 'odometer.right': 'r'}),
    'odometer Float32': (st.builds(make.real, st.floats(width=32), st.just('Float32')), {}),
    'odometer Float64': (st.builds(make.real, floats), {}),
} | {f'odometer {name}': (st.builds(make.whole, st.integers(
        0 if name[0] == 'U' else -2**(int(name.lstrip('UInt')) - 1),
        2**(int(name.lstrip('UInt')) - (name[0] != 'U')) - 1), st.just(name)), {}) for name in STD
} | {f'odometer {name} array': (st.builds(
        make.whole_array, st.lists(st.integers(-2**31, 2**31 - 1), max_size=3), st.just(name),
        st.sampled_from([(), ('a',), ('b', 'cd')])), {}) for name in ('Int32', 'Int64')}


@pytest.mark.parametrize('which', MESSAGES)
@settings(max_examples=40, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_chopping_gives_the_rows_of_single_messages(which, monkeypatch, data):
    messages, changes = MESSAGES[which]
    stream = data.draw(st.lists(messages, min_size=1, max_size=20))
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=4)))
    # big endian has no layout: such rows go through deserialize amid the others
    raws = [make.cdr(m, data.draw(st.sampled_from([True, True, True, False]))) for m in stream]
    slot, msgtype = which.split()[0], stream[0].__msgtype__
    settings_ = with_settings(Config(), changes)
    times = [10 + i for i in range(len(raws))]

    def rows(edges):
        reader = make_reader(slot, msgtype, settings_)
        found = []
        for start, stop in zip(edges[:-1], edges[1:], strict=True):
            found += reader.rows(raws[start:stop], times[start:stop], make.deserializer(msgtype))
        return bits(found), reader.form, reader.unreadable

    blocks = rows([0, *cuts, len(raws)])
    with monkeypatch.context() as patch:
        patch.setattr(cdr, 'layout_of', lambda msgtype, raw: None)
        assert rows(range(len(raws) + 1)) == blocks


@pytest.mark.parametrize('which', [name for name in MESSAGES if name[0] in 'io'])
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_readings_are_the_rows_in_plain_numbers(which, data):
    messages, changes = MESSAGES[which]
    stream = data.draw(st.lists(messages, min_size=1, max_size=20))
    raws = [make.cdr(m, data.draw(st.sampled_from([True, True, True, False]))) for m in stream]
    slot, msgtype = which.split()[0], stream[0].__msgtype__

    def read(how):
        reader, found = make_reader(slot, msgtype, with_settings(Config(), changes)), {}
        for k, raw in enumerate(raws):
            for own, rows in getattr(reader, how)([raw], [k], make.deserializer(msgtype)):
                rows = rows if how == 'readings' else readings_of(rows)
                found.setdefault(own, []).extend(
                    repr([list(v) if isinstance(v, tuple) else v for v in row[:4]])
                    for row in rows)
        return found, reader.unreadable

    assert read('readings') == read('rows')


def test_readings_of_an_imu_without_force_have_none():
    message = make.imu(7, f=(4, 5, 6))
    message.linear_acceleration_covariance = np.array([-1.0] + [0.0] * 8)
    reader = make_reader('imu', message.__msgtype__, Config())
    for _ in range(5):
        (_, ((*_, f_i),)), = [(slot, [row[:4] for row in rows]) for slot, rows in reader.readings(
            [make.cdr(message)], [1], None)]
        assert np.isnan(f_i).all()


def test_alike_messages_are_read_without_arrays(monkeypatch):
    """The property above would hold if readings were always made of rows."""
    for slot, message, row in (
            ('imu', make.imu(7, w=(1, 2, 3), f=(4, 5, 6)), (7, 1, (1, 2, 3), (4, 5, 6))),
            ('odometer', make.whole(3), (1, 1, 3)),
            ('odometer', make.joints(7, ['l', 'r'], [5, 6]), (7, 1, 5))):
        raw = make.cdr(message)
        reader = make_reader(slot, message.__msgtype__, Config())
        for _ in range(3):      # these determine frame and wheels
            reader.rows([raw], [0], None)
        with monkeypatch.context() as patch:
            patch.setattr(reader, 'rows', None)
            assert reader.readings([raw], [1], None)[0][1] == [row]


def test_a_layout_is_remembered_for_messages_that_have_it():
    """Not for one that is cut off, nor for one of other lengths; and found again after those."""
    raws = [make.cdr(make.imu(1, frame=frame)) for frame in ('imu', 'other', 'six')]
    first, other, again = (cdr.layout_of(make.imu(1).__msgtype__, raw) for raw in raws)
    assert first.size == len(raws[0])
    assert other.size == len(raws[1]) > first.size
    assert again == first
    for raw in raws:
        layout = cdr.layout_of(make.imu(1).__msgtype__, raw)
        assert cdr.layout_of(make.imu(1).__msgtype__, raw + b'more') is layout
        assert cdr.layout_of(make.imu(1).__msgtype__, raw[:-1]) is None


def test_layouts_do_read_columns():
    """The property above would hold if the block path never ran: here it must."""
    for message in (make.imu(1), make.fix(1, 2, 3), make.joints(1, ['a'], [1]),
                    make.odometry(1, 2), make.twist_stamped(1, 2), make.whole(3),
                    make.whole_array([1], labels=['x'])):
        raws = [make.cdr(message)] * 50
        reader = make_reader({'Imu': 'imu', 'NavSatFix': 'fix'}.get(
            message.__msgtype__.split('/')[-1], 'odometer'), message.__msgtype__, Config())
        (_, block), = reader.rows(raws, range(50), None)   # None: any deserialising would fail
        assert len(block.stamp_ns) == 50


def test_a_recorder_gets_one_leg_from_any_blocks():
    raws = [make.cdr(make.imu(10**9 * i, w=(i, 0, 0), frame='x' * (i % 3))) for i in range(20)]
    legs = []
    for size in (1, 7, 20):
        reader, recorder = make_reader('imu', 'sensor_msgs/msg/Imu', Config()), LegRecorder()
        for i in range(0, 20, size):
            for slot, block in reader.rows(raws[i:i + size], range(i, min(i + size, 20)), None):
                recorder.feed(slot, block)
        legs.append(bits([('imu', recorder.close(3 * 10**9, 15 * 10**9).imu)]))
    assert legs[0] == legs[1] == legs[2]


@pytest.mark.parametrize('message', [
    make.imu(1_700_000_000_123_456_789, w=(1, 2, 3)), make.fix(1, 2, 3), make.whole(-5, 'Int16'),
    make.joints(1, ['l', 'right'], [], [1.0, 2.0]), make.joints(1, ['l'], [1.0], []),
    make.whole_array([1, 2], labels=['abc']), make.odometry(1, 2.5, 'b'), make.twist(1.0),
    make.twist_covariance(1, 2.0)], ids=lambda m: m.__msgtype__)
def test_what_rclpy_serialises_has_the_same_layout(message):
    serialization = pytest.importorskip('rclpy.serialization')
    import importlib
    package, _, name = message.__msgtype__.split('/')
    ros = getattr(importlib.import_module(f'{package}.msg'), name)
    raw = serialization.serialize_message(
        serialization.deserialize_message(make.cdr(message), ros))
    slot = {'Imu': 'imu', 'NavSatFix': 'fix'}.get(name, 'odometer')
    by_columns, by_message, by_rosbags = (
        make_reader(slot, message.__msgtype__, Config()) for _ in range(3))
    wire = by_columns.rows([raw], [5], None)
    big = make.cdr(message, little_endian=False)
    assert bits(wire) == bits(by_rosbags.rows([make.cdr(message)], [5], None))
    assert bits(wire) == bits(by_message.rows(
        [big], [5], lambda raw: serialization.deserialize_message(raw, ros)))


def test_a_nan_that_signals_is_one_in_silence():
    position = np.zeros((2, 3))
    position.view(np.uint64)[1] = 0x7ff0000000000001
    ns = np.zeros(2, np.int64)
    with np.errstate(all='raise'):
        fixes = _fix(ns, ns, position, np.zeros((2, 9)), *np.zeros((2, 2, 1)))
        q_ni = np.pad(position, ((0, 0), (0, 1)))
        heading = _heading(ns, ns, q_ni, np.ones((2, 1)), np.ones((2, 1)))
    assert np.isnan(fixes.latitude).tolist() == [False, True]
    assert np.isnan(heading.yaw_variance).tolist() == [True, False]     # of zeros: no orientation
