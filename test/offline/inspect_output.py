# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A planar drive with known faults, and the output of odocal inspect."""

import json
import math

import numpy as np
from ros_bags import T0
import ros_messages as make

from odocal_ros.offline.cli import main

K = 0.02                   # m per pulse
RATE = 25                  # Hz, IMU
G = 9.81


def planar(seconds=150):
    """Return t, speed, turn rate and acceleration of a drive: rest, go, left turn, go, rest."""
    t = np.arange(0, seconds, 1 / RATE)
    a = np.where((t > 12) & (t < 22), 1.0, 0) - np.where((t > 130) & (t < 140), 1.0, 0) \
        + np.where((t > 40) & (t < 120), 0.3 * np.sin(math.pi / 4 * t), 0)
    w = np.where((t > 70) & (t < 80), math.pi / 20, 0.0)
    v = np.cumsum(a) / RATE
    return t, np.where(np.abs(v) < 1e-6, 0, v), w, a


def drive(seconds=150, C_ib=None, gyro=1.0, accel=1.0, lag=0.0, status=0, loop=False, known=2):
    """
    Return rows of a planar drive.

    C_ib rotates from b to the IMU frame; gyro, accel: factors of the sent values; lag: s, added to
    the stamps of the fixes; loop: a full circle.
    """
    t, v, w, a = planar(seconds)
    if loop:
        w = np.where(v > 0.1, 2 * math.pi * v / (v.sum() / RATE), 0.0)
    C_ib = np.eye(3) if C_ib is None else C_ib
    yaw = np.cumsum(w) / RATE
    east, north = np.cumsum(v * np.cos(yaw)) / RATE, np.cumsum(v * np.sin(yaw)) / RATE
    counts = np.floor(np.cumsum(v) / RATE / K).astype(int)
    rng = np.random.default_rng(5)
    rows = []
    for i, s in enumerate(t):
        ns = T0 + round(s * 1e9)
        f = C_ib @ (a[i], v[i] * w[i], G) * accel + rng.normal(0, 0.02, 3)
        rate = C_ib @ (0, 0, w[i]) * gyro + rng.normal(0, 0.001, 3)
        rows.append(('/imu/data', ns, make.imu(ns, w=rate, f=f)))
        rows.append(('/odometer', ns + 1, make.whole(int(counts[i]))))
        if i % 5 == 0:
            x, y = east[i] + rng.normal(0, 0.3), north[i] + rng.normal(0, 0.3)
            rows.append(('/fix', ns + 2, make.fix(
                ns + round(lag * 1e9), 48 + np.rad2deg(y / 6.38e6),
                11 + np.rad2deg(x / 6.38e6 / math.cos(math.radians(48))), 500, sigma=0.3,
                status=status, known=known)))
    return rows


def inspect(path, capsys, *options):
    """Return the output of the command, as JSON and as text."""
    assert main(['inspect', str(path), '--json', *options]) == 0
    seen = json.loads(capsys.readouterr().out)
    assert main(['inspect', str(path), *options]) == 0
    out = capsys.readouterr()
    assert out.err == ''
    assert max(len(line) for line in out.out.splitlines() if str(path) not in line) < 100
    return seen, out.out


def codes(seen):
    return {finding['code'] for finding in seen['findings']}


def topic(seen, name):
    return next(t for t in seen['topics'] if t['name'] == name)
