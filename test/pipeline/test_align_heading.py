# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The heading of a leg: the order of its sources, each against the simulator's truth."""

from dataclasses import replace

from align_cases import Case, PLAIN, settings, TURNING
import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.data.samples import HeadingSamples
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import (
    matrix_from_rpy,
    quat_from_matrix,
    quat_from_rotvec,
    wrap,
    yaw_from_heading,
)
from odocal_ros.reasons import Code
from odocal_ros.screening.inputs import UsableRows

PLACE = 1e-6     # rad: north and level at a standstill by fixes of 1.5 m, 2.4e-7


@pytest.fixture(scope='module')
def plain():
    return Case(PLAIN)


@pytest.mark.parametrize('heading_deg', [43.3, 0.0, 270.0])
def test_a_fixed_heading_is_a_compass_quantity(heading_deg):
    case = Case(replace(PLAIN, heading=np.deg2rad(heading_deg), yaw=0.0, pitch=0.0))
    a, _ = case.with_settings_of(alignment__heading=float(np.deg2rad(heading_deg)),
                 alignment__heading_sigma=0.003).align()
    assert wrap(yaw_of(a) - np.deg2rad(90 - heading_deg)) == pytest.approx(0, abs=PLACE)
    assert_allclose(case.miss(a), 0, atol=1e-6)
    assert (a.heading_source, a.heading_sigma, a.heading_shared) == ('fixed', 0.003, True)


@pytest.mark.parametrize('later', [8.0, 25.0, 80.0])
def test_a_fixed_heading_at_a_moving_mark_is_carried_back_to_the_standstill(later):
    case = Case(replace(TURNING, fix_sigma=0.0), later=later)
    a, _ = case.with_settings_of(alignment__heading=case.heading()).align()
    # a perfect gyro at 50 Hz; Earth rate on axes from before the body turned: 7e-5 rad/s times
    # the tilt, 0.01 rad, for a minute: 4e-5 at most
    assert_allclose(case.miss(a), 0, atol=5e-6)


def orientations(case, yaw, variance):
    """Return inputs for an IMU that always sends the same orientation, of its own frame i."""
    n = len(case.inputs.t_imu)
    q = quat_from_matrix(matrix_from_rpy([0.0, 0.0, yaw]) @ case.inputs.C_bi)
    return {'q_ni': np.tile(q, (n, 1)), 'yaw_variance': np.full(n, variance)}


def heading_rows(yaw, variance, t):
    q = quat_from_rotvec(np.outer(np.broadcast_to(yaw, np.shape(t)), [0, 0, 1]))
    stamp_ns = np.round(t * 1e9)
    sent = HeadingSamples(stamp_ns, stamp_ns, q, np.full(len(t), variance))
    return {'external': {'heading': UsableRows(sent, t)}}


def yaw_of(alignment):
    return np.arctan2(alignment.C_nb[1, 0], alignment.C_nb[0, 0])


@pytest.mark.parametrize(('variance', 'sigma'), [(1e-4, 0.01), (0.0, 0.0175)])
def test_orientation_of_the_imu_has_its_own_sigma_or_that_of_the_setting(plain, variance, sigma):
    case = plain.with_settings_of(alignment__heading_source='imu_orientation')
    a, reasons = case.align(**orientations(plain, 2.9, variance))
    assert yaw_of(a) == pytest.approx(2.9, abs=PLACE)
    assert (a.heading_source, a.heading_shared) == ('imu_orientation', True)
    assert a.heading_sigma == pytest.approx(sigma)
    assert reasons == ()


def test_orientation_is_of_the_imu_frame_not_of_the_body():
    nominal = (0.0, 0.0, np.pi / 2)
    case = Case(replace(PLAIN, mounting_rpy=nominal, orientation_sigma=0.0, yaw=0.0, pitch=0.0),
                config=settings(imu__grade='navigation', imu__mounting_rpy=list(nominal),
                                alignment__heading_source='imu_orientation'))
    a, _ = case.align()
    assert_allclose(case.miss(a), 0, atol=1e-6)


def test_mean_heading_is_right_across_the_wrap_around_and_has_its_offset(plain):
    case = plain.with_settings_of(alignment__heading_source='heading_topic')
    t = np.linspace(-30, -10, 200)
    a, _ = case.align(**heading_rows(np.pi + 0.01 * (-1.0)**np.arange(200), 1e-4, t))
    assert abs(yaw_of(a)) == pytest.approx(np.pi, abs=PLACE)
    case = plain.with_settings_of(alignment__heading_source='heading_topic',
                                  alignment__heading_offset=0.3)
    a, _ = case.align(**heading_rows(1.0, 4e-6, np.linspace(-50, 50, 1001)))
    assert yaw_of(a) == pytest.approx(1.3, abs=PLACE)
    assert (a.heading_source, a.heading_shared) == ('heading_topic', True)
    assert a.heading_sigma == pytest.approx(2e-3)


def test_in_motion_the_nearest_heading_is_used_and_no_old_one(plain):
    case = plain.with_settings_of(alignment__heading_source='heading_topic')
    rows = heading_rows(np.array([9.0, 1.0, 2.0, 9.0]), np.array([np.nan, 1e-4, 1e-4, 1e-4]),
                        np.array([0.0, 0.1, 0.3, 0.6]))
    a, _ = case.align(spans=np.empty((0, 2)), **rows)
    assert yaw_of(a) == pytest.approx(1.0, abs=PLACE)
    a, reasons = case.align(spans=np.empty((0, 2)),
                            **heading_rows(1.0, 1e-4, np.array([-0.6, 0.6])))
    assert a.heading_source == 'course'
    assert Code.HEADING_UNAVAILABLE in {r.code for r in reasons}


@pytest.mark.parametrize('source', ['imu_orientation', 'heading_topic'])
@pytest.mark.parametrize(('variance', 'words'), [
    (np.nan, 'covariance[0] = -1'), (10.0, 'sigma is 181 deg; the limit is')])
def test_a_missing_or_invalid_orientation_is_refused(plain, source, variance, words):
    case = plain.with_settings_of(alignment__heading_source=source)
    rows = orientations(plain, 1.0, variance) if source == 'imu_orientation' else \
        heading_rows(1.0, variance, np.linspace(-50, 50, 1001))
    a, reasons = case.align(**rows)
    assert a.heading_source == 'course'
    assert [r.code for r in reasons] == [Code.HEADING_UNAVAILABLE]
    assert source in reasons[0].text
    assert words in reasons[0].text


@pytest.mark.parametrize(('source', 'words', 'sent'), [
    ('fixed', 'alignment.heading is not set', {}), ('heading_topic', 'no message', {}),
    ('imu_orientation', '', {'q_ni': 0.0, 'yaw_variance': 0.0})])       # quaternions of zeros
def test_a_source_without_data_is_refused(plain, source, words, sent):
    a, reasons = plain.with_settings_of(alignment__heading_source=source).align(**{
        name: value * getattr(plain.inputs, name) for name, value in sent.items()})
    assert a.heading_source == 'course'
    assert reasons[0].code is Code.HEADING_UNAVAILABLE
    assert words in reasons[0].text


TOO_POOR = 'causes a heading uncertainty of'


@pytest.mark.parametrize(('changes', 'bias_deg_h', 'text'), [
    *(({'imu__grade': grade}, 0.0, TOO_POOR) for grade in ('consumer', 'industrial', 'tactical')),
    # tactical gyro configured as navigation: its gyrocompass errs by 20 deg and states 0.1
    ({}, [5.0, 0.0, 0.0], 'the Earth rate'), ({}, [0.0, 0.0, -2.0], 'the Earth rate')])
def test_a_gyro_that_does_not_show_the_earth_rate_gives_no_heading(
        plain, changes, bias_deg_h, text):
    case = plain.with_settings_of(alignment__heading_source='gyrocompass', **changes)
    case.inputs = replace(case.inputs, w_b=case.inputs.w_b + np.deg2rad(bias_deg_h) / 3600)
    a, reasons = case.align()
    assert a.heading_source == 'course'
    assert [r.code for r in reasons] == [Code.GYROCOMPASS_REFUSED]
    assert text in reasons[0].text


def test_a_gyrocompass_needs_a_standstill(plain):
    _, reasons = plain.with_settings_of(alignment__heading_source='gyrocompass').align(
        spans=np.empty((0, 2)))
    assert {r.code for r in reasons} == {Code.NO_STANDSTILL, Code.GYROCOMPASS_REFUSED}


@pytest.mark.parametrize('heading_deg', [0.0, 45.0, 180.0, 269.0])
def test_course_of_the_first_thirty_metres_contains_the_mounting_angle(heading_deg):
    case = Case(replace(PLAIN, heading=np.deg2rad(heading_deg), fix_sigma=0.0))
    a, reasons = case.with_settings_of(alignment__heading_source='course').align()
    assert reasons == ()
    assert not a.heading_separable
    assert a.heading_shared
    # x of b is used as forward: wrong by the mounting angle; 1 mm fixes over 30 m, 2 cm pulses
    assert wrap(yaw_of(a) - yaw_from_heading(np.deg2rad(heading_deg))) == pytest.approx(
        0, abs=2e-4)
    assert wrap(yaw_of(a) - np.arctan2(*case.truth(a.t)[[1, 0], 0])) == pytest.approx(
        -PLAIN.yaw, abs=2e-4)
    assert np.abs(case.miss(a)[:2]).max() < 1e-5


def test_course_error_agrees_with_its_sigma():
    z = []
    for seed in range(30):
        case = Case(replace(PLAIN, imu_rate=20.0, odometer_rate=20.0, seed=seed, duration=190.0))
        a, _ = case.with_settings_of(alignment__heading_source='course').align()
        z.append(wrap(yaw_of(a) - yaw_from_heading(PLAIN.heading)) / a.heading_sigma)
    # the variance of 30 normal draws is within 4 * sqrt(2 / 30) = 1.03 of one, never below 0.3
    assert 0.3 < np.mean(np.square(z)) < 2.03


def test_course_of_a_vehicle_that_first_reverses(plain):
    t = plain.inputs.travel
    case = plain.with_settings_of(alignment__heading_source='course')
    a, _ = case.align(travel=Travel(t.t, -t.s, t.quantum))
    forwards, _ = case.align()
    assert abs(wrap(yaw_of(a) - yaw_of(forwards))) == pytest.approx(np.pi, abs=1e-6)


def test_without_motion_or_fixes_after_the_mark_there_is_no_course(plain):
    case = plain.with_settings_of(alignment__heading_source='course')
    a, reasons = case.align(travel=Travel(plain.inputs.travel.t, 0 * plain.inputs.travel.s, 1.0))
    assert a.heading_sigma == np.pi
    assert reasons[-1].code is Code.HEADING_UNAVAILABLE
    assert '30 m' in reasons[-1].text
    case.fixes_n = np.empty((0, 3))
    a, _ = case.align(t_fix=np.empty(0), covariance_n=np.empty((0, 3, 3)))
    assert a.heading_sigma == np.pi


def test_auto_uses_the_first_source_that_is_available(plain):
    t = np.linspace(-50, 50, 1001)
    case = plain.with_settings_of()
    everything = heading_rows(1.0, 1e-4, t) | orientations(plain, 2.0, 1e-4)
    assert case.align(**everything)[0].heading_source == 'heading_topic'
    assert case.align(**orientations(plain, 2.0, 1e-4))[0].heading_source == 'imu_orientation'
    a, reasons = case.align()
    assert (a.heading_source, a.heading_shared, reasons) == ('gyrocompass', False, ())
    assert_allclose(a.gyro_bias, 0, atol=1e-10)        # 1e-6 rad of level times the Earth rate
    a, reasons = plain.with_settings_of(imu__grade='industrial').align()
    assert a.heading_source == 'course'
    assert reasons == ()        # no reasons of sources that are not needed
    given = plain.with_settings_of(alignment__heading=1.0)
    assert given.align(**everything)[0].heading_source == 'fixed'


@pytest.mark.parametrize('source', ['heading_topic', 'imu_orientation', 'gyrocompass', 'course'])
def test_a_configured_source_is_used_although_others_come_first(plain, source):
    rows = heading_rows(1.0, 1e-4, np.linspace(-50, 50, 1001)) | orientations(plain, 2.0, 1e-4)
    case = plain.with_settings_of(alignment__heading_source=source)
    assert case.align(**rows)[0].heading_source == source
