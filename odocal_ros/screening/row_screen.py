# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Usable rows of one topic: finite, in a possible range, rising stamps, no isolated outliers."""

from bisect import bisect_left
from dataclasses import replace
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Bools, chunks, Floats, Ints, map_windows, work_array
from odocal_ros.data.inputs import INPUTS, WHEELS
from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import Samples, take
from odocal_ros.nav.geodesy import LARGEST_FRAME
from odocal_ros.nav.time_series import gaps_in_rhythm
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening import glitches
from odocal_ros.screening.leg_kind import is_local
from odocal_ros.settings.config import Config

LABEL = {slot: one.label for slot, one in INPUTS.items()}
NO_ROW_CODES = {'imu': Code.NO_IMU, 'fix': Code.FIXES_UNUSABLE,
                **dict.fromkeys(WHEELS, Code.NO_ODOMETER)}

NO_RECEPTION = ('Drive under open sky if possible: the likely cause is a tunnel, buildings or '
                'trees. The leg stays valid; missing data increases the uncertainties.')


def topic_gap(slot: str, t: Floats) -> tuple[Reason, ...]:
    """Return TOPIC_GAP for the longest gap of a topic, far longer than its median interval."""
    gaps = gaps_in_rhythm(t)
    if not len(gaps):
        return ()
    begin, end = gaps[np.argmax(gaps[:, 1] - gaps[:, 0])]
    return (Reason(Code.TOPIC_GAP, f'{INPUTS[slot].label} gap of {end - begin:.2f} s at '
                   f't = {begin:.2f} s (median interval {np.median(np.diff(t)):.3f} s)',
                   NO_RECEPTION if slot == 'fix' else ''),)


def imu_gap(t_imu: Floats, t_from: float, t_stop: float, limit: float) -> tuple[Reason, ...]:
    """Return IMU_GAP if IMU data is missing for over ``limit`` s between t_from and t_stop."""
    t = t_imu[np.searchsorted(t_imu, t_from - 1e-9):
              np.searchsorted(t_imu, t_stop + 1e-9, side='right')]
    long = np.flatnonzero(map_windows(lambda t: np.diff(t) > limit, t))
    ends = [(t_from, t[0]), *zip(t[long], t[long + 1], strict=True), (t[-1], t_stop)] \
        if len(t) else [(t_from, t_stop)]
    gaps = [(float(b - a), float(a)) for a, b in ends if b - a > limit]
    if not gaps:
        return ()
    length, at = max(gaps)
    return (Reason(Code.IMU_GAP, f'no IMU data for {length:.2f} s at t = {at:.2f} s ({len(gaps)} '
                   f'gap{"s" * (len(gaps) > 1)}; the limit is {limit:g} s)'),)


def usable_rows(slot: str, leg: Leg, config: Config, offset: float,
                reasons: list[Reason]) -> tuple[Any, Floats]:
    """Return the usable rows of a topic, and their times from the start mark, s: (n,)."""
    sent = leg.rows(slot)
    if slot in WHEELS:
        sent = _with_zero_for_tiny_speeds(sent)
    good, impossible = _finite(sent, slot, leg, reasons)
    clean = sent if good.all() else take(sent, good)
    clean = _separate_equal_stamps(clean) if slot in WHEELS else clean
    clean = _spread_packets(clean, reasons) if slot == 'imu' else clean
    order = _rising(clean, slot, leg, reasons)
    clean = clean if order is None else take(clean, order)
    t = work_array(len(clean.stamp_ns))
    for some in chunks(len(t)):
        t[some] = (clean.stamp_ns[some] - leg.start_ns) * 1e-9 + offset
    spikes = np.zeros(len(t), bool)
    if slot == 'imu':
        spikes = glitches.imu_glitches(t, clean.w_i, clean.f_i, config.imu)
    elif slot in WHEELS and leg.form_of(slot).quantity == 'rate':
        spikes = glitches.speed_glitches(t, clean.value.astype(float))
    if spikes.any():
        reasons.append(Reason(Code.BAD_ROWS_DROPPED, f'{int(spikes.sum())} of {len(t)} '
                              f'{LABEL[slot]} messages are isolated outliers, first at t = '
                              f'{t[np.argmax(spikes)]:.2f} s; dropped'))
        # outliers and impossible values together may be a damaged group, unless one was found
        if not glitches.near_impossible_groups(impossible).any():
            rows = np.flatnonzero(good) if order is None else np.flatnonzero(good)[order]
            impossible[rows[spikes]] = True
            spikes |= _damaged(impossible, good, slot, reasons)[rows]
        clean, t = take(clean, ~spikes), t[~spikes]
    if len(sent.stamp_ns) and not len(t) and slot in NO_ROW_CODES:
        zero = int((sent.stamp_ns <= 0).sum())
        reasons.append(Reason(
            NO_ROW_CODES[slot],
            f'none of the {len(sent.stamp_ns)} {LABEL[slot]} messages is usable'
            + (f': {zero} have no stamp (0)' if zero else ': values are missing or impossible'),
            _unstamped_remedy(slot) if zero else 'Check the driver that sends these messages, and '
            'wait for valid values before the drive.'))
    return clean, t


def _unstamped_remedy(slot: str) -> str:
    return (f'Set {INPUTS[slot].clock or slot}.arrival_time to true, or let the driver stamp its '
            'messages.')


def _time_text(samples: Samples, index: int, leg: Leg) -> str:
    """Return the time of a row in seconds from the start mark (arrival time without a stamp)."""
    stamp = samples.stamp_ns[index]
    if stamp > 0:
        return f't = {(stamp - leg.start_ns) * 1e-9:.2f} s'
    return f't = {(samples.received_ns[index] - leg.start_ns) * 1e-9:.2f} s (arrival)'


def _finite(samples: Any, slot: str, leg: Leg, reasons: list[Reason]) -> tuple[Bools, Bools]:
    """Return masks of rows with a stamp and all required values, and of finite impossible rows."""
    stamped = samples.stamp_ns > 0
    finite, impossible = np.ones(len(stamped), bool), np.zeros(len(stamped), bool)
    limits = INPUTS[slot].value_limits
    for name in INPUTS[slot].required_columns:
        column = getattr(samples, name)
        invalid = glitches.is_impossible(name, column)
        if limits is not None:
            invalid |= ~((column >= limits[0]) & (column <= limits[1]))
        finite &= ~invalid
        impossible[invalid] |= np.isfinite(column[invalid]).all(axis=tuple(range(1, column.ndim)))
    if slot == 'fix':
        finite |= samples.status < 0       # a receiver without a fix publishes NaN: not a fault
    bad_value = 'hold NaN, Inf or an impossible value'
    if slot == 'fix' and is_local(samples):
        bad_value = ('hold NaN or a position more than '
                     f'{LARGEST_FRAME / 1000:g} km from the origin of its frame')
    for bad, what in ((~stamped, 'have no stamp (zero or negative)'),
                      (stamped & ~finite, bad_value)):
        if bad.any():
            first = int(np.argmax(bad))
            reasons.append(Reason(Code.BAD_ROWS_DROPPED, f'{int(bad.sum())} of {len(bad)} '
                                  f'{LABEL[slot]} messages {what}, first at '
                                  f'{_time_text(samples, first, leg)}; dropped',
                                  '' if stamped[first] else _unstamped_remedy(slot)))
    good = stamped & finite
    suspect = _damaged(impossible, good, slot, reasons,
                       min(glitches.DAMAGED_SHARE * len(impossible), glitches.SEVERAL_ROWS))
    return good & ~suspect, impossible


def _damaged(impossible: Bools, good: Bools, slot: str, reasons: list[Reason],
             limit: float = np.inf) -> Bools:
    """Return rows near groups of impossible rows; add ROWS_DAMAGED, or for more than ``limit``."""
    suspect = glitches.near_impossible_groups(impossible)
    count = int(impossible.sum())
    if suspect.any() or count > limit:
        reasons.append(Reason(Code.ROWS_DAMAGED, f'{count} of {len(impossible)} {LABEL[slot]} '
                              'messages hold impossible values or are outliers; '
                              f'{int((suspect & good & ~impossible).sum())} messages next to them '
                              'were dropped too'))
    return suspect


def _with_zero_for_tiny_speeds(samples: Any) -> Any:
    """Return odometer samples with zero for the tiny values of a decaying low-pass filter."""
    min_value = 1e-30    # m/s or rad/s: a filter of 0.4 s reaches it after half a minute
    tiny = (samples.value != 0) & (np.abs(samples.value) < min_value)
    return replace(samples, value=np.where(tiny, 0, samples.value)) if tiny.any() else samples


def _separate_equal_stamps(samples: Any) -> Any:
    """Return samples stamped at arrival, equal stamps 1 ns apart; repeated samples unchanged."""
    stamp = samples.stamp_ns
    step = np.diff(stamp)
    if (step > 0).all() or (step < 0).any() or (stamp != samples.received_ns).any():
        return samples
    repeated = np.diff(samples.value)[step == 0] == 0
    repeated_share = 1 / 3    # of all; if each sample is sent twice, it is a half
    if repeated.all() and len(repeated) > repeated_share * len(stamp):
        return samples
    order = np.arange(len(stamp))
    return replace(samples, stamp_ns=np.maximum.accumulate(stamp - order) + order)


def _spread_packets(imu: Any, reasons: list[Reason]) -> Any:
    """Return IMU samples; packets of one stamp are distributed over the time since the last."""
    stamp, packed_share = imu.stamp_ns, 1 / 3       # judgement: of all; fewer are duplicates
    step = np.diff(stamp)
    same = step == 0
    if same.sum() <= packed_share * len(stamp) or (step < 0).any():
        return imu
    repeated = np.all([(np.diff(x, axis=0) == 0).all(axis=1) for x in (imu.w_i, imu.f_i)], axis=0)
    if (same & ~repeated).sum() <= packed_share * len(stamp):
        return imu
    first = np.flatnonzero(np.append(True, ~same))
    count = np.diff(np.append(first, len(stamp)))
    # a packet after a gap has the usual duration
    usual = int(np.median(np.diff(stamp[first]))) if len(first) > 1 else 0
    duration = np.minimum(np.diff(stamp[first], prepend=stamp[0] - usual), usual)
    rows_to_last = np.repeat(first + count - 1, count) - np.arange(len(stamp))
    reasons.append(Reason(Code.STAMPS_NOT_RISING, f'{int(same.sum())} of {len(stamp)} '
                          f'{LABEL["imu"]} messages repeat the previous stamp: all messages of '
                          'a packet have one stamp; they were spread evenly over the time since '
                          'the previous packet',
                          'Stamp each message with the time of its measurement.'))
    return replace(imu, stamp_ns=stamp - rows_to_last * np.repeat(duration // count, count))


def _rising(samples: Samples, slot: str, leg: Leg, reasons: list[Reason]) -> Ints | None:
    """Return the largest set of rows with strictly increasing stamps; None for all."""
    stamp = samples.stamp_ns
    step = np.diff(stamp)
    if (step > 0).all():
        return None
    keep = _longest_rising(stamp)
    same, backward = int((step == 0).sum()), int((step < 0).sum())
    first = int(np.argmax(step <= 0)) + 1
    faults = [f'{same} repeat the previous stamp'] * (same > 0)
    faults += [f'{backward} backward step{"s" * (backward > 1)} (up to {-step.min() * 1e-9:.3g} '
               's)'] * (backward > 0)
    reasons.append(Reason(Code.STAMPS_NOT_RISING, f'{LABEL[slot]} stamps do not increase: '
                          f'{" and ".join(faults)}, first at {_time_text(samples, first, leg)}; '
                          f'{len(stamp) - len(keep)} of {len(stamp)} messages dropped'))
    return keep


def _longest_rising(stamp: Ints) -> Ints:
    """Return the indices of a longest strictly rising subsequence (patience sorting)."""
    tails: list[int] = []     # smallest last value of a rising subsequence of each length
    ends: list[int] = []      # its row
    before = np.full(len(stamp), -1)      # row before a row in its subsequence
    for i, value in enumerate(stamp.tolist()):
        k = bisect_left(tails, value)
        if k:
            before[i] = ends[k - 1]
        tails[k:k + 1], ends[k:k + 1] = [value], [i]
    keep, i = [], ends[-1]
    while i >= 0:
        keep.append(i)
        i = int(before[i])
    return np.array(keep[::-1])
