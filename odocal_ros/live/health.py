"""How well one topic arrives: counts, rate, gaps, losses. Knows nothing of ROS."""

from collections import deque

import numpy as np

MEMORY = 64            # blocks kept for the rate
RATE_SPAN_NS = 3_000_000_000
SILENCE_NS = 2_000_000_000
JUMP_NS = 1_000_000_000
FEW = 3


class Health:
    """
    What is known of one topic's arrival.

    ``newest_ns`` is the newest usable stamp, on the sender's clock; ``heard_ns`` when the last
    message came, on the node's steady clock: the age of a topic must not depend on sim time.
    """

    def __init__(self) -> None:
        self.count = 0
        self.unusable = 0      # messages that could not be read
        self.lost = 0          # by the middleware's sequence numbers
        self.gaps = 0
        self.newest_ns = 0
        self.heard_ns = 0
        self.delay_s = 0.0     # arrival minus stamp of the newest row
        self.jumped_back = False
        self.fix_status: int | None = None
        self._last_sequence: int | None = None
        self._ends: deque = deque(maxlen=MEMORY)  # (count, stamp) after each block
        self._interval_s = 0.0

    def arrived(self, sequences, now_ns: int) -> None:
        """Count messages as they came; sequences are the publisher's numbers, or None."""
        self.heard_ns = now_ns
        numbers = [s for s in [self._last_sequence, *sequences] if s is not None]
        if len(numbers) > 1:
            steps = np.diff(np.asarray(numbers, dtype=np.int64))
            # several publishers, or one that started anew: the numbers then say nothing
            if (steps > 0).all():
                self.lost += int((steps - 1).sum())
        if numbers:
            self._last_sequence = numbers[-1]

    def decoded(self, block, max_gap_s: float | None = None) -> None:
        """Take over the stamps of a block; a gap is a step beyond the limit (or 5 intervals)."""
        self.count += len(block.stamp_ns)
        stamps = block.stamp_ns[block.stamp_ns > 0]
        if hasattr(block, 'status') and len(block.status):
            self.fix_status = int(block.status[-1])
        if not len(stamps):
            return
        newest = self._newest(stamps)
        steps = np.diff(stamps if not self.newest_ns else np.r_[self.newest_ns, stamps]) * 1e-9
        rising = steps[steps > 0]
        if len(rising):
            limit = max_gap_s or 5 * self._interval_s
            self.gaps += int((rising > limit).sum()) if limit else 0
            typical = float(np.median(rising))
            self._interval_s = 0.9 * self._interval_s + 0.1 * typical if self._interval_s \
                else typical
        self.newest_ns = newest
        self.delay_s = (int(block.received_ns[-1]) - int(block.stamp_ns[-1])) * 1e-9
        self._ends.append((self.count, newest))

    def _newest(self, stamps) -> int:
        """
        Return the newest stamp with a block of them, and note whether time has started anew.

        One or two stale stamps are a hiccup of the driver, more are a new start of time; where a
        block ends with few of them, the next one tells.
        """
        known = stamps if not self.newest_ns else np.r_[self.newest_ns, stamps]
        steps = np.diff(known)
        at = int(np.argmin(steps)) if len(steps) else 0
        fell = bool(len(steps)) and known[at + 1:].max() < known[at] - JUMP_NS
        after_wild = steps[at - 1] > JUMP_NS if at else not self.newest_ns
        if not fell or after_wild:
            return int(stamps[-1])
        if at and len(known) - 1 - at < FEW:
            return int(known[at])
        self.jumped_back = True
        return int(stamps[-1])

    def silent_s(self, now_ns: int) -> float:
        """Return seconds since the last message, infinite before the first."""
        return (now_ns - self.heard_ns) * 1e-9 if self.heard_ns else float('inf')

    def silence_allowed_s(self) -> float:
        """Return how long this topic may be silent before it counts as gone."""
        return max(SILENCE_NS * 1e-9, 5 * self._interval_s)

    def flowing(self, now_ns: int) -> bool:
        """Return whether messages that can be used are coming."""
        return bool(self.newest_ns) and self.silent_s(now_ns) < self.silence_allowed_s()

    def rate_hz(self, now_ns: int) -> float:
        """Return rows per second by their stamps over the last seconds, 0 when silent."""
        if not self.flowing(now_ns):
            return 0.0
        recent = [e for e in self._ends if e[1] >= self.newest_ns - RATE_SPAN_NS]
        if len(recent) < 2:
            recent = list(self._ends)[-2:]
        if len(recent) < 2 or recent[-1][1] <= recent[0][1]:
            return 0.0
        return (recent[-1][0] - recent[0][0]) / ((recent[-1][1] - recent[0][1]) * 1e-9)

    def forget(self) -> None:
        """Start anew after a jump of time; counts of losses stay."""
        self.newest_ns = 0
        self.jumped_back = False
        self._ends.clear()
