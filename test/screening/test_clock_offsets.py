# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Clock offsets of seconds: found from the motion and corrected; the values do not change."""

from dataclasses import replace

from drives import kept, reason_texts, settings
import numpy as np
import pytest

from odocal_ros.pipeline.calibrate import calibrate
from odocal_ros.reasons import Code
from odocal_ros.screening import clocks
from odocal_ros.screening.clocks import OFFSET_CELL

LABELS = {'odometer': {'odometer'}, 'fix': {'fix'}, 'imu': {'odometer', 'fix'}}
MADE = {'scenario': 'town', 'duration': 240.0, 'imu_grade': 'industrial'}


@pytest.fixture(scope='module')
def alone(made):
    return calibrate(made.leg(), settings(made, method='smoother'))


def with_clock_error(leg, slot, offset_s, arrivals):
    rows, offset_ns = leg.rows(slot), round(offset_s * 1e9)
    moved = replace(rows, stamp_ns=rows.stamp_ns + offset_ns,
                    received_ns=rows.received_ns + offset_ns * arrivals)
    return leg.with_rows(**{slot: moved})


@pytest.mark.parametrize(('slot', 'offset_s', 'arrivals'), [
    ('odometer', 5.0, True), ('odometer', -3.3, False), ('fix', 20.0, True), ('fix', -2.6, False),
    ('imu', 2.0, True)])
def test_clocks_that_are_seconds_apart_are_aligned(made, alone, slot, offset_s, arrivals):
    leg = with_clock_error(made.leg(), slot, offset_s, arrivals)
    result = calibrate(leg, settings(made, method='smoother'))
    texts = [r.text for r in result.reasons if r.code is Code.DELAY_SEEN]
    direction = 'late' if (offset_s > 0) != (slot == 'imu') else 'early'
    assert {text.split(' stamps')[0] for text in texts} == LABELS[slot]
    for text in texts:
        found_s, _, found_direction = text.split('about ')[1].split()[:3]
        assert found_direction == direction
        assert float(found_s) == pytest.approx(abs(offset_s), abs=OFFSET_CELL / 2)
    assert Code.CLOCKS_DIFFER not in reason_texts(result)
    for name in ('scale_factor', 'yaw_mounting_angle'):
        one, other = (x.methods['smoother'].estimates[name] for x in (result, alone))
        # the marks cut the topics at other samples, and a part of a cell remains as a delay
        assert abs(one.value - other.value) < 0.5 * other.sigma
        assert one.sigma == pytest.approx(other.sigma, rel=0.1)


@pytest.mark.parametrize(('slot', 'offset_s'), [
    ('odometer', 0.8), ('fix', 0.9), ('fix', -0.6), ('imu', 0.7), ('imu', -0.9)])
@pytest.mark.parametrize('wrong', ['stamp_ns', 'received_ns'])
def test_delays_below_a_second_are_estimated(made, alone, slot, offset_s, wrong):
    rows, offset_ns = made.leg().rows(slot), round(offset_s * 1e9)
    leg = made.leg().with_rows(**{slot: replace(rows, **{wrong: getattr(rows, wrong)
                                                         + offset_ns})})
    if wrong == 'stamp_ns' and slot == 'imu':
        leg = replace(leg, start_ns=leg.start_ns + offset_ns, stop_ns=leg.stop_ns + offset_ns)
    result = calibrate(leg, settings(made, method='smoother'))
    assert result.verdict is alone.verdict
    texts = [r.text for r in result.reasons if r.code is Code.DELAY_SEEN]
    differ = {text.split(' stamps')[0] for text in texts if 'differ by' in text}
    found = {text.split(' stamps')[0] for text in texts if 'accounted for' in text}
    assert differ == LABELS[slot]
    assert found == (LABELS[slot] if wrong == 'stamp_ns' else set())
    for name in ('scale_factor', 'yaw_mounting_angle'):
        one, other = (x.methods['smoother'].estimates[name] for x in (result, alone))
        assert abs(one.value - other.value) < 0.5 * other.sigma
        assert one.sigma == pytest.approx(other.sigma, rel=0.1)


def test_clocks_that_agree_are_unchanged(made, alone):
    assert Code.DELAY_SEEN not in reason_texts(alone)


@pytest.mark.parametrize('seconds', [0.1, 0.4, 0.6])
def test_a_leg_shorter_than_a_change_of_speed_is_not_aligned(made, seconds):
    short, end_ns = made.leg(), made.imu.stamp_ns[0] + round(seconds * 1e9)
    for slot in ('imu', 'odometer'):
        short = kept(short, slot, short.rows(slot).stamp_ns < end_ns)
    assert Code.DELAY_SEEN not in reason_texts(calibrate(short, settings(made)))


def test_nothing_is_aligned_without_accelerations():
    """At constant speed all offsets fit equally well; 0.3 m/s of noise is not motion."""
    rng = np.random.default_rng(1)
    assert clocks._delay(rng.normal(size=(1200, 1)), rng.normal(size=(1200, 3))) == 0.0
    steady = np.zeros((1200, 1))
    assert clocks._delay(steady, steady) == 0.0


@pytest.mark.parametrize('offset_s', [-7.3, 0.0, 3.37, 60.0])
def test_an_offset_is_found_to_a_fraction_of_a_cell(offset_s):
    """For a signal that is linear between cells, with independent noise of the same size."""
    rng = np.random.default_rng(2)
    t = OFFSET_CELL * np.arange(1600)
    bumps = rng.uniform(t[0], t[-1], 60)

    def signal(t):
        return np.exp(-((t[:, None] - bumps) / 1.5)**2 / 2).sum(axis=1, keepdims=True)

    x = signal(t) - signal(t).mean()
    y = signal(t - offset_s) - signal(t - offset_s).mean() + 0.3 * rng.normal(size=(len(t), 1))
    assert clocks._delay(y, x) == pytest.approx(offset_s, abs=OFFSET_CELL / 4)
