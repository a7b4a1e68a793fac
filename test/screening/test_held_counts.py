# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Counters that are published faster than they are read: each value is repeated."""

from dataclasses import replace

from drives import drive, reason_texts, settings
import numpy as np
import pytest

from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.screening.odometer_rows import repeated_counts

STAND, ROWS = 40, 200


def published(rows_per_update, counts):
    """Return a counter at rest, accelerating from row STAND on, and at rest."""
    read = np.floor(np.arange(ROWS) / rows_per_update) * rows_per_update
    moved = np.clip((read - STAND) / (ROWS - 2 * STAND), 0, 1)
    return np.floor(counts * ROWS * moved**2).astype(np.int64)


@pytest.mark.parametrize('rows', [2.0, 5.0, 10 / 3])
def test_repeated_counts_in_motion_are_dropped(rows):
    value = published(rows, 4)
    held = repeated_counts(value, 2**64)
    moves = np.flatnonzero(np.diff(value)) + 1
    inside = np.arange(moves[0], moves[-1])
    np.testing.assert_array_equal(~held[inside], np.isin(inside, moves))
    kept = np.flatnonzero(~held)
    # at a standstill the interval of the updates
    assert np.diff(kept).max() <= np.ceil(rows)
    assert np.median(np.diff(kept)) >= np.floor(rows)


@pytest.mark.parametrize('value', [
    published(1.0, 4), published(1.0, 0.3), published(2.0, 0.5), np.zeros(ROWS, np.int64)],
    ids=['each row new', 'coarse', 'coarse and read slowly', 'standing'])
def test_rows_of_other_counters_are_kept(value):
    assert not repeated_counts(value, 2**64).any()


def test_a_counter_read_at_5_hz_and_published_at_50_hz_gives_no_slip():
    made = drive(scenario='town', duration=300.0, imu_grade='industrial', odometer_rate=50.0,
                 fix_noise='rtk', seed=8)
    leg = made.leg()
    read = np.arange(len(leg.odometer.value)) // 10 * 10
    slow = replace(leg, odometer=replace(leg.odometer, value=leg.odometer.value[read]))
    result, plain = (calibrate(one, settings(made, heading_sigma=None, method='smoother'))
                     for one in (slow, leg))
    texts = reason_texts(result)
    assert not {Code.WHEEL_SLIP, Code.TRAVEL_MISSING, Code.TOPIC_GAP, Code.ODOMETER_LATE} & set(
        texts)
    found, exact = (one.methods['smoother'].estimates['scale_factor'] for one in (result, plain))
    assert abs(found.value - exact.value) < exact.sigma
    assert found.sigma < 1.5 * exact.sigma      # with the repeated rows: 2.6 times
