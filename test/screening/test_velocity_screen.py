# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0


"""A velocity is used where it is that of the fixes."""

from dataclasses import replace

from drives import changed, settings
import numpy as np
import pytest

from odocal_ros.reasons import Code
from odocal_ros.screening.screen import screen
from odocal_ros.sim.scenarios import SimOptions, simulate


@pytest.fixture(scope='module', params=['town', 'straight'])
def drive(request):
    return simulate(SimOptions(scenario=request.param, duration=200.0, imu_rate=50.0,
                               velocity_sigma=0.05, velocity_delay=0.2))


def screened(drive, change, **options):
    leg = drive.leg()
    leg = replace(leg, fix_velocity=changed(leg.fix_velocity, velocity_n=change))
    inputs, found = screen(leg, settings(drive, None, **options))
    said = [r.text for r in found if r.code is Code.VELOCITY_UNUSABLE]
    assert len(said) == (not len(inputs.t_velocity))
    return said


@pytest.mark.parametrize('factor', [1.0, 1.05, 0.95])
def test_that_of_the_fixes_is_used(drive, factor):
    assert not screened(drive, lambda v: np.multiply(v, factor, out=v))


def test_wheel_speeds_units_and_axes_are_found(drive):
    def forward(v):
        v[:] = np.linalg.norm(v, axis=1)[:, None] * [1.0, 0.0, 0.0]

    def down(v):            # north, east: on a road to the north-east the same
        v[:, :2] = v[:, 1::-1] * [1.0, -1.0]

    for change in (forward, down, lambda v: np.multiply(v, 3.6, out=v),
                   lambda v: np.negative(v, out=v)):
        assert 'contradicts the fixes' in screened(drive, change)[0]


def test_nothing_is_said_of_a_velocity_that_is_not_wanted(drive):
    leg = drive.leg()
    leg = replace(leg, fix_velocity=changed(leg.fix_velocity, velocity_n=lambda v: v.fill(9.0)))
    _, found = screen(leg, settings(drive, None, gnss__use_velocity=False))
    assert Code.VELOCITY_UNUSABLE not in {r.code for r in found}


def test_a_vehicle_that_stands_says_nothing(drive):
    leg = drive.leg()
    keep = leg.fix.stamp_ns < drive.options.start_ns + 5 * 10**9
    still = replace(leg, fix=type(leg.fix)(*(getattr(leg.fix, f)[keep] for f in (
        'stamp_ns', 'received_ns', 'latitude', 'longitude', 'height', 'covariance_n',
        'covariance_type', 'status'))))
    inputs, _ = screen(still, settings(drive, None))
    assert len(inputs.t_velocity)
