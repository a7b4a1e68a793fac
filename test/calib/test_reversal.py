# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reversing that the odometer counts upwards is found; a heading or fixes that drift are not."""

import numpy as np
import pytest

from odocal_ros.calib.reversal import against_travel, backwards, level_track, Pieces, pieces
from odocal_ros.reasons import Code

DEG = np.pi / 180


def drive(reversed_at=(), drift=0.0, bias=0.0, jump=0.0, seconds=1200.0, speed=5.0):
    """
    Return the pieces of a drive round bends, fixes of 0.3 m once a second.

    reversed_at : (begin, end) s of stretches driven backwards and counted forwards.
    drift, bias : of the gyro, rad/s^2 and rad/s.   speed : m/s.
    jump : m by which fixes at 600 to 625 s run back against the travel, and on again until 650 s.
    """
    rng = np.random.default_rng(1)
    t = np.arange(0.0, seconds, 0.1)
    rate = 0.02 * np.sin(t / 40.0)
    faces = np.cumsum(rate) * 0.1
    sign = np.ones(len(t))
    for begin, end in reversed_at:
        sign[(t >= begin) & (t < end)] = -1.0
    true = level_track(speed * np.cumsum(sign) * 0.1, faces)
    track = level_track(speed * t, faces + bias * t + drift * t**2 / 2)
    ahead = np.array([np.cos(faces[6125]), np.sin(faces[6125])])
    error = -np.interp(t, [600.0, 625.0, 650.0], [0.0, jump, 0.0])
    fixes = true + error[:, None] * ahead + rng.normal(0.0, 0.3, true.shape)
    return pieces(track[::10], fixes[::10], t[::10], 0.3)


def test_the_level_track_of_a_circle_is_one():
    turned = np.linspace(0.0, 2 * np.pi, 721)
    track = level_track(50.0 * turned, turned)
    np.testing.assert_allclose(track[[360, 720]], [[0.0, 100.0], [0.0, 0.0]], atol=1e-3)


def test_pieces_are_long_enough_for_a_direction():
    t = np.arange(0.0, 100.0)
    p = np.stack([2.0 * t, np.zeros(100)], -1)
    found = pieces(7.0 * p, p, t, sigma=1.0)
    np.testing.assert_array_equal(found.length, np.full(9, 20.0))       # of 20 sigmas
    np.testing.assert_array_equal(found.off, 0.0)
    np.testing.assert_array_equal(found.stretch, 1.0)       # whatever the unit of the track
    assert len(pieces(p * 0, p * 0, t, 1.0).t) == 0


@pytest.mark.parametrize(('begin', 'end'), [(500.0, 506.0), (200.0, 300.0), (0.0, 100.0),
                                            (1150.0, 1200.0)])
@pytest.mark.parametrize('drift', [0.0, 0.1 * DEG / 600])
def test_a_stretch_driven_backwards_is_found(begin, end, drift):
    found = drive([(begin, end)], drift)
    back = backwards(found)
    inside = (found.t > begin + 3.0) & (found.t < end - 3.0)
    outside = (found.t < begin - 3.0) | (found.t > end + 3.0)
    assert back[inside].all()
    assert not back[outside].any()
    (reason,) = against_travel(found, signed=True)
    assert reason.code is Code.TRACK_MISMATCH
    assert f'in {back.sum()} of {len(back)} sections' in reason.text
    assert 'the counter does not count down' in reason.text
    assert 'odometer.signed is false' in against_travel(found, signed=False)[0].text


def test_a_gyro_that_drifts_by_turns_is_no_reversing():
    """A bias that grows by 0.3 deg/s within 20 min: 180 deg in all."""
    found = drive(drift=0.3 * DEG / 1200)
    assert np.ptp(np.unwrap(found.off)) > 3.0
    assert not backwards(found).any()
    assert against_travel(found, signed=True) == ()


def test_a_gyro_bias_that_nothing_has_shown_hides_no_reversing():
    """A robot at 0.3 m/s: a bias of 1 deg/s turns the track by 30 deg from piece to piece."""
    found = drive([(2000.0, 2400.0)], bias=DEG, speed=0.3, seconds=4000.0)
    assert 9 <= backwards(found).sum() <= 12     # 120 m in pieces of 10 m and more
    assert not backwards(drive(bias=DEG, speed=0.3, seconds=4000.0)).any()


@pytest.mark.parametrize('drift', [0.0, 0.3 * DEG / 1200])
def test_fixes_that_run_back_and_on_again_are_no_reversing(drift):
    """At 10 m/s against 5 m/s of travel: the fixes go back as far as the odometer goes on."""
    found = drive(drift=drift, jump=250.0)
    inside = (found.t > 600.0) & (found.t < 625.0)
    assert inside.sum() > 5
    np.testing.assert_allclose(found.stretch[inside], 1.0, atol=0.2)
    assert against_travel(found, signed=True) == ()
    # the same pieces, but that the fixes do not come back
    stay = found.t < 626.0
    assert against_travel(Pieces(*(x[stay] for x in found)), signed=True)


def test_fixes_that_jump_have_no_direction():
    found = drive()
    back = found.off.copy()
    back[[40, 41]] += np.pi
    stretch = found.stretch.copy()
    stretch[[40, 41]] = 0.33        # back by 60 m while the vehicle goes on by 20
    assert against_travel(found._replace(off=back, stretch=stretch), signed=True) == ()


def test_after_a_gap_in_which_the_heading_is_lost_forwards_is_what_most_pieces_are():
    found = drive()
    late = found.t > 800.0
    noisy = found.off + np.random.default_rng(2).normal(0.0, 0.1, len(found.t))
    turned = found._replace(off=noisy + np.pi * late, t=found.t + 60.0 * late)
    assert not backwards(turned).any()
    assert backwards(turned._replace(off=found.off + np.pi * late)).sum() == late.sum()
