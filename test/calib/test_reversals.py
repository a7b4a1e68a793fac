# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reversing is found from sections of track and fixes, and not confused with other errors."""


import numpy as np
import pytest

from odocal_ros.calib.reversals import (
    CourseSections,
    cut_sections,
    find_reversed,
    reversal_reasons,
)
from odocal_ros.nav.dead_reckoning import level_track
from odocal_ros.reasons import Code

DEG = np.pi / 180


def winding(reversed_at=(), drift=0.0, bias=0.0, jump=0.0, seconds=1200.0, speed=5.0):
    """
    Return the sections of a drive with bends and fixes of 0.3 m once a second.

    reversed_at : (begin, end) s of sections driven backwards and counted forwards.
    drift, bias : of the gyro, rad/s^2 and rad/s.   speed : m/s.
    jump : m by which fixes move back against the travel at 600 to 625 s, and return until 650 s.
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
    return cut_sections(track[::10], fixes[::10], t[::10], 0.3)


def test_level_track_of_a_circle_is_a_circle():
    turned = np.linspace(0.0, 2 * np.pi, 721)
    track = level_track(50.0 * turned, turned)
    np.testing.assert_allclose(track[[360, 720]], [[0.0, 100.0], [0.0, 0.0]], atol=1e-3)


def test_sections_are_long_enough_for_a_direction():
    t = np.arange(0.0, 100.0)
    p = np.stack([2.0 * t, np.zeros(100)], -1)
    found = cut_sections(7.0 * p, p, t, sigma=1.0)
    np.testing.assert_array_equal(found.length, np.full(9, 20.0))       # of 20 sigmas
    np.testing.assert_array_equal(found.heading_error, 0.0)
    np.testing.assert_array_equal(found.length_ratio, 1.0)       # for any unit of the track
    assert len(cut_sections(p * 0, p * 0, t, 1.0).t) == 0


@pytest.mark.parametrize(('begin', 'end'), [(500, 506), (200, 300), (0, 100), (1150, 1200)])
@pytest.mark.parametrize('drift', [0.0, 0.1 * DEG / 600])
def test_section_driven_backwards_is_found(begin, end, drift):
    found = winding([(begin, end)], drift)
    back = find_reversed(found)
    inside = (found.t > begin + 3.0) & (found.t < end - 3.0)
    outside = (found.t < begin - 3.0) | (found.t > end + 3.0)
    assert back[inside].all()
    assert not back[outside].any()
    (reason,) = reversal_reasons(found, signed=True)
    assert reason.code is Code.TRACK_MISMATCH
    assert f'in {back.sum()} of {len(back)} sections' in reason.text
    assert 'the counter does not count down' in reason.text
    assert 'odometer.signed is false' in reversal_reasons(found, signed=False)[0].text


def test_wrong_course_of_two_sections_does_not_reverse_the_rest():
    """Its start changes the direction by 136 deg, its end by less, as in a zoo drive."""
    off = np.deg2rad(np.repeat([-86.0, 138.0, -93.0], [60, 2, 50]))
    t = np.arange(len(off)) * 1.0
    found = CourseSections(t, off, *np.ones((3, len(t))))
    assert not np.delete(find_reversed(found), [60, 61]).any()


def test_gyro_errors_are_not_reversing_and_do_not_hide_it():
    # a bias that grows by 0.3 deg/s in 20 min: 180 deg in total
    found = winding(drift=0.3 * DEG / 1200)
    assert np.ptp(np.unwrap(found.heading_error)) > 3.0
    assert reversal_reasons(found, signed=True) == ()
    # a robot at 0.3 m/s: a bias of 1 deg/s turns the track by 30 deg per section
    slow = {'bias': DEG, 'speed': 0.3, 'seconds': 4000.0}
    assert not find_reversed(winding(**slow)).any()
    # 120 m in sections of 10 m or more
    assert 9 <= find_reversed(winding([(2000.0, 2400.0)], **slow)).sum() <= 12


@pytest.mark.parametrize('drift', [0.0, 0.3 * DEG / 1200])
def test_fixes_that_move_back_and_return_are_not_reversing(drift):
    """At 10 m/s against 5 m/s of travel: the fixes go back as far as the odometer advances."""
    found = winding(drift=drift, jump=250.0)
    inside = (found.t > 600.0) & (found.t < 625.0)
    assert inside.sum() > 5
    np.testing.assert_allclose(found.length_ratio[inside], 1.0, atol=0.2)
    assert reversal_reasons(found, signed=True) == ()
    # the same sections, but the fixes do not return
    stay = found.t < 626.0
    assert reversal_reasons(CourseSections(*(x[stay] for x in found)), signed=True)


def test_error_that_disappears_after_a_turn_is_not_reversing():
    """The fixes move back while the vehicle drives east, and catch up while it drives north."""
    path = np.arange(0.0, 1200.0, 5.0)
    true = np.stack([np.minimum(path, 600.0), np.maximum(path - 600.0, 0.0)], -1)
    error = np.stack([-np.interp(path, [460.0, 500.0, 700.0, 800.0], [0.0, 80.0, 80.0, 0.0]),
                      0.0 * path], -1)
    found = cut_sections(true, true + error, path / 10.0, 0.3)
    assert 2 <= (np.abs(found.heading_error) > 3.0).sum() <= 4
    assert not find_reversed(found).any()
    # if they do not catch up, it is reversing
    error[path > 500.0] = error[path == 500.0]
    assert 2 <= find_reversed(cut_sections(true, true + error, path / 10.0, 0.3)).sum() <= 4


def test_fixes_that_jump_have_no_direction():
    found = winding()
    jumps = np.isin(np.arange(len(found.t)), (40, 41))
    # back by 60 m while the vehicle advances by 20 m
    found = found._replace(heading_error=found.heading_error + np.pi * jumps,
                           length_ratio=np.where(jumps, 0.33, found.length_ratio))
    assert reversal_reasons(found, signed=True) == ()


def test_forwards_is_the_direction_of_most_sections_after_a_gap_without_heading():
    found = winding()
    late = found.t > 800.0
    noisy = found.heading_error + np.random.default_rng(2).normal(0.0, 0.1, len(found.t))
    turned = found._replace(heading_error=noisy + np.pi * late, t=found.t + 60.0 * late)
    assert not find_reversed(turned).any()
    turned = turned._replace(heading_error=found.heading_error + np.pi * late)
    assert find_reversed(turned).sum() == late.sum()
