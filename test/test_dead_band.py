# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Speeds that are sent as zero below a dead band: the way in it is put back, and doubted."""

import numpy as np
import pytest

from odocal_ros.data.samples import OdometerForm
from odocal_ros.nav.odometer import travel
from odocal_ros.screening.odometer_care import with_uncertainty

RATE = OdometerForm('rate', 0, '1')
T = np.arange(0.0, 300.0, 0.05)
# to and fro, each stop and start at an acceleration of its own
CORNERS = np.cumsum(np.tile([3.0, 1.5, 6.0, 2.1], 20))
SPEED = np.interp(T, np.r_[0.0, CORNERS], np.r_[0.0, np.tile([0.0, 1.7, 1.7, 0.0], 20)])
SPEED[CORNERS[39] < T] *= -1
BAND = 0.25


def of(value, **how):
    way, _ = travel(T, value, RATE, **how)
    return with_uncertainty(way, value, RATE)


@pytest.mark.parametrize('reversed_counts', [False, True])
def test_the_way_below_the_band_is_put_back(reversed_counts):
    sent = np.where(np.abs(SPEED) < BAND, 0.0, SPEED)
    way, t, sigma = of(sent, reversed_counts=reversed_counts)
    true, _ = travel(T, SPEED, RATE, reversed_counts=reversed_counts)
    raw, _ = travel(T, sent, RATE, reversed_counts=reversed_counts)
    lost = np.abs(np.diff(raw.s)).sum() - np.abs(np.diff(true.s)).sum()
    left = np.abs(np.diff(way.s)).sum() - np.abs(np.diff(true.s)).sum()
    assert lost < -0.8          # 40 times v^2 / 2a
    # a band ends within a row: half a row's speed of 1.1 m/s^2, of 0.25 m/s
    assert abs(left) < 0.11 * abs(lost)
    # each is doubted by half of it, where it is
    assert sigma.sum() == pytest.approx(abs(lost) / 2, rel=0.11)
    at = np.interp(t, T, np.abs(SPEED))
    assert (at < BAND + 0.1).all()


def test_a_speed_that_falls_to_zero_stays_as_it_is():
    way, t, _ = of(SPEED)
    np.testing.assert_array_equal(way.s, travel(T, SPEED, RATE)[0].s)
    assert not len(t)
