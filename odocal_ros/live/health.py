# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Health of one topic: rate, lost messages, gaps and jumps of time.

In: stamps and sequence numbers of its messages. Out: values for the status, and plausible rows.
"""

from collections import deque
from collections.abc import Sequence
from itertools import pairwise

from odocal_ros.data.arrays import Ints
from odocal_ros.settings.levels import TIME_RESTART_NS, TIME_RESTART_ROWS

# judgement: time span and number of blocks of a rate; silence of a lost topic
RATE_SPAN_NS, RATE_BLOCKS = 3 * 10**9, 64
SILENCE_NS = 2 * 10**9
# judgement: intervals of the stamps: longest step that is no gap, and longest silence of a topic;
# share of a new interval in their mean
GAP_LIMIT_INTERVALS, NEW_INTERVAL_SHARE = 5, 0.1
# judgement: a stamp further ahead is accepted as the last of TIME_RESTART_ROWS such stamps
STAMP_JUMP_NS = 30 * 10**9


class Health:
    """
    Counts and times of the messages of one topic.

    ``newest_ns`` is the newest usable stamp, on the sender's clock; ``last_arrival_ns`` is on the
    node's steady clock, since the age of a topic must not depend on simulated time.
    """

    def __init__(self) -> None:
        self.count = 0
        self.unreadable_count = 0    # messages that could not be read
        self.lost_count = 0          # messages missing in the middleware's sequence numbers
        self.lost_before_leg = 0     # ``lost_count`` at the start of the leg
        self.gap_count = 0          # steps of the stamps beyond the limit
        self.has_no_stamps = False    # no stamp in the last messages
        self.last_arrival_ns = 0
        self.delay_s = 0.0     # send time minus stamp of the newest message
        self.fix_status: int | None = None      # NavSatStatus of the newest fix
        self._last_sequence: int | None = None
        self._interval_s = 0.0    # smoothed interval of the stamps
        self.reset_times()

    def reset_times(self) -> None:
        """Restart after a jump of time; counts of losses stay."""
        self.newest_ns = 0
        self.has_jumped_back = False
        self._stamps_ahead: list[int] = []      # far ahead, not confirmed yet
        self._stale_rows = 0                    # far behind, at the end of the last block
        # count of messages and newest stamp after each block
        self._block_ends: deque[tuple[int, int]] = deque(maxlen=RATE_BLOCKS)

    def register_arrival(self, sequences: Sequence[int | None], now_ns: int) -> None:
        """Count lost messages; sequences: publisher's numbers in order of arrival, or None."""
        self.last_arrival_ns = now_ns
        numbers = [number for number in [self._last_sequence, *sequences] if number is not None]
        steps = [after - before for before, after in pairwise(numbers)]
        # numbers of several publishers, or of a restarted one, cannot be used
        if steps and min(steps) > 0:
            self.lost_count += sum(steps) - len(steps)
        if numbers:
            self._last_sequence = numbers[-1]

    def check_stamps(self, stamps: list[int], received_ns: Sequence[int] | Ints,
                     max_gap_s: float | None = None) -> list[bool]:
        """
        Process the stamps of some rows, ns.

        received_ns : as in the samples, the send time of live messages.   max_gap_s : longer steps
        are gaps; None: those above GAP_LIMIT_INTERVALS. Returns a mask of plausible stamps: not
        zero, not far ahead or behind.
        """
        self.count += len(stamps)
        self.has_no_stamps = bool(stamps) and max(stamps) <= 0
        plausible = self._not_ahead(stamps)
        rows = [row for row, is_plausible in enumerate(plausible) if is_plausible]
        if rows:
            newest = self.newest_ns
            self._update_times([stamps[row] for row in rows], max_gap_s)
            self.delay_s = (int(received_ns[rows[-1]]) - stamps[rows[-1]]) * 1e-9
            for row in rows:
                newest = max(newest, stamps[row])
                plausible[row] = stamps[row] >= newest - TIME_RESTART_NS
        return plausible

    def _not_ahead(self, stamps: list[int]) -> list[bool]:
        """Return a mask of stamps that exist and are not far ahead of the last one."""
        plausible, last = [stamp > 0 for stamp in stamps], self.newest_ns
        first = next((stamp for stamp in stamps if stamp > 0), 0)
        if not self._stamps_ahead and max(stamps, default=0) - (last or first) < STAMP_JUMP_NS:
            return plausible
        for row, stamp in enumerate(stamps):
            if plausible[row] and last and stamp - last >= STAMP_JUMP_NS:
                before = self._stamps_ahead
                is_confirming = before and abs(stamp - before[-1]) < STAMP_JUMP_NS
                self._stamps_ahead = [*before, stamp] if is_confirming else [stamp]
                plausible[row] = len(self._stamps_ahead) >= TIME_RESTART_ROWS
            if plausible[row]:
                last, self._stamps_ahead = stamp, []
        return plausible

    def _update_times(self, stamps: list[int], max_gap_s: float | None) -> None:
        stamps = [self.newest_ns, *stamps] if self.newest_ns else stamps
        steps = [after - before for before, after in pairwise(stamps)]
        rising = sorted(step * 1e-9 for step in steps if step > 0)
        if rising:
            limit = GAP_LIMIT_INTERVALS * self._interval_s if max_gap_s is None else max_gap_s
            self.gap_count += sum(step > limit for step in rising) if limit else 0
            median_s = rising[(len(rising) - 1) // 2]
            share = NEW_INTERVAL_SHARE if self._interval_s else 1.0
            self._interval_s += (median_s - self._interval_s) * share
        self.newest_ns = self._newest_after(stamps, steps)
        self._block_ends.append((self.count, self.newest_ns))

    def _newest_after(self, stamps: list[int], steps: list[int]) -> int:
        """Return the newest stamp after a block, and note whether time has restarted."""
        # one or two stamps far behind are a driver error, more are a restart of time; if a block
        # ends with few of them, or has one row only, the next block decides
        earlier_stale_rows, self._stale_rows = self._stale_rows, 0
        if not steps or min(steps) >= -TIME_RESTART_NS:
            return stamps[-1]
        k = steps.index(min(steps))      # the largest step back
        before, after = stamps[k], max(stamps[k + 1:])
        is_behind = after < before - TIME_RESTART_NS
        # the stamp before the step was a single error: those after it continue the earlier ones
        was_ahead = (steps[k - 1] > TIME_RESTART_NS and after >= stamps[k - 1] - TIME_RESTART_NS
                     if k else not self.newest_ns)
        if not is_behind or was_ahead:
            return stamps[-1]
        stale_rows = len(stamps) - 1 - k
        if stale_rows < TIME_RESTART_ROWS if k else stale_rows + earlier_stale_rows < 2:
            self._stale_rows = stale_rows
            return before
        self.has_jumped_back = True
        return stamps[-1]

    def silent_s(self, now_ns: int) -> float:
        """Return seconds since the last message, infinite before the first."""
        return (now_ns - self.last_arrival_ns) * 1e-9 if self.last_arrival_ns else float('inf')

    def is_flowing(self, now_ns: int) -> bool:
        limit_s = max(SILENCE_NS * 1e-9, GAP_LIMIT_INTERVALS * self._interval_s)
        return bool(self.newest_ns) and self.silent_s(now_ns) < limit_s

    def rate_hz(self, now_ns: int) -> float:
        """Return rows per second by their stamps over the last seconds, 0 when silent."""
        if not self.is_flowing(now_ns):
            return 0.0
        recent = [end for end in self._block_ends if end[1] >= self.newest_ns - RATE_SPAN_NS]
        if len(recent) < 2:
            recent = list(self._block_ends)[-2:]
        (first_count, first_ns), (count, newest_ns) = recent[0], recent[-1]
        duration_s = (newest_ns - first_ns) * 1e-9
        return (count - first_count) / duration_s if duration_s > 0 else 0.0
