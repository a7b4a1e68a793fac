# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Odometer: travel from counters, increments and speeds, with rollovers and resets corrected."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, running_sum, runs, Values
from odocal_ros.data.samples import OdometerForm
from odocal_ros.nav import coarse_speed
from odocal_ros.reasons import Code, Reason

# judgement: a step this many times the 95th percentile of the moving rate is not motion
RESET_FACTOR = 5.0
# s to each side of a row for smoothing. Judgement: in which a vehicle accelerates evenly
SMOOTHING_REACH = 0.2
MIN_STEPS = 20     # judgement: steps required for a search for resets or a divisor


@dataclass(frozen=True, eq=False)
class Travel:
    """Travel of the odometer's measuring point, in scale units: pulses, rad or configured m."""

    t: Floats         # (n,) s since the start mark, rising
    s: Floats         # (n,) signed travel from the first row
    quantum: float    # size of one count, scale units; 0 for speeds and floats
    coarse: coarse_speed.CoarseSpeed | None = None    # its speeds, if published in steps
    name: str = ''         # of the wheel, '' for a single one or a mean
    # scale units, of a steered wheel from the axle that does not steer; 0: it does not steer
    distance_ahead: float = 0.0

    def at(self, t: Floats) -> Floats:
        """Return travel at times t, linear between rows, constant outside."""
        return np.interp(t, self.t, self.s)

    def smoothed(self) -> 'Travel':
        """
        Return travel with the rounding of counts smoothed by parabolas (Savitzky-Golay).

        The slope between rounded rows is not the speed: a fit of the delay would not converge with
        it if there are few other errors. Rows beside gaps and at the ends are not smoothed.
        """
        period = float(np.median(np.diff(self.t))) if self.quantum and len(self.t) > 1 else np.inf
        m = int(SMOOTHING_REACH / period)        # rows to each side
        if m < 2 or len(self.t) <= 2 * m:
            return self
        # parabola by least squares at its middle (Savitzky and Golay 1964)
        weights = 3.0 * (3 * m**2 + 3 * m - 1 - 5 * np.arange(-m, m + 1)**2)
        even = self.t[2 * m:] - self.t[:-2 * m] < 3 * m * period      # longer by half: a gap
        t, s = (np.concatenate([x[:m], np.where(even, np.convolve(
            x, weights / weights.sum(), 'valid'), x[m:-m]), x[-m:]]) for x in (self.t, self.s))
        return replace(self, t=t, s=s) if (np.diff(t) > 0).all() else self

    def mirrored(self, spans: Floats) -> 'Travel':
        """Return the travel with the counts in spans, (m, 2) s, reversed."""
        def sign(t: Floats) -> Floats:
            return np.where(((t[:, None] >= spans[:, 0]) & (t[:, None] < spans[:, 1])).any(axis=1),
                            -1.0, 1.0)
        step = np.diff(self.s, prepend=self.s[:1]) * sign(self.t)
        coarse = None if self.coarse is None else self.coarse.mirrored(sign(self.coarse.t))
        return replace(self, s=self.s[:1] + np.cumsum(step), coarse=coarse)


def make_travel(t: Floats, value: Values, form: OdometerForm, reversed_counts: bool = False,
                name: str = 'the counter') -> tuple[Travel, tuple[Reason, ...]]:
    """
    Return the travel from an odometer's rows, and reasons.

    t : (n,) times, s, rising.   value : (n,) raw: int64 counters or float64.   form : meaning of
    the values.   reversed_counts : positive values mean backwards.   name : of the counter in
    reasons. Rollovers are corrected, resets interpolated from the adjacent speed.
    """
    is_integer, sign = np.issubdtype(value.dtype, np.integer), -1.0 if reversed_counts else 1.0
    reasons: tuple[Reason, ...] = ()
    coarse = None
    if form.quantity == 'rate':
        speed = sign * value.astype(float, copy=False)
        coarse = coarse_speed.find_coarse_speed(t, speed)
        held = coarse_speed.find_held_speed(t, speed)
        # a held speed takes precedence over a finer step
        if held and (coarse is None or coarse.step < held.step / 2):
            coarse, speed = held, held.value
        step = (speed[:-1] + speed[1:]) / 2 * np.diff(t)
    elif form.quantity == 'increment':
        step = sign * value[1:].astype(float)
    else:
        step, reasons = _counter_steps(t, value, form.modulus, name)
        step = sign * step
    quantum = _quantum(step) if is_integer and form.quantity != 'rate' else 0.0
    return Travel(t, running_sum(step) if len(value) else np.empty(0), quantum, coarse), reasons


def _quantum(step: Floats) -> float:
    """Return the common divisor of steps of a counter, 1 if they hardly change."""
    size = np.abs(step)
    changes = np.count_nonzero(np.diff(size)) > MIN_STEPS
    if not changes or (size % 1).any() or size.max() > 2**53:
        return 1.0
    return float(np.gcd.reduce(size.astype(np.int64)))


def mean_travel(travels: Sequence[Travel]) -> Travel:
    """
    Return the mean travel of wheels, at the rows of the first one within the time span of all.

    n wheels round independently: the rounding error of their mean is that of a count over sqrt(n).
    """
    first, *others = travels
    if not others:
        return first
    if not all(len(travel.t) for travel in others):
        return Travel(first.t[:0], first.s[:0], first.quantum)
    common = (first.t >= max(travel.t[0] for travel in others)) & (
        first.t <= min(travel.t[-1] for travel in others))
    t = first.t[common]
    s = sum((travel.at(t) for travel in others), first.s[common]) / len(travels)
    return Travel(t, s - (s[0] if len(s) else 0.0), first.quantum / np.sqrt(len(travels)))


def without_rollover(step: Values, modulus: int) -> Values:
    """
    Return steps, (n,), without rollovers.

    modulus : of the counter; 0 for floats. Differences of 64-bit integers wrap already.
    """
    half = modulus // 2
    return (step + half) % modulus - half if 0 < modulus < 2**63 else step


def _counter_steps(t: Floats, value: Values, modulus: int,
                   name: str) -> tuple[Floats, tuple[Reason, ...]]:
    """Return steps of a counter as floats, rollovers and resets corrected; and the reasons."""
    is_integer = np.issubdtype(value.dtype, np.integer)
    raw = np.diff(value)
    unwrapped = without_rollover(raw, modulus)
    step = unwrapped.astype(float)
    resets = _find_resets(t, step, is_integer)
    rollovers = (unwrapped != raw) & ~resets
    reasons: tuple[Reason, ...] = ()
    if resets.any():
        first, count = int(np.argmax(resets)), int(resets.sum())
        step = _bridge_resets(t, step, resets)
        jump = value[first + 1].item() - value[first].item()
        reasons += (Reason(Code.COUNTER_RESET, f'{name} jumps by '
                           f'{jump:{"+" if is_integer else "+.6g"}} at t = '
                           f'{t[first + 1]:.2f} s ({count} such step{"s" * (count > 1)}): a '
                           'reset, not motion; interpolated from the adjacent speed'),)
    if rollovers.any():
        first, count = int(np.argmax(rollovers)), int(rollovers.sum())
        reasons += (Reason(Code.COUNTER_ROLLOVER, f'{name} rolled over {count} '
                           f'time{"s" * (count > 1)} (modulus {modulus}), first at t = '
                           f'{t[first + 1]:.2f} s; corrected'),)
    return step, reasons


def _find_resets(t: Floats, step: Floats, is_integer: bool) -> Bools:
    """Return a mask of impossible steps: far above the speed of the drive, single or in pairs."""
    dt = np.diff(t)
    if len(step) < MIN_STEPS or not step.any():
        return np.zeros(len(step), bool)
    period = np.median(dt)
    rate = np.abs(step) / np.maximum(dt, period)    # of bursts of stamps: not too large
    if not (rate > 0).any():       # steps so small that their rates are zero
        return np.zeros(len(step), bool)
    limit = RESET_FACTOR * np.percentile(rate[rate > 0], 95)
    resets = rate > (max(limit, 3 / period) if is_integer else limit)     # at least 3 counts
    # motion lasts for several steps; a reset is one large step, a false row is two
    for begin, end in runs(resets):
        if end - begin > 2:
            resets[begin:end] = False
    return resets


def _bridge_resets(t: Floats, step: Floats, resets: Bools) -> Floats:
    """Return the steps with those of resets replaced by the speed beside them: (n - 1,)."""
    dt = np.diff(t)
    step, rows = step.copy(), np.flatnonzero(resets)
    others = np.flatnonzero(~resets & (dt > 0))
    rate = step[others] / np.maximum(dt[others], np.median(dt))    # as in _find_resets
    step[rows] = np.interp(rows, others, rate) * dt[rows] if len(others) else 0.0
    return step
