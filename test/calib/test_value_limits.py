# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Limits of values, of the track against the fixes, and of the units and axes of an IMU."""

import numpy as np
import pytest

from odocal_ros.calib.drive import separated_fixes
from odocal_ros.calib.gyro_axes import _without_drift, gyro_reasons, turn_ratio
from odocal_ros.calib.marks import slow_variance
from odocal_ros.calib.result import Estimate
from odocal_ros.calib.track_check import (
    bend_reasons,
    distance_reasons,
    find_inliers,
    fix_noise_factor,
    track_statistics,
)
from odocal_ros.calib.value_limits import check_limits
from odocal_ros.reasons import Code
from odocal_ros.screening.imu_orientation import unit_and_axis_reasons
from odocal_ros.settings.config import Config, ImuConfig, with_settings
from odocal_ros.settings.nominal import nominal_scale

pytestmark = pytest.mark.core
CONFIG = Config()


def estimates(scale=0.02, relative=1e-4, yaw=0.01, yaw_sigma=1e-3):
    return {'scale_factor': Estimate(scale, scale and scale * relative, 'm/pulse'),
            'yaw_mounting_angle': Estimate(yaw, yaw_sigma, 'rad')}


def codes(reasons):
    return [r.code for r in reasons]


T_WAY = np.arange(0.0, 300.0, 0.05)


def fixes_of(rate):
    """Return fixes at 2 Hz of a drive at 10 m/s with these turn rates at T_WAY."""
    path = np.cumsum(np.exp(1j * np.cumsum(rate) * 0.05)) * 0.5
    return np.stack([path.real, path.imag], -1)[::10]


def test_good_and_undetermined_values_have_no_reasons():
    assert check_limits(estimates(), 0.021, CONFIG) == check_limits(estimates(), 0.0, CONFIG) == ()
    assert check_limits(estimates(None, yaw=None, yaw_sigma=None), 0.02, CONFIG) == ()


@pytest.mark.parametrize(('values', 'nominal', 'code', 'text'), [
    (estimates(relative=2e-3), 0.0, Code.SCALE_SIGMA_TOO_LARGE, '2000 ppm; the limit is 1000 ppm'),
    (estimates(relative=0.0157), 0.0, Code.SCALE_SIGMA_TOO_LARGE, ' 1.6 %; the limit is 0.1 %'),
    (estimates(relative=1.004e-3), 0.0, Code.SCALE_SIGMA_TOO_LARGE, '1004 ppm; the limit is 1000 '
     'ppm'),
    (estimates(relative=12.0), 0.0, Code.SCALE_NOT_DETERMINED, '1200 %, too large for a '
     'usable value'),
    (estimates(yaw_sigma=0.02), 0.0, Code.YAW_SIGMA_TOO_LARGE, ' 1.1 deg; the limit is 0.498'),
    (estimates(scale=0.03), 0.02, Code.SCALE_FAR_FROM_NOMINAL, '+50.0 % from the nominal value '),
    (estimates(scale=0.01), 0.02, Code.SCALE_FAR_FROM_NOMINAL, '-50.0 %')])
def test_each_limit_has_its_reason(values, nominal, code, text):
    reason, = check_limits(values, nominal, CONFIG)
    assert reason.code is code
    assert text in reason.text
    rejects = code is Code.SCALE_NOT_DETERMINED
    assert code.severity.value == ('rejected' if rejects else 'caution')


@pytest.mark.parametrize(('kmh', 'unit', 'nominal', 'word', 'wanted'), [
    (1.0084 / 3.6, '1', 1.0, 'km/h', 1 / 3.6), (0.4507, '1', 1.0, 'mph', 0.44704),
    (0.0051, 'm/pulse', 0.02, 'four edges', 0.005), (0.6, '1', 1.0, '', None)])
def test_scale_from_a_wrong_unit_names_the_unit(kmh, unit, nominal, word, wanted):
    found = {'scale_factor': Estimate(kmh, 1e-6, unit),
             'yaw_mounting_angle': Estimate(None, None, 'rad')}
    (reason,) = check_limits(found, nominal, CONFIG)
    assert word in reason.text
    assert ' 1 ' not in reason.text.split(' from')[0]      # the scale of a speed has no unit
    if wanted is None:
        assert reason.remedy == Code.SCALE_FAR_FROM_NOMINAL.remedy
    else:
        assert f'odometer.nominal_scale to {wanted:.6g}' in reason.remedy


def test_nominal_scale_is_the_first_known_one():
    wheel = with_settings(CONFIG, {'wheels.radius': 0.3, 'wheels.pulses_per_revolution': 100.0})
    both = with_settings(wheel, {'odometer.nominal_scale': 0.5})
    assert nominal_scale(both, 'm/pulse') == 0.5
    assert nominal_scale(wheel, 'm/pulse') == pytest.approx(2 * np.pi * 0.3 / 100)
    assert nominal_scale(wheel, 'm/rad') == 0.3
    assert nominal_scale(CONFIG, '1') == 1.0
    assert nominal_scale(CONFIG, 'm/pulse') == 0.0


class TestImu:
    """Units and axes are checked with gravity and turn rates."""

    @staticmethod
    def say(up, size=9.81, fast=0.1, C_bi=None, imu=None):
        rng = np.random.default_rng(1)
        f = np.tile(np.asarray(up, float) * size, (2000, 1)) + 0.02 * rng.standard_normal(
            (2000, 3)) * size / 9.81
        w = 0.002 * rng.standard_normal((2000, 3))
        w[500:520, 2] = fast
        return unit_and_axis_reasons(np.median(f, axis=0), w, np.eye(3) if C_bi is None else C_bi,
                                     imu or ImuConfig())

    def test_correct_imu_has_no_reasons(self):
        assert self.say([0, 0, 1]) == ((), False)
        assert self.say([np.sin(0.2), 0, np.cos(0.2)]) == ((), False)      # parked on a hill

    @pytest.mark.parametrize(('sent', 'text'), [
        ({'size': 1.0}, 'probably g. Set imu.accel_scale to 9.80665, or publish'),
        ({'size': 0.5}, 'a gravity of 0.5 m/s^2 instead of 9.8'),
        ({'fast': 20.0}, 'limit for a vehicle is 8 rad/s: the unit is probably deg/s. Set '
         'imu.gyro_scale to 0.01745329252, or'),
        ({'fast': 20.0, 'imu': ImuConfig(gyro_scale=180 / np.pi)}, 'Set imu.gyro_scale to 1, or'),
        ({'size': 1.0, 'imu': ImuConfig(accel_scale=2.0)}, 'Set imu.accel_scale to 19.6133')])
    def test_unit_error_is_found_by_size_and_the_factor_includes_the_setting(self, sent, text):
        (reason,), _ = self.say([0, 0, 1], **sent)
        assert reason.code is Code.IMU_UNITS
        assert text in f'{reason.text}. {reason.remedy}'

    @pytest.mark.parametrize(('up', 'C_bi', 'code', 'text'), [
        ([0, 0, -1], None, Code.IMU_LOOKS_Z_DOWN, ''),      # upside down
        # not with a configured rotation: then the configuration is wrong
        ([0, 0, -1], np.diag([1.0, -1.0, -1.0]), Code.IMU_AXES, ''),
        ([1, 0, 0], None, Code.IMU_AXES, 'gravity is on +x'),
        ([0, -1, 0], None, Code.IMU_AXES, 'gravity is on -y')])
    def test_imu_that_is_not_upright_is_named(self, up, C_bi, code, text):
        (reason,), turned = self.say(up, C_bi=C_bi)
        assert reason.code is code
        assert text in reason.text
        assert turned == (code is Code.IMU_LOOKS_Z_DOWN)

    def test_imu_without_signal_does_not_fail(self):
        reasons, turned = unit_and_axis_reasons(
            np.zeros(3), np.zeros((50, 3)), np.eye(3), ImuConfig())
        assert codes(reasons) == [Code.NO_IMU, Code.NO_IMU]
        assert not turned


def test_knots_are_fixes_separated_by_a_minimum_distance():
    rng = np.random.default_rng(2)
    p = np.cumsum(rng.normal(0.5, 1.0, (2000, 2)) * (rng.random(2000) < 0.3)[:, None], axis=0)
    p[700:720] = np.nan
    for least in (1e-3, 3.0, 90.0, 1e6):
        knots = [0]
        for k in range(len(p)):
            if np.hypot(*(p[k] - p[knots[-1]])) >= least:
                knots.append(k)
        assert separated_fixes(p, least) == knots
    assert separated_fixes(p[:0], 3.0) == []


class TestCheck:
    """The corrected track against the fixes."""

    def test_track_statistics_are_those_of_the_residuals(self):
        check = track_statistics(np.array([[3.0, 4.0, 9.0], [0.0, 0.0, 9.0], [0.0, -1.0, 9.0]]),
                                 50.0)
        assert (check.max, check.end, check.mean) == (5.0, 1.0, 2.0)
        assert check.rms == pytest.approx(np.sqrt(26 / 3))
        assert check.percent_of_distance == 2.0

    @pytest.mark.parametrize('true', [0.5, 1.0, 3.0])
    def test_noise_factor_is_that_of_the_residuals(self, true):
        rng = np.random.default_rng(2)
        residual = true * rng.standard_normal((3000, 3)) * [1.0, 1.0, 2.0]
        stated = np.tile(np.diag([1.0, 1.0, 4.0]), (3000, 1, 1))
        factor = fix_noise_factor(residual, stated, 0.0)
        # medians of 3000: 2 to 3 %; below 1.25 the stated sigmas are kept
        np.testing.assert_allclose(factor, max(true, 1.0), rtol=0.1)
        assert fix_noise_factor(residual, stated, 10.0).max() == 1.0
        residual[:, 2] = np.nan
        assert np.isfinite(fix_noise_factor(residual, stated, 0.0)).all()

    def test_correlated_errors_are_found_beside_white_errors(self):
        rng = np.random.default_rng(3)
        t = np.arange(0.0, 600.0, 0.2)
        white, stated = rng.standard_normal(len(t)), np.ones(len(t))
        assert slow_variance(t, white, 10 * t, stated, 0.0)[0] == 0.0
        slow = np.repeat(rng.standard_normal(20), 150) * 0.4
        # 20 draws of a variance, two removed by a line: within five sigmas of sqrt(2 / 18)
        found, _ = slow_variance(t, white + slow, 10 * t, stated, 0.0)
        assert 0.16 / 4 < found < 0.16 * 2.7
        assert slow_variance(t, white + slow, 10 * t, stated, 2.0)[0] == 0.0  # gyro error
        # mark errors give a line over the path, which is no correlated error
        assert slow_variance(t, white + 3 + 0.001 * t, 10 * t, stated, 0.0)[0] == 0.0
        assert slow_variance(t[:300], white[:300], t[:300], stated[:300], 0.0)[0] == 0.0

    def test_mismatch_exceeds_noise_drift_and_slip(self):
        check = track_statistics(np.full((10, 3), 10.0), 1000.0)
        assert codes(distance_reasons(check, 1.5, 0.0, 1000.0)) == [Code.TRACK_MISMATCH]
        assert distance_reasons(check, 1.5, 5.0, 1000.0) == ()
        assert distance_reasons(check, 1.5, 0.0, 5000.0) == ()

    @pytest.mark.parametrize(('factor', 'code', 'text'), [
        (1.0, None, ''), (-1.0, Code.GYRO_SIGN, 'ratio -1.'),
        (57.3, Code.IMU_UNITS, 'Set imu.gyro_scale to 0.01745329252'),
        (14.0, Code.IMU_UNITS, 'set imu.gyro_scale to 0.07'),
        (0.3, Code.IMU_UNITS, 'Check unit and range of the gyro. If all its rates are wrong by '
         'this factor, set imu.gyro_scale to 3.3')])
    def test_turns_by_gyro_and_by_fixes_are_compared(self, factor, code, text):
        """A slalom of radius 100 m at 10 m/s: the course turns by -+0.1 rad/s."""
        rate = 0.1 * np.sign(np.sin(T_WAY / 10))
        reasons = gyro_reasons(turn_ratio(T_WAY, factor * rate + 0.01, T_WAY[::10],
                                          fixes_of(rate), 0.5), 1.0)
        assert codes(reasons) == ([code] if code else [])
        assert all(text in f'{r.text} {r.remedy}' for r in reasons)

    @pytest.mark.parametrize(('sign', 'rows', 'loose'), [
        # the course turns by 3 rad before and after the IMU rows
        (-1.0, (T_WAY >= 30.0) & (T_WAY < 200.0), 0.03), (1.0, abs(T_WAY - 115) < 85, 0.03),
        # a gap, as after a clock step: the rate before and after it is not the rate within
        (1.0, abs(T_WAY - 130) > 25, 0.05), (-1.0, abs(T_WAY - 130) > 25, 0.05)])
    def test_turns_by_fixes_are_counted_only_with_imu_data(self, sign, rows, loose):
        rate = np.where(np.sin(T_WAY / 20) > 0, 0.12, -0.1)
        ratio = turn_ratio(T_WAY[rows], sign * rate[rows], T_WAY[::10], fixes_of(rate), 0.5)
        assert ratio == pytest.approx(sign, abs=loose)

    def test_outliers_have_no_direction(self):
        rng = np.random.default_rng(4)
        residual = rng.standard_normal((500, 3)) + np.linspace(0, 300, 500)[:, None]
        residual[[100, 101, 300], 0] += 30.0
        keep, sigma = find_inliers(residual, 0.5)
        assert np.flatnonzero(~keep).tolist() == [100, 101, 300]
        # of 500 white errors of 1 m, on a track that deviates by 0.6 m per fix
        assert sigma == pytest.approx(1.05, abs=0.15)
        assert find_inliers(residual, 9.0)[1] == 9.0


def test_reversing_vehicle_does_not_turn_more_than_its_gyro_measures():
    """Yards of nine pieces of 20 m, some driven backwards: the course changes by half a turn."""
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 180.0, 0.2)
    k = np.minimum((t / 20).astype(int), 8)
    ends = np.array([20.0 * i + x for i in range(9) for x in (1, 19)])
    for _ in range(300):
        path = np.cumsum(rng.uniform(-1.5, 1.5, 9))      # rad, heading
        sign = rng.choice([-1.0, 1.0], 9, p=[0.2, 0.8])
        faces = np.interp(t, ends, np.repeat(path, 2))
        step = sign[k, None] * np.stack([np.cos(faces), np.sin(faces)], -1) * 0.2
        fixes = np.cumsum(step, axis=0)[::5]
        ratio = turn_ratio(t, np.gradient(faces, t), t[::5], fixes, 1.5)
        assert gyro_reasons(ratio, 1.0) == ()


@pytest.mark.parametrize('sections', [1, 8, 150])
def test_drift_of_sections_is_that_of_a_fit(sections):
    rng = np.random.default_rng(2)
    t, x = np.cumsum(rng.random(300)), np.cumsum(rng.normal(size=300))
    section = np.sort(np.r_[np.arange(sections), rng.integers(sections, size=300 - sections)])
    columns = np.column_stack([t, section[:, None] == np.arange(sections)])
    expected = x - columns @ np.linalg.lstsq(columns, x, rcond=None)[0]
    np.testing.assert_allclose(_without_drift(x, t, section), expected, atol=1e-9)


@pytest.mark.parametrize('row', [24.0, 25.0, 26.5, 28.0])
def test_rows_of_a_mower_are_not_a_wrong_unit(row):
    """Rows of 1.6 m: 1 m/s, U-turns of radius 0.8 m at 0.7 m/s, alternately left and right."""
    turn = np.pi * 0.8 / 0.7       # s
    t = np.arange(0.0, 16 * (row + turn), 0.02)
    number, within = np.divmod(t, row + turn)
    rate = np.where(within > row, np.pi / turn * (1 - 2 * (number % 2)), 0.0)
    heading = np.cumsum(rate) * 0.02
    path = np.cumsum(np.where(within > row, 0.7, 1.0) * np.exp(1j * heading)) * 0.02
    fixes = np.stack([path.real, path.imag], -1)[::10]
    assert gyro_reasons(turn_ratio(t, rate, t[::10], fixes, 0.01), 1.0) == ()


def test_bend_of_the_track_without_a_cause_in_gyro_or_fixes_is_reported():
    t = np.arange(0.0, 200.0, 0.5)
    rng, chord = np.random.default_rng(5), np.array([300.0, 400.0, 0.0])
    white = np.c_[rng.normal(0.0, 1.5, (len(t), 2)), np.zeros(len(t))]
    across = np.array([-0.8, 0.6, 0.0])
    bow = np.where(np.abs(t - 100.0) < 40.0, 6.0, 0.0)[:, None]     # four windows of 20 s
    # 4 sigma of the mean of 40 fixes, 0.24 m each, as much along, and 0.2 % of the path length
    found, = bend_reasons(t, white + bow * across, chord, 1.5, 0.0, 500.0)
    assert found.code is Code.MODEL_MISMATCH
    assert 'deviates up to 6.' in found.text
    assert not bend_reasons(t, white, chord, 1.5, 0.0, 500.0)
    # gyro errors that explain it, or fixes with an equal deviation along the path
    assert not bend_reasons(t, white + bow * across, chord, 1.5, 2.0, 500.0)
    slow = bow * across + np.roll(bow, 60) * chord / 500.0
    assert not bend_reasons(t, white + slow, chord, 1.5, 0.0, 500.0)
    # too few windows
    assert not bend_reasons(t[:100], (white + bow * across)[:100], chord, 1.5, 0.0, 500.0)
