# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Imu rows on the rhythm of their sender, where stamps jitter about it.

An Imu samples by its own crystal; what stamps its rows as they arrive makes jitter of some
milliseconds, or pairs. Integrals see the change from row to row times the jitter: with an engine's
vibration a noise many times the sensors' own. Rows are put on an even rhythm where rate and force
are evener so, as they would not be of an Imu that is asked at uneven times.
"""

from itertools import product

import numpy as np

from odocal_ros.data.arrays import Floats, Ints

BLOCK_TIME = 1.0          # s of rows in whose mean a lost row shows
WINDOW_BLOCKS = 20        # over which the rhythm is a mean: jitter over sqrt(2000) at 100 Hz
JITTER_SHARE = 2e-3       # of an interval, the least that is worth it
TESTED_ROWS = 20_000      # at the most, in as many
TESTED_GROUPS = 40        # groups, whose sums tell how sure it is
BESIDE, HERE, NODES = np.arange(-2, 3), 2, (0, 1, 3, 4)     # a row amid those of its cubic
SURE_SIGMAS = 4.0         # of that rows are evener on the rhythm: by chance once in 30,000


def on_rhythm(t: Floats, w: Floats, f: Floats) -> Floats:
    """
    Return when rows were sampled: (n,) s, rising.

    t : (n,) s by stamps, rising.   w, f : (n, 3) turn rate and specific force, in any unit.
    """
    usual = _interval(t)
    per = int(BLOCK_TIME / usual) if usual > 0 else 0
    if per < 10 or len(t) < WINDOW_BLOCKS * per:
        return t
    even = _rhythm(t, usual, per)
    jitters = np.median(np.abs(t - even)) > JITTER_SHARE * usual
    if not jitters or not _evener(t, even, w, f):
        return t
    # where rows that keep their stamps meet the others, none before the one before
    apart = 1e-9 * np.arange(len(t))
    rising: Floats = np.maximum.accumulate(even - apart) + apart
    return rising


def _interval(t: Floats) -> float:
    """Return the time from row to row, s, of the median of stretches of 100."""
    stretch = t[::100]
    return float(np.median(np.diff(stretch))) / 100 if len(stretch) > 1 else 0.0


def _rhythm(t: Floats, usual: float, per: int) -> Floats:
    """Return even times through the means of rows, where none is lost; elsewhere as they are."""
    n = len(t) // per * per
    rows = usual * np.arange(len(t))
    late = np.sort((t - rows)[:n].reshape(-1, per), axis=1)
    # without what a busy machine held up
    mean = late[:, per // 10:per - per // 10].mean(axis=1)
    lost = np.zeros(len(mean), bool)
    jump = np.abs(mean[2:] - mean[:-2]) > usual / 2       # a row, over a block that it may be in
    for shift in range(3):
        lost[shift:shift + len(jump)] |= jump
    even = t.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[True], lost, [True]]).astype(int)))
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        here = slice(first * per, len(t) if last * per == n else last * per)
        even[here] = rows[here] + _smooth(mean[first:last], per, here.stop - here.start)
    return even


def _smooth(mean: Floats, per: int, count: int) -> Floats:
    """Return how late rows are by means of blocks: a line and what windows differ, (count,) s."""
    middle = (np.arange(len(mean)) + 0.5) * per
    slope, first = np.polyfit(middle, mean, 1) if len(mean) > 1 else (0.0, mean[0])
    windows = np.array_split(np.arange(len(mean)), max(1, len(mean) // WINDOW_BLOCKS))
    off = mean - first - slope * middle
    rows = np.arange(count)
    return np.asarray(first + slope * rows + np.interp(
        rows, [middle[blocks].mean() for blocks in windows],
        [off[blocks].mean() for blocks in windows]))


def _evener(t: Floats, even: Floats, w: Floats, f: Floats) -> bool:
    """Tell whether rates and forces are surely evener on the rhythm than by the stamps."""
    rows = np.arange(2, len(t) - 2, max(1, len(t) // TESTED_ROWS))
    sent, put = _weights(t, rows), _weights(even, rows)
    gain = np.zeros(len(rows))
    for column in (*w.T, *f.T):
        near = column[rows[:, None] + BESIDE]
        # of noise alone both are its variance
        off, left = (np.einsum('mk,mk->m', near, x)**2 / (x**2).sum(axis=1) for x in (sent, put))
        rounding = 1e-18 * (near**2).mean() + 1e-30
        gain += np.clip((off - left) / max(np.median(off + left), rounding), -10.0, 10.0)
    sums = np.array([group.sum() for group in np.array_split(gain, TESTED_GROUPS)])
    return bool(sums.mean() > SURE_SIGMAS * sums.std() / np.sqrt(len(sums)))


def _weights(t: Floats, rows: Ints) -> Floats:
    """Return by what rows and those beside make how far rows are off a cubic: (m, 5)."""
    times = t[rows[:, None] + BESIDE]
    weights = np.full(times.shape, -1.0)
    for i, j in product(NODES, NODES):
        if i != j:
            apart = times[:, i] - times[:, j]
            weights[:, i] *= (times[:, HERE] - times[:, j]) / np.where(apart == 0, 1e-9, apart)
    weights[:, HERE] = 1.0
    return weights
