# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Scale and position error by distance, by window length and by speed: closed forms."""

from drives import drive, settings
import numpy as np
import pytest

from odocal_ros.calib.scale_variation import window_scale, WINDOWS
from odocal_ros.calib.speed_scale import speed_scale
from odocal_ros.calib.track_check import compare_sections
from odocal_ros.nav.odometer import Travel
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code

RADIUS = 400.0
PATH = np.arange(0.0, 3000.0, 1.0)
TRUE = RADIUS * np.stack([np.sin(PATH / RADIUS), 1 - np.cos(PATH / RADIUS), 0 * PATH], -1)
T = np.arange(0.0, 1800.0)


def errors_per_distance(*tracks):
    return compare_sections(*tracks, configured=True)[0]


def wrong(scale=1.0, yaw=0.0):
    """Return the deviation of a track with this scale and yaw error, zero at its start."""
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    return scale * TRUE @ turn.T - TRUE


@pytest.mark.parametrize(('scale', 'yaw'), [(1.0, 0.02), (0.98, -0.03)])
def test_scale_and_yaw_errors_appear_as_their_share_of_the_chord(scale, yaw):
    """Each piece has chord 2 r sin(L / 2 r) and deviates by |scale e^(i yaw) - 1| of it."""
    off = abs(scale * np.exp(1j * yaw) - 1)
    for found in errors_per_distance(PATH, wrong(scale, yaw), wrong()):
        chord = 2 * RADIUS * np.sin(found.length / 2 / RADIUS)
        assert found.before == pytest.approx(off * chord, rel=1e-9)
        assert found.after == 0.0


def test_single_step_of_a_track_affects_only_the_pieces_that_contain_it():
    """Pieces of 1000 m start within the first 2000 m; half of them contain the 30 m step."""
    step = np.zeros_like(TRUE)
    step[PATH > 1500.5, 0] = 30.0
    *_, longest = errors_per_distance(PATH, step, step)
    assert longest.length == 1000.0
    assert longest.before == pytest.approx(30.0 * np.sqrt(0.5), rel=0.02)     # one of 20 pieces


def test_lengths_beyond_the_path_or_across_missing_fixes_are_left_out():
    assert [x.length for x in errors_per_distance(PATH[:600], TRUE[:600], TRUE[:600])] == [100.0,
                                                                                           500.0]
    seen = (PATH < 700) | (PATH > 2250)       # 1.5 km without fixes: pieces that end beyond it
    found = errors_per_distance(PATH[seen], wrong(1.01)[seen], wrong()[seen])
    assert [x.length for x in found] == [100.0, 500.0]
    assert errors_per_distance(np.empty(0), np.empty((0, 3)), np.empty((0, 3))) == ()


def test_correction_that_increases_the_error_is_reported():
    noise = np.random.default_rng(1).normal(0.0, 0.5, TRUE.shape)
    _, (reason,) = compare_sections(PATH, wrong() + noise, wrong(1.02) + noise, configured=True)
    assert reason.code is Code.CHECK_WORSE
    # 2 % of the chord of 100 m and the noise of both ends, each axis
    assert f': {np.hypot(2.0, 1.0):.2g} m rms from the fixes in sections of 100 m' in reason.text
    assert ', 1 m with the configured values' in reason.text
    for scales in ((1.02, 1.0), (1.0, 1.0005)):
        tracks = [wrong(scale) + noise for scale in scales]
        assert compare_sections(PATH, *tracks, configured=True)[1] == ()


def driven(seed=0):
    """Return speeds, m/s, and a track of stop and go with turns, m: (k,), (k, 2)."""
    rng = np.random.default_rng(seed)
    speed = np.repeat(rng.uniform(0.0, 15.0, 90), 20)
    heading = np.repeat(np.cumsum(rng.normal(0.0, 0.5, 90)), 20)
    step = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    return speed, np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)[:-1]])


def test_wrong_scale_is_the_same_in_all_windows():
    _, dead = driven()
    found = window_scale(T, 1.01 * dead, dead)
    assert found[:, 0].tolist() == list(WINDOWS)
    # values far from the median are clipped: slightly for the longest paths
    assert found[:, 1] == pytest.approx(0.01, rel=0.02)


def test_fixes_that_contain_an_odometer_differ_in_short_windows():
    """An odometer 2 % too long, corrected by satellites in 20 s: s' = -s / 20 s + 0.02 v."""
    _, dead = driven()
    error = np.zeros_like(dead)
    for k in range(1, len(T)):
        error[k] = error[k - 1] * np.exp(-1 / 20) + 0.02 * (dead[k] - dead[k - 1])
    found = window_scale(T, dead + error, dead)
    by_length = dict(zip(found[:, 0], found[:, 1], strict=True))
    assert by_length[2.0] > 5 * abs(by_length[200.0])
    assert np.all(np.diff(found[:, 1]) < 0.0)


def test_window_sigma_is_that_of_white_fixes():
    z = []
    for seed in range(30):
        rng, (_, dead) = np.random.default_rng(100 + seed), driven(seed)
        found = window_scale(T, dead + rng.normal(0.0, 1.0, dead.shape), dead)
        z.append(found[:5, 1] / found[:5, 2])
    # 150 partly dependent values, sigmas with seven degrees of freedom: Student, rms 1.2
    assert 0.9 < np.sqrt(np.mean(np.square(z))) < 1.5


def test_windows_end_with_the_fixes_and_a_short_or_stationary_leg_has_none():
    assert window_scale(T[:0], np.empty((0, 2)), np.empty((0, 2))).shape == (0, 4)
    _, dead = driven()
    assert window_scale(T[:20], dead[:20], dead[:20])[:, 0].max(initial=0.0) <= 2.0
    assert not len(window_scale(T, dead, np.zeros_like(dead)))
    dead = np.zeros((len(T), 2))
    dead[:, 0] = 1e-9 * T + 1e9 * np.clip(T - 1600.0, 0.0, None)      # at rest within rounding
    assert not len(window_scale(T, 1.001 * dead, dead))
    t = 1.203 + np.arange(34.0)
    t[-1] = 34.203      # the last window, 32.203 to 34.203 s, ends at 34.203000000000003 s
    even = np.stack([t, t], axis=-1)
    assert window_scale(t, 1.001 * even, even)[0, 1] == pytest.approx(0.001)


def straight(factor=0.98, offset=0.12, lag=0.3, noise=0.0, reverse=False):
    """Return the arguments of a straight drive whose odometer has these errors."""
    t = np.arange(0.0, 600.0, 0.1)
    v = 12 + 6 * np.sin(t / 15)
    s = np.append(0.0, np.cumsum((v[1:] + v[:-1]) / 2 * 0.1))
    late = np.interp(t - lag, t, s)
    sent = (late - offset * t) / factor * (-1 if reverse else 1)
    pick = slice(50, -50, 10)
    place = np.stack([s, 0 * s], -1)[pick]
    fix = place + noise * np.random.default_rng(1).standard_normal(place.shape)
    return t[pick], fix, place, s[pick], Travel(t, sent, 0.0)


@pytest.mark.parametrize('reverse', [False, True])
def test_factor_offset_and_lag_are_those_of_the_odometer(reverse):
    """Without noise the model is exact except for squared lag: the speed it uses is also late."""
    found = speed_scale(*straight(reverse=reverse))
    assert found.factor[0] == pytest.approx(0.98, abs=3e-4)
    assert found.offset[0] == pytest.approx(0.12, abs=4e-3)
    assert found.lag[0] == pytest.approx(0.3, abs=5e-3)
    speed, ratio, _, _ = found.bins.T
    assert (np.diff(speed) > 0).all()
    # 0.12 m/s is a larger share of the slow sections than of the fast ones
    assert ratio == pytest.approx(0.98 * speed / (speed - 0.12), rel=3e-3)


def test_sigmas_hold_with_noise():
    found = speed_scale(*straight(noise=0.3))
    for (value, sigma), truth in zip((found.factor, found.offset, found.lag), (0.98, 0.12, 0.3),
                                     strict=True):
        assert 0 < abs(value - truth) < 4 * sigma


def test_one_speed_gives_no_offset_and_too_few_sections_give_no_result():
    """At 10 m/s, with an odometer that counts half metres."""
    def even(t):
        place = np.stack([10 * t, 0 * t], -1)
        return speed_scale(t, place, place, 10 * t, Travel(t, 10 * t / 0.5, 0.0))

    # 99 cells of 5 s and 6e-14 s: the last cell ends one rounding after the last fix
    rounded = (7_369_999_872 + np.arange(496) * 10**9) * 1e-9
    assert np.arange(rounded[0], rounded[-1], 5.0)[-1] > rounded[-1]
    for t in (np.arange(0.0, 200.0), rounded):
        assert even(t).offset is None
        assert even(t).bins[:, 1] == pytest.approx(0.5)
    assert not len(even(np.arange(0.0, 8.0, 0.1)).bins)


@pytest.mark.slow
def test_delay_of_a_simulated_odometer_is_found():
    made = drive(scenario='town', duration=600.0, seed=4, imu_grade='industrial', fix_sigma=0.3,
                 odometer_delay=0.2)
    leg = calibrate(made.leg(), settings(made))
    found = leg.evidence.by_speed
    assert abs(found.lag[0] - 0.2) < 4 * found.lag[1] < 0.2
    assert abs(found.factor[0] - made.truth.scale) < 4 * found.factor[1]
