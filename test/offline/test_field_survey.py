# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal inspect finds the odometer in messages of any type, by the path of the fixes."""

import shlex

from drives import drive
import numpy as np
import pytest
import ros_messages as make
from survey_bags import encoders, inspected, replayed, sigmas_off, town, types, write

from odocal_ros.offline.odometer_search import FieldCollector

pytestmark = pytest.mark.slow


def test_two_counters_of_an_array_are_found_across_rollovers(tmp_path, capsys):
    made = town(400.0)
    path = write(tmp_path / 'bag', made, encoders(made, ('ticks', 'speed_kmh')))
    found, text = inspected(path, capsys)
    assert '/encoders.ticks[1] grows with distance, 0.0' in text
    fields = next(t for t in found['topics'] if t['name'] == '/encoders')['fields']['found']
    assert {one['path'] for one in fields} == {'ticks[0]', 'ticks[1]', 'speed_kmh'}
    assert {'odometer.left=ticks[1]', 'odometer.right=ticks[0]', 'odometer.wrap=65536'} <= set(
        shlex.split(found['command']))
    assert found['drive']['scale_unit'] == 'm/pulse'
    content = replayed(found['command'], tmp_path / 'out')
    for side, truth in zip(('left', 'right'), made.truth.wheel_scales, strict=True):
        assert sigmas_off(content, f'scale_factor_{side}', truth) < 4


@pytest.mark.parametrize(('field', 'quantity', 'factor'), [
    ('speed_kmh', 'rate', 1 / 3.6), ('delta', 'increment', None), ('motors', 'cumulative',
                                                                   1 / 0.31)])
def test_rate_increment_and_cumulative_fields_are_found(tmp_path, capsys, field, quantity, factor):
    made = town()
    path = write(tmp_path / 'bag', made, encoders(made, (field,)))
    found, _ = inspected(path, capsys)
    fields = next(t for t in found['topics'] if t['name'] == '/encoders')['fields']
    (one,) = fields['found']
    assert one['path'].startswith(field)
    assert one['quantity'] == quantity
    truth = factor or made.truth.wheel_scales[0]
    assert one['scale'] == pytest.approx(truth, rel=0.02)      # chords of intervals of 4 s
    content = replayed(found['command'], tmp_path / 'out')
    assert content['result']['scale_factor']['value'] == pytest.approx(truth, rel=0.005)


def test_a_field_is_preferred_to_a_number_that_does_not_follow_the_fixes(tmp_path, capsys):
    made = town()
    path = write(tmp_path / 'bag', made, encoders(made, ('delta',)) + [
        ('/battery_voltage', stamp, make.real(24.0 + np.sin(stamp * 1e-9), 'Float32'))
        for stamp in made.odometer.stamp_ns.tolist()])
    found, _ = inspected(path, capsys)
    assert found['mapping']['odometer'] == '/encoders'
    # a topic named by the user is kept
    found, _ = inspected(path, capsys, '--odometer-topic', '/battery_voltage')
    assert found['mapping']['odometer'] == '/battery_voltage'


def test_the_speed_of_autoware_is_the_odometer_and_the_steering_is_not(tmp_path, capsys):
    made = drive(scenario='town', duration=300.0, seed=4, imu_grade='tactical', fix_noise='rtk',
                 odometer='speed')
    velocity, steering = (types().types[f'autoware_vehicle_msgs/msg/{name}Report']
                          for name in ('Velocity', 'Steering'))
    time = make.kind('builtin_interfaces/msg/Time')
    rows = []
    for stamp, v in zip(made.odometer.stamp_ns.tolist(), made.odometer.value, strict=True):
        rows.append(('/vehicle/status/velocity_status', stamp, velocity(
            header=make.header(stamp), longitudinal_velocity=v, lateral_velocity=0.0,
            heading_rate=0.0)))
        rows.append(('/vehicle/status/steering_status', stamp, steering(
            stamp=time(sec=0, nanosec=0), steering_tire_angle=0.1 * np.sin(stamp * 1e-9))))
    path = write(tmp_path / 'bag', made, rows)
    found, text = inspected(path, capsys)
    assert found['mapping']['odometer'] == '/vehicle/status/velocity_status'
    assert 'no numeric field grows with the distance between the fixes (1 tried)' in text
    content = replayed(found['command'], tmp_path / 'out')
    assert sigmas_off(content, 'scale_factor', made.truth.scale) < 4


def test_wheels_are_the_joints_that_follow_the_fixes(tmp_path, capsys):
    """A spinning lidar turns farther than the wheels; the joints with wheel names steer."""
    made = town()
    names = ['lidar', 'left_wheel', 'right_wheel', 'b', 'a']
    t = made.odometer.stamp_ns.tolist()
    rows = []
    for i, stamp in enumerate(t):
        steer = 0.3 * np.sin(i / 50)
        rows.append(('/arm/joint_states', stamp, make.joints(stamp, ['elbow'], [i * 0.01])))
        rows.append(('/joint_states', stamp, make.joints(stamp, names, [
            i * 3.0, steer, steer, made.odometer.value[i] * 0.05,
            made.odometer_right.value[i] * 0.05])))
    path = write(tmp_path / 'bag', made, rows)
    found, text = inspected(path, capsys)
    assert found['mapping']['odometer'] == '/joint_states'
    assert found['not_following'] == ['/arm/joint_states']
    assert found['command'].endswith('--set odometer.left=b --set odometer.right=a')
    assert all(f'  {name} travels' in text for name in names)
    assert ': a wheel, 0.42' in text
    content = replayed(found['command'], tmp_path / 'out')
    for side, truth in zip(('left', 'right'), made.truth.wheel_scales, strict=True):
        assert sigmas_off(content, f'scale_factor_{side}', truth / 0.05) < 4


def test_the_number_of_searched_fields_and_messages_is_limited():
    kind = types().types['mycar_msgs/msg/Encoders']
    motor = types().types['mycar_msgs/msg/Motor']
    message = kind(header=make.header(0), ticks=np.zeros(4, np.uint16), messages=0,
                   temperature=0.0, speed_kmh=0.0, delta=0, east=np.zeros(300),
                   motors=[motor(rpm=0.0, angle=0.0)] * 100)
    raw = bytes(types().serialize_cdr(message, kind.__msgtype__))
    requests = []

    def deserialize(raw):
        requests.append(raw)
        return message
    n = 100_000
    fields = FieldCollector(n)
    for k in range(10):
        fields.rows([raw] * (n // 10), range(k * n // 10, (k + 1) * n // 10), deserialize)
    assert len(fields.paths) == 8 + 16 + 2 * 16
    assert len(requests) < 400_000 / len(fields.paths) + 1
    image = FieldCollector(5)
    image.rows([bytes(2**20)] * 5, range(5), deserialize)
    assert image.error == 'no numeric field'
