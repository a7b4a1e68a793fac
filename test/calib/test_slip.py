# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Wheel slip is seen where odometer and IMU part, and nowhere else."""

from dataclasses import replace

from drives import drive, settings
import numpy as np
import pytest

from odocal_ros.calib.slip import find_slips
from odocal_ros.nav.dead_reckoning import Track
from odocal_ros.nav.earth import gravity
from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code

pytestmark = pytest.mark.slow


def result(**options):
    made = drive(**options)
    return made, calibrate(made.leg(), settings(made, None))


def slips(leg):
    return [r for r in leg.reasons if r.code is Code.WHEEL_SLIP]


@pytest.mark.parametrize('seed', [1, 2, 5])
def test_spins_are_named_and_the_sigma_holds_what_they_did(seed):
    made, leg = result(scenario='straight', slip_events=30.0, slip_size=1.0, seed=seed)
    (reason,) = slips(leg)
    assert 'place' in reason.text
    scale = leg.methods['two_point'].estimates['scale_factor']
    assert abs(scale.value - made.truth.scale) < 2 * scale.sigma
    slip = next(s for s in leg.methods['two_point'].sources if s.name == 'wheel_slip')
    assert slip.effects.shape[1] == 1       # spins add up rather than average
    assert not slip.shared
    # all spins together: about what they moved the scale by, within the two ends' fix noise
    off = abs(scale.value / made.truth.scale - 1)
    assert abs(np.linalg.norm(slip.effects[0]) - off) < 0.5 * off + 1e-4


@pytest.mark.parametrize('options', [
    {'scenario': 'straight'}, {'scenario': 'town'}, {'scenario': 'town', 'odometer': 'speed'},
    {'scenario': 'straight', 'slope': 0.15}, {'scenario': 'town', 'imu_grade': 'tactical'},
    {'scenario': 'straight', 'scale': 0.35, 'nominal_scale': 0.35},
    {'scenario': 'straight', 'odometer_delay': 0.1}])
def test_no_slip_is_seen_where_there_is_none(options):
    assert not slips(result(**options)[1])


def held_up(leg, seconds, how):
    """Return a leg whose speeds come late, or low-passed with that time constant."""
    sent = leg.odometer
    if how == 'late':
        return replace(leg, odometer=replace(sent, stamp_ns=sent.stamp_ns + round(seconds * 1e9)))
    t, value = sent.stamp_ns * 1e-9, sent.value.copy()
    for k in range(1, len(value)):
        value[k] = value[k - 1] + (value[k] - value[k - 1]) * -np.expm1(
            (t[k - 1] - t[k]) / seconds)
    return replace(leg, odometer=replace(sent, value=value))


@pytest.mark.parametrize('how', ['late', 'low pass'])
def test_a_late_or_filtered_odometer_is_named_and_no_slip(how):
    made = drive(scenario='town', odometer='speed', seed=3, duration=300.0)
    leg = calibrate(held_up(made.leg(), 0.4, how), settings(made, None))
    assert not slips(leg)
    (text,) = (r.text for r in leg.reasons if r.code is Code.DELAY_SEEN)
    # to the grid of 0.05 s, for a filter to the second order of its time
    assert float(text.split('about ')[1].split(' s')[0]) == pytest.approx(0.4, abs=0.06)
    assert 'odometer.time_offset = -0.' in text


@pytest.mark.parametrize('how', ['late', 'low pass'])
def test_spins_are_found_of_a_late_or_filtered_odometer(how):
    made = drive(scenario='straight', odometer='speed', slip_events=30.0, slip_size=1.0, seed=2)
    (sound,), (reason,) = (slips(calibrate(leg, settings(made, None))) for leg in (
        made.leg(), held_up(made.leg(), 0.4, how)))
    found, wanted = (r.text.split('in total at ')[1].split(' place')[0] for r in (reason, sound))
    assert found == wanted


@pytest.mark.parametrize(('slip', 'bends'), [(1.0, False), (0.0, False), (0.0, True)])
def test_a_bend_to_and_fro_is_no_slip(slip, bends):
    """Two lanes across and back within a window: a yaw of 3 deg left out, turns press ahead."""
    t, speed, off = np.arange(0.0, 60.0, 0.02), 12.0, np.deg2rad(3.0)
    there = (t > 30) & (t < 34)
    rate = np.where(there & bends, 0.7 * np.sin(2 * np.pi * (t - 30) / 4), 0.0)
    yaw = np.cumsum(rate) * 0.02
    q_nb = np.stack([0 * t, 0 * t, np.sin(yaw / 2), np.cos(yaw / 2)], -1)
    spun = slip * np.clip(t - 31.5, 0.0, 1.0)
    f_b = np.stack([0 * t, speed * rate, 0 * t + gravity(0.8, 0.0)], -1)
    track = Track(t, q_nb, speed * t + spun, np.zeros((len(t), 3, 3)))
    found = find_slips(t, f_b, track, np.array([np.cos(off), np.sin(off), 0.0]), 0.8, 0.01)
    assert len(found.t) == (slip > 0)
    assert found.size.sum() == pytest.approx(slip, abs=0.2)
    assert found.late == 0.0
