# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Wheels that do not count, or count in one direction only, are reported with the time."""

from dataclasses import replace

from drives import changed, drive, seconds, settings
import numpy as np
import pytest

from odocal_ros.nav.odometer import Travel
from odocal_ros.reasons import Code
from odocal_ros.screening.inputs import ImuRows
from odocal_ros.screening.screen import screen
from odocal_ros.screening.wheel_faults import broken_wheel_reasons

pytestmark = pytest.mark.slow
TOWN = {'scenario': 'town', 'duration': 300.0, 'two_wheels': True}


def texts_of(made, **wheels):
    """Return the reasons that screening reports for a leg with changed counters."""
    leg = made.leg()
    leg = leg.with_rows(**{slot: changed(leg.rows(slot), value=change)
                           for slot, change in wheels.items()})
    return {r.code: r.text for r in screen(leg, settings(made))[1]}


@pytest.mark.parametrize('side', ['left', 'right'])
def test_a_wheel_that_never_counts_or_counts_down_is_reported(side):
    slot = 'odometer' if side == 'left' else 'odometer_right'
    text = texts_of(drive(**TOWN), **{slot: lambda a: a * 0})[Code.WHEEL_DEAD]
    assert text.startswith(f'the {side} wheel does not count: its travel is 0 % of that of the ')
    assert '(limit 2 %)' in text
    text = texts_of(drive(**TOWN), **{slot: lambda a: -a})[Code.WHEEL_REVERSED]
    assert text.startswith(f'the {side} wheel counts down')
    # two reversed wheels are outside this check
    both = texts_of(drive(**TOWN), odometer=lambda a: -a, odometer_right=lambda a: -a)
    assert not {Code.WHEEL_REVERSED, Code.WHEEL_DEAD} & set(both)


def test_a_wheel_that_stops_counting_is_reported_with_the_time():
    made = drive(**TOWN)
    t = seconds(made.leg(), made.odometer)
    k = np.searchsorted(t, 100.0)

    def dies(a):
        a[k:] = a[k]
    moves = np.flatnonzero(np.diff(made.odometer.value[k:]) > 0)[0]     # a red light?
    text = texts_of(made, odometer=dies)[Code.WHEEL_DEAD]
    at = float(text.removeprefix('the left wheel does not count from t = ').split()[0])
    # rows of 0.05 s, cells of 0.5 s; the last cell with counts contains the time of the fault
    assert abs(at - t[k + moves]) < 1.1
    right = np.abs(np.diff(made.odometer_right.value))
    share = float(text.split(' s on, in ')[1].split(' % of the travel of the right')[0])
    assert share == pytest.approx(100 * right[k:].sum() / right.sum(), abs=1.5)


def test_a_wheel_that_stops_for_seconds_is_reported_with_time_and_length():
    made = drive(**TOWN)
    t = seconds(made.leg(), made.odometer)
    rate = np.diff(made.odometer.value) > 5
    a, b = next((i, i + 80) for i in range(2000, 4000) if rate[i:i + 80].all())     # 4 s

    def hangs(value):
        value[b:] -= value[b] - value[a]
        value[a:b] = value[a]
    text = texts_of(made, odometer_right=hangs)[Code.WHEEL_DEAD]
    assert 'right wheel does not count in 1 interval, first from t = ' in text
    begin, length = (float(text.split(x)[1].split()[0]) for x in ('t = ', ' s for '))
    assert abs(begin - t[a]) < 1.1
    assert abs(length - 4.0) < 1.1


def robot(right_speed, left_speed, track=0.5, seconds_=200.0):
    """Return wheels and IMU of a robot; each wheel has one speed per segment of 10 s."""
    t = np.arange(0.0, seconds_, 0.02)
    k = (t // 10).astype(int)
    left, right = (np.cumsum(np.asarray(v)[k % len(v)]) * 0.02 for v in (left_speed, right_speed))
    turn = (right - left) / track
    w = np.stack([0 * t, 0 * t, np.gradient(turn, t) + 0.01], -1)
    f = np.stack([np.gradient(np.gradient((left + right) / 2, t), t), 0 * t, 0 * t + 9.8], -1)
    return [Travel(t, np.floor(w_ / 0.001), 1.0) for w_ in (left, right)], ImuRows(t, w, f)


def test_a_robot_may_turn_about_one_wheel_and_on_the_spot():
    wheels, imu = robot(right_speed=[0.5, 0.5, 0.3, 0.6], left_speed=[0.5, 0.0, -0.3, 0.6])
    assert broken_wheel_reasons(wheels, imu, 200.0) == ()
    # the same wheels with zero turn rate: one dead for a while, and opposite directions
    still = imu._replace(w_b=imu.w_b * 0)
    codes = {r.code for r in broken_wheel_reasons(wheels, still, 200.0)}
    assert codes == {Code.WHEEL_DEAD, Code.WHEEL_REVERSED}


def test_a_wheel_without_direction_is_reported_in_reverse_gear():
    wheels, imu = robot(right_speed=[0.5, 0.6, -0.3, 0.7, 0.3],
                        left_speed=[0.5, 0.5, -0.3, 0.7, 0.4])
    up = replace(wheels[1], s=np.append(0.0, np.cumsum(np.abs(np.diff(wheels[1].s)))))
    (reason,) = broken_wheel_reasons((wheels[0], up), imu, 200.0)
    assert reason.code is Code.WHEEL_REVERSED
    assert reason.text.startswith('the right wheel also counts up in reverse')
    assert 'first at t = 20.' in reason.text


def test_one_counter_sent_twice_is_not_a_second_wheel():
    left = drive(**TOWN).odometer.value
    text = texts_of(drive(**TOWN), odometer_right=lambda _: left)[Code.WHEEL_DEAD]
    assert 'one counter is sent twice' in text
