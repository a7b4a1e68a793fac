# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Convert the recording of a Husky in the tests of robot_localization to the bag of our tests.

``python -m tools.husky_bag test1.bag --out FOLDER`` writes FOLDER/bag. ``odocal try test1.bag``
also reads the recording itself; the bag has renamed topics, pulses and an IMU in vehicle axes.
"""

from pathlib import Path
import sys

import numpy as np

from odocal_ros.bagio import encode
from odocal_ros.bagio.write import write_bag
from odocal_ros.data.samples import FixSamples, ImuSamples, OdometerSamples
from odocal_ros.errors import BadData
from tools.converter import run

KINDS = ('sensor_msgs/msg/Imu', 'nav_msgs/msg/Odometry', 'sensor_msgs/msg/NavSatFix')
R_BI = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])    # Rz(-90) Rx(90) deg
K0 = 0.001               # m, of a pulse derived from the pose of the wheel odometry


def messages(recording: Path):
    """Return (header stamp, arrival, message) of the IMU, the wheel odometry and the fixes."""
    from rosbags.highlevel import AnyReader, AnyReaderError
    try:
        with AnyReader([recording]) as bag:
            found = []
            for kind in KINDS:
                links = [link for link in bag.connections if link.msgtype == kind]
                if len({link.topic for link in links}) != 1:
                    raise BadData(f'{recording}: {len(links)} topics of type {kind}, 1 expected')
                rows = [(arrival, bag.deserialize(raw, kind))
                        for _, arrival, raw in bag.messages(links)]
                stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for _, m in rows]
                found.append((np.array(stamps), np.array([a for a, _ in rows]),
                              [m for _, m in rows]))
            return found
    except AnyReaderError as error:
        raise BadData(f'{recording}: {error}') from None


def vectors(messages_, *path):
    """Return x, y, z of a field of messages, (n, 3)."""
    rows = messages_
    for name in path:
        rows = [getattr(one, name) for one in rows]
    return np.array([(one.x, one.y, one.z) for one in rows])


def topics(imu, odometry, fixes):
    """Yield the topics of the bag."""
    stamp, arrival, rows = imu
    turn, force = vectors(rows, 'angular_velocity'), vectors(rows, 'linear_acceleration')
    n = len(stamp)
    for name, R, frame in (('/imu/data', np.eye(3), 'imu_link'),
                           ('/imu/data_flu', R_BI, 'imu_flu')):
        yield encode.imu(name, ImuSamples(
            stamp, arrival, turn @ R.T, force @ R.T, np.tile([0.0, 0.0, 0.0, 1.0], (n, 1)),
            np.full(n, np.nan)), frame)
    stamp, arrival, rows = odometry
    speed = vectors(rows, 'twist', 'twist', 'linear')[:, 0]
    yield encode.twist('/vehicle/twist', OdometerSamples(stamp, arrival, speed))
    yield encode.counter('/odometer/pulses_derived', OdometerSamples(
        arrival, arrival, np.round(travel(rows) / K0).astype(np.int64)))
    stamp, arrival, rows = fixes
    yield encode.fix('/fix', FixSamples(
        stamp, arrival, np.deg2rad([m.latitude for m in rows]),
        np.deg2rad([m.longitude for m in rows]), np.array([m.altitude for m in rows]),
        np.array([m.position_covariance for m in rows]).reshape(-1, 3, 3),
        np.array([m.position_covariance_type for m in rows], np.int64),
        np.array([m.status.status for m in rows], np.int64)), 'gps')


def travel(rows):
    """Return the path length of the poses of a wheel odometry, m, less what it drives back."""
    steps = np.diff(vectors(rows, 'pose', 'pose', 'position')[:, :2], axis=0)
    heading = np.array([2 * np.arctan2(m.pose.pose.orientation.z, m.pose.pose.orientation.w)
                        for m in rows])[1:]
    ahead = steps[:, 0] * np.cos(heading) + steps[:, 1] * np.sin(heading)
    return np.append(0.0, np.cumsum(np.sign(ahead) * np.hypot(*steps.T)))


def convert(recording: Path, out: Path, force: bool) -> Path:
    """Write the bag of the recording."""
    return write_bag(out / 'bag', [*topics(*messages(recording))], force=force)


def main(argv=None) -> int:
    """Convert the recording; return 0, 2 for an unusable one."""
    return run('husky_bag', 'test1.bag of robot_localization', convert, argv)


if __name__ == '__main__':
    sys.exit(main())
