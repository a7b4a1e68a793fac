# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A bag without GNSS, or without an IMU: what it has is found, shown and used."""

import json
import math
import re

import numpy as np
import pytest
import ros_messages as make

from odocal_ros.bagio.encode import imu, pose, Topic, twist
from odocal_ros.bagio.read import open_bag
from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.library.read_bag import read_bag
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.offline import cli
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
NUMBERS = ('--set', 'output.formats=[params]')      # no report is drawn
TF = 'tf2_msgs/msg/TFMessage'
FRAMES = ('--set', 'reference.frames=[map,prism]', '--set', 'odometer.left=topic', '--set',
          'odometer.right=topic', '--odometer-topic', '/odometer/left', '--odometer-right-topic',
          '/odometer/right')


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Return a bag of a car with poses, the truth beside it."""
    out = tmp_path_factory.mktemp('posed') / 'drive'
    assert cli.main(['simulate', '--scenario', 'town', '--duration', '200', '--imu-rate', '50',
                     '--odometer-rate', '20', '--fix-noise', 'rtk', '--reference', 'pose',
                     '--seed', '5', '--out', str(out), '--quiet']) == 0
    return out


def test_inspect_shows_the_reference_and_suggests_the_command(bag, capsys):
    assert cli.main(['inspect', str(bag)]) == 0
    text = capsys.readouterr().out
    assert '/pose      geometry_msgs/PoseStamped' in text
    assert '<- fix (position reference)' in text
    assert '1000 positions in a local frame; no covariance' in text
    assert f'  odocal replay {bag} --fix-topic /pose\n' in text
    assert 'LOCAL_FRAME' in text


def test_replay_calibrates_and_states_the_reference(bag, tmp_path, capsys):
    assert cli.main(['replay', str(bag), '--config', str(bag.parent / 'calibrator.yaml'),
                     '--output', str(tmp_path / 'out'), *NUMBERS]) == 0
    printed = capsys.readouterr()
    assert printed.err.count('no NavSatFix with messages in the bag; position reference: /pose '
                             '(geometry_msgs/msg/PoseStamped); another one: --fix-topic') == 1
    written = json.loads((tmp_path / 'out' / 'calibration.json').read_text())
    assert written['inputs'][0]['topics']['fix'] == '/pose'
    scale = written['result']['scale_factor']
    assert abs(scale['value'] - 0.0213) < 3 * scale['sigma'] < 3e-4 * 0.0213
    reasons = {r['code']: r for r in written['legs'][0]['reasons']}
    assert {'LOCAL_FRAME', 'COVARIANCE_UNKNOWN'} <= set(reasons)
    assert 'antenna' not in printed.out
    for part in ('text', 'remedy'):
        assert 'reference.default_sigma' in reasons['COVARIANCE_UNKNOWN'][part]


@pytest.mark.parametrize('name', ['trajectory.csv', 'debug.mcap', 'track.kml'])
def test_exports_of_local_positions_have_no_latitude(bag, tmp_path, capsys, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    code = cli.main(['replay', str(bag), '--config', str(bag.parent / 'calibrator.yaml'),
                     '--output', str(tmp_path / 'out'), '--export', name, '--quiet', *NUMBERS])
    if name == 'track.kml':
        assert code == 2
        assert 'the positions are in a local frame' in capsys.readouterr().err
    elif name == 'debug.mcap':
        with open_bag(tmp_path / 'out' / name) as written:
            assert written.topics['/odocal/track'].msgtype == 'geometry_msgs/msg/PoseStamped'
    else:
        rows = np.genfromtxt(tmp_path / 'out' / name, delimiter=',', names=True)
        assert np.isnan(rows['latitude_deg']).all()
        assert np.ptp(rows['east_m']) > 100


def test_comma2k19_with_poses_gives_the_scale_of_its_fixes(data_dir, tmp_path):
    """The frame looks anywhere, has no latitude and says nothing of its errors, as the fixes."""
    from odocal_ros import calibrate_bag
    real = data_dir / 'comma2k19_rav4' / 'bag'
    topics = {'imu': '/imu/data_flu', 'odometer': '/vehicle/twist', 'fix': '/fix'}
    rows = read_bag(real, topics)
    fix = rows.samples('fix')
    geodetic = np.stack([fix.latitude, fix.longitude, fix.height], -1)
    position = Origin(*geodetic[0]).to_n(geodetic) @ matrix_from_rpy([0.0, 0.0, 2.1])
    posed = write_bag(tmp_path / 'posed', [
        imu('/imu/data_flu', rows.samples('imu')), pose('/pose', fix, position),
        twist('/vehicle/twist', rows.samples('odometer'))])
    by_fix = calibrate_bag(real, topics=topics)
    # the first sigma of fixes without a covariance
    by_pose = calibrate_bag(posed, config={'reference.default_sigma': 2.5})
    scale, sigma = by_fix.values['scale_factor'], by_fix.sigmas['scale_factor']
    assert abs(by_pose.values['scale_factor'] - scale) < 0.1 * sigma
    assert by_pose.sigmas['scale_factor'] == pytest.approx(sigma, rel=0.05)
    assert math.isclose(scale, 1.0084, abs_tol=4 * math.hypot(sigma, 0.0006))


def topic(name, time_ns, transforms):
    """Return a topic of TFMessages with one transform each, of one length."""
    raws = [make.cdr(make.kind(TF)(transforms=[one])) for one in transforms]
    size, = {len(raw) for raw in raws}
    return Topic(name, TF, np.asarray(time_ns), lambda rows: np.frombuffer(
        b''.join(raws[rows]), f'V{size}'))


def with_tf(folder, name='/tf'):
    """Return a bag of a robot with its positions as poses and as TF."""
    made = simulate(SimOptions(scenario='indoor', duration=60.0, reference='pose', imu_rate=50.0))
    fix = made.fix
    moving = [make.transform(int(t), p, 'base_link', 'map')
              for t, p in zip(fix.stamp_ns, made.positions(), strict=True)]
    # sent once, after the first positions
    static = topic(f'{name}_static', [fix.received_ns[20]], [
        make.transform(0, (0.0, 0.0, 0.0), 'prism', 'base_link')])
    return write_bag(folder / 'bag', [*drive_topics(made), topic(name, fix.received_ns, moving),
                                      static])


@pytest.fixture(scope='module')
def tf_bag(tmp_path_factory):
    return with_tf(tmp_path_factory.mktemp('tf'))


def test_tf_positions_are_counted_also_before_the_static_transform(tmp_path, capsys):
    bag = with_tf(tmp_path, '/a/tf')       # before the other topics, by name
    assert cli.main(['inspect', str(bag), '--json', '--fix-topic', '/a/tf', *FRAMES]) == 0
    topics = {one['name']: one for one in json.loads(capsys.readouterr().out)['topics']}
    count = topics['/pose']['fix']['positions']
    assert topics['/a/tf']['fix']['positions'] == pytest.approx(count, abs=1)


def test_tf_and_poses_as_reference_give_the_same_result(tf_bag, tmp_path):
    found = []
    for name in ('/pose', '/tf'):
        out = tmp_path / name[1:]
        assert cli.main(['replay', str(tf_bag), '--fix-topic', name, '--output', str(out), *FRAMES,
                         '--set', 'output.formats=[params]']) in (0, 1)
        found.append(json.loads((out / 'calibration.json').read_text()))
    assert found[1]['inputs'][0]['topics']['fix'] == '/tf'
    assert found[0]['result'] == found[1]['result']
    assert found[0]['result']['scale_factor']['value'] > 0


def test_inspect_shows_tf_positions_and_other_frames_are_an_error(tf_bag, capsys):
    assert cli.main(['inspect', str(tf_bag), '--fix-topic', '/tf', *FRAMES]) == 0
    text = capsys.readouterr().out
    assert re.search('/tf +tf2_msgs/TFMessage .*<- fix .position reference.', text), text
    assert 'positions in a local frame' in text
    assert cli.main(['replay', str(tf_bag), '--fix-topic', '/tf', *FRAMES, '--set',
                     'reference.frames=[world,prism]']) == 2
    assert "no transform from world to prism: 'map' has no parent" in capsys.readouterr().err


def test_a_robot_without_an_imu_is_inspected_and_calibrated(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    assert cli.main(['simulate', '--scenario', 'indoor', '--duration', '90', '--no-imu',
                     '--reference', 'mocap', '--fix-rate', '10', '--out', 'robot',
                     '--quiet']) == 0
    capfd.readouterr()
    assert cli.main(['inspect', 'robot', '--json']) == 0
    found = json.loads(capfd.readouterr()[0])
    assert 'NO_IMU' not in {reason['code'] for reason in found['findings']}
    assert '--set odometer.left=topic' in found['command']
    assert 'imu' not in found['command']
    assert cli.main(['try', 'robot', '--no-browser']) == 0
    out, _ = capfd.readouterr()
    assert 'track width' in out
    assert 'yaw mounting' not in out
