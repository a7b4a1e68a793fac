# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Where a leg has no turns to test it by, an ordinary road's sideways noise is believed."""

from dataclasses import replace

import numpy as np
import pytest
from smoother_legs import made, truth

from odocal_ros.estimator import bound, smooth
from odocal_ros.estimator.factors.slide import (
    HEAVE,
    least_slide,
    ORDINARY_ROAD,
    SIDEWAYS,
    TURN_SLIDE,
    turned,
)
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.prepare import problem_of
from odocal_ros.reasons import Code

pytestmark = pytest.mark.slow


def said(method):
    """Tell whether the result says that a road's noise was assumed."""
    return any(r.code is Code.PARAMETER_NOT_DETERMINED and 'turns faster than 3 deg/s add up'
               in r.text and 'is assumed' in r.text for r in method.reasons)


def straight(**options):
    return made(scenario='straight', duration=300.0, imu_grade='industrial', **options)


@pytest.mark.parametrize('sway', [0.0, 0.05])
def test_a_straight_drive_states_the_bound_of_an_ordinary_road(sway):
    drive, config, leg = straight(sway=sway)
    method = smooth(leg, config)
    # the road's noise in the place of what the fit made of the seconds
    levels = Levels.of_roots(method.details['noise']).but(
        **dict.fromkeys(SIDEWAYS, 0.05**2 / 10.0))
    sigma = np.sqrt(bound(leg, config, truth(drive, config, leg), levels)[1, 1])
    stated = method.estimates['yaw_mounting_angle'].sigma
    # linearised at the estimate and not at the truth, heavy tails: 3 %; a second sways
    # by a level known to 5 % of sqrt(1 / 2 / 200 s)
    assert stated == pytest.approx(sigma, rel=0.03 + 0.05)
    assert stated > 0.97 * sigma
    if not sway:
        assert said(method)


def test_a_leg_with_turns_tests_it_itself():
    _, config, leg = made(duration=200.0, imu_grade='industrial')
    method = smooth(leg, config)
    assert not said(method)
    # wheels that never slide: far below a road's; up and down springs and road do what they do
    noise = method.details['noise']
    assert max(noise['side'], noise['side_turn']) < ORDINARY_ROAD / 10
    assert method.details['noise']['up'] == pytest.approx(HEAVE)


def test_turns_are_those_driven_whatever_the_bias_of_the_gyro():
    drive, config, leg = made(duration=200.0, imu_grade='industrial')
    problem = problem_of(leg, config)
    t = problem.imu.t[problem.imu.key] + (drive.truth.start_ns - drive.options.start_ns) * 1e-9
    yaw = np.abs(np.diff(drive.motion.at(t).yaw))
    # slower than TURNING between turns: less than that rate for all the time
    assert turned(leg, problem.imu) == pytest.approx(yaw[yaw > 0.05].sum(), rel=0.02)
    biased = replace(leg, w_b=leg.w_b + [0.0, 0.0, 0.06])
    assert problem_of(biased, config).turned == pytest.approx(problem.turned, rel=0.02)
    assert straight_angle() == 0.0


def straight_angle():
    _, config, leg = straight()
    return problem_of(leg, config).turned


def test_the_least_falls_from_a_road_to_what_turns_can_test_without_a_step():
    angles = np.deg2rad(np.arange(0.0, 270.0))
    least = np.array([least_slide(a) for a in angles])
    assert least[:90] == pytest.approx(ORDINARY_ROAD)
    assert least[181:] == pytest.approx(TURN_SLIDE)
    # a factor of 80 over 90 deg: 5 % a degree
    assert np.abs(np.diff(np.log(least))).max() < np.log(ORDINARY_ROAD / TURN_SLIDE) / 90 * 1.001
