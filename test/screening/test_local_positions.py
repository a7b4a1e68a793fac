# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Positions in a local frame that are not in metres, or whose z axis is not up, are refused."""

from dataclasses import replace
import re

import drives
import numpy as np
import pytest

from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.geodesy import geodetic_from_local
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.settings.config import with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

Y_UP = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])


@pytest.fixture(scope='module', params=[True, False], ids=['imu', 'wheels'])
def run(request):
    """Return a run on a level floor, settings, and its positions: (k, 3) m."""
    made = simulate(SimOptions(scenario='indoor', duration=60.0, seed=3, imu_rate=50.0,
                               reference='mocap', imu=request.param))
    fix = made.leg().fix
    geodetic = np.stack([fix.latitude, fix.longitude, fix.height], -1)
    return made.leg(), drives.configured(made), Origin(*geodetic[0]).to_n(geodetic)


def reasons_of(leg, config, position):
    latitude, longitude, height = geodetic_from_local(position, np.nan)
    fix = replace(leg.fix, latitude=latitude, longitude=longitude, height=height)
    return calibrate(replace(leg, fix=fix), config).reasons


def test_positions_with_y_up_have_heights_as_far_apart_as_x(run):
    leg, config, _ = run
    t = (leg.fix.stamp_ns - leg.fix.stamp_ns[0]) * 1e-9
    position = np.stack([2 * np.cos(t / 5), 2 * np.sin(t / 10), 1e-3 * np.sin(9 * t)], -1)
    *_, reason = reasons_of(leg, config, position @ Y_UP.T)
    assert reason.code is Code.FIXES_UNUSABLE
    # x and y of the figure; its ends are in means over 1.2 s, 1 % less
    found = re.fullmatch('heights of the positions vary by (.*) m, x and y by (.*) m: .*',
                         reason.text)
    np.testing.assert_allclose([float(size) for size in found.groups()], 4.0, rtol=0.01)


@pytest.mark.parametrize('unit', [100.0, 1000.0])
def test_positions_in_cm_and_mm_move_too_far_for_the_odometer(run, unit):
    leg, config, position = run
    *_, reason = reasons_of(leg, config, position * unit)
    assert reason.code is Code.FIXES_UNUSABLE
    assert 'one of them in mm or cm, or a wrong odometer.nominal_scale' in reason.text
    # the ratio in the text is that of metres times the unit
    ratio = float(reason.text.split()[2])
    *_, wrong = reasons_of(leg, with_settings(config, {
        'odometer.nominal_scale': config.odometer.nominal_scale / unit}), position)
    assert ratio == pytest.approx(float(wrong.text.split()[2]), rel=0.05)    # other sections
