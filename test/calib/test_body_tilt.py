# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The tilt of the body, by slopes, banks and suspension, displaces the odometer."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from smoother_legs import along_axis, at_truth, pitch_increments

from odocal_ros.estimator import state as layout
from odocal_ros.estimator.equations import Equations
from odocal_ros.estimator.factors.axle import follow_hills, HILL_WEIGHTS, separate_tilts
from odocal_ros.estimator.factors.body_tilt import BodyTilt
from odocal_ros.estimator.factors.motion import D
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.wheels import G

# away from the ends, where fewer values determine a parabola
INSIDE = slice(HILL_WEIGHTS.size, -HILL_WEIGHTS.size)
BUMP_GAIN = 0.0995      # of parabolas, period of 2.5: (7 + 12 cos w + 6 cos 2w - 4 cos 3w) / 21


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
    np.testing.assert_allclose(pitch_increments(motion)[steady, 2], want[steady], atol=5e-3)


def lateral_acceleration(motion, state):
    """Return the acceleration to the left by speed and turn rate, (K,), and where it is steady."""
    speed = np.linalg.norm(state.v_n, axis=1)
    turning = motion.rate_n[:, 2] * (speed[1:] + speed[:-1]) / 2
    assert np.abs(turning).max() > 2.0
    return turning, np.abs(np.gradient(motion.rate_n[:, 2])) < 0.01


def test_side_force_of_the_tyres_includes_gravity_on_a_bank():
    """The bank balances the lateral force."""
    _, problem, state = at_truth(real=RealEffects(banking=1.0))
    motion = Equations(problem, state).factors['motion'].motion
    turning, steady = lateral_acceleration(motion, state)
    left_up = np.einsum('ki,i->k', state.C_nb[:, 2], state.C_bv[:, 1])
    want = turning + G * follow_hills((left_up[1:] + left_up[:-1]) / 2)
    # up to a constant: the bank without lateral acceleration
    off = motion.yaw_lean[:, 0] - want
    assert np.abs(off[steady] - np.median(off)).max() < 0.1 * np.abs(turning).max()
    assert np.abs(motion.yaw_lean[steady, 0]).max() < 0.3 * np.abs(turning).max()


def test_side_force_of_the_tyres_does_not_include_the_roll_of_the_body():
    """A body that rolls outwards in turns on level ground does not make a bank."""
    by_force = 0.01     # rad per m/s^2: as a bank it would add a tenth
    _, problem, state = at_truth(real=RealEffects(body_roll=by_force))
    motion = Equations(problem, state).factors['motion'].motion
    turning, steady = lateral_acceleration(motion, state)
    np.testing.assert_allclose(motion.yaw_lean[steady, 0], turning[steady],
                               atol=0.02 * np.abs(turning).max())
    _, roll = motion.axle.rolls()
    np.testing.assert_allclose(roll[1:][steady], by_force * motion.axle.left_acceleration[1:][
        steady], atol=0.05 * by_force * np.abs(turning).max())


def test_tilts_of_ground_and_body_are_separated_by_force_and_duration():
    """Springs react to the acceleration and to gravity on the ground; bumps are short."""
    k, by_force = np.arange(601), 0.015
    ground, acceleration = 0.03 * np.sin(2 * np.pi * k / 60), 2.0 * np.sign(np.sin(k / 7.0))
    bump = 0.01 * np.sin(2 * np.pi * k / 2.5)
    body = by_force * (acceleration + G * ground) + bump
    both = separate_tilts(0.1 + ground + body, acceleration, np.ones(len(k)))
    # ground and acceleration correlate a little, the mean of each is not exactly zero
    for found, true in zip(both, (ground, body), strict=True):
        np.testing.assert_allclose(found[INSIDE], true[INSIDE], atol=1.2 * BUMP_GAIN * 0.01 + 1e-3)
    inwards = -0.02 * (acceleration - acceleration.mean())
    bank, body = separate_tilts(inwards, acceleration, np.ones(len(k)))
    np.testing.assert_allclose(bank, follow_hills(inwards), atol=1e-12)
    np.testing.assert_allclose(body, inwards - bank, atol=1e-12)


def test_body_tilts_about_its_centre_by_bumps_and_force_but_not_by_a_bank():
    """The centre is 0.4 m above ground; the IMU at 1.5 m moves with bank, bumps and force."""
    _, _, state = at_truth(60.0)
    k, height, by_force, size = np.arange(len(state.t)), 0.4, 0.01, 0.02
    bank, bump = 0.05 * np.sin(2 * np.pi * k / 60), size * np.sin(2 * np.pi * k / 2.5)
    force = 2.0 * np.cos(2 * np.pi * k / 60)        # m/s^2
    roll = bank + bump + by_force * force
    road, body = (matrix_from_rpy(np.stack([angle, 0 * k, 0 * k], -1)) for angle in (bank, roll))
    imu, centre = np.array([0.0, 0.0, 1.5]), np.array([0.0, 0.0, height])
    p_n = road @ centre + body @ (imu - centre)
    state = replace(state, C_nb=body, up_b=np.eye(3)[2], constants=0 * state.constants)
    moved = np.diff(p_n - body @ imu, axis=0)       # of the body point at the ground
    acceleration = force - G * bank
    rolls = separate_tilts(np.sin(roll), acceleration, np.ones(len(k)))
    axle = SimpleNamespace(rolls=lambda: rolls, body_pitch=lambda: 0 * roll,
                           left_acceleration=acceleration)
    tilt = BodyTilt(state, np.zeros((len(k) - 1, 3)), axle)
    found = tilt.displacements[:, :, 3] * height
    assert np.abs(moved[INSIDE, 1]).max() > 0.01
    # the part of bumps that parabolas follow, up and down
    np.testing.assert_allclose(found[INSIDE, :2], moved[INSIDE, :2],
                               atol=1.2 * 2 * BUMP_GAIN * size * height)
    np.testing.assert_allclose(tilt.displacements[INSIDE, 1, 4], np.diff(force)[INSIDE],
                               atol=G * 1.2 * 2 * BUMP_GAIN * size)


def test_bumps_may_have_a_different_tilt_centre_than_hills():
    _, problem, state = at_truth(slope=0.05)
    motion = Equations(problem, state).factors['motion'].motion
    hill, bump = (np.sin(2 * np.pi * np.arange(len(motion.T)) / period) for period in (40.0, 2.5))
    assert follow_hills(hill)[INSIDE] == pytest.approx(hill[INSIDE], abs=1e-3)
    assert follow_hills(bump)[INSIDE] == pytest.approx(-BUMP_GAIN * bump[INSIDE], abs=1e-4)
    body = pitch_increments(motion)[:, 1]
    assert body == pytest.approx(-np.diff(motion.axle.body_pitch()))
