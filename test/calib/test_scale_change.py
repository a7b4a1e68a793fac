# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs continued without their rows, and a scale that changes between two legs."""

from dataclasses import replace
import json

from legs_to_combine import largest_deviation, leg_result, moved, NO_SCATTER, STEPS, Toy
import numpy as np
import pytest
from smoother_legs import made, smoothed

from odocal_ros.calib.joint import fit_jointly, scale_steps
from odocal_ros.calib.marginal_information import read_carried
from odocal_ros.errors import BadUsage
from odocal_ros.estimator import several, smooth
from odocal_ros.output.files import as_json
from odocal_ros.output.stored import known_imu
from odocal_ros.pipeline.automatic import add_to_carried
from odocal_ros.pipeline.combination import combine
from odocal_ros.reasons import Code, Verdict
from odocal_ros.settings.config import with_settings
from odocal_ros.settings.levels import REMARK_SIGMAS
from odocal_ros.sim.real_effects import RealEffects

pytestmark = pytest.mark.slow
SCALE, YAW = 'scale_factor', 'yaw_mounting_angle'
ACCEL = (3e-3, 0.0, 0.0, 0.0, -2e-3, 0.0, 0.0, 0.0, 0.0)      # scale errors of x and y


@pytest.mark.parametrize('first', [1, 2, 4])
def test_continued_legs_equal_one_fit_with_the_later_legs(first):
    marginals = Toy(np.random.default_rng(5)).marginals()
    whole = fit_jointly(marginals, STEPS, 'k')
    before = fit_jointly(marginals[:first], STEPS[:first - 1], 'k').information
    found = fit_jointly([before, *marginals[first:]], STEPS[first - 1:], 'k')
    assert largest_deviation(found.value, whole.value, whole.covariance) < 1e-6
    sigma = np.sqrt(np.diag(whole.covariance))
    assert np.abs((found.covariance - whole.covariance) / np.outer(sigma, sigma)).max() < 1e-6


def test_random_walk_is_rarely_a_change_and_a_change_is_found():
    rng = np.random.default_rng(6)
    toy = Toy(rng, states=6, rows=60)
    alarms = sum(len(scale_steps(toy.walk(rng).marginals(), STEPS, 'k')) for _ in range(500))
    # three legs of five can be compared with others: one in 370 of 1500 is 4
    assert 0 < alarms <= 12
    rng = np.random.default_rng(7)
    toy = Toy(rng, states=6, rows=60)
    for _ in range(20):
        (found,) = scale_steps(toy.walk(rng, change=-0.9).marginals(), STEPS, 'k')
        assert found.leg == 3
        assert found.change == pytest.approx(-0.9, abs=4 * 0.06)     # walk and noise of the legs
        assert found.sigmas < -REMARK_SIGMAS


@pytest.fixture(scope='module')
def session():
    """Return settings and the legs of a short drive and of the same vehicle on other days."""
    short = {'duration': 200.0, 'imu_grade': 'industrial'}
    results = [smoothed(**short, seed=seed)[1] for seed in (1, 2, 3)]
    return with_settings(made(**short, seed=3)[1], {
        'method': 'smoother', 'leg.automatic': True}), results


def legs_of(results, change=0.0, since=2):
    """Return legs of results, with the scale of the later legs changed."""
    out = []
    for i, one in enumerate(results, 1):
        if i > since:
            scale = one.estimates[SCALE]
            one = moved(replace(one, estimates=one.estimates | {SCALE: replace(
                scale, value=scale.value * (1 + change))}), SCALE, np.log1p(change))
        out.append(leg_result(one, i))
    return out


def compare(found, whole, share):
    for name in (SCALE, YAW):
        a, b = found.estimates[name], whole.estimates[name]
        assert a.value == pytest.approx(b.value, abs=share * b.sigma), name
        assert a.sigma == pytest.approx(b.sigma, rel=share), name


def changed(calibration):
    return [r.text for r in calibration.reasons if r.code is Code.SCALE_CHANGED]


def test_pressure_loss_of_a_tyre_is_reported_and_the_scale_follows(session):
    config, results = session
    before = combine(legs_of(results), config)
    assert changed(before) == []
    after = combine(legs_of(results, -0.009), config)
    (text,) = changed(after)
    assert text.startswith('the scale changed by -0.')
    assert float(text.split()[4]) == pytest.approx(-0.9, abs=0.02)      # sigma of one leg
    assert 'since 1970-01-01 00:33 UTC, seen in leg 3: tyre pressure, wear, load' in text
    assert after.verdict is Verdict.CAUTION
    e, old = after.estimates[SCALE], before.estimates[SCALE]
    alone = legs_of(results, -0.009)[2].methods['smoother'].estimates[SCALE]
    assert abs(e.value - alone.value) < alone.sigma
    assert e.value < 0.995 * old.value
    # a tyre does not affect the yaw: the sigma is as before
    assert after.estimates[YAW].sigma == pytest.approx(before.estimates[YAW].sigma, rel=0.05)
    # without leg.automatic, a leg that differs widens the sigma instead
    off = with_settings(config, {'leg.automatic': False})
    plain = combine(legs_of(results, -0.009), off)
    assert changed(plain) == []
    assert 'carried' not in as_json(plain, off, [], 'now')
    assert Code.LEGS_DISAGREE in {r.code for r in plain.reasons}


def test_combination_continues_from_a_result_on_disk(session, monkeypatch):
    monkeypatch.setattr(several, 'SCATTER', NO_SCATTER)
    config, results = session
    legs = legs_of(results)
    whole = combine(legs, config)
    two = combine(legs[:2], config)
    written = json.loads(json.dumps(as_json(two, config, [], 'now'), allow_nan=False))
    carried = read_carried(written['carried'])
    assert (carried.legs, carried.first_ns, carried.last_ns) == (
        2, legs[0].start_ns, legs[1].start_ns)
    for before in (carried, add_to_carried(legs[:2], config)):
        found = combine(legs[2:], config, before)
        compare(found, whole, 1e-3)
        assert found.carried.legs == 3
    rejected = leg_result(results[0], 0, Code.IMU_GAP)       # a rejected leg adds nothing
    assert add_to_carried([rejected], config, carried) is carried
    assert found.carried.includes(carried)
    assert not carried.includes(found.carried)
    (text,) = changed(combine(legs_of(results, 0.02)[2:], config, carried))
    assert text.startswith('the scale changed by +')
    assert float(text.split()[4]) == pytest.approx(2.0, abs=0.1)
    assert 'seen in leg 1' in text
    # a clock set back or another kind of odometer: results are not combined
    for other in (replace(carried, last_ns=10**18), replace(carried, unit='1')):
        alone = combine(legs[2:], config, other)
        assert alone.estimates[SCALE].value == results[2].estimates[SCALE].value


def imu_of(legs, config, folder):
    """Return settings with the IMU constants of a calibration of these legs, and the IMU."""
    path = folder / 'calibration.json'
    path.write_text(json.dumps(as_json(combine(legs, config), config, [], 'now')))
    with_imu = with_settings(config, {'imu.constants': str(path)})
    return with_imu, known_imu(with_imu)


def test_imu_known_from_rtk_determines_the_scale_with_correlated_fixes(tmp_path):
    results = []
    for seed, noise in ((1, 'rtk'), (2, 'correlated')):
        drive, config, leg = made(duration=200.0, imu_grade='industrial', seed=seed,
                                  fix_noise=noise, real=RealEffects(accel_matrix=ACCEL))
        config = with_settings(config, {'imu.accel_scale_sigma': np.nan, 'method': 'smoother',
                                        'vehicle': 'van'})
        results.append(smooth(leg, config))
    legs = legs_of(results)
    _, imu = imu_of(legs[:1], config, tmp_path)
    alone, found, whole = (combine(some, config, imu=of).estimates[SCALE] for some, of in (
        (legs[1:], None), (legs[1:], imu), (legs, None)))
    # no scale is transferred: less information than both legs, but much more than one leg
    assert 3 * whole.sigma < found.sigma < 0.4 * alone.sigma
    for e in (alone, found):
        assert abs(e.value - drive.truth.scale) < 3 * e.sigma


def test_imu_belongs_to_one_vehicle_and_no_leg_counts_twice(session, tmp_path):
    config, results = session
    config = with_settings(config, {'leg.automatic': False, 'vehicle': 'van'})
    legs = legs_of(results)
    with_imu, imu = imu_of(legs[:2], config, tmp_path)
    assert {name.split('_')[0] for name in imu.marginal.names} == {'gyro', 'accelerometer'}
    # a leg that it includes does not count twice; an IMU of another vehicle is rejected
    assert combine(legs[1:2], config, imu=imu).estimates[YAW].sigma == results[
        1].estimates[YAW].sigma
    for other in ({'vehicle': 'lorry'}, {'imu.mounting_rpy': (0.0, 0.0, 1.5)}):
        with pytest.raises(BadUsage, match=f'has another {list(other)[0]}'):
            known_imu(with_settings(with_imu, other))


def test_scatter_information_of_combined_legs_is_continued(session):
    """One leg changes the scatter known from three legs by half, and other sigmas by 10 %."""
    config, results = session
    legs = legs_of(results)
    whole = combine(legs, config)
    found = combine(legs[2:], config, read_carried(json.loads(json.dumps(
        add_to_carried(legs[:2], config).as_dict()))))
    compare(found, whole, 0.1)
    evidence = found.carried.marginal.scatter_likelihood
    assert set(evidence) == {'scale_factor', 'yaw_mounting_angle', 'pitch_mounting_angle'}
