# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What odocal inspect says of topics without an odometer, and of the settings of a drive."""

from contextlib import closing
import sqlite3

from drives import changed, drive
import numpy as np
import pytest
import ros_bags
import ros_messages as make
from rosbags.highlevel import AnyReader
from survey_bags import encoders, inspected, replayed, town, types, write

from odocal_ros.bagio.encode import counter, fix, imu, velocity
from odocal_ros.bagio.write import write_bag
from odocal_ros.offline.odometer_search import drop_weak_fields

pytestmark = pytest.mark.slow


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
