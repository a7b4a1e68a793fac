# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Fixes that a receiver dead-reckons are found, and velocities that contradict the fixes."""

import re

from drives import configured, kept, seconds, settings, with_columns
import numpy as np
import pytest

from odocal_ros.reasons import Code
from odocal_ros.screening.dead_reckoned_fixes import dead_reckoned_fixes
from odocal_ros.screening.screen import screen
from odocal_ros.sim.noise import make_rng
from odocal_ros.sim.options import SimOptions
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.scenarios import simulate

pytestmark = pytest.mark.core
at_s = np.arange(0.0, 400.0, 1.0)


def turned(t):
    """Return the angle of a drive on a winding road, rad."""
    return 0.8 * np.sin(0.03 * np.asarray(t))


def driven(stop=(0, 0)):
    """Return positions of a vehicle at 15 m/s with a standstill between two times, m: (n,)."""
    fine = np.arange(0.0, 400.0, 0.01)
    speed = np.where((fine >= stop[0]) & (fine < stop[1]), 0.0, 15.0)
    return np.interp(at_s, fine, np.cumsum(speed * 0.01 * np.exp(1j * turned(fine))))


def received(sigma, tunnel, scale=0.02, stop=(0, 0)):
    """Return positions from a receiver, in the tunnel by its own odometer, m: (n, 3)."""
    true = driven(stop)
    noise = sigma * make_rng(3, 'fixes').standard_normal((len(at_s), 2)) @ [1, 1j]
    inside = (at_s >= tunnel[0]) & (at_s < tunnel[1])
    if inside.any():
        begin = np.flatnonzero(inside)[0]
        noise[inside] = noise[begin] + scale * (true[inside] - true[begin])
    place = true + noise
    return np.stack([place.real, place.imag, 0 * place.real], -1)


def stated(sigma):
    return np.full(len(at_s), sigma)


@pytest.mark.parametrize(('length', 'stop'), [
    (20, (0, 0)), (60, (0, 0)), (120, (0, 0)), (80, (220, 240))], ids=str)
@pytest.mark.parametrize('sigma', [0.05, 0.5])
def test_a_tunnel_is_found_with_its_ends_also_at_a_standstill(sigma, length, stop):
    begin, end = 150, 150 + length
    found, why = dead_reckoned_fixes(at_s, received(sigma, (begin, end), stop=stop), stated(sigma),
                                     1j * driven(stop))
    assert [r.code for r in why] == [Code.FIXES_DEAD_RECKONED]
    assert f'to {end - 1} s' in why[0].text
    # the window holds three rows of noise at most
    assert not found[at_s < begin - 5].any()
    assert not found[at_s >= end].any()
    assert found[begin:end].mean() > 0.8


def test_fixes_of_one_moment_are_too_few_for_a_tunnel():
    t = at_s * 1e-6       # stamps whose nanoseconds the driver divides by 1000
    with np.errstate(all='raise'):
        found, why = dead_reckoned_fixes(t, received(0.01, (0, 0)), stated(0.01), 1j * driven())
    assert not found.any()
    assert not why


@pytest.mark.parametrize('sigma', [0.01, 0.05, 0.5])
def test_noise_and_a_wrong_fix_are_not_a_tunnel(sigma):
    fixes = received(sigma, (0, 0))
    fixes[200:230, 0] += 20.0          # a false fix, and back
    found, why = dead_reckoned_fixes(at_s, fixes, stated(sigma), 1j * driven())
    assert not found.any()
    assert not why


@pytest.mark.parametrize('change', [0.7, 3.0])
def test_a_change_of_satellites_is_not_a_tunnel(change):
    """Carrier-smoothed fixes move by less than a metre of a stated error of 1.4 m."""
    fixes = received(0.1, (0, 0))
    fixes[150:200] = received(0.0, (0, 0))[150:200] + fixes[149] - received(0.0, (0, 0))[149]
    fixes[200:, 0] += change
    found, why = dead_reckoned_fixes(at_s, fixes, stated(1.4), 1j * driven())
    assert bool(why) == (change > 1.4)
    assert found.any() == (change > 1.4)


@pytest.mark.parametrize('lag', ['delay', 'filter'])
@pytest.mark.parametrize('tunnel', [False, True])
def test_an_odometer_that_is_late_when_braking_is_not_a_tunnel(lag, tunnel):
    fine = np.arange(0.0, 400.0, 0.01)
    phase = fine % 60.0
    speed = np.interp(phase, [0, 48, 50, 54, 60], [15, 15, 7, 15, 15]) + np.where(
        phase < 24, np.sin(np.pi / 4 * phase), 0.0)
    past = np.arange(0.0, 3.0, 0.01)
    weight = np.exp(-past / 0.3) if lag == 'filter' else np.isclose(past, 0.3)
    late = np.convolve(np.pad(speed, (len(past), 0), mode='edge'), weight / weight.sum())
    true, track = (np.interp(at_s, fine, np.cumsum(v * 0.01 * np.exp(1j * turned(fine))))
                   for v in (speed, late[len(past):][:len(fine)]))
    noise = 0.003 * make_rng(3, 'fixes').standard_normal((len(at_s), 2)) @ [1, 1j]
    inside = tunnel & (at_s >= 210) & (at_s < 226)
    place = true + np.where(inside, 0.02 * (true - true[210]), noise)
    place_n = np.stack([place.real, place.imag, 0 * at_s], -1)
    found, why = dead_reckoned_fixes(at_s, place_n, stated(0.01), 1j * track)
    assert len(why) == tunnel
    assert not found[(at_s < 168) | (at_s >= 226)].any()      # smooth from the last braking on
    assert found[inside].sum() >= 0.8 * inside.sum()


@pytest.mark.parametrize(('scenario', 'noise'), [('motorway', 'white'), ('town', 'rtk')])
def test_fixes_in_a_tunnel_are_not_used_and_this_is_reported(scenario, noise):
    real = RealEffects(tunnels=((110.0, 70.0),), tunnel_odometer=0.02)
    made = simulate(SimOptions(scenario=scenario, duration=300.0, imu_grade='industrial',
                               imu_rate=50.0, fix_noise=noise, antenna_lever_arm=(1.0, 0.0, 1.5),
                               real=real))
    inputs, reasons = screen(made.leg(), configured(made))
    off = (made.truth.start_ns - made.imu.stamp_ns[0]) * 1e-9
    assert [reason.code for reason in reasons].count(Code.FIXES_DEAD_RECKONED) == 1
    inside = (inputs.t_fix > 115.0 - off) & (inputs.t_fix < 175.0 - off)
    assert not inside.any()
    assert inputs.fixes_rejected == len(made.fix.stamp_ns) - len(inputs.t_fix)


@pytest.fixture(scope='module', params=['town', 'straight'])
def drive(request):
    return simulate(SimOptions(scenario=request.param, duration=200.0, imu_rate=50.0,
                               velocity_sigma=0.05, velocity_delay=0.2))


def screened(drive, change, **options):
    leg = with_columns(drive.leg(), 'fix_velocity', velocity_n=change)
    inputs, found = screen(leg, settings(drive, None, **options))
    texts = [r.text for r in found if r.code is Code.VELOCITY_UNUSABLE]
    assert len(texts) == (not len(inputs.external['fix_velocity'].t))
    return texts


@pytest.mark.parametrize('factor', [1.0, 1.05, 0.95])
def test_a_velocity_that_agrees_with_the_fixes_is_used(drive, factor):
    assert not screened(drive, lambda v: np.multiply(v, factor, out=v))


def test_gaps_of_the_velocity_are_not_compared(drive):
    leg = drive.leg()
    v = leg.rows('fix_velocity')
    t = seconds(leg, v)
    fast = np.linalg.norm(v.velocity_n, axis=1) > 8.0      # no stop by interpolation
    some = (t < 30.0) | (t > 170.0) | fast & (t % 60.0 < 15.0)
    inputs, found = screen(kept(leg, 'fix_velocity', some), settings(drive, None))
    assert Code.VELOCITY_UNUSABLE not in {r.code for r in found}
    assert len(inputs.external['fix_velocity'].t)


def test_wheel_speeds_units_and_axes_are_found(drive):
    def forward(v):
        v[:] = np.linalg.norm(v, axis=1)[:, None] * [1.0, 0.0, 0.0]

    def down(v):            # north, east: on a road to the north-east the same
        v[:, :2] = v[:, 1::-1] * [1.0, -1.0]

    for change in (forward, down, lambda v: np.multiply(v, 3.6, out=v),
                   lambda v: np.negative(v, out=v)):
        text, = screened(drive, change)
        assert re.search(r'contradicts the fixes .* a difference of \d+ % \(limit 1\d %\)', text)


def test_a_velocity_not_configured_or_at_a_standstill_is_not_reported(drive):
    leg = with_columns(drive.leg(), 'fix_velocity', velocity_n=lambda v: v.fill(9.0))
    _, found = screen(leg, settings(drive, None, gnss__use_velocity=False))
    assert Code.VELOCITY_UNUSABLE not in {r.code for r in found}
    keep = drive.fix.stamp_ns < drive.options.start_ns + 5 * 10**9
    inputs, _ = screen(kept(drive.leg(), 'fix', keep), settings(drive, None))
    assert len(inputs.external['fix_velocity'].t)
