# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The tilt of the body, by slopes, banks and suspension, displaces the odometer."""

from dataclasses import replace

import numpy as np
import pytest
from smoother_legs import along_axis, at_truth

from odocal_ros.estimator import state as layout
from odocal_ros.estimator.equations import Equations
from odocal_ros.estimator.factors.body_tilt import BodyTilt, HILL_INTERVALS, moving_mean
from odocal_ros.estimator.factors.motion import D
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.wheels import G


def test_body_pitches_about_the_middle_of_the_wheelbase_on_a_crest():
    """The remaining error is the curvature of the road within the wheelbase: (h / length)^2."""
    _, problem, state = at_truth(slope=0.1, scale=1e-3, nominal_scale=1e-3,
                                 real=RealEffects(wheelbase=3.0))
    off, by = along_axis(problem, state, 2, layout.BODY_TILT)
    by = by[:, 0]
    centre = -(by @ off) / (by @ by)
    assert np.abs(off).max() > 1e-3       # m in one second
    assert centre == pytest.approx(1.5, rel=0.02)
    assert np.sqrt(((off + by * centre)**2).mean()) < 0.05 * np.sqrt((off**2).mean())
    # the lift of the odometer is no wheel travel: the scale does not multiply it
    c = state.constants.copy()
    c[layout.BODY_TILT.start] = centre
    there, here = (
        Equations(problem, one).factors['motion'].jacobians(layout.SIZE_WITHOUT_SLOW)[2]
        for one in (replace(state, constants=c), state))
    np.testing.assert_allclose(there[:, D, layout.LN_K], here[:, D, layout.LN_K], atol=1e-9)


@pytest.mark.parametrize('banking', [0.0, 1.0])
def test_turn_on_banked_ground_pitches_the_vehicle_about_its_left_axis(banking):
    """The bank balances the lateral force: the road leans inwards by the angle to gravity."""
    _, problem, state = at_truth(real=RealEffects(banking=banking))
    motion = Equations(problem, state).factors['motion'].motion
    rate, speed = motion.rate_n[:, 2], np.linalg.norm(state.v_n, axis=1)[:-1]
    want = -rate * motion.T[:, 0] * np.sin(np.arctan(banking * speed * rate / G))
    steady = np.abs(np.gradient(rate)) < 0.01        # the lean is that at the start
    assert np.abs(want[steady]).max() >= 0.06 * banking
    np.testing.assert_allclose(motion.tilt.pitch_increments[steady, 2], want[steady], atol=5e-3)


def test_side_force_of_the_tyres_includes_gravity_on_a_bank():
    """The bank balances the lateral force, as a mean over HILL_INTERVALS."""
    _, problem, state = at_truth(real=RealEffects(banking=1.0))
    motion = Equations(problem, state).factors['motion'].motion
    speed = np.linalg.norm(state.v_n, axis=1)
    turning = motion.rate_n[:, 2] * (speed[1:] + speed[:-1]) / 2
    left_up = np.einsum('ki,i->k', state.C_nb[:, 2], state.C_bv[:, 1])
    want = turning + G * moving_mean((left_up[1:] + left_up[:-1]) / 2)
    assert np.abs(turning).max() > 2.0
    # up to a constant: the bank without lateral acceleration
    off = motion.lean_accelerations[:, 1] - want
    steady = np.abs(np.gradient(motion.rate_n[:, 2])) < 0.01
    assert np.abs(off[steady] - np.median(off)).max() < 0.1 * np.abs(turning).max()
    assert np.abs(motion.lean_accelerations[steady, 1]).max() < 0.3 * np.abs(turning).max()


def test_body_tilts_about_its_centre_by_bumps_and_force_but_not_by_a_bank():
    """The centre is 0.4 m above ground; the IMU at 1.5 m moves with bank, bumps and force."""
    _, _, state = at_truth(60.0)
    k, height, by_force = np.arange(len(state.t)), 0.4, 0.01
    bank, bump = 0.05 * np.sin(2 * np.pi * k / 60), 0.02 * np.sin(2 * np.pi * k / 2.5)
    force = 2.0 * np.cos(2 * np.pi * k / 60)        # m/s^2
    road, body = (matrix_from_rpy(np.stack([roll, 0 * k, 0 * k], -1))
                  for roll in (bank, bank + bump + by_force * force))
    imu, centre = np.array([0.0, 0.0, 1.5]), np.array([0.0, 0.0, height])
    p_n = road @ centre + body @ (imu - centre)
    state = replace(state, C_nb=body, up_b=np.eye(3)[2], constants=0 * state.constants)
    moved = np.diff(p_n - body @ imu, axis=0)       # of the body point at the ground
    tilt = BodyTilt(state, np.zeros((len(k) - 1, 3)), (force[1:] + force[:-1]) / 2)
    found = tilt.displacements[:, :, 3:5] @ [height, height * by_force]
    inside = slice(HILL_INTERVALS, -HILL_INTERVALS)
    assert np.abs(moved[inside, 1]).max() > 0.01
    # means over 5 samples of a period of 60 lack 1 % of bank and force; the arm turns by 0.1 rad
    np.testing.assert_allclose(found[inside, :2], moved[inside, :2], atol=0.01 * height * 0.1)


def test_bumps_may_have_a_different_tilt_centre_than_hills():
    _, problem, state = at_truth(slope=0.05)
    motion = Equations(problem, state).factors['motion'].motion
    hill, bump = (np.sin(2 * np.pi * np.arange(len(motion.T)) / period) for period in (40.0, 2.5))
    around = slice(HILL_INTERVALS, -HILL_INTERVALS)
    # the mean of five samples is 0 for a period of 2.5, and a sinc of 0.974 for a period of 40
    assert moving_mean(bump)[around] == pytest.approx(0.0, abs=1e-9)
    assert moving_mean(hill)[around] == pytest.approx(np.sin(np.pi / 8) / (5 * np.sin(np.pi / 40))
                                                      * hill[around])
    both, fast = motion.tilt.pitch_increments.T[:2]
    assert fast == pytest.approx(both - moving_mean(both))
