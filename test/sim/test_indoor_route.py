# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""A small robot indoors: what its route holds, and what its references err by."""

import numpy as np
import pytest

from odocal_ros.bagio.read import open_bag
from odocal_ros.bagio.write import drive_topics, write_bag
from odocal_ros.data.samples import LOCAL
from odocal_ros.library.read_bag import read_bag
from odocal_ros.sim.options import resolved
from odocal_ros.sim.references import drift, REFERENCES
from odocal_ros.sim.scenarios import motion_of, SimOptions, simulate

pytestmark = pytest.mark.core
LOCAL_KINDS = [kind for kind in REFERENCES if kind != 'fix']


def indoor(**options):
    return simulate(SimOptions(scenario='indoor', **{'imu_rate': 20.0} | options))


@pytest.mark.parametrize('seed', range(10))
@pytest.mark.parametrize('duration', [30.0, 180.0])
def test_a_robot_drives_straight_in_arcs_and_turns_on_the_spot(seed, duration):
    motion = motion_of(resolved(SimOptions(scenario='indoor', seed=seed, duration=duration)))
    assert motion.duration == pytest.approx(duration)
    state = motion.at(np.arange(0.0, duration, 0.05))
    assert state.speed.min() >= 0.0
    assert state.speed.max() <= 1.2
    assert np.abs(state.yaw_rate).max() < 1.3
    still = (state.speed == 0.0) & (state.yaw_rate == 0.0)
    assert still[:100].all()            # 5 s before and after
    assert still[-100:].all()
    spot = (state.speed == 0.0) & (state.yaw_rate != 0.0)
    assert spot.any()
    assert ((state.speed > 0.1) & (state.yaw_rate == 0.0)).any()
    if duration > 100.0:
        assert {-1.0, 1.0} <= set(np.sign(state.yaw_rate[spot]))
        assert ((state.speed > 0.1) & (state.yaw_rate != 0.0)).any()


@pytest.mark.parametrize('kind', LOCAL_KINDS)
def test_a_bag_holds_the_positions_that_the_leg_has(kind, tmp_path):
    made = indoor(duration=40.0, reference=kind)
    leg, topic = made.leg(), REFERENCES[kind].topic
    bag = write_bag(tmp_path / 'bag', drive_topics(made))
    with open_bag(bag) as opened:
        assert topic in opened.topics
        assert {'/odometer/left', '/odometer/right'} <= set(opened.topics)
    fix = read_bag(bag, {'imu': '/imu/data', 'odometer': '/odometer/left',
                         'fix': topic}).samples('fix')
    assert (fix.status == LOCAL).all()
    for name in ('stamp_ns', 'latitude', 'longitude', 'height', 'covariance_n',
                 'covariance_type'):
        assert np.array_equal(getattr(fix, name), getattr(leg.fix, name)), name
    if REFERENCES[kind].planar:
        assert (made.positions()[:, 2] == 0.0).all()
        assert (fix.covariance_n[:, 2, 2] == 0.0).all()


@pytest.mark.parametrize(('kind', 'sigma'), [('mocap', 1e-3), ('total_station', 2e-3)])
def test_errors_have_the_size_of_the_kind(kind, sigma):
    exact = indoor(duration=180.0, reference=kind, fix_sigma=0.0).positions()
    error = indoor(duration=180.0, reference=kind).positions() - exact
    # 1800 rows or more: 5 sigma of a standard deviation are 9 %
    assert error[:, :2].std() == pytest.approx(sigma, rel=0.1)


def test_amcl_keeps_its_error_at_rest_and_forgets_it_with_the_path():
    options = resolved(SimOptions(scenario='indoor', reference='amcl'))
    t = np.arange(0.0, 20_000.0, 1.0)
    travel = np.where(t < 10_000.0, 0.0, t - 10_000.0)
    error = drift(t, travel, options)
    assert np.ptp(error[t < 10_000.0], axis=0) == pytest.approx(0.0)
    # sqrt(2 m / 2) of path; 5000 independent values
    assert error[t > 10_000.0, :2].std() == pytest.approx(0.05, rel=0.1)
    assert (error[:, 2] == 0.0).all()


def test_slam_drifts_with_the_path_and_jumps_back():
    t = np.arange(0.0, 3000.0, 0.1)
    free = resolved(SimOptions(scenario='indoor', closure_time=0.0))
    closing = resolved(SimOptions(scenario='indoor'))
    steps = np.diff(drift(t, t, free)[:, :2], axis=0)       # at 1 m/s
    assert steps.std() == pytest.approx(0.01 * np.sqrt(0.1), rel=0.02)
    error = drift(t, t, closing)[:, :2]
    # between closures 30 s apart, in the mean: sqrt(30 m) of walk
    assert 0.02 < np.abs(error).max() < 0.3
    jumps = np.hypot(*np.diff(error, axis=0).T) > 0.02
    assert 40 < jumps.sum() < 100       # of 100 closures, those that have something to close


def test_wheels_slip_in_turns_on_the_spot_too():
    made, bare = (indoor(seed=4, duration=60.0, slip_walk=slip) for slip in (1e-3, 0.0))
    state = made.motion.at((made.odometer.stamp_ns - made.options.start_ns) * 1e-9)
    spot = (state.speed == 0.0) & (state.yaw_rate != 0.0)
    slip = np.diff(made.odometer.value - bare.odometer.value)
    assert slip[spot[1:]].any()
    assert not slip[(state.speed == 0.0)[1:] & (state.yaw_rate == 0.0)[1:]].any()
