# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The running estimate: what it costs, how near to the result it is, what it says is lacking."""

from dataclasses import replace
import math
from types import SimpleNamespace
import warnings

from drives import thinned
import numpy as np
import pytest

from odocal_ros.calib.result import Estimate
from odocal_ros.data.samples import take
from odocal_ros.errors import BadData, OdocalError
from odocal_ros.estimator import growing
from odocal_ros.estimator.growing import carried, LOOK_PASSES, steps_of
from odocal_ros.estimator.prepare import problem_of
from odocal_ros.forecast.forecast import Abandoned, as_keys, Forecast, Prospect
from odocal_ros.forecast.foresight import forecast_of
from odocal_ros.forecast.leg_so_far import SmootherSoFar
from odocal_ros.forecast.smoother_forecast import look, with_running
from odocal_ros.live.answers import hint
from odocal_ros.live.session import Session, SessionView
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

pytestmark = pytest.mark.slow
NAMES = ('scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle')
LOOKS = (30.0, 47.0, 60.0, 95.0, 108.0, 165.0, 172.0, 240.0)    # s after the start mark


def drive_of(**options):
    return simulate(SimOptions(**{'scenario': 'town', 'duration': 260.0, 'imu_rate': 50.0,
                                  'imu_grade': 'industrial', 'seed': 7} | options))


def looked(drive, config, looks=LOOKS):
    """Return what each look at a growing leg gave, and the leg as sketched at the last."""
    whole, cells, so_far, found = drive.leg(), None, SmootherSoFar(), []
    for before, now in zip((-np.inf, *looks), looks, strict=False):
        cells = thinned(whole, now, before, cells)
        leg = cells.leg(whole.start_ns)
        running = so_far.look(leg, config)
        found.append(SimpleNamespace(running=running, once_s=so_far.once_s, leg=leg))
    return found


@pytest.fixture(scope='module')
def config():
    # an IMU without errors of scale and axes, as it is simulated
    return with_settings(Config(), {'imu.grade': 'industrial', 'method': 'smoother',
                                    'imu.accel_scale_sigma': 0.0, 'imu.misalignment_sigma': 0.0,
                                    'imu.gyro_by_force_sigma': 0.0})


@pytest.fixture(scope='module')
def drive():
    return drive_of()


@pytest.fixture(scope='module')
def looks(drive, config):
    return looked(drive, config)


def apart(one, other):
    """Return how far estimates lie apart in sigmas of the other, and the ratio of sigmas."""
    return [((one[n].value - other[n].value) / other[n].sigma, one[n].sigma / other[n].sigma)
            for n in NAMES]


def errors_in_sigmas(running, drive):
    true = (drive.truth.scale, drive.truth.yaw, drive.truth.pitch)
    return [(running.method.estimates[n].value - t) / running.method.estimates[n].sigma
            for n, t in zip(NAMES, true, strict=True)]


def test_it_ends_as_the_result_and_is_within_its_sigma_all_along(drive, config, looks):
    result = calibrate(drive.leg(), config).methods['smoother'].estimates
    for off, ratio in apart(looks[-1].running.method.estimates, result):
        assert abs(off) < 0.5
        assert 0.9 < ratio < 1.3       # a little is put on: noise levels from 150 s of driving
    for seen in looks:
        assert np.abs(errors_in_sigmas(seen.running, drive)).max() < 4    # 24: 1 in 700 by chance


def test_a_look_goes_on_from_the_last_and_comes_out_as_one_from_nothing(config, looks):
    passes = [x.running.method.details['iterations'] for x in looks]
    assert passes[0] > LOOK_PASSES
    # of 4, with driving, stops and turns in between; the others are cold starts
    assert passes.count(LOOK_PASSES) >= 2
    anew = SmootherSoFar().look(looks[-1].leg, config).method.estimates
    assert anew['scale_factor'].value != looks[-1].running.method.estimates['scale_factor'].value
    for off, ratio in apart(looks[-1].running.method.estimates, anew):
        # both stop within 0.1 sigma and levels within 10 % of where they would end
        assert abs(off) < 0.2
        assert ratio == pytest.approx(1.0, abs=0.1)


def test_what_is_decided_once_is_decided_anew_when_the_leg_has_grown_by_half(looks):
    # from the standstill 20 s before the mark on: 50 s, 80 s, 128 s, 192 s
    assert [x.once_s > 0 for x in looks] == [False, False, True, False, True, False, True, False]


def test_a_long_leg_is_looked_at_in_windows(drive, config, looks, monkeypatch):
    monkeypatch.setattr(growing, 'LONG_WINDOW', 70.0)
    monkeypatch.setattr(growing, 'NEXT_WINDOW', 100.0)
    thinned, so_far = looks[-1].leg, SmootherSoFar()
    for seen in looks:
        windowed = so_far.look(seen.leg, config)
    past, t_end = so_far._growing._past
    assert t_end == pytest.approx(60.0, abs=0.2)
    assert so_far._growing._last.state.t[0] == pytest.approx(t_end, abs=0.11)      # of a cell
    whole = looks[-1].running
    assert windowed.distance == pytest.approx(whole.distance, rel=0.01)
    assert windowed.agility == pytest.approx(whole.agility, rel=0.1)
    assert (windowed.sigmas < past.sigmas).all()
    for off, ratio in apart(windowed.method.estimates, whole.method.estimates):
        # the end of a window is the begin of the next, with states that it does not know
        assert abs(off) < 1.0
        assert 0.9 < ratio < 1.6
    assert np.abs(errors_in_sigmas(windowed, drive)).max() < 4
    # a window that cannot be fitted leaves the finished ones
    monkeypatch.setattr(growing, 'outcome', lambda *_: np.linalg.inv(np.zeros((2, 2))))
    assert so_far.look(thinned, config) is past


def test_a_fit_that_runs_away_is_told_and_the_next_look_begins_anew(config, looks, monkeypatch):
    so_far = SmootherSoFar()

    def wild(*_):
        return np.exp(np.full(3, 1e3))
    with monkeypatch.context() as broken, warnings.catch_warnings():
        warnings.simplefilter('error')       # a node has no place for warnings
        broken.setattr(growing, 'best_fit', wild)
        with pytest.raises(BadData, match='cannot solve the data so far: overflow'):
            so_far.look(looks[-1].leg, config)
    assert so_far.look(looks[-1].leg, config).method.estimates['scale_factor'].value is not None


def test_keyframes_stay_where_they_are(config, looks):
    so_far = SmootherSoFar()
    views = [so_far._view(x.leg, config) for x in looks[-2:]]
    first, second = (steps_of(view, 1.0) for view in views)
    times = [rows.t[rows.key] for rows in (first, second)]
    assert (times[1][:len(times[0]) - 2] == times[0][:-2]).all()
    assert np.diff(times[1])[1:-1] == pytest.approx(1.0, abs=0.11)     # cells are 0.1 s wide
    assert 0.45 < np.diff(times[1])[-1] < 1.6
    so_far.look(looks[-2].leg, config)
    going_on = carried(so_far._growing._last, problem_of(views[1], config, second))
    assert len(going_on.state.t) == len(going_on.spread) + 1 == len(times[1])
    other = problem_of(views[1], config, steps_of(views[1], 0.7))
    assert carried(so_far._growing._last, other) is None
    # a constant joins: the error by the stated sigma, which was constant
    stated = views[1].covariance_n * np.linspace(1.0, 2.0, len(views[1].t_fix))[:, None, None]
    other = problem_of(replace(views[1], covariance_n=stated), config, second)
    assert carried(so_far._growing._last, other) is None


def test_the_state_is_reckoned_on_to_where_the_vehicle_is(drive, config, looks):
    so_far = SmootherSoFar()
    so_far.look(looks[-3].leg, config)      # 7 s are to be reckoned on, at speed
    view = so_far._view(looks[-2].leg, config)
    state = carried(so_far._growing._last, problem_of(view, config, steps_of(view, 1.0))).state
    later = SmootherSoFar()
    later.look(looks[-2].leg, config)
    last = later._growing._last.state
    assert np.linalg.norm(last.v_n[-1]) > 5.0
    # a way of 70 m to a part in a thousand; the place itself was good to 1.5 m / sqrt(fixes)
    assert state.p_n[-1, :2] == pytest.approx(last.p_n[-1, :2], abs=0.5)
    assert state.v_n[-1, :2] == pytest.approx(last.v_n[-1, :2], abs=0.1)
    assert state.C_nb[-1] == pytest.approx(last.C_nb[-1], abs=2e-3)


def test_what_is_believed_of_the_accelerometer_is_carried_on_and_judged_anew(config):
    drive = drive_of(fix_noise='correlated')     # then metres come from the accelerometer
    graded = with_settings(config, {'imu.accel_scale_sigma': math.nan})
    first, later, last = (x.running for x in looked(drive, graded, (100.0, 112.0, 165.0)))
    # the same priors and a tenth more to see: by the way squared 1.2 times smaller at most
    assert 1 / 1.2 < later.sigmas[0] / first.sigmas[0] < 1.02
    assert later.method.details['posterior_to_prior']['accelerometer_scale_x'] < 1.0
    leg = looked(drive, graded, (165.0,))[0].running
    # both stop within 0.1 sigma, so the log odds z^2 / 2 of scale errors 1 to 2 sigmas off differ
    # by 0.2 at most, the mean square of both priors by a tenth; noise levels by another tenth
    assert last.sigmas[0] == pytest.approx(leg.sigmas[0], rel=0.15)
    blind = looked(drive, config, (165.0,))[0].running
    assert last.sigmas[0] > 1.5 * blind.sigmas[0]      # it does decide


def test_the_size_of_an_imperfection_is_carried_on(config):
    graded = with_settings(config, {'imu.accel_scale_sigma': math.nan})

    def size(running):
        return running.method.details['noise']['size_accelerometer_scale']

    offs, ratios = [], []
    for seed in range(3, 11):
        # as large as is usual
        drive = drive_of(accel_scale_error=3e-3, seed=seed, duration=130.0)
        first, later = looked(drive, graded, (40.0, 60.0))
        assert (first.once_s, later.once_s) == (0.0, 0.0)     # not grown by half: no cold start
        leg = SmootherSoFar().look(later.leg, graded)
        # two passes of a level that one fit settles: within a tenth of its own sigma of about 1
        assert size(later.running) == pytest.approx(size(leg), rel=0.1)
        (off, ratio), *_ = apart(later.running.method.estimates, leg.method.estimates)
        offs.append(off)
        ratios.append(ratio)
    # as of any look that goes on from the last; in 80 s the level of slow errors is good to a
    # factor of e in its variance, and still falls by a tenth a pass where a fit may end
    assert np.sqrt(np.mean(np.square(offs))) < 0.3
    assert np.sqrt(np.mean(np.square(np.log(ratios)))) < 0.15


@pytest.mark.parametrize('allowed', [0, 3])
def test_a_look_gives_up_between_passes_and_the_next_begins_anew(config, looks, allowed):
    so_far, asked = SmootherSoFar(), []

    def wanted():
        asked.append(True)
        return len(asked) <= allowed

    with pytest.raises(Abandoned):
        so_far.look(looks[0].leg, config, wanted)
    assert len(asked) == allowed + 1
    assert so_far.look(looks[0].leg, config).sigmas.shape == (3,)


def test_slow_errors_are_allowed_for_before_they_can_be_seen(config, looks):
    whites = with_settings(config, {'gnss.correlation_time': 0.0})

    def seen(leg, config):
        return SmootherSoFar().look(leg, config)

    drive = drive_of(fix_noise='correlated', seed=58)
    leg = looked(drive, config, (30.0,))[0].leg       # and the standstill
    slow, white = (e.method.estimates['scale_factor'] for e in (seen(leg, config),
                                                                seen(leg, whites)))
    assert abs(slow.value - drive.truth.scale) < 3 * slow.sigma
    assert abs(white.value - drive.truth.scale) > 5 * white.sigma
    # white fixes pay for the slow part that they might have: never with a smaller sigma
    assert (seen(looks[0].leg, config).sigmas >= 0.95 * seen(looks[0].leg, whites).sigmas).all()


def test_an_imu_that_faces_down_is_read_as_such(config, looks):
    leg = looks[1].leg
    down = np.array([1.0, -1.0, -1.0])
    over = replace(leg, imu=replace(leg.imu, w_i=leg.imu.w_i * down, f_i=leg.imu.f_i * down))
    both = [SmootherSoFar().look(one, config).method.estimates for one in (leg, over)]
    for off, ratio in apart(*both):
        assert (off, ratio) == (pytest.approx(0.0, abs=1e-3), pytest.approx(1.0, abs=1e-3))


@pytest.mark.parametrize(('changed', 'words'), [
    ({'fix': slice(0, 5)},
     '^5 fixes and [0-9.]+ s of data; the smoother needs at least 10 fixes and 20 s'),
    ({'imu': slice(0, 0)}, 'needs IMU'), ({'imu': slice(0, 2)}, 'needs IMU'),
    ({'odometer': slice(0, 1)}, 'and odometer')])
def test_too_little_is_said_and_no_look_is_lost_by_it(config, looks, changed, words):
    leg, so_far = looks[0].leg, SmootherSoFar()
    less = leg.with_rows(**{slot: take(leg.rows(slot), rows) for slot, rows in changed.items()})
    with pytest.raises(OdocalError, match=words):
        so_far.look(less, config)
    assert so_far.look(leg, config).distance > 50.0


# what is made foreseen

def forecast_at(seen, config, **settings):
    return forecast_of(seen.leg, 5.0, with_settings(config, settings), smoother=SmootherSoFar())


def test_the_sigma_that_counts_is_of_the_method_that_will_give(config, looks):
    found = forecast_at(looks[-1], config, method='auto')
    e = found.methods['smoother'].estimates
    assert found.estimates['scale_factor'] == replace(e['scale_factor'], method='smoother')
    assert found.scale.sigma == pytest.approx(e['scale_factor'].sigma / e['scale_factor'].value)
    assert found.yaw.sigma == pytest.approx(e['yaw_mounting_angle'].sigma)
    assert found.pitch == pytest.approx(e['pitch_mounting_angle'].sigma)
    assert (found.scale.metres, found.yaw.metres, found.complete) == (0.0, 0.0, True)
    assert found.until_ns == looks[-1].leg.stop_ns
    ends = forecast_at(looks[-1], config, method='two_point')
    assert ends.estimates == {}
    assert ends.scale.sigma > 3 * found.scale.sigma


def test_before_the_smoother_can_say_anything_the_end_points_are_foreseen(config, looks):
    class Silent:
        def look(self, *_):
            raise OdocalError('too little')

    leg = looks[0].leg
    assert look(leg, Config(), Silent(), lambda: True) is None
    assert forecast_of(leg, 5.0, Config(), smoother=Silent()).scale.sources[0][0] == 'fix_end'
    with pytest.raises(OdocalError, match='too little'):
        look(leg, with_settings(Config(), {'method': 'smoother'}), Silent(), lambda: True)


@pytest.mark.parametrize('method', ['smoother', 'auto'])
def test_what_the_leg_will_be_rejected_for_is_said_at_once(config, looks, method):
    leg = looks[-1].leg
    backwards = replace(leg, odometer=replace(leg.odometer, value=-leg.odometer.value))
    asked = with_settings(config, {'method': method})
    found = forecast_of(backwards, 5.0, asked, smoother=SmootherSoFar())
    fault = found.faults[0]
    assert (fault.code, fault.text[:41]) == (Code.ODOMETER_REVERSED,
                                             'odometer and IMU have opposite directions')
    assert found.estimates.get('scale_factor') is None      # no value that would be thrown away
    session = Session()
    session.start(1, asked)
    told = hint(SessionView(session, asked, forecast=found, faults=found.faults, distance_m=900.0,
                          max_speed=10.0))
    assert 'the leg would be rejected: ODOMETER_REVERSED' in told
    assert forecast_of(leg, 5.0, asked, smoother=SmootherSoFar()).faults == ()


def test_the_metres_and_the_stops_foreseen_are_about_those_it_takes(drive, config):
    white = with_settings(config, {'gnss.correlation_time': 0.0})
    early, late = (seen.running for seen in looked(drive, white, (95.0, 240.0)))
    assert late.distance > 1.6 * early.distance
    assert late.agility > 1.5 * early.agility
    # what was to be driven for the sigmas that came out, and what was driven
    before = Forecast(*(Prospect(None, float(sigma), None) for sigma in late.sigmas[:2]))
    found = with_running(before, early, config)
    # a law of one power stands for what starts, stops and turns make of it
    assert found.scale.metres == pytest.approx(late.distance - early.distance, rel=0.4)
    assert 'stop and start' in found.yaw.lack
    assert late.agility / early.agility == pytest.approx(
        (early.sigmas[1] / late.sigmas[1])**2, rel=0.5)


def of_sigmas(seen, scale=1e-4, yaw=1e-3, agility=120.0, known=True):
    """Return an forecast made of a running estimate with other figures."""
    method = seen.running.method
    found = dict(method.estimates)
    if not known:
        found['yaw_mounting_angle'] = Estimate(None, None, 'rad')
    running = replace(seen.running, method=replace(method, estimates=found), agility=agility,
                      sigmas=np.array([scale, yaw, 1e-3]), speed=10.0, distance=500.0)
    before = Forecast(Prospect(0.1, 1e-3, 500.0), Prospect(None, 0.01, None, (), 'not told'))
    return with_running(before, running, Config())


def test_the_yaw_asks_for_stops_and_starts_until_it_is_there(looks):
    # agility 120 by a sigma twice the asked: three times as much more, 30 for each stop and start
    found = of_sigmas(looks[-1], yaw=0.02)
    assert found.yaw.lack == 'for the yaw: stop and start 12 times, or make as many turns'
    assert found.yaw.metres == pytest.approx(1500.0)
    assert found.yaw.words('yaw', 'deg', math.degrees(1)).endswith(
        ' ± 1.15 deg so far (limit 0.573)')
    assert not found.complete
    assert of_sigmas(looks[-1], yaw=0.0105).yaw.lack.startswith('for the yaw: stop and start 1 ')
    assert of_sigmas(looks[-1], yaw=0.2).yaw.lack.startswith('for the yaw: stop and start often,')
    assert of_sigmas(looks[-1], yaw=0.2).yaw.metres is None
    never = of_sigmas(looks[-1], yaw=0.05, agility=0.0, known=False)
    assert never.yaw.words('yaw', 'deg', math.degrees(1)) == (
        'yaw is not determined yet (2.86 deg)')
    good = of_sigmas(looks[-1], yaw=0.009)
    assert (good.yaw.lack, good.yaw.metres, good.complete) == ('', 0.0, True)


def test_the_hint_tells_the_value_what_is_lacking_and_how_old_it_is(looks):
    session = Session()
    session.start(1, Config())
    known = {'distance_m': 300.0, 'max_speed': 10.0}
    far = of_sigmas(looks[-1], scale=2e-3, yaw=0.02)
    said = hint(SessionView(session, Config(), forecast=far, forecast_age_s=6.0, **known))
    # twice the asked sigma: 500 m more by white errors, 1500 m by slow ones, here some of both
    assert (' m/pulse ± 2000 ppm so far; drive 660 m more to reach the limit of 1000 ppm; yaw '
            in said)
    assert said.endswith('; for the yaw: stop and start 12 times, or make as many turns')
    told = hint(SessionView(session, Config(), forecast=far, forecast_age_s=40.0, **known))
    assert '; estimate is 40 s old; ' in told
    good = hint(SessionView(session, Config(), forecast=of_sigmas(looks[-1]), **known))
    assert good.startswith('OK: scale 0.02')
    assert good.endswith('stand still 10 s at the end point, then call ~/stop_leg')


def test_the_keys_hold_values_and_sigmas(looks):
    found = of_sigmas(looks[-1])
    found = replace(found, estimates={
        'scale_factor': Estimate(0.02, 1e-5, 'm/pulse', 'smoother'),
        'yaw_mounting_angle': Estimate(0.01, 1e-3, 'rad', 'two_point'),
        'pitch_mounting_angle': Estimate(None, None, 'rad', 'smoother')})
    keys = as_keys(found, 7.5)
    assert [keys[f'estimate_{name}'] for name in (
        'scale_factor', 'scale_factor_sigma', 'yaw_mounting_angle_rad',
        'yaw_mounting_angle_sigma_rad', 'method', 'age_s')] == [
            0.02, 1e-5, 0.01, 1e-3, 'smoother, two_point', 7.5]
    assert math.isnan(keys['estimate_pitch_mounting_angle_rad'])
    assert math.isnan(keys['estimate_pitch_mounting_angle_sigma_rad'])


@pytest.mark.parametrize(('yaw', 'turn_rates', 'why'), [
    (math.pi / 2, 1.0, 'accelerations point to the right'),
    (0.0, 0.0, 'all turn rates are zero')])
def test_an_imu_that_no_leg_can_use_is_told_at_once(config, yaw, turn_rates, why):
    drive = drive_of(yaw=yaw)
    leg = drive.leg()
    leg = replace(leg, imu=replace(leg.imu, w_i=turn_rates * leg.imu.w_i))
    with pytest.raises(OdocalError, match=why):
        SmootherSoFar().look(leg, config)
