# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Faults, distance and standstill of a leg during its recording agree with the result."""

from dataclasses import replace

from drives import changed, delayed_in_bursts, seconds, settings, thinned
import numpy as np
import pytest

from odocal_ros.data.samples import ImuSamples, OdometerForm, OdometerSamples, take
from odocal_ros.forecast.leg_so_far import find_thinned_faults, ImuGaps
from odocal_ros.forecast.progress import OdometerProgress, Progress
from odocal_ros.forecast.quantities import find_observable
from odocal_ros.forecast.thinned_leg import ThinnedLeg
from odocal_ros.pipeline.calibrate import calibrate, find_faults, screen_leg
from odocal_ros.reasons import Code, Verdict
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config

pytestmark = pytest.mark.core
SECOND = 10**9
MADE = {'scenario': 'town', 'duration': 180.0, 'imu_grade': 'industrial', 'seed': 4}


def without(samples, leg, begin_s, end_s):
    t = seconds(leg, samples)
    return take(samples, (t < begin_s) | (t >= end_s))


def reset(v):
    """Return counts that restart at zero after a third of the drive."""
    return v - np.where(np.arange(len(v)) > len(v) // 3, v[len(v) // 3], 0)


WRONG = {
    'reversed counter': lambda leg: {'odometer': changed(leg.odometer, value=lambda v: -v)},
    'reset counter': lambda leg: {'odometer': changed(leg.odometer, value=reset)},
    'gap': lambda leg: {'imu': without(leg.imu, leg, 40.0, 43.0)},
    'dead counter': lambda leg: {'odometer': changed(leg.odometer, value=lambda v: v * 0)},
    'in g': lambda leg: {'imu': changed(leg.imu, f_i=lambda f: f / 9.80665)},
    'sound': lambda leg: {}}


@pytest.mark.parametrize('wrong', WRONG)
def test_faults_during_the_recording_are_those_of_the_result(made, wrong):
    config = settings(made)
    leg = replace(made.leg(), **WRONG[wrong](made.leg()))
    result = calibrate(leg, config)
    # a method reports the gap as slip
    lowering = {r.code for r in result.reasons
                if r.code.severity is not Verdict.ACCEPTED} - {Code.WHEEL_SLIP}
    assert {r.code for r in find_faults(screen_leg(leg, config), config)} == lowering
    during = find_thinned_faults(thinned(leg).leg(leg.start_ns), config)
    assert {r.code for r in during} == lowering
    assert (lowering == set()) == (wrong == 'sound')


def test_late_rows_are_corrected_during_the_recording_as_in_the_result(made):
    leg = made.leg()
    late = replace(leg, odometer=delayed_in_bursts(leg.odometer, how_long_s=0.4)[0])
    expected = screen(late, settings(made))[0].travel
    cells = ThinnedLeg(leg.form)
    sent_ns = late.odometer.stamp_ns
    for begin in np.arange(sent_ns[0], sent_ns[-1] + 1, 5 * 10**9):       # update by update
        cells.feed('odometer', take(late.odometer, (sent_ns >= begin)
                                    & (sent_ns < begin + 5 * 10**9)))
    cells.feed('imu', leg.imu)
    cells = cells.leg(leg.start_ns).odometer
    count = np.interp(seconds(leg, cells), expected.t, expected.s)
    # a row is 0.05 s; as sent, cells are off by up to 0.4 s of driving
    speed = np.gradient(expected.s, expected.t).max()
    base = late.odometer.value[0]
    off = cells.value - base - (count - expected.s[0])
    assert np.abs(off - np.median(off)).max() < 0.05 * speed
    raw = np.interp(seconds(leg, cells), seconds(leg, late.odometer), late.odometer.value - base)
    assert np.abs(raw - (count - expected.s[0])).max() > 0.2 * speed


def test_an_imu_gap_is_reported_at_once_and_remains(made):
    leg = made.leg()
    gaps, limit = ImuGaps(leg.start_ns, 0.5), 0.5
    rows = without(without(leg.imu, leg, -100.0, 0.0), leg, 40.0, 43.0)
    t = seconds(leg, rows)
    gaps.feed(take(rows, t < 40.0))
    assert gaps.reasons() == ()
    assert gaps.reasons(silent_s=0.9) == ()         # a busy computer is not a gap
    assert gaps.reasons(silent_s=0.95)[0].code is Code.IMU_GAP      # within a second
    for row in np.flatnonzero(t >= 40.0):
        gaps.feed(take(rows, slice(row, row + 1)))
    stated, = gaps.reasons()
    whole = replace(leg, imu=without(leg.imu, leg, 40.0, 43.0), stop_ns=int(rows.stamp_ns[-1]))
    result = calibrate(whole, settings(made, leg__max_gap=limit))
    assert stated in result.reasons                    # to the last digit


@pytest.mark.parametrize('odd', [np.nan, np.inf, -np.inf, 1e300])
@pytest.mark.parametrize('quantity', ['cumulative', 'rate'])
def test_impossible_values_change_no_distance_and_no_standstill(odd, quantity):
    t = np.arange(0, 20 * SECOND, SECOND // 10)
    speed = np.where(t < 15 * SECOND, 2.0, 0.0)
    value = speed if quantity == 'rate' else np.cumsum(speed) * 0.1
    found = []
    for bad in ([], [20, 21, 100, 190]):
        sent = value.copy()
        sent[bad] = odd
        travel = OdometerProgress(OdometerForm(quantity, 0, '1'))
        for k in range(0, len(t), 3):
            travel.feed(take(OdometerSamples(t + SECOND, t + SECOND, sent), slice(k, k + 3)), 1.0)
        found.append((travel.path_length, travel.still_s(), travel.top_speed))
    assert found[1] == pytest.approx(found[0], abs=0.2)
    assert found[0][0] == pytest.approx(30.0, abs=0.3)


def test_with_an_imu_without_accelerometer_only_the_scale_is_observable():
    stamps, rates = np.arange(1, 4) * SECOND, np.zeros((3, 3))
    progress = Progress()
    for force in (9.81, 0.0):
        progress.feed('imu', ImuSamples(stamps, stamps, rates, rates + force, np.zeros((3, 4)),
                                        np.full(3, np.nan)), Config(), None, 0.0)
        words = find_observable(Config(), progress.received_before(600.0)).as_text()
        assert ('observable: the scale; not observable: the yaw' in words) == (not force), words
        assert ('the pitch (IMU without acceleration)' in words) == (not force)
