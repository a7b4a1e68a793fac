# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Dead reckoning of incoming samples, compared with replay of the same drive and closed forms."""

from drives import settings
import numpy as np
import pytest
from streams import alignment_of, given, odometry_of, poses_of, samples_of

from odocal_ros.apply.odometry import Odometry
from odocal_ros.apply.vehicle import vehicle_of
from odocal_ros.calib.result import Estimate
from odocal_ros.data.samples import ImuSamples, OdometerForm, OdometerSamples, take
from odocal_ros.nav.dead_reckoning import dead_reckon, forward_b
from odocal_ros.nav.rotations import matrix_from_quat
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.pipeline.prepare import prepare
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import with_settings
from odocal_ros.settings.node_configs import ApplyConfig
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
RATES = {'imu_rate': 50.0, 'odometer_rate': 20.0, 'duration': 120.0}   # replay keeps each epoch
KINDS = {'counts': {}, 'speed': {'odometer': 'speed'}, 'angle': {'odometer': 'angle'}}


@pytest.fixture(scope='module', params=KINDS)
def drive(request):
    """Simulate two minutes in a hilly town with each kind of odometer."""
    return simulate(SimOptions(scenario='town', slope=0.03, fix_noise='rtk',
                               imu_grade='tactical', **RATES, **KINDS[request.param]))


def test_the_path_equals_that_of_replay_with_the_calibration(drive):
    row = int(np.searchsorted(drive.imu.stamp_ns, drive.truth.start_ns)) - 5
    alignment = alignment_of(drive, row)
    result = calibrate(drive.leg(), settings(drive), alignment)
    estimates = result.methods['two_point'].estimates
    assert estimates['yaw_mounting_angle'].value is not None
    poses = poses_of(odometry_of(drive, estimates, **given(alignment, result.origin[0])),
                     samples_of(drive, drive.imu.stamp_ns[row]), drive.form)
    assert len(poses) > 900
    rows = np.searchsorted(drive.imu.stamp_ns, [p.stamp_ns for p in poses]) - row
    off = np.array([p.position for p in poses]) - (result.track_n[rows] - result.track_n[0])
    # rounding errors: 600 m are summed in another order
    assert np.abs(off).max() < 1e-9


@pytest.fixture(scope='module')
def two_wheels():
    """Simulate two wheels whose scale factors differ by 2 %."""
    return simulate(SimOptions(scenario='town', two_wheels=True, wheel_difference=0.02,
                               fix_noise='rtk', imu_grade='tactical', **RATES))


@pytest.mark.core
def test_each_of_two_wheels_has_its_own_scale_factor(two_wheels):
    made = two_wheels
    row = int(np.searchsorted(made.imu.stamp_ns, made.truth.start_ns)) - 5
    alignment, config = alignment_of(made, row), settings(made)
    run, _ = prepare(made.leg(), screen(made.leg(), config)[0], config, alignment=alignment)
    left, right = (dead_reckon(*run.epochs, travel).P * scale for travel, scale in zip(
        (run.inputs.travels[0], run.inputs.travels[1]), made.truth.wheel_scales, strict=True))
    expected = (left + right) / 2 @ forward_b(made.truth.yaw, made.truth.pitch)
    poses = poses_of(odometry_of(made, **given(alignment, run.origin.latitude)),
                     samples_of(made, made.imu.stamp_ns[row]), made.form)
    rows = np.searchsorted(made.imu.stamp_ns, [p.stamp_ns for p in poses]) - row
    off = np.array([p.position for p in poses]) - (expected[rows] - expected[0])
    assert np.abs(off).max() < 1e-9


def blocks_with(drive, change):
    """Return the samples of a drive; change(t from the first row in s, values) of its odometer."""
    blocks = samples_of(drive)
    sent = blocks['odometer']
    t = (sent.stamp_ns - sent.stamp_ns[0]) * 1e-9
    keep, value = change(t, sent.value.copy())
    stamps = sent.stamp_ns[keep]
    return blocks | {'odometer': OdometerSamples(stamps, stamps, value[keep])}


def always(t):
    return np.ones(len(t), bool)


def rolling(t, value):
    return always(t), (value + 60_000) % 2**16


def reset(t, value):
    return always(t), np.where(t > 80.0, value - value[np.searchsorted(t, 80.0)], value)


def one_false(t, value):
    value[np.searchsorted(t, [70.0, 90.0])] = [0, 10**9]
    return always(t), value


def hole(t, value):
    return (t < 70.0) | (t > 73.0), value


FAULTS = {'rollover': (rolling, 1e-9), 'reset': (reset, 1.0), 'false rows': (one_false, 1.5),
          'no messages for 3 s': (hole, 2.0)}


@pytest.fixture(scope='module')
def counted():
    """Simulate two minutes in a town with a counter and a gyro with a bias."""
    return simulate(SimOptions(scenario='town', slope=0.03, imu_grade='consumer', **RATES))


@pytest.fixture(scope='module')
def whole(counted):
    return poses_of(odometry_of(counted), samples_of(counted), counted.form)


@pytest.mark.parametrize('fault', FAULTS)
def test_faults_of_a_counter_change_the_path_only_slightly(counted, whole, fault):
    change, most = FAULTS[fault]
    form = OdometerForm('cumulative', 2**16 if change is rolling else 2**64, 'm/pulse')
    odometry = odometry_of(counted)
    poses = poses_of(odometry, blocks_with(counted, change), form)
    expected = {p.stamp_ns: p for p in whole}
    off = np.array([p.position - expected[p.stamp_ns].position for p in poses
                    if p.stamp_ns in expected])
    assert len(off) > 1100
    assert np.abs(off).max() <= most
    notes = odometry.take_notes()
    assert any('jumps by' in text for text in notes) == (change in (reset, one_false))
    assert max(np.linalg.norm(p.velocity) for p in poses) < 25.0


def test_repeated_rows_change_nothing(counted, whole):
    blocks = samples_of(counted)
    imu = blocks['imu']
    rows = np.insert(np.arange(len(imu.stamp_ns)), 1000, [998, 998])    # earlier rows again
    blocks['imu'] = take(imu, rows)
    poses = poses_of(odometry_of(counted), blocks, counted.form)
    assert [p.stamp_ns for p in poses] == [p.stamp_ns for p in whole]
    np.testing.assert_array_equal(poses[-1].position, whole[-1].position)


def test_the_path_starts_at_zero_along_x_and_the_bias_is_estimated_at_rest(counted, whole):
    first = whole[0]
    np.testing.assert_allclose(first.position, 0.0, atol=1e-6)
    C = matrix_from_quat(first.q)
    assert abs(np.arctan2(C[1, 0], C[0, 0])) < 1e-4
    # of 0.04 deg/s: the remainder is the noise of two seconds
    at_rest = [p.rate for p in whole[:20]]
    assert np.abs(np.mean(at_rest, axis=0)).max() < 3e-4
    assert np.abs(counted.truth.gyro_bias).max() > 3e-4


def test_the_pose_error_is_within_its_covariance(counted, whole):
    last = whole[-1]
    state = counted.motion.at(np.array(
        [(p.stamp_ns - counted.options.start_ns) * 1e-9 for p in (whole[0], last)]))
    C = matrix_from_quat(last.q)
    turned = np.arctan2(C[1, 0], C[0, 0]) - np.diff(state.yaw)[0]
    assert abs((turned + np.pi) % (2 * np.pi) - np.pi) < 3 * np.sqrt(last.pose_cov[5, 5])
    assert 3e-4 < np.sqrt(last.pose_cov[5, 5]) < 0.03
    for covariance in (last.pose_cov, last.twist_cov):
        np.testing.assert_allclose(covariance, covariance.T, atol=1e-15)
        assert np.linalg.eigvalsh(covariance).min() > -1e-12
    grown = [np.trace(p.pose_cov[:2, :2]) for p in whole[::100]]
    assert grown[-1] > grown[len(grown) // 2] > grown[0]


def test_base_link_rotates_about_a_wheel_with_a_lever_arm(counted):
    arm = np.array([1.2, -0.7, 0.3])
    whole, poses = (poses_of(odometry_of(counted, levelling=False, odometer__lever_arm=where),
                             samples_of(counted), counted.form)
                    for where in ((0.0, 0.0, 0.0), tuple(arm.tolist())))
    C = [matrix_from_quat(p.q) for p in (poses[0], poses[-1])]
    np.testing.assert_allclose(poses[-1].position - whole[-1].position,
                               (C[0] - C[1]) @ arm, atol=2e-3)      # C[0]: of 2 s at rest
    turning = max(poses, key=lambda p: abs(p.rate[2]))
    same = next(p for p in whole if p.stamp_ns == turning.stamp_ns)
    np.testing.assert_allclose(turning.velocity - same.velocity,
                               np.cross(turning.rate, -arm), atol=1e-3)


def test_a_backward_time_jump_restarts_the_odometry(counted):
    odometry = odometry_of(counted)
    blocks = samples_of(counted)
    first = poses_of(odometry, blocks, counted.form)
    again = poses_of(odometry, blocks, counted.form)
    assert any('restarts' in text for text in odometry.take_notes())
    assert odometry.restarts == 1
    np.testing.assert_allclose(again[-1].position, first[-1].position, atol=1e-9)


def test_an_imu_without_accelerometer_is_used_with_a_larger_height_variance(counted, whole):
    blocks = samples_of(counted)
    imu = blocks['imu']
    blocks['imu'] = ImuSamples(imu.stamp_ns, imu.received_ns, imu.w_i, np.zeros_like(imu.f_i),
                               imu.q_ni, imu.yaw_variance)
    poses = poses_of(odometry_of(counted), blocks, counted.form)
    off = np.linalg.norm((poses[-1].position - whole[-1].position)[:2])
    assert off < 3 * np.sqrt(np.trace(poses[-1].pose_cov[:2, :2]))
    assert poses[-1].pose_cov[2, 2] > 2 * whole[-1].pose_cov[2, 2]       # no levelling


def test_the_end_of_braking_is_not_treated_as_tilt():
    """A level drive with perfect sensors and hard stops at all phases of the levelling updates."""
    rate, period = 100.0, 9.55
    t = np.arange(0.0, 20 * period, 1 / rate)
    since = (t - 4.0) % period
    accel = np.select([t < 4.0, since < 2.0, since < 3.5, since < 4.5], [0.0, 3.0, 0.0, -6.0])
    path_length = np.cumsum(np.cumsum(accel)) / rate**2
    stamp = 10**18 + np.rint(t * 1e9).astype(np.int64)
    force = np.stack([accel, 0 * t, np.full(len(t), 9.81)], -1)
    imu = ImuSamples(stamp, stamp, 0 * force, force, np.zeros((len(t), 4)),
                     np.full(len(t), np.nan))
    form = OdometerForm('cumulative', 0, 'm/pulse')
    wheel = OdometerSamples(stamp[::4], stamp[::4],
                            np.floor(path_length[::4] / 0.005).astype(np.int64))
    config = with_settings(ApplyConfig(), {'imu.grade': 'consumer', 'publish.rate': 10.0})
    known = {'scale_factor': Estimate(0.005, 1e-7, 'm/pulse'),
             'yaw_mounting_angle': Estimate(0.0, 1e-4, 'rad'),
             'pitch_mounting_angle': Estimate(0.0, 1e-4, 'rad')}
    poses = poses_of(Odometry(vehicle_of(known, config), config), {'imu': imu, 'odometer': wheel},
                     form)
    pitch = np.array([np.arcsin(-matrix_from_quat(p.q)[2, 0]) for p in poses])
    # a speed that is late by 0.1 s at 6 m/s^2 would give a tilt of 0.06 rad
    assert np.abs(pitch).max() < 0.03


@pytest.mark.core
def test_the_scale_factor_as_sent_is_used_if_it_is_given():
    exact = {'scale_factor': Estimate(0.987, 3e-4, '1')}
    assert vehicle_of(exact, ApplyConfig()).scale == 0.987
    sent = exact | {'scale_factor_as_sent': Estimate(0.995, 4e-4, '1')}
    vehicle = vehicle_of(sent, ApplyConfig())
    assert vehicle.scale == 0.995
    assert vehicle.scale_sigma == pytest.approx(4e-4 / 0.995)


def test_covariances_do_not_depend_on_the_rate_of_poses(counted):
    """At 50 Hz they are up to 0.05 s old, except for the interval of the twist."""
    few, many = (poses_of(odometry_of(counted, publish__rate=rate), samples_of(counted),
                          counted.form) for rate in (10.0, 50.0))
    same = {p.stamp_ns: p for p in few}
    pairs = [(p, same[p.stamp_ns]) for p in many if p.stamp_ns in same
             and np.linalg.norm(same[p.stamp_ns].velocity) > 1.0]
    assert len(pairs) > 300
    sigmas = np.sqrt([[np.diag(p.pose_cov) for p in pair] for pair in pairs])
    ratio = sigmas[:, 0] / sigmas[:, 1]
    # growth within 0.05 s of minutes; more while the speed changes, because of the delay
    assert np.abs(np.median(ratio, axis=0) - 1).max() < 0.005
    assert ratio.min() > 0.8
    # rows are 0.02 s apart: each third one is 0.05 s after the last update
    assert len({p.pose_cov.tobytes() for p in many}) == pytest.approx(len(many) / 3, rel=0.1)


@pytest.mark.core
def test_exactly_one_pose_is_ready_after_the_wait_time():
    made = simulate(SimOptions(scenario='straight', duration=180.0, imu_rate=100.0,
                               odometer_rate=100.0, imu_grade='tactical'))
    odometry, blocks = odometry_of(made, publish__rate=20.0), samples_of(made)
    fed_ns, now_ns = 0, int(made.imu.stamp_ns[0]) + 5 * 10**9
    for seconds in range(101):
        for slot, block in blocks.items():
            inside = (block.stamp_ns > fed_ns) & (block.stamp_ns <= now_ns)
            if inside.any():
                odometry.feed(slot, take(block, inside), made.form)
        poses = odometry.poses()
        assert len(poses) == 1 if seconds else poses
        fed_ns, now_ns = now_ns, now_ns + round((odometry.wait_s() + 1e-3) * 1e9)
