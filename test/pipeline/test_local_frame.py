# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A leg whose positions are poses in a local frame gives the values of the same leg with fixes."""

from dataclasses import replace
import math

from drives import drive, off, reason_texts, settings, with_columns
from matplotlib.figure import Figure
import numpy as np
import pytest

from odocal_ros.data.samples import LOCAL_STATUS
from odocal_ros.estimator import make_smoother_leg, prepare
from odocal_ros.estimator.prepare import _priors
from odocal_ros.nav import geodesy
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.geodesy import (
    earth_rate_n,
    local_fixes,
    OMEGA,
    PartlyKnownRate,
    rate_without_north,
)
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.output.plots import draw_track
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.screening.inputs import locate_fixes
from odocal_ros.screening.screen import screen
from odocal_ros.settings.nominal import grade_of
from odocal_ros.sim.real_effects import RealEffects

pytestmark = pytest.mark.slow
NAMES = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')
# method smoother, without a heading
SMOOTHER = {'heading_sigma': None, 'method': 'smoother'}
CAR = {'scenario': 'town', 'duration': 240.0, 'imu_grade': 'consumer', 'fix_noise': 'rtk',
       'seed': 5}
MADE = CAR


def posed(made, latitude_deg=math.nan, position=None):
    """Return the leg of a drive with poses instead of its fixes, or with other positions, m."""
    position = made.positions() if position is None else position
    return replace(made.leg(), fix=local_fixes(latitude_deg)(
        made.fix.stamp_ns, made.fix.received_ns, position))


def without_covariance(made):
    return with_columns(made.leg(), 'fix', covariance_type=np.zeros_like)


def estimates(leg, config):
    return calibrate(leg, config).methods['smoother'].estimates


@pytest.mark.parametrize('options', [
    CAR, CAR | {'scenario': 'yard', 'duration': 180.0}],
    ids=['car', 'robot at walking speed, 91 m'])
def test_poses_give_the_values_of_fixes(options, monkeypatch):
    # poses may be better than GNSS: here not
    monkeypatch.setattr(prepare, 'MIN_POSE_NOISE', prepare.MIN_FIX_NOISE)
    made = drive(**options)
    # the same first sigma: a fit from another start ends within 0.03 sigma of it
    config = settings(made, **SMOOTHER, leg__min_distance=20.0, reference__default_sigma=2.5)
    by_fix, by_pose = (estimates(leg, config) for leg in (without_covariance(made), posed(made)))
    tenth = 0.1     # sigma; the pitch depends on the Earth rate, unknown from poses
    for name, limit in zip(NAMES, (tenth, tenth, 0.4), strict=True):
        a, b = by_fix[name], by_pose[name]
        # estimates of nested data differ by a variance that is the difference of theirs
        lost = np.sqrt(abs(b.sigma**2 - a.sigma**2))
        assert abs(b.value - a.value) < np.hypot(limit * a.sigma, lost), name
        assert b.sigma == pytest.approx(a.sigma, rel=0.1)
    assert off(by_pose, made, *NAMES) < 3


def test_poses_give_the_values_of_fixes_with_the_earth_rate_of_the_frame(monkeypatch):
    made = drive(**CAR | {'fix_noise': 'white'})
    latitude, turned = made.options.latitude, math.pi / 2 - made.options.heading
    rate = earth_rate_n(latitude) @ matrix_from_rpy([0.0, 0.0, turned])
    monkeypatch.setattr(geodesy, 'rate_without_north', lambda latitude: PartlyKnownRate(
        tuple(rate.tolist()), (0.0, 0.0, 0.0)))
    monkeypatch.setattr(prepare, 'drift_time', lambda leg, t: np.diff(t))
    config = settings(made, **SMOOTHER, reference__default_sigma=2.5)
    by_fix = estimates(without_covariance(made), config)
    by_pose = estimates(posed(made, math.degrees(latitude)), config)
    for name in NAMES:
        assert abs(by_pose[name].value - by_fix[name].value) < 0.1 * by_fix[name].sigma


def test_sigma_contains_the_unknown_part_of_the_earth_rate():
    made = drive(**CAR | {'imu_grade': 'tactical'})
    config = settings(made, **SMOOTHER)
    by_fix, by_pose = (estimates(leg, config) for leg in (without_covariance(made), posed(made)))
    yaw = by_pose['yaw_mounting_angle']
    assert 1.2 < yaw.sigma / by_fix['yaw_mounting_angle'].sigma < 3
    assert abs(yaw.value - made.truth.yaw) < 3 * yaw.sigma


def test_a_frame_without_north_has_the_vertical_earth_rate_at_most():
    known = rate_without_north(math.radians(40.0))
    _, north, up = earth_rate_n(math.radians(40.0))
    assert known.rate_n == (0.0, 0.0, pytest.approx(up))
    assert np.linalg.norm(known.sigma_n) == pytest.approx(north)     # in an unknown direction
    unknown = rate_without_north(math.nan)
    assert unknown.rate_n == (0.0, 0.0, 0.0)
    assert unknown.sigma_n == (OMEGA, OMEGA, OMEGA)


@pytest.mark.parametrize('latitude_deg', [math.nan, 40.0])
def test_the_leg_is_placed_in_the_frame_as_sent(made, latitude_deg):
    config = settings(made, reference__latitude_deg=latitude_deg)
    inputs, _ = screen(posed(made, latitude_deg), config)
    there = locate_fixes(inputs, config)
    assert inputs.is_local
    assert there.origin.local_earth_rate == rate_without_north(math.radians(latitude_deg))
    sent = made.positions()[:len(there.fixes_n)]
    off = there.fixes_n - there.fixes_n[0] - (sent - sent[0])
    assert np.abs(off).max() < 0.2       # m: frames at places 300 m apart differ by 5e-5 rad
    distances, as_sent = (np.linalg.norm(x - x[0], axis=1) for x in (there.fixes_n, sent))
    np.testing.assert_allclose(distances, as_sent, atol=1e-4)


def test_data_relative_to_north_is_not_used_and_this_is_reported():
    made = drive(**CAR, heading_sigma=0.001, velocity_sigma=0.05)
    leg, config = posed(made), settings(made, **SMOOTHER)
    inputs, found = screen(leg, config)
    assert not len(inputs.external['heading'].t)
    assert not len(inputs.external['fix_velocity'].t)
    texts = {r.code: r.text for r in found}
    assert Code.VELOCITY_UNUSABLE not in texts
    assert texts[Code.LOCAL_FRAME] == (
        'positions are in a local frame, so north is unknown: up to 15.0 deg/h of the Earth rate '
        'are estimated as gyro bias; GNSS velocities and external headings are not used')
    assert Code.LOCAL_FRAME not in {r.code for r in screen(made.leg(), config)[1]}
    # a configured heading topic is relative to the frame of the positions
    heading_config = settings(made, **SMOOTHER, alignment__heading_source='heading_topic')
    assert len(screen(leg, heading_config)[0].external['heading'].t)
    text = {r.text for r in screen(leg, settings(made, reference__latitude_deg=40.0))[1]
            if r.code is Code.LOCAL_FRAME}
    assert f'up to {15.041 * math.cos(math.radians(40.0)):.1f} deg/h' in text.pop()


def test_a_local_frame_has_no_gyrocompass():
    made = drive(scenario='straight', duration=200.0, imu_grade='navigation', fix_noise='rtk',
                 seed=5)
    config = settings(made, heading_sigma=None)
    assert calibrate(made.leg(), config).methods['two_point'].estimates[
        'yaw_mounting_angle'].value is not None
    result = calibrate(posed(made), config)
    assert Code.YAW_NOT_SEPARABLE in reason_texts(result)
    heading_config = settings(made, heading_sigma=None, alignment__heading_source='gyrocompass')
    assert 'y axis does not point to north' in reason_texts(calibrate(posed(made),
                                                                      heading_config))[
        Code.GYROCOMPASS_REFUSED]


def test_an_orientation_is_a_heading_in_the_frame_only_if_configured():
    made = drive(**CAR, orientation_sigma=0.001)
    for source in ('auto', 'imu_orientation'):
        config = settings(made, heading_sigma=None, alignment__heading_source=source)
        texts = reason_texts(calibrate(posed(made), config))
        assert (Code.YAW_NOT_SEPARABLE in texts) == (source == 'auto')


def test_surveyed_points_are_not_used_in_a_local_frame(made):
    plain, surveyed = (calibrate(posed(made), settings(made, **more)).methods['two_point']
                       for more in ({}, {'reference__start': [40.0, 116.0, 50.0, 0.01]}))
    assert plain.estimates['scale_factor'] == surveyed.estimates['scale_factor']


def test_the_earth_rate_is_in_the_priors_of_the_gyro_bias():
    made = drive(**CAR | {'imu_grade': 'tactical'})
    config = settings(made, imu__grade='tactical', imu__gyro_bias=1e-6)
    inputs, _ = screen(posed(made), config)
    there = locate_fixes(inputs, config)
    leg = make_smoother_leg(inputs, config, there.origin, there.fixes_n, np.empty((0, 2)),
                            there.rough_scale)
    grade = grade_of(config.imu)
    np.testing.assert_allclose(_priors(config, grade, leg).gyro_bias_sigma,
                               math.hypot(1e-6, OMEGA))
    north = replace(leg, origin=replace(there.origin, local_earth_rate=None))
    np.testing.assert_allclose(_priors(config, grade, north).gyro_bias_sigma, 1e-6)


def test_the_bias_at_rest_has_the_sigma_of_the_earth_rate():
    made = drive(**CAR | {'imu_grade': 'tactical'})
    config = settings(made, imu__gyro_bias=1e-3)
    sigmas = [calibrate(leg, config).methods['two_point'].estimates['gyro_bias_z'].sigma
              for leg in (made.leg(), posed(made))]
    assert sigmas[1] == pytest.approx(math.hypot(sigmas[0], OMEGA), rel=0.01)


def test_a_pose_that_contains_the_wheels_is_reported():
    made = drive(**CAR | {'scenario': 'yard', 'duration': 300.0, 'seed': 4},
                 real=RealEffects(receiver_odometer=-0.03))
    config = settings(made, **SMOOTHER, leg__min_distance=20.0)
    result = calibrate(posed(made), config).methods['smoother']
    texts, = (r for r in result.reasons if r.code is Code.FIXES_FOLLOW_ODOMETER)
    assert 'with an uncertainty of the scale of' in texts.text
    position_effects, = (s.effects for s in result.sources if s.name == 'wheels_in_positions')
    scale = result.estimates['scale_factor']
    # 3 % wrong, known as from 300 s / 20 s samples, within a factor of two
    assert 0.5 < position_effects[0, 0] / (0.03 * (20 / 300)**0.5) < 2.0
    assert scale.sigma > position_effects[0, 0] * scale.value
    assert 'positions fused with a wheel speed' in texts.text
    assert all(word in texts.remedy for word in ('SLAM', 'AMCL', 'robot_localization', 'lidar'))
    plain = calibrate(posed(drive(**CAR)), settings(drive(**CAR), **SMOOTHER))
    assert Code.FIXES_FOLLOW_ODOMETER not in reason_texts(plain)


def test_a_result_in_a_local_frame_has_no_map_and_no_north(made):
    assert calibrate(made.leg(), settings(made)).origin is not None
    result = calibrate(posed(made), settings(made))
    assert result.origin is None
    assert result.track_n is not None
    made = drive(**CAR | {'duration': 120.0})
    config = settings(made, **SMOOTHER)
    for leg, axes in ((without_covariance(made), ['east of the start', 'north of the start']),
                      (posed(made), ['x from the start', 'y from the start'])):
        ax = Figure().subplots()
        draw_track(ax, calibrate(leg, config).evidence)
        assert [label.split(',')[0] for label in (ax.get_xlabel(), ax.get_ylabel())] == axes


def test_map_coordinates_are_refused_and_far_positions_stated_with_their_distance(made):
    far = posed(made, position=made.positions() + [691_000.0, 5_334_000.0, 0.0])
    assert (far.fix.status == LOCAL_STATUS).all()
    _, found = screen(far, settings(made))
    refused = {r.text: r.remedy for r in found if r.code is Code.FIXES_UNUSABLE}
    assert refused[f'all {len(far.fix.stamp_ns)} positions are NaN or more than 20 km from the '
                   'origin of their frame, as map coordinates are'] == \
        'Publish positions in a frame with its origin near the site.'
    position = made.positions()
    position[70:74] += 30_000.0
    _, found = screen(posed(made, position=position), settings(made))
    (reason,) = [r for r in found if r.code is Code.BAD_ROWS_DROPPED]
    assert reason.text.startswith(f'4 of {len(position)} fix messages hold NaN or a position more '
                                  'than 20 km from the origin of its frame, first at t = ')


def test_the_simulated_frame_starts_at_the_vehicle_and_looks_ahead():
    made = drive(scenario='straight', duration=200.0, fix_noise='rtk', seed=5, heading=0.3)
    position = made.positions()
    assert np.abs(position[0]).max() < 0.2                # m: errors of 2 cm
    forward = position[len(position) // 3]
    assert abs(forward[1]) < 0.2 * forward[0]
    geodetic = np.stack([made.fix.latitude, made.fix.longitude, made.fix.height], -1)
    origin = Origin(made.options.latitude, made.options.longitude, made.options.height)
    turned = position @ matrix_from_rpy([0.0, 0.0, math.pi / 2 - made.options.heading]).T
    np.testing.assert_allclose(turned, origin.to_n(geodetic), atol=1e-9)
