# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Test of the stamps of a topic by their arrival times: false stamps, clocks that were set.

In: rows in order of arrival. Out: the rows with a usable stamp, and steps of the sender's clock.
"""

from collections import deque
from collections.abc import Sequence

from odocal_ros.data.samples import Reading

LATEST_STAMP_NS = (2**31 - 5) * 10**9    # format: 32-bit seconds of a header, minus a time_offset
STAMP_LIMIT_NS = 200_000_000    # judgement: lead over the least lag; age before the newest stamp
CLOCK_SET_ROWS = 10    # judgement: consecutive rows beyond STAMP_LIMIT_NS, then the clock was set
LAG_ROWS = 1000        # judgement: accepted rows over which the least lag increases again
# judgement: consecutive rows until a clock step is detected, and until it is permanent
STEP_ROWS, PERMANENT_ROWS = 3, 50
MIN_STEP_S = 0.03    # s, judgement: smaller shifts of the lag are no clock step
LAG_CHANGE_NS = 1e4    # ns per row, judgement: largest change of the median lag
FAST_PLAY = 1.5        # judgement: least speed of a bag played faster, relative to real time
REAL_TIME_TOLERANCE = 0.05    # judgement: relative; at other speeds of a bag, no clock steps


class StampScreen:
    """
    Test of the stamps of one topic, in blocks of rows in order of arrival.

    Lag is arrival minus stamp. A stamp whose lag is far below the least lag so far, or that is
    far older than the newest one, is false, or the clock was set: ``clock_jumped`` is then True
    after CLOCK_SET_ROWS such rows, and ``jump_row`` is the first of them in the last block.
    """

    def __init__(self) -> None:
        self.clock_jumped = False
        self.jump_row = 0
        self.excess_s = 0.0           # of the last refused stamp; positive: it is in the future
        self.dropped = 0              # number of rows dropped from the last block
        self.drop_cause = ''          # of the last of them
        self.rate = 1.0               # speed of a bag played faster than FAST_PLAY, else 1
        self.lag_ns: float | None = None      # least lag
        self._refused_rows = 0        # consecutive ones
        self._newest_ns = 0           # newest usable stamp
        self._first_row: tuple[int, int] | None = None      # its stamp and arrival, ns
        self._is_real_time = True     # False: a bag is played faster or slower
        self._median_lag_ns = 0.0     # running median of the lags
        self._lags: deque[int] = deque(maxlen=PERMANENT_ROWS)

    def clock_step_s(self, rows: int) -> float:
        """Return the shift of the lag of the last rows, s; 0 if any is within MIN_STEP_S."""
        if len(self._lags) < rows or not self._is_real_time or (
                abs(self._lags[-1] - self._median_lag_ns) * 1e-9 <= MIN_STEP_S):
            return 0.0
        last = list(self._lags)[-rows:]
        smallest_shift = max(min(last) - self._median_lag_ns,
                             self._median_lag_ns - max(last)) * 1e-9
        shift = abs(sum(last) / rows - self._median_lag_ns) * 1e-9
        return shift if smallest_shift > MIN_STEP_S else 0.0

    def select_usable(self, rows: Sequence[Reading]) -> list[Reading]:
        """Return the rows of the next block with a usable stamp."""
        usable_rows: list[Reading] = []
        self.jump_row = self.dropped = 0
        for k, row in enumerate(rows):
            stamp, received = row[:2]      # ns
            if not 0 < stamp < LATEST_STAMP_NS:
                self._drop('a stamp is zero, negative or too large')
                continue
            lag = received - stamp
            lead_ns = 0.0 if self.lag_ns is None else self.lag_ns - lag
            age_ns = self._newest_ns - stamp
            if lead_ns > STAMP_LIMIT_NS * self.rate or age_ns > STAMP_LIMIT_NS:      # it is false
                if not self._refused_rows:
                    self.jump_row = k
                self._refused_rows += 1
                self.excess_s = (-age_ns if age_ns > STAMP_LIMIT_NS else lead_ns) * 1e-9
                if age_ns:      # a repeated row is no fault
                    self._drop(f'the stamps differ from the arrival times by {self.excess_s:+.3g} '
                               f's; the limit is {STAMP_LIMIT_NS * 1e-9:g} s')
                self.clock_jumped |= self._refused_rows >= CLOCK_SET_ROWS
            elif age_ns < 0:
                self._refused_rows, self._newest_ns = 0, stamp
                usable_rows.append(row)
                if self.lag_ns is None or lead_ns > 0:
                    self.lag_ns = lag
                else:
                    self.lag_ns -= lead_ns / LAG_ROWS
            elif age_ns > 0:
                self._drop(f'a stamp is {age_ns * 1e-9:.3g} s before an earlier one')
            if not self._refused_rows:
                self._update_median_lag(lag)
        self._update_rate(rows[-1][1] if rows else 0)
        return usable_rows

    def _drop(self, cause: str) -> None:
        self.dropped, self.drop_cause = self.dropped + 1, cause

    def _update_median_lag(self, lag: int) -> None:
        """Update the running median by a lag, ns; it changes slowly, as two clocks drift."""
        self._median_lag_ns = self._median_lag_ns if self._lags else float(lag)
        self._median_lag_ns += min(max(lag - self._median_lag_ns, -LAG_CHANGE_NS), LAG_CHANGE_NS)
        self._lags.append(lag)

    def _update_rate(self, received_ns: int) -> None:
        """Update the rate of the stamps since the first block: the speed of a played bag."""
        if self._first_row is None:
            self._first_row = (self._newest_ns, received_ns) if self._newest_ns else None
        elif received_ns > self._first_row[1]:
            rate = (self._newest_ns - self._first_row[0]) / (received_ns - self._first_row[1])
            self._is_real_time = abs(rate - 1) < REAL_TIME_TOLERANCE
            self.rate = rate if rate > FAST_PLAY else 1.0
