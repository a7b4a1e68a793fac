# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Noise levels the smoother finds are those of the simulation, at rest and in motion."""

from types import SimpleNamespace

import numpy as np
import pytest
from smoother_legs import made

from odocal_ros.estimator import smooth
from odocal_ros.estimator.factors.interval_noise import REST_NOISE, rest_noise
from odocal_ros.estimator.factors.travel_error import once_a_rest
from odocal_ros.estimator.imu_noise import at_rest
from odocal_ros.sim.real import Real

pytestmark = pytest.mark.slow
SWAY = {'sway': 0.05, 'odometer': 'speed', 'odometer_rate': 10.0, 'speed_noise': 0.05}


@pytest.mark.parametrize('noise', ['white', 'rtk'])
def test_levels_of_a_noisy_speed_and_a_swaying_vehicle_are_found(noise):
    _, config, leg = made(imu_grade='industrial', fix_noise=noise, duration=400.0, **SWAY)
    result = smooth(leg, config)
    level, scale = result.details['noise'], result.estimates['scale_factor'].value
    # what a second's way errs by: the walk, and a reading's own error at both of its ends
    along = np.hypot(level['along'], np.sqrt(2) * scale * level['travel'])
    # 0.05 m/s white at 10 Hz: 0.0158 m/sqrt(s); 150 seconds of even driving tell it: 5 sigma of
    # a standard deviation from so many are 29 %
    for name, found in (('along', along), ('side', level['side']), ('up', level['up'])):
        assert found == pytest.approx(0.05 / np.sqrt(10.0), rel=5 / np.sqrt(2 * 150)), name
    # no interval but chance ones is taken for a slip: the edges of stops are none
    assert result.details['residuals']['intervals_slipping'] <= 4


@pytest.mark.parametrize(('kerbs', 'least', 'most'), [(0.0, 0.0, 0.05), (0.06, 0.1, 1.0)])
def test_a_body_that_kerbs_pitch_lifts_its_axle(kerbs, least, most):
    # within a second by half a wheelbase at most, 0.25 m a rad; without kerbs it is as it begins
    _, config, leg = made(scenario='yard', duration=300.0, imu_grade='industrial',
                          fix_noise='rtk', real=Real(kerbs=kerbs, wheelbase=0.5))
    assert least < smooth(leg, config).details['noise']['pitching'] < most


def test_noise_at_rest_is_measured_where_there_is_rest_to_measure():
    rng = np.random.default_rng(4)
    way = np.concatenate([np.full(100, 9.0), 0.0158 * rng.standard_normal(100)])
    rest = np.arange(200) >= 100
    # 5 sigma of a variance from a hundred draws
    assert rest_noise(way, rest) == pytest.approx(0.0158**2, rel=5 * np.sqrt(2 / 100))
    assert rest_noise(way, rest & (np.arange(200) < 103)) == REST_NOISE**2
    assert rest_noise(np.zeros(200), rest) == REST_NOISE**2


@pytest.mark.parametrize(('loaded_s', 'most'), [(0, 1.2), (10, 2.0)])
def test_a_van_that_rocks_at_its_stops_has_no_noisy_accelerometer(loaded_s, most):
    """Stops of 20 s: the body is moved for half of each, and for 12 of its 18 differences."""
    rng = np.random.default_rng(4)
    signals = 1e-3 * rng.standard_normal((400, 6))
    signals[np.arange(400) % 40 < loaded_s, 5] += 0.03 * rng.standard_normal(10 * loaded_s)
    imu = SimpleNamespace(t=np.arange(401.0), key=np.arange(401), signals=None,
                          over_intervals=lambda _: signals)
    still = np.arange(401) % 40 <= 20
    sigma = at_rest(imu, SimpleNamespace(has_accelerometer=True), still)['accel']**0.5
    # 4 sigma of a quartile from 180 draws
    assert 0.75 * 1e-3 < sigma < most * 1e-3


def test_rounding_that_stands_counts_once():
    still = np.array([1, 1, 0, 0, 1, 0, 1, 1, 1], bool)
    assert once_a_rest(still) == pytest.approx([1/2, 1/2, 1, 1, 1, 1, 1/3, 1/3, 1/3])
    assert once_a_rest(np.zeros(3, bool)) == pytest.approx(1.0)


def test_a_counter_that_stands_is_no_slip_of_the_wheel():
    _, config, leg = made(imu_grade='industrial', fix_noise='rtk', duration=400.0)
    level = smooth(leg, config).details['noise']
    # wheels that never slip; the rounding, 5.8 mm, once a stop of a minute would be 0.75 mm
    assert level['along_hard'] < 6e-4
