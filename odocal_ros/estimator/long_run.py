# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The growth of fix errors with time, against that of the model: docs/method.md (S17a).

The errors of a receiver that filters have a correlated rate. They grow with time, those of a
Gauss-Markov process with its root: differences of adjacent fixes then underestimate them.
"""

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.estimator.factors.fixes import Fixes
from odocal_ros.estimator.factors.point_rows import TAIL_SIGMAS
from odocal_ros.estimator.levels import Levels
from odocal_ros.nav.statistics import NORMAL_MEDIAN

# minimum number of spans in a leg: statistical, their variance is then good to 35 %, with two axes
FEWEST_SPANS = 8
COLUMNS = {'slow': slice(0, 2), 'slow_up': slice(2, 3)}     # of ENU


def long_run(fixes: Fixes, levels: Levels,
             found: dict[str, tuple[float, float]]) -> dict[str, float]:
    """
    Return the factors, 1 or more, by which correlated errors exceed the model of their steps.

    The largest ratio, for spans of 1, 2, 4, ... s, of the mean square of the error differences to
    its expectation plus one standard deviation.

    fixes : with white and correlated errors.   levels : of the pass.   found : quadratic sum and
    expectation of each level.
    """
    t, error = fixes.state.t[fixes.k] + fixes.points.tau, fixes.errors()
    stated = 1 / np.diagonal(fixes.root, axis1=1, axis2=2)**2
    time, out = levels.correlation_time, dict.fromkeys(COLUMNS, 1.0)
    span = max(1.0, 2 * float(np.median(np.diff(t))))
    while t[-1] - t[0] > FEWEST_SPANS * span:
        end = np.searchsorted(t, t + span)
        a = np.flatnonzero(end < len(t))
        b = end[a]
        grown = float((1 - np.exp(-(t[b] - t[a]) / time)).mean())
        spans = (t[-1] - t[0]) / span
        for (name, columns), white in zip(COLUMNS.items(), Fixes.levels_of, strict=True):
            power, noise = (levels[level] * found[level][0] / max(found[level][1], 1e-9)
                            for level in (name, white))
            want = 2 * noise * float(stated[a, columns].mean()) + power * time * grown
            change = error[b, columns] - error[a, columns]
            chance = 1 + np.sqrt(2 / (spans * change.shape[1]))
            out[name] = max(out[name], _mean_square(change) / want / chance)
        span *= 2
    return out


def _mean_square(change: Floats) -> float:
    """Return the mean square of changes (k, c) with their tails cut."""
    size = np.abs(change)
    most = TAIL_SIGMAS * np.median(size, axis=0) / NORMAL_MEDIAN
    return float((np.minimum(size, most)**2).mean())
