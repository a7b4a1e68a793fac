# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Steps of the fit: damped where they would oscillate, and cut off at the limit of passes."""

from dataclasses import dataclass

import numpy as np
from numpy.testing import assert_allclose
import pytest
from smoother_legs import made

from odocal_ros.estimator import smooth
from odocal_ros.estimator.fit import damped
from odocal_ros.reasons import Code
from odocal_ros.settings.config import with_settings


@dataclass(frozen=True)
class Step:
    """What ``damped`` reads of a solution."""

    step: np.ndarray
    step_border: np.ndarray
    reduced: np.ndarray
    taken: float = 1.0


def walked(slope, passes):
    """Return how far off an iteration is whose steps are ``slope`` times what is left."""
    off, taken = np.array([1.0, -0.5]), np.zeros(2)
    for _ in range(passes):
        step = -slope * off
        found = damped(Step(step[None, :], step, np.diag([4.0, 1.0])), taken)
        assert_allclose(found.step[0], found.step_border)
        taken = found.step_border
        off = off + taken
    return float(np.abs(off).max())


def test_steps_that_would_oscillate_are_damped_and_others_taken_as_they_are():
    # a step twice too long turns back on itself whole: half of it leads to the zero
    assert walked(2.0, 1) == pytest.approx(1.0)
    assert walked(2.0, 2) < 1e-12
    assert walked(0.4, 3) == pytest.approx(0.6**3)
    back = np.array([-2.0, 1.0])
    assert damped(Step(back[None, :], back, np.eye(2)), -back).taken == pytest.approx(0.5)
    step = np.array([3.0, -1.0])
    found = damped(Step(step[None, :], step, np.eye(2)), np.zeros(2))
    assert np.array_equal(found.step_border, step)


def test_at_the_limit_of_passes_the_best_so_far_is_stated_with_a_wider_sigma():
    drive, config, leg = made(duration=200.0, imu_grade='consumer', fix_noise='white')
    whole = smooth(leg, config)
    few = smooth(leg, with_settings(config, {'leg.compute_limit': 5}))
    assert few.details['iterations'] == 5
    said = {r.code: r.text for r in few.reasons}
    assert 'after 5 iterations the estimates still changed' in said[Code.MODEL_MISMATCH]
    a, b = (m.estimates['scale_factor'] for m in (whole, few))
    assert b.sigma > 1.5 * a.sigma
    assert abs(b.value - drive.truth.scale) < 4 * b.sigma
