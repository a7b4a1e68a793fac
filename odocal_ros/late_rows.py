"""
Odometer rows that came late: a pause, then rows in a burst that catch up.

A counter without a header is stamped on the way: what holds a message up (a serial line, a busy
machine) looks like a wheel that slid and spun. Such rows are put where they belong: where the
sender's own rhythm has them, else where the travel on both sides of the burst does.
"""

import numpy as np

from odocal_ros.odometer_care import counter_steps
from odocal_ros.reasons import Code, Reason

PAUSE = 1.3         # median intervals: a longer one may be a row that is late
LEAST = 0.02        # s of lateness, and
SHARE = 0.3         # of a median interval, that matter
LONGEST = 5.0       # s within which a burst has caught up
SHORT = 1.0         # s within which travel is as good as even
EVEN = 0.5          # share of the intervals that are within a quarter of the median
COUNTS = 2.5        # by which a late row must be off: less is rounding
FITS = 0.3          # of what rows are off as sent, of smooth motion
SMOOTH = 3          # degree: acceleration that changes evenly
BESIDE = 5          # rows beside a burst that tell the speed there
FAST = 3.0          # times the speed beside: no wheel, so rows that catch up


def on_time(samples, t, form, found, name='odometer'):
    """
    Return when rows were taken: (n,) s, late ones put back.

    samples : OdometerSamples, usable.   t : (n,) s by stamps.   found : list that findings join.
    """
    if form.quantity == 'rate' or len(t) < 4 * BESIDE:
        return t       # what a late speed adds comes out right by itself
    step = (counter_steps(samples.value, form.modulus) if form.quantity == 'cumulative'
            else samples.value[1:].astype(float))
    travel = np.concatenate([[0.0], np.cumsum(step)])
    whole = np.issubdtype(samples.value.dtype, np.integer)
    true, count = _put_back(t, travel, COUNTS if whole else 0.0)
    late = t - true
    if count:
        worst = int(np.argmax(late))
        found.append(Reason(Code.ODOMETER_LATE, f'{int((late > 0).sum())} of {len(t)} {name} '
                            f'messages came late in {count} burst{"s" * (count > 1)}, by up to '
                            f'{late[worst]:.3g} s at t = {t[worst]:.2f} s; put where they belong, '
                            f'between the rows beside'))
    return true


def _put_back(t, travel, least):
    """Return times with late rows put back, and how many bursts there were."""
    dt = np.diff(t)
    usual = float(np.median(dt))
    if np.mean(np.abs(dt - usual) < usual / 4) < EVEN:
        return t, 0
    true, count, done = t.copy(), 0, 0
    for a in np.flatnonzero(dt > max(PAUSE * usual, usual + LEAST / 2)):
        if a < done:
            continue
        b, earliest = _caught_up(t, a, usual)
        if b <= a + 1 or t[a + 1] - earliest < max(LEAST, SHARE * usual):
            continue
        placed = _placed(t, travel, a, b, usual, least)
        if placed is not None:
            true[a + 1:b] = placed
            count, done = count + 1, b
    return true, count


def _caught_up(t, a, usual):
    """Return the row by which the rhythm is back after a pause behind row a, and a + 1's time."""
    end = np.searchsorted(t, t[a + 1] + LONGEST, side='right')
    back = t[a + 1:end] - usual * np.arange(end - a - 1)      # a row is never early
    first = int(np.argmax(back <= back.min() + SHARE / 3 * usual))
    return a + 1 + first, float(back[first])


def _placed(t, travel, a, b, usual, least):
    """Return the times of the rows between a and b, None where they were not late."""
    rows = np.arange(a + 1, b)
    about = slice(max(a - BESIDE, 0), b + BESIDE + 1)

    def off(times):
        """Return by how much travel at these times is off a smooth motion."""
        x = np.concatenate([t[about.start:a + 1], times, t[b:about.stop]])
        x = (x - x[0]) / (x[-1] - x[0])
        smooth = np.polynomial.Polynomial.fit(x, travel[about], SMOOTH, domain=[0, 1])
        return float(np.abs(travel[about] - smooth(x)).max())

    sent = off(t[rows])
    even = np.minimum(t[b] - (b - rows) * usual, t[rows])
    if even[0] > t[a] and off(even) <= max(FITS * sent, least):
        return even

    def speed(first, last):
        first, last = max(first, 0), min(last, len(t) - 1)
        return abs(travel[last] - travel[first]) / max(t[last] - t[first], usual / 10)

    beside = max(speed(a - BESIDE, a), speed(b, b + BESIDE))
    if t[b] - t[a] > SHORT or not beside or speed(a + 1, b) < FAST * beside:
        return None
    # some rows of the burst are lost, so that its rhythm tells nothing
    line = (travel[b] - travel[a]) / (t[b] - t[a])
    by_travel = t[a] + (travel[rows] - travel[a]) / line
    rising = np.maximum.accumulate(np.clip(by_travel, t[a], t[rows]))
    return rising + np.arange(1, len(rows) + 1) * 1e-9
