# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Seeded mutations of the meaning of messages; every message stays well-formed.

Each takes a random.Random and the rows of a bag by topic, and returns the factors (least,
largest) of the true scale factor; an estimate may lie between both.
"""

from contextlib import closing
import math
import sqlite3
import struct

import numpy as np

from odocal_ros.messages.cdr import FRAME_OFFSET, layout_of
from odocal_ros.messages.message_fields import FIX, IMU

SAME = (1.0, 1.0)
SIGMAS = 5.0
NAMES = {'scale_factor': 'scale', 'yaw_mounting_angle': 'yaw', 'pitch_mounting_angle': 'pitch'}
COUNTER, JOINTS = 'std_msgs/msg/Int64', 'sensor_msgs/msg/JointState'
RATES = [f'angular_velocity.{axis}' for axis in 'xyz']
FORCES = [f'linear_acceleration.{axis}' for axis in 'xyz']
DEG, G = 180 / math.pi, 9.80665


def ranges(truth, factors=None):
    """Return the least and largest true value of each name; factors: of the scale."""
    return {name: sorted(getattr(truth, short) * x for x in (
        factors if factors and short == 'scale' else SAME)) for name, short in NAMES.items()}


def worst_error(found, true):
    """Return the largest error over sigma of values, name to (value, sigma), and a text."""
    worst, what = 0.0, ''
    for name, (least, largest) in true.items():
        value, sigma = found.get(name, (None, None))
        if value is None or not sigma:
            continue
        off = max(least - value, value - largest, 0.0) / sigma
        if not off <= worst:
            worst, what = off, (f'{name} {value:.6g} +- {sigma:.2g}, {least:.6g} to '
                                f'{largest:.6g} is true')
    return worst, what


def change_sqlite(rng, file, mutation):
    """Change the rows of a database; return the factors of the true scale."""
    with closing(sqlite3.connect(file)) as db, db:
        topics = dict(db.execute('SELECT id, type FROM topics'))
        rows = {kind: [] for kind in topics.values()}
        for topic, time_ns, data in db.execute(
                'SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id'):
            rows[topics[topic]].append((time_ns, data))
        factors = mutation(rng, rows)
        ids = {kind: topic for topic, kind in topics.items()}
        db.execute('DELETE FROM messages')
        db.executemany('INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)',
                       sorted(((ids[kind], t, bytes(data)) for kind, one in rows.items()
                               for t, data in one), key=lambda row: row[1]))
    return factors


def put(kind, data, fields, change):
    """Return a message with the values of some fields changed."""
    data, layout = bytearray(data), layout_of(kind, bytes(data))
    places = [np.ndarray(1, form, data, at) for at, form, _ in map(layout.find, fields)]
    for place, value in zip(places, change(*(place[0].item() for place in places)), strict=True):
        place[0] = value
    return bytes(data)


def put_all(rows, kind, fields, change, which=slice(None)):
    """Change fields of some messages of a type."""
    rows[kind][which] = [(t, put(kind, data, fields, change)) for t, data in rows[kind][which]]


def odometer_of(rows):
    kind = COUNTER if COUNTER in rows else JOINTS
    return kind, ['data'] if kind == COUNTER else ['position[0]']


def some_range(rng, n):
    """Return a part of n rows, up to all that follow."""
    begin = rng.randrange(n // 10, n - n // 10)
    return slice(begin, n if rng.random() < 0.3 else rng.randrange(begin, n) + 1)


def second_imu(rng, rows):
    """Replace some messages of the IMU by those of a second one that is rotated about z."""
    angle = rng.uniform(-3.0, 3.0)
    c, s = math.cos(angle), math.sin(angle)
    which = slice(0, None, rng.choice([2, 2, 3, 10]))
    for fields in (RATES[:2], FORCES[:2]):
        put_all(rows, IMU, fields, lambda x, y: (c * x - s * y, s * x + c * y), which)
    rows[IMU][which] = [
        (t, data[:FRAME_OFFSET] + bytes([data[FRAME_OFFSET] ^ 1]) + data[FRAME_OFFSET + 1:])
        for t, data in rows[IMU][which]]
    return SAME


def axes(rng, rows):
    """Send the axes of gyro or accelerometer in another order or with other signs."""
    order = rng.sample(range(3), 3)
    signs = [rng.choice([1.0, -1.0]) for _ in order]
    put_all(rows, IMU, rng.choice([RATES, RATES, FORCES]),
            lambda *x: [sign * x[k] for sign, k in zip(signs, order, strict=True)])
    return SAME


def units(rng, rows):
    """Send a topic in another unit; the true scale factor changes with that of the odometer."""
    kind, fields = odometer_of(rows)
    name, fields, factor = rng.choice([
        (IMU, RATES, DEG), (IMU, RATES, 1 / DEG), (IMU, FORCES, 1 / G), (IMU, FORCES, 1000 / G),
        (FIX, ['latitude', 'longitude'], 1 / DEG),
        (FIX, ['altitude'], rng.choice([1 / 0.3048, 1000])),
        (kind, fields, rng.choice([2, 4, 100, -1])), (kind, fields, rng.choice([2, 10, 1000]))])
    put_all(rows, name, fields, lambda *x: [value * factor for value in x])
    return (1 / abs(factor),) * 2 if name == kind else SAME


def swapped_fix(rng, rows):
    """Swap latitude and longitude, with the same or the other sign."""
    sign = rng.choice([1.0, -1.0])
    put_all(rows, FIX, ['latitude', 'longitude'], lambda x, y: (sign * y, x))
    return SAME


def doubled_range(rng, rows):
    """Repeat a part of the recording, of one topic or all, at the same times or later."""
    later_ns = rng.choice([0, 0, 1, 10**9])
    for kind in rng.choice([[rng.choice(list(rows))], list(rows)]):
        part = rows[kind][some_range(rng, len(rows[kind]))]
        rows[kind] += [(t + later_ns, data) for t, data in part]
    return SAME


def spliced(rng, rows):
    """Continue a drive with the odometer of another vehicle, or also with its IMU."""
    kind, fields = odometer_of(rows)
    n, factor = len(rows[kind]), math.exp(rng.choice([-1, 1]) * rng.uniform(0.005, 1.0))
    begin = rng.randrange(n // 5, n - n // 5)
    at, form, _ = layout_of(kind, rows[kind][begin][1]).find(fields[0])
    first = np.frombuffer(rows[kind][begin][1], form, 1, at)[0].item()
    whole = int if kind == COUNTER else float
    put_all(rows, kind, fields, lambda x: [whole(first + (x - first) * factor)],
            slice(begin, None))
    if rng.random() < 0.3:
        put_all(rows, IMU, RATES[:2] + FORCES[:2], lambda a, b, c, d: (-b, a, -d, c),
                slice(begin * len(rows[IMU]) // n, None))
    return min(1.0, 1 / factor), max(1.0, 1 / factor)


def second_publisher(rng, rows):
    """Add a second publisher with other values to the topic of odometer or fixes."""
    every = rng.choice([1, 2, 7])
    if rng.random() < 0.5:
        kind, fields = odometer_of(rows)
        off = rng.choice([1, 50, 3000, 10**6])
    else:
        kind, fields = FIX, ['latitude', 'longitude', 'altitude']
        off = rng.choice([-1, 1]) * 10**rng.uniform(-5.0, 0.0)
    half_ns = (rows[kind][-1][0] - rows[kind][0][0]) // (2 * len(rows[kind]))
    rows[kind] += [(t + half_ns, put(kind, stamped(kind, data, half_ns), fields,
                                     lambda *x: [value + off for value in x]))
                   for t, data in rows[kind][::every]]
    return SAME


def stamped(kind, data, by_ns):
    """Return a message with its header stamp moved."""
    if kind == COUNTER:
        return data
    sec, nanosec = struct.unpack_from('<iI', data, 4)
    return data[:4] + struct.pack('<iI', *divmod(sec * 10**9 + nanosec + by_ns, 10**9)) + data[12:]


def clock_step(rng, rows):
    """Step the clock of a topic, for a while or permanently."""
    kind = rng.choice(list(rows))
    which = some_range(rng, len(rows[kind]))
    by_ns = int(rng.choice([-1, 1]) * 10**rng.uniform(7.0, 11.0))
    arrivals = kind == COUNTER or rng.random() < 0.3
    rows[kind][which] = [(t + by_ns * arrivals, stamped(kind, data, by_ns))
                         for t, data in rows[kind][which]]
    return SAME


def wrapped(rng, rows):
    """Wrap the odometer at a full turn, or at a smaller modulus."""
    kind, fields = odometer_of(rows)
    span = rng.choice([256, 1000, 4096, 2**16] if kind == COUNTER else [2 * math.pi, 360.0])
    put_all(rows, kind, fields, lambda x: [x % span])
    return SAME


def carried(rng, rows):
    """Insert a standstill in which the vehicle is carried, or does not move."""
    kind, fields = odometer_of(rows)
    at, form, _ = layout_of(kind, rows[kind][0][1]).find(fields[0])
    value = [np.frombuffer(data, form, 1, at)[0] for _, data in rows[kind]]
    still = [k for k in range(60, len(value)) if value[k] == value[k - 15]]
    time_ns, wait_ns, again_ns = (rows[kind][rng.choice(still)][0],
                                  rng.choice([20, 60, 200]) * 10**9, 2 * 10**9)
    metres = rng.choice([0.0, 5.0, 30.0, 100.0, 1000.0])
    for name, some in rows.items():
        last = [row for row in some if time_ns - again_ns < row[0] <= time_ns]
        more = [(t, data[:12] + rng.choice(last)[1][12:], by_ns)     # own header, another row
                for by_ns in range(again_ns, wait_ns + 1, again_ns) for t, data in last]
        after = [(*row, wait_ns) for row in some if row[0] > time_ns]
        rows[name] = [row for row in some if row[0] <= time_ns] + [
            (t + by_ns, stamped(name, data, by_ns)) for t, data, by_ns in more + after]
    gone = [metres / 111e3 * min(max((t - time_ns) / wait_ns, 0.0), 1.0) for t, _ in rows[FIX]]
    rows[FIX] = [(t, put(FIX, data, ['latitude'], lambda x, by=by: [x + by]))
                 for (t, data), by in zip(rows[FIX], gone, strict=True)]
    return SAME


ALL = [second_imu, axes, units, swapped_fix, doubled_range, spliced, second_publisher,
       clock_step, wrapped, carried]
