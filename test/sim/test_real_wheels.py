# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Real wheels: what they grow and slip is in the truth; what is sent coarsely is not."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.sim import real_wheels
from odocal_ros.sim.options import resolved, SimOptions
from odocal_ros.sim.real import Real
from odocal_ros.sim.scenarios import motion_of, simulate

RUN = {'scenario': 'straight', 'duration': 400.0, 'imu_rate': 20.0}


def run(**figures):
    motion = motion_of(resolved(SimOptions(**RUN)))
    return motion, motion.at(np.arange(0, 400, 0.02)), Real(**figures)


def test_a_tyre_grows_with_the_square_of_the_speed_and_as_it_warms():
    _, state, real = run(speed_law=0.003, warming=0.002, warming_time=100.0)
    cruise = state.t == 250.0                        # 12 m/s since 85 s, rolling since 60 s
    want = 0.003 / 9 + 0.002 * (1 - np.exp(-190 / 100))
    # one step of 0.02 s more or less of warming
    assert real_wheels.growth(state, real)[cruise] == pytest.approx(want, abs=0.002 * 3e-4)


def test_tyres_slip_by_the_force_over_the_load():
    _, state, real = run(tyre_slip=1 / 30)
    spun = real_wheels.tyre_slip(state, real)
    a, b = (np.flatnonzero(state.t == x)[0] for x in (65.0, 80.0))
    push = 12 / 24                                    # m/s^2 between the blends of its ramp
    way = state.travel[b] - state.travel[a]
    air = real_wheels.AIR * (state.speed[a:b + 1]**2 * np.gradient(state.travel[a:b + 1])).sum()
    want = 2 / 30 * ((push / 9.81 + real_wheels.REST) * way + air)
    assert spun[b] - spun[a] == pytest.approx(want, rel=2e-3)      # the ends of the sum
    braked = real_wheels.tyre_slip(state, Real(tyre_slip=1 / 30, driven=False))
    assert braked[b] == 0
    assert braked[-1] < 0


def test_up_a_slope_tyres_slip_by_its_share_of_the_load():
    _, level, real = run(tyre_slip=1 / 30)
    up = replace(level, slope=np.full(len(level.t), 0.05))
    pulls = level.acceleration > 0.1
    more = real_wheels.slip_share(up, real) - real_wheels.slip_share(level, real)
    assert more[pulls] == pytest.approx(2 / 30 * 0.05)


@pytest.mark.parametrize('odometer', ['counts', 'speed', 'angle'])
def test_the_true_scale_is_metres_over_counts_between_the_marks(odometer):
    real = Real(speed_law=0.01, warming=0.01, warming_time=50.0, tyre_slip=1 / 30)
    drive = simulate(SimOptions(**RUN, odometer=odometer, real=real))
    t, value = (drive.odometer.stamp_ns - drive.options.start_ns) * 1e-9, drive.odometer.value
    way = ((value[1:] + value[:-1]) / 2 * np.diff(t)).sum()
    counted = way if odometer == 'speed' else value[-1] - value[0]
    # a pulse of 2 cm at either end; the sums of speeds at 50 Hz and of the truth's own steps
    at = 2 * 0.0213 / drive.truth.distance if odometer == 'counts' else 1e-6
    assert drive.truth.scale == pytest.approx(drive.truth.distance / counted, rel=at)
    assert drive.truth.scale_ratio == drive.truth.scale / drive.options.nominal_scale
    assert drive.truth.scale / drive.options.scale != pytest.approx(1, abs=1e-3)


def test_speeds_are_sent_in_steps_the_same_to_and_fro():
    v = np.array([0.0, 0.2, 0.3, 0.99, -0.99, 1.6])
    floor, near = (Real(speed_step=0.5, speed_rounding=r) for r in ('floor', 'round'))
    assert_allclose(real_wheels.coarse(v, floor), [0, 0, 0, 0.5, -0.5, 1.5])
    assert_allclose(real_wheels.coarse(v, near), [0, 0, 0.5, 1.0, -1.0, 1.5])
    assert_allclose(real_wheels.coarse(v, Real(dead_band=0.5)), [0, 0, 0, 0.99, -0.99, 1.6])


def test_a_coarse_speed_leaves_the_truth_alone():
    coarse, fine = (simulate(SimOptions(**RUN, odometer='speed', real=Real(**figures)))
                    for figures in ({'speed_step': 1 / 3.6}, {}))
    assert coarse.truth.scale == fine.truth.scale
    off = fine.odometer.value - coarse.odometer.value
    assert off.min() >= 0
    assert off.max() < 1 / 3.6


def test_a_filtered_speed_lags_a_ramp_by_its_time_constant():
    t = np.arange(0.0, 20.0, 0.05)
    sent = real_wheels.low_passed(1.5 * t, t, 0.4)
    # steps of first order: the input of a step counts as its end, half a step early
    assert sent[-1] == pytest.approx(1.5 * (t[-1] - 0.4 + 0.025), abs=1.5 * 0.05**2 / 0.4)
    assert real_wheels.low_passed(t, t, 0.0) is t
