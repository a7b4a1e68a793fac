# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Find the legs of a recording, as spans of stamps.

These are the legs requested by the user, else those marked by the node, else those between
standstills.
"""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple, TYPE_CHECKING, TypeAlias

import numpy as np

from odocal_ros.bagio.read import Bag
from odocal_ros.bagio.segments import DROPPED_EVENTS, STATUS_NAME, STATUS_TYPE
from odocal_ros.data.arrays import Floats, Ints, running_sum
from odocal_ros.data.inputs import INPUTS
from odocal_ros.data.leg import LegRecorder
from odocal_ros.errors import BadData, BadUsage
from odocal_ros.library.arguments import EACH_STOP, LegSpan
from odocal_ros.pipeline.automatic import LegSearch
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.clocks import MAX_CLOCK_OFFSET
from odocal_ros.screening.inputs import Inputs, locate_fixes
from odocal_ros.screening.leg_kind import settings_by_frame
from odocal_ros.screening.screen import screen
from odocal_ros.settings.config import Config

if TYPE_CHECKING:
    from odocal_ros.library.read_bag import Recording

AnyBag: TypeAlias = 'Bag | Recording'     # an open bag, or one that was read
Spans = list[tuple[int, int]]    # (start, stop) stamps, ns
# judgement: a first standstill later than 20 % of the path is not the start of the leg
LATEST_START_SHARE = 0.2
COVERAGE_TOLERANCE_NS = 10 * 10**9    # judgement: drivers and recorders start and stop within it
BAG_TIME_TOLERANCE_NS = 10 * 10**9    # judgement: stamps of a bag may be outside its bag times
OPEN_LEG = ('the leg has no stop mark, because recording ended during the leg: it ends at the '
            'last sample that all topics have')


class Standstills(NamedTuple):
    """Standstills of a recording, and the path length up to them."""

    spans_ns: Ints      # (k, 2) ns, begin and end
    path_m: Floats      # (k, 2) m, path length at begin and end
    distance: float     # m, path length of the whole recording


def marked_legs(bag: Bag) -> list[tuple[int, int]]:
    """Return legs marked by a node, not cancelled; stop = 0: recording ended before the mark."""
    legs = [(int(values['leg_start_ns']), int(values['leg_stop_ns']))
            for values in last_statuses(bag) if values.get('leg_event') not in DROPPED_EVENTS]
    return sorted(leg for leg in legs if leg[0] > 0)


def missing_stop_reasons(spans: Spans,
                         marks: Sequence[tuple[int, int]]) -> list[tuple[Reason, ...]]:
    """Return a note for each leg marked only at its start; spans: (start, stop) of the legs."""
    starts = {start for start, stop in marks if not stop}
    return [(Reason(Code.STOP_MARK_MISSING, OPEN_LEG),) if start in starts else ()
            for start, _ in spans]


def coverage_reasons(recorder: LegRecorder) -> tuple[Reason, ...]:
    """Return TOPIC_GAP for topics that begin after the others, or end before them."""
    ends = _first_and_last(recorder)
    if not ends:
        return ()
    firsts, lasts = zip(*ends.values(), strict=True)
    earliest, latest = min(firsts), max(lasts)
    gaps = [f'{INPUTS[slot].label} {verb} {missing_ns * 1e-9:.0f} s {relation}'
            for slot, (first, last) in ends.items()
            for verb, missing_ns, relation in (
                ('begins', first - earliest, 'after the first topic'),
                ('ends', latest - last, 'before the last topic'))
            if missing_ns > COVERAGE_TOLERANCE_NS]
    return (Reason(Code.TOPIC_GAP, f'{", ".join(gaps)}: the leg is limited to the time '
                   'that all topics cover', 'Wait for messages of all topics and the first fix '
                   'before the drive, and record to its end. If a topic failed, check its driver, '
                   'cable and the recorder.'),) if gaps else ()


def has_dropped_legs(bag: Bag) -> bool:
    """Return True if the operator cancelled or undid a leg that is marked in the bag."""
    return any(values.get('leg_event') in DROPPED_EVENTS for values in last_statuses(bag))


def last_statuses(bag: Bag) -> list[dict[str, str]]:
    """Return the last status of each leg in a bag."""
    last: dict[tuple[str, int], dict[str, str]] = {}
    for values in _statuses(bag):
        try:
            start, _ = int(values['leg_start_ns']), int(values['leg_stop_ns'])
        except (KeyError, ValueError):
            continue
        # ids begin again with each run of the node: a leg is identified by its start too
        leg_id = values.get('leg_id', ''), start
        last_event = last.get(leg_id, {}).get('leg_event', '')
        has_started = leg_id[0] not in ('', '0')
        is_dropped = last_event in DROPPED_EVENTS      # and stays dropped
        if has_started and not is_dropped:
            last[leg_id] = values | {'leg_event': values.get('leg_event') or last_event}
    return list(last.values())


def _statuses(bag: Bag) -> Iterator[dict[str, str]]:
    """Yield the values of each status message of a node, by key."""
    for topic in bag.topics.values():
        if topic.msgtype == STATUS_TYPE:
            message: Any
            for _, message in bag.messages(topic.name):
                for status in message.status:
                    if status.name.endswith(STATUS_NAME):
                        yield {entry.key: entry.value for entry in status.values}


def find_legs(recorder: LegRecorder, bag: AnyBag, requested: Sequence[LegSpan | str],
              marks: Sequence[tuple[int, int]], config: Config,
              stops: Standstills | None = None) -> Spans:
    """
    Return (start, stop) stamps of the legs of one bag.

    recorder : with all rows of the bag.   bag : for its time span.   requested : legs; empty: the
    marks, else automatic legs with leg.automatic, else one between standstills.   marks : (start,
    stop) by the node.   stops : result of ``standstills_of`` for the common time of the topics.

    Raises BadUsage: a requested leg is outside the bag; BadData: the stamps of the topics have no
    common time, and a leg must be searched or is open-ended.
    """
    firsts, lasts = zip(*_first_and_last(recorder).values() or [(0, 1)], strict=True)
    first, last = max(firsts), min(lasts)     # last before first: no common time
    has_both_ends = marks or any(
        isinstance(leg, LegSpan) and None not in (leg.start_ns, leg.stop_ns) for leg in requested)
    if first - last > MAX_CLOCK_OFFSET * 1e9 and not has_both_ends:
        raise BadData(f'{bag.name}: {_no_common_time_text(recorder)}')
    last = max(last, first + 1)

    def standstills() -> Standstills:
        return stops or standstills_of(screen(recorder.close(first, last, preroll=0.0), config,
                                              check_faults=False)[0], first, config)
    legs = [_span_in_bag(leg, bag, first, last) for leg in requested if isinstance(leg, LegSpan)]
    if EACH_STOP in requested:
        settings = settings_by_frame(recorder.rows('fix'), config)
        legs += _legs_between_all_stops(standstills(), settings)
    if legs:
        return legs
    if marks:
        return _marked_spans(marks, last, bag)
    if config.leg.automatic:
        return automatic_legs(recorder, last, config) or [(first, last)]
    return [_leg_between_standstills(first, last, standstills())]


def _marked_spans(marks: Sequence[tuple[int, int]], last: int, bag: AnyBag) -> Spans:
    """Return marked legs, each with an end."""
    legs = [(start, stop or last) for start, stop in marks if (stop or last) > start]
    if not legs:
        raise BadData(f'{bag.name}: the recording ended at the start mark or right after it, so '
                      'the leg is empty; drive it again, or use the whole recording with --leg :')
    return legs


def _first_and_last(recorder: LegRecorder) -> dict[str, tuple[int, int]]:
    """Return the first and the last stamp of each required slot that has stamps."""
    ends = {}
    for slot in ('imu', 'odometer', 'fix'):
        stamps = recorder.rows(slot).stamp_ns
        stamps = stamps[stamps > 0]
        if len(stamps) > 20:      # medians: one implausible stamp must not move the leg
            ends[slot] = int(np.median(stamps[:5])), int(np.median(stamps[-5:]))
        elif len(stamps):
            ends[slot] = int(stamps.min()), int(stamps.max())
    return ends


def _no_common_time_text(recorder: LegRecorder) -> str:
    """Return a sentence with the first and last stamp of each required topic."""
    spans = ', '.join(
        f'{INPUTS[slot].label} {" to ".join(str(np.datetime64(ns, "ns"))[:19] for ns in ends)}'
        for slot, ends in _first_and_last(recorder).items())
    return (f'the stamps of the topics have no time in common: {spans} (UTC). Likely '
            'cause: a time zone, time since boot, GPS time, or separate recordings. Stamp all '
            'sensors with one clock, or use arrival times (imu.arrival_time, '
            'odometer.arrival_time, gnss.arrival_time)')


def zero_of_times(bag: AnyBag, first: int, last: int) -> int:
    """
    Return the stamp at which the seconds of a leg begin: the start of the bag.

    If the stamps, from first to last, are on another clock than the bag times, as in simulation
    time or in a recording of a replay, it is the first of them.
    """
    return bag.start_ns if first <= bag.end_ns and bag.start_ns <= last else first


def _span_in_bag(span: LegSpan, bag: AnyBag, first: int, last: int) -> tuple[int, int]:
    """Return the stamps of a requested leg; raise BadUsage if it is outside the bag."""
    zero = zero_of_times(bag, first, last)
    start = first if span.start_ns is None else span.start_ns + zero * span.start_is_relative
    stop = last if span.stop_ns is None else span.stop_ns + zero * span.stop_is_relative
    begin, end = min(zero, first), max(zero + bag.end_ns - bag.start_ns, last)
    if (stop <= start or stop < begin - BAG_TIME_TOLERANCE_NS
            or start > end + BAG_TIME_TOLERANCE_NS):
        length = (bag.end_ns - bag.start_ns) * 1e-9
        requested = ':'.join(f'{(stamp - zero) * 1e-9:.2f}' for stamp in (start, stop))
        raise BadUsage(f'{bag.name}: the leg {requested} contains no data; the bag runs '
                       f'from 0 to {length:.1f} s; correct --leg')
    return start, stop


def standstills_of(inputs: Inputs, first: int, config: Config) -> Standstills:
    """
    Return the standstills of a recording, none if a topic is missing.

    inputs : screened, over the common time of the topics.   first : their start, ns.
    """
    if not (len(inputs.t_imu) > 3 and len(inputs.travel.t) > 1 and len(inputs.t_fix)):
        return Standstills(np.empty((0, 2), np.int64), np.empty((0, 2)), 0.0)
    scale = locate_fixes(inputs, config).rough_scale or 1.0
    spans = inputs.standstills(scale, config)
    path_length = running_sum(np.abs(np.diff(inputs.travel.s))) * scale
    metres = np.interp(spans, inputs.travel.t, path_length) if len(spans) else np.empty((0, 2))
    return Standstills(first + np.round(spans * 1e9).astype(np.int64), metres,
                       float(path_length[-1]))


def automatic_legs(recorder: LegRecorder, last: int, config: Config) -> Spans:
    """Return the legs that the node would start and end; ``last``: end of an open one, ns."""
    search = LegSearch(config)
    for slot in ('fix', 'imu', 'odometer'):
        search.feed(slot, recorder.rows(slot), recorder.form)
    return [(leg.start_ns, leg.stop_ns or last) for leg in search.spans
            if (leg.stop_ns or last) > leg.start_ns]


def _leg_between_standstills(first: int, last: int, stops: Standstills) -> tuple[int, int]:
    """Return one leg, from the first standstill to the last; intermediate stops never split."""
    count, distance = len(stops.spans_ns), stops.distance
    if not count:
        return first, last
    start, stop = first, last
    starts_at_rest = stops.path_m[0, 0] < LATEST_START_SHARE * distance
    if starts_at_rest:
        start = int(stops.spans_ns[0, 1])
    # judgement: the drive ends at a standstill if at most 2 % and 1 m of travel follow. A single
    # standstill is not start and end
    if count > starts_at_rest and distance - stops.path_m[-1, 1] < 0.02 * distance + 1.0:
        stop = int(stops.spans_ns[-1, 1])
    return start, stop


def _legs_between_all_stops(stops: Standstills, config: Config) -> Spans:
    """Return a leg from each standstill to the next, without short ones if others are left."""
    legs = list(pairwise(stops.spans_ns[:, 1].tolist()))
    lengths = stops.path_m[1:, 0] - stops.path_m[:-1, 1]
    return [leg for leg, length in zip(legs, lengths, strict=True)
            if length >= config.leg.min_distance] or legs
