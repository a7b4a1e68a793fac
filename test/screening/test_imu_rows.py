# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""IMU rows: regular intervals, an axis at the limit of its range, two alternating IMUs."""

from drives import drive, seconds, with_columns
import numpy as np
import pytest

from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.reasons import Code
from odocal_ros.screening.even_imu_times import even_imu_times
from odocal_ros.screening.glitches import dead_band_reasons, saturation_reasons
from odocal_ros.screening.imu_faults import alternating_imu_reasons
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config, ImuConfig
from odocal_ros.settings.nominal import G

RATE, SECONDS = 100.0, 120.0
JITTER = 1e-3
N = 20_000
T = np.arange(N) * 0.01
NONE = np.zeros((N, 3))
BIAS = np.array([3e-3, -2e-3, 1e-3])     # rad/s: 0.17 deg/s, a consumer gyro has 1 deg/s


def signals(t, rng, vibration=1.0, noise=0.01):
    """Return rates and forces at times of an IMU that vibrates at 12 Hz: (n, 3) each."""
    phases = rng.uniform(0, 2 * np.pi, 6)
    x = vibration * np.sin(2 * np.pi * 12.0 * t[:, None] + phases)
    x = x + noise * rng.standard_normal(x.shape)
    return 0.01 * x[:, :3], x[:, 3:]


def late(t, rng, jitter=JITTER):
    """Return stamps of rows that are late by 4 ms and a jitter, in order."""
    return np.maximum.accumulate(t + 4e-3 + jitter * rng.standard_normal(len(t))
                                 - 1e-9 * np.arange(len(t))) + 1e-9 * np.arange(len(t))


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_stamps_with_jitter_or_in_pairs_are_corrected_to_the_regular_interval(rng):
    true = np.arange(SECONDS * RATE) / RATE
    found = even_imu_times(late(true, rng), *signals(true, rng))
    # means over 20 s, of 2000 rows each, with linear interpolation
    assert np.abs(found - true - 4e-3).max() < 5 * JITTER / np.sqrt(2000)
    assert (np.diff(found) > 0).all()
    true = np.arange(SECONDS * RATE) / RATE
    pairs = np.repeat(true[1::2], 2) + np.tile([0.0, 1e-6], len(true) // 2)
    found = even_imu_times(pairs, *signals(true, rng))
    # the first of two has a stamp one interval after its sampling time, the second a right one
    np.testing.assert_allclose(found - true, 0.5 / RATE, atol=2e-6)


def test_an_imu_that_is_sampled_at_irregular_times_keeps_its_stamps(rng):
    stamps = np.sort(np.arange(SECONDS * RATE) / RATE + JITTER * rng.standard_normal(12000))
    assert even_imu_times(stamps, *signals(stamps, rng)) is stamps


@pytest.mark.parametrize('t', [
    np.arange(SECONDS * RATE) / RATE, np.arange(50) / RATE, np.zeros(500), np.empty(0),
    np.cumsum(np.random.default_rng(3).exponential(0.01, 12000))],
    ids=['even', 'few', 'at once', 'none', 'at random'])
def test_stamps_without_a_regular_interval_are_unchanged(rng, t):
    np.testing.assert_array_equal(even_imu_times(t, *signals(t, rng)), t)


@pytest.mark.parametrize('noise', [0.01, 0.0])
def test_noise_alone_determines_no_regular_interval(rng, noise):
    true = np.arange(SECONDS * RATE) / RATE
    stamps = late(true, rng)
    w, f = signals(true, rng, vibration=0.0, noise=noise)
    assert even_imu_times(stamps, w, f + 9.81) is stamps


def test_lost_rows_do_not_change_the_times_of_others(rng):
    true = np.arange(4 * SECONDS * RATE) / RATE
    kept = np.ones(len(true), bool)
    kept[rng.integers(500, len(true) - 500, 16)] = False
    true = true[kept]
    stamps = late(true, rng)
    found = even_imu_times(stamps, *signals(true, rng))
    left = np.abs(found - true - 4e-3)
    # a row lost in the first or last quarter of a block changes its mean by less than the limit
    assert np.median(left) < 0.1 * JITTER
    assert left.max() < np.abs(stamps - true - 4e-3).max() + 0.25 / RATE
    assert (np.diff(found) > 0).all()
    assert np.std(found - true) < 0.6 * np.std(stamps - true)


def vibrating(size, step=0.0):
    """Return forces about gravity: (N, 3) m/s^2, in steps."""
    f = np.random.default_rng(1).normal(0.0, size, (N, 3)) + [0.0, 0.0, G]
    return np.round(f / step) * step if step else f


def words(*signals, imu=None):
    reasons = saturation_reasons(T, *signals, imu or ImuConfig())
    assert {reason.code for reason in reasons} <= {Code.IMU_SATURATED}
    return [reason.text for reason in reasons]


@pytest.mark.parametrize('step', [0.0, 0.125])
def test_a_force_clipped_at_a_limit_is_reported(step):
    f = np.clip(vibrating(5.0, step), -2 * G, 19.5)
    count = int((f[:, 2] == 19.5).sum())
    first = T[np.argmax(f[:, 2] == 19.5)]
    assert words(NONE, f) == [
        f'accelerometer z saturates at +19.5 m/s^2 in {count} of {N} messages, first at t = '
        f'{first:.1f} s']


def test_limits_are_of_the_scaled_unit_and_both_ends_are_counted():
    f = np.clip(vibrating(5.0), -2 * G, 2 * G) / G
    assert 'saturates at +19.61 m/s^2' in words(NONE, f, imu=ImuConfig(accel_scale=G))[0]
    assert not words(NONE, f)       # 2 m/s^2 is not a range of a sensor
    w = np.zeros((N, 3))
    w[:, 1] = np.clip(3.0 * np.sin(T), -2.18, 2.18)
    text, = words(w, NONE)
    assert text.startswith('gyro y saturates at ')
    assert text.endswith('; other axis limits reached: 1')


@pytest.mark.parametrize('signal', [
    vibrating(5.0), vibrating(5.0, 0.125), vibrating(5.0, 1.0),         # not clipped
    vibrating(5.0)[np.arange(N) // 4],                            # each value sent four times
    np.round(vibrating(0.01) / 0.1) * 0.1,                        # at rest, in coarse steps
], ids=['fine', 'steps', 'coarse', 'repeated', 'rest'])
def test_signals_without_clipping_have_no_limit(signal):
    assert not words(NONE, signal)
    assert not words(signal * [1.0, 1.0, 0.0] / 5.0, NONE)


@pytest.fixture(scope='module')
def leg():
    return drive(scenario='town', duration=200.0, imu_grade='consumer', seed=8).leg()


def second(x, by):
    """Return rows of which every second one is changed."""
    return np.where((np.arange(len(x)) % 2 == 1)[:, None], by(x), x)


@pytest.mark.parametrize(('column', 'by'), [
    ('w_i', lambda w: w + BIAS), ('f_i', lambda f: f + 100 * BIAS),
    ('w_i', lambda w: w @ matrix_from_rpy([0.1, 0.0, 0.0]).T)], ids=['gyro', 'force', 'axes'])
def test_rows_that_alternate_between_two_imus_reject_the_leg(leg, column, by):
    _, reasons = screen(with_columns(leg, 'imu', **{column: lambda x: second(x, by)}), Config())
    assert 'every second message' in {r.code: r for r in reasons}[Code.SEVERAL_IMUS].text


@pytest.mark.parametrize('grade', ['consumer', 'perfect'])
@pytest.mark.parametrize('rate', [10.0, 25.0, 100.0])
@pytest.mark.parametrize('repeat', [1, 2])
def test_one_imu_is_not_two_at_any_rate_or_with_repeated_rows(grade, rate, repeat):
    imu = drive(scenario='yard', duration=250.0, imu_grade=grade, imu_rate=rate, seed=9).leg().imu
    assert not alternating_imu_reasons(
        *(np.repeat(x[::repeat], repeat, axis=0) for x in (imu.w_i, imu.f_i)))


@pytest.mark.parametrize(('off_hz', 'on_s'), [(0.002, 60.0), (0.0, 40.0), (0.001, 40.0)])
@pytest.mark.parametrize('size', [0.1, 1.0])
def test_a_vibration_at_half_the_rate_is_not_a_second_imu(leg, off_hz, on_s, size):
    t = seconds(leg, leg.imu)
    vibration = size * np.cos(2 * np.pi * (25.0 - off_hz) * t + 1.0) * (t % 60.0 < on_s)
    assert not alternating_imu_reasons(leg.imu.w_i, leg.imu.f_i + vibration[:, None])
    assert not alternating_imu_reasons(leg.imu.w_i + 0.01 * vibration[:, None], leg.imu.f_i)


@pytest.mark.parametrize('drift', [0.0, 0.1])
def test_two_imus_with_drifting_biases_are_found(leg, drift):
    t = seconds(leg, leg.imu)[:, None]
    assert alternating_imu_reasons(
        second(leg.imu.w_i, lambda w: w + BIAS * (1 + drift * t / t[-1])), leg.imu.f_i)


@pytest.mark.parametrize('seed', [8, 9, 11, 12, 14])
def test_a_section_with_more_tilt_and_vibration_is_not_a_second_imu(seed):
    rng = np.random.default_rng(seed)
    lifted = (np.arange(N) > 0.9 * N)[:, None]
    f = np.array([0.0, 0.0, G]) + rng.standard_normal((N, 3)) * np.where(lifted, 0.072, 0.006)
    f[:, 0] -= 1.4 * lifted[:, 0] * np.sin(np.linspace(0.0, 10 * np.pi, N))**2
    assert not alternating_imu_reasons(NONE, f)


def test_a_spike_is_not_a_second_imu(leg):
    w = leg.imu.w_i.copy()
    w[len(w) // 2] += 50.0
    assert not alternating_imu_reasons(w, leg.imu.f_i)


def rates(kind, rng):
    """Return the rates of a gyro, (n, 3) rad/s, and the travel, with stops of 50 of 100 s."""
    moves = T % 100.0 < 50.0
    w = np.deg2rad(0.5) * rng.standard_normal((N, 3)) * [0.3, 1.0, 3.0]
    travel = Travel(T, np.cumsum(np.where(moves, 0.1, 0.0)), 0.0)
    band = np.deg2rad(0.3)
    if kind == 'dead band':
        w[np.abs(w) < band] = 0.0
    elif kind == 'coarse steps':
        w = band * np.round(w / band)
    elif kind == 'zero at rest':
        w[~moves] = 0.0
    elif kind == 'yaw only':
        w[:, :2] = 0.0
    return w, travel


@pytest.mark.parametrize('kind', ['', 'dead band', 'coarse steps', 'zero at rest', 'yaw only'])
def test_a_gyro_without_small_rates_in_motion_has_a_dead_band(rng, kind):
    reasons = dead_band_reasons(T, *rates(kind, rng))
    assert [r.code for r in reasons] == [Code.GYRO_DEAD_BAND] * (kind == 'dead band')
    if reasons:
        # of x, with a sigma of 0.15 deg/s: two sigma
        assert reasons[0].text == ('the gyro sends 0 for turn rates below 0.3 deg/s, on axis x in '
                                   '95 % of the messages in motion')
