# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal inspect on lists of values: which of them roll, and which side each is on."""

import json

from inspecting import inspect, topic
import numpy as np
import pytest
import ros_bags
from ros_bags import T0
import ros_messages as make

from odocal_ros.offline.cli import main

pytestmark = pytest.mark.slow
RATE, WIDTH = 20, 1.6


def drive(message, seconds=120):
    """Return rows of a drive with turns; message(ns, i, left, right) gives an odometer."""
    t = np.arange(0, seconds, 1 / RATE)
    v = np.clip(t - 10, 0, 8) * (t < 100)
    w = 0.2 * np.sin(t / 5) * (t > 20) * (t < 90)
    left, right = (np.cumsum(v - s * w * WIDTH / 2) / RATE / 0.3 for s in (1, -1))
    yaw = np.cumsum(w) / RATE
    east, north = np.cumsum(v * np.cos(yaw)) / RATE, np.cumsum(v * np.sin(yaw)) / RATE
    rows = []
    for i, s in enumerate(t):
        ns = T0 + round(s * 1e9)
        rows.append(('/imu/data', ns, make.imu(ns, w=(0, 0, w[i]), f=(0, v[i] * w[i], 9.81))))
        rows.append(('/wheels', ns + 1, message(ns, i, left[i], right[i])))
        if i % 4 == 0:
            rows.append(('/fix', ns + 2, make.fix(ns, 48 + np.rad2deg(north[i] / 6.38e6),
                                                  11 + np.rad2deg(east[i] / 4.27e6), sigma=0.3)))
    return rows


@pytest.fixture
def look(tmp_path, capsys):
    """Return a function: what is told of a drive with such an odometer, its wheels, the text."""
    def inspected(message):
        path = ros_bags.write(tmp_path / 'bag', drive(message))
        told, text = inspect(path, capsys)
        return told, topic(told, '/wheels'), text
    return inspected


def test_unnamed_joints_are_told_apart_by_how_they_move(look):
    names = ['j1', 'j2', 'j3']
    printed, wheels, text = look(lambda ns, i, left, right: make.joints(
        ns, names, [0.4 * np.sin(i / 30), right, left]))
    assert [v['side'] for v in wheels['values']] == ['', 'right', 'left']
    assert [v['rolls'] for v in wheels['values']] == [False, True, True]
    assert 'the wheels among the joints j1, j2, j3 are not clear' in wheels['trouble']
    assert printed['command'].endswith('--set odometer.left=j3 --set odometer.right=j2')
    assert 'j1 travels' in text


def test_four_unnamed_joints_are_a_list_of_axles(look):
    found, wheels, _ = look(lambda ns, i, left, right: make.joints(
        ns, ['a', 'b', 'c', 'd'], [right, left, 1.01 * right, 0.99 * left]))
    assert [v['side'] for v in wheels['values']] == ['right', 'left', 'right', 'left']
    assert found['command'].endswith("--set 'odometer.wheels=[b, a, d, c]'")


def test_the_sides_of_two_counters_are_told_and_their_replay_runs(look, tmp_path, capsys):
    printed, wheels, _ = look(lambda ns, i, left, right: (
        make.whole_array([int(right * 50), int(left * 50)])))
    assert 'the mean of 0 and 1 is used' in wheels['chosen']
    options = ['--set', 'odometer.left=1', '--set', 'odometer.right=0']
    assert printed['command'].split()[-4:] == options
    assert main(['replay', printed['path'], *options, '--output', str(tmp_path / 'out'), '--json',
                 '--set', 'output.formats=[params]']) < 2
    said = capsys.readouterr().out
    assert 'scale_factor_left' in json.loads(said)['methods']['smoother']['estimates']
    assert 'WHEELS_SWAPPED' not in said


def test_wheels_told_by_their_names_are_shown_with_the_settings_to_write(look):
    names = ['left_steer', 'left_wheel', 'right_steer', 'right_wheel']
    found, wheels, _ = look(lambda ns, i, left, right: make.joints(
        ns, names, velocity=[0.1, left, 0.1, right]))
    assert 'left_wheel is used as left wheel, right_wheel as right' in wheels['chosen']
    assert found['command'].endswith(
        '--set odometer.left=left_wheel --set odometer.right=right_wheel')
    assert 'trouble' not in wheels
