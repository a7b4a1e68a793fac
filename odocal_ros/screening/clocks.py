# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Clocks: offsets between the stamps of topics, and clocks that were set during the leg.

Sensors of two computers may have clocks that are seconds apart although stamps and arrivals agree.
Such an offset is estimated from the motion that IMU, odometer and fixes all measure: the
acceleration of the odometer is compared with the specific force at all offsets, the speed of the
fixes with that of the odometer. Offsets up to MAX_CLOCK_OFFSET are delays, which the smoother
estimates.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from odocal_ros.data.arrays import (
    bin_means,
    Bools,
    enclosing_slices,
    Floats,
    Ints,
    map_windows,
    median,
    running_sum,
)
from odocal_ros.data.inputs import INPUTS
from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import ImuSamples, Samples, SomeSamples, take
from odocal_ros.nav.time_series import interpolated
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.inputs import Inputs, LocatedFixes
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import CLOCK_DIFFERENCE_LIMIT

MAX_CLOCK_OFFSET = 1.0     # s, larger ones are no delay. Format: range of a time_offset setting
# judgement: least step of a clock that is detected, s; rows before and after it whose median lag
# gives its size
CLOCK_STEP, STEP_LAG_ROWS = 0.01, 50
STEP_TOLERANCE = 0.3    # judgement: of its size, difference of two measures of one step
# s, judgement: within it the least lag is again that of before if messages only queued
QUEUE_TIME = 10.0
OFFSET_CELL = 0.25          # s, judgement: time of a mean; accelerations of a vehicle take longer
FARTHEST_OFFSET = 90.0      # s, judgement: largest offset that is found
# s, judgement: slower changes of force (slopes) and of speed (traffic) are removed
SLOW_FORCE, SLOW_SPEED = 20.0, 60.0
# s, judgement: duration of one acceleration, which counts as one sample
ACCELERATION_S = 4.0
# statistical: log likelihood of the best offset less that of small ones and of all more than
# ACCELERATION_S away; the margin above 10 (once in 20,000) is for signals that repeat themselves
DELAY_LOG_ODDS = 20.0
TOPICS = ('odometer', 'odometer_right', 'fix', 'heading')
SYNCHRONISE_REMEDY = (
    'Stamp all sensors with one clock, or set arrival_time of imu, odometer or gnss: the '
    'difference exceeds the range of time_offset. If a bag is played, use ros2 bag play --clock '
    'at normal speed and start the node with use_sim_time:=true.')


def stamp_offsets(config: Config) -> dict[str, float]:
    """Return the seconds to add to the stamps of each input; 0 for the IMU, the reference."""
    def offset(clock: str) -> float:
        return float(getattr(config, clock).time_offset) if clock else 0.0
    return {slot: offset(source.clock) - offset('imu') for slot, source in INPUTS.items()}


def clock_differences(leg: Leg, config: Config) -> dict[str, float]:
    """Return by how many s stamps lead IMU stamps of equal arrival, of topics beyond the limit."""
    offset = stamp_offsets(config)
    differences: dict[str, float] = {}
    imu = _stamped(leg.imu)
    for slot in TOPICS:
        samples = _stamped(leg.rows(slot))
        if min(len(imu.stamp_ns) - 1, len(samples.stamp_ns)) < 1 or (
                slot == 'fix' and config.reference.points):
            continue
        lead_s = median(_lag_at(samples.received_ns, imu) - _lag(samples)) + offset[slot]
        if abs(lead_s) > CLOCK_DIFFERENCE_LIMIT:
            differences[slot] = lead_s
    return differences


def clock_reasons(differences: Mapping[str, float]) -> list[Reason]:
    """Return reasons for the clock differences of topics, s, as of ``clock_differences``."""
    reasons = []
    for slot, lead_s in differences.items():
        group, text = INPUTS[slot].clock, (
            f'{INPUTS[slot].label} stamps differ by {lead_s:+z.3f} s from IMU stamps that arrive '
            f'at the same time; the limit is {CLOCK_DIFFERENCE_LIMIT:g} s')
        reasons.append(Reason(
            Code.DELAY_SEEN, f'{text}. {group}.time_sigma was increased to the difference',
            f'If it is not transport delay, add {-lead_s:+z.3f} to {group}.time_offset.',
        ) if _is_estimable(slot, lead_s) else Reason(
            Code.CLOCKS_DIFFER, text, clock_remedy(lead_s)))
    return reasons


def with_delay_sigmas(config: Config, differences: Mapping[str, float]) -> Config:
    """Return settings by which delays as large as clock differences, s by topic, are likely."""
    for slot, lead_s in differences.items():
        if _is_estimable(slot, lead_s):
            group = INPUTS[slot].clock
            clock = getattr(config, group)
            config = replace(config, **{
                group: replace(clock, time_sigma=max(clock.time_sigma, abs(lead_s)))})
    return config


def _is_estimable(slot: str, lead_s: float) -> bool:
    """Return True if a clock difference is in the range of the delays that methods estimate."""
    return bool(INPUTS[slot].clock) and abs(lead_s) <= MAX_CLOCK_OFFSET


def clock_remedy(lead_s: float) -> str:
    """Return the remedy for a clock that is ``lead_s`` s ahead of the IMU clock."""
    return SYNCHRONISE_REMEDY if abs(lead_s) > MAX_CLOCK_OFFSET else Code.CLOCKS_DIFFER.remedy


def _stamped(samples: SomeSamples) -> SomeSamples:
    """Return the rows that have a stamp."""
    has_stamp = samples.stamp_ns > 0
    return samples if has_stamp.all() else take(samples, has_stamp)


def _lag(samples: Samples) -> Floats:
    """Return arrival minus stamp, s: (n,)."""
    return np.asarray((samples.received_ns - samples.stamp_ns) * 1e-9)


def _lag_at(arrival_ns: Ints, imu: ImuSamples) -> Floats:
    """Return the lag of the IMU, interpolated at (m,) times of arrival: (m,) s."""
    base = imu.received_ns[0]

    def seconds(received_ns: Ints) -> Floats:
        return np.asarray((received_ns - base) * 1e-9)

    if not map_windows(lambda ns: np.diff(seconds(ns)) > 0, imu.received_ns).all():
        # queued messages arrive together: their mean is used
        arrival, group, count = np.unique(seconds(imu.received_ns), return_inverse=True,
                                          return_counts=True)
        lag = np.bincount(group, _lag(imu)) / count
        return np.interp(seconds(arrival_ns), arrival, lag)
    order = np.argsort(arrival_ns, kind='stable')
    times_ns, lags = arrival_ns[order], np.empty(len(order))
    for times, rows in enclosing_slices(times_ns, imu.received_ns):
        lags[order[times]] = np.interp(seconds(times_ns[times]), seconds(imu.received_ns[rows]),
                                      _lag(take(imu, rows)))
    return lags


def without_clock_steps(leg: Leg) -> tuple[Leg, list[Reason]]:
    """Return the leg with stamps as if no clock had been set during it, and CLOCK_SET reasons."""
    rows: dict[str, Samples] = {}
    reasons: list[Reason] = []
    for slot in ('imu', *TOPICS):
        stamped = _stamped(leg.rows(slot))
        last_rows, sizes = _clock_steps(stamped)
        if not len(last_rows):
            continue
        # sections between steps; the stamps of the one with the smallest lag are kept
        section = np.searchsorted(last_rows, np.arange(len(stamped.stamp_ns)))
        lag = [abs(np.median(_lag(take(stamped, section == k))))
               for k in range(len(last_rows) + 1)]
        shift = running_sum(np.round(sizes * 1e9).astype(np.int64))
        shift -= shift[int(np.argmin(lag))]
        samples = leg.rows(slot)
        stamp_ns = samples.stamp_ns.copy()
        stamp_ns[stamp_ns > 0] -= shift[section]
        rows[slot] = replace(samples, stamp_ns=stamp_ns)
        reasons += [Reason(
            Code.CLOCK_SET, f'the {INPUTS[slot].label} clock was set by {size:+z.3f} s at t = '
            f'{(stamped.stamp_ns[k] - leg.start_ns) * 1e-9:.2f} s; '
            f'{"earlier" if shift[section[k]] else "later"} stamps were corrected')
            for k, size in zip(last_rows, sizes, strict=True)]
        if slot == 'imu':
            leg = replace(leg, start_ns=leg.start_ns - int(shift[0]),
                          stop_ns=leg.stop_ns - int(shift[-1]))
    return leg.with_rows(**rows), reasons


def _clock_steps(samples: Samples) -> tuple[Ints, Floats]:
    """Return the rows after which a clock was set, and the change, s, of the median lag there."""
    def may_be_clock_step(stamp_ns: Ints) -> Bools:
        step_s: Floats = np.diff(stamp_ns) * 1e-9
        return (step_s <= 0) | (step_s > CLOCK_STEP)
    if len(samples.stamp_ns) < 2 * STEP_LAG_ROWS or not map_windows(
            may_be_clock_step, samples.stamp_ns).any():
        return np.empty(0, np.int64), np.empty(0)
    step, lag = np.diff(samples.stamp_ns) * 1e-9, _lag(samples)
    advance = lag[:-1] - lag[1:]        # of stamps over arrivals
    is_unusual = np.abs(step - np.median(step)) > np.maximum(CLOCK_STEP, np.abs(advance) / 4)
    rows, sizes = [], []
    for k in np.flatnonzero(is_unusual & (np.abs(advance) > CLOCK_STEP / 2)).tolist():
        first, last = max(k + 1 - STEP_LAG_ROWS, 0), k + STEP_LAG_ROWS
        size = float(np.median(lag[first:k + 1]) - np.median(lag[k + 1:last + 1]))
        if (abs(size) >= CLOCK_STEP and abs(advance[k] - size) <= STEP_TOLERANCE * abs(size)
                and (step[first:k] >= 0).all() and (step[k + 1:last] >= 0).all()):
            rows.append(k)
            sizes.append(size)
    last_rows, size_s = np.array(rows, np.int64), np.array(sizes)
    stays = _are_lasting_steps(samples, lag, last_rows, size_s)
    return last_rows[stays], size_s[stays]


def _are_lasting_steps(samples: Samples, lag: Floats, last_rows: Ints, size_s: Floats) -> Bools:
    """
    Return a mask of the steps by which the least lag changes, with arrivals in real time: (m,).

    Within QUEUE_TIME and the adjacent sections.   last_rows : (m,) last rows of sections.
    """
    received_ns, stamp_ns = samples.received_ns, samples.stamp_ns
    edges = np.concatenate([[0], last_rows + 1, [len(lag)]])
    first, last = (np.searchsorted(received_ns, received_ns[last_rows] + sign * round(
        QUEUE_TIME * 1e9)) for sign in (-1, 1))
    first = np.minimum(np.maximum(first, edges[:-2]), last_rows)
    last = np.maximum(np.minimum(last, edges[2:]), last_rows + 2)

    def is_in_real_time(rows: slice) -> bool:      # not played back faster
        return bool(2 * np.ptp(received_ns[rows]) >= np.ptp(stamp_ns[rows]))

    return np.array([abs(lag[i:k + 1].min() - lag[k + 1:j].min() - size) <= STEP_TOLERANCE * abs(
        size) and is_in_real_time(slice(i, k + 1)) and is_in_real_time(slice(k + 1, j))
        for i, k, j, size in zip(first, last_rows, last, size_s, strict=True)], dtype=bool)


def late_clocks(inputs: Inputs, located: LocatedFixes) -> Iterator[tuple[str, float]]:
    """Yield groups of settings whose clock is late or early, and its delay to the IMU clock, s."""
    t, travel, t_fix = inputs.t_imu, inputs.travel, inputs.t_fix
    if not inputs.has_accelerometer or min(len(t), len(travel.t), len(t_fix)) < 2:
        return
    edges = np.arange(min(t[0], travel.t[0]), max(t[-1], travel.t[-1]), OFFSET_CELL)
    if len(edges) < 3:      # no change of speed between two cells
        return
    count, (force,) = bin_means(t, edges, inputs.f_b)
    force[count == 0] = inputs.median_f_b
    travel_steps = np.diff(travel.at(edges))
    odometer = _delay(_without_slow_changes(np.gradient(travel_steps)[:, None], SLOW_FORCE),
                      _without_slow_changes(force, SLOW_FORCE))
    if odometer:
        yield 'odometer', odometer
    position = interpolated(edges, t_fix, located.fixes_n[:, :2])
    fix = _delay(_without_slow_changes(_chords(position), SLOW_SPEED),
                 _without_slow_changes(_chords(travel.at(edges)[:, None]), SLOW_SPEED), odometer)
    if fix:
        yield 'gnss', fix


def _chords(position: Floats) -> Floats:
    """Return distances between the sums of positions in adjacent windows, as a speed: (n, 1)."""
    cells = round(ACCELERATION_S / OFFSET_CELL)
    total = np.cumsum(np.pad(position, ((cells, cells), (0, 0)), mode='edge'), axis=0)
    window_sum = total[cells:] - total[:-cells]
    difference = window_sum[cells:] - window_sum[:-cells]
    return np.asarray(np.linalg.norm(difference, axis=1, keepdims=True))


def _without_slow_changes(x: Floats, window_s: float) -> Floats:
    """Return columns minus their running means over ``window_s``: (n, k)."""
    half = min(round(window_s / OFFSET_CELL / 2), (len(x) - 1) // 2)
    total = np.cumsum(np.pad(x, ((half + 1, half), (0, 0)), mode='edge'), axis=0)
    return x - (total[2 * half + 1:] - total[:-2 * half - 1]) / (2 * half + 1)


def _delay(y: Floats, x: Floats, x_delay: float = 0.0) -> float:
    """
    Return the delay of y (n, 1) against x (n, k), s; 0 if uncertain or up to MAX_CLOCK_OFFSET.

    At this delay a regression on x explains the largest share of the variance of y. Rows are
    OFFSET_CELL apart.   x_delay : known delay of x, s, which is added.
    """
    max_cells = round(FARTHEST_OFFSET / OFFSET_CELL)
    size = 2 * max(len(x), max_cells)      # zeros after the rows: the correlation is not cyclic
    product = np.fft.rfft(y, size, axis=0) * np.fft.rfft(x, size, axis=0).conj()
    cells = np.arange(-max_cells, max_cells + 1)      # tested delays
    correlation = np.fft.irfft(product, axis=0)[cells]
    explained = np.einsum('li,ij,lj->l', correlation, np.linalg.pinv(x.T @ x), correlation) / max(
        float((y**2).sum()), 1e-12)
    best = 1 + int(np.argmax(explained[1:-1]))
    before, largest, after = explained[best - 1:best + 2]
    vertex = (after - before) / max(2 * (2 * largest - before - after), 1e-12)    # of a parabola
    delay_s = OFFSET_CELL * (cells[best] + np.clip(vertex, -0.5, 0.5))
    is_small = np.abs(OFFSET_CELL * cells + x_delay) <= MAX_CLOCK_OFFSET
    is_far = np.abs(OFFSET_CELL * cells - delay_s) > ACCELERATION_S
    samples = len(y) * OFFSET_CELL / ACCELERATION_S
    unexplained = np.maximum(1.0 - np.array([explained[is_far | is_small].max(), largest]), 1e-6)
    log_odds = samples / 2 * np.log(unexplained[0] / unexplained[1])
    return float(delay_s + x_delay) if log_odds > DELAY_LOG_ODDS else 0.0


def shift_stamps(samples: SomeSamples, shift_ns: int, imu: ImuSamples) -> SomeSamples:
    """Return samples with shifted stamps; arrivals too, unless stamps then lag like the IMU's."""
    lag, imu_lag = (float(np.median(rows.received_ns - rows.stamp_ns))
                    if len(rows.stamp_ns) else 0.0 for rows in (samples, imu))
    only_stamps = abs(lag - shift_ns - imu_lag) < abs(lag - imu_lag)
    return replace(samples, received_ns=samples.received_ns + (0 if only_stamps else shift_ns),
                   stamp_ns=samples.stamp_ns + shift_ns * (samples.stamp_ns > 0))
