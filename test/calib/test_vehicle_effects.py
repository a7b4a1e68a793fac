# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Effects of the vehicle and of its receiver are found, and the values are within their sigmas."""

from dataclasses import replace
import re
from types import SimpleNamespace

from drives import off, settings
import numpy as np
import pytest
from smoother_legs import leg_of, made, reason_texts

from odocal_ros.estimator import smooth
from odocal_ros.estimator.level_steps import long_span_factors
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.state import CONSTANTS, FIX_ERROR_BY_SIGMA, HEIGHT_DRIFT
from odocal_ros.nav.time_series import running_integral
from odocal_ros.reasons import Code
from odocal_ros.settings.nominal import G
from odocal_ros.sim.noise import gauss_markov
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.scenarios import simulate
from odocal_ros.sim.wheels import steered_path

pytestmark = pytest.mark.slow
TOWN = {'scenario': 'town', 'duration': 250.0, 'imu_grade': 'industrial', 'sway': 0.05}
AHEAD = 6.0      # m
RTK = TOWN | {'fix_noise': 'rtk', 'fix_sigma': 0.01}


def test_scale_that_decreases_with_speed_is_not_attributed_to_tyres():
    _, config, leg = made(scenario='town', duration=300.0, imu_grade='industrial', seed=4,
                          fix_noise='rtk', real=RealEffects(speed_law=-0.006))
    falls = next(r for r in smooth(leg, config).reasons if r.code is Code.SCALE_VARIES)
    assert re.search('changes by -.* from low to high speed', falls.text)
    assert falls.remedy.startswith('Possible causes: truncated speed values')


@pytest.mark.parametrize('driven', [True, False])
def test_tyre_slip_in_one_direction_keeps_the_mean_scale_correct(driven):
    """A wheel without drive slips only in braking: half a slope per direction is 90 ppm."""
    drive, config, leg = made(**TOWN | {
        'fix_noise': 'rtk', 'fix_sigma': 0.01,
        'real': RealEffects(tyre_slip=0.035, driven=driven)})
    method = smooth(leg, config)
    assert off(method, drive) < 3.3
    assert method.estimates['scale_factor'].sigma / drive.truth.scale < 60e-6
    assert Code.WHEEL_SLIP not in {r.code for r in method.reasons}


def test_brakes_pitch_the_body_with_a_slope_of_their_own():
    """A body that dives by 1.8 deg/g and squats by 0.8: one slope moves the pitch by 1.5 sigma."""
    dive, squat = 0.018 / G, 0.014 / G      # rad per m/s^2, the first in addition
    drive, config, leg = made(**TOWN | {'duration': 400.0, 'fix_noise': 'rtk', 'fix_sigma': 0.01,
                                        'imu_grade': 'tactical', 'real': RealEffects(
                                            squat=squat, brake_dive=dive)})
    found = smooth(leg, config)
    assert off(found, drive, 'pitch_mounting_angle') < 3.0
    for name, true in (('squat', squat), ('dive', squat + dive)):
        value = found.details[name]
        assert abs(value['value'] + true) < 3.0 * value['sigma'] < dive / 2


def rolled_differently(leg, drive, additional):
    """Return the leg with additional travel, m, a function of the motion, and its share."""
    since = (drive.truth.start_ns - drive.options.start_ns) * 1e-9
    travel, scale = leg.travel, drive.truth.scale
    more = additional(drive.motion.at(since + travel.t)) / scale
    within = (travel.t >= leg.t_begin) & (travel.t <= leg.t_stop)
    rolled, size = (np.abs(np.diff(x[within])).sum() for x in (travel.s, more))
    return replace(leg, travel=replace(travel, s=travel.s + more)), size / rolled


@pytest.mark.parametrize('seed', [4, 5])
def test_turns_load_or_unload_a_wheel(seed):
    """The tyre of an odometer on one wheel is larger in turns to its own side."""
    drive, config, leg = made(**RTK | {'seed': seed})
    by_force = 1e-3     # per m/s^2

    def additional(state):
        return -by_force * running_integral(state.t, state.speed**2 * state.yaw_rate)

    loaded, share = rolled_differently(leg, drive, additional)
    found = smooth(loaded, config)
    assert share > 1e-4
    assert off(found, drive) < 3.0
    assert found.estimates['scale_factor'].sigma < 1.1 * smooth(
        leg, config).estimates['scale_factor'].sigma
    slope = found.details['beside']['scale_by_left_force']
    assert abs(slope['slope'] - by_force) < 3.0 * slope['sigma'] < by_force
    assert 'from right to left turns' in reason_texts(found)[Code.SCALE_VARIES]
    assert Code.WHEEL_SLIP not in reason_texts(found)


@pytest.mark.parametrize(('share', 'seed'), [(1.0, 4), (0.5, 5)])
def test_wheels_that_steer_travel_farther_in_turns(share, seed):
    """Front wheels of a bus, 6 m ahead, and the mean of all four."""
    drive, config, leg = made(**RTK | {'seed': seed})
    steered, more = rolled_differently(leg, drive, lambda state: share * steered_path(
        state, (AHEAD, 0.0, 0.0)))
    found = smooth(steered, config)
    assert more > 1e-4
    assert off(found, drive) < 3.0
    assert found.estimates['scale_factor'].sigma < 0.3 * more * drive.truth.scale
    slope = found.details['beside']['scale_by_curvature']
    assert abs(slope['slope'] + share * AHEAD**2) < 3.0 * slope['sigma'] < 0.3 * share * AHEAD**2
    assert 'to the tightest turn' in reason_texts(found)[Code.SCALE_VARIES]
    assert Code.WHEEL_SLIP not in reason_texts(found)


# quadratic sums and expectations of levels that agree with the rows
AS_IT_IS = dict.fromkeys(('fix', 'fix_up', 'slow', 'slow_up'), (1.0, 1.0))
DRIVE = {'scenario': 'town', 'duration': 400.0, 'imu_grade': 'industrial', 'fix_noise': 'rtk'}
FAST = 1e-4         # relative
STATED, CHANGE = 1.0, 1.5           # m: stated sigma of heights, and change of their error
START, WHITE, TIME = 1.2, 0.02, 300.0       # m, m, s
IN_SIGMAS = np.array([0.8, -1.2, 0.5])      # east, north, up


def received(**real):
    """Return details and reasons of a drive; asserts that the scale is within its sigma."""
    drive, config, leg = made(**DRIVE, seed=4, real=RealEffects(**real))
    found = smooth(leg, config)
    assert off(found, drive) < 3
    return found.details, reason_texts(found)


@pytest.mark.parametrize('share', [0.02, -0.003])
def test_odometer_in_the_receiver_is_distinguished_from_the_vehicle_odometer(share):
    details, texts = received(receiver_odometer=share)
    seen, time = (details[name] for name in ('fix_error_by_motion', 'fix_motion_time'))
    assert abs(seen['value'] - share) < 3 * seen['sigma'] < 0.3 * abs(share)
    assert abs(time['value'] - np.log(20.0)) < 3 * time['sigma']
    assert f'{100 * seen["value"]:+.2f} %' in texts[Code.FIXES_FOLLOW_ODOMETER]


def test_filter_of_position_and_velocity_is_reported_if_there_is_one():
    _, texts = received(receiver_tracking=0.8)
    text = texts[Code.FIXES_SMOOTHED]
    assert 'positions and velocities' in text
    assert float(re.search(r'about (.*) s;', text)[1]) == pytest.approx(0.8, rel=0.02)
    _, texts = received()
    assert not {Code.FIXES_FOLLOW_ODOMETER, Code.FIXES_SMOOTHED, Code.CLOCKS_DRIFT} & texts.keys()


def test_odometer_in_the_receiver_is_found_with_a_consumer_accelerometer():
    """In a short yard drive, an accelerometer error of the same size also explains the speeds."""
    drive = simulate(SimOptions(scenario='yard', duration=300.0, seed=5,
                                imu_grade='consumer', real=RealEffects(receiver_odometer=0.05)))
    config = settings(drive, None)
    found = smooth(leg_of(drive.leg(), config), config)
    assert off(found, drive) < 3
    assert Code.FIXES_FOLLOW_ODOMETER in reason_texts(found)


def fixes_of(error, t):
    """Return fixes every second as long_span_factors uses them: errors (m, 3), sigma 1 m."""
    return SimpleNamespace(
        k=np.arange(len(t)), state=SimpleNamespace(t=t), errors=lambda: error,
        points=SimpleNamespace(tau=np.zeros(len(t))),
        whitening=np.tile(np.eye(3), (len(t), 1, 1)))


def test_errors_that_fit_the_model_are_not_widened():
    t, sigma, time, white = np.arange(0.0, 900.0), 1.5, 60.0, 0.3
    gain = 2 * sigma**2 / time
    levels = Levels({'slow': gain, 'slow_up': gain, 'fix': white**2, 'fix_up': white**2,
                     'correlation_time': time})
    high = levels.replaced(slow=4 * gain, slow_up=4 * gain)
    steps = AS_IT_IS | {'slow': (0.25, 1.0), 'slow_up': (0.25, 1.0)}
    factors = []
    for seed in range(40):
        rng = np.random.default_rng(seed)
        error = gauss_markov(rng, sigma, time, t) + white * rng.standard_normal((len(t), 3))
        found = long_span_factors(fixes_of(error, t), levels, AS_IT_IS)
        factors += found.values()
        # a level four times too high, consistent with its own steps, does not change the factors
        again = long_span_factors(fixes_of(error, t), high, steps)
        assert again == pytest.approx(found)
    # one span in six is a sigma too large by chance, the longest, of 8 differences, by half of it;
    # in 1 of 1000 their mean square is 3.3 times too large; a factor of 1.5 is tolerated
    assert max(factors) < 3.3 / 1.5
    assert np.mean(factors) < 1 + 0.5 / 6


def test_errors_with_a_persistent_rate_grow_faster_than_their_steps():
    t, seconds, factors = np.arange(0.0, 900.0), 20, []
    levels = Levels({'slow': 1 / seconds, 'slow_up': 1 / seconds, 'fix': 1e-6, 'fix_up': 1e-6,
                     'correlation_time': 1e4})
    for seed in range(3, 11):
        steps = np.random.default_rng(seed).standard_normal((len(t) + seconds, 3))
        # mean of a random walk over 20 s: steps of 1 / sqrt(20), the same growth over long spans
        error = np.stack([np.convolve(x, np.full(seconds, 1 / seconds), 'valid')
                          for x in np.cumsum(steps, axis=0).T], -1)[:len(t)]
        factors += long_span_factors(fixes_of(error, t), levels, AS_IT_IS).values()
    assert seconds / 3 < min(factors) < max(factors) < 1.5 * seconds
    # 20, minus the effect of chance at spans of 50 s or more: a quarter or more
    assert np.mean(factors) > 0.6 * seconds


@pytest.mark.parametrize('name', ['fix', 'odometer'])
def test_clock_rate_is_reported_and_the_scale_is_that_of_the_wheel(name):
    drive, config, leg = made(scenario='town', fix_noise='rtk', fix_sigma=0.01,
                              duration=300.0, real=RealEffects(**{f'{name}_clock_rate': FAST}))
    result = smooth(replace(leg, t_begin=60.0, t_stop=240.0), config)
    scale, texts = result.estimates['scale_factor'], reason_texts(result)
    assert off(result, drive) < 3
    assert scale.sigma / scale.value < FAST / 3     # an error of FAST exceeds the sigma
    text = texts[Code.CLOCKS_DRIFT]
    ppm = int(text.split('clock is ')[1].split(' ppm')[0])
    sigma = int(text.split('(± ')[1].split(')')[0])
    assert text.startswith(f'{name} stamps')
    assert 'fast' in text
    assert abs(ppm - 1e6 * FAST) <= 3 * sigma + 1    # rounded to whole ppm
    assert not {Code.WHEEL_SLIP, Code.SCALE_VARIES, Code.FIXES_NOISIER_THAN_SAID} & set(texts)


def test_height_drift_is_found_and_the_pitch_is_within_its_sigma():
    drive, config, leg = made(scenario='town', duration=500.0, fix_noise='white', fix_sigma=0.05)
    covariance, fixes = leg.covariance_n.copy(), leg.fixes_n.copy()
    covariance[:, 2, 2] = STATED**2
    fixes[:, 2] += CHANGE * leg.t_fix / leg.t_fix[-1]
    result = smooth(replace(leg, fixes_n=fixes, covariance_n=covariance), config)
    found = result.details[CONSTANTS[HEIGHT_DRIFT]]
    assert abs(found['value'] - CHANGE / leg.t_fix[-1]) < 3 * found['sigma']
    assert off(result, drive, 'pitch_mounting_angle') < 3
    sigma = result.estimates['pitch_mounting_angle'].sigma
    assert sigma < CHANGE / drive.truth.distance / 2        # drift taken as pitch would exceed it


@pytest.mark.parametrize(('unit', 'implausible'), [(1.0, False), (1 / 0.3048, False),
                                                   (100.0, True)])
def test_implausible_heights_are_a_caution_with_the_cause(unit, implausible):
    """Heights in cm give slopes of 1 %; heights in feet change the scale by 20 ppm."""
    _, config, leg = made(scenario='town', duration=300.0, imu_grade='industrial',
                          fix_noise='rtk', slope=0.01, seed=5)
    found = smooth(replace(leg, fixes_n=leg.fixes_n * [1.0, 1.0, unit]), config)
    reasons = [r for r in found.reasons if r.code is Code.MODEL_MISMATCH]
    assert len(reasons) == implausible
    for reason in reasons:
        assert 'height error of the fixes is ' in reason.text
        assert reason.text.endswith('(limit 50 m)')
        assert reason.remedy == 'Check the unit of heights in the fix driver.'


def test_converging_fixes_are_found_and_the_scale_is_within_its_sigma():
    drive, config, leg = made(scenario='motorway', duration=500.0, fix_noise='white',
                              fix_sigma=WHITE, imu_grade='industrial')
    stated = np.hypot(WHITE, START * np.exp(-leg.t_fix / TIME))[:, None] * np.ones(3)
    result = smooth(replace(leg, fixes_n=leg.fixes_n + IN_SIGMAS * stated,
                            covariance_n=stated[:, :, None]**2 * np.eye(3)), config)
    assert off(result, drive) < 3
    sigma = result.estimates['scale_factor'].sigma / drive.truth.scale
    assert sigma < START / drive.truth.distance / 2     # the error at the start exceeds it
    for name, true in zip(CONSTANTS[FIX_ERROR_BY_SIGMA], IN_SIGMAS, strict=True):
        assert abs(result.details[name]['value'] - true) < 3 * result.details[name]['sigma']
