# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Checks of the drive: length, speed, straightness, and motion of wheels and fixes."""

from typing import NamedTuple

import numpy as np

from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.nav.dead_reckoning import Track
from odocal_ros.nav.geodesy import MIN_GNSS_MOTION, MIN_LOCAL_MOTION
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import yaw_from_quat
from odocal_ros.nav.time_series import NORMAL_MEDIAN
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import LegConfig
from odocal_ros.settings.levels import FASTEST

# limits of a slide of locked wheels; more motion without counts is a fault of the odometer
SLIDE_DISTANCE = 100.0      # m: physical
SLIDE_TIME = 20.0           # s: physical; after a longer time, MIN_GNSS_MOTION is the limit
MIN_UNCOUNTED_SHARE = 0.01   # judgement: share of the path without counts that is reported


def check_drive(track: Track, t_stop: float, metres_per_unit: float,
                leg: LegConfig) -> tuple[float, tuple[Reason, ...]]:
    """Return path length and reasons of ``check_path_and_speed``, and LEG_NOT_STRAIGHT."""
    distance, reasons = check_path_and_speed(track, t_stop, metres_per_unit, leg)
    inside = (track.t >= 0) & (track.t <= t_stop)
    t, s = track.t[inside], track.s[inside] * metres_per_unit
    if len(t) < 2:
        return distance, reasons
    step, yaw = np.abs(np.diff(s)), np.unwrap(yaw_from_quat(track.q_nb[inside]))
    turning = np.abs(rate_over_second(t, yaw)) > leg.max_yaw_rate
    share = float(step[turning[:-1]].sum() / distance) if distance else 0.0
    limit = 0.1         # judgement: manoeuvres at the ends are shorter
    if share > limit:
        reasons += (Reason(
            Code.LEG_NOT_STRAIGHT, f'{100 * share:.0f} % of the distance was driven in turns '
            f'above {leg.max_yaw_rate:g} rad/s; the limit is {100 * limit:.0f} %'),)
    return distance, reasons


def check_path_and_speed(track: Track, t_stop: float, metres_per_unit: float,
                         leg: LegConfig) -> tuple[float, tuple[Reason, ...]]:
    """Return the path length between the marks, m, and reasons if it or the speed is too low."""
    # t_stop : stop mark, s.   metres_per_unit : approximate scale.   leg : limits
    inside = (track.t >= 0) & (track.t <= t_stop)
    t, s = track.t[inside], track.s[inside] * metres_per_unit
    distance = float(np.abs(np.diff(s)).sum())
    reasons: tuple[Reason, ...] = ()
    if distance < leg.min_distance:
        reasons += (Reason(Code.LEG_TOO_SHORT, f'{distance:.1f} m between the marks; the limit is '
                           f'{leg.min_distance:g} m'),)
    if len(t) < 2:
        return distance, reasons
    top_speed = float(np.abs(rate_over_second(t, s)).max())
    if top_speed < leg.min_speed:
        reasons += (speed_reason(top_speed, leg.min_speed),)
    return distance, reasons


def speed_reason(top_speed: float, limit: float) -> Reason:
    """Return SPEED_TOO_LOW for a highest speed, mean over 1 s, and its limit, m/s."""
    return Reason(Code.SPEED_TOO_LOW, f'the highest speed (mean over 1 s) is {top_speed:.2f} m/s; '
                  f'the limit is {limit:g} m/s')


def rate_over_second(t: Floats, x: Floats) -> Floats:
    """Return the mean rate of x, (m,), in the second around each row: (m,), 0 of a single row."""
    if len(t) < 2:
        return np.zeros(len(t))
    low, high = np.maximum(t - 0.5, t[0]), np.minimum(t + 0.5, t[-1])
    change = np.interp(high, t, x) - np.interp(low, t, x)
    return np.asarray(change / np.maximum(high - low, 1e-9))


def odometer_span_reasons(travel: Travel, t_stop: float) -> tuple[Reason, ...]:
    """Return a reason if the odometer begins after the start mark or ends before the stop mark."""
    late, early = float(travel.t[0]), float(t_stop - travel.t[-1])
    # s, shortest reported; for slow topics 1.5 times the interval of their messages
    shortest = max(0.5, 1.5 * float(np.median(np.diff(travel.t))) if len(travel.t) > 1 else 0.0)
    texts = [f'begins {late:.1f} s after the start mark'] * (late > shortest)
    texts += [f'ends {early:.1f} s before the stop mark'] * (early > shortest)
    if not texts:
        return ()
    return (Reason(Code.TOPIC_GAP, f'the odometer {" and ".join(texts)}: the leg is limited to '
                   'the time of the odometer data'),)


def motion_reasons(travel: Travel, t_fix: Floats, fixes_n: Floats, fix_sigma: float,
                   t_stop: float, min_motion: float) -> tuple[Reason, ...]:
    """
    Return the reason if wheels or fixes do not move between the marks.

    t_fix, fixes_n : (k,) s, (k, 3) m.   fix_sigma : stated, m.   t_stop : stop mark, s.
    min_motion : distance between fixes that is motion, m.
    """
    # judgement, s and fixes: with slow fixes a mark is between two of them; those before it are
    # needed for the position
    mark_margin, count_before = 0.5, 3
    rows = slice(max(0, np.searchsorted(t_fix, -mark_margin) - count_before),
                 np.searchsorted(t_fix, t_stop + mark_margin))
    t, fixes = t_fix[rows], fixes_n[rows, :2]
    if len(fixes) < 2:
        return (Reason(Code.NO_FIX, f'{len(fixes)} usable fix{"es" * (len(fixes) != 1)} between '
                       'the marks; required: 2 or more. Likely cause: the topic stopped, or the '
                       'marks are too close'),)
    if len(fixes) > 4:       # a single outlier is no motion: running median of three
        fixes = np.median(np.lib.stride_tricks.sliding_window_view(fixes, 3, axis=0), axis=-1)
        t = t[1:-1]
    # 10 sigmas: judgement, a leg is longer. Many receivers state far more than their noise
    sigma = min(fix_sigma, fix_white_noise(fixes))
    fixes_move = np.hypot(*np.ptp(fixes, axis=0)) > max(min_motion, 10 * sigma)
    inside = (travel.t >= 0) & (travel.t <= t_stop)
    if inside.sum() < 2:
        return (Reason(Code.NO_ODOMETER, 'fewer than two odometer messages between the marks. '
                       'Likely cause: the topic stopped, or the marks are too close'),)
    # three counts: a wheel at rest on the edge of a pulse may count once in each direction
    wheels_move = np.ptp(travel.s[inside]) > 3 * travel.quantum
    if wheels_move and fixes_move:
        return _stopped_counter_reasons(travel, t, fixes, fix_sigma)
    if fixes_move:
        return (Reason(Code.ODOMETER_STILL, 'the fixes move, but the odometer does not'),)
    if wheels_move:
        return (Reason(Code.LEG_TOO_SHORT, 'the odometer counts, but the fixes do not move',
                       'If the vehicle moved, check the unit of latitude and longitude '
                       '(degrees), and switch off static hold in the receiver.'),)
    return (Reason(Code.LEG_TOO_SHORT, 'the vehicle did not move'),)


def _stopped_counter_reasons(travel: Travel, t: Floats, fixes: Floats,
                             fix_sigma: float) -> tuple[Reason, ...]:
    """Return a reason if the fixes, (k, 2) at (k,) s, move far without counts."""
    motion = max(_motion_without_counts(travel, t, fixes, fix_sigma), default=None)
    if motion is None or motion.distance < MIN_UNCOUNTED_SHARE * path_and_chord(t, fixes)[0]:
        return ()
    return (Reason(Code.ODOMETER_STILL, f'the fixes move by {motion.distance:.0f} m from '
                   f't = {motion.begin:.0f} s to {motion.end:.0f} s, but the odometer does not '
                   'count'),)


class UncountedMotion(NamedTuple):
    """Motion of the fixes in an interval in which the odometer does not count."""

    distance: float    # m
    begin: float       # s
    end: float         # s


def _motion_without_counts(travel: Travel, t: Floats, fixes: Floats,
                           fix_sigma: float) -> list[UncountedMotion]:
    """Return the intervals without counts in which the fixes, (k, 2) m at (k,) s, move."""
    counts = np.flatnonzero(np.diff(travel.s))      # rows before a count
    begin = travel.t[np.append(0, counts + 1)]
    end = travel.t[np.append(counts, len(travel.t) - 1)]
    motions = []
    # shorter intervals cannot contain that distance
    for k in np.flatnonzero(end - begin > SLIDE_DISTANCE / FASTEST):
        # not at the end of the data: errors of the fixes of a parked vehicle move as far
        is_no_slide = end[k] - begin[k] > SLIDE_TIME and end[k] < travel.t[-1]
        motion_limit = max(MIN_GNSS_MOTION if is_no_slide else SLIDE_DISTANCE, 10 * fix_sigma)
        distance = _motion_of_fixes(fixes[(t >= begin[k]) & (t <= end[k])], motion_limit)
        if distance >= motion_limit:
            motions.append(UncountedMotion(distance, begin[k], end[k]))
    return motions


def ferry_intervals(travel: Travel, t_fix: Floats, fixes_n: Floats, fix_sigma: float) -> Floats:
    """
    Return intervals in which fixes move and wheels stand, as on a ferry, (k, 2) s.

    An interval begins when the vehicle leaves its place at the start, and ends when it reaches the
    last one: the standstill on either side is not a ferry.
    """
    spans = []
    for distance, begin, end in _motion_without_counts(travel, t_fix, fixes_n[:, :2], fix_sigma):
        rows = np.flatnonzero((t_fix >= begin) & (t_fix <= end))
        if end >= travel.t[-1]:
            continue
        t, positions = t_fix[rows], fixes_n[rows, :2]
        # at most a quarter of the distance: with noisy fixes, both ends remain two places
        limit = min(max(MIN_LOCAL_MOTION, 10 * fix_sigma), distance / 4)
        left, reached = _start_of_motion(t, positions, limit), -_start_of_motion(
            -t[::-1], positions[::-1], limit)
        spans.append((left, reached))
    return np.reshape(np.array(spans, float), (-1, 2))


def _start_of_motion(t: Floats, positions: Floats, limit: float) -> float:
    """Return the time at which the fixes, (k, 2) m at (k,) s, leave their first place, s."""
    # the place is the median of three fixes, of which one may be an outlier
    distance = np.hypot(*(positions - np.median(positions[:3], axis=0)).T)
    near, far = (t[np.argmax(distance > share * limit)] for share in (1.0, 2.25))
    # at constant acceleration from rest, 2.25 times the distance takes 1.5 times as long
    return float(max(near - 2 * max(far - near, 0.0), t[0]))


def _motion_of_fixes(fixes: Floats, motion_limit: float) -> float:
    """Return the motion of (k, 2) fixes without jumps and noise, m, 0 below ``motion_limit``."""
    part_count = 20      # so many that motion extends over more than two of them
    if len(fixes) < part_count:
        return 0.0
    middle = np.array([np.median(part, axis=0) for part in np.array_split(fixes, part_count)])
    if np.hypot(*(middle[-1] - middle[0])) < motion_limit:
        return 0.0
    steps = np.sort(np.hypot(*np.diff(middle, axis=0).T))
    # a jump is one step, or two if inside a part: limit steps to the third largest
    return float(min(np.minimum(steps, steps[-3]).sum(), np.hypot(*(middle[-1] - middle[0]))))


def path_and_chord(t_fix: Floats, fixes_n: Floats,
                   min_distance: float = MIN_GNSS_MOTION) -> tuple[float, float]:
    """
    Return path length and distance between the ends, m, from (k, 2 or more) fixes at (k,) s.

    The path connects fixes at least ten times their white noise, and ``min_distance`` or 2 m,
    apart, so that noise does not accumulate. Fixes out of reach of a vehicle are left out.
    """
    p = fixes_n[find_reachable(t_fix, fixes_n), :2]
    if len(p) < 2:
        return 0.0, 0.0
    knots = [*separated_fixes(p, max(min(2.0, min_distance), 10 * fix_white_noise(p))), len(p) - 1]
    path = float(np.hypot(*np.diff(p[knots], axis=0).T).sum())
    return path, float(np.hypot(*(p[-1] - p[0])))


def find_reachable(t_fix: Floats, fixes_n: Floats) -> Bools:
    """Return the fixes that a vehicle can reach from the median one, in sequence: (k,) bool."""
    p = fixes_n[:, :2]
    steps = np.hypot(*np.diff(p, axis=0).T)
    error_limit = 50.0       # m, possible error of any fix: physical, multipath in a street
    if len(p) < 2 or (steps <= FASTEST * np.diff(t_fix) + error_limit).all():
        return np.ones(len(p), bool)
    first = int(np.argmin(np.hypot(*(p - np.median(p, axis=0)).T)))
    reachable = np.zeros(len(p), bool)
    for order in (range(first, len(p)), range(first, -1, -1)):    # forwards and backwards in time
        last = first
        for k in order:
            distance = np.hypot(p[k, 0] - p[last, 0], p[k, 1] - p[last, 1])
            if distance <= FASTEST * abs(t_fix[k] - t_fix[last]) + error_limit:
                reachable[k], last = True, k
    return reachable


def fix_white_noise(fixes_n: Floats) -> float:
    """Return the white noise of fixes, 1 sigma, m, from the median of second differences."""
    if len(fixes_n) < 5:
        return 2.5      # m, of a receiver without corrections
    second_difference = np.diff(fixes_n[:, :2], n=2, axis=0)     # has 1 + 4 + 1 variances
    return float(np.median(np.abs(second_difference)) / (NORMAL_MEDIAN * np.sqrt(6)))


def separated_fixes(fixes_n: Floats, min_distance: float) -> list[int]:
    """Return indices of fixes, (k, 2 or more), from the first, at least min_distance, m, apart."""
    knots, p = [0] if len(fixes_n) else [], fixes_n[:, :2]
    begin, block_size = 1, 64     # fixes searched at a time: the next knot is usually among them
    while begin < len(p):
        is_distant = np.hypot(*(p[begin:begin + block_size] - p[knots[-1]]).T) >= min_distance
        if is_distant.any():
            knots.append(begin + int(np.argmax(is_distant)))
            begin = knots[-1] + 1
        else:
            begin += block_size
    return knots
