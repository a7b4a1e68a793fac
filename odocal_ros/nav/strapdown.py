# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Strapdown attitude: turn rates of the gyro to attitudes q_nb.

n is fixed to the Earth at the leg's start, so there is no transport rate; the Earth's rotation is
one closed-form rotation per epoch. The product of the body increments is a prefix scan: products
of blocks in parallel, then of the ends of blocks, without a loop over samples.
"""

import numpy as np

from odocal_ros.data.arrays import Complexes, Floats, map_rows, release_mapped_memory

Pairs = tuple[Complexes, Complexes]      # quaternions: w + x i, y + z i
# judgement: quaternions that a scan multiplies in sequence; 40 to 800 are equally fast
SCAN_BLOCK = 64
SAMPLES_AT_A_TIME = 16384    # judgement: intervals at a time, whose arrays stay in the cache
MIN_INTERVAL = 1e-9    # s, between stamps; judgement: keeps the slope finite if stamps are equal
# judgement: largest ratio of adjacent intervals for a cubic through them
EVEN_RATIO = 2.0


def rotation_increments(t: Floats, w_b: Floats, begin: int = 0, end: int | None = None) -> Floats:
    """
    Return the rotation vectors of b between samples: (n,), (n, 3) to (3, n - 1) rad.

    begin, end : range of intervals, by default all; bitwise equal to a computation of all.

    Rate as a cubic through four samples, with the coning term of the same order
    (Bortz: phi = int w + 1/2 int alpha x w); at the ends, and if stamps are uneven by more
    than a factor of two, as a straight line (the classic two-sample form). The algorithm error
    falls with the fourth power of the step, that of two samples with the second.
    """
    t, w_b = np.asarray(t, dtype=float), np.asarray(w_b, dtype=float)
    end = max(len(t) - 1, 0) if end is None else end
    phi = np.empty((3, end - begin))
    for first in range(begin, end, SAMPLES_AT_A_TIME):
        last = min(first + SAMPLES_AT_A_TIME, end)
        phi[:, first - begin:last - begin] = _increments(t, w_b, first, last)
        release_mapped_memory()
    return phi


def _increments(t: Floats, w_b: Floats, first: int, last: int,
                bias: float | Floats = 0.0) -> Floats:
    """Return the rotation vectors of the intervals from first up to last: (3, last - first)."""
    low, high = max(first - 1, 0), min(last + 1, len(t) - 1)     # with an adjacent row each side
    h = np.diff(t[low:high + 1])
    w = np.ascontiguousarray((w_b[low:high + 1] - bias).T)
    rise = w[:, 1:] - w[:, :-1]
    mid = w[:, :-1] + w[:, 1:]
    mid *= 0.5
    mean = mid * h
    if len(h) > 2:
        bow, twist = _bow(h, rise)
        mid[:, 1:-1] -= bow
        rise[:, 1:-1] -= twist
        bow *= h[1:-1] * (2 / 3)        # mean of the parabola: 2/3 of its bow, not all
        mean[:, 1:-1] -= bow
    h2 = h**2 / 12
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        mean[i] += (mid[j] * rise[k] - mid[k] * rise[j]) * h2
    return mean[:, first - low:first - low + last - first]


def _bow(h: Floats, rise: Floats) -> tuple[Floats, Floats]:
    """
    Return the height of the chord over its cubic in each inner interval: (3, m - 2).

    bow : chord minus cubic in the middle.
    twist : rise of the chord minus slope of the cubic in the middle times the interval.
    From divided differences of the rates over intervals h, (m,), with rises (3, m) over them.
    """
    safe = np.maximum(h, MIN_INTERVAL)
    curve = np.diff(rise / safe) / (safe[:-1] + safe[1:])       # half the second derivative
    before, step, after = safe[:-2], safe[1:-1], safe[2:]
    even = ((EVEN_RATIO * before > step) & (before < EVEN_RATIO * step)
            & (EVEN_RATIO * after > step) & (after < EVEN_RATIO * step))
    weight = np.where(even, step**2 / 4 / (before + step + after), 0.0)
    left, right = curve[:, :-1], curve[:, 1:]
    bow = left * (weight * (step / 2 + after)) + right * (weight * (step / 2 + before))
    return bow, (right - left) * (weight * step)


def _pairs_from_rotvec(phi: Floats) -> Pairs:
    """Return unit quaternions of (3, n) rotation vectors as two complex rows each."""
    half = np.sqrt(phi[0]**2 + phi[1]**2 + phi[2]**2) / 2
    s = np.sinc(half / np.pi) / 2
    a, b = np.empty(phi.shape[1], complex), np.empty(phi.shape[1], complex)
    a.real, a.imag, b.real, b.imag = np.cos(half), s * phi[0], s * phi[1], s * phi[2]
    return a, b


def _pairs(q: Floats) -> Pairs:
    """Return quaternions x y z w as two complex rows: w + x i and y + z i."""
    q = np.asarray(q, dtype=float)
    return q[..., 3] + 1j * q[..., 0], q[..., 1] + 1j * q[..., 2]


def _quats(pairs: Pairs) -> Floats:
    """Return the unit quaternions x y z w of two complex rows: (n, 4)."""
    a, b = pairs
    out = np.stack([a.imag, b.real, b.imag, a.real], axis=-1)
    out /= np.sqrt(np.einsum('ij,ij->i', out, out))[:, None]
    return out


def _product(p: Pairs, q: Pairs) -> Pairs:
    """Return the products of quaternions a + b j and c + d j; a = w + x i, b = y + z i."""
    (a, b), (c, d) = p, q
    return a * c - b * np.conj(d), a * d + b * np.conj(c)


def prefix_product(q: Floats) -> Floats:
    """Return q_0, q_0 q_1, q_0 q_1 q_2 ...: (n, 4) to (n, 4), unit quaternions x y z w."""
    return _quats(_scan(*_pairs(q)))


def _scan(a: Complexes, b: Complexes) -> Pairs:
    """Return the prefix products of n quaternions, by blocks; the ends of blocks recursively."""
    n = len(a)
    if n <= 2:
        if n == 2:
            a, b = a.copy(), b.copy()
            a[1], b[1] = _product((a[0], b[0]), (a[1], b[1]))
        return a, b
    width = min(SCAN_BLOCK, max(2, int(np.sqrt(n))))
    rows = -(-n // width)
    A, B = np.ones((rows * width), complex), np.zeros((rows * width), complex)
    A[:n], B[:n] = a, b
    A, B = (np.ascontiguousarray(x.reshape(rows, width).T) for x in (A, B))
    for k in range(1, width):
        A[k], B[k] = _product((A[k - 1], B[k - 1]), (A[k], B[k]))
    if rows > 1:
        ends_a, ends_b = _scan(A[-1, :-1], B[-1, :-1])
        for k in range(width):
            A[k, 1:], B[k, 1:] = _product((ends_a, ends_b), (A[k, 1:], B[k, 1:]))
    return A.T.reshape(-1)[:n], B.T.reshape(-1)[:n]


def _products(t: Floats, w_b: Floats, every: int, bias: float | Floats) -> Pairs:
    """Return the rotation over each ``every`` intervals; the last group may be shorter: pairs."""
    n = len(t) - 1
    groups = -(-n // every)
    a, b = np.empty(groups, complex), np.empty(groups, complex)
    step = max(1, SAMPLES_AT_A_TIME // every)
    for g in range(0, groups, step):
        first, last = g * every, min((g + step) * every, n)
        c, d = _pairs_from_rotvec(_increments(t, w_b, first, last, bias))
        if missing := -(last - first) % every:
            c = np.concatenate([c, np.ones(missing)])
            d = np.concatenate([d, np.zeros(missing)])
        C, D = c.reshape(-1, every), d.reshape(-1, every)
        c, d = C[:, 0], D[:, 0]
        for k in range(1, every):
            c, d = _product((c, d), (C[:, k], D[:, k]))
        a[g:g + step], b[g:g + step] = c, d
        release_mapped_memory()
    return a, b


def attitude(t: Floats, w_b: Floats, q_nb0: Floats, earth_rate_n: Floats, every: int = 1,
             bias: float | Floats = 0.0) -> tuple[Floats, Floats]:
    """
    Return times (m,), s, and attitudes (m, 4), unit quaternions, propagated with gyro samples.

    t : (n,) s, rising.   w_b : (n, 3) turn rate of b relative to inertial space, rad/s.   q_nb0 :
    (4,) attitude at t[0], x y z w.   earth_rate_n : (3,) rad/s (n is fixed to the Earth).
    every : keep one epoch in this many, and the last.   bias : (3,) of the gyro, rad/s.
    """
    t, w_b = np.asarray(t, dtype=float), np.asarray(w_b, dtype=float)
    if not len(t):
        return t, np.empty((0, 4))
    rows = np.append(np.arange(0, len(t) - 1, every), len(t) - 1)
    t_out = map_rows(lambda k: t[k], rows)
    a, b = (np.append(first, steps) for first, steps in zip(
        _pairs(q_nb0), _products(t, w_b, every, bias), strict=True))
    # n rotates with the Earth relative to the inertial frame that it equals at t[0]
    earth = _pairs_from_rotvec(np.multiply.outer(np.asarray(earth_rate_n), t[0] - t_out))
    return t_out, _quats(_product(earth, _scan(a, b)))
