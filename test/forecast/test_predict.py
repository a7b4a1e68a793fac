# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Predicted sigmas against closed forms, the pipeline and changed drives."""

import math

from drives import planned
import numpy as np
import pytest

from odocal_ros.errors import BadConfig, BadUsage
from odocal_ros.forecast.leg_so_far import drive_profile
from odocal_ros.forecast.planned_drive import drive_from_rates, PlannedDrive
from odocal_ros.forecast.predict import find_remaining_distance, predict, Sigmas
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import motion_of, resolve, SimOptions, simulate
from odocal_ros.sim.truth import operator_settings

pytestmark = pytest.mark.slow
SCALE, YAW, PITCH = 'scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle'
HEADING = math.radians(0.06)
DEG = math.degrees(1.0)


def config(**changes):
    names = {'grade': 'imu.grade', 'correlation': 'gnss.correlation_time'}
    base = {'method': 'two_point', 'imu.grade': 'navigation', 'gnss.correlation_time': 0.0,
            'alignment.heading_source': 'fixed', 'alignment.heading_sigma': HEADING}
    return with_settings(Config(), base | {names.get(k, k.replace('__', '.')): v
                                           for k, v in changes.items()})


def paper_drive(rest=30.0):
    """Return the paper leg: 300 s still, 0.5 m/s2 for 40 s, 20 m/s for 520 s, down in 40 s."""
    t = np.arange(0.0, 900.0 + rest + 0.05, 0.1)
    return drive_from_rates(t, np.interp(t, [300, 340, 860, 900], [0, 20, 20, 0]),
                            np.zeros_like(t))


def row(prediction, source):
    return prediction.method.details['budget'][source]


def test_white_end_fixes_give_root_two_sigma_over_the_chord():
    drive = paper_drive(rest=300.0)
    result = predict(drive, Sigmas(config=config(), fix=2.0, fix_rate=4.0))
    # 1200 fixes at each mark, one more or less where the span is cut
    expected = math.sqrt(2) * 2.0 / math.sqrt(1200) / 11_200
    assert result.distance == pytest.approx(11_200, rel=1e-9)
    # 1/2400 from the count; the other sources (height 0.03, second order 0.01 ppm) are nothing
    assert result.sigma(SCALE) == pytest.approx(expected, rel=1e-3)
    for source in ('fix_start', 'fix_end'):
        assert row(result, source)[YAW] == pytest.approx(expected / math.sqrt(2), rel=1e-3)


def test_correlated_fixes_give_the_sigma_of_a_gauss_markov_mean():
    result = predict(paper_drive(), Sigmas(config=config(correlation=60.0), fix=2.0))
    for source, rest in (('fix_start', 300.0), ('fix_end', 30.0)):
        x = rest / 60.0
        left = 2 * (x - 1 + math.exp(-x)) / x**2        # mean over T of exp(-dt / tau)
        # 150 and more samples of the double integral: its sum errs by less than 1 %
        assert row(result, source)[SCALE] == pytest.approx(
            2.0 * math.sqrt(left) / 11_200, rel=0.01)


def test_effect_of_a_vertical_gyro_bias_is_that_of_the_mean_travel_time():
    result = predict(paper_drive(), Sigmas(config=config()))
    # the trapezoid of speed is symmetric: the mean time of its travel is 300 s after the start
    sigma = result.alignment.gyro_bias_sigma[2]
    assert row(result, 'gyro_bias_z')[YAW] == pytest.approx(sigma * 300.0, rel=1e-6)
    # 0.01 deg/h times 300 s: 8.33e-4 deg
    assert math.radians(0.01) / 3600 / sigma * row(result, 'gyro_bias_z')[YAW] * DEG == \
        pytest.approx(8.33e-4, abs=0.005e-4)
    assert row(result, 'gyro_bias_x')[YAW] < 1e-9 * sigma * 300.0


@pytest.mark.parametrize('scenario', ['paper', 'straight', 'town'])
@pytest.mark.parametrize('source', ['fixed', 'gyrocompass'])
def test_the_prediction_is_the_sigma_of_the_result(scenario, source):
    grade = 'navigation' if source == 'gyrocompass' else 'tactical'
    options = resolve(SimOptions(scenario=scenario, imu_grade=grade, imu_rate=20.0,
                                  odometer_rate=20.0, fix_rate=4.0, seed=5, pitch=0.0))
    drive = simulate(options)
    groups = operator_settings(drive, HEADING if source == 'fixed' else None)
    settled = with_settings(Config(), {
        f'{group}.{name}': value for group, values in groups.items()
        for name, value in values.items()} | {
        'method': 'two_point', 'gnss.correlation_time': 0.0,
        'alignment.heading_source': source})
    result = calibrate(drive.leg(), settled).methods['two_point']
    predicted = predict(planned(motion_of(options), options),
                        Sigmas(config=settled, fix_rate=4.0, quantum=options.scale))
    scale = result.estimates[SCALE]
    # a standstill is found up to 0.5 s short at each moving end: 20 s (town) give 2.5 % fewer
    # fixes and 1.3 % more sigma; the gyro noise measured at rest (300 values) has a sigma of 4 %,
    # the largest of three axes 4 % more, but is a quarter of the variance at most
    assert predicted.sigma(SCALE) == pytest.approx(scale.sigma / scale.value, rel=0.03)
    for name in (YAW, PITCH):
        assert predicted.sigma(name) == pytest.approx(result.estimates[name].sigma, rel=0.03)
    assert set(predicted.method.details['budget']) == set(result.details['budget'])


def test_remaining_distance_is_sufficient_and_not_too_long():
    drive, sigmas = paper_drive(), Sigmas(config=config(correlation=60.0))
    required = predict(drive, sigmas).sigma(SCALE) / 1.5
    metres = find_remaining_distance(drive, sigmas, SCALE, required)
    assert predict(drive.lengthen(metres), sigmas).sigma(SCALE) <= required
    assert predict(drive.lengthen(0.97 * metres), sigmas).sigma(SCALE) > required
    # only fixes contribute: the sigma is inversely proportional to the path length
    assert metres == pytest.approx(0.5 * 11_200, rel=0.03)
    assert find_remaining_distance(drive, sigmas, SCALE, 1.0) == 0.0
    assert find_remaining_distance(drive, sigmas, YAW, 0.9 * HEADING) is None


def test_a_drive_that_the_method_cannot_use_has_the_reasons():
    t = np.arange(0.0, 200.1, 0.1)
    speed = np.interp(t, [20, 30, 170, 180], [0, 10, 10, 0])
    around = drive_from_rates(t, speed, np.where((t > 96) & (t < 104), math.pi / 8, 0.0))
    result = predict(around, Sigmas(config=config()))
    assert Code.CHORD_TOO_SHORT in {r.code for r in result.reasons}
    assert result.sigma(SCALE) is None
    no_heading = predict(paper_drive(), Sigmas(config=Config()))
    assert Code.YAW_NOT_SEPARABLE in {r.code for r in no_heading.reasons}
    assert no_heading.sigma(YAW) is None
    assert no_heading.sigma(SCALE) > 0
    moving = drive_from_rates(t, np.full_like(t, 10.0), np.zeros_like(t))
    result = predict(moving, Sigmas(config=config()))
    assert Code.NO_STANDSTILL in {r.code for r in result.reasons}
    # the same speed at start and end: the latency cancels, with fixes of a second on each side
    assert result.rests == (0.0, 0.0)


@pytest.mark.parametrize(('change', 'words'), [
    ({'fix': 0.0}, 'fix sigma 0'), ({'fix': -1.0}, 'fix sigma -1'),
    ({'fix': math.nan}, 'fix sigma nan'), ({'fix_up': 0.0}, 'height sigma of the fixes 0'),
    ({'fix_rate': 0.0}, 'fix rate 0'), ({'quantum': -0.1}, 'size of a count -0.1'),
    ({'config': config(alignment__heading_sigma=0.0)}, 'heading sigma 0')])
def test_impossible_sigmas_are_refused(change, words):
    with pytest.raises(BadConfig, match=words):
        Sigmas(**change)


def test_impossible_drives_are_refused():
    t = np.arange(0.0, 100.0, 0.1)
    with pytest.raises(BadUsage, match='never moves'):
        drive_from_rates(t, np.zeros_like(t), np.zeros_like(t))
    with pytest.raises(BadUsage, match='not finite'):
        PlannedDrive(t, np.full_like(t, np.nan), t, t)
    with pytest.raises(BadUsage, match='increasing times'):
        PlannedDrive(t[::-1], t, t, t)
    with pytest.raises(BadUsage, match='one speed, yaw and slope for each time'):
        PlannedDrive(t, t[1:], t, t)
    short = drive_from_rates(t[:11], np.full(11, 5.0), np.zeros(11))
    with pytest.raises(BadUsage, match='less than one fix interval'):
        predict(short, Sigmas(config=config(), fix_rate=0.5))


def test_each_change_of_a_drive_changes_only_what_it_states():
    drive = paper_drive()
    longer = drive.lengthen(1000.0)
    assert longer.distance == pytest.approx(12_200, rel=1e-9)
    assert longer.duration - drive.duration == pytest.approx(50.0)
    rested = drive.lengthen_rests(60.0)
    assert rested.distance == pytest.approx(drive.distance, rel=1e-9)
    before, after = (predict(d, Sigmas(config=config())).rests for d in (drive, rested))
    assert np.subtract(after, before) == pytest.approx([60.0, 60.0], abs=1e-6)
    other = predict(drive.turn_around(), Sigmas(config=config()))
    assert other.sigma(SCALE) == pytest.approx(
        predict(drive, Sigmas(config=config())).sigma(SCALE), rel=1e-3)
    half = drive.cut_at(300.0, 20.0)
    assert half.distance == pytest.approx(20 * 300 - 400, rel=1e-2)
    assert predict(half, Sigmas(config=config())).rests[1] == pytest.approx(20.0, abs=0.2)


def test_yaw_of_a_recorded_leg_is_corrected_for_the_gyro_bias_at_rest():
    drive = simulate(SimOptions(scenario='town', imu_grade='consumer', imu_rate=50.0, seed=4))
    assert abs(drive.truth.gyro_bias[2]) * 500.0 > 0.1         # rad: there is a bias to subtract
    leg = drive.leg()
    config = with_settings(Config(), {'imu.grade': 'consumer'})
    profile = drive_profile(screen(leg, config)[0], config)
    t = (leg.start_ns - drive.options.start_ns) * 1e-9 + profile.t
    true = drive.motion.at(t).yaw
    turned, truly = profile.yaw - profile.yaw[0], true - true[0]
    # noise over 20 s at rest leaves 2e-5 rad/s of the bias, 0.012 rad in ten minutes; five of that
    np.testing.assert_allclose(turned, truly, atol=0.06)
    # and the first course by fixes of 1.5 m over kilometres: 1 mrad, and the error of the bias
    off = np.median(profile.yaw - true)
    assert abs((off + math.pi) % (2 * math.pi) - math.pi) < 0.06
