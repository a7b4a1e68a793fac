# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""odocal inspect on lists of values: which of them are wheels, and on which side."""

from itertools import count
import json

import inspect_output
from inspect_output import inspect, planar, RATE, topic
import numpy as np
import pytest
import ros_bags
import ros_messages as make

from odocal_ros.offline.cli import main

pytestmark = pytest.mark.slow
WIDTH, RADIUS = 1.6, 0.3      # m


def drive(message):
    """Return rows of the planar drive; message(ns, i, left, right) gives an odometer, rad."""
    _, v, w, _ = planar()
    left, right = (np.cumsum(v - s * w * WIDTH / 2) / RATE / RADIUS for s in (1, -1))
    number = count()
    return [('/wheels', ns, message(ns, i := next(number), left[i], right[i]))
            if name == '/odometer' else (name, ns, m) for name, ns, m in inspect_output.drive()]


@pytest.fixture
def inspect_drive(tmp_path, capsys):
    """Return a function that gives findings, wheels and text of a drive with an odometer."""
    def inspected(message):
        path = ros_bags.write(tmp_path / 'bag', drive(message))
        facts, text = inspect(path, capsys)
        return facts, topic(facts, '/wheels'), text
    return inspected


def test_the_sides_of_unnamed_joints_are_found_from_their_motion(inspect_drive):
    names = ['j1', 'j2', 'j3']
    printed, wheels, text = inspect_drive(lambda ns, i, left, right: make.joints(
        ns, names, [0.4 * np.sin(i / 30), right, left]))
    assert [v['side'] for v in wheels['values']] == ['', 'right', 'left']
    assert [v['rolls'] for v in wheels['values']] == [False, True, True]
    assert 'the wheels among the joints j1, j2, j3 are not clear' in wheels['error']
    assert printed['command'].endswith('--set odometer.left=j3 --set odometer.right=j2')
    assert 'j1 travels' in text


def test_four_unnamed_joints_are_a_list_of_axles(inspect_drive):
    found, wheels, _ = inspect_drive(lambda ns, i, left, right: make.joints(
        ns, ['a', 'b', 'c', 'd'], [right, left, 1.01 * right, 0.99 * left]))
    assert [v['side'] for v in wheels['values']] == ['right', 'left', 'right', 'left']
    assert found['command'].endswith("--set 'odometer.wheels=[b, a, d, c]'")


def test_the_sides_of_two_counters_are_found_and_replay_runs(inspect_drive, tmp_path, capsys):
    printed, wheels, _ = inspect_drive(lambda ns, i, left, right: (
        make.whole_array([int(right * 50), int(left * 50)])))
    assert 'the mean of 0 and 1 is used' in wheels['chosen']
    options = ['--set', 'odometer.left=1', '--set', 'odometer.right=0']
    assert printed['command'].split()[-4:] == options
    assert main(['replay', printed['path'], *options, '--output', str(tmp_path / 'out'), '--json',
                 '--set', 'output.formats=[params]']) < 2
    stdout = capsys.readouterr().out
    assert 'scale_factor_left' in json.loads(stdout)['methods']['smoother']['estimates']
    assert 'WHEELS_SWAPPED' not in stdout


def test_wheels_found_by_their_names_are_shown_with_their_settings(inspect_drive):
    names = ['left_steer', 'left_wheel', 'right_steer', 'right_wheel']
    found, wheels, _ = inspect_drive(lambda ns, i, left, right: make.joints(
        ns, names, velocity=[0.1, left, 0.1, right]))
    assert 'left_wheel is used as left wheel, right_wheel as right' in wheels['chosen']
    assert found['command'].endswith(
        '--set odometer.left=left_wheel --set odometer.right=right_wheel')
    assert 'error' not in wheels
