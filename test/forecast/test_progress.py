# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Distance and standstill so far with impossible values; an IMU without accelerometer."""

import numpy as np
import pytest

from odocal_ros.data.samples import ImuSamples, OdometerForm, OdometerSamples, take
from odocal_ros.forecast.ability import ability
from odocal_ros.forecast.progress import Progress, Travel
from odocal_ros.settings.config import Config

SECOND = 10**9


@pytest.mark.core
@pytest.mark.parametrize('odd', [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize('quantity', ['cumulative', 'rate'])
def test_impossible_values_change_no_distance_and_no_standstill(odd, quantity):
    t = np.arange(0, 20 * SECOND, SECOND // 10)
    speed = np.where(t < 15 * SECOND, 2.0, 0.0)
    value = speed if quantity == 'rate' else np.cumsum(speed) * 0.1
    found = []
    for bad in ([], [20, 21, 100, 190]):
        sent = value.copy()
        sent[bad] = odd
        travel = Travel(OdometerForm(quantity, 0, '1'))
        for k in range(0, len(t), 3):
            travel.feed(take(OdometerSamples(t + SECOND, t + SECOND, sent), slice(k, k + 3)), 1.0)
        found.append((travel.total, travel.still_s(), travel.top))
    assert found[1] == pytest.approx(found[0], abs=0.2)
    assert found[0][0] == pytest.approx(30.0, abs=0.3)


@pytest.mark.core
def test_with_an_imu_without_accelerometer_only_the_scale_is_observable():
    stamps, rates = np.arange(1, 4) * SECOND, np.zeros((3, 3))
    progress = Progress()
    for force in (9.81, 0.0):
        progress.feed('imu', ImuSamples(stamps, stamps, rates, rates + force, np.zeros((3, 4)),
                                        np.full(3, np.nan)), Config(), None, 0.0)
        words = ability(Config(), progress.received_before(600.0)).words()
        assert ('observable: the scale; not observable: the yaw' in words) == (not force), words
        assert ('the pitch (IMU without acceleration)' in words) == (not force)
