# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Accepted stamps of one topic in odometry: increasing and close to their arrival."""

from collections import deque

import numpy as np

from odocal_ros.data.arrays import Bools, Ints

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
        last = list(self._lags)[-rows:]
        if len(last) < rows or not self._real_time:
            return 0.0
        least = max(min(last) - self._usual_ns, self._usual_ns - max(last)) * 1e-9
        return abs(sum(last) / rows - self._usual_ns) * 1e-9 if least > MOVED_S else 0.0

    def usable(self, stamp_ns: Ints, received_ns: Ints) -> Bools:
        """Return a mask of rows of the next block with a usable stamp: (n,)."""
        good = np.zeros(len(stamp_ns), bool)
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
        return good

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
