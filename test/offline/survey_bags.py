# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags of vehicles with messages of their own, and what odocal inspect finds in them."""

from functools import cache
import json
import shlex

from drives import drive
import numpy as np
import ros_bags
import ros_messages as make
from rosbags.rosbag2 import Writer
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

from odocal_ros.bagio.encode import fix, imu
from odocal_ros.offline import inspection_text
from odocal_ros.offline.cli import main

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
