# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The error per distance driven: closed forms on a circle, and when it speaks against a result."""

import numpy as np
import pytest

from odocal_ros.calib.per_distance import check_worse, per_distance
from odocal_ros.reasons import Code

RADIUS = 400.0
WAY = np.arange(0.0, 3000.0, 1.0)
TRUE = RADIUS * np.stack([np.sin(WAY / RADIUS), 1 - np.cos(WAY / RADIUS), 0 * WAY], -1)


def wrong(scale=1.0, yaw=0.0):
    """Return what a track of this scale and yaw error strays by, pinned at its beginning."""
    turn = np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, 1]])
    return scale * TRUE @ turn.T - TRUE


@pytest.mark.parametrize(('scale', 'yaw'), [(1.01, 0.0), (1.0, 0.02), (0.98, -0.03)])
def test_scale_and_yaw_show_as_their_share_of_the_chord(scale, yaw):
    """Each piece is a chord 2 r sin(L / 2 r), off by |scale e^(i yaw) - 1| of it, anywhere."""
    off = abs(scale * np.exp(1j * yaw) - 1)
    for found in per_distance(WAY, wrong(scale, yaw), wrong()):
        chord = 2 * RADIUS * np.sin(found.length / 2 / RADIUS)
        assert found.before == pytest.approx(off * chord, rel=1e-9)
        assert found.after == 0.0


def test_what_bends_a_track_once_is_no_error_of_most_pieces():
    """A step of 30 m is in the pieces that hold it: of 1000 m in half of those of 2000 m."""
    step = np.zeros_like(TRUE)
    step[WAY > 1500.5, 0] = 30.0
    *_, longest = per_distance(WAY, step, step)
    assert longest.length == 1000.0
    assert longest.before == pytest.approx(30.0 * np.sqrt(0.5), rel=0.02)     # one of 20 pieces


def test_lengths_beyond_the_way_or_across_missing_fixes_are_left_out():
    assert [x.length for x in per_distance(WAY[:600], TRUE[:600], TRUE[:600])] == [100.0, 500.0]
    seen = (WAY < 700) | (WAY > 2250)       # 1.5 km of no fixes: pieces that end beyond it
    found = per_distance(WAY[seen], wrong(1.01)[seen], wrong()[seen])
    assert [x.length for x in found] == [100.0, 500.0]
    assert per_distance(np.empty(0), np.empty((0, 3)), np.empty((0, 3))) == ()


def test_a_correction_that_makes_it_worse_is_a_reason():
    noise = np.random.default_rng(1).normal(0.0, 0.5, TRUE.shape)
    (reason,) = check_worse(WAY, wrong() + noise, wrong(1.02) + noise, configured=True)
    assert reason.code is Code.CHECK_WORSE
    # 2 % of the chord of 100 m and the noise of both ends, each axis
    assert (f'in 100 m of path the calibrated track deviates {np.hypot(2.0, 1.0):.2g} '
            'm') in reason.text
    assert 'as configured 1 m' in reason.text
    assert check_worse(WAY, wrong(1.02) + noise, wrong() + noise, configured=True) == []
    assert check_worse(WAY, wrong() + noise, wrong(1.0005) + noise, configured=True) == []
