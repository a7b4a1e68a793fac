"""Odometer: counters, increments and speeds to travel, with rollover and resets undone."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.reasons import Code, Reason

RESET_FACTOR = 5.0   # a step this many times the 99th percentile of the rate is no motion


@dataclass(frozen=True, eq=False)
class Travel:
    """
    Travel of the odometer's measuring point.

    t : (n,) s since the start mark, rising.
    s : (n,) signed travel from the first row, in scale units (pulses, rad or configured m).
    quantum : size of one count in s, 0 for speeds and floats.
    """

    t: NDArray[np.float64]
    s: NDArray[np.float64]
    quantum: float

    def at(self, t):
        """Return travel at times t, linear between rows, constant outside."""
        return np.interp(t, self.t, self.s)


def travel(t, value, form, reversed_counts=False) -> tuple[Travel, tuple[Reason, ...]]:
    """
    Sum an odometer's rows up to travel.

    Parameters
    ----------
    t : (n,) array
        Times, s, rising.
    value : (n,) array
        As sent: int64 counters or float64.
    form : OdometerForm
        What the value means.
    reversed_counts : bool
        Positive values mean backwards.

    Returns
    -------
    Travel, and what was found: rollovers (undone), resets (bridged at the speed beside them).

    """
    whole = np.issubdtype(value.dtype, np.integer)
    reasons: tuple[Reason, ...] = ()
    if form.quantity == 'rate':
        step = (value[:-1] + value[1:]) / 2 * np.diff(t)
    elif form.quantity == 'increment':
        step = value[1:].astype(float)
    else:
        step, reasons = _counter_steps(t, value, form.modulus)
    s = np.concatenate([[0.0], np.cumsum(step)]) if len(value) else np.empty(0)
    quantum = 1.0 if whole and form.quantity != 'rate' else 0.0
    return Travel(t, -s if reversed_counts else s, quantum), reasons


def mean_travel(left: Travel, right: Travel) -> Travel:
    """Return the travel of the middle of the axle, on the left wheel's rows both have."""
    both = (left.t >= right.t[0]) & (left.t <= right.t[-1])
    t = left.t[both]
    s = (left.s[both] + right.at(t)) / 2
    return Travel(t, s - (s[0] if len(s) else 0.0), left.quantum / 2)


def _counter_steps(t, value, modulus):
    """Return steps of a counter as floats, rollover undone, resets bridged; and what was found."""
    if not np.issubdtype(value.dtype, np.integer):
        return _bridge_resets(t, value, np.diff(value))
    with np.errstate(over='ignore'):
        raw = np.diff(value)                       # wraps at 2^64 by itself
    step = raw
    if 0 < modulus < 2**63:
        half = modulus // 2
        step = (raw + half) % modulus - half
    rolled = np.flatnonzero(step != raw)
    step, reasons = _bridge_resets(t, value, step.astype(float))
    if len(rolled):
        reasons += (Reason(Code.COUNTER_ROLLOVER, f'the counter rolled over {len(rolled)} '
                           f'time{"s" * (len(rolled) > 1)} (modulus {modulus}), first at '
                           f't = {t[rolled[0] + 1]:.2f} s; undone'),)
    return step, reasons


def _bridge_resets(t, value, step):
    """Replace steps no wheel can make by the rate beside them."""
    if len(step) < 20:
        return step, ()
    dt = np.diff(t)
    dt = np.maximum(dt, np.median(dt))             # bursts of stamps are no speed
    rate = step / dt
    limit = RESET_FACTOR * np.percentile(np.abs(rate), 99)
    limit = max(limit, 3 / np.median(dt)) if np.issubdtype(value.dtype, np.integer) else limit
    bad = np.flatnonzero(np.abs(rate) > limit)
    if not len(bad) or limit == 0:
        return step, ()
    good = np.setdiff1d(np.arange(len(step)), bad)
    step = step.copy()
    step[bad] = np.interp(bad, good, rate[good]) * np.diff(t)[bad]
    jump = value[bad[0] + 1].item() - value[bad[0]].item()
    return step, (Reason(Code.COUNTER_RESET, f'the counter jumps by {jump:+.6g} at '
                         f't = {t[bad[0] + 1]:.2f} s ({len(bad)} such step'
                         f'{"s" * (len(bad) > 1)}): a reset, not motion; bridged at the speed '
                         'beside it'),)
