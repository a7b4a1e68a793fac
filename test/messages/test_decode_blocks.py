# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages in blocks, single and as plain numbers give identical rows."""

import dataclasses
import importlib

from hypothesis import given, HealthCheck, settings, strategies as st
import numpy as np
import pytest
import ros_messages as make
from test_decode import span, STD

from odocal_ros.data.leg import LegRecorder
from odocal_ros.data.samples import readings_of
from odocal_ros.messages import cdr
from odocal_ros.messages.decode import make_reader
from odocal_ros.messages.message_fields import _build_fixes, _build_headings
from odocal_ros.settings.config import Config, with_settings


def bits(pairs):
    """Return all rows of (slot, block) pairs as bytes, so that NaN and -0.0 count."""
    rows: dict = {}
    for slot, block in pairs:
        for f in dataclasses.fields(block):
            array_column = getattr(block, f.name)
            rows.setdefault((slot, f.name, array_column.dtype.str),
                            []).append(array_column.tobytes())
    return {key: b''.join(parts) for key, parts in rows.items()}


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
} | {f'odometer {name}': (st.builds(make.whole, st.integers(*span(name)), st.just(name)), {})
     for name in STD} | {f'odometer {name} array': (st.builds(
        make.whole_array, st.lists(st.integers(-2**31, 2**31 - 1), max_size=3), st.just(name),
        st.sampled_from([(), ('a',), ('b', 'cd')])), {}) for name in ('Int32', 'Int64')}


def drawn(which, data):
    """Return serialised messages, their type, and a function that makes a reader of them."""
    messages, changes = MESSAGES[which]
    stream = data.draw(st.lists(messages, min_size=1, max_size=20))
    # big-endian messages have no layout: they are deserialised among the others
    raws = [make.cdr(m, data.draw(st.sampled_from([True, True, True, False]))) for m in stream]
    slot, msgtype = which.split()[0], stream[0].__msgtype__
    return raws, msgtype, lambda: make_reader(slot, msgtype, with_settings(Config(), changes))


@pytest.mark.parametrize('which', MESSAGES)
@settings(max_examples=40, deadline=None,
          suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_division_into_blocks_gives_the_rows_of_single_messages(which, monkeypatch, data):
    raws, msgtype, new_reader = drawn(which, data)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(raws)), max_size=4)))
    times = [10 + i for i in range(len(raws))]

    def rows(edges):
        reader, found = new_reader(), []
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
    raws, msgtype, new_reader = drawn(which, data)

    def read(how):
        reader, found = new_reader(), {}
        for k, raw in enumerate(raws):
            for slot, rows in getattr(reader, how)([raw], [k], make.deserializer(msgtype)):
                rows = rows if how == 'readings' else readings_of(rows)
                found.setdefault(slot, []).extend(
                    repr([list(v) if isinstance(v, tuple) else v for v in row[:4]])
                    for row in rows)
        return found, reader.unreadable

    assert read('readings') == read('rows')


def test_readings_of_an_imu_without_accelerometer_have_nan_forces():
    message = make.imu(7, f=(4, 5, 6))
    message.linear_acceleration_covariance = np.array([-1.0] + [0.0] * 8)
    reader = make_reader('imu', message.__msgtype__, Config())
    for _ in range(5):
        (_, ((*_, f_i),)), = [(slot, [row[:4] for row in rows]) for slot, rows in reader.readings(
            [make.cdr(message)], [1], None)]
        assert np.isnan(f_i).all()


def test_messages_of_equal_layout_are_read_without_arrays(monkeypatch):
    """The property above would also hold if readings were always made from rows."""
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


def test_a_layout_is_reused_for_messages_of_the_same_lengths():
    """Truncated messages and messages of other lengths do not use it; later ones find it again."""
    raws = [make.cdr(make.imu(1, frame=frame)) for frame in ('imu', 'other', 'six')]
    first, other, again = (cdr.layout_of(make.imu(1).__msgtype__, raw) for raw in raws)
    assert first.size == len(raws[0])
    assert other.size == len(raws[1]) > first.size
    assert again == first
    for raw in raws:
        layout = cdr.layout_of(make.imu(1).__msgtype__, raw)
        assert cdr.layout_of(make.imu(1).__msgtype__, raw + b'more') is layout
        assert cdr.layout_of(make.imu(1).__msgtype__, raw[:-1]) is None


def test_layouts_are_used_to_read_columns():
    """The property above would also hold if layouts were never used."""
    for slot, message in (('imu', make.imu(1)), ('fix', make.fix(1, 2, 3)),
                          *(('odometer', one) for one in (
                              make.joints(1, ['a'], [1]), make.odometry(1, 2), make.whole(3),
                              make.twist_stamped(1, 2), make.whole_array([1], labels=['x'])))):
        reader = make_reader(slot, message.__msgtype__, Config())
        # None: any deserialising would fail
        (_, block), = reader.rows([make.cdr(message)] * 50, range(50), None)
        assert len(block.stamp_ns) == 50


def test_the_leg_of_a_recorder_does_not_depend_on_the_block_size():
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
    make.imu(1_700_000_000_123_456_789, w=(1, 2, 3)), make.fix(1, 2, 3),
    make.whole(-5, 'Int16'),
    make.joints(1, ['l', 'right'], [], [1.0, 2.0]), make.joints(1, ['l'], [1.0], []),
    make.whole_array([1, 2], labels=['abc']), make.odometry(1, 2.5, 'b'), make.twist(1.0),
    make.twist_covariance(1, 2.0)], ids=lambda m: m.__msgtype__)
def test_messages_serialised_by_rclpy_have_the_same_layout(message):
    serialization = pytest.importorskip('rclpy.serialization')
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


def test_a_signalling_nan_is_read_without_a_floating_point_error():
    position = np.zeros((2, 3))
    position.view(np.uint64)[1] = 0x7ff0000000000001
    ns = np.zeros(2, np.int64)
    with np.errstate(all='raise'):
        fixes = _build_fixes(ns, ns, position, np.zeros((2, 9)), *np.zeros((2, 2, 1)))
        q_ni = np.pad(position, ((0, 0), (0, 1)))
        heading = _build_headings(ns, ns, q_ni, np.ones((2, 1)), np.ones((2, 1)))
    assert np.isnan(fixes.latitude).tolist() == [False, True]
    assert np.isnan(heading.yaw_variance).tolist() == [True, False]     # of zeros: no orientation
