# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Alignment of a leg: the order of heading sources, each against the simulator's truth."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.data.samples import HeadingSamples, take
from odocal_ros.nav import rotations
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.earth import C_en
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import heading_from_yaw, wrap, yaw_from_heading
from odocal_ros.nav.standstill import standstills
from odocal_ros.pipeline.align import align, choose_standstill, with_observed_walk
from odocal_ros.pipeline.prepared import attitude_of
from odocal_ros.reasons import Code
from odocal_ros.screening.inputs import UsableRows
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.settings.grades import GRADES
from odocal_ros.sim.motion import attitude
from odocal_ros.sim.scenarios import SimOptions, simulate

PLAIN = SimOptions(scenario='straight', duration=240.0, imu_grade='perfect', imu_rate=50.0,
                   yaw=0.02, pitch=0.01)
TURNING = replace(PLAIN, scenario='town', duration=300.0)
PLACE = 1e-6     # rad: fixes of 1.5 m say where north and level of a standstill are, 2.4e-7


def settings(**changes):
    return with_settings(Config(), {k.replace('__', '.'): v for k, v in changes.items()})


class Case:
    """A drive made ready for ``align``, its start mark ``later`` seconds on if asked."""

    def __init__(self, options, config=None, later=0.0, forget=False):
        self.drive = simulate(options)
        self.config = config or settings(imu__grade='navigation')
        leg = self.drive.leg()
        start_ns = leg.start_ns + round(later * 1e9)
        if forget:     # no pre-roll: the recording begins at the mark

            leg = leg.with_rows(**{slot: take(leg.rows(slot),
                                              leg.rows(slot).stamp_ns >= start_ns)
                                   for slot in ('imu', 'odometer', 'fix', 'heading')})
        self.leg = replace(leg, start_ns=start_ns)
        self.mark = (start_ns - self.drive.options.start_ns) * 1e-9     # s of the motion
        self.inputs, _ = screen(self.leg, self.config)
        near = int(np.argmin(np.abs(self.inputs.t_fix)))
        self.origin = Origin(*(float(x) for x in self.inputs.geodetic[near]))
        self.fixes_n = self.origin.to_n(self.inputs.geodetic)
        self.scale = self.drive.truth.scale
        self.spans = standstills(self.inputs.t_imu, self.inputs.w_b, self.inputs.travel,
                                 self.scale, 2.0)

    def align(self, spans=None, **changes):
        inputs = replace(self.inputs, **changes)
        return align(inputs, self.spans if spans is None else spans, self.scale, self.fixes_n,
                     self.origin, self.config)

    def truth(self, t):
        """Return the true C_nb at t, n being that of the origin."""
        state = self.drive.motion.at(np.array([self.mark + t]))
        o = self.drive.options
        C_vb = rotations.matrix_from_rpy([o.roll, o.pitch, o.yaw])
        C_np = rotations.transpose(C_en(self.origin.latitude, self.origin.longitude)) @ C_en(
            state.latitude[0], state.longitude[0])
        return C_np @ attitude(state)[0] @ C_vb

    def miss(self, alignment):
        """Return how the alignment turns n against the truth, as a rotation vector, rad."""
        return np.array(rotations.rpy_from_matrix(alignment.C_nb @ self.truth(alignment.t).T))


@pytest.fixture(scope='module')
def plain():
    return Case(PLAIN)


@pytest.fixture(scope='module')
def turning():
    return Case(TURNING)


def asked(case, **changes):
    """Return the case with other settings (those that the screening does not use)."""
    other = object.__new__(Case)
    config = settings(**{'imu__grade': 'navigation'} | changes)
    other.__dict__ |= case.__dict__ | {'config': config}
    return other


# ---------------------------------------------------------------- standstill and level

@pytest.mark.parametrize(('spans', 'chosen'), [
    ([], None), ([[5.0, 9.0]], None), ([[-9.0, 3.0]], 0), ([[-9.0, -5.0], [-3.0, -1.0]], 1),
    ([[-9.0, -5.0], [0.4, 3.0]], 1), ([[-9.0, -5.0], [0.6, 3.0]], 0)])
def test_the_standstill_that_holds_or_last_ended_before_the_mark(spans, chosen):
    found = choose_standstill(np.array(spans).reshape(-1, 2))
    assert found is None if chosen is None else found.tolist() == spans[chosen]


@pytest.fixture(scope='module')
def far():
    """Return a drive whose mark is set 3 km after its standstill."""
    return Case(replace(PLAIN, duration=500.0, heading_sigma=0.0, fix_sigma=0.0), later=300.0)


@pytest.mark.parametrize('source', ['heading_topic', 'gyrocompass', 'fixed'])
def test_a_standstill_far_from_the_mark_is_level_and_north_where_it_was(far, source):
    x_n = far.truth(0.0)[:, 0]
    heading = float(heading_from_yaw(np.arctan2(x_n[1], x_n[0])))
    a, _ = asked(far, alignment__heading_source=source, alignment__heading=heading).align()
    assert a.t < -250
    assert a.heading_source == source
    # fixes to a millimetre; a heading carried back is that of an axis pitched by 0.01 rad, and the
    # level it is seen on has leant by 0.4 mrad meanwhile
    assert_allclose(far.miss(a), 0, atol=5e-6 if source == 'fixed' else 2e-7)


@pytest.mark.parametrize('seed', [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize('grade', ['consumer', 'tactical'])
def test_level_in_motion_is_within_its_sigma(seed, grade):
    case = Case(replace(TURNING, imu_grade=grade, seed=seed, yaw=0.0, pitch=0.0), forget=True,
                config=settings(imu__grade=grade), later=14.0)
    a, reasons = case.align(spans=np.empty((0, 2)))
    assert Code.NO_STANDSTILL in {r.code for r in reasons}
    assert a.standstill is None
    assert_allclose(a.gyro_bias_sigma, a.gyro_bias_sigma[0])
    tilt = (a.C_nb.T @ [0, 0, 1.0]) @ case.truth(a.t).T       # up as levelled, in the true n
    # four sigmas in twelve drives of two axes: 1.5e-3 to fail by chance
    assert np.abs(tilt[:2]).max() < 4 * a.level_sigma
    assert a.level_sigma < 0.03


@pytest.mark.parametrize('slope', [0.0, 2e-7])
def test_a_gyro_that_warms_up_walks_as_its_standstills_show(slope):
    """The bias changes by slope T until a standstill, as a walk of slope sqrt(T) does."""
    case = Case(TURNING)
    alignment, _ = case.align()
    late = np.clip(case.inputs.t_imu - alignment.t, 0.0, None)
    inputs = replace(case.inputs, w_b=case.inputs.w_b + slope * late[:, None])
    epochs = attitude_of(inputs, case.origin, alignment.t, alignment.q_nb, alignment.gyro_bias)
    later = case.spans[case.spans[:, 0] > alignment.t]
    assert len(later) > 1
    seen = with_observed_walk(alignment, inputs, case.spans, epochs, case.origin.earth_rate_n)
    # the heading of a course has an error, and with it the Earth rate
    walk = slope * np.sqrt(np.median(later.mean(axis=1) - alignment.t))
    assert seen.gyro_bias_walk == pytest.approx(max(walk, alignment.gyro_bias_walk), rel=0.1)
    if slope:
        assert walk > 10 * alignment.gyro_bias_walk
    unknown = with_observed_walk(replace(alignment, standstill=None), inputs, case.spans, epochs,
                             case.origin.earth_rate_n)
    assert unknown.gyro_bias_walk == alignment.gyro_bias_walk


def test_an_imu_taken_for_better_than_it_is_has_the_errors_of_its_noise():
    """The noise at rest is that of the consumer grade; its accelerometer tilts the level."""
    noisy = replace(PLAIN, imu_grade='consumer')
    alignment, _ = Case(noisy, settings(imu__grade='tactical')).align()
    own, _ = Case(noisy, settings(imu__grade='consumer')).align()
    grade = GRADES['consumer']
    assert alignment.gyro_bias_walk == own.gyro_bias_walk == grade.gyro_bias_walk
    assert alignment.gyro_scale_sigma == grade.gyro_scale_error
    assert alignment.gyro_axes_sigma == pytest.approx(np.sqrt(2) * grade.misalignment)
    # sold with a bias of 25 mg
    assert own.level_sigma == pytest.approx(
        np.hypot(25e-3, np.sqrt(2) * grade.misalignment), rel=0.01)


def test_level_in_motion_takes_the_acceleration_out():
    """Pulling away at 0.5 m/s^2 leans the specific force by 50 mrad."""
    case = Case(replace(PLAIN, yaw=0.0, pitch=0.0), forget=True, later=2.0)
    a, _ = case.align(spans=np.empty((0, 2)))
    assert case.inputs.f_b[50:500, 0].mean() / 9.8 > 0.04
    tilt = (a.C_nb.T @ [0, 0, 1.0]) @ case.truth(a.t).T
    # pulses of 2 cm over 1 s: 0.02 m/s of 30 s * g; level turning 1e-3 rad with the Earth
    assert np.abs(tilt[:2]).max() < 1.5e-3


@pytest.mark.parametrize('rows', [2, 3])
def test_an_imu_that_falls_silent_at_the_mark_is_still_aligned(plain, rows):
    keep = plain.inputs.t_imu < 0
    keep[:np.flatnonzero(keep)[-rows]] = False
    short = {name: getattr(plain.inputs, name)[keep]
             for name in ('t_imu', 'w_b', 'f_b', 'q_ni', 'yaw_variance')}
    a, reasons = plain.align(spans=np.empty((0, 2)), **short)
    assert np.isfinite(a.C_nb).all()
    assert Code.NO_STANDSTILL in {r.code for r in reasons}


# ---------------------------------------------------------------- fixed heading

@pytest.mark.parametrize('heading_deg', [43.3, 0.0, 270.0])
def test_a_fixed_heading_is_a_compass_quantity(heading_deg):
    """ENU yaw of 46.7 deg is heading 43.3 deg."""
    case = Case(replace(PLAIN, heading=np.deg2rad(heading_deg), yaw=0.0, pitch=0.0))
    a, _ = asked(case, alignment__heading=float(np.deg2rad(heading_deg)),
                 alignment__heading_sigma=0.003).align()
    assert wrap(yaw_of(a) - np.deg2rad(90 - heading_deg)) == pytest.approx(0, abs=PLACE)
    assert_allclose(case.miss(a), 0, atol=1e-6)
    assert (a.heading_source, a.heading_sigma, a.heading_shared) == ('fixed', 0.003, True)


@pytest.mark.parametrize('later', [8.0, 25.0, 80.0])
def test_a_fixed_heading_at_a_moving_mark_is_carried_back_to_the_standstill(later):
    case = Case(replace(TURNING, fix_sigma=0.0), later=later)
    x_n = case.truth(0.0)[:, 0]
    heading = float(heading_from_yaw(np.arctan2(x_n[1], x_n[0])))
    a, _ = asked(case, alignment__heading=heading).align()
    # a perfect gyro at 50 Hz; Earth rate left on axes that the body has turned from: 7e-5 rad/s
    # times what it is tilted by, 0.01 rad, for a minute: 4e-5 at the very most
    assert_allclose(case.miss(a), 0, atol=5e-6)


# ---------------------------------------------------------------- orientation and heading topic

def orientations(case, yaw, variance):
    """Return inputs for an IMU that sends one orientation, of its own frame i, all the time."""
    n = len(case.inputs.t_imu)
    q = rotations.quat_from_matrix(rotations.matrix_from_rpy([0.0, 0.0, yaw]) @ case.inputs.C_bi)
    return {'q_ni': np.tile(q, (n, 1)), 'yaw_variance': np.full(n, variance)}


def heading_rows(yaw, variance, t):
    q = rotations.quat_from_rotvec(np.outer(np.broadcast_to(yaw, np.shape(t)), [0, 0, 1]))
    stamp_ns = np.round(t * 1e9)
    sent = HeadingSamples(stamp_ns, stamp_ns, q, np.full(len(t), variance))
    return {'outside': {'heading': UsableRows(sent, t)}}


def yaw_of(alignment):
    return np.arctan2(alignment.C_nb[1, 0], alignment.C_nb[0, 0])


@pytest.mark.parametrize(('variance', 'sigma'), [(1e-4, 0.01), (0.0, 0.0175)])
def test_orientation_of_the_imu_with_its_sigma_or_the_setting(plain, variance, sigma):
    case = asked(plain, alignment__heading_source='imu_orientation')
    a, reasons = case.align(**orientations(plain, 2.9, variance))
    assert yaw_of(a) == pytest.approx(2.9, abs=PLACE)
    assert (a.heading_source, a.heading_shared) == ('imu_orientation', True)
    assert a.heading_sigma == pytest.approx(sigma)
    assert reasons == ()


def test_orientation_is_of_the_imu_frame_not_of_the_body():
    """An IMU mounted 90 deg to the left sends a yaw that is 90 deg more."""
    nominal = (0.0, 0.0, np.pi / 2)
    case = Case(replace(PLAIN, mounting_rpy=nominal, orientation_sigma=0.0, yaw=0.0, pitch=0.0),
                config=settings(imu__grade='navigation', imu__mounting_rpy=list(nominal),
                                alignment__heading_source='imu_orientation'))
    a, _ = case.align()
    assert_allclose(case.miss(a), 0, atol=1e-6)


def test_means_of_headings_go_over_the_seam_and_have_their_offset(plain):
    case = asked(plain, alignment__heading_source='heading_topic')
    t = np.linspace(-30, -10, 200)
    a, _ = case.align(**heading_rows(np.pi + 0.01 * (-1.0)**np.arange(200), 1e-4, t))
    assert abs(yaw_of(a)) == pytest.approx(np.pi, abs=PLACE)
    case = asked(plain, alignment__heading_source='heading_topic', alignment__heading_offset=0.3)
    a, _ = case.align(**heading_rows(1.0, 4e-6, np.linspace(-50, 50, 1001)))
    assert yaw_of(a) == pytest.approx(1.3, abs=PLACE)
    assert (a.heading_source, a.heading_shared) == ('heading_topic', True)
    assert a.heading_sigma == pytest.approx(2e-3)


def test_in_motion_the_nearest_heading_is_taken_and_none_of_long_ago(plain):
    case = asked(plain, alignment__heading_source='heading_topic')
    rows = heading_rows(np.array([9.0, 1.0, 2.0, 9.0]), np.array([np.nan, 1e-4, 1e-4, 1e-4]),
                        np.array([0.0, 0.1, 0.3, 0.6]))
    a, _ = case.align(spans=np.empty((0, 2)), **rows)
    assert yaw_of(a) == pytest.approx(1.0, abs=PLACE)
    case = asked(plain, alignment__heading_source='heading_topic')
    a, reasons = case.align(spans=np.empty((0, 2)),
                            **heading_rows(1.0, 1e-4, np.array([-0.6, 0.6])))
    assert a.heading_source == 'course'
    assert Code.HEADING_UNAVAILABLE in {r.code for r in reasons}


@pytest.mark.parametrize('source', ['imu_orientation', 'heading_topic'])
@pytest.mark.parametrize(('variance', 'says'), [
    (np.nan, 'covariance[0] = -1'), (10.0, 'sigma is 181 deg; the limit is')])
def test_an_orientation_not_sent_or_worthless_is_refused(plain, source, variance, says):
    case = asked(plain, alignment__heading_source=source)
    rows = orientations(plain, 1.0, variance) if source == 'imu_orientation' else \
        heading_rows(1.0, variance, np.linspace(-50, 50, 1001))
    a, reasons = case.align(**rows)
    assert a.heading_source == 'course'
    assert [r.code for r in reasons] == [Code.HEADING_UNAVAILABLE]
    assert source in reasons[0].text
    assert says in reasons[0].text


@pytest.mark.parametrize(('source', 'says', 'sent'), [
    ('fixed', 'alignment.heading is not set', {}), ('heading_topic', 'no message', {}),
    ('imu_orientation', '', {'q_ni': 0.0, 'yaw_variance': 0.0})])       # quaternions of zeros
def test_a_source_without_data_is_refused(plain, source, says, sent):
    a, reasons = asked(plain, alignment__heading_source=source).align(**{
        name: value * getattr(plain.inputs, name) for name, value in sent.items()})
    assert a.heading_source == 'course'
    assert reasons[0].code is Code.HEADING_UNAVAILABLE
    assert says in reasons[0].text


# ---------------------------------------------------------------- gyrocompass

def test_gyrocompass_of_a_perfect_gyro(plain):
    a, reasons = asked(plain, alignment__heading_source='gyrocompass').align()
    assert reasons == ()
    assert (a.heading_source, a.heading_shared) == ('gyrocompass', False)
    assert a.standstill is not None
    assert a.t <= 0.5
    # place known to 1.5 m / R = 2.4e-7 rad; the level likewise; 3000 rows of 9.8 m/s^2
    assert_allclose(plain.miss(a), 0, atol=1e-6)
    assert_allclose(a.gyro_bias, 0, atol=1e-10)        # 1e-6 rad of level times the Earth rate


TOO_POOR = 'causes a heading uncertainty of'


@pytest.mark.parametrize(('changes', 'bias_deg_h', 'text'), [
    *(({'imu__grade': grade}, 0.0, TOO_POOR) for grade in ('consumer', 'industrial', 'tactical')),
    # a tactical gyro set as navigation grade: its compass would be 20 deg off, at 0.1 stated
    ({}, [5.0, 0.0, 0.0], 'the Earth rate'), ({}, [0.0, 0.0, -2.0], 'the Earth rate')])
def test_a_gyro_that_does_not_show_the_turn_of_the_earth_is_no_compass(
        plain, changes, bias_deg_h, text):
    case = asked(plain, alignment__heading_source='gyrocompass', **changes)
    case.inputs = replace(case.inputs, w_b=case.inputs.w_b + np.deg2rad(bias_deg_h) / 3600)
    a, reasons = case.align()
    assert a.heading_source == 'course'
    assert [r.code for r in reasons] == [Code.GYROCOMPASS_REFUSED]
    assert text in reasons[0].text


def test_a_gyrocompass_needs_a_standstill(plain):
    _, reasons = asked(plain, alignment__heading_source='gyrocompass').align(
        spans=np.empty((0, 2)))
    assert {r.code for r in reasons} == {Code.NO_STANDSTILL, Code.GYROCOMPASS_REFUSED}


# ---------------------------------------------------------------- course

@pytest.mark.parametrize('heading_deg', [0.0, 45.0, 180.0, 269.0])
def test_course_of_the_first_thirty_metres_holds_the_mounting_angle(heading_deg):
    case = Case(replace(PLAIN, heading=np.deg2rad(heading_deg), fix_sigma=0.0))
    a, reasons = asked(case, alignment__heading_source='course').align()
    assert reasons == ()
    assert not a.heading_separable
    assert a.heading_shared
    # b's x axis is taken for forward: off by the mounting angle; 1 mm fixes over 30 m, 2 cm pulses
    assert wrap(yaw_of(a) - yaw_from_heading(np.deg2rad(heading_deg))) == pytest.approx(
        0, abs=2e-4)
    assert wrap(yaw_of(a) - np.arctan2(*case.truth(a.t)[[1, 0], 0])) == pytest.approx(
        -PLAIN.yaw, abs=2e-4)
    assert np.abs(case.miss(a)[:2]).max() < 1e-5


def test_course_sigma_holds():
    z = []
    for seed in range(30):
        case = Case(replace(PLAIN, imu_rate=20.0, odometer_rate=20.0, seed=seed, duration=190.0))
        a, _ = asked(case, alignment__heading_source='course').align()
        z.append(wrap(yaw_of(a) - yaw_from_heading(PLAIN.heading)) / a.heading_sigma)
    # the variance of 30 normal draws is within 4 * sqrt(2 / 30) = 1.03 of one, never below 0.3
    assert 0.3 < np.mean(np.square(z)) < 2.03


def test_course_of_a_vehicle_that_first_reverses(plain):
    """Counting down on the way backwards, the track is the same as forwards."""
    t = plain.inputs.travel
    case = asked(plain, alignment__heading_source='course')
    a, _ = case.align(travel=Travel(t.t, -t.s, t.quantum))
    forwards, _ = case.align()
    assert abs(wrap(yaw_of(a) - yaw_of(forwards))) == pytest.approx(np.pi, abs=1e-6)


def test_without_motion_or_fixes_after_the_mark_there_is_no_course(plain):
    case = asked(plain, alignment__heading_source='course')
    a, reasons = case.align(travel=Travel(plain.inputs.travel.t, 0 * plain.inputs.travel.s, 1.0))
    assert a.heading_sigma == np.pi
    assert reasons[-1].code is Code.HEADING_UNAVAILABLE
    assert '30 m' in reasons[-1].text
    case.fixes_n = np.empty((0, 3))
    a, _ = case.align(t_fix=np.empty(0), covariance_n=np.empty((0, 3, 3)))
    assert a.heading_sigma == np.pi


# ---------------------------------------------------------------- order of auto

def test_auto_takes_the_first_that_answers(plain):
    t = np.linspace(-50, 50, 1001)
    case = asked(plain)
    everything = heading_rows(1.0, 1e-4, t) | orientations(plain, 2.0, 1e-4)
    assert case.align(**everything)[0].heading_source == 'heading_topic'
    assert case.align(**orientations(plain, 2.0, 1e-4))[0].heading_source == 'imu_orientation'
    assert case.align()[0].heading_source == 'gyrocompass'
    poor = asked(plain)
    poor.config = settings(imu__grade='industrial')
    a, reasons = poor.align()
    assert a.heading_source == 'course'
    assert reasons == ()        # nobody asked for the others
    given = asked(plain, alignment__heading=1.0)
    assert given.align(**everything)[0].heading_source == 'fixed'


@pytest.mark.parametrize('source', ['heading_topic', 'imu_orientation', 'gyrocompass', 'course'])
def test_an_asked_source_is_taken_though_others_come_first(plain, source):
    rows = heading_rows(1.0, 1e-4, np.linspace(-50, 50, 1001)) | orientations(plain, 2.0, 1e-4)
    case = asked(plain, alignment__heading_source=source)
    assert case.align(**rows)[0].heading_source == source
