# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Counts as they come while a leg is recorded, late ones put back as the result has them."""

from dataclasses import replace

import numpy as np

from odocal_ros.data.samples import join, OdometerForm, OdometerSamples, take
from odocal_ros.screening.late_rows import on_time, ON_TIME_WINDOW

SETTLED_NS = round(ON_TIME_WINDOW * 1e9)    # definition: after which no row to come moves one
RHYTHM_NS = 3 * SETTLED_NS       # judgement: of earlier rows, which determine the rhythm
UNROLLED = OdometerForm('cumulative', 0, '')     # definition: a count that never rolls over


class LateSoFar:
    """The newest rows of one counter that never rolls over; ``feed`` takes them as sent."""

    def __init__(self) -> None:
        self._rows: OdometerSamples | None = None
        self._given = 0             # of these, given away

    def feed(self, rows: OdometerSamples) -> OdometerSamples:
        """Take rows, and return those that stay where they are now."""
        rows = rows if self._rows is None else join([self._rows, rows])
        settled = int(np.searchsorted(rows.stamp_ns, rows.stamp_ns[-1] - SETTLED_NS))
        settled = max(settled, self._given)
        out = take(_on_time(rows), slice(self._given, settled))
        first = int(np.searchsorted(rows.stamp_ns, rows.stamp_ns[settled] - RHYTHM_NS))
        self._rows, self._given = take(rows, slice(first, None)), settled - first
        return out

    def rest(self) -> OdometerSamples:
        """Return the rows that are not given away, where they seem to belong; some were fed."""
        assert self._rows is not None
        return take(_on_time(self._rows), slice(self._given, None))


def _on_time(rows: OdometerSamples) -> OdometerSamples:
    since_s = (rows.stamp_ns - rows.stamp_ns[0]) * 1e-9
    true_s = on_time(rows, since_s, UNROLLED, [])
    true_ns = rows.stamp_ns[0] + np.rint(true_s * 1e9).astype(np.int64)
    return replace(rows, stamp_ns=np.maximum.accumulate(true_ns))
