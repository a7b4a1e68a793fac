# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The node odometry compared with replay, and after internal errors."""

import importlib.util
from types import SimpleNamespace

from bench import given, NodeProcess, ROOT, wait_for
from drives import settings
from geometry_msgs.msg import TwistWithCovarianceStamped
from launch_stand_in import of_xml
from nav_msgs.msg import Odometry
import numpy as np
from player import messages_of, playing_to, stamp_of, with_clock
import pytest
from rcl_interfaces.srv import GetParameters
from rclpy.qos import QoSProfile
from test_names_shown_to_users import allowed, seen

from odocal_ros.apply.pose import Pose
from odocal_ros.live.odometry import transform_of
from odocal_ros.nav.alignment import Alignment
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.output.files import as_json
from odocal_ros.output.program_files import file_texts
from odocal_ros.pipeline.calibrate import calibrate, combine
from odocal_ros.settings.node_configs import OdomFrames
from odocal_ros.sim.scenarios import SimOptions, simulate

BIAS, TILT = (2e-5, -1e-5, 3e-5), (0.01, -0.02)     # rad/s; rad: the same for both
RESULT = {'result.valid': True, 'result.scale_factor': 1.0, 'result.scale_factor_sigma': 0.001}
# the first path that has poses ends in an error
FAILS = """
from odocal_ros.apply.reckoning import DeadReckoning
_poses, _failed = DeadReckoning.poses, []
def poses(self, *args):
    found = _poses(self, *args)
    if found and not _failed:
        _failed.append(None)
        1 / 0
    return found
DeadReckoning.poses = poses
"""


@pytest.fixture(scope='module')
def drive():
    """Simulate two minutes in a hilly town, at an IMU rate of which replay uses each sample."""
    return simulate(SimOptions(scenario='town', duration=135.0, slope=0.03, imu_rate=50.0,
                               odometer_rate=20.0, odometer='speed', fix_noise='rtk',
                               imu_grade='tactical'))


@pytest.fixture(scope='module')
def replayed(drive, tmp_path_factory):
    """Calibrate the drive from a given alignment, and write the file that replay writes."""
    row = int(np.searchsorted(drive.imu.stamp_ns, drive.truth.start_ns)) - 5
    alignment = Alignment(
        t=(int(drive.imu.stamp_ns[row]) - drive.truth.start_ns) * 1e-9,
        C_nb=matrix_from_rpy((*TILT, np.pi / 2 - drive.truth.heading)),
        gyro_bias=np.array(BIAS), level_sigma=0.003, heading_sigma=0.002,
        gyro_bias_sigma=np.full(3, 1e-5), gyro_noise=1e-5, gyro_bias_walk=1e-8,
        heading_source='fixed', heading_shared=True)
    config = settings(drive)
    result = calibrate(drive.leg(), config, alignment)
    calibration = combine([result], config)
    path = tmp_path_factory.mktemp('calibrated') / 'calibration.yaml'
    content = as_json(calibration, config, [], '2026-01-02T03:04:05+00:00')
    path.write_text(file_texts(calibration, config, content)['calibration.yaml'])
    return SimpleNamespace(row=row, alignment=alignment, result=result, path=path)


def begin(replayed):
    """Return the settings with which the node starts like replay."""
    return {'start.attitude': replayed.alignment.q_nb.tolist(), 'start.gyro_bias': list(BIAS),
            'start.latitude': float(np.rad2deg(replayed.result.origin[0])), 'levelling': False,
            # a lost first message would change the start
            **{f'qos_overrides./{topic}.subscription.reliability': 'reliable'
               for topic in ('imu/data', 'odometer')}}


@pytest.fixture(scope='module')
def received(drive, replayed):
    """Play the drive to a node with that calibration; keep what it publishes."""
    types, sent = messages_of(drive, fix=None)
    early_ns = {'imu': 0, 'odometer': 10**9}
    begin_ns = int(drive.imu.stamp_ns[replayed.row])
    sent = [one for one in sent if one.stamp_ns >= begin_ns - early_ns[one.slot]]
    with playing_to((types, sent), begin(replayed), 20.0, module='odometry',
                    words=('--params-file', str(replayed.path))) as leg:
        seen, node = SimpleNamespace(odometry=[], twists=[], node=leg.node), leg.client.node
        for kind, name, kept in ((Odometry, 'odometry', seen.odometry),
                                 (TwistWithCovarianceStamped, 'odometry/twist', seen.twists)):
            node.create_subscription(kind, name, kept.append, QoSProfile(depth=5000))
        wait_for(lambda: node.count_publishers('/odometry/twist'), 'its publishers')
        leg.play(0.0, np.inf)
        wait_for(lambda: seen.odometry and stamp_of(seen.odometry[-1]) > sent[-1].stamp_ns - 10**9,
                 f'the last pose; the node says {leg.node.text}')
        assert leg.node.end() == 0
    return seen         # ended: a test may start one of this name


def test_the_path_of_the_node_equals_that_of_replay(received, drive, replayed):
    assert received.node.text.count('odometry starts') == 1, received.node.text
    assert 'jumps' not in received.node.text
    rows = np.searchsorted(drive.imu.stamp_ns, [stamp_of(m) for m in received.odometry])
    path = np.array([[getattr(m.pose.pose.position, axis) for axis in 'xyz']
                     for m in received.odometry])
    expected_track = replayed.result.track_n[rows - replayed.row] - replayed.result.track_n[0]
    assert len(path) > 1000
    assert np.linalg.norm(expected_track[-1]) > 200.0
    assert np.abs(path - expected_track).max() < 1e-9


def test_messages_have_the_frames_and_covariances_for_robot_localization(received):
    pose, twist = received.odometry[500], received.twists[500]
    assert (pose.header.frame_id, pose.child_frame_id) == ('odom', 'base_link')
    assert (twist.header.frame_id, twist.header.stamp) == ('base_link', pose.header.stamp)
    assert pose.twist == twist.twist
    for covariance in (pose.pose.covariance, twist.twist.covariance):
        matrix = np.reshape(covariance, (6, 6))
        assert (np.diag(matrix) > 0).all()
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-12 * np.trace(matrix))


def test_without_a_calibration_the_error_names_the_required_file(tmp_path):
    rejected = tmp_path / 'rejected.yaml'
    rejected.write_text('/**: {ros__parameters: {result: {scale_factor: 0.02, valid: false}}}')
    for more, why in (((), 'no calibration is given'),
                      (('--params-file', str(rejected)), 'was rejected')):
        node = NodeProcess('-p', 'vehicle:=car 3', *more, module='odometry')
        assert node.wait() == 1
        line, = node.lines
        assert line.startswith('odometry: ')
        assert why in line
        assert 'calibration.yaml' in line


def test_the_launch_file_starts_the_node_with_both_files():
    declared, (node,) = of_xml(ROOT / 'launch' / 'odometry.launch.xml',
                               {'calibration': '/tmp/calibration.yaml', 'imu_topic': '/a/imu'})
    assert declared['calibration'][0] == ''       # must be given
    assert node.executable == 'odometry'
    assert f"'{node.executable} = odocal_ros.live.node_commands:odometry'" in (
        ROOT / 'setup.py').read_text()
    assert node.parameters[:2] == [str(ROOT / 'config' / 'odometry.yaml'), '/tmp/calibration.yaml']
    assert node.remappings['imu/data'] == '/a/imu'


def test_the_node_accepts_its_settings_file_and_conforms_to_the_policy(replayed):
    expected_track = allowed('/odometry')
    settings = {'odometer.left': 'topic', 'odometer.right': 'topic', 'use_sim_time': True,
                'odometer.type': 'std_msgs/msg/Int64'}
    with playing_to(({}, []), settings, module='odometry', words=(
            '--params-file', str(ROOT / 'config' / 'odometry.yaml'), '--params-file',
            str(replayed.path))) as leg:
        for kind in ('publish', 'subscribe'):
            wait_for(lambda kind=kind: seen(leg.client, kind, 'odometry') == expected_track[kind],
                     f'{kind}: {expected_track[kind]}')
        assert leg.node.end() == 0


def test_the_ekf_configuration_uses_the_published_twist():
    import yaml
    ekf = yaml.safe_load((ROOT / 'config' / 'ekf_odocal.yaml').read_text())[
        '/**/ekf_filter_node']['ros__parameters']
    frames = yaml.safe_load((ROOT / 'config' / 'odometry.yaml').read_text())[
        '/**/odometry']['ros__parameters']['frames']
    assert ekf['twist0'] == 'odometry/twist'
    assert (ekf['odom_frame'], ekf['base_link_frame']) == (frames['odom'], frames['base'])
    names = ('x', 'y', 'z', 'roll', 'pitch', 'yaw')
    fused = dict(zip([*names, *(f'v{n}' for n in names), 'ax', 'ay', 'az'],
                     ekf['twist0_config'], strict=True))
    assert {name for name, on in fused.items() if on} == {'vx', 'vy', 'vyaw'}


def test_publish_tf_without_tf2_msgs_names_the_package_to_install():
    if importlib.util.find_spec('tf2_msgs'):
        pytest.skip('tf2_msgs is installed')
    node = NodeProcess(*given(RESULT | {'publish_tf': True}), module='odometry')
    assert node.wait() == 1
    assert node.lines[-1:] == [
        'odometry: publish_tf needs the package tf2_msgs, which is not installed: install '
        'ros-jazzy-tf2-msgs, or set publish_tf to false']


def test_the_transform_equals_the_pose():
    numbers = np.array([1.0, -2.0, 0.5, 0.1, 0.2, 0.3, 0.9, *[0.0] * 78])
    pose = Pose(1_234_567_890_123, numbers.tobytes())
    out = transform_of(pose, OdomFrames(base='car', odom='map'))
    assert (out.header.stamp.sec, out.header.stamp.nanosec) == (1234, 567_890_123)
    assert (out.header.frame_id, out.child_frame_id) == ('map', 'car')
    move, turn = out.transform.translation, out.transform.rotation
    assert (move.x, move.y, move.z) == (1.0, -2.0, 0.5)
    assert (turn.x, turn.y, turn.z, turn.w) == (0.1, 0.2, 0.3, 0.9)


@pytest.mark.parametrize('simulated', [False, True])
def test_the_node_continues_after_an_internal_error(simulated):
    types, messages = messages_of(simulate(SimOptions(
        scenario='out_and_back', duration=240.0, imu_rate=50.0, odometer_rate=20.0,
        odometer='speed')), fix=None)
    found = []
    with playing_to((types, messages), RESULT | {'use_sim_time': simulated}, 7.0,
                    before=FAILS, module='odometry') as leg:
        leg.client.node.create_subscription(Odometry, 'odometry', found.append,
                                            QoSProfile(depth=5000))
        play = with_clock(leg) if simulated else leg.play
        call = leg.client.send(GetParameters, 'get_parameters',
                               GetParameters.Request(names=['publish.rate']))
        play(0, 40)
        last_s = leg.part(0, 40)[-1].stamp_ns // 10**9
        wait_for(lambda: found and found[-1].header.stamp.sec > last_s - 2,
                 f'the last pose; the node says {leg.node.text}')
        assert call.result().values[0].double_value == 20.0
        assert leg.node.end() == 0
    assert 'restarts from the origin: internal error, please report it: ZeroDivisionError' in (
        leg.node.text)
    assert len(found) > 500
