# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""Integrals of long columns, some rows at a time; to the last bit as if at once."""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.pieces import pieces


class Integral:
    """The integral of (n, ...) by the trapezoid rule, over times that come in pieces."""

    def __init__(self) -> None:
        self.end = 0.0

    def over(self, t: Floats, x: Floats) -> Floats:
        """Return it at the times of a piece, whose first row is the last of that before."""
        out = np.empty_like(x)
        out[0] = self.end
        np.multiply((x[:-1] + x[1:]) / 2, np.diff(t).reshape(-1, *(1,) * (x.ndim - 1)),
                    out=out[1:])
        np.cumsum(out, axis=0, out=out)
        self.end = out[-1].copy()
        return out


def integral_at(times: Floats, t: Floats, x: Floats) -> Floats:
    """
    Return the integral of x, (n, ...), from t[0] on, linear between rows.

    times : (m,) array, rising.   t : (n,) array, n > 1.   Returns (m, ...).
    """
    integral, out = Integral(), np.empty((len(times), *x.shape[1:]))
    for where, rows in pieces(times, t):
        interpolated(times[where], t[rows], integral.over(t[rows], x[rows]), out[where])
    return out


def interpolated(times: Floats, t: Floats, x: Floats, out: Floats) -> None:
    """Write x, (n,) or (n, k), at times to out, linear between rows."""
    if x.ndim == 1:
        out[:] = np.interp(times, t, x)
        return
    for k in range(x.shape[1]):
        out[:, k] = np.interp(times, t, x[:, k])


def twice_integral_at(times: Floats, t: Floats, x: Floats) -> Floats:
    """Return the integral of the integral of x, (n,), at times, rising: (m,)."""
    once, twice, out = Integral(), Integral(), np.empty(len(times))
    for where, rows in pieces(times, t):
        interpolated(times[where], t[rows], twice.over(t[rows], once.over(t[rows], x[rows])),
                     out[where])
    return out
