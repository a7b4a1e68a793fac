# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A bag with TF: replay gives the values of the same positions as poses, to the last bit."""

import json
import re

import numpy as np
import pytest
import ros_messages as make

from odocal_ros.bagio.encode import Topic
from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.offline import cli
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
TF = 'tf2_msgs/msg/TFMessage'
FRAMES = ('--set', 'reference.frames=[map,prism]', '--set', 'odometer.left=topic', '--set',
          'odometer.right=topic', '--odometer-topic', '/odometer/left', '--odometer-right-topic',
          '/odometer/right')


def topic(name, time_ns, transforms):
    """Return a topic of TFMessages with one transform each, of one length."""
    raws = [make.cdr(make.kind(TF)(transforms=[one])) for one in transforms]
    size, = {len(raw) for raw in raws}
    return Topic(name, TF, np.asarray(time_ns), lambda rows: np.frombuffer(
        b''.join(raws[rows]), f'V{size}'))


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Return a bag of a robot with its positions as poses and as TF."""
    made = simulate(SimOptions(scenario='indoor', duration=60.0, reference='pose', imu_rate=50.0))
    fix = made.fix
    moving = [make.transform(int(t), p, 'base_link', 'map')
              for t, p in zip(fix.stamp_ns, made.positions(), strict=True)]
    # sent once, after the first positions
    static = topic('/tf_static', [fix.received_ns[20]], [
        make.transform(0, (0.0, 0.0, 0.0), 'prism', 'base_link')])
    return write_bag(tmp_path_factory.mktemp('tf') / 'bag', [
        *drive_topics(made), topic('/tf', fix.received_ns, moving), static])


def test_replay_by_tf_is_replay_by_poses(bag, tmp_path):
    found = []
    for name in ('/pose', '/tf'):
        out = tmp_path / name[1:]
        assert cli.main(['replay', str(bag), '--fix-topic', name, '--output', str(out), *FRAMES,
                         '--set', 'output.formats=[params]']) in (0, 1)
        found.append(json.loads((out / 'calibration.json').read_text()))
    assert found[1]['inputs'][0]['topics']['fix'] == '/tf'
    assert found[0]['result'] == found[1]['result']
    assert found[0]['result']['scale_factor']['value'] > 0


def test_inspect_shows_the_positions(bag, capsys):
    assert cli.main(['inspect', str(bag), '--fix-topic', '/tf', *FRAMES]) == 0
    text = capsys.readouterr().out
    assert re.search('/tf +tf2_msgs/TFMessage .*<- fix .position reference.', text), text
    assert 'positions in a local frame' in text


def test_other_frames_are_named_in_the_error(bag, capsys):
    assert cli.main(['replay', str(bag), '--fix-topic', '/tf', *FRAMES, '--set',
                     'reference.frames=[world,prism]']) == 2
    assert "no transform from world to prism: 'map' has no parent" in capsys.readouterr().err
