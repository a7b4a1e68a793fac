# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tyres, wheels that steer, and the body on its springs change the scale and the pitch."""

from dataclasses import replace
import re

from drives import off
import numpy as np
import pytest
from smoother_legs import made, reason_texts

from odocal_ros.estimator import smooth
from odocal_ros.reasons import Code
from odocal_ros.settings.nominal import G
from odocal_ros.sim.real_effects import RealEffects
from odocal_ros.sim.wheels import steered_path

pytestmark = pytest.mark.slow
TOWN = {'scenario': 'town', 'duration': 250.0, 'imu_grade': 'industrial', 'sway': 0.05}
AHEAD = 6.0      # m
RTK = TOWN | {'fix_noise': 'rtk', 'fix_sigma': 0.01}


def test_scale_that_decreases_with_speed_is_not_attributed_to_tyres():
    _, config, leg = made(scenario='town', duration=300.0, imu_grade='industrial', seed=4,
                          fix_noise='rtk', real=RealEffects(speed_law=-0.006))
    falls = next(r for r in smooth(leg, config).reasons if r.code is Code.SCALE_VARIES)
    assert re.search('changes by -.* from low to high speed', falls.text)
    assert falls.remedy.startswith('Possible causes: truncated speed values')


@pytest.mark.parametrize('driven', [True, False])
def test_tyre_slip_in_one_direction_keeps_the_mean_scale_correct(driven):
    """A wheel without drive slips only in braking: half a slope per direction is 90 ppm."""
    drive, config, leg = made(**TOWN | {
        'fix_noise': 'rtk', 'fix_sigma': 0.01,
        'real': RealEffects(tyre_slip=0.035, driven=driven)})
    method = smooth(leg, config)
    assert off(method, drive) < 3.3
    assert method.estimates['scale_factor'].sigma / drive.truth.scale < 60e-6
    assert Code.WHEEL_SLIP not in {r.code for r in method.reasons}


def test_brakes_pitch_the_body_with_a_slope_of_their_own():
    """A body that dives by 1.8 deg/g and squats by 0.8: one slope moves the pitch by 1.5 sigma."""
    dive, squat = 0.018 / G, 0.014 / G      # rad per m/s^2, the first in addition
    drive, config, leg = made(**TOWN | {'duration': 400.0, 'fix_noise': 'rtk', 'fix_sigma': 0.01,
                                        'imu_grade': 'tactical', 'real': RealEffects(
                                            squat=squat, brake_dive=dive)})
    found = smooth(leg, config)
    assert off(found, drive, 'pitch_mounting_angle') < 3.0
    for name, true in (('squat', squat), ('dive', squat + dive)):
        value = found.details[name]
        assert abs(value['value'] + true) < 3.0 * value['sigma'] < dive / 2


@pytest.mark.parametrize(('share', 'seed'), [(1.0, 4), (0.5, 5)])
def test_wheels_that_steer_travel_farther_in_turns(share, seed):
    """Front wheels of a bus, 6 m ahead, and the mean of all four."""
    drive, config, leg = made(**TOWN | {'fix_noise': 'rtk', 'fix_sigma': 0.01, 'seed': seed})
    since = (drive.truth.start_ns - drive.options.start_ns) * 1e-9
    travel, scale = leg.travel, drive.truth.scale
    additional = share * steered_path(drive.motion.at(since + travel.t), (AHEAD, 0.0, 0.0)) / scale
    steered = replace(leg, travel=replace(travel, s=travel.s + additional))
    found = smooth(steered, config)
    within = (travel.t >= leg.t_begin) & (travel.t <= leg.t_stop)
    rolled, more = (np.ptp(np.abs(x[within])) for x in (travel.s, additional))
    assert more / rolled > 1e-4
    estimate = found.estimates['scale_factor']
    assert off(found, drive) < 3.0
    assert estimate.sigma < 0.3 * more / rolled * scale
    slope = found.details['beside']['scale_by_curvature']
    assert abs(slope['slope'] + share * AHEAD**2) < 3.0 * slope['sigma'] < 0.3 * share * AHEAD**2
    assert 'to the tightest turn' in reason_texts(found)[Code.SCALE_VARIES]
    assert Code.WHEEL_SLIP not in reason_texts(found)
