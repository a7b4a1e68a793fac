# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reversing in a leg: signed counters give the truth, others are mirrored, however short it is."""

import re

from drives import drive, errors_in_sigmas, everything_said, rejecting, settings, shifted
import numpy as np
import pytest
from reversing_drives import made, there_and_back, three_point_turn, without_direction

from odocal_ros.nav.odometer import Travel
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code, Verdict
from odocal_ros.screening.reversing import doubled, reversed_starts
from odocal_ros.screening.screen import screen

pytestmark = pytest.mark.slow

# m/s and s at that speed: 3 m, 10 m and 72 m backwards
ROUTES = {'3 m': there_and_back(0.8, 0.0), '10 m': there_and_back(1.5, 3.0),
          '72 m': there_and_back(3.0, 20.0), 'three point turn': three_point_turn}
METRES = {'3 m': 3.2, '10 m': 10.5, '72 m': 72.0, 'three point turn': 71.2}
BACK_AT = {'3 m': 85.0, '10 m': 85.0, '72 m': 85.0, 'three point turn': 90.0}    # s in the bag


def told(leg, config):
    return {r.code: r.text for r in screen(leg, config)[1]}


@pytest.mark.parametrize('route', ROUTES)
@pytest.mark.parametrize('kind', [
    {}, {'two_wheels': True}, {'odometer': 'speed', 'speed_noise': 0.05},
    {'slope': 0.05, 'imu_grade': 'consumer'}, {'yaw': np.pi, 'imu_grade': 'consumer'}],
    ids=['counts', 'two wheels', 'speed', 'hills', 'IMU facing back'])
def test_a_counter_that_counts_up_in_reverse_is_seen_off_the_stop(route, kind):
    drive_ = made(ROUTES[route], **kind)
    leg = drive_.leg()
    assert Code.REVERSING_UNSIGNED not in told(leg, settings(drive_))
    text = told(without_direction(leg), settings(drive_))[Code.REVERSING_UNSIGNED]
    times = '2 times' if route == 'three point turn' else '1 time'
    assert text.startswith(f'{times} the acceleration has the opposite sign')
    # how far: to a tenth, by a rough scale and the blur of its ends
    metres = sum(float(m) for m in re.findall(r', ([\d.]+) m', text))
    assert metres == pytest.approx(METRES[route], rel=0.1, abs=0.5)
    # where: the stop before the stretch ends where the route says, to the stop's blur
    at = float(text.split('t = ')[1].split(' s')[0])
    start = (drive_.truth.start_ns - drive_.options.start_ns) * 1e-9
    assert at + start == pytest.approx(BACK_AT[route], abs=2.0)


@pytest.mark.parametrize('route', ['10 m', 'three point turn'])
def test_what_is_mirrored_gives_the_truth_and_no_slip(route):
    drive_ = made(ROUTES[route], two_wheels=True)
    for config in (settings(drive_), settings(drive_, method='smoother', heading_sigma=None)):
        result = calibrate(without_direction(drive_.leg()), config)
        assert result.verdict is Verdict.CAUTION
        assert not rejecting(result)
        assert not {Code.WHEELS_SWAPPED, Code.WHEEL_SLIP} & set(everything_said(result))
        errors = errors_in_sigmas(result, drive_.truth)
        assert max(map(abs, errors.values())) < 3.5


def test_a_stretch_that_slips_by_twice_its_way_was_reversed():
    """Of stretches of 10 s and 8 m/s at the top, 40 m each, the second slips by 76 m."""
    travel, *_ = starts([8.0, 8.0, 8.0])
    def slip(metres):
        return [{'t': 19.0, 'duration': 8.0, 'metres': metres}]
    ((begin, end),) = doubled(slip(76.0), travel, 1.0)
    assert (begin, end) == (pytest.approx(18.0, abs=1.5), pytest.approx(28.0, abs=1.5))
    assert len(doubled(slip(40.0), travel, 1.0)) == 0, 'a wheel that spins on the spot'
    assert len(doubled([], travel, 1.0)) == 0
    back = travel.mirrored(np.array([[begin, end]]))
    # 3 runs of 40 m (sin^2 of 8 m/s for 10 s), of which one is driven back
    assert (travel.s[-1], back.s[-1]) == (pytest.approx(120.0, rel=1e-3),
                                          pytest.approx(40.0, rel=1e-3))


@pytest.mark.parametrize('route', ROUTES)
def test_signed_counters_give_the_truth_over_it(route):
    drive_ = made(ROUTES[route])
    result = calibrate(drive_.leg(), settings(drive_))
    assert result.verdict is Verdict.ACCEPTED
    errors = errors_in_sigmas(result, drive_.truth)
    assert len(errors) == 3
    assert max(map(abs, errors.values())) < 3.5      # 12 draws: p = 0.006 for an honest sigma


@pytest.mark.parametrize('seed', range(6))
@pytest.mark.parametrize('scenario', ['town', 'out_and_back'])
def test_no_drive_forward_is_taken_for_it(scenario, seed):
    clean = drive(scenario=scenario, seed=seed, slope=0.08, imu_grade='consumer', sway=0.05)
    assert Code.REVERSING_UNSIGNED not in told(clean.leg(), settings(clean))


def starts(speeds, nose=None, noise=0.0):
    """
    Return travel, IMU times, turn rates and forces of runs of 10 s with stops of 4 s between.

    speeds : m/s at the top of each.   nose : gravity along x by the nose's rise, in parts of the
    acceleration.
    """
    t = np.arange(0.0, 14.0 * len(speeds) + 4.0, 0.02)
    v, theta = np.zeros(len(t)), np.zeros(len(t))
    for k, top in enumerate(speeds):
        run = top * np.sin(np.pi * np.clip((t - 14.0 * k - 4.0) / 10.0, 0.0, 1.0))**2
        v += run
        theta += np.arcsin((nose[k] if nose else 0.0) * np.gradient(run, t) / 9.81)
    zero = np.zeros(len(t))
    rng = np.random.default_rng(1)
    f = np.gradient(v, t) + 9.81 * np.sin(theta) + noise * rng.standard_normal(len(t))
    s = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2 * 0.02)])
    return Travel(t, s, 0.0), t, np.stack([zero, -np.gradient(theta, t), zero], -1), \
        np.stack([f, zero, 9.81 * np.cos(theta)], -1)


def test_a_nose_that_dips_and_starts_too_gentle_are_no_reversing():
    # gravity by the dip takes away twice what the speed adds to the specific force
    made_ = starts([8.0, 1.0, 8.0], [0.0, -2.0, 0.0])
    assert not len(reversed_starts(*made_, (0.0, 50.0)))
    travel, t, w_b, f_b = made_
    assert len(reversed_starts(travel, t, 0 * w_b, f_b, (0.0, 50.0)))    # but for the gyro
    # 0.06 m/s^2 in 2 m/s^2 of white noise at 50 Hz: half of 60 would go the wrong way by chance
    made_ = starts([12.0] + [0.2] * 60, noise=2.0)
    assert not len(reversed_starts(*made_, (0.0, 1000.0)))


def test_what_was_reversed_before_the_leg_does_not_matter():
    drive_ = made(ROUTES['10 m'])
    leg = without_direction(drive_.leg())
    late = shifted(leg, start=75.0)
    assert Code.REVERSING_UNSIGNED not in told(late, settings(drive_))
