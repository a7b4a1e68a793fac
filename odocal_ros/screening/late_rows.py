# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Odometer rows that came late: a pause, then rows in a burst that catch up.

A counter without a header is stamped at arrival: what delays a message (a serial line, a busy
machine) looks like a wheel that slid and spun. No row is early, so the sender's even rhythm shows
in the rows that came soonest; that, later by what all rows are, is where the others are put, where
the counts bear it out; else where the travel on both sides of a burst has them.
"""

from itertools import pairwise

import numpy as np

from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.data.pieces import median
from odocal_ros.data.samples import OdometerForm, OdometerSamples
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.odometer_care import counter_steps

ON_TIME_WINDOW = 5.0      # s, judgement: within which some row comes on time
EVEN_BESIDE = 5           # judgement: rows to either side that determine the place of a row
LINE = (-EVEN_BESIDE, EVEN_BESIDE)
# definition: a line takes half the acceleration for lateness
CUBIC = (2 * LINE[0], *LINE, 2 * LINE[1])
LEAST_JITTER = 1e-4       # s, judgement: off the rhythm that is worth it
ROUNDING_COUNTS = 2.5     # judgement: that rounding may put a row off by


def on_time(samples: OdometerSamples, t: Floats, form: OdometerForm, found: list[Reason],
            name: str = 'odometer') -> Floats:
    """
    Return the sampling times of rows: (n,) s, late ones moved back.

    samples : OdometerSamples, usable.   t : (n,) s by stamps.   found : list that findings join.
    """
    if form.quantity == 'rate' or len(t) < 4 * EVEN_BESIDE:
        return t       # the travel of a late speed is still correct
    step = (counter_steps(samples.value, form.modulus) if form.quantity == 'cumulative'
            else samples.value[1:].astype(float))
    travel = np.concatenate([[0.0], np.cumsum(step)])
    whole = np.issubdtype(samples.value.dtype, np.integer)
    usual = interval(t)
    even_share = 0.3    # share of the intervals that are within a quarter of the median
    if np.mean(np.abs(np.diff(t) - usual) < usual / 4) < even_share:
        return t
    true = _put_back(t, travel, usual, ROUNDING_COUNTS if whole else 0.0)
    late = t - true
    named_late, named_late_share = 0.02, 0.3    # s, of an interval: the more is worth a word
    named = late > max(named_late, named_late_share * usual)
    if named.any():
        worst, times = int(np.argmax(late)), int((np.diff(named.astype(int)) == 1).sum())
        found.append(Reason(Code.ODOMETER_LATE, f'{int(named.sum())} of {len(t)} {name} messages '
                            f'came late, {max(times, 1)} time{"s" * (times > 1)}, by up to '
                            f'{late[worst]:.3g} s at t = {t[worst]:.2f} s; moved back between '
                            'their neighbours'))
    return true


def interval(t: Floats) -> float:
    """Return the sender's interval, s, lost and late rows notwithstanding."""
    usual = median(np.diff(t))
    interval_span = 5.0    # s over which the interval is taken
    n = min(max(int(interval_span / usual), 1), len(t) - 1) if usual > 0 else 1
    mean = median(t[n:] - t[:-n]) / n
    steady_share = 0.005    # by which it is another than the median: rows are lost
    return mean if abs(mean - usual) < steady_share * usual else usual


def _put_back(t: Floats, travel: Floats, usual: float, least: float) -> Floats:
    """Return times with late rows put back."""
    rows = usual * np.arange(len(t))
    ahead = int(ON_TIME_WINDOW / usual) + 1
    # those to come, not those before: a lost row sets the rhythm back
    even = rows + _least_of_next(t - rows, ahead)
    even += np.median(t - even)         # what all have is a delay, and no lateness
    least_late, late_share = 0.004, 0.1    # s, of an interval: the more of both matters
    late = t - even > max(least_late, late_share * usual)
    true = t.copy()
    edges = np.flatnonzero(np.diff(np.concatenate([[False], late, [False]]).astype(int)))
    fitting_share = 0.4    # of what rows are off as sent
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        about = np.arange(max(begin - EVEN_BESIDE, 0), min(end + EVEN_BESIDE, len(t)))
        sent, put = (_off(x, travel, LINE, about) for x in (t, even))
        fits = np.linalg.norm(put) < fitting_share * np.linalg.norm(sent)
        if np.abs(put).max() <= least or fits:
            true[begin:end] = even[begin:end]
        elif begin > 0 and end < len(t):
            true[begin:end] = _by_travel(t, travel, begin - 1, end, usual)
    true = _on_rhythm(true, t, travel, [even, *_middle(t, usual)], usual)
    floor = np.maximum.accumulate(np.concatenate([[-np.inf], true[:-1] + 1e-9]))
    return np.where((true > floor) | ~late, true, np.minimum(floor, t))


def _on_rhythm(true: Floats, t: Floats, travel: Floats, rhythms: list[Floats],
               usual: float) -> Floats:
    """
    Return times on that of several rhythms on which the travel is evenest, as they are if on none.

    What is left off a rhythm is stamped some milliseconds late, as a busy machine comes to it, or
    both ways, by a sender's clock that ticks seldom.
    """
    best, least = true, 1.0
    evener_share = 0.9    # of it, where all rows that are not late are put on the rhythm
    for even in rhythms:
        left = np.abs(true - even)
        jitters = (left > LEAST_JITTER) & (left < usual)
        rows = np.flatnonzero(jitters)
        sent, put = (np.linalg.norm(_off(x, travel, CUBIC, rows)) for x in (t, even))
        if put < evener_share * least * sent:
            best, least = np.where(jitters, even, true), float(put / sent)
    return best


def _middle(t: Floats, usual: float) -> list[Floats]:
    """Return the rhythm in the middle of rows, some of them early; none where rows are lost."""
    rows = usual * np.arange(len(t))
    middle_window = 20.0    # s of rows whose median is the middle: jitter over sqrt(600)
    blocks = np.array_split(t - rows, max(1, int(len(t) * usual / middle_window)))
    ends = np.cumsum([len(block) for block in blocks])
    at = [end - len(block) / 2 for end, block in zip(ends, blocks, strict=True)]
    off = [float(np.median(block)) for block in blocks]
    lost = any(abs(b - a) > usual / 4 for a, b in pairwise(off))
    return [] if lost else [rows + np.interp(np.arange(len(t)), at, off)]


def _least_of_next(x: Floats, count: int) -> Floats:
    """Return the least of each value and those after it, so many in all."""
    n, count = len(x), min(count, len(x))       # a wild interval asks for any number
    blocks = np.append(x, np.full(count - n % count + count, np.inf)).reshape(-1, count)
    since = np.minimum.accumulate(blocks, axis=1).ravel()       # from its block's first
    until = np.minimum.accumulate(blocks[:, ::-1], axis=1)[:, ::-1].ravel()   # to its last
    return np.minimum(until[:n], since[count - 1:count - 1 + n])


def _off(t: Floats, travel: Floats, beside: tuple[int, ...], rows: Ints) -> Floats:
    """Return by how much rows' travel is off the polynomial through rows so far beside: (m,)."""
    last = len(t) - 1
    nodes = [np.clip(rows + step, 0, last) for step in beside]
    times, here = [t[at] for at in nodes], t[rows]
    meant = np.zeros(len(rows))
    for at, time in zip(nodes, times, strict=True):
        weight = np.ones(len(rows))
        for other in times:
            if other is not time:
                apart = time - other        # none of rows that came at once, or at an end
                weight *= (here - other) / np.where(np.abs(apart) > 1e-9, apart, 1e-9)
        meant += weight * (travel[at] - travel[rows])
    whole = (rows + min(beside) >= 0) & (rows + max(beside) <= last)
    return np.where(whole, -meant, 0.0)


def _by_travel(t: Floats, travel: Floats, a: int, b: int, usual: float) -> Floats:
    """Return the times of the rows between a and b, as sent where they do not catch up."""
    rows = np.arange(a + 1, b)

    def speed(first: int, last: int) -> float:
        first, last = max(first, 0), min(last, len(t) - 1)
        size: float = abs(travel[last] - travel[first]) / max(t[last] - t[first], usual / 10)
        return size

    beside = max(speed(a - EVEN_BESIDE, a), speed(b, b + EVEN_BESIDE))
    even_travel = 1.0    # s within which travel is as good as even
    catching_up = 3.0    # times the speed beside: no wheel, so rows that catch up
    if t[b] - t[a] > even_travel or not beside or speed(a + 1, b) < catching_up * beside:
        return t[rows]
    if travel[a] == travel[b]:      # there and back: it gives no time
        return t[rows]
    # some rows of the burst are lost, so that its rhythm is useless
    by_travel = t[a] + (travel[rows] - travel[a]) * (t[b] - t[a]) / (travel[b] - travel[a])
    return np.maximum.accumulate(np.clip(by_travel, t[a], t[rows]))
