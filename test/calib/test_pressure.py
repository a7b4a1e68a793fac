# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Heights by air pressure in the smoother."""

from dataclasses import replace

import numpy as np
import pytest
from smoother_legs import leg_of, made, truth

from odocal_ros.estimator import smooth
from odocal_ros.estimator.equations import Equations
from odocal_ros.estimator.prepare import problem_of
from odocal_ros.estimator.state import PRESSURE
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import with_settings

pytestmark = pytest.mark.slow
HILLS = {'slope': np.deg2rad(2.0), 'pressure_sigma': 0.15}
SHORT = {'duration': 240.0, 'imu_grade': 'consumer', 'fix_noise': 'correlated'} | HILLS


def rows_at(problem, state):
    return Equations(problem, state).parts['pressure']


def exact(**options):
    drive, config, _ = made(imu_grade='perfect', fix_sigma=0.0, duration=150.0,
                            **HILLS | {'pressure_sigma': 0.0}, **options)
    leg = replace(leg_of(drive.leg(), config), t_stop=60.0)
    return problem_of(leg, config), truth(drive, config, leg)


def test_rows_vanish_at_the_truth_but_for_the_constants():
    problem, state = exact()
    part = rows_at(problem, state)
    _, by_constants = part.jacobians(16)
    by = by_constants[:, 0, PRESSURE]
    left = part.raw[:, 0] - by @ np.linalg.lstsq(by, part.raw[:, 0], rcond=None)[0]
    # a mean of twenty heights of a second, 4 m/s^2 up at most at a change of slope: 4 / 24 m
    assert np.abs(left).max() < 4 / 24
    assert np.ptp(problem.outside['pressure'].height) > 1.0


def test_heights_sharpen_the_pitch_and_hold():
    off, gain = [], []
    for seed in range(1, 7):
        drive, config, leg = made(**SHORT, seed=seed)
        found, without = smooth(leg, config), smooth(replace(leg, outside={}), config)
        pitch, before = (m.estimates['pitch_mounting_angle'] for m in (found, without))
        off.append((pitch.value - drive.truth.pitch) / pitch.sigma)
        gain.append(pitch.sigma / before.sigma)
        scale, free = (m.estimates['scale_factor'] for m in (found, without))
        assert abs(scale.value - drive.truth.scale) < 3.3 * scale.sigma
        # the air temperature is unknown by 15 K, 5 % of a height: no scale of metres
        assert scale.sigma > 0.8 * free.sigma
        assert 'air_pressure' in {s.name for s in found.sources}
    # chi^2 of 6 at 1 in 1000. The vehicle is ideal: the sigma also holds for bodies that pitch
    assert np.sum(np.square(off)) < 22.5
    assert np.median(gain) < 0.8


def test_the_noise_level_is_found():
    drive, config, leg = made(**SHORT | {'pressure_sigma': 0.3}, seed=3)
    level = smooth(leg, config).details['noise']['pressure']
    # 240 means of a second: 1 / sqrt(2 * 240) of a sigma, and a mean over a second of hills
    assert level == pytest.approx(1.0, abs=3.3 / np.sqrt(480))


def test_doors_and_tunnels_are_outliers():
    """A door that is slammed, a tunnel: 30 to 300 Pa for seconds."""
    drive, config, _ = made(**SHORT, seed=2)
    sent = drive.leg().rows('pressure')
    value = sent.value + np.where(np.arange(len(sent.value)) % 800 < 40, 300.0, 0.0)
    leg = leg_of(drive.leg().with_rows(pressure=replace(sent, value=value)), config)
    pitch = smooth(leg, config).estimates['pitch_mounting_angle']
    assert abs(pitch.value - drive.truth.pitch) < 3.3 * pitch.sigma


def test_hectopascals_are_no_pascals():
    drive, config, _ = made(**SHORT)
    sent = drive.leg().rows('pressure')
    leg = drive.leg().with_rows(pressure=replace(sent, value=sent.value / 100))
    inputs, found = screen(leg, config)
    assert not len(inputs.outside['pressure'].t)
    assert any('air pressure messages hold NaN, Inf or an impossible value' in r.text
               for r in found)
    assert not leg_of(leg, config).outside


def test_it_can_be_left_out():
    drive, config, leg = made(**SHORT)
    assert 'pressure' in leg.outside
    assert not leg_of(drive.leg(), with_settings(config, {'imu.use_pressure': False})).outside
    assert 'pressure' not in with_settings(config, {'imu.use_pressure': False}).inputs
