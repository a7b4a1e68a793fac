# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Standstills are found, and not in slow motion, rocking or turns on the spot."""

from drives import drive
import numpy as np
import pytest
from scipy.stats import norm, rayleigh

from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.standstill import REST_TRAVEL, standstills
from odocal_ros.nav.time_series import NORMAL_MEDIAN, RAYLEIGH_MEDIAN, robust_sigma
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config
from odocal_ros.settings.nominal import GRADES

pytestmark = pytest.mark.core
RATE = 100.0       # Hz
K = 0.02           # m per count


def gyro(t, noise=0.0, bias=(0.0, 0.0, 0.0), turn=None, seed=1):
    """Return turn rates of a flat vehicle, rad/s: (n, 3)."""
    w = np.array(bias) + noise * np.sqrt(RATE) * np.random.default_rng(seed).normal(
        size=(len(t), 3))
    w[:, 2] += 0.0 if turn is None else np.interp(t, *turn)
    return w


def counts(t, drive, phase=0.3):
    """Return travel as whole counts of K metres at the odometer's own 50 Hz."""
    t_odometer = t[::2]
    s = np.floor(np.interp(t_odometer, *drive) / K + phase)
    return Travel(t_odometer, s - s[0], 1.0)


def ramp(begin, end, top=10.0, slope=1.0):
    """Return (times, metres) of a drive from rest to rest, accelerations of slope, m/s^2."""
    t = np.arange(0, 100, 0.01)
    speed = np.clip(np.minimum((t - begin) * slope, (end - t) * slope), 0, top)
    return t, np.concatenate([[0], np.cumsum((speed[1:] + speed[:-1]) / 2 * 0.01)])


T = np.arange(0, 100, 1 / RATE)
DRIVE = ramp(20.0, 70.0)


@pytest.mark.parametrize('grade', ['perfect', *GRADES])
@pytest.mark.parametrize('bias', [0.0, 0.1, -0.1])
def test_both_ends_of_a_drive_are_found_inside_the_truth(grade, bias):
    noise = 0.0 if grade == 'perfect' else GRADES[grade].gyro_noise
    found = standstills(T, gyro(T, noise, (bias, -bias, bias)), counts(T, DRIVE), K, 2.0)
    assert len(found) == 2
    (a, b), (c, d) = found
    assert a == 0.0
    assert 20.0 - 0.7 < b <= 20.0          # half a window, a cell, a count
    assert 70.0 <= c < 70.0 + 0.7
    assert d == pytest.approx(T[-2], abs=0.02)


@pytest.mark.parametrize('slope', [0.02, 0.1, 0.5, 3.0])
def test_a_standstill_ends_early_in_a_slow_start(slope):
    drive = ramp(20.0, 90.0, slope=slope)
    b = standstills(T, gyro(T), counts(T, drive), K, 2.0)[0, 1]
    assert np.interp(b, *drive) <= REST_TRAVEL
    if slope >= 0.5:                        # 0.5 m/s^2 makes 3 cm within 0.35 s < the window
        assert b <= 20.0


def swinging(hertz):
    """Return turn rates of a body that swings on its wheels, as someone walks about in a bus."""
    w = gyro(T)
    w[:, 0] += 0.06 * np.sin(2 * np.pi * hertz * T)
    return w


@pytest.mark.parametrize(('w', 'travel'), [
    *((gyro(T), size * np.sin(2 * np.pi * T / period))
      for size in (0.05, 0.2) for period in (0.5, 1.0, 3.0)),
    *((gyro(T), speed * T) for speed in (0.025, 0.05, 0.1)),
    (gyro(T, bias=(0.0, 0.0, 0.3)), 0 * T), (swinging(0.5), 0 * T), (swinging(3.0), 0 * T)],
    ids=[*['rocking'] * 6, *['creeping'] * 3, 'turning all the time', *['swinging'] * 2])
def test_motion_is_not_a_standstill(w, travel):
    assert len(standstills(T, w, Travel(T, travel, 0.0), 1.0, 2.0)) == 0


@pytest.mark.parametrize('metres', [0.001, 0.02, 0.3])
def test_a_count_that_flickers_at_rest_is_a_standstill(metres):
    flicker = Travel(T, np.random.default_rng(2).integers(0, 2, len(T)).astype(float), 1.0)
    found = standstills(T, gyro(T), flicker, metres, 2.0)
    assert found.tolist() == [[0.0, T[-1]]]


@pytest.mark.parametrize('bias', [0.0, 0.1, -0.1])
@pytest.mark.parametrize('spin', [0.3, -0.5, 1.0])
def test_turning_on_the_spot_is_not_a_standstill(bias, spin):
    turn = [0, 10, 10.3, 40, 40.3, 100], [0, 0, spin, spin, 0, 0]
    found = standstills(T, gyro(T, 1e-4, (0.02, 0.0, bias), turn), Travel(T, 0 * T, 0.5), K, 2.0)
    assert len(found) == 2
    # the ramp of the turn begins at 10 and ends at 40.3: the window's deviation shows it
    assert found[0, 0] == 0.0
    assert 10 - 0.7 < found[0, 1] <= 10.2
    assert 40.1 <= found[1, 0] < 40.3 + 0.7
    assert found[1, 1] == T[-1]


def test_a_standstill_among_many_equal_turns_is_found():
    turn = ([0, 10, 10.2, 30, 30.2, 35, 35.2, 60, 60.2, 65, 65.2, 100],
            [0.2, 0.2, 0.5, 0.5, 0.2, 0.2, 0.0, 0.0, 0.2, 0.2, 0.5, 0.5])
    w = gyro(T, bias=(0.0, 0.0, -0.01), turn=turn)
    found = standstills(T, w, Travel(T, 0 * T, 0.5), K, 2.0)
    assert len(found) == 1
    assert 35.0 <= found[0, 0] < 36.0
    assert 59.0 < found[0, 1] <= 60.2


def test_standstill_is_found_with_engine_vibration_and_reversed_counts():
    w = gyro(T, GRADES['consumer'].gyro_noise)
    w += 0.05 * np.sin(2 * np.pi * np.outer(T, [27.0, 31.0, 23.0]))
    assert len(standstills(T, w, counts(T, DRIVE), K, 2.0)) == 2
    assert len(standstills(T, gyro(T), counts(T, (DRIVE[0], -DRIVE[1])), K, 2.0)) == 2


def test_an_imu_gap_is_not_a_standstill():
    for gap, count in ((5.0, 2), (0.3, 1)):
        keep = (T < 50) | (50 + gap < T)
        found = standstills(T[keep], gyro(T)[keep], Travel(T, 0 * T, 1.0), K, 2.0)
        assert len(found) == count
        assert found[0, 0] == 0.0
        assert found[-1, 1] == T[-1]
        if count == 2:
            assert found[0, 1] <= 50.0
            assert found[1, 0] >= 55.0


def test_a_standstill_is_found_without_odometer_messages_at_rest():
    rows = counts(T, DRIVE)
    in_motion = (rows.t == 0) | ((rows.t > 20) & (rows.t < 70)) | (rows.t == rows.t[-1])
    found = standstills(T, gyro(T), Travel(rows.t[in_motion], rows.s[in_motion], 1.0), K, 2.0)
    assert len(found) == 2
    assert found[0, 1] <= 20.0
    assert found[1, 0] >= 70.0


@pytest.mark.parametrize(('shortest', 'count'), [(1.0, 3), (4.0, 2), (25.0, 1), (40.0, 0)])
def test_standstills_shorter_than_the_minimum_are_not_found(shortest, count):
    drive = ramp(20.0, 40.0)
    again = ramp(43.0, 70.0)
    both = drive[0], drive[1] + again[1]
    assert len(standstills(T, gyro(T), counts(T, both), K, shortest)) == count


@pytest.mark.parametrize('n', [0, 1, 2, 3])
def test_too_little_data_has_no_standstill(n):
    few = np.arange(n) * 0.01
    many = Travel(T, 0 * T, 1.0)
    assert standstills(few, np.zeros((n, 3)), many, K, 2.0).shape == (0, 2)
    assert standstills(T, gyro(T), Travel(few, few, 1.0), K, 2.0).shape == (0, 2)
    assert standstills(T + 1e3, gyro(T), many, K, 2.0).shape == (0, 2)


@pytest.mark.parametrize('scale', [0.35, 1.0, 1.7])
def test_a_stop_is_found_with_one_pulse_per_wheel_turn(scale):
    made = drive(scenario='straight', duration=200.0, scale=scale, nominal_scale=scale)
    inputs, _ = screen(made.leg(), Config())
    spans = standstills(inputs.t_imu, inputs.w_b, inputs.travel, scale, 2.0)
    assert len(spans) == 2
    # 0.5 m/s^2: within two counts of the onset, sqrt(2 * 2 * scale / 0.48)
    assert 0 <= spans[0, 1] < np.sqrt(4 * scale / 0.48)


def test_robust_levels_have_the_factors_of_the_distributions():
    assert pytest.approx(norm.ppf(0.75), abs=1e-4) == NORMAL_MEDIAN
    assert pytest.approx(rayleigh.median(), abs=1e-4) == RAYLEIGH_MEDIAN
    x = np.random.default_rng(1).normal(0.0, 0.3, 30_000)
    # of 30,000 values a median is known to 0.8 %: three sigmas
    assert robust_sigma(x) == pytest.approx(0.3, rel=0.024)
    x[::10] = 1e6
    assert robust_sigma(x) < 0.36
