# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Bags for tests, written by rosbags."""

import numpy as np
import ros_messages as make
from rosbags import rosbag1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
T0 = 1_700_000_000 * 10**9


def write(path, rows, storage='mcap', compression='none', types=None, store=None):
    """
    Write (topic, bag time, message or CDR bytes) rows in the order given; return the path.

    Bytes need the type of their topic in ``types``, foreign ones in ``store``. ``rosbag1`` gives a
    file.
    """
    types = {topic: getattr(m, '__msgtype__', '') for topic, _, m in rows} | (types or {})
    if storage == 'rosbag1':
        bag = rosbag1.Writer(path)
        if compression != 'none':
            bag.set_compression(bag.CompressionFormat[compression.upper()])
    else:
        bag = Writer(path, version=9, storage_plugin=STORAGES[storage])
        if compression != 'none':
            bag.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with bag:
        ends = {topic: bag.add_connection(topic, kind, typestore=store or make.store())
                for topic, kind in types.items()}
        for topic, time_ns, message in rows:
            raw = message if isinstance(message, bytes) else make.cdr(message)
            if storage == 'rosbag1':
                raw = make.store().cdr_to_ros1(raw, types[topic])
            bag.write(ends[topic], time_ns, raw)
    return path


def drive(seconds=10.0, start_ns=T0):
    """Return rows of a short straight drive: IMU 100 Hz, counter 50 Hz, fixes 5 Hz."""
    rows = []
    noise = np.random.default_rng(3).normal(size=(round(seconds * 100), 6))
    for i in range(round(seconds * 100)):
        t = start_ns + i * 10**7
        rows.append(('/imu/data', t + 1000, make.imu(t, w=noise[i, :3], f=noise[i, 3:])))
        if i % 2 == 0:
            rows.append(('/odometer', t + 2000, make.whole(5 * i)))
        if i % 20 == 0:
            rows.append(('/fix', t + 3000, make.fix(t, 48.0, 11.0 + i * 1e-6, 500.0)))
    return rows
