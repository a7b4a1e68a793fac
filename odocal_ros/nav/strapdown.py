"""
Strapdown attitude: gyro rates to q_nb, as a blocked prefix product of quaternions.

n is fixed to the Earth at the leg's start, so there is no transport rate; the Earth's own turn is
one closed-form rotation per output epoch, and the product of body increments is a prefix scan
without any per-sample loop.
"""

import numpy as np

from odocal_ros.nav.rotations import quat_from_rotvec, quat_multiply

BLOCK = 64   # quaternions a scan multiplies up in step; 40 to 800 make no difference


def rotation_increments(t, w_b):
    """
    Return the rotation vectors of b between samples: (n,), (n, 3) to (3, n - 1) rad.

    Rate as a cubic through four samples, with the coning term of the same order
    (Bortz: phi = int w + 1/2 int alpha x w); at the ends, and where stamps are uneven by more
    than a factor of two, as a straight line (the classic two-sample form). Algorithm error
    falls with the fourth power of the step, two-sample with the second.
    """
    h = np.diff(t)
    w = np.ascontiguousarray(np.asarray(w_b, dtype=float).T)
    mean = (w[:, :-1] + w[:, 1:]) / 2
    mid, slope = mean.copy(), (w[:, 1:] - w[:, :-1]) / h
    if len(t) > 3:
        before, after = h[:-2] / h[1:-1], h[2:] / h[1:-1]
        even = (before > 0.5) & (before < 2.0) & (after > 0.5) & (after < 2.0)
        weights = _cubic_weights(h[:-2], h[1:-1], h[2:])
        for line, weight in zip((mean, mid, slope), weights, strict=True):
            for axis in range(3):
                v = w[axis]
                fit = (weight[0] * v[:-3] + weight[1] * v[1:-2]
                       + weight[2] * v[2:-1] + weight[3] * v[3:])
                np.copyto(line[axis, 1:-1], fit, where=even)
    phi = mean * h
    h3 = h**3 / 12
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        phi[i] += (mid[j] * slope[k] - mid[k] * slope[j]) * h3
    return phi


def _cubic_weights(ha, h, hb):
    """Return the weights of four uneven samples in mean, middle and middle slope over h."""
    x = (-h / 2 - ha, -h / 2, h / 2, h / 2 + hb)      # abscissae about the middle
    h2 = h**2 / 12
    mean, mid, slope = [], [], []
    for i in range(4):
        p, q, r = (x[j] for j in range(4) if j != i)
        scale = 1 / ((x[i] - p) * (x[i] - q) * (x[i] - r))
        # basis (x-p)(x-q)(x-r) = x^3 - (p+q+r) x^2 + (pq+pr+qr) x - pqr
        pq = p * q
        mid.append(-scale * pq * r)
        mean.append(mid[-1] - scale * (p + q + r) * h2)
        slope.append(scale * (pq + (p + q) * r))
    return mean, mid, slope


def _pairs_from_rotvec(phi):
    """Return unit quaternions of (3, n) rotation vectors as two complex rows each."""
    half = np.sqrt(phi[0]**2 + phi[1]**2 + phi[2]**2) / 2
    s = np.sinc(half / np.pi) / 2
    a, b = np.empty(phi.shape[1], complex), np.empty(phi.shape[1], complex)
    a.real, a.imag, b.real, b.imag = np.cos(half), s * phi[0], s * phi[1], s * phi[2]
    return a, b


def prefix_product(q):
    """Return q_0, q_0 q_1, q_0 q_1 q_2 ...: (n, 4) to (n, 4), unit quaternions x y z w."""
    q = np.asarray(q, dtype=float)
    return _quats(*_scan(q[:, 3] + 1j * q[:, 0], q[:, 1] + 1j * q[:, 2]))


def _quats(a, b):
    out = np.stack([a.imag, b.real, b.imag, a.real], axis=-1)
    return out / np.linalg.norm(out, axis=-1)[:, None]


def _times(a, b, c, d):
    """Multiply quaternions a + b j and c + d j: with z = w + x i, y + z i for (a, b)."""
    return a * c - b * np.conj(d), a * d + b * np.conj(c)


def _scan(a, b):
    n = len(a)
    if n <= 2:
        if n == 2:
            a, b = a.copy(), b.copy()
            a[1], b[1] = _times(a[0], b[0], a[1], b[1])
        return a, b
    width = min(BLOCK, max(2, int(np.sqrt(n))))
    rows = -(-n // width)
    A, B = np.ones((rows * width), complex), np.zeros((rows * width), complex)
    A[:n], B[:n] = a, b
    A, B = np.ascontiguousarray(A.reshape(rows, width).T), \
        np.ascontiguousarray(B.reshape(rows, width).T)
    for k in range(1, width):
        A[k], B[k] = _times(A[k - 1], B[k - 1], A[k], B[k])
    if rows > 1:
        ends_a, ends_b = _scan(A[-1, :-1], B[-1, :-1])
        A[:, 1:], B[:, 1:] = _times(ends_a, ends_b, A[:, 1:], B[:, 1:])
    return A.T.reshape(-1)[:n], B.T.reshape(-1)[:n]


def attitude(t, w_b, q_nb0, earth_rate_n, every=1):
    """
    Propagate attitude through gyro samples.

    Parameters
    ----------
    t : (n,) array
        Sample times, s, rising; the attitude ``q_nb0`` holds at ``t[0]``.
    w_b : (n, 3) array
        Turn rate of b against inertial space, rad/s, bias removed.
    q_nb0 : (4,) array
        Attitude at t[0], x y z w.
    earth_rate_n : (3,) array
        Earth rate in n, rad/s (n is fixed to the Earth).
    every : int
        Keep each so-manieth epoch.

    Returns
    -------
    t_out : (m,) array
        Times of t[0], t[every], ...; the last sample is always kept.
    q_nb : (m, 4) array
        Attitude there, unit quaternions.

    """
    t = np.asarray(t, dtype=float)
    a, b = _pairs_from_rotvec(rotation_increments(t, w_b))
    n = len(a)
    groups = -(-n // every)
    A, B = np.ones(groups * every, complex), np.zeros(groups * every, complex)
    A[:n], B[:n] = a, b
    A, B = A.reshape(groups, every), B.reshape(groups, every)
    a, b = A[:, 0], B[:, 0]
    for k in range(1, every):
        a, b = _times(a, b, A[:, k], B[:, k])
    turned = _quats(*_scan(a, b)) if groups else np.empty((0, 4))
    q = np.concatenate([[[0.0, 0.0, 0.0, 1.0]], turned])
    keep = np.append(np.arange(0, n, every), n) if n else np.array([0])
    t_out = t[keep]
    inertial = quat_multiply(q_nb0, q)
    earth = quat_from_rotvec(-(t_out - t[0])[:, None] * np.asarray(earth_rate_n))
    return t_out, quat_multiply(earth, inertial)
