# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A counter that counts otherwise from some point of the drive on."""

from dataclasses import replace

import numpy as np
import pytest

from odocal_ros.calib.counter_change import counter_change
from odocal_ros.calib.sections import Sections
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code, Verdict
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate


def found(ratio, sigma=1e-3):
    """Return what is said of ten sections of 100 m in 10 s each."""
    edges = np.linspace(0.0, 1000.0, len(ratio) + 1)
    parts = Sections(edges[:-1], edges[1:], np.array(ratio), np.full(len(ratio), sigma))
    return counter_change(parts, np.linspace(0.0, 100.0, 101), np.linspace(0.0, 1000.0, 101))


@pytest.mark.core
def test_it_is_found_where_it_is_and_with_its_factor():
    (reason,) = found([1.4] * 4 + [0.9] + [0.7] * 5)
    assert reason.code is Code.TRACK_MISMATCH
    assert '2.00 times as much per metre after t = 40 to 50 s' in reason.text
    assert '0.50 times' in found([0.7] * 4 + [0.9] + [1.4] * 5)[0].text


@pytest.mark.core
@pytest.mark.parametrize(('ratio', 'sigma'), [
    ([1.0] * 10, 1e-3), ([1.01] * 5 + [0.99] * 5, 1e-4), ([1.05] * 5 + [0.95] * 5, 0.05),
    ([1.0] * 4 + [0.7] + [1.0] * 5, 1e-3), (np.linspace(0.9, 1.1, 10), 1e-3),
    ([1.0] * 5 + [np.nan] * 5, 1e-3)],
    ids=['constant', 'tyres', 'uncertain', 'slip', 'drift', 'half'])
def test_what_else_changes_a_scale_is_none(ratio, sigma):
    assert found(ratio, sigma) == ()


@pytest.fixture(scope='module')
def town():
    return simulate(SimOptions(scenario='town', duration=240.0, seed=3, imu_rate=50.0,
                               odometer_rate=25.0, fix_noise='rtk'))


@pytest.mark.slow
@pytest.mark.parametrize('factor', [1, 2, 4])
def test_a_driver_that_decodes_each_edge_from_the_middle_of_the_drive_on(town, factor):
    leg = town.leg()
    step = np.diff(leg.odometer.value, prepend=leg.odometer.value[:1])
    late = leg.odometer.stamp_ns > (leg.start_ns + leg.stop_ns) // 2
    counts = leg.odometer.value[0] + np.cumsum(step * np.where(late, factor, 1))
    result = calibrate(replace(leg, odometer=replace(leg.odometer, value=counts)),
                       with_settings(Config(), {'imu.grade': town.options.imu_grade}))
    said = [r.text for r in result.reasons if f'{factor:.2f} times as much' in r.text]
    assert len(said) == (factor > 1)
    assert (result.verdict is Verdict.REJECTED) == (factor > 1)


@pytest.mark.parametrize(('size', 'more'), [
    (1 / 9.80665, 0.0), (0.0, 0.1), (2.0, 0.0), (1.0, [0.0, 9.8, 0.0])])
def test_an_accelerometer_changes_its_unit_or_range_but_not_in_a_bend_at_one_g(town, size, more):
    leg = town.leg()
    force = leg.imu.f_i.copy()
    late = leg.imu.stamp_ns > (leg.start_ns + 2 * leg.stop_ns) // 3
    force[late] = force[late] * size + more
    result = calibrate(replace(leg, imu=replace(leg.imu, f_i=force)), Config())
    said = [r.text[:9] for r in result.reasons if r.code is Code.IMU_UNITS]
    assert said == ['from t = '] * (size != 1.0)
    assert result.verdict is Verdict.REJECTED or size == 1.0
