"""Equations of the smoother: true at the truth, derivatives as finite differences have them."""

from dataclasses import replace

import numpy as np
import pytest
from smoother_legs import made, truth

from odocal_ros.calib.smoother.equations import Equations
from odocal_ros.calib.smoother.problem import Problem
from odocal_ros.calib.smoother.state import ACCEL, BARE, E, GNSS_DELAY, GYRO, IMPERFECT, M

ARMS = {'imu_lever_arm': (1.2, 0.3, 0.4), 'antenna_lever_arm': (0.5, -0.2, 1.5)}


@pytest.fixture(scope='module')
def perfect():
    drive, config, leg = made(imu_grade='perfect', fix_sigma=0.0, duration=150.0)
    leg = replace(leg, t_stop=60.0)
    problem = Problem.of(leg, config)
    return leg, problem, truth(drive, config, leg)


def test_the_truth_fulfils_the_equations(perfect):
    _, problem, state = perfect
    equations = Equations(problem, state, problem.sums(state))
    r = np.abs(equations.motion.residual)
    # trapezoid rule at 50 Hz: kinks of the profile within a step leave a few dt^2 / 12 of a jerk
    # of 3 m/s^3, 1e-4 m/s over an interval
    assert r[:, :6].max() < 2e-4
    assert r[:, 6:9].max() < 1e-7
    # the odometer's rounding: two ends of up to one count of 2 cm, less their mean
    assert r[:, 15:18].max() < 0.022
    assert np.abs(equations.fixes.raw).max() < 5e-4


def test_the_truth_of_an_accelerometer_with_scale_error_fulfils_them(perfect):
    error = 0.01
    drive, config, leg = made(imu_grade='perfect', fix_sigma=0.0, duration=150.0,
                              accel_scale_error=error)
    leg = replace(leg, t_stop=60.0)
    problem = Problem.of(leg, config)
    state = truth(drive, config, leg)
    c = state.constants.copy()
    c[ACCEL.start:ACCEL.start + 2] = error / (1 + error)      # of what is measured
    # on a level road the force along z is gravity, but for the tilt: the error a bias
    bias = state.accel_bias + [0.0, 0.0, error * 9.80154]
    state = replace(state, constants=c, accel_bias=bias)
    r = Equations(problem, state, problem.sums(state)).motion.residual
    _, without, straight = perfect
    kinks = Equations(without, straight, without.sums(straight)).motion.residual
    # no more than what the trapezoid rule leaves without a scale error; the error times the mean
    # force of each second would be off by 1 % of up to 0.2 m
    assert np.abs(r[:, :2] - kinks[:, :2]).max() < 2e-5
    assert np.abs(r[:, 3:5] - kinks[:, 3:5]).max() < 2e-5
    # and sums brought here from where there was none say the same, to first order
    none = replace(state, constants=state.constants - c * (np.arange(M) >= ACCEL.start))
    moved = Equations(problem, state, problem.sums(none)).motion.residual
    np.testing.assert_allclose(moved, r, atol=1e-9)


def _shaken(state):
    """Return a state off the truth, so that no term vanishes by symmetry."""
    rng = np.random.default_rng(1)
    step = 1e-3 * rng.standard_normal((len(state.t), BARE))
    step[:, 6:12] *= 0.1
    c = 1e-3 * rng.standard_normal(M)
    # of the size that there is: derivatives leave out how these change what the others do
    c[IMPERFECT] *= [1, 1, *[0.1] * 6, 1, 1, 1, 1, 1, 0.1, 0.003, 0.0, 0.0]
    return state.moved(step, c)


@pytest.mark.parametrize('where', ['begin', 'end', 'constants'])
def test_derivatives_of_the_motion(perfect, where):
    leg, problem, state = perfect
    leg = replace(leg, imu_arm=np.array(ARMS['imu_lever_arm']))
    problem = replace(problem, leg=leg)
    state = _shaken(state)
    sums = problem.sums(state)
    J, _ = Equations(problem, state, sums).jacobians(BARE)
    column = {'begin': 0, 'end': BARE, 'constants': 2 * BARE}[where]
    for i in range(M if where == 'constants' else BARE):
        h = {E: 1.0}.get(i, 1e-5) if where != 'constants' else 1e-5
        # every second keyframe moves: each interval sees one end move only
        moves = (np.arange(len(state.t)) % 2 == (0 if where == 'begin' else 1))

        def residual(size, i=i, moves=moves):
            step, c = np.zeros((len(state.t), BARE)), np.zeros(M)
            if where == 'constants':
                c[i] = size
            else:
                step[moves, i] = size
            there = state.moved(step, c)
            return Equations(problem, there, sums).motion.residual

        numeric = (residual(h) - residual(-h)) / (2 * h)
        seen = slice(None) if where == 'constants' else slice(0, None, 2)
        expected = J[seen, :, column + i]
        # left out: Earth rate times a second, 7e-5 rad, and half the attitude residual, 2e-4
        np.testing.assert_allclose(numeric[seen], expected, atol=3e-4 * max(
            1.0, np.abs(expected).max()), err_msg=str(i))


def test_derivatives_of_the_fixes(perfect):
    leg, problem, state = perfect
    leg = replace(leg, antenna_arm=np.array(ARMS['antenna_lever_arm']))
    problem = replace(problem, leg=leg)
    state = _shaken(state)
    J, Jc = Equations(problem, state, problem.sums(state)).fixes.jacobians(BARE)
    for i in range(BARE + M):
        h = 1e-4

        def raw(size, i=i):
            step, c = np.zeros((len(state.t), BARE)), np.zeros(M)
            if i < BARE:
                step[:, i] = size
            else:
                c[i - BARE] = size
            there = state.moved(step, c)
            return Equations(problem, there, problem.sums(there)).fixes.raw

        numeric = (raw(h) - raw(-h)) / (2 * h)
        expected = J[:, :, i] if i < BARE else Jc[:, :, i - BARE]
        if GYRO.start <= i - BARE < GYRO.stop:    # within a second: no fix sees it
            continue
        # biases act within a second by a few metres a unit: taken as under constant force and no
        # turn, of which a vehicle makes up to 0.3 rad
        loose = {3: 0.3, 4: 0.1}.get(i // 3, 1e-3)
        if i == BARE + GNSS_DELAY:      # the arm's swing at the mean turn rate of the second
            loose = 5e-3
        np.testing.assert_allclose(numeric, expected, atol=loose * max(
            1.0, np.abs(expected).max()), err_msg=str(i))
