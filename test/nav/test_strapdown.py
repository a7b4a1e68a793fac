# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Strapdown attitude: against loops and closed forms, orders of the error, chunk edges."""

from hypothesis import given, strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest

from odocal_ros.nav import strapdown
from odocal_ros.nav.geodesy import earth_rate_n, OMEGA
from odocal_ros.nav.rotations import (
    matrix_from_rpy,
    quat_conjugate,
    quat_from_matrix,
    quat_from_rotvec,
    quat_multiply,
)
from odocal_ros.nav.strapdown import attitude, prefix_product, rotation_increments

pytestmark = pytest.mark.core
ONE = np.array([0.0, 0.0, 0.0, 1.0])
STILL = np.zeros(3)


def angle(p, q):
    """Return the rotation between two attitudes, rad."""
    return 2 * np.linalg.norm(quat_multiply(quat_conjugate(p), q)[..., :3], axis=-1)


def stamps(n, rng, jitter=0.3):
    """Return n rising times about 5 ms apart, s."""
    return np.cumsum(0.005 * (1 + jitter * rng.uniform(-1, 1, n)))


@pytest.mark.parametrize('n', [0, 1, 2, 3, 4, 5, 63, 64, 65, 129, 4097, 20_000])
def test_prefix_product_equals_that_of_a_loop(n):
    q = quat_from_rotvec(np.random.default_rng(n).normal(0, 0.3, (n, 3)))
    before, expected, total = q.copy(), np.empty((n, 4)), ONE
    for k in range(n):
        expected[k] = total = quat_multiply(total, q[k])
    # a product rounds by some 2e-16; as a random walk over 20 000: 3e-14
    assert_allclose(prefix_product(q), expected, rtol=0, atol=1e-13)
    assert np.array_equal(q, before)        # the input is unchanged


@pytest.mark.parametrize('n', [2, 3, 4, 5, 6, 7, 100])
def test_constant_rate_on_uneven_stamps_is_exact(n):
    t, w = stamps(n, np.random.default_rng(1)), np.array([0.3, -1.0, 0.8])
    t_out, q = attitude(t, np.tile(w, (n, 1)), ONE, STILL)
    assert np.array_equal(t_out, t)
    assert_allclose(q, quat_from_rotvec((t - t[0])[:, None] * w), atol=1e-14)


def test_one_sample_gives_the_start_attitude_and_none_gives_none():
    q0 = quat_from_rotvec([0.1, 0.2, 0.3])
    t, q = attitude([5.0], np.ones((1, 3)), q0, np.ones(3), every=4)
    assert_allclose(t, [5.0])
    assert_allclose(q, [q0], atol=1e-16)
    t, q = attitude([], np.empty((0, 3)), q0, np.ones(3))
    assert t.shape == (0,)
    assert q.shape == (0, 4)


@pytest.mark.parametrize('latitude', [0.7, -0.7, 0.0, 1.5])
@pytest.mark.parametrize('every', [1, 50])
def test_attitude_at_rest_is_constant_for_hours(latitude, every):
    C_nb, hours = matrix_from_rpy([0.1, -0.2, 2.5]), 3
    t = np.arange(0.0, hours * 3600, 0.5)
    w_b = np.tile(C_nb.T @ earth_rate_n(latitude), (len(t), 1))
    _, q = attitude(t, w_b, quat_from_matrix(C_nb), earth_rate_n(latitude), every)
    # 21600 products of 2e-16 each, at worst of one sign
    assert angle(q, quat_from_matrix(C_nb)).max() < 5e-12
    # the Earth turns by 0.8 rad meanwhile: left out, the attitude is off by that
    _, q = attitude(t, w_b, quat_from_matrix(C_nb), STILL, every)
    assert angle(q[-1], quat_from_matrix(C_nb)) == pytest.approx(
        2 * np.sin(OMEGA * t[-1] / 2), rel=1e-9)


CONE, RATE = 0.05, 2 * np.pi * 3.0      # rad, half-angle; rad/s: 3 Hz


def coning(t):
    """Return attitude and turn rate, b, of a body in coning motion of its z axis."""
    axis = np.stack([np.cos(RATE * t), np.sin(RATE * t), np.zeros_like(t)], -1)
    w = np.stack([-np.sin(CONE) * np.sin(RATE * t), np.sin(CONE) * np.cos(RATE * t),
                  np.full_like(t, -2 * np.sin(CONE / 2)**2)], -1) * RATE
    return quat_from_rotvec(CONE * axis), w


def coning_error(t):
    """Return the attitude error over t, without the first and last interval (straight lines)."""
    truth, w = coning(t)
    phi = rotation_increments(t, w)[:, 1:-1]
    turned = prefix_product(quat_from_rotvec(phi.T))[-1]
    return angle(quat_multiply(truth[1], turned), truth[-2])


def even(n):
    return np.linspace(0.0, 1.0, n + 1)


def limping(n):
    """Return steps of 1 and 3 in turn: too uneven for the cubic, so all are two-sample."""
    return np.concatenate([[0.0], np.cumsum(np.tile([1.0, 3.0], n // 2))]) / (2 * n)


@pytest.mark.parametrize('n', [200, 400])
@pytest.mark.parametrize(('stamped', 'ratio'), [(even, 16), (limping, 4)])
def test_coning_error_is_of_fourth_order_and_with_two_samples_of_second(stamped, ratio, n):
    # next order: (RATE / n)^2 = 0.9 % at 200
    assert coning_error(stamped(n)) / coning_error(stamped(2 * n)) == pytest.approx(
        ratio, rel=0.05)


def test_drift_of_the_four_sample_form_in_closed_form():
    """
    The same with x = RATE h: RATE sin^2 CONE x^4 / 90.

    Weights (-1, 13, 13, -1) / 24 make increments of a sine 11/720 x^4 too short: as much of the
    area; within steps the true coning is x^2 / 12 (1 - x^2 / 20), of which the second term is
    not in the formula: 11/720 - 1/240 = 1/90.
    """
    t = even(400)
    x = RATE * t[1]
    # the next order is x^2 = 0.2 % of it times a few, CONE^2 = 0.25 %
    assert coning_error(t) == pytest.approx(RATE * np.sin(CONE)**2 * x**4 / 90, rel=0.02)


@given(seed=st.integers(0, 10_000))
def test_cubic_rate_about_one_axis_is_integrated_exactly(seed):
    """On stamps uneven by less than a factor of two, for all but the first and last interval."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.72, 1.4, 12))
    p = np.polynomial.Polynomial(rng.normal(0, 0.05, 4))
    w = p(t)[:, None] * [0.6, 0.0, -0.8]
    turned = np.diff(p.integ()(t))
    phi = rotation_increments(t, w)
    # rates of some 100 rad/s at t = 12: 1e-14 each, twenty operations
    assert_allclose(phi[0, 1:-1] / 0.6, turned[1:-1], atol=1e-11)
    assert_allclose(phi[1], 0, atol=1e-11)


@pytest.mark.parametrize('n', [2, 3])
def test_short_arrays_use_the_two_sample_form(n):
    t = np.array([0.0, 0.1, 0.25])[:n]
    w = np.array([[0.0, 0.0, 1.0], [0.0, 0.5, 2.0], [1.0, 0.0, 0.0]])[:n]
    h = np.diff(t)[:, None]
    straight = (w[:-1] + w[1:]) * h / 2 + np.cross(w[:-1], w[1:]) * h**2 / 12
    assert_allclose(rotation_increments(t, w).T, straight, atol=1e-17)


def test_rates_are_linear_around_a_gap_and_unchanged_elsewhere():
    rng = np.random.default_rng(6)
    w = rng.normal(0, 1, (40, 3))
    t = np.arange(40) * 0.01
    gapped = np.where(np.arange(40) > 20, t + 0.5, t)
    before, after = rotation_increments(t, w), rotation_increments(gapped, w)
    touched = [19, 20, 21]          # the gap itself and one interval each side
    others = np.setdiff1d(np.arange(39), touched)
    assert_allclose(after[:, others], before[:, others], atol=1e-15)
    h = np.diff(gapped)[touched, None]
    w0, w1 = w[touched], w[np.add(touched, 1)]
    assert_allclose(after[:, touched].T, (w0 + w1) * h / 2 + np.cross(w0, w1) * h**2 / 12,
                    atol=1e-15)


def test_equal_stamps_have_no_effect_on_the_attitude():
    w = np.random.default_rng(7).normal(0, 1, (6, 3))
    phi = rotation_increments(np.array([0.0, 1.0, 2.0, 2.0, 3.0, 4.0]), w)
    assert np.isfinite(phi).all()
    assert_allclose(phi[:, 2], 0, atol=0)


@pytest.mark.parametrize('n', [1, 2, 3, 4, 5, 8, 9, 1000, 1001])
@pytest.mark.parametrize('every', [1, 2, 3, 4, 7, 5000])
def test_decimation_keeps_epochs_of_the_full_result(n, every):
    rng = np.random.default_rng(n)
    t, w, earth = stamps(n, rng), rng.normal(0, 2, (n, 3)), rng.normal(0, 0.1, 3)
    t_all, q_all = attitude(t, w, ONE, earth)
    t_some, q_some = attitude(t, w, ONE, earth, every)
    keep = np.unique(np.append(np.arange(0, n, every), n - 1))
    assert np.array_equal(t_some, t_all[keep])
    assert angle(q_some, q_all[keep]).max() < 1e-13
    assert_allclose(np.linalg.norm(q_some, axis=1), 1, atol=5e-16)


@pytest.mark.parametrize('every', [1, 3, 4])
@pytest.mark.parametrize('chunk', [1, 2, 5, 16])
def test_result_does_not_depend_on_chunk_size(monkeypatch, every, chunk):
    rng = np.random.default_rng(8)
    t, w = stamps(203, rng, 0.9), rng.normal(0, 2, (203, 3))
    whole = attitude(t, w, ONE, STILL, every)[1], rotation_increments(t, w)
    monkeypatch.setattr(strapdown, 'SAMPLES_AT_A_TIME', chunk)
    assert_allclose(attitude(t, w, ONE, STILL, every)[1], whole[0], atol=1e-15)
    assert_allclose(rotation_increments(t, w), whole[1], rtol=0, atol=1e-18)
