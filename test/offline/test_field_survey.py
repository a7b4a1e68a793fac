# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal inspect finds the odometer in messages of any type, by the path of the fixes."""

from contextlib import closing
from functools import cache
import json
import shlex
import sqlite3

from drives import changed, drive
import numpy as np
import pytest
import ros_bags
import ros_messages as make
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from odocal_ros.bagio.encode import counter, fix, imu, velocity
from odocal_ros.bagio.write import write_bag
from odocal_ros.offline import inspection_text
from odocal_ros.offline.cli import main
from odocal_ros.offline.odometer_search import drop_weak_fields, FieldCollector

pytestmark = pytest.mark.slow
MOTOR = 'float32 rpm\nfloat64 angle\n'
ENCODERS = ('std_msgs/Header header\nuint16[4] ticks\nuint32 messages\nfloat32 temperature\n'
            'float64 speed_kmh\nint16 delta\nfloat64[] east\nmycar_msgs/Motor[] motors\n')
VELOCITY = ('std_msgs/Header header\nfloat32 longitudinal_velocity\nfloat32 lateral_velocity\n'
            'float32 heading_rate\n')
STEERING = 'builtin_interfaces/Time stamp\nfloat32 steering_tire_angle\n'


@cache
def types():
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in (('mycar_msgs/msg/Motor', MOTOR), ('mycar_msgs/msg/Encoders', ENCODERS),
                       ('autoware_vehicle_msgs/msg/VelocityReport', VELOCITY),
                       ('autoware_vehicle_msgs/msg/SteeringReport', STEERING),
                       ('can_msgs/msg/Frame', 'uint32 id\nuint8[2] data\n')):
        store.register(get_types_from_msg(text, name))
    return store


def write(path, made, more, has_fixes=True):
    """Write IMU and fixes of a drive, and (topic, bag time, message) rows of its vehicle."""
    topics = [imu('/imu/data', made.imu), *[fix('/fix', made.fix)] * has_fixes]
    rows = [(topic.name, topic.msgtype, int(t), row.tobytes()) for topic in topics
            for t, row in zip(topic.time_ns, topic.pack(slice(0, len(topic.time_ns))),
                              strict=True)]
    rows += [(name, message.__msgtype__, t, bytes(types().serialize_cdr(
        message, message.__msgtype__))) for name, t, message in more]
    with Writer(path, version=9, storage_plugin=ros_bags.STORAGES['mcap']) as bag:
        ends = {}
        for name, kind, time_ns, raw in sorted(rows, key=lambda row: row[2]):
            if name not in ends:
                ends[name] = bag.add_connection(name, kind, typestore=types())
            bag.write(ends[name], time_ns, raw)
    return path


def town(duration=240.0):
    return drive(scenario='town', duration=duration, seed=4, imu_grade='tactical', fix_noise='rtk',
                 two_wheels=True, odometer_rate=20.0)


def encoders(made, keep):
    """Return the messages of a vehicle; keep: fields that are not set to zero."""
    kind, motor = (types().types[f'mycar_msgs/msg/{name}'] for name in ('Encoders', 'Motor'))
    left, right = made.odometer.value, made.odometer_right.value
    t = (made.odometer.stamp_ns - made.odometer.stamp_ns[0]) * 1e-9
    speed = np.gradient((left + right) / 2 * made.truth.scale, t)
    rows = []
    for i, stamp in enumerate(made.odometer.stamp_ns.tolist()):
        has = {'ticks': np.array([right[i], left[i], 0, 7 * i], np.int64).astype(np.uint16),
               'messages': i, 'temperature': 20 + 30 * (1 - np.exp(-i / 3000)),
               'speed_kmh': 3.6 * speed[i], 'delta': int(left[i] - left[max(i - 1, 0)])}
        empty = {'ticks': np.zeros(4, np.uint16), 'speed_kmh': 0.0, 'delta': 0}
        has |= {name: value for name, value in empty.items() if name not in keep}
        angle = 0.31 * left[i] * made.truth.scale if 'motors' in keep else 0.0
        engine = 800 + 500 * abs(speed[i]) / np.clip(speed[i] // 6 + 1, 1, 5)
        rows.append(('/encoders', stamp, kind(
            header=make.header(stamp), **has, east=np.zeros(2),
            motors=[motor(rpm=engine, angle=0.0), motor(rpm=0.0, angle=angle)])))
    return rows


def inspected(path, capsys, *options):
    assert main(['inspect', str(path), *options, '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    return found, inspection_text.text(found)


def replayed(command, folder):
    assert main([*shlex.split(command)[1:], '--output', str(folder), '--set',
                 'verdict.max_yaw_sigma=0.1', '--set', 'output.formats=[params]']) in (0, 1)
    return json.loads((folder / 'calibration.json').read_text())


def sigmas_off(content, name, truth):
    found = content['result'][name]
    return abs(found['value'] - truth) / found['sigma']


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


def plain(path, made, *more, **changes):
    """Write IMU, fixes and counter of a drive, and more topics."""
    return write_bag(path, [imu('/imu/data', changed(made.imu, **changes)), fix('/fix', made.fix),
                            counter('/odometer', made.odometer), *more])


def test_the_command_removes_a_sigma_limit_that_rejects_most_fixes(tmp_path, capsys):
    path = plain(tmp_path / 'bag', drive(scenario='town', duration=200.0, seed=4, fix_sigma=1.0))
    assert 'gnss.max_sigma' not in inspected(path, capsys)[0]['command']
    found, _ = inspected(path, capsys, '--set', 'gnss.max_sigma=0.5')
    assert found['command'].endswith('--set gnss.max_sigma=nan')


def test_no_axes_are_given_without_an_accelerometer(tmp_path, capsys):
    made = drive(scenario='town', duration=200.0, seed=4)
    found, text = inspected(plain(tmp_path / 'bag', made, f_i=lambda f: 0 * f), capsys)
    assert 'gravity' not in text
    assert 'an upright IMU is assumed' in text
    assert found['mounting']['rpy'] is None


def test_a_component_of_a_velocity_is_not_called_speed(tmp_path, capsys):
    made = drive(scenario='yard', duration=300.0, seed=4, fix_sigma=0.2, velocity_sigma=0.05)
    found, text = inspected(plain(tmp_path / 'bag', made, velocity('/vel', made.velocity)), capsys)
    block = text.partition('\n/vel\n')[2].partition('\n\n')[0]
    assert block.strip().startswith('one component of a velocity')
    assert found['not_following'] == ['/vel']


def without_definitions(path, store):
    """Return a bag with the content of another, as an sqlite3 bag without definitions."""
    with AnyReader([path], default_typestore=store) as reader:
        rows = [(c.topic, c.msgtype, t, raw) for c, t, raw in reader.messages()]
    out = ros_bags.write(path.parent / 'foxy', [(topic, t, raw) for topic, _, t, raw in rows],
                         'sqlite3', types={topic: kind for topic, kind, *_ in rows}, store=store)
    with closing(sqlite3.connect(out / 'foxy.db3')) as db, db:
        db.execute('DELETE FROM message_definitions')
    return out


def estimates(made):
    """Return velocities by a filter, at the time of each odometer message."""
    speed = np.gradient(made.odometer.value * made.truth.scale, made.odometer.stamp_ns * 1e-9)
    return [('/odometry/filtered', t, make.odometry(t, v)) for t, v in zip(
        made.odometer.stamp_ns.tolist(), speed, strict=True)]


def test_a_field_is_preferred_to_an_estimate_that_follows_the_fixes(tmp_path, capsys):
    made = town()
    path = write(tmp_path / 'bag', made, encoders(made, ('speed_kmh',)) + estimates(made))
    found, text = inspected(path, capsys)
    assert found['mapping']['odometer'] == '/encoders'
    assert 'an estimate by its name' not in text
    # without its definition only the estimate is left
    found, text = inspected(without_definitions(path, types()), capsys)
    assert found['mapping']['odometer'] == '/odometry/filtered'
    text = ' '.join(text.split())
    assert 'note: /odometry/filtered is an estimate by its name' in text
    assert 'does not define their types: /encoders (mycar_msgs/msg/Encoders). If one' in text
    assert 'an estimate by its name' not in inspected(
        path, capsys, '--odometer-topic', '/odometry/filtered')[1]


def test_a_missing_odometer_names_topics_of_undefined_types(tmp_path, capsys):
    made = town()
    path = without_definitions(write(tmp_path / 'bag', made, encoders(made, ('ticks',))), types())
    _, text = inspected(path, capsys)
    text = ' '.join(text.split())
    assert 'no topic for the odometer; not searched for an odometer, because the bag does' in text
    assert '/encoders (mycar_msgs/msg/Encoders). If one of them is the odometer, convert' in text


def test_raw_can_frames_are_not_searched(tmp_path, capsys):
    """Frames of several senders share one topic: a byte of it is no odometer."""
    made = town()
    frame = types().types['can_msgs/msg/Frame']
    counts = made.odometer.value.astype(np.int64) // 8
    path = write(tmp_path / 'bag', made, [
        ('/can', t, frame(id=0x1a0, data=np.array([count // 256, count % 256], np.uint8)))
        for t, count in zip(made.odometer.stamp_ns.tolist(), counts.tolist(), strict=True)])
    found, text = inspected(path, capsys)
    assert 'odometer' not in found['mapping']
    text = ' '.join(text.split())
    assert 'no topic for the odometer; /can: raw CAN frames. Decode the wheel speeds' in text


def test_missing_fixes_name_the_poses_of_the_bag(tmp_path, capsys):
    """The positions of navsat_transform are an Odometry, which only the user can select."""
    made = town()
    path = write(tmp_path / 'bag', made, [('/odometry/gps', t, message) for _, t, message in
                                          estimates(made)] + [
        ('/ticks', t, make.whole(int(count))) for t, count in zip(
            made.odometer.stamp_ns.tolist(), made.odometer.value.tolist(), strict=True)],
        has_fixes=False)
    text = ' '.join(inspected(path, capsys)[1].split())
    assert ('no topic for the fixes; /odometry/gps: poses of nav_msgs/Odometry. If their '
            'positions do not contain the odometer, add --fix-topic /odometry/gps.') in text


def test_gyro_and_accelerometer_on_two_topics_are_named(tmp_path, capsys):
    made = drive(scenario='town', duration=200.0, seed=4)
    gyro = changed(made.imu, f_i=lambda f: 0 * f)
    accelerometer = changed(made.imu, w_i=lambda w: 0 * w)
    topics = [fix('/fix', made.fix), counter('/odometer', made.odometer),
              imu('/camera/gyro', gyro), imu('/camera/accel', accelerometer)]
    found, text = inspected(write_bag(tmp_path / 'two', topics), capsys)
    assert found['mapping']['imu'] == '/camera/gyro'      # not the first by name
    assert 'note: /camera/gyro has only turn rates, /camera/accel only' in ' '.join(text.split())
    found, text = inspected(write_bag(tmp_path / 'three', [
        *topics, imu('/camera/imu', made.imu)]), capsys)
    assert found['mapping']['imu'] == '/camera/imu'
    assert 'only turn rates' not in text


def test_without_odometer_and_imu_standstills_are_not_mentioned(tmp_path, capsys):
    made = drive(scenario='town', duration=200.0, seed=4)
    _, text = inspected(write_bag(tmp_path / 'bag', [fix('/fix', made.fix)]), capsys)
    assert 'stand' not in text
    assert 'all data for a calibration' not in text


def test_a_field_that_explains_much_less_than_the_best_is_removed():
    """Engine speed explains up to 0.93 of the distances; another topic has the true speed."""
    fields = [{'found': [{'path': 'speed', 'explained': 0.999}]},
              {'found': [{'path': 'rpm', 'explained': 0.93}, {'path': 'v', 'explained': 0.99}]}]
    drop_weak_fields(fields)
    assert [[one['path'] for one in facts['found']] for facts in fields] == [['speed'], ['v']]


def numbers(path, made, values):
    """Write IMU and fixes of a drive, and one plain number per odometer message."""
    return write(path, made, [('/distance', stamp, make.real(value)) for stamp, value in zip(
        made.odometer.stamp_ns.tolist(), values, strict=True)])


@pytest.mark.parametrize('kind', ['distance', 'speed'])
def test_the_fixes_decide_whether_a_float_is_a_distance_or_a_speed(tmp_path, capsys, kind):
    """By its type a std_msgs/Float64 is a speed; a trip meter has the same type."""
    made = town()
    trip = (made.odometer.value + made.odometer_right.value) / 2 * made.truth.scale
    t = (made.odometer.stamp_ns - made.odometer.stamp_ns[0]) * 1e-9
    path = numbers(tmp_path / 'bag', made, trip if kind == 'distance' else np.gradient(trip, t))
    found, text = inspected(path, capsys)
    block = text.partition('\n/distance\n')[2].partition('\n\n')[0]
    is_distance = kind == 'distance'
    assert block.strip().startswith('running count: ' if is_distance else 'speed: ')
    assert ('--set odometer.quantity=cumulative' in block) == is_distance
    assert ('odometer.quantity=cumulative' in found['command']) == is_distance
    assert found['drive']['rough_scale'] == pytest.approx(1.0, rel=0.02)
    content = replayed(found['command'], tmp_path / 'out')
    assert content['result']['scale_factor']['value'] == pytest.approx(1.0, rel=0.005)
