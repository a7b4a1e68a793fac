# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The path ratio of fixes and odometer does not depend on turns and reversing."""

from drives import configured, drive
import numpy as np
import pytest

from odocal_ros.nav.dead_reckoning import section_ratio
from odocal_ros.pipeline.prepare import prepare
from odocal_ros.screening.screen import screen

pytestmark = pytest.mark.core


def test_chords_of_a_circle_are_compared_with_those_of_its_path():
    """Chords of fixes and of the path on a circle shrink alike, the travel does not."""
    s = np.linspace(0.0, 100.0, 301)                # of a radius of 10
    path = 10 * np.stack([np.sin(s / 10), 1 - np.cos(s / 10)], -1)
    turned = path @ [[0.0, 1.0], [-1.0, 0.0]] * 0.7 + [3.0, -5.0]
    assert section_ratio(s, path, turned, 10.0) == pytest.approx(0.7, rel=1e-12)
    # a chord of 10 m on a radius of 7 m spans 2 asin(5 / 7) = 1.591 rad, 2 sin(x / 2) / x of it
    assert section_ratio(s, s[:, None], turned, 10.0) < 0.7 * 2 * (5 / 7) / 1.591
    assert section_ratio(s, path, 0 * turned, 10.0) is None


@pytest.mark.parametrize('seed', [1, 3, 4])
def test_reversing_in_a_yard_does_not_change_the_ratio(seed):
    """With RTK, whose 3 cm are 0.15 % of 20 m, and an industrial gyro: slopes, less than 1 %."""
    made = drive(scenario='yard', duration=300.0, fix_noise='rtk', imu_grade='industrial',
                 seed=seed)
    leg, config = made.leg(), configured(made)
    prepared, _ = prepare(leg, screen(leg, config)[0], config)
    assert prepared.path_ratio == pytest.approx(made.truth.scale, rel=0.01)
