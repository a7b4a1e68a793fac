# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Scale against speed: in closed form, and in simulated drives with offset and delay."""

from drives import drive, settings
import numpy as np
import pytest

from odocal_ros.calib.speed_scale import speed_scale
from odocal_ros.nav.odometer import Travel
from odocal_ros.pipeline.calibrate import calibrate


def straight(factor=0.98, offset=0.12, lag=0.3, noise=0.0, reverse=False):
    """Return the arguments of a straight drive whose odometer has these errors."""
    t = np.arange(0.0, 600.0, 0.1)
    v = 12 + 6 * np.sin(t / 15)
    s = np.append(0.0, np.cumsum((v[1:] + v[:-1]) / 2 * 0.1))
    late = np.interp(t - lag, t, s)
    sent = (late - offset * t) / factor * (-1 if reverse else 1)
    pick = slice(50, -50, 10)
    place = np.stack([s, 0 * s], -1)[pick]
    fix = place + noise * np.random.default_rng(1).standard_normal(place.shape)
    return t[pick], fix, place, s[pick], Travel(t, sent, 0.0)


@pytest.mark.parametrize('reverse', [False, True])
def test_factor_offset_and_lag_are_those_of_the_odometer(reverse):
    """Without noise the model is exact but for squares of the lag: the speed used is late too."""
    found = speed_scale(*straight(reverse=reverse))
    assert found.factor[0] == pytest.approx(0.98, abs=3e-4)
    assert found.offset[0] == pytest.approx(0.12, abs=4e-3)
    assert found.lag[0] == pytest.approx(0.3, abs=5e-3)
    speed, ratio, _, _ = found.bins.T
    assert (np.diff(speed) > 0).all()
    # 0.12 m/s of the slow sections are a larger share than of the fast ones
    assert ratio == pytest.approx(0.98 * speed / (speed - 0.12), rel=3e-3)


def test_the_sigmas_hold_with_noise():
    found = speed_scale(*straight(noise=0.3))
    for (value, sigma), truth in zip((found.factor, found.offset, found.lag), (0.98, 0.12, 0.3),
                                     strict=True):
        assert 0 < abs(value - truth) < 4 * sigma


def test_at_one_speed_no_offset_is_stated():
    t = np.arange(0.0, 200.0, 0.1)
    place = np.stack([10 * t, 0 * t], -1)[::10]
    found = speed_scale(t[::10], place, place, 10 * t[::10], Travel(t, 10 * t / 0.5, 0.0))
    assert found.offset is None
    assert found.bins[:, 1] == pytest.approx(0.5)


def test_too_few_sections_are_no_result():
    t = np.arange(0.0, 8.0, 0.1)
    place = np.stack([10 * t, 0 * t], -1)
    assert not len(speed_scale(t, place, place, 10 * t, Travel(t, 10 * t, 0.0)).bins)


@pytest.mark.slow
def test_the_delay_of_a_simulated_odometer():
    made = drive(scenario='town', duration=600.0, seed=4, imu_grade='industrial', fix_sigma=0.3,
                 odometer_delay=0.2)
    leg = calibrate(made.leg(), settings(made))
    found = leg.evidence.by_speed
    assert abs(found.lag[0] - 0.2) < 4 * found.lag[1] < 0.2
    assert abs(found.factor[0] - made.truth.scale) < 4 * found.factor[1]


def test_cells_that_end_at_the_last_fix_may_be_rounded_beyond_it():
    t = (7_369_999_872 + np.arange(496) * 10**9) * 1e-9     # 99 cells of 5 s and 6e-14 s
    assert np.arange(t[0], t[-1], 5.0)[-1] > t[-1]
    place = np.stack([10 * t, 0 * t], -1)
    found = speed_scale(t, place, place, 10 * t, Travel(t, 10 * t / 0.5, 0.0))
    assert found.bins[:, 1] == pytest.approx(0.5)
