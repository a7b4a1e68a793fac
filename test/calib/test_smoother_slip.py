# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Wheel slip, by two_point and in the smoother: its reason, place and uncertainty."""

from dataclasses import replace

from drives import drive, off, settings
import numpy as np
import pytest
from reversing_drives import made as by_hand
from smoother_legs import leg_of, made, reason_texts, smoothed

from odocal_ros.calib.slip import find_slips, travel_error_sign
from odocal_ros.estimator import smooth
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.result.residuals import find_unexplained_travel
from odocal_ros.estimator.smoother import best_fit
from odocal_ros.nav.dead_reckoning import Track
from odocal_ros.nav.geodesy import gravity
from odocal_ros.nav.odometer import Travel
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.sim import routes
from odocal_ros.sim.profile import hold, ramp
from odocal_ros.sim.scenarios import SimOptions, simulate
from odocal_ros.sim.wheels import low_pass_speed

pytestmark = pytest.mark.slow
SHORT = {'duration': 200.0, 'imu_grade': 'industrial'}


def slipping(leg, begin, length, share):
    """Return a leg whose wheel turns more by a share for some seconds, and by how many counts."""
    t, s = leg.travel.t, leg.travel.s
    spun = np.cumsum(np.diff(s, prepend=s[0]) * ((t >= begin) & (t < begin + length)) * share)
    travel = Travel(t, np.floor(s + spun + 0.5), leg.travel.quantum)
    return replace(leg, travel=travel), spun[-1]


def reason_text(method, code=Code.WHEEL_SLIP):
    return reason_texts(method).get(code, '')


@pytest.mark.parametrize(('noise', 'begin', 'length', 'share'), [
    ('white', 100.0, 3.0, 0.1), ('white', 100.0, 10.0, 0.05), ('rtk', 60.0, 10.0, 0.1),
    ('rtk', 100.0, 10.0, 0.3)])
def test_slip_of_seconds_is_reported_with_place_and_size(noise, begin, length, share):
    drive, config, leg = made(**SHORT, fix_noise=noise)
    leg, pulses = slipping(leg, begin, length, share)
    method = smooth(leg, config)
    assert off(method, drive) < 3.3
    # path per count of this leg, with slip
    found, counts = method.estimates['scale_factor'], np.ptp(leg.travel.s)
    assert abs(found.value - drive.truth.scale * (1 - pulses / counts)) < 2 * found.sigma
    slips = method.details['slips']
    metres = sum(s['metres'] for s in slips if begin - 2.0 <= s['t'] <= begin + length)
    # intervals that slip for a part of their second are found to nine tenths; the accelerometer
    # determines a path of 10 s to some decimetres
    assert metres == pytest.approx(pulses * drive.truth.scale, rel=0.25, abs=0.3)
    assert begin - 2.0 <= slips[0]['t'] <= begin + length
    assert f'{slips[0]["metres"]:+.2f} m at t = {slips[0]["t"]:.0f} s' in reason_text(method)


@pytest.mark.parametrize('noise', ['white', 'rtk'])
def test_slip_at_starts_is_reported(noise):
    drive, method = smoothed(**SHORT, fix_noise=noise, start_slip=0.005)
    assert 'slip while accelerating or braking' in reason_text(method)
    assert not reason_text(method, Code.SPEED_FILTERED)
    assert off(method, drive) < 3.3


@pytest.mark.parametrize('options', [
    {}, {'fix_noise': 'rtk'}, {'fix_noise': 'correlated'}, {'odometer_delay': 0.05},
    {'odometer': 'speed', 'speed_noise': 0.05, 'odometer_rate': 10.0, 'sway': 0.05,
     'fix_noise': 'rtk'}, {'odometer_delay': 0.3}, {'scale': 0.3, 'nominal_scale': 0.3},
    {'odometer': 'speed', 'speed_noise': 0.05}], ids=str)
def test_wheels_without_slip_and_without_a_filter_have_no_reasons(options):
    assert not {Code.WHEEL_SLIP,
                Code.SPEED_FILTERED} & set(reason_texts(smoothed(**SHORT, **options)[1]))


def vibrating(leg):
    """Return a leg with vibration of 70 Hz + 4 Hz per m/s, sampled at 100 Hz without a filter."""
    t, rng = leg.t_imu, np.random.default_rng(1)
    speed = np.abs(np.gradient(leg.travel.at(t), t)) * leg.rough_scale
    speed = np.convolve(speed, np.full(100, 0.01), 'same')
    phase = np.cumsum((70.0 + 4.0 * speed) * np.gradient(t)) * 2 * np.pi
    wave = np.sin(phase[:, None] + rng.uniform(0, 2 * np.pi, 3))
    return replace(leg, f_b=leg.f_b + 0.5 * wave, w_b=leg.w_b + np.deg2rad(0.2) * wave)


@pytest.mark.parametrize('noise', ['white', 'rtk'])
def test_aliased_vibration_is_an_imu_error_and_not_slip(noise):
    drive, config, leg = made(**SHORT, fix_noise=noise)
    method = smooth(vibrating(leg), config)
    assert not reason_text(method)
    assert 'aliasing' in ' '.join(r.remedy for r in method.reasons
                                  if r.code is Code.IMU_WORSE_THAN_GRADE)
    assert off(method, drive, 'scale_factor', 'yaw_mounting_angle') < 3.3


def test_level_without_information_is_not_reported():
    """12 m/s in 40 s: no second has more than 0.5 m/s^2, from where wheels may slip."""
    drive = by_hand(lambda duration, rng: routes._route([
        (hold(30) + ramp(40, 12, 1.0) + hold(60) + ramp(40, -12, 1.0) + hold(20), hold(190))]))
    config = settings(drive, None)
    method = smooth(leg_of(drive.leg(), config), config)
    assert method.details['noise']['along_hard'] == pytest.approx(0.01)     # initial value
    assert not reason_text(method)


def test_travel_lost_by_a_counter_without_braking_is_not_slip():
    """A wheel that travels less than the vehicle slides, and brakes it."""
    drive, config, leg = made(**SHORT, fix_noise='rtk')
    t = np.arange(40.0, 150.0)
    speed = drive.truth.scale * np.diff(np.interp(t, leg.travel.t, leg.travel.s))
    least = [np.diff(speed[k:k + 8]).min() for k in range(100)]     # m/s^2 in 8 s
    at = next(k for k in range(100) if least[k] > -0.1 and speed[k:k + 8].min() > 4.0)
    leg, _ = slipping(leg, t[at] + 3.0, 3.0, -0.1)
    method = smooth(leg, config)
    assert not reason_text(method)
    assert 'without braking' in reason_text(method, Code.TRAVEL_MISSING)


@pytest.mark.parametrize('loss', [0.1, 0.03])
def test_counts_lost_at_high_speed_are_an_error_of_the_scale(loss):
    """A counter that loses some of the counts in the fastest 15 % of the time."""
    drive, config, leg = made(**SHORT)
    t, s = leg.travel.t, leg.travel.s
    speed = np.convolve(np.gradient(s, t), np.ones(20) / 20, 'same')
    is_fast = speed > np.quantile(speed, 0.85)
    counted = np.cumsum(np.diff(s, prepend=s[0]) * np.where(is_fast, 1 - loss, 1.0))
    lossy = replace(leg, travel=Travel(t, np.floor(counted + 0.5), leg.travel.quantum))
    method = smooth(lossy, config)
    found = method.estimates['scale_factor']
    assert abs(found.value - drive.truth.scale * np.ptp(s) / np.ptp(counted)) < 2 * found.sigma
    assert 'less than the vehicle moves, mostly at constant speed' in reason_text(
        method, Code.TRAVEL_MISSING)
    assert 'unexplained_travel' in {source.name for source in method.sources}


def test_a_drive_that_slips_all_the_time_has_no_other_unexplained_travel():
    _, config, leg = made(duration=120.0)
    problem = make_problem(leg, config)
    fit = best_fit(problem, config)
    slipping_always = replace(fit, variance_factors=np.full_like(fit.variance_factors, 10.0))
    assert find_unexplained_travel(slipping_always, np.ones(len(fit.variance_factors))) is None


@pytest.mark.parametrize('forward', [1.0, -1.0])
@pytest.mark.parametrize(('begin', 'metres', 'acceleration', 'sign'), [
    (10.0, 0.5, 1.0, 0), (10.0, 0.5, -2.0, 0), (10.0, -0.5, 1.0, -1), (10.0, -0.5, 0.0, -1),
    (10.0, -0.5, -0.3, -1), (10.0, -0.5, -2.0, 0), (4.0, 0.5, -2.0, 1), (4.0, -0.5, -2.0, 0)])
def test_wheel_slips_only_in_the_direction_of_a_force(begin, metres, acceleration, sign, forward):
    t = np.arange(0.0, 20.0, 1.0)
    speed = begin + acceleration * np.clip(t - 9.0, 0.0, 2.0)
    assert travel_error_sign(9.0, 2.0, forward * metres, t, forward * speed) == sign


def test_held_speed_before_stops_is_not_slip():
    """A wheel sensor without output below 0.5 m/s; the bus repeats its last value for 2 s."""
    drive = simulate(SimOptions(scenario='town', seed=100, duration=300.0, imu_rate=50.0,
                                odometer='speed', odometer_rate=10.0, imu_grade='industrial',
                                fix_noise='rtk', fix_sigma=0.02))
    rows, held, since = drive.odometer, 0.0, -2.0
    value, t = rows.value.copy(), (rows.stamp_ns - rows.stamp_ns[0]) * 1e-9
    for k, speed in enumerate(rows.value):
        if abs(speed) >= 0.5:
            held, since = speed, t[k]
        value[k] = held if t[k] - since < 2.0 else 0.0
    leg = replace(drive, wheels=(replace(rows, value=value),)).leg()
    config = settings(drive, None)
    method = smooth(leg_of(leg, config), config)
    assert not reason_text(method)
    assert 'while the vehicle brakes to a stop' in reason_text(method, Code.TRAVEL_EXCESS)
    assert off(method, drive) < 3.3


def low_passed(leg, seconds):
    """Return a leg whose counter follows the wheel with that time constant."""
    t, s = leg.travel.t, leg.travel.s
    return replace(leg, travel=Travel(t, np.floor(low_pass_speed(s, t, seconds)),
                                      leg.travel.quantum))


def test_residual_of_a_filter_at_speed_changes_is_not_slip():
    """Four filters in series: not of first order, the type that the fit models."""
    _, config, leg = made(**SHORT, fix_noise='rtk')
    for _ in range(4):
        leg = low_passed(leg, 0.2)
    method = smooth(leg, config)
    assert reason_text(method, Code.SPEED_FILTERED)
    noise = method.details['noise']
    # m/sqrt(s), from changes of speed
    assert np.sqrt(noise['along_hard']**2 - noise['along']**2) > 0.006
    assert not reason_text(method)


@pytest.mark.parametrize('noise', ['white', 'rtk'])
def test_low_pass_filter_is_named_and_is_not_slip(noise):
    _, config, leg = made(**SHORT, fix_noise=noise)
    method = smooth(low_passed(leg, 0.4), config)
    # the delay and the noise levels of the fit include a part of it
    seconds = reason_text(method, Code.SPEED_FILTERED).split('about ')[1].split(' s')[0]
    assert float(seconds) == pytest.approx(0.4, abs=0.04)
    assert not reason_text(method)
    assert not method.details['slips']


def test_slip_of_a_filtered_odometer_is_reported():
    drive, config, leg = made(**SHORT)
    slipped, pulses = slipping(leg, 100.0, 3.0, 0.2)
    method = smooth(low_passed(slipped, 0.4), config)
    assert reason_text(method, Code.SPEED_FILTERED)
    first = method.details['slips'][0]
    assert first['metres'] == pytest.approx(pulses * drive.truth.scale, rel=0.3)
    assert 98.0 <= first['t'] <= 103.0


def result(**options):
    made = drive(**options)
    return made, calibrate(made.leg(), settings(made, None))


def slips(leg):
    return [r for r in leg.reasons if r.code is Code.WHEEL_SLIP]


@pytest.mark.parametrize('seed', [1, 2, 5])
def test_spins_are_named_and_the_sigma_includes_their_effect(seed):
    made, leg = result(scenario='straight', slip_events=30.0, slip_size=1.0, seed=seed)
    (reason,) = slips(leg)
    assert 'place' in reason.text
    scale = leg.methods['two_point'].estimates['scale_factor']
    assert abs(scale.value - made.truth.scale) < 2 * scale.sigma
    slip = next(s for s in leg.methods['two_point'].sources if s.name == 'wheel_slip')
    assert slip.effects.shape[1] == 1       # spins add up, they do not average down
    assert not slip.shared
    # all spins together: about their effect on the scale, within the fix noise of the two ends
    off = abs(scale.value / made.truth.scale - 1)
    assert abs(np.linalg.norm(slip.effects[0]) - off) < 0.5 * off + 1e-4


@pytest.mark.parametrize('options', [
    {'scenario': 'straight'}, {'scenario': 'town'}, {'scenario': 'town', 'odometer': 'speed'},
    {'scenario': 'straight', 'slope': 0.15}, {'scenario': 'town', 'imu_grade': 'tactical'},
    {'scenario': 'straight', 'scale': 0.35, 'nominal_scale': 0.35},
    {'scenario': 'straight', 'odometer_delay': 0.1}])
def test_drive_without_slip_has_no_slip_reason(options):
    assert not slips(result(**options)[1])


def delayed(leg, seconds, how):
    """Return a leg whose speeds are late, or low-passed with that time constant."""
    sent = leg.odometer
    if how == 'late':
        return replace(leg, odometer=replace(sent, stamp_ns=sent.stamp_ns + round(seconds * 1e9)))
    return replace(leg, odometer=replace(sent, value=low_pass_speed(
        sent.value, sent.stamp_ns * 1e-9, seconds)))


@pytest.mark.parametrize('how', ['late', 'low pass'])
def test_late_or_filtered_odometer_is_named_and_is_not_slip(how):
    made = drive(scenario='town', odometer='speed', seed=3, duration=300.0)
    leg = calibrate(delayed(made.leg(), 0.4, how), settings(made, None))
    assert not slips(leg)
    (text,) = (r.text for r in leg.reasons if r.code is Code.DELAY_SEEN)
    # to the grid of 0.05 s; for a filter to second order of its time
    assert float(text.split('about ')[1].split(' s')[0]) == pytest.approx(0.4, abs=0.06)
    assert 'odometer.time_offset = -0.' in text


@pytest.mark.parametrize('how', ['late', 'low pass'])
def test_spins_of_a_late_or_filtered_odometer_are_found(how):
    made = drive(scenario='straight', odometer='speed', slip_events=30.0, slip_size=1.0, seed=2)
    (sound,), (reason,) = (slips(calibrate(leg, settings(made, None))) for leg in (
        made.leg(), delayed(made.leg(), 0.4, how)))
    found, expected = (r.text.split('in total at ')[1].split(' place')[0] for r in (reason, sound))
    assert found == expected


@pytest.mark.parametrize(('slip', 'bends'), [(1.0, False), (0.0, False), (0.0, True)])
def test_lane_change_and_return_is_not_slip(slip, bends):
    """Two lanes across and back in a window: a neglected yaw of 3 deg gives a forward force."""
    t, speed, off = np.arange(0.0, 60.0, 0.02), 12.0, np.deg2rad(3.0)
    there = (t > 30) & (t < 34)
    rate = np.where(there & bends, 0.7 * np.sin(2 * np.pi * (t - 30) / 4), 0.0)
    yaw = np.cumsum(rate) * 0.02
    q_nb = np.stack([0 * t, 0 * t, np.sin(yaw / 2), np.cos(yaw / 2)], -1)
    spun = slip * np.clip(t - 31.5, 0.0, 1.0)
    f_b = np.stack([0 * t, speed * rate, 0 * t + gravity(0.8, 0.0)], -1)
    track = Track(t, q_nb, speed * t + spun, np.zeros((len(t), 3, 3)))
    found = find_slips(t, f_b, track, np.array([np.cos(off), np.sin(off), 0.0]), 0.8, 0.01)
    assert len(found.t) == (slip > 0)
    assert found.size.sum() == pytest.approx(slip, abs=0.2)
    assert found.delay == 0.0
