# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Axes of the IMU in the vehicle from gravity and accelerations, and their remedy."""

import json
import math
import re

from inspect_output import G, planar, RATE
import numpy as np
import pytest

from odocal_ros.calib.mounting import estimate_mounting, remedy
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import matrix_from_rpy


def test_an_unobservable_forward_axis_is_assumed_or_left_open():
    t = np.arange(0, 100, 0.02)
    travel = Travel(t, 10.0 * t, 0.0)               # steady: no acceleration
    rng = np.random.default_rng(1)
    w_i = rng.normal(0, 1e-3, (len(t), 3))
    for up, rpy in (((0, 0, G), [0, 0, 0]), ((0, 0, -G), [math.pi, 0, 0]), ((0, G, 0), None)):
        m = estimate_mounting(t, w_i, np.array(up) + rng.normal(0, 0.05, (len(t), 3)), travel, 1.0)
        assert m.assumed
        assert m.rpy == (rpy and pytest.approx(rpy))
    # the remedy lists the setting for each axis that may point forward
    possible = re.findall(r'([-+])([xz]): (\[.*?\])', remedy(m))
    assert len(possible) == 4
    for sign, axis, rpy in possible:
        forward = float(f'{sign}1') * np.eye(3)['xyz'.index(axis)]
        np.testing.assert_allclose(
            matrix_from_rpy(json.loads(rpy)) @ np.stack([forward, [0, 1, 0]], -1),
            np.eye(3)[:, [0, 2]], atol=1e-8)


def test_axes_far_from_quarter_turns_are_reported_as_measured():
    t, v, w, a = planar()
    C_bi = matrix_from_rpy([0.0, 0.0, math.radians(45)])
    f_b = np.stack([a, v * w, np.full(len(t), G)], -1)
    w_b = np.stack([0 * w, 0 * w, w], -1)
    m = estimate_mounting(t, w_b @ C_bi, f_b @ C_bi, Travel(t, np.cumsum(v) / RATE, 0.0), 1.0)
    assert m.rpy is None
    remedy_text = remedy(m)
    assert 'The IMU axes are 45 deg from quarter turns (limit 30 deg)' in remedy_text
    assert json.loads(re.search(r'\[.*\]', remedy_text)[0]) == pytest.approx([0, 0, 0.785],
                                                                             abs=0.02)
