# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The experiments of docs/conventions.md on a simulated vehicle: signs are as stated."""

from dataclasses import replace
from pathlib import Path
import re

from drives import drive, settings, two_point
import numpy as np
import pytest

from odocal_ros.nav.rotations import (
    heading_from_yaw,
    matrix_from_quat,
    rpy_from_matrix,
    yaw_from_heading,
)
from odocal_ros.screening.screen import screen

PAGE = (Path(__file__).resolve().parent.parent / 'docs' / 'conventions.md').read_text()
STRAIGHT = {'scenario': 'straight', 'duration': 200.0, 'fix_noise': 'rtk', 'imu_grade': 'perfect'}
TURN = {'scenario': 'out_and_back', 'duration': 300.0, 'imu_grade': 'perfect'}


def seconds(made, samples):
    return (samples.stamp_ns - made.imu.stamp_ns[0]) * 1e-9


def at_rest(made):
    """Return the mean specific force of the first 50 s, before the vehicle moves, m/s^2."""
    return made.imu.f_i[seconds(made, made.imu) < 50.0].mean(axis=0)


def turning(made, samples):
    """Return a mask of the rows in the U turn of out_and_back, which is to the left."""
    times = np.linspace(0, made.options.duration, 30_000)
    left = times[made.motion.yaw_rate(times) > 0.01]
    t = seconds(made, samples)
    return (t > left[0]) & (t < left[-1])


def found(**options):
    made = drive(**STRAIGHT, **options)
    return two_point(made.leg(), settings(made)).estimates


def test_each_experiment_of_the_page_is_done_here():
    listed = [int(n) for n in re.findall(r'^\| (\d+) \|', PAGE, re.MULTILINE)]
    here = {int(n) for name in globals() for n in re.findall(r'_experiments?_(\d+)', name)}
    here |= {int(n) for name in globals() for n in re.findall(r'_and_(\d+)', name)}
    assert listed == list(range(1, len(listed) + 1))
    assert set(listed) == here


def test_experiment_1_gravity_shows_upwards():
    assert at_rest(drive(**STRAIGHT))[2] == pytest.approx(9.8, abs=0.05)


def test_experiment_2_a_left_turn_is_positive():
    made = drive(**TURN)
    rows = turning(made, made.imu)
    assert np.median(made.imu.w_i[rows, 2]) > 0.1


def test_experiment_3_acceleration_from_rest_is_positive():
    made = drive(**STRAIGHT, yaw=0.0, pitch=0.0)
    t = seconds(made, made.imu)
    assert made.imu.f_i[(t > 65) & (t < 80), 0].min() > 0.1


def test_experiment_4_lifting_the_left_side_increases_the_value():
    level, lifted = (at_rest(drive(**STRAIGHT, roll=np.deg2rad(a))) for a in (0.0, 5.0))
    assert lifted[1] - level[1] == pytest.approx(9.8 * np.sin(np.deg2rad(5)), abs=0.02)


def test_experiments_5_and_6_a_turn_of_the_wheel():
    radius, pulses = 0.3, 100
    made = drive(**STRAIGHT, scale=2 * np.pi * radius / pulses)
    counts = made.odometer.value
    assert (np.diff(counts) >= 0).all()
    turns = made.truth.distance / (2 * np.pi * radius)
    assert counts[-1] - counts[0] == pytest.approx(turns * pulses, abs=2)


def test_experiment_7_the_outer_wheel_travels_farther():
    made = drive(**TURN, two_wheels=True, wheel_difference=0.0)
    path = [np.ptp(w.value[turning(made, w)]) for w in (made.odometer, made.odometer_right)]
    assert path[1] > path[0]
    # the track width times half a turn
    assert (path[1] - path[0]) * made.truth.scale == pytest.approx(1.6 * np.pi, rel=0.02)


@pytest.mark.parametrize(('heading', 'grows'), [(np.pi / 2, 'longitude'), (0.0, 'latitude')])
def test_experiment_8_east_and_north(heading, grows):
    fix = drive(**STRAIGHT, heading=heading).fix
    moved = {name: np.ptp(getattr(fix, name)) for name in ('latitude', 'longitude')}
    values = getattr(fix, grows)
    assert values[-1] - values[0] == pytest.approx(moved[grows], rel=1e-3)
    assert moved[grows] > 10 * min(moved.values())


def test_experiments_9_and_10_compass_and_yaw():
    assert heading_from_yaw(0.0) == pytest.approx(np.pi / 2)               # east
    assert yaw_from_heading(np.pi) == pytest.approx(-np.pi / 2)            # south
    assert heading_from_yaw(0.1) < heading_from_yaw(0.0)                   # left: compass falls
    made = drive(**TURN, heading=np.pi / 2, heading_sigma=1e-4, yaw=0.0)
    yaw = np.unwrap([rpy_from_matrix(C)[2] for C in matrix_from_quat(made.heading.q_ni)])
    assert yaw[0] == pytest.approx(0.0, abs=1e-3)
    assert np.ptp(yaw) == pytest.approx(np.pi, abs=0.01)
    assert yaw[-1] > yaw[0]


def test_experiment_10_the_offset_is_added_to_the_topic():
    # a topic that points 90 deg to the left of the IMU x axis needs that subtracted
    made = drive(**STRAIGHT, heading_sigma=1e-4)
    q = made.heading.q_ni
    turned = np.stack([q[:, 0] - q[:, 1], q[:, 0] + q[:, 1], q[:, 2] + q[:, 3],
                       q[:, 3] - q[:, 2]], axis=1) / np.sqrt(2)     # Rz(90 deg) times q
    other = replace(made, heading=replace(made.heading, q_ni=turned))
    config = settings(made, None, alignment__heading_offset=-np.pi / 2)
    there, plain = (two_point(m.leg(), c).estimates['yaw_mounting_angle'].value
                    for m, c in ((other, config), (made, settings(made, None))))
    assert plain == pytest.approx(made.truth.yaw, abs=1e-3)      # as good as the heading
    assert there == pytest.approx(plain, abs=1e-9)


@pytest.mark.parametrize('angle', ['yaw', 'pitch'], ids=['11', '12'])
def test_experiments_11_and_12_the_mounting_angles(angle):
    name = f'{angle}_mounting_angle'
    before, after = (found(**{angle: np.deg2rad(a)})[name] for a in (1.0, 3.0))
    # rtk: 2 cm at either end of 670 m, up 4 cm
    assert after.value - before.value == pytest.approx(np.deg2rad(2.0), abs=5e-4)


def test_experiment_12_the_front_tilted_down_is_negative():
    assert at_rest(drive(**STRAIGHT, yaw=0.0, pitch=np.deg2rad(3.0)))[0] == pytest.approx(
        -9.8 * np.sin(np.deg2rad(3.0)), abs=0.01)


def test_experiment_13_larger_tyres():
    before, after = (found(scale=s)['scale_factor'] for s in (0.020, 0.021))
    assert after.value / before.value == pytest.approx(1.05, abs=2e-4)


def test_experiment_14_late_stamps_are_corrected():
    def first_metre(made, **changes):
        inputs, _ = screen(made.leg(), settings(made, **changes))
        return np.interp(1.0, inputs.travel.s * made.truth.scale, inputs.travel.t)
    late, right = drive(**STRAIGHT, odometer_delay=0.1), first_metre(drive(**STRAIGHT))
    assert first_metre(late) - right == pytest.approx(0.1, abs=0.03)       # a pulse is 2 cm
    assert first_metre(late, odometer__time_offset=-0.1) == pytest.approx(right, abs=0.03)


@pytest.mark.parametrize(('arm', 'grows'), [((2.0, 0.0, 0.0), 'longitude'),
                                            ((0.0, 2.0, 0.0), 'latitude')])
def test_experiment_15_lever_arms_are_forward_and_left(arm, grows):
    facing_east = {**STRAIGHT, 'heading': np.pi / 2}
    at_base, away = (drive(**facing_east, antenna_lever_arm=a).fix for a in ((0., 0., 0.), arm))
    radius = 6.38e6 * (np.cos(at_base.latitude[0]) if grows == 'longitude' else 1.0)
    moved = (getattr(away, grows)[:200] - getattr(at_base, grows)[:200]).mean() * radius
    assert moved == pytest.approx(2.0, abs=0.05)
