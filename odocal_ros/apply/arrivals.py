# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Arrivals of a stream: accepted stamps of a topic, and times on the rhythm of the sender."""

from collections import deque
import math

import numpy as np

from odocal_ros.data.arrays import Bools, Ints
from odocal_ros.screening.imu_rhythm import APART
from odocal_ros.screening.late_rows import LEAST_JITTER

# judgement: ns that a stamp may be ahead of what the arrivals before allow, and behind the newest:
# no driver is as odd; rows in turn beyond it, after which the clock was set
ODD_NS, ODD_ROWS = 200_000_000, 10
LATEST_NS = (2**31 - 5) * 10**9    # format: s of a header's stamp, with an imu.time_offset
FAST_PLAY = 1.5      # judgement: times real time, from which a bag is played, without its clock
LAG_ROWS = 1000      # judgement: accepted rows over which the least lag is forgotten
# judgement: rows in turn, all off by so many s or more, that show a clock that moved; rows that
# show that it stays so; ns per row that the usual lag follows; how far from real time a bag is
# played whose arrivals show nothing
MOVED_ROWS, MOVED_S, STAYS_ROWS, FOLLOW_NS, PLAYED = 3, 0.03, 50, 1e4, 0.05
# judgement: rows before the line is used; rows that it forgets in: crystals keep their rate for
# longer, and the jitter of the line goes by the root of 4 over them
FIRST_ROWS, LINE_ROWS = 20, 300
UNEVEN_ROWS = 100          # judgement: rows in motion over which unevenness is averaged
# judgement: ratio of unevenness on the rhythm to that of the arrivals above which it is no longer
# used, and below which it is again
AS_EVEN, EVENER = 1.0, 0.8
LATE_SIGMA = 1.5           # judgement: sigma over mean deviation of lateness, 1.3 if exponential
MOST_LATE = 3.0            # judgement: mean deviations that a row moves the line by at most
LATE_ROWS = 50             # judgement: rows of the mean deviation
SURE_STEP = 4.0            # judgement: counts in an interval from which travel shows lost rows
FAR = 0.5                  # judgement: intervals off the line from which rows may have been lost
FAR_ROWS = 25              # judgement: rows all of which are off so: it is no jitter
LONG_GAP = 1.0             # s; judgement: between rows of a slow wheel, lost rows
MOST_LOST = 5              # judgement: rows lost at once after which another line is determined


class Arrivals:
    """
    The stamps of one topic against their arrival.

    Lag is arrival minus stamp. Its least value so far, slowly forgotten, shows how early a stamp
    may be: one further ahead is false, or the clock was set. ``anew`` is True once ODD_ROWS in
    turn are odd; ``odd_from`` is then the first of them in the last block.
    """

    def __init__(self) -> None:
        self.anew = False
        self.odd_from = 0
        self.off_s = 0.0              # of the last odd stamp: how far ahead, or behind if negative
        self.dropped = 0              # rows of the last block, whatever their stamps are
        self._odd = 0
        self._newest_ns = 0
        self._first: tuple[int, int] | None = None      # stamp and arrival, ns
        self.rate = 1.0               # times real time that the stamps go by, 1 if about real time
        self.lag_ns: float | None = None      # the least, arrival less stamp
        self._real_time = True
        self._usual_ns = 0.0                  # of the lags, their median
        self._lags: deque[int] = deque(maxlen=STAYS_ROWS)

    def moved_s(self, rows: int) -> float:
        """Return by how many s the last rows are off the usual lag, 0 if one of them is not."""
        if len(self._lags) < rows or not self._real_time or (
                abs(self._lags[-1] - self._usual_ns) * 1e-9 <= MOVED_S):
            return 0.0
        last = list(self._lags)[-rows:]
        least = max(min(last) - self._usual_ns, self._usual_ns - max(last)) * 1e-9
        return abs(sum(last) / rows - self._usual_ns) * 1e-9 if least > MOVED_S else 0.0

    def usable(self, stamp_ns: Ints, received_ns: Ints) -> Bools:
        """Return a mask of rows of the next block with a usable stamp: (n,)."""
        good = [False] * len(stamp_ns)
        self.odd_from = self.dropped = 0
        for k, (stamp, received) in enumerate(zip(stamp_ns.tolist(), received_ns.tolist(),
                                                  strict=True)):
            if not 0 < stamp < LATEST_NS:
                self.dropped += 1
                continue
            lag = received - stamp
            ahead = 0.0 if self.lag_ns is None else self.lag_ns - lag
            behind = self._newest_ns - stamp
            if ahead > ODD_NS * self.rate or behind > ODD_NS:
                self.odd_from = k if not self._odd else self.odd_from
                self._odd += 1
                self.off_s = (-behind if behind > ODD_NS else ahead) * 1e-9
                self.anew |= self._odd >= ODD_ROWS
            elif behind < 0:
                good[k], self._odd, self._newest_ns = True, 0, stamp
                if self.lag_ns is None or ahead > 0:
                    self.lag_ns = lag
                else:
                    self.lag_ns -= ahead / LAG_ROWS
            self.dropped += not good[k] and behind != 0
            if not self._odd:
                self._follow(lag)
        self._take_rate(int(received_ns[-1]) if len(received_ns) else 0)
        return np.array(good, bool)

    def _follow(self, lag: int) -> None:
        """Take a lag, ns, and let the usual one follow slowly, as two clocks drift."""
        self._usual_ns = self._usual_ns if self._lags else float(lag)
        self._usual_ns += min(max(lag - self._usual_ns, -FOLLOW_NS), FOLLOW_NS)
        self._lags.append(lag)

    def _take_rate(self, received_ns: int) -> None:
        """Take the rate of the stamps since the first block; of a bag played fast it is not 1."""
        if self._first is None:
            self._first = (self._newest_ns, received_ns) if self._newest_ns else None
        elif received_ns > self._first[1]:
            rate = (self._newest_ns - self._first[0]) / (received_ns - self._first[1])
            self._real_time = abs(rate - 1) < PLAYED
            self.rate = rate if rate > FAST_PLAY else 1.0


class Rhythm:
    """
    Places the rows of a counter in time.

    ``error_s`` is the sigma of the times, s, beside a constant delay, as unevenness shows it.
    """

    def __init__(self) -> None:
        self._even = True      # travel is as even on the line, as far as it is known
        self.error_s = 0.0
        self._t = -math.inf                     # s, the last row as placed
        self._rows: deque[tuple[float, float, float]] = deque(maxlen=3)  # arrival, line, travel
        self._uneven = [0.0, 0.0]               # m^2, of travel by arrivals, on the line
        self._rounding = self._moved = 0.0      # m^2, of a count; (m/s)^2, mean of the speed
        self._tested = 0
        self._restart()

    def _restart(self) -> None:
        """Forget the line: the next rows determine another."""
        self._count = self._shifted = 0
        self._line = self._interval = self._late = 0.0
        self._off: deque[float] = deque(maxlen=FAR_ROWS)

    def place(self, t: float, travel: float, speed: float, quantum: float) -> float:
        """
        Return the time of the next row, s.

        t : s, its arrival.   travel : m, so far.   speed : m/s, before it.   quantum : m.
        """
        expected = abs(speed) * self._interval
        step = abs(travel - self._rows[-1][2]) if self._rows else 0.0
        sure = expected > SURE_STEP * quantum
        if not sure and t - self._line > LONG_GAP and not 0 < step <= 2 * SURE_STEP * quantum:
            self._restart()      # lost rows, as far as travel shows it: late ones come in turn
        self._follow(t, step, expected if sure else 0.0)
        self._rows.append((t, self._line if self._count else t, travel))
        if len(self._rows) == 3:
            self._test(quantum)
        at = self._rows[-1][1] if self._in_use() else t
        self._t = max(at, self._t + APART)
        return self._t

    @property
    def delay_s(self) -> float:
        """Return the sigma of the constant delay of the times, s: no row is early."""
        return LATE_SIGMA * self._late if self._in_use() else 0.0

    def _in_use(self) -> bool:
        return self._even and self._late > LEAST_JITTER and self._count > FIRST_ROWS

    def _follow(self, t: float, step: float, expected: float) -> None:
        """
        Move the line to the next row: that of least squares through the arrivals.

        t : s, its arrival.   step, expected : m in an interval, expected 0 where it shows nothing.
        """
        self._count += 1
        k = min(self._count, LINE_ROWS)
        if k == 1:
            self._line = t
            return
        off = t - self._line - self._interval
        intervals = 1
        if expected and off > FAR * self._interval and k > FIRST_ROWS:
            intervals = max(1, round(step / expected))
        if intervals > MOST_LOST:
            self._restart()
            return
        self._line += intervals * self._interval
        off = t - self._line
        if k > 2:       # two rows determine a line
            self._off.append(off)
            self._late += (abs(off) - self._late) / min(k - 2, LATE_ROWS)
        if k > FIRST_ROWS:
            most = MOST_LATE * self._late
            off = min(max(off, -most), most)
        self._line += off * 2 * (2 * k - 1) / (k * (k + 1))
        self._interval += off * 6 / (k * (k + 1)) / intervals
        if self._count > FIRST_ROWS:
            self._shift()

    def _shift(self) -> None:
        """Put a line right that all of the last rows are off by an interval or more."""
        least, largest = min(self._off), max(self._off)
        far = least if least > 0 else -largest if largest < 0 else 0.0
        if len(self._off) < FAR_ROWS or far <= FAR * self._interval:
            return
        if self._count - self._shifted < 4 * FAR_ROWS and self._shifted:
            self._restart()      # it is another rhythm
            return
        self._shifted = self._count
        self._line += math.copysign(round(far / self._interval) or 1, least) * self._interval
        self._off.clear()

    def _test(self, quantum: float) -> None:
        """Compare how even the travel is by arrivals and on the line."""
        (t0, p0, s0), (t1, p1, s1), (t2, p2, s2) = self._rows
        if self._count <= FIRST_ROWS or abs(s2 - s0) <= 2 * SURE_STEP * quantum:
            return
        self._tested += 1
        share = 1 / min(self._tested, UNEVEN_ROWS)
        for k, (a, b, c) in enumerate(((t0, t1, t2), (p0, p1, p2))):
            even = s0 + (s2 - s0) * (b - a) / (c - a) if c > a else s1
            self._uneven[k] += ((s1 - even)**2 - self._uneven[k]) * share
        self._moved += (((s2 - s0) / max(p2 - p0, APART))**2 - self._moved) * share
        self._rounding += (quantum**2 / 12 - self._rounding) * share
        limit = AS_EVEN if self._even else EVENER
        known = self._tested > FIRST_ROWS
        self._even = not known or self._uneven[1] <= limit**2 * self._uneven[0]
        # a row off its neighbours' middle by x has a sigma of x / sqrt(1.5)
        left = max(self._uneven[self._in_use()] / 1.5 - self._rounding, 0.0)
        self.error_s = math.sqrt(left / max(self._moved, APART))
        if not known:       # they may be right as they came
            self.error_s = max(self.error_s, LATE_SIGMA * self._late)
