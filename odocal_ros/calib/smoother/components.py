"""
The variance components of a fit: how much of each noise there is beside how much there should be.

The restricted likelihood has its maximum where, for every component of level s with covariance
s V, r' R^-1 s V R^-1 r equals the trace of R^-1 s V less that of the part the unknowns take up,
P J' R^-1 s V R^-1 J (P the covariance of the unknowns). All arguments ``P`` are of
``Solved.neighbours``, residuals those that ``Weighted.after`` left.
"""

import numpy as np

from odocal_ros.calib.smoother.noise import INTERVAL
from odocal_ros.calib.smoother.state import E, M, SLOW, WITH_SLOW

ROAD = (('along', 'along_hard'), ('side', 'side_turn'), ('up',))


def components(w, neighbours) -> dict[str, tuple[float, float]]:
    """
    Return for each component its quadratic sum and what is expected of it.

    The restricted likelihood has its maximum where, for every component of level s with
    covariance s V, r' R^-1 s V R^-1 r equals the trace of R^-1 s V less that of the part the
    unknowns take up, P J' R^-1 s V R^-1 J (P the covariance of the unknowns).
    """
    sums = _interval_components(w, neighbours)
    sums |= _fix_components(w, neighbours)
    for rows in w.outside:
        sums |= rows.components(neighbours)
    e = w.travel_variance
    n = w.n
    spread = np.concatenate([neighbours[:, E, E], neighbours[-1:, n + E, n + E]])
    moving = ~w.eq.still
    x = w.reached.travel_error[moving]
    sums['travel'] = float((x**2).sum() / e), float((1 - spread[moving] / e).sum())
    if n == WITH_SLOW:
        sums |= _slow_components(w, neighbours)
    return sums


def units(w):
    """Return the whitened unit noises of the intervals, (K, 18, c), and J' of them."""
    noise = w.eq.noise
    root = np.sqrt([w.levels[INTERVAL[i]] for i in noise.component])
    A = w.whiten @ (noise.columns * root)
    return A, np.swapaxes(w.WJ, 1, 2) @ A


def road_noise(w, P):
    """
    Return the odometer's noise of each interval, along, side, up: (K, 3) each.

    First the best estimate in its own sigmas, second the variance that it should have: of 1,
    what the data can see.
    """
    A, Y = units(w)
    component = w.eq.noise.component
    pairs = [[INTERVAL.index(n) for n in names] for names in (
        ('along', 'along_hard'), ('side', 'side_turn'), ('up',))]
    estimate = np.einsum('kic,ki->kc', A, w.wr)
    seen = (A**2).sum(axis=1) - (Y * (P @ Y)).sum(axis=1)
    columns = [np.isin(component, pair) for pair in pairs]
    return (np.stack([estimate[:, c].sum(axis=1) for c in columns], -1),
            np.stack([seen[:, c].sum(axis=1) for c in columns], -1))


def _interval_components(w, P):
    noise = w.eq.noise
    A, Y = units(w)
    quadratic = (np.einsum('kic,ki->kc', A, w.wr)**2).sum(axis=0)
    expected = (A**2).sum(axis=(0, 1)) - (Y * (P @ Y)).sum(axis=(0, 1))
    return {name: (float(quadratic[noise.component == i].sum()),
                   float(expected[noise.component == i].sum()))
            for i, name in enumerate(INTERVAL)}


def _fix_components(w, P):
    n, k = w.n, w.eq.fixes.k
    own = np.r_[0:n, 2 * n:2 * n + M]
    J = w.by_interval(w.FJ)
    present = np.unique(k)
    block = P[present]
    X = J @ block[:, own[:, None], own]
    taken = (X * J).sum(axis=2)
    if n == WITH_SLOW:
        B = w.by_interval(w.FJ_end)
        end = np.arange(n + SLOW.start, n + SLOW.stop)
        taken = taken + 2 * ((J @ block[:, own[:, None], end]) * B).sum(axis=2)
        taken = taken + ((B @ block[:, end[:, None], end]) * B).sum(axis=2)
    taken = taken.reshape(len(present), -1, 3)
    rows = w.by_interval(np.ones((len(k), 3, 1))).reshape(len(present), -1, 3)
    r = w.fix_r**2
    known = w.eq.root[:, 2, 2] > 1e-5
    up_taken = taken[:, :, 2].sum()
    return {'fix': (float(r[:, :2].sum()),
                    float(rows[:, :, :2].sum() - taken[:, :, :2].sum())),
            'fix_up': (float(r[known, 2].sum()), float(known.sum() - up_taken))}


def _slow_components(w, P):
    n = w.n
    i = np.arange(SLOW.start, SLOW.stop)
    a, q = w.decay[:, None], w.slow_drive
    var = P[:, n + i, n + i] + a**2 * P[:, i, i] - 2 * a * P[:, i, n + i]
    r2 = w.slow_residual()**2
    first = w.reached.slow_n[0]**2 / w.slow_power, 1 - P[0, i, i] / w.slow_power
    num = (r2 / q).sum(axis=0) + first[0]
    den = (1 - var / q).sum(axis=0) + first[1]
    return {'slow': (float(num[:2].sum()), float(den[:2].sum())),
            'slow_up': (float(num[2]), float(den[2]))}
