# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Health of inputs and progress of a leg, computed from synthetic arrivals."""

from dataclasses import replace

import numpy as np
import pytest

from odocal_ros.data.samples import FixSamples, OdometerForm, OdometerSamples, take
from odocal_ros.forecast.progress import Clocks, FixPath, OdometerProgress, Progress
from odocal_ros.live.health import Health
from odocal_ros.settings.config import Config, with_settings

pytestmark = pytest.mark.core
SECOND = 1_000_000_000
COUNTER = OdometerForm('cumulative', 2**16, 'm/pulse')


def rows(stamps_s, values=None, received_s=None):
    stamps = np.round(np.asarray(stamps_s, float) * SECOND).astype(np.int64)
    received = stamps if received_s is None else np.round(np.asarray(received_s) * SECOND)
    values = np.zeros(len(stamps)) if values is None else values
    return OdometerSamples(stamps, received.astype(np.int64), np.asarray(values))


def decoded(health, block, **limits):
    """Process a block as an input does; return the mask of usable rows."""
    return np.array(health.check_stamps(block.stamp_ns.tolist(), block.received_ns, **limits),
                    bool)


def health_of(*blocks, arrived=(), **limits):
    """Return the health after blocks of stamps, s; arrived: sequence numbers after 1 s, 2 s."""
    health = Health()
    for second, numbers in enumerate(arrived, 1):
        health.register_arrival(numbers, now_ns=second * SECOND)
    for stamps in blocks:
        decoded(health, rows(stamps), **limits)
    return health


def test_the_rate_follows_from_stamps_and_the_silence_limit_from_the_rate():
    blocks = [100 + (begin + np.arange(10)) * 0.02 for begin in range(0, 100, 10)]  # 50 Hz
    health = health_of(*blocks, arrived=[[None] * 100])
    assert health.rate_hz(SECOND) == pytest.approx(50.0)
    assert health.rate_hz(3 * SECOND + 1) == 0.0  # 2 s of silence at 50 Hz
    health = health_of([0.5, 1.5, 2.5], arrived=[[None] * 3])
    assert health.is_flowing(SECOND + 4 * SECOND)       # 5 intervals of 1 s
    assert not health.is_flowing(SECOND + 6 * SECOND)
    assert not health_of([0.0], arrived=[[1]]).is_flowing(SECOND)


def test_lost_messages_and_gaps_are_counted_but_not_between_two_publishers():
    assert health_of(arrived=[[5, 6, 9], [10, 12]]).lost_count == 3       # 7, 8 and 11
    assert health_of(arrived=[[5, 900, 6, 901], [1, 2]]).lost_count == 0
    assert health_of([1.0, 1.01, 1.6], max_gap_s=0.5).gap_count == 1
    # 0.54 s exceeds 5 intervals of 0.1 s, 0.45 s does not
    assert health_of(np.arange(1, 2, 0.1), [2.0, 2.45, 2.99]).gap_count == 1


def test_a_block_of_old_stamps_is_a_time_jump_but_a_single_one_is_not():
    health = health_of([10.0, 10.1], [3.0, 10.2])
    assert not health.has_jumped_back
    decoded(health, rows([2.0, 2.1]))
    assert health.has_jumped_back
    health.reset_times()
    decoded(health, rows([2.2]))
    assert (health.has_jumped_back, health.newest_ns) == (False, int(2.2 * SECOND))
    stamps = [*np.arange(20.0, 21.0, 0.1), *np.arange(5.0, 6.0, 0.1)]
    for cut in range(1, len(stamps)):
        assert health_of([19.9], stamps[:cut], stamps[cut:]).has_jumped_back, cut


@pytest.mark.parametrize('rows_at_once', [1, 3, 20])
@pytest.mark.parametrize('wild', [-15.0, -1e6, 40.0, 1e9])
def test_single_wrong_stamps_are_ignored_for_any_block_size(rows_at_once, wild):
    stamps = 1e6 + np.arange(20.0, 24.0, 0.1)
    for at in range(1, 19):
        health, travel, some = Health(), OdometerProgress(COUNTER), stamps.copy()
        some[at] += wild
        sent = rows(some, np.arange(len(some)) >= 30)       # one count: a standstill
        for begin in range(0, len(some), rows_at_once):
            part = take(sent, slice(begin, begin + rows_at_once))
            sound = decoded(health, part)
            assert (sound == (abs(part.stamp_ns * 1e-9 - 1e6 - 22) < 3)).all()
            if sound.any():
                travel.feed(take(part, sound), 0.02)
            assert 0 <= travel.still_s() < 4
            assert abs(health.newest_ns * 1e-9 - 1e6 - 22) < 3
        assert not health.has_jumped_back, at
        assert travel.still_s() == pytest.approx(3.9, abs=0.25)     # wrong stamps at the ends


@pytest.mark.parametrize('rows_behind', [1, 2])
def test_an_old_stamp_after_a_pause_is_ignored(rows_behind):
    health = health_of([1000.0, 1000.1], [1000.2, 1002.0, *[1.0] * rows_behind])
    assert (health.newest_ns, health.has_jumped_back) == (1002 * SECOND, False)
    decoded(health, rows([1002.1, 1002.2]))
    assert (health.newest_ns * 1e-9, health.has_jumped_back) == (pytest.approx(1002.2), False)


@pytest.mark.parametrize('before', [[], [10.0, 10.1]])
def test_a_stamp_seconds_ahead_within_a_block_is_ignored(before):
    health = health_of([*before, 20.0, 10.2, 10.3, 10.4])
    assert (health.newest_ns * 1e-9, health.has_jumped_back) == (pytest.approx(10.4), False)


def test_stamps_far_ahead_are_accepted_if_the_next_ones_continue_them():
    health = health_of([10.0, 10.1])
    assert decoded(health, rows([1e5])).tolist() == [False]
    assert decoded(health, rows([1e5 + 1, 1e5 + 2])).tolist() == [False, True]
    assert health.newest_ns == int((1e5 + 2) * SECOND)
    assert not health.has_jumped_back


def test_after_a_time_jump_stamps_are_not_reported_as_zero():
    assert not Health().has_no_stamps
    assert health_of([0.0, 0.0]).has_no_stamps
    health = health_of([0.0, 0.0], [5.0, 5.1])
    health.reset_times()
    assert (health.newest_ns, health.has_no_stamps) == (0, False)


def travelled(*blocks, form=COUNTER, scale=0.02):
    """Return the odometer progress after blocks of (times, s, and values)."""
    travel = OdometerProgress(form)
    for times, values in blocks:
        travel.feed(rows(times, np.array(values)), scale)
    return travel


def test_the_distance_is_right_across_a_rollover_and_a_reset_adds_none():
    counts = [65000, 65300, 64, 364, 664] # 300 counts each, over 65536
    for cut in range(1, 5):
        travel = travelled((range(cut), counts[:cut]), (range(cut, 5), counts[cut:]))
        assert travel.path_length == 1200
    travel = travelled((range(4), [900000, 900100, 0, 100]),
                       form=OdometerForm('cumulative', 2**64, 'm/pulse'))
    assert travel.path_length == 200  # 18 km in a second is a reset


@pytest.mark.parametrize(('quantity', 'unit', 'scale', 'values', 'metres'), [
    ('increment', 'm/pulse', 0.02, [7, 10, 10], 0.4),   # the first is of the time before
    ('rate', '1', 1.0, [2.0, 2.0, 3.0], 5.0), ('cumulative', 'm/rad', 0.3, [1.0, 2.0, 4.0], 0.9)])
def test_every_quantity_gives_metres(quantity, unit, scale, values, metres):
    travel = travelled((range(3), values), form=OdometerForm(quantity, 0, unit), scale=scale)
    assert travel.path_length * scale == pytest.approx(metres)


def test_a_clock_that_is_set_back_gives_no_negative_standstill():
    blocks = [([1000, 1001, 1002], [0, 100, 200])]
    for t in (10, 11, 12):
        blocks.append(([t], [200]))
        travel = travelled(*blocks)
        assert travel.still_s() == t - 10
        assert travel.rest_s(600.0) >= 0


def test_standstills_are_detected_with_toggling_counts_and_in_the_preroll():
    standing = range(6), [0, 100, 200, 200, 201, 201]
    assert travelled(standing).still_s() == pytest.approx(3.0)
    assert travelled(standing, ([6], [301])).still_s() == 0.0
    assert travelled().rest_s(600.0) == 0.0
    counts = 100 * np.concatenate([np.arange(6), np.full(10, 5), np.arange(5, 20)])
    stood = np.arange(31), counts        # stands from 5 s to 16 s, drives on to 30 s
    travel = travelled(stood)
    assert travel.still_s() == 0.0
    assert travel.rest_s(600.0) == pytest.approx(11.0, abs=1.0)
    assert travel.rest_s(10.0) == 0.0
    assert travelled(stood, ([31, 40], [1900, 1900])).rest_s(10.0) == pytest.approx(10.0)


def fixes(latitude, **columns):
    """Return fixes with a sigma of 0.5 m, one per second."""
    n = len(latitude)
    stamps = np.arange(n) * SECOND
    return replace(FixSamples(stamps, stamps, latitude, np.full(n, 0.1), np.zeros(n),
                              np.tile(np.eye(3) * 0.25, (n, 1, 1)), np.full(n, 2), np.zeros(n)),
                   **columns)


def test_the_path_length_of_the_fixes_excludes_their_noise():
    north = 1e-7 * np.array([0.0, 1.0, 0.0, 1.0, 0.0])     # 0.6 m of jitter
    drive = 0.7 + np.concatenate([north, 10e-7 * np.arange(1, 11)])  # then 63.7 m in 6.4 m steps
    path = FixPath()
    path.feed(fixes(drive, status=np.full(len(drive), -1)), 0, is_moving=True)
    assert path.path_length == 0.0
    path.feed(fixes(drive), 0, is_moving=True)
    # the jitter may shift the first anchor
    assert path.path_length == pytest.approx(63.6, abs=0.7)
    assert path.top_speed == pytest.approx(6.36, abs=0.7)


@pytest.mark.parametrize('odd', [1e200, -1e308, np.inf, np.nan, 2.0])
def test_an_impossible_fix_adds_no_path_length(odd):
    path = FixPath()
    with np.errstate(all='raise'):
        path.feed(fixes(np.array([0.7, 0.7, odd, 0.7, 0.7])), 0, is_moving=True)
    assert (path.path_length, path.top_speed) == (0.0, 0.0)


def test_fix_noise_adds_no_path_length_while_the_counter_stands():
    """30 s of rest with fixes of 2.5 m, then 20 s at 10 m/s; the scale is unknown."""
    rng, progress = np.random.default_rng(3), Progress()
    t = np.arange(0.0, 50.0, 0.2)
    x_m = np.clip(t - 30.0, 0.0, None) * 10.0
    for k in range(len(t)):
        counts = rows(t[k:k + 1] + 1000, np.array([int(x_m[k] / 0.02)]))
        noise = 2.5 * rng.standard_normal(2) / 6.37e6
        fix = FixSamples(counts.stamp_ns, counts.received_ns, [0.7 + x_m[k] / 6.37e6 + noise[0]],
                         [0.1 + noise[1]], [0.0], np.eye(3)[None] * 6.25, [2], [0])
        progress.feed('odometer', counts, Config(), COUNTER, float('nan'))
        progress.feed('fix', fix, Config(), COUNTER, float('nan'))
        if t[k] < 30.0:
            assert (progress.distance_m(), progress.max_speed()) == (0.0, 0.0)
    assert progress.distance_m() == pytest.approx(200.0, rel=0.15)
    assert 9.0 < progress.max_speed() < 20.0
    # with the scale of the running estimate
    progress.feed('odometer', rows([1050.0], np.array([int(x_m[-1] / 0.02)])), Config(), COUNTER,
                  0.02)
    assert progress.distance_m() == pytest.approx(x_m[-1], abs=0.1)
    assert progress.max_speed() == pytest.approx(10.0, abs=0.1)


def test_a_burst_of_counts_does_not_increase_the_maximum_speed():
    t = np.arange(0.0, 20.0, 0.02)
    late = np.where(t % 5.0 < 0.12, t - t % 5.0 + 0.12 + (t % 5.0) / 100, t) + 1000
    travel = travelled(*(([late[k]], [int(10 * t[k] / 0.02)]) for k in range(len(t))))
    assert travel.top_speed * 0.02 == pytest.approx(10.0, rel=0.15)


def test_a_burst_of_messages_is_not_reported_as_a_clock_difference():
    """A bag played 30 times as fast on a busy machine: 3 s of it arrive within 20 ms."""
    clocks, config = Clocks(), Config()
    for i in range(20):
        arrival = 1000.0 + 0.1 * i + np.array([0.0, 0.07, 0.08])
        stamps = 50 + 3.0 * i + np.array([0.0, 0.1, 2.9])
        clocks.feed('imu', rows(stamps[:2], received_s=arrival[:2]))
        clocks.feed('odometer', rows(stamps[2:], received_s=arrival[2:]))
        clocks.feed('imu', rows(stamps[2:] + 0.01, received_s=arrival[2:] + 1e-4))
    assert clocks.find_differing(config) == []


def test_the_scale_of_the_hint_is_the_best_known_one():
    config = with_settings(Config(), {'wheels.radius': 0.3, 'wheels.pulses_per_revolution': 100.0})
    angle, speed = OdometerForm('cumulative', 0, 'm/rad'), OdometerForm('rate', 0, '1')

    def scale(config, form, known=np.nan):
        progress = Progress()
        progress.feed('odometer', rows([1.0, 2.0]), config, form, known)
        return progress._scale
    assert scale(Config(), COUNTER) == 0.0
    assert scale(config, COUNTER) == pytest.approx(2 * np.pi * 0.003)
    assert scale(config, angle) == 0.3
    assert scale(config, speed) == 1.0
    named = with_settings(config, {'odometer.nominal_scale': 0.019})
    assert scale(named, COUNTER) == 0.019
    assert scale(named, COUNTER, known=0.0188) == 0.0188


def test_clocks_are_compared_between_rows_that_arrived_together():
    clocks, config = Clocks(), Config()
    for i in range(5):
        arrival = 1000.0 + i + np.arange(10) * 0.1
        # played ten times faster than real time, on a foreign clock: no difference between topics
        clocks.feed('imu', rows((arrival - 1000) * 10 + 50, received_s=arrival))
        clocks.feed('fix', rows([(arrival[4] - 1000) * 10 + 50 - 0.3], received_s=[arrival[4]]))
        clocks.feed('odometer', rows([(arrival[4] - 1000) * 10 + 50.7], received_s=[arrival[4]]))
    assert clocks.find_differing(config) == [('odometer', pytest.approx(0.7, abs=1e-6))]
    aligned = with_settings(config, {'odometer.time_offset': -0.7})
    assert clocks.find_differing(aligned) == []
    late = with_settings(aligned, {'imu.time_offset': 0.9})
    assert [slot for slot, _ in clocks.find_differing(late)] == ['fix', 'odometer']
    # two synchronous sensors: in each tick the IMU row arrives first and the other row last
    clocks = Clocks()
    for i in range(20):
        arrival = 1000.0 + 0.05 * i + np.array([0.0, 0.025])
        clocks.feed('imu', rows((arrival - 1000) * 10 + 50, received_s=arrival))
        late = arrival + 0.002
        clocks.feed('odometer', rows((late - 1000) * 10 + 50.7, received_s=late))
    assert clocks.find_differing(config) == [('odometer', pytest.approx(0.7, abs=1e-6))]
