# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Scale of the fixes by the length of the window."""

import numpy as np
import pytest

from odocal_ros.calib.window_scale import window_scale, WINDOWS

T = np.arange(0.0, 1800.0)


def driven(seed=0):
    """Return speeds, m/s, and a track of stop and go with turns, m: (k,), (k, 2)."""
    rng = np.random.default_rng(seed)
    speed = np.repeat(rng.uniform(0.0, 15.0, 90), 20)
    heading = np.repeat(np.cumsum(rng.normal(0.0, 0.5, 90)), 20)
    step = speed[:, None] * np.stack([np.cos(heading), np.sin(heading)], -1)
    return speed, np.concatenate([np.zeros((1, 2)), np.cumsum(step, axis=0)[:-1]])


def test_a_wrong_scale_is_the_same_in_all_windows():
    _, dead = driven()
    found = window_scale(T, 1.01 * dead, dead)
    assert found[:, 0].tolist() == list(WINDOWS)
    # what is far from the median of all is clipped: the longest ways a little
    assert found[:, 1] == pytest.approx(0.01, rel=0.02)


def test_fixes_that_hold_an_odometer_differ_in_short_windows():
    """An odometer 2 % long, that satellites correct within 20 s: s' = -s / 20 s + 0.02 v."""
    _, dead = driven()
    error = np.zeros_like(dead)
    for k in range(1, len(T)):
        error[k] = error[k - 1] * np.exp(-1 / 20) + 0.02 * (dead[k] - dead[k - 1])
    found = window_scale(T, dead + error, dead)
    by_length = dict(zip(found[:, 0], found[:, 1], strict=True))
    assert by_length[2.0] > 5 * abs(by_length[200.0])
    assert np.all(np.diff(found[:, 1]) < 0.0)


def test_the_sigma_is_that_of_white_fixes():
    z = []
    for seed in range(30):
        rng, (_, dead) = np.random.default_rng(100 + seed), driven(seed)
        found = window_scale(T, dead + rng.normal(0.0, 1.0, dead.shape), dead)
        z.append(found[:5, 1] / found[:5, 2])
    # 150 of some dependence, the sigma by seven degrees of freedom: Student's, rms 1.2
    assert 0.9 < np.sqrt(np.mean(np.square(z))) < 1.5


def test_a_short_or_empty_leg_has_no_windows():
    assert window_scale(T[:0], np.empty((0, 2)), np.empty((0, 2))).shape == (0, 4)
    _, dead = driven()
    assert window_scale(T[:20], dead[:20], dead[:20])[:, 0].max(initial=0.0) <= 2.0
    assert not len(window_scale(T, dead, np.zeros_like(dead)))


def test_a_last_window_may_end_a_rounding_after_the_last_fix():
    t = 1.203 + np.arange(34.0)
    t[-1] = 34.203      # the last window, 32.203 to 34.203 s, ends at 34.203000000000003 s
    even = np.stack([t, t], axis=-1)
    assert window_scale(t, 1.001 * even, even)[0, 1] == pytest.approx(0.001)


def test_a_way_within_one_part_of_the_leg_has_no_scatter():
    dead = np.zeros((len(T), 2))
    dead[:, 0] = 1e-9 * T + 1e9 * np.clip(T - 1600.0, 0.0, None)      # all of it, within rounding
    assert not len(window_scale(T, 1.001 * dead, dead))
