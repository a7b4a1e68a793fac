# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Clocks: how far apart the topics' stamps are, and whether one was set during the leg."""

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.data.inputs import INPUTS
from odocal_ros.data.leg import Leg
from odocal_ros.data.pieces import by_step, median, pieces
from odocal_ros.data.samples import ImuSamples, Samples, SomeSamples, take
from odocal_ros.nav.statistics import GAP_INTERVALS
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import Config
from odocal_ros.settings.levels import CLOCK_APART

OFFSET_REACH = 1.0     # s, format: what a time_offset setting holds
CLOCK_SET = 0.02       # s, judgement: a clock set by more than this is named
TOPICS = ('odometer', 'odometer_right', 'fix', 'heading')
TOO_FAR = ('Stamp all sensors with one clock: the difference exceeds the range of time_offset. '
           'If a bag is played, use ros2 bag play --clock at normal speed and start the node '
           'with use_sim_time:=true.')


def offsets(config: Config) -> dict[str, float]:
    """Return the s to add to the stamps of each input; 0 for the IMU, which stamps the marks."""
    def of(group: str) -> float:
        return float(getattr(config, group).time_offset) if group else 0.0
    return {slot: of(one.clock) - of('imu') for slot, one in INPUTS.items()}


def judge_clocks(leg: Leg, config: Config) -> list[Reason]:
    """
    Return reasons for clocks that differ from the IMU's at equal times of arrival.

    leg : as recorded.   Positions of marks are not compared: they have IMU stamps and arrive late
    by WITHIN.
    """
    topics = [slot for slot in TOPICS if not (slot == 'fix' and config.reference.points)]
    offset = offsets(config)
    found = [r for slot in ('imu', *topics) for r in _was_set(
        leg.rows(slot), INPUTS[slot].label, leg.start_ns)]
    imu = _stamped(leg.imu)
    if len(imu.stamp_ns) < 2:
        return found
    for slot in topics:
        samples = _stamped(leg.rows(slot))
        if not len(samples.stamp_ns):
            continue
        ahead = median(_lag_at(samples.received_ns, imu) - _lag(samples))
        ahead += offset[slot]
        if abs(ahead) > CLOCK_APART:
            found.append(Reason(
                Code.CLOCKS_DIFFER, f'{INPUTS[slot].label} stamps are {ahead:+.3f} s relative to '
                f'IMU stamps of the same time{_cure(slot, ahead)}', remedy(ahead)))
    return found


def remedy(ahead: float) -> str:
    """Return the remedy for a clock that is this many seconds ahead of the IMU clock."""
    return TOO_FAR if abs(ahead) > OFFSET_REACH else Code.CLOCKS_DIFFER.remedy


def _stamped(samples: SomeSamples) -> SomeSamples:
    good = samples.stamp_ns > 0
    return samples if good.all() else take(samples, good)


def _lag(samples: Samples) -> Floats:
    """Return arrival less stamp, s: (n,)."""
    lag: Floats = np.multiply(samples.received_ns - samples.stamp_ns, 1e-9)
    return lag


def _lag_at(arrival_ns: Ints, imu: ImuSamples) -> Floats:
    """Return the lag of the IMU at times of arrival: (m,) s; computed in pieces."""
    base = imu.received_ns[0]

    def seconds(received_ns: Ints) -> Floats:
        since: Floats = np.multiply(received_ns - base, 1e-9)
        return since

    if not by_step(lambda ns: np.diff(seconds(ns)) > 0, imu.received_ns).all():
        # queued messages arrive together: their mean is used
        arrival, group, count = np.unique(seconds(imu.received_ns), return_inverse=True,
                                          return_counts=True)
        lag = np.bincount(group, _lag(imu)) / count
        return np.interp(seconds(arrival_ns), arrival, lag)
    order = np.argsort(arrival_ns, kind='stable')
    times_ns, found = arrival_ns[order], np.empty(len(order))
    for where, rows in pieces(times_ns, imu.received_ns):
        found[order[where]] = np.interp(seconds(times_ns[where]), seconds(imu.received_ns[rows]),
                                        _lag(take(imu, rows)))
    return found


def _cure(slot: str, ahead: float) -> str:
    """Return the offset that aligns a topic's stamps with the IMU, if a setting allows it."""
    group = INPUTS[slot].clock
    if not group or abs(ahead) > OFFSET_REACH:
        return ''
    return f'; if this is not transport delay, add {-ahead:+.3f} to {group}.time_offset'


def _may_be_odd(stamp_ns: Ints) -> Bools:
    step: Floats = np.diff(stamp_ns) * 1e-9
    return (step <= 0) | (step > CLOCK_SET)


def _was_set(samples: Samples, label: str, start_ns: int) -> list[Reason]:
    """
    Return a reason if a clock was set during the leg: its stamps step for good, arrivals do not.

    Rows out of order or with a false stamp step twice, and the lag does not change.
    """
    samples = _stamped(samples)
    if not by_step(_may_be_odd, samples.stamp_ns).any():
        return []
    step = np.diff(samples.stamp_ns) * 1e-9
    if len(step) < 3:
        return []
    odd = np.flatnonzero((step <= 0) | (step > max(GAP_INTERVALS * np.median(step), CLOCK_SET)))
    if not len(odd):
        return []
    first, last = int(odd[0]), int(odd[-1])
    lag = _lag(samples)
    lag_neighbours = 50    # rows on each side that determine the lag
    before = lag[max(0, first + 1 - lag_neighbours):first + 1]
    after = lag[last + 1:][:lag_neighbours]
    moved = float(np.median(before) - np.median(after))      # of the stamps, against arrival
    at = int(odd[np.argmin(np.abs(step[odd] - moved))])
    if abs(moved) < CLOCK_SET or abs(step[at] - moved) > 0.3 * abs(moved) + np.median(step):
        return []
    first_lag = (lag - (np.median(before) + np.median(after)) / 2) * moved > 0
    most_exchanged = 0.25    # of all rows: those of topics that arrive twice or shuffled are half
    if (first_lag != (np.arange(len(lag)) <= at)).mean() > most_exchanged:
        return []
    return [Reason(Code.CLOCKS_DIFFER, f'the {label} clock was set by {moved:+.3f} s during the '
                   f'leg, at t = {(samples.stamp_ns[at] - start_ns) * 1e-9:.2f} s: its stamps '
                   'before and after are inconsistent')]
