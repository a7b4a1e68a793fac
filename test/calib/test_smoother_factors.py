# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Factors of the smoother: derivatives, and consistency of cost, step and likelihood."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline
from smoother_legs import leg_of, made, truth, with_velocity

from odocal_ros.estimator import state as layout
from odocal_ros.estimator.chain import NormalEquations, solve
from odocal_ros.estimator.equations import Equations, FACTORS, WeightedEquations
from odocal_ros.estimator.factors import motion
from odocal_ros.estimator.factors.axle import Axle
from odocal_ros.estimator.factors.motion import D, squared_bounce
from odocal_ros.estimator.factors.pseudo_observations import PriorRows, SIZE, SIZE_SPREADS
from odocal_ros.estimator.factors.slow_error import SlowError, TIME_SPREAD, USUAL_TIME
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.nav.coarse_speed import CoarseSpeed
from odocal_ros.nav.geodesy import rate_without_north
from odocal_ros.nav.odometer import Travel

pytestmark = pytest.mark.slow
N = layout.SIZE_WITH_SLOW
# clock rates, and the delays they cause
CLOCKS = {layout.GNSS_CLOCK: layout.GNSS_DELAY, layout.ODO_CLOCK: layout.ODO_DELAY}
END = 60.0      # s
COLUMNS = range(layout.M)
# relative errors neglected in derivatives. Motion: Earth rate times one second, 7e-5 rad, and
# half the attitude residual, 2e-4. Fixes, velocity, heading: second order of a turn of 1e-3 rad
LOOSE = {'motion': 3e-4, 'fixes': 1e-3, 'velocity': 2e-3, 'heading': 2e-3, 'steps': 2e-3}
# rotation of a lever arm: at the mean turn rate of the second, without its delay. Motion: a change
# of speed at the mean direction of both ends; a turn of 0.3 rad gives an error of 0.3 / 12 rad
SWING = {'fixes': 1e-2, 'steps': 0.03, 'motion': 2e-3}
# m/s^2, half the second derivative of counts of 0.021 m over 0.5 s, with three rounding errors
COUNTED = 0.03
# derivatives of velocity rows are means over a second: correct for the mean of its rows, except
# for motion before and after the second of a jump in turn rate, or of 2 m/s^2
MEANS = dict.fromkeys((*layout.AXES, *COLUMNS[layout.GNSS_ARM]), 0.02) | dict.fromkeys(
    (*COLUMNS[layout.GYRO], *COLUMNS[layout.ACCEL]), 0.13) | {layout.VELOCITY_DELAY: 0.1}


def by_second(rows, k):
    """Return the means of rows (m, d) of each interval k (m,)."""
    return np.stack([np.bincount(k, column) for column in rows.T], -1) / np.maximum(
        np.bincount(k), 1)[:, None]


@pytest.fixture(scope='module')
def moved():
    """Return the problem of a leg with all sensors, and a state in which no term vanishes."""
    drive, config, _ = made(imu_grade='perfect', fix_sigma=0.0, duration=150.0, heading_sigma=0.0,
                            pressure_sigma=0.0, antenna_lever_arm=(0.5, -0.3, 1.2))
    leg = replace(leg_of(with_velocity(drive, lambda e: 0 * e), config), t_stop=END,
                  imu_arm=np.array([1.2, 0.3, 0.4]))
    problem, state = make_problem(leg, config), truth(drive, config, leg)
    rng = np.random.default_rng(1)
    step = 1e-3 * rng.standard_normal((len(state.t), N))
    step[:, layout.PHI.start:layout.BG.stop] *= 0.1
    c = 1e-3 * np.insert(rng.standard_normal(layout.M - 9), [
        layout.FIX_MOTION_TIME, *2 * [layout.SCALE_BY_LEFT_FORCE - 1],
        layout.PITCH_LEAN.start - 2, *2 * [layout.BODY_TILT.start - 1],
        *3 * [layout.FIX_ERROR_BY_SIGMA.start - 6]], 1.0)
    # derivatives by biases treat these as constant within hills: no bump centre or body
    # centre of real size, because derivatives neglect how they change the effect of the others
    c[layout.SPEED_OFFSET], c[layout.FIX_MOTION_TIME], c[layout.LIFT] = 0.0, np.log(5.0), 0.01
    c[layout.MEAN_ROLL] = 0.01
    c[layout.IMPERFECTIONS] *= [*[1] * 7, *[0.1] * 6, *[1] * 8, 0.0, 0.1, 0.1, 0.1, 0.0, 0.03,
                                0.003, *[0.0] * 3, 10.0, 1e3, *[0.0] * 5, 1e3, 0.0, 1e3, 0.0, 0.0]
    c[layout.FIX_LAG2] = 2.1e-4    # not zero, where the filter changes its type
    c[layout.VELOCITY_LAG2] = 2.1e-4
    return problem, state.updated(step, c)


@pytest.fixture(scope='module')
def stepping(moved):
    """Return the problem of the same leg with a speed in whole km/h, and such a state."""
    problem, state = moved
    leg, step = problem.leg, 1 / 3.6
    t = np.arange(leg.t_begin, leg.t_stop, 0.1)
    speed = np.diff(leg.travel.at(np.append(t, t[-1] + 0.1))) / 0.1 * leg.rough_scale
    coarse = CoarseSpeed(step, t, np.floor(speed / step) * step)
    path = Travel(t, np.cumsum(coarse.value) * 0.1, 0.0, coarse)
    c = np.zeros(layout.M)
    c[layout.LN_K], c[layout.SPEED_OFFSET] = -np.log(leg.rough_scale), 0.1
    state = state.updated(np.zeros((len(state.t), N)), c)
    return replace(problem, leg=replace(leg, travel=path, rough_scale=1.0)), state


def without_steps(problem, state):
    """Return the problem with a travel whose speed is the state's at the keyframes."""
    wheel = Axle(problem, state).wheel_speed / state.scale
    s = np.append(0.0, np.cumsum(np.diff(state.t) * (wheel[1:] + wheel[:-1]) / 2))
    fine = np.arange(state.t[0] - 0.1, state.t[-1] + 0.1, 1e-3)
    path = Travel(fine, CubicHermiteSpline(state.t, s, wheel)(fine), 0.0)
    return replace(problem, leg=replace(problem.leg, travel=path))


def part_at(problem, state, name):
    return Equations(problem, state).factors[name]


# in a local frame the bias of the accelerometer turns with a robot
@pytest.mark.parametrize(('name', 'local'), [*((name, False) for name in LOOSE), ('fixes', True)])
def test_derivatives_equal_finite_differences(moved, stepping, name, local, monkeypatch):
    problem, state = stepping if name == 'steps' else moved
    if local:
        origin = replace(problem.leg.origin, local_earth_rate=rate_without_north(0.7))
        problem = replace(problem, leg=replace(problem.leg, origin=origin))
    stated = 1 + np.sin(problem.leg.t_fix)[:, None] * [0.3, 0.5, 0.7]     # m, sigmas that change
    problem = replace(problem, leg=replace(problem.leg,
                                           covariance_n=stated[:, :, None]**2 * np.eye(3)))
    held = []      # derivatives treat the bounce as constant
    monkeypatch.setattr(motion, 'squared_bounce', lambda *signals: held[0] if held else (
        held.append(squared_bounce(*signals)) or held[0]))
    part = part_at(problem, state, name)
    *ends, constants = part.jacobians(N)
    begin, end = ends if len(ends) == 2 else (*ends, np.zeros_like(ends[0]))
    if name == 'fixes':
        end[:, :, layout.SLOW] = -np.eye(3) * part.share[:, None, None]
    k = np.arange(len(part.raw)) if name == 'motion' else part.k
    # every second keyframe moves: each row has one moved end only
    even = np.arange(len(state.t)) % 2 == 0
    for i in range(N + layout.M):
        h = 1.0 if (i, name) == (layout.E, 'motion') else 1e-5 if name == 'motion' else 1e-4
        h /= END if i - N in CLOCKS else 1.0
        point = problem
        # counts have steps
        if i - N in (layout.ODO_DELAY, layout.ODO_CLOCK) and name == 'motion':
            point, h = without_steps(problem, state), 1e-3 / (END if i - N in CLOCKS else 1.0)
        middle = 0.0
        if (i, name) == (N + layout.ODO_LAG2, 'motion'):    # below zero it is linear
            middle, h = -0.02, 0.01

        def raw(size, i=i, point=point, middle=middle):
            step, c = np.zeros((len(state.t), N)), np.zeros(layout.M)
            if i < N:
                step[even, i] = size
            else:
                c[i - N] = middle + size
            return part_at(point, state.updated(step, c), name).raw

        expected = constants[:, :, i - N] if i >= N else np.where(
            even[k][:, None], begin[:, :, i], end[:, :, i])
        # g times the 1e-3 by which another constant tilts it
        loose = 0.01 if name == 'steps' and i - N in COLUMNS[layout.ACCEL] else LOOSE[name]
        if (i, name) == (N + layout.ODO_LAG2, 'motion'):
            loose = COUNTED
        if i - N in (layout.GNSS_DELAY, layout.ODO_DELAY, *CLOCKS):
            loose = SWING.get(name, loose)
        found, size = (raw(h) - raw(-h)) / (2 * h), max(1.0, np.abs(expected).max())
        if i - N in CLOCKS:         # the corresponding delay at the end of the leg
            size = max(1.0, END * np.abs(constants[:, :, CLOCKS[i - N]]).max())
        if name == 'velocity' and i - N in MEANS:
            found, expected, loose = by_second(found, k), by_second(expected, k), MEANS[i - N]
        np.testing.assert_allclose(found, expected, err_msg=str(i), atol=loose * size)
    assert begin[:, :, layout.P].any() == (name in ('motion', 'fixes'))


def test_path_of_a_speed_in_coarse_steps_does_not_determine_the_scale(stepping):
    problem, state = stepping
    by_constants = part_at(problem, state, 'motion').jacobians(N)[2]
    assert not by_constants[:, D, [layout.LN_K, layout.ODO_DELAY, layout.SPEED_OFFSET]].any()
    assert by_constants[:, D, layout.YAW].any()


def test_path_excludes_the_offset_while_a_coarse_speed_moves(stepping):
    problem, state = stepping
    # steps so fine that the path is used, with the same path
    problem = replace(problem, leg=replace(problem.leg, rough_scale=0.1))
    assert not problem.leg.uses_speed_steps

    def raw(size):
        c = np.zeros(layout.M)
        c[layout.SPEED_OFFSET] = size
        return part_at(problem, state.updated(np.zeros((len(state.t), N)), c), 'motion').raw

    by_offset = part_at(problem, state, 'motion').jacobians(N)[2][:, :, layout.SPEED_OFFSET]
    np.testing.assert_allclose((raw(0.01) - raw(-0.01)) / 0.02, by_offset, atol=1e-9)
    moves = np.linalg.norm(by_offset, axis=1)
    assert {0, 1} == set(np.rint(moves))        # seconds in motion, of each interval


@pytest.mark.parametrize('name', [part.name for part in FACTORS])
def test_cost_after_a_step_agrees_with_the_normal_equations(moved, stepping, name):
    problem, state = stepping if name == 'steps' else moved
    # sigmas so wide that there are no outliers: squares only
    wide = dict.fromkeys(('fix', 'fix_up', 'velocity', 'heading', 'pressure', 'steps'), 1e8)
    levels = problem.initial_levels.replaced(correlation_time=40.0, **wide)
    part = part_at(problem, state, name).weighted_copy(levels, layout.M)
    normal = NormalEquations(len(state.t), N, layout.M)
    part.add(normal)
    rng = np.random.default_rng(2)
    x, c = 1e-4 * rng.standard_normal((len(state.t), N)), 1e-4 * rng.standard_normal(layout.M)
    # the start is fixed, otherwise the chain has no solution: no prior
    x[0, layout.P.start:layout.PHI.stop] = 0.0
    # H x by blocks of the chain
    Hx = np.einsum('kij,kj->ki', normal.diagonal, x) + normal.coupling @ c
    Hx[:-1] += np.einsum('kij,kj->ki', normal.upper, x[1:])
    Hx[1:] += np.einsum('kji,kj->ki', normal.upper, x[:-1])
    Hc = normal.corner @ c + np.einsum('kij,ki->j', normal.coupling, x)
    change = (x * Hx).sum() + c @ Hc - 2 * ((normal.g * x).sum() + normal.g_constants @ c)
    before = part.cost()
    part.apply_step(x, c, state.updated(x, c))
    # standstills recompute their turns: second order in 1e-3 rad
    rel = 1e-2 if name == 'standstills' else 1e-6
    assert part.cost() - before == pytest.approx(change, rel=rel)
    assert change != 0.0


@pytest.mark.parametrize('name', ['slow', 'slow_up', 'correlation_time'])
def test_levels_of_correlated_errors_increase_the_restricted_likelihood(moved, name):
    problem, state = moved
    levels = problem.initial_levels.replaced(correlation_time=20.0, slow=0.01, slow_up=0.02,
                                           fix=1e4, fix_up=1e4, velocity=1.0)

    weighted, solution, at = least(problem, state, levels)
    quadratic, expected = weighted[SlowError].components(solution.marginals())[name]
    score = (quadratic - expected) / 2
    if name == 'correlation_time':      # the score itself, and the prior of the time
        score = quadratic - expected + np.log(20.0 / USUAL_TIME) / TIME_SPREAD**2
    assert score == pytest.approx(slope(at, levels, name), rel=1e-3)
    assert abs(score) > 0.1


def least(problem, state, levels):
    """
    Return rows and step near the minimum cost, where it does not change with the state.

    Also return a function of levels: rows, step and logarithm of the restricted likelihood.
    """
    def at(levels):
        weighted = WeightedEquations(Equations(problem, state), levels)
        solution = solve(weighted.normal())
        weighted.apply_step(solution)
        return weighted, solution, -0.5 * (weighted.cost() + weighted.log_R_total()
                                         + solution.log_determinant)

    for _ in range(3):
        _, solution, _ = at(levels)
        state = state.updated(solution.step, solution.step_constants)
    return *at(levels)[:2], at


def slope(at, levels, name):
    """Return the derivative of the likelihood by the logarithm of a level."""
    h = 1e-2      # at 1e-3 rounding of the cost is 1e-3 of the score
    above, below = (at(levels.replaced(**{name: levels[name] * np.exp(x)}))[2] for x in (h, -h))
    return (above - below) / (2 * h)


def sized(problem, where, sigma, mean):
    """Return a problem with other priors of some constants."""
    sigmas, means = problem.priors.sigma.copy(), problem.priors.mean.copy()
    sigmas[where], means[where] = sigma, mean
    return replace(problem, priors=replace(problem.priors, sigma=sigmas, mean=means))


# one alone and two of a kind. The drive determines them to 1e-4 s^2 and 6e-4, 1e-4 of the priors
@pytest.mark.parametrize(('name', 'where', 'prior'), [
    ('size_fix_lag_square', layout.constants_from('fix_lag_square', 'fix_lag_square'), 1.0),
    ('size_scale_by_force', layout.constants_from('scale_by_pull', 'scale_by_braking'), 0.1)])
def test_sizes_of_observable_constants_are_the_mean_of_their_likelihood(moved, name, where, prior):
    problem, state = moved
    problem = sized(problem, where, prior, 1.5 * prior)
    levels = problem.initial_levels
    weighted, solution, at = least(problem, state, levels)
    found = weighted[PriorRows].sizes(solution.marginals())[name]
    # 1.5 of the prior for each, and the log-normal prior of the size
    logs = np.log(SIZE) + np.arange(-2.5, 5.0, 0.25)
    likelihood = np.array([at(levels.replaced(**{name: float(np.exp(x))}))[2] for x in logs])
    likelihood -= ((logs - np.log(SIZE)) / SIZE_SPREADS[name])**2 / 2
    p = np.exp(likelihood - likelihood.max())
    assert found == pytest.approx((np.exp(logs) * p).sum() / p.sum(), rel=0.01)
    assert found > 1.5 * SIZE      # far from the initial value


def test_size_of_a_weakly_observable_constant_keeps_its_prior(moved):
    problem, state = moved
    where = layout.CONSTANTS.index('squat_by_jerk')
    # sigma 1e-3 by the drive, 7e-6 by the prior; a residual of 100 sigmas of the drive
    problem = sized(problem, where, 1e-5, 0.1)
    levels = problem.initial_levels
    weighted, solution, at = least(problem, state, levels)
    name = 'size_squat_by_jerk'
    assert slope(at, levels, name) > 0.1         # the likelihood increases with the size
    # (7e-6 / 1e-3)^2 of that slope, 5e-5: the size stays at the mean of its log-normal prior
    assert weighted[PriorRows].sizes(solution.marginals())[name] == pytest.approx(
        SIZE * np.exp(SIZE_SPREADS[name]**2 / 2), rel=1e-3)
