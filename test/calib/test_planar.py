# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The planar estimate and its increments: closed forms, truth within sigma, dense algebra."""

from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.calib.planar.fit import fit_run, LEVELS, noise_path
from odocal_ros.calib.planar.run import (
    make_side_wheels,
    PriorKnowledge,
    Run,
    WHEEL_DIFFERENCE,
    wheel_rows,
    Wheels,
)
from odocal_ros.estimator.result.wheel_regression import (
    _leave_one_out,
    _solve,
    fit_regression,
    Increments,
)

LEFT, RIGHT, WIDTH = 0.0352, 0.0349, 0.31     # m/rad, m
SCALES = np.array([0.0352, 0.0349, 0.0351, 0.0356])     # m/rad, of each wheel
STEP = 0.1      # s


def body(moves):
    """Return body increments (n, 3) of moves (forward m, left m, turn rad), 0.1 m or rad each."""
    parts = [np.zeros((20, 3))]
    for move in moves:
        n = max(2, round(float(np.abs(move).max()) / 0.1))
        parts += [np.tile(np.array(move) / n, (n, 1)), np.zeros((5, 3))]
    return np.concatenate(parts)


def run_of(d, kind='differential', arc=0.0, lateral=0.95, slip=0.0, noise=1e-4, every=1, rng=None,
           offset=0.0, count=4):
    """
    Return a Run from body increments; slip m/sqrt(m) of each wheel, noise m of positions.

    lateral : motion over wheel travel of mecanum wheels.   offset, count : of omni wheels.
    """
    turn = np.append(0.0, np.cumsum(d[:, 2])) + 0.3
    chord = (d[:, 0] + 1j * d[:, 1]) * np.sinc(d[:, 2] / (2 * np.pi))
    z = np.append(0.0, np.cumsum(chord * np.exp(1j * (turn[1:] + turn[:-1]) / 2)))
    delta = d[:, 2] * WIDTH         # right minus left wheel
    for _ in range(50 * bool(arc)):     # the width depends on the wheels
        straight = make_side_wheels((d[:, 0] - delta / 2) / LEFT, (d[:, 0] + delta / 2) / RIGHT,
                                    'skid').straightness
        delta = d[:, 2] / (1 / WIDTH + arc * straight)
    rows = wheel_rows(kind, count, offset)
    side = d[:, 1] / (lateral if kind == 'mecanum' else 1.0)
    metres = rows @ np.stack([d[:, 0], side, delta / 2])
    if slip:
        metres = metres + slip * np.sqrt(np.abs(metres)) * rng.standard_normal(metres.shape)
    scales = SCALES[:len(rows)] if len(rows) > 2 else (LEFT, RIGHT)
    counts = metres.T / scales
    node = np.arange(0, len(z), every)
    position = np.stack([z.real, z.imag], -1)[node]
    if rng is not None:
        position = position + noise * rng.standard_normal(position.shape)
    return Run(STEP * np.arange(len(z)), Wheels(counts, rows, kind), node, position,
               np.full(len(node), noise))


SQUARES = [m for side in (1, -1) for _ in range(4) for m in ((2, 0, 0), (0, 0, side * np.pi / 2))]
SQUARES += [(2, 0, 0)]
SIDEWAYS = [(2, 0, 0), (0, 1.5, 0), (0, 0, 2), (-1, 0, 0), (0, -1, 0), (0, 0, -1.5), (1, 1, 0)]


def value(found, name):
    i = found.names.index(name)
    return found.value[i], np.sqrt(found.covariance[i, i])


OMNI = [(count, offset) for count in (3, 4) for offset in (0.0, 0.5, -2.0)]


@pytest.mark.parametrize(('moves', 'options', 'expected', 'loose'), [
    # squares in both directions separate ratio and width
    (SQUARES, {}, (LEFT, RIGHT, 1 / WIDTH), 2e-7),
    (SIDEWAYS * 2, {'kind': 'mecanum', 'lateral': 0.9}, (*SCALES, 1 / WIDTH, 0.9), 1e-5),
    *((SIDEWAYS * 2, {'kind': 'omni', 'offset': offset, 'count': count},
       (*SCALES[:count], 1 / WIDTH), 1e-5) for count, offset in OMNI),
    # turns on the spot and arcs of two radii: the width changes by a third
    ([*SQUARES, (2, 0, 1.2), (1.5, 0, -0.8), (2, 0, -2.0), (1, 0, 2.0)],
     {'kind': 'skid', 'arc': 1.0}, (LEFT, RIGHT, 1 / WIDTH, 1.0), 1e-5)])
def test_fit_without_noise_is_exact(moves, options, expected, loose):
    found = fit_run(run_of(body(moves), **options), PriorKnowledge())
    assert found.converged
    assert_allclose(found.value[:len(expected)], expected, rtol=loose)
    offset = found.names.index('ahead')
    assert_allclose(found.value[offset:offset + 2], 0.0, atol=loose)


def test_offset_of_the_tracked_point_gyro_scale_and_bias_are_estimated_exactly():
    """A point 0.1 m ahead and 0.05 m right of the axle moves when the robot turns."""
    run = run_of(body(SQUARES))
    psi = np.append(0.0, np.cumsum(body(SQUARES)[:, 2])) + 0.3
    arm = (0.1 - 0.05j) * np.exp(1j * psi)
    run = replace(run, position=run.position + np.stack([arm.real, arm.imag], -1))
    found = fit_run(run, PriorKnowledge())
    assert_allclose(found.value[3:5], (0.1, -0.05), atol=1e-5)
    assert_allclose(found.value[2], 1 / WIDTH, rtol=1e-5)
    run = run_of(body(SQUARES))
    turn = body(SQUARES)[:, 2]
    found = fit_run(replace(run, gyro=1.02 * turn + 0.01 * STEP), PriorKnowledge())
    assert_allclose(1 + value(found, 'gyro_scale')[0], 1 / 1.02, rtol=1e-5)
    assert_allclose(value(found, 'gyro_bias')[0], 0.01 / 1.02, rtol=1e-3)


def test_wheels_that_differ_by_a_few_per_cent_do_not_affect_the_scale(monkeypatch):
    """Without sideways motion, one difference of four wheels is known from its prior only."""
    run = run_of(body([(2, 0, 0), (0, 0, 1.5), (2, 0, 0)]), 'mecanum')
    sigma = np.sqrt(np.diag(fit_run(run, PriorKnowledge()).covariance)[:4])
    assert (sigma < 1.2 * WHEEL_DIFFERENCE * SCALES).all()
    monkeypatch.setattr('odocal_ros.calib.planar.run.WHEEL_DIFFERENCE', 0.3)
    assert (np.sqrt(np.diag(fit_run(run, PriorKnowledge()).covariance)[:4]) > 2 * sigma).all()


@pytest.mark.parametrize('kind', ['differential', 'mecanum', 'omni'])
def test_wheel_table_inverts_the_wheel_rows(kind):
    """The table is the pseudo-inverse of the rows: numpy.linalg.pinv."""
    rows = wheel_rows(kind, 5, 0.3)
    table = Wheels(np.zeros((1, len(rows))), rows, kind).wheels_to_body
    assert_allclose(table, np.linalg.pinv(rows) * [[1], [1], [2]], atol=1e-12)


def test_omni_rows_agree_with_omni_wheel_drive_controller():
    """ros2_controllers, test_odometry.cpp: 1 m/s turns wheels of 0.1 m by 0, 10, 0, -10 rad/s."""
    forward, left, turn = (wheel_rows('omni', 4) @ np.eye(3) / 0.1).T
    assert_allclose(forward, (0, 10, 0, -10), atol=1e-12)
    assert_allclose(left, (-10, 0, 10, 0), atol=1e-12)
    assert_allclose(turn, -10)


def test_sigma_of_a_straight_run_equals_the_bound():
    """
    Positions at both ends and a gyro without turns give one equation for the scale.

    Variance of the distance: two white errors, the change of the drift, slip along the path.
    """
    run = run_of(body([(8, 0, 0)]))
    run = replace(run, node=run.node[[0, -1]], position=run.position[[0, -1]],
                  sigma=np.array([0.01, 0.02]), gyro=np.zeros(len(run.t) - 1))
    known = PriorKnowledge(offset_sigma=1e-6, delay_sigma=1e-6, gyro_noise=1e-6,
                           gyro_bias_sigma=1e-6)
    found = fit_run(run, known)
    path = noise_path(run, LEFT)
    level = {name: sigma**2 for name, sigma in found.levels.items()}
    student = 6 / 8         # information of the Student distribution
    variance = (level['white'] / student * (0.01**2 + 0.02**2)
                + 2 * level['drift'] / student * (1 - np.exp(-path.sum() / known.drift_length))
                + level['along'] * path.sum())
    mean = np.array([0.5, 0.5])
    sigma = np.sqrt(mean @ found.covariance[:2, :2] @ mean)
    # prior sigma of each factor: 0.35
    information = 8**2 / variance + 2 / 0.35**2
    assert_allclose(sigma / LEFT, information**-0.5, rtol=2e-2)
    assert level['along'] == pytest.approx(LEVELS['along'], rel=0.5)


@pytest.mark.slow
@pytest.mark.parametrize('kind', ['differential', 'skid', 'mecanum', 'omni'])
def test_truth_is_within_sigma(kind):
    """Ten runs with slip and noise: the rms of error over sigma is that of ten draws."""
    sideways = [(0, 1, 0), (0, -1.2, 0)] * (kind in ('mecanum', 'omni'))
    arcs = [(2, 0, 1.2), (2, 0, -1.5)]
    off = []
    for seed in range(10):
        rng = np.random.default_rng(100 + seed)
        d = body(SQUARES + arcs + sideways)
        found = fit_run(run_of(d, kind, arc=0.5 * (kind == 'skid'), slip=3e-3, noise=0.005,
                               every=2, rng=rng, count=3), PriorKnowledge())
        truth = {'left': LEFT, 'right': RIGHT, 'inverse_track_width': 1 / WIDTH, 'arc': 0.5,
                 'lateral': 0.95} | {f'wheel_{k}': one for k, one in enumerate(SCALES, 1)}
        off.append([(value(found, n)[0] - truth[n]) / value(found, n)[1]
                    for n in found.names[:found.names.index('ahead')]])
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    # the rms of 10 is 1 +- 0.22; left and right are almost the same draw
    assert (rms < 1.6).all(), rms
    assert (rms > 0.4).all(), rms


K = 300             # increments of a drive of five minutes
PATH = 10.0          # m, per increment
NO_READING = 1e-16      # m^2


def increments(seed=0, walk=1e-3**2, reading=0.0, k=K, ratio=1e-3):
    """Return equal increments with random walk, m^2 per second, and reading variance, m^2."""
    draw = np.random.default_rng(seed)
    error = np.sqrt(walk) * draw.standard_normal(k) + np.diff(
        np.sqrt(reading) * draw.standard_normal(k + 1))
    path = np.full(k, PATH)
    return Increments(ratio * path + error, path[:, None], np.array([np.inf]), np.zeros(1),
                      max(reading, NO_READING), np.ones(k), np.zeros(k, int), np.array([2e-3**2]))


def uneven():
    """Return increments of three kinds with two unknowns, one with a prior."""
    draw = np.random.default_rng(3)
    k = 40
    return Increments(
        draw.standard_normal(k), draw.standard_normal((k, 2)), np.array([np.inf, 0.3]),
        np.array([0.0, 0.7]), 0.2, draw.uniform(0.1, 1.0, k), draw.integers(0, 3, k),
        np.array([0.5, 1.0, 2.0])), draw.uniform(1.0, 3.0, k), np.array([0.3, -0.2, 0.1, 0.4])


def dense(seen, spread, log_levels):
    """Return the full covariance of increments from readings and random walk."""
    k = len(seen.y)
    D = np.diff(np.eye(k + 1), axis=0)
    walk = (seen.walk * np.exp(log_levels[:-1]))[seen.kind] * seen.walk_time * spread
    return np.diag(walk) + seen.reading * np.exp(log_levels[-1]) * D @ D.T


def test_fit_equals_least_squares_with_the_full_covariance():
    seen, spread, levels = uneven()
    V = dense(seen, spread, levels)
    x, covariance, cost, banded, root = _solve(levels, seen, spread)
    information = seen.X.T @ np.linalg.solve(V, seen.X) + np.diag(1 / seen.prior**2)
    expected = seen.mean + np.linalg.solve(
        information, seen.X.T @ np.linalg.solve(V, seen.y - seen.X @ seen.mean))
    assert_allclose(covariance, np.linalg.inv(information), rtol=1e-10)
    assert_allclose(x, expected, rtol=1e-10)
    off, before = seen.y - seen.X @ x, x - seen.mean
    quadratic = off @ np.linalg.solve(V, off) + before @ (before / seen.prior**2)
    assert cost == pytest.approx(np.linalg.slogdet(V)[1] + np.linalg.slogdet(information)[1]
                                 + quadratic, rel=1e-10)
    inverse = np.linalg.inv(V)
    assert_allclose(_leave_one_out(banded, root, off), inverse @ off / np.sqrt(np.diag(inverse)),
                    rtol=1e-9)
    assert_allclose(banded[1], np.diag(V))


def test_ratio_with_a_random_walk_only_is_that_of_the_end_points():
    line = fit_regression(seen := increments(walk=1e-3**2))
    assert line.x[0] == pytest.approx(seen.y.sum() / seen.X.sum(), rel=1e-6)
    # the logarithm of a variance from k increments has sigma sqrt(2 / k); the prior is far wider
    level, = line.levels
    assert abs(np.log(level / 1e-3**2)) < 4 * np.sqrt(2 / K)
    assert np.sqrt(line.covariance[0, 0]) == pytest.approx(np.sqrt(level / K) / PATH, rel=1e-4)


@pytest.mark.parametrize(('walk', 'reading'), [
    (1e-3**2, 0.0), (0.0, 0.01**2), (1e-3**2, 0.01**2), (0.02**2, 1e-3**2)])
def test_sigmas_hold_for_walk_and_reading_errors(walk, reading):
    """40 drives: their rms has an error of 1 / sqrt(80), four times that is 0.45."""
    lines = [fit_regression(increments(seed, walk, reading)) for seed in range(40)]
    off = np.array([(line.x[0] - 1e-3) / np.sqrt(line.covariance[0, 0]) for line in lines])
    assert np.sqrt((off**2).mean()) == pytest.approx(1.0, abs=0.45)


def test_each_kind_has_a_separate_walk_level():
    draw = np.random.default_rng(1)
    kind = np.arange(900) % 3
    walk = np.array([0.5e-3, 1e-3, 4e-3])**2
    seen = increments(k=900)
    seen = replace(seen, kind=kind, walk=np.full(3, 2e-3**2),
                   y=1e-3 * PATH + np.sqrt(walk[kind]) * draw.standard_normal(900))
    # each from 300 increments; the common prior has a sigma of 1 and moves them by (2 / 300)
    # of their distance from the mean, which is 2.2 at most
    assert np.abs(np.log(fit_regression(seen).levels / walk)).max() < 4 * np.sqrt(2 / 300) + 0.02


def test_outlying_and_uncertain_increments_have_less_weight():
    seen = increments()
    jumps = np.zeros(K)
    jumps[[50, 120, 200]] = 0.3, 0.2, -0.1       # m, with a walk of 1 mm
    line, clean = fit_regression(replace(seen, y=seen.y + jumps)), fit_regression(seen)
    sigma = np.sqrt(clean.covariance[0, 0])
    # with full weight 0.4 m in 3000 m, 2300 sigma
    assert abs(line.x[0] - clean.x[0]) < 2 * sigma
    assert np.sqrt(line.covariance[0, 0]) < 2 * sigma
    seen = increments(reading=1e-3**2)
    walk_time, y = seen.walk_time.copy(), seen.y.copy()
    walk_time[100:103], y[100:103] = 1e10, 5.0
    line, clean = fit_regression(replace(seen, walk_time=walk_time, y=y)), fit_regression(seen)
    assert abs(line.x[0] - clean.x[0]) < np.sqrt(clean.covariance[0, 0])


def test_gain_maps_increments_to_x_and_mirrored_wheels_have_negative_x():
    """Increments proportional to X return x unchanged, without a prior."""
    seen = increments(reading=1e-3**2)
    line = fit_regression(seen)
    assert_allclose(line.gain @ seen.X, np.eye(1), rtol=1e-9)
    assert line.gain @ seen.y == pytest.approx(line.x, rel=1e-9)
    other = fit_regression(replace(seen, y=-seen.y))
    assert_allclose(other.x, -line.x, rtol=1e-12)
    assert_allclose(other.covariance, line.covariance, rtol=1e-12)
