# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The running estimate of a robot without an IMU."""

from cells import thinned
import pytest

from odocal_ros.errors import BadData
from odocal_ros.forecast.forecast import Abandoned
from odocal_ros.forecast.smoother_forecast import planar_forecast
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.settings.config import Config, with_settings
from odocal_ros.sim.scenarios import SimOptions, simulate

CONFIG = with_settings(Config(), {'odometer.left': 'topic', 'odometer.right': 'topic'})


@pytest.fixture(scope='module')
def leg():
    return simulate(SimOptions(scenario='indoor', duration=110.0, imu=False, reference='mocap',
                               fix_rate=10.0, slip_walk=5e-4, seed=3)).leg()


def forecast(leg, seconds, wanted=lambda: True):
    return planar_forecast(thinned(leg, seconds).leg(leg.start_ns), CONFIG, wanted)


def test_the_last_update_is_near_the_result(leg):
    """Its samples are cells of 0.1 s, within which the speed changes: measured, 0.75 sigma."""
    found, result = forecast(leg, 1e9), calibrate(leg, CONFIG)
    for name in ('scale_factor', 'scale_factor_left', 'track_width'):
        now, then = found.estimates[name], result.methods['planar'].estimates[name]
        assert abs(now.value - then.value) < then.sigma
        assert now.sigma == pytest.approx(then.sigma, rel=0.15)
    assert found.scale.metres == 0.0
    assert found.complete
    assert not found.faults
    assert 'yaw: not estimated on this robot' in found.words()


def test_the_distance_to_go_is_by_the_root_of_the_path(leg):
    """Nine times the variance that is required: eight times the path more."""
    result = calibrate(leg, CONFIG)
    scale = result.methods['planar'].estimates['scale_factor']
    strict = with_settings(CONFIG, {'verdict.max_scale_sigma': scale.sigma / scale.value / 3})
    found = planar_forecast(leg, strict, lambda: True)
    assert found.scale.metres == pytest.approx(8 * result.distance, rel=1e-6)


def test_before_the_first_motion_there_is_none(leg):
    with pytest.raises(BadData, match='positions while the wheels have data'):
        forecast(leg, 0.0)


def test_an_update_that_nobody_wants_ends(leg):
    with pytest.raises(Abandoned):
        forecast(leg, 1e9, lambda: False)
