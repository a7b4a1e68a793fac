# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Usable rows of one topic: finite, in a possible range, rising stamps, no isolated outliers."""

from bisect import bisect_left
from dataclasses import replace
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Bools, chunks, Floats, Ints, work_array
from odocal_ros.data.inputs import INPUTS, WHEELS
from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import Samples, take
from odocal_ros.nav.geodesy import LARGEST_FRAME
from odocal_ros.nav.time_series import gaps_in_rhythm, gaps_longer
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening import glitches
from odocal_ros.screening.inputs import UsableRows
from odocal_ros.screening.leg_kind import is_local
from odocal_ros.settings.config import Config

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


def imu_gap(t_imu: Floats, t_start: float, t_stop: float, limit: float) -> tuple[Reason, ...]:
    """Return IMU_GAP if IMU data is missing for over ``limit`` s between t_start and t_stop."""
    t = t_imu[np.searchsorted(t_imu, t_start - 1e-9):
              np.searchsorted(t_imu, t_stop + 1e-9, side='right')]
    intervals = [(t_start, t[0]), *gaps_longer(t, limit), (t[-1], t_stop)] if len(t) else [
        (t_start, t_stop)]
    gaps = [(float(end - begin), float(begin)) for begin, end in intervals if end - begin > limit]
    if not gaps:
        return ()
    length, begin = max(gaps)
    return (Reason(Code.IMU_GAP, f'no IMU data for {length:.2f} s at t = {begin:.2f} s '
                   f'({len(gaps)} gap{"s" * (len(gaps) > 1)}; the limit is {limit:g} s)'),)


def usable_rows(slot: str, leg: Leg, config: Config,
                offset: float) -> tuple[UsableRows, list[Reason]]:
    """Return the usable rows of a topic, and reasons; offset : added to their times, s."""
    samples = leg.rows(slot)
    if slot in WHEELS:
        samples = _with_zero_for_tiny_speeds(samples)
    is_valid, impossible, reasons = _find_valid_rows(samples, slot, leg)
    rows = samples if is_valid.all() else take(samples, is_valid)
    if slot in WHEELS:
        rows = _separate_equal_stamps(rows)
    if slot == 'imu':
        rows, packet_reasons = _spread_packets(rows)
        reasons += packet_reasons
    order, order_reasons = _rising_rows(rows, slot, leg)
    reasons += order_reasons
    rows = rows if order is None else take(rows, order)
    t = work_array(len(rows.stamp_ns))
    for chunk in chunks(len(t)):
        t[chunk] = (rows.stamp_ns[chunk] - leg.start_ns) * 1e-9 + offset
    is_outlier = _find_outliers(rows, t, slot, leg, config)
    if is_outlier.any():
        reasons.append(Reason(Code.BAD_ROWS_DROPPED, f'{int(is_outlier.sum())} of {len(t)} '
                              f'{INPUTS[slot].label} messages are isolated outliers, first at t = '
                              f'{t[np.argmax(is_outlier)]:.2f} s; dropped'))
        # outliers and impossible values together may be a damaged group
        if not glitches.near_impossible_groups(impossible).any():
            row_numbers = np.flatnonzero(is_valid)      # in ``samples``
            row_numbers = row_numbers if order is None else row_numbers[order]
            impossible[row_numbers[is_outlier]] = True
            damaged, damage_reasons = _find_damaged_rows(impossible, is_valid, slot)
            is_outlier |= damaged[row_numbers]
            reasons += damage_reasons
        rows, t = take(rows, ~is_outlier), t[~is_outlier]
    if len(samples.stamp_ns) and not len(t) and slot in NO_ROW_CODES:
        reasons.append(_no_row_reason(samples, slot))
    return UsableRows(rows, t), reasons


def _find_outliers(rows: Any, t: Floats, slot: str, leg: Leg, config: Config) -> Bools:
    """Return a mask of isolated outliers of an IMU or a speed: (n,) bool."""
    if slot == 'imu':
        return glitches.imu_glitches(t, rows.w_i, rows.f_i, config.imu)
    if slot in WHEELS and leg.form_of(slot).quantity == 'rate':
        return glitches.speed_glitches(t, rows.value.astype(float))
    return np.zeros(len(t), bool)


def _no_row_reason(samples: Samples, slot: str) -> Reason:
    """Return the reason for a topic without usable rows."""
    unstamped = int((samples.stamp_ns <= 0).sum())
    cause = f'{unstamped} have no stamp (0)' if unstamped else 'values are missing or out of range'
    return Reason(
        NO_ROW_CODES[slot], f'none of the {len(samples.stamp_ns)} {INPUTS[slot].label} messages '
        f'is usable: {cause}', _unstamped_remedy(slot) if unstamped else
        'Check the driver that sends these messages, and wait for valid values before the drive.')


def _unstamped_remedy(slot: str) -> str:
    return (f'Set {INPUTS[slot].clock or slot}.arrival_time to true, or let the driver stamp its '
            'messages.')


def _time_text(samples: Samples, index: int, leg: Leg) -> str:
    """Return the time of a row in seconds from the start mark (arrival time without a stamp)."""
    stamp = samples.stamp_ns[index]
    if stamp > 0:
        return f't = {(stamp - leg.start_ns) * 1e-9:.2f} s'
    return f't = {(samples.received_ns[index] - leg.start_ns) * 1e-9:.2f} s (arrival)'


def _find_valid_rows(samples: Any, slot: str, leg: Leg) -> tuple[Bools, Bools, list[Reason]]:
    """
    Return a mask of valid rows, one of rows with finite but impossible values, and reasons.

    A valid row has a stamp and all required values, and is not near a group of impossible rows.
    """
    stamped = samples.stamp_ns > 0
    is_possible, impossible = np.ones(len(stamped), bool), np.zeros(len(stamped), bool)
    limits = INPUTS[slot].value_limits
    for name in INPUTS[slot].required_columns:
        column = getattr(samples, name)
        invalid = glitches.is_impossible(name, column)
        if limits is not None:
            invalid |= ~((column >= limits[0]) & (column <= limits[1]))
        is_possible &= ~invalid
        impossible[invalid] |= np.isfinite(column[invalid]).all(axis=tuple(range(1, column.ndim)))
    if slot == 'fix':
        is_possible |= samples.status < 0     # a receiver without a fix publishes NaN: not a fault
    invalid_text = 'hold NaN, Inf or an impossible value'
    if slot == 'fix' and is_local(samples):
        invalid_text = ('hold NaN or a position more than '
                        f'{LARGEST_FRAME / 1000:g} km from the origin of its frame')
    reasons = []
    for bad, text in ((~stamped, 'have no stamp (zero or negative)'),
                      (stamped & ~is_possible, invalid_text)):
        if bad.any():
            first = int(np.argmax(bad))
            reasons.append(Reason(Code.BAD_ROWS_DROPPED, f'{int(bad.sum())} of {len(bad)} '
                                  f'{INPUTS[slot].label} messages {text}, first at '
                                  f'{_time_text(samples, first, leg)}; dropped',
                                  '' if stamped[first] else _unstamped_remedy(slot)))
    valid = stamped & is_possible
    max_impossible = min(glitches.DAMAGED_SHARE * len(impossible), glitches.SEVERAL_ROWS)
    damaged, damage_reasons = _find_damaged_rows(impossible, valid, slot, max_impossible)
    return valid & ~damaged, impossible, reasons + damage_reasons


def _find_damaged_rows(impossible: Bools, valid: Bools, slot: str,
                       max_impossible: float = np.inf) -> tuple[Bools, list[Reason]]:
    """
    Return a mask of rows in or near groups of impossible rows, and ROWS_DAMAGED if there are any.

    max_impossible : with more impossible rows, ROWS_DAMAGED is returned also without groups.
    """
    damaged = glitches.near_impossible_groups(impossible)
    count = int(impossible.sum())
    if not damaged.any() and count <= max_impossible:
        return damaged, []
    others = int((damaged & valid & ~impossible).sum())
    return damaged, [Reason(Code.ROWS_DAMAGED, f'{count} of {len(impossible)} '
                            f'{INPUTS[slot].label} messages hold impossible values or are '
                            f'outliers; {others} messages next to them were dropped too')]


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
    order = np.arange(len(stamp))      # each stamp becomes 1 ns or more after the previous one
    return replace(samples, stamp_ns=np.maximum.accumulate(stamp - order) + order)


def _spread_packets(imu: Any) -> tuple[Any, list[Reason]]:
    """Return IMU samples, packets of equal stamps spread over the time since the last packet."""
    stamp, min_share = imu.stamp_ns, 1 / 3       # judgement: share of rows; fewer: duplicates
    step = np.diff(stamp)
    is_same = step == 0      # stamp as before
    if is_same.sum() <= min_share * len(stamp) or (step < 0).any():
        return imu, []
    repeated = np.all([(np.diff(x, axis=0) == 0).all(axis=1) for x in (imu.w_i, imu.f_i)], axis=0)
    if (is_same & ~repeated).sum() <= min_share * len(stamp):
        return imu, []
    first = np.flatnonzero(np.append(True, ~is_same))
    count = np.diff(np.append(first, len(stamp)))
    # a packet after a gap has the usual duration
    usual_ns = int(np.median(np.diff(stamp[first]))) if len(first) > 1 else 0
    duration = np.minimum(np.diff(stamp[first], prepend=stamp[0] - usual_ns), usual_ns)
    rows_to_last = np.repeat(first + count - 1, count) - np.arange(len(stamp))
    spread = replace(imu, stamp_ns=stamp - rows_to_last * np.repeat(duration // count, count))
    return spread, [Reason(
        Code.STAMPS_NOT_RISING, f'{int(is_same.sum())} of {len(stamp)} IMU messages repeat the '
        'previous stamp: all messages of a packet have one stamp; they were spread evenly over '
        'the time since the previous packet',
        'Stamp each message with the time of its measurement.')]


def _rising_rows(samples: Samples, slot: str, leg: Leg) -> tuple[Ints | None, list[Reason]]:
    """Return the largest set of rows with strictly rising stamps, None for all, and reasons."""
    stamp = samples.stamp_ns
    step = np.diff(stamp)
    if (step > 0).all():
        return None, []
    rising = _longest_rising(stamp)
    same, backward = int((step == 0).sum()), int((step < 0).sum())
    first = int(np.argmax(step <= 0)) + 1
    faults = [f'{same} repeat the previous stamp'] * (same > 0)
    faults += [f'{backward} backward step{"s" * (backward > 1)} (up to {-step.min() * 1e-9:.3g} '
               's)'] * (backward > 0)
    return rising, [Reason(
        Code.STAMPS_NOT_RISING, f'{INPUTS[slot].label} stamps do not increase: '
        f'{" and ".join(faults)}, first at {_time_text(samples, first, leg)}; '
        f'{len(stamp) - len(rising)} of {len(stamp)} messages dropped')]


def _longest_rising(stamp: Ints) -> Ints:
    """Return the indices of a longest strictly rising subsequence (patience sorting)."""
    # of the rising subsequences of each length, the one with the smallest last value
    last_values: list[int] = []
    last_rows: list[int] = []
    previous = np.full(len(stamp), -1)      # row before each row in its subsequence
    for row, value in enumerate(stamp.tolist()):
        length = bisect_left(last_values, value)
        if length:
            previous[row] = last_rows[length - 1]
        last_values[length:length + 1], last_rows[length:length + 1] = [value], [row]
    rows, row = [], last_rows[-1]
    while row >= 0:      # from the last one back
        rows.append(row)
        row = int(previous[row])
    return np.array(rows[::-1])
