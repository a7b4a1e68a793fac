# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""IMU rows on their rhythm: jitter of the stamps goes, uneven sampling stays."""

import numpy as np
import pytest

from odocal_ros.screening.imu_rhythm import on_rhythm

RATE, SECONDS = 100.0, 120.0
JITTER = 1e-3


def signals(t, rng, vibration=1.0, noise=0.01):
    """Return rates and forces of an IMU that shakes at 12 Hz, taken at times: (n, 3) each."""
    phases = rng.uniform(0, 2 * np.pi, 6)
    x = vibration * np.sin(2 * np.pi * 12.0 * t[:, None] + phases)
    x = x + noise * rng.standard_normal(x.shape)
    return 0.01 * x[:, :3], x[:, 3:]


def late(t, rng, jitter=JITTER):
    """Return stamps of rows that arrive late by 4 ms and a jitter, in order."""
    return np.maximum.accumulate(t + 4e-3 + jitter * rng.standard_normal(len(t))
                                 - 1e-9 * np.arange(len(t))) + 1e-9 * np.arange(len(t))


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def test_stamps_that_jitter_are_put_on_the_rhythm(rng):
    true = np.arange(SECONDS * RATE) / RATE
    found = on_rhythm(late(true, rng), *signals(true, rng))
    # means over 20 s: of 2000 rows each, between them a line
    assert np.abs(found - true - 4e-3).max() < 5 * JITTER / np.sqrt(2000)
    assert (np.diff(found) > 0).all()


def test_rows_stamped_in_pairs_are_put_on_the_rhythm(rng):
    true = np.arange(SECONDS * RATE) / RATE
    pairs = np.repeat(true[1::2], 2) + np.tile([0.0, 1e-6], len(true) // 2)
    found = on_rhythm(pairs, *signals(true, rng))
    # the first of two is stamped an interval later than it was taken, the second as it was
    np.testing.assert_allclose(found - true, 0.5 / RATE, atol=2e-6)


def test_an_imu_that_is_asked_at_uneven_times_keeps_them(rng):
    asked = np.sort(np.arange(SECONDS * RATE) / RATE + JITTER * rng.standard_normal(12000))
    assert on_rhythm(asked, *signals(asked, rng)) is asked


@pytest.mark.parametrize('t', [
    np.arange(SECONDS * RATE) / RATE, np.arange(50) / RATE, np.zeros(500), np.empty(0),
    np.cumsum(np.random.default_rng(3).exponential(0.01, 12000))],
    ids=['even', 'few', 'at once', 'none', 'at random'])
def test_what_shows_no_rhythm_stays(rng, t):
    np.testing.assert_array_equal(on_rhythm(t, *signals(t, rng)), t)


@pytest.mark.parametrize('noise', [0.01, 0.0])
def test_noise_alone_tells_no_rhythm(rng, noise):
    true = np.arange(SECONDS * RATE) / RATE
    stamps = late(true, rng)
    w, f = signals(true, rng, vibration=0.0, noise=noise)
    assert on_rhythm(stamps, w, f + 9.81) is stamps


def test_lost_rows_move_no_others(rng):
    """A row lost every 30 s: those about it keep their stamps, the rest find their rhythm."""
    true = np.arange(4 * SECONDS * RATE) / RATE
    kept = np.ones(len(true), bool)
    kept[rng.integers(500, len(true) - 500, 16)] = False
    true = true[kept]
    stamps = late(true, rng)
    found = on_rhythm(stamps, *signals(true, rng))
    left = np.abs(found - true - 4e-3)
    # a row lost in the first or last quarter of a block moves its mean by less than is seen
    assert np.median(left) < 0.1 * JITTER
    assert left.max() < np.abs(stamps - true - 4e-3).max() + 0.25 / RATE
    assert (np.diff(found) > 0).all()
    assert np.std(found - true) < 0.6 * np.std(stamps - true)
