# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The cells of a thinned leg during the recording: turns, counts and speeds."""

from dataclasses import fields

from drives import seconds
import numpy as np
import pytest

from odocal_ros.data.samples import ImuSamples, OdometerForm, OdometerSamples, take
from odocal_ros.forecast.thinned_leg import MAX_CELLS, ThinnedLeg
from odocal_ros.nav.time_series import running_integral

SECOND = 10**9


def imu_rows(t, yaw_rate):
    n = len(t)
    stamps = SECOND + np.round(np.asarray(t) * 1e9).astype(np.int64)
    w_i = np.stack([np.zeros(n), np.zeros(n), yaw_rate], -1)
    return ImuSamples(stamps, stamps, w_i, np.tile([0.0, 0.0, 9.81], (n, 1)), np.zeros((n, 4)),
                      np.full(n, np.nan))


def odometer_rows(t, value):
    stamps = SECOND + np.round(np.asarray(t) * 1e9).astype(np.int64)
    return OdometerSamples(stamps, stamps, value)


def fed(form, slot, rows, chop):
    cells = ThinnedLeg(form)
    for first in range(0, len(rows.stamp_ns), chop):
        cells.feed(slot, take(rows, slice(first, first + chop)))
    return cells


def test_the_number_of_cells_is_limited_no_turn_is_lost_and_vibration_is_none():
    t = np.arange(0.0, 4 * 3600.0, 0.05)          # four hours, the longest leg there may be
    rate = np.where((t % 60) < 3, 0.5, 0.0)       # 3 s turns, one a minute
    leg = fed(None, 'imu', imu_rows(t, rate), 12_000).leg(SECOND)
    assert MAX_CELLS / 2 < len(leg.imu.stamp_ns) <= MAX_CELLS
    # the cells are 1.6 s wide then: a trapezoid misses at most a cell at each end
    turned = running_integral(seconds(leg, leg.imu), leg.imu.w_i[:, 2])[-1]
    assert turned == pytest.approx(1.5 * 240, abs=2 * 0.5 * 1.6)
    assert (np.diff(leg.imu.stamp_ns) > 0).all()
    t = np.arange(0.0, 300.0, 0.005)
    leg = fed(None, 'imu', imu_rows(t, np.sin(2 * np.pi * 10.03 * t)), 1000).leg(SECOND)
    # 10.03 Hz sampled every 0.1 s is a slow wave: single rows turn by 1 / (pi 0.03) = 10 rad;
    # in the mean of a cell sinc(1.003) = 0.3 % remains
    assert abs(np.cumsum(leg.imu.w_i[:, 2] * 0.1)).max() < 0.1


@pytest.mark.parametrize(('form', 'sent'), [
    (OdometerForm('cumulative', 256, 'm/pulse'), lambda n: (15 * np.arange(n)) % 256),
    (OdometerForm('cumulative', 2**64, 'm/pulse'), lambda n: 2**63 - 700 + 15 * np.arange(
        n, dtype=np.uint64)),
    (OdometerForm('increment', 2**16, 'm/pulse'), lambda n: np.full(n, 15))])
def test_counts_do_not_roll_over_for_any_block_size(form, sent):
    t = np.arange(0.0, 10.0, 0.01)
    value = sent(len(t)).astype(np.uint64).view(np.int64)
    legs = [fed(form, 'odometer', odometer_rows(t, value), chop).leg(SECOND)
            for chop in (1, 7, len(t))]
    for leg in legs:
        assert leg.form == OdometerForm('cumulative', 2**64, 'm/pulse')
        rows = leg.odometer
        assert np.diff(rows.value) == pytest.approx(150)    # 0.1 s of 1500 counts a second
        assert np.diff(rows.stamp_ns) == pytest.approx(SECOND // 10)
        for f in fields(rows):
            assert (getattr(rows, f.name) == getattr(legs[0].odometer, f.name)).all()


def test_speeds_are_averaged_without_rows_that_are_not_numbers():
    form = OdometerForm('rate', 0, '1')
    t = np.arange(0.0, 10.0, 0.01)
    value = 10.0 + np.sin(2 * np.pi * 10 * t)
    value[500] = np.nan
    rows = fed(form, 'odometer', odometer_rows(t, value), 33).leg(SECOND).odometer
    # one row of ten less changes the mean of that cell by at most 1 / 9
    assert rows.value == pytest.approx(np.full(len(rows.value), 10.0), abs=0.12)
