# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
First values of a planar fit: scale factors, track width and headings, without prior values.

Wheel paths are dead-reckoned for many widths and ratios of the wheels; the best ones are refined.
Horizontal positions and vectors are complex numbers, x + y i.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.planar.run import Run
from odocal_ros.data.arrays import Complexes, Floats, Ints, running_sum

# track widths, m, 7.5 % apart, and right over left wheel minus 1. Judgement: of robots
WIDTHS = np.geomspace(0.05, 3.0, 58)
RATIOS = np.linspace(-0.03, 0.03, 13)
MAX_MINIMA, EQUIVALENT_COSTS = 5, 1.3     # judgement: minima compared, ratio of equal costs
SWAPPED_COST_RATIO = 0.3     # judgement: of mirrored to given positions, if wheels are swapped
# m, wheel path over which dead reckoning is compared. Judgement: several moves and turns
WINDOW = 6.0
# judgement: steps in a window between distant positions, such as marks; two fit any path
WINDOW_STEPS = 4


class FirstValues(NamedTuple):
    """First values of the wheels and of the n + 1 nodes of a run."""

    left: float      # scale factor, m per unit
    right: float     # the same
    width: float     # m, track width
    heading: Floats  # (n + 1,) rad, of nodes
    swapped: bool    # the mirrored positions fit better


def first_values(run: Run, width: float) -> FirstValues:
    """
    Return the first values of a run; width : track width, m, as configured, 0 unknown.

    Dead-reckoned paths for each of WIDTHS and RATIOS, in windows of WINDOW or WINDOW_STEPS steps
    between positions, are rotated and scaled onto the positions. Turns on the spot by 90 deg and
    by 450 deg look the same: if several minima fit about equally well, the one nearest to the
    configured width is used; without a configured width the largest, with the smallest turns.
    """
    # imported here: the start of a node does not need it
    from scipy.optimize import minimize
    position = run.position[:, 0] + 1j * run.position[:, 1]
    path = running_sum(run.wheels.path)[run.node]
    scale_guess = _scale_guess(position, path)
    windows = _windows(path * scale_guess)
    alignment = _Alignment(run, position, windows, scale_guess)
    # cost of the positions and of their mirror image for each width and ratio
    costs, mirrored = np.stack([alignment.fit(log_width, RATIOS)[0]
                                for log_width in np.log(WIDTHS)], axis=1)

    def cost(x: Floats) -> float:
        """Return the cost of x: log width, and ratio - 1."""
        return float(alignment.fit(x[0], x[1:])[0][0, 0])
    lowest = costs.min(axis=1)
    padded = np.pad(lowest, 1, constant_values=np.inf)
    minima = np.flatnonzero((lowest <= padded[:-2]) & (lowest <= padded[2:]))
    refined = []      # cost and x of minima
    for k in minima[np.argsort(lowest[minima])][:MAX_MINIMA]:
        guess = np.array([np.log(WIDTHS[k]), RATIOS[np.argmin(costs[k])]])
        minimum = minimize(cost, guess, method='Nelder-Mead', options={
            'initial_simplex': guess + [[0, 0], [0.04, 0], [0, 0.003]], 'maxfev': 80})
        refined.append((minimum.fun, minimum.x))
    # (1 mm)^2 for each position
    limit = EQUIVALENT_COSTS * min(value for value, _ in refined) + len(position) * 1e-6
    expected = np.log(width or WIDTHS[-1])
    x = min((x for value, x in refined if value <= limit), key=lambda x: abs(x[0] - expected))
    _, (factor,), (turn,) = alignment.fit(x[0], x[1:])
    middle = run.node[windows.sum(axis=1) // 2]
    heading = turn + np.interp(np.arange(len(turn)), middle, np.unwrap(np.angle(factor)))
    scale = float(np.median(np.abs(factor)))
    return FirstValues(scale * (1 - x[1] / 2), scale * (1 + x[1] / 2),
                       float(np.exp(x[0])) * scale / scale_guess, heading,
                       bool(mirrored.min() < SWAPPED_COST_RATIO * costs.min()))


def _scale_guess(position: Complexes, path: Floats) -> float:
    """Return metres per unit of wheel path: 75th percentile of chord over wheel path."""
    step = max(float(path[-1] - path[0]) / 200, 1e-12)
    ends = np.unique(np.searchsorted(path[:-1], np.arange(path[0], path[-1], step)))
    ratio = np.abs(np.diff(position[ends])) / np.diff(path[ends])
    return float(np.percentile(ratio, 75))


def _windows(path: Floats) -> Ints:
    """Return first and last + 1 position of each window, by the wheel path there, m: (w, 2)."""
    steps = np.sort(np.diff(path))
    # median step, weighted by its length
    median_step = steps[np.searchsorted(np.cumsum(steps), steps.sum() / 2)]
    length = max(WINDOW, WINDOW_STEPS * median_step)
    begins = np.arange(path[0], max(path[-1] - length / 2, path[0] + 1e-9), length / 2)
    spans = np.stack([np.searchsorted(path, begins), np.searchsorted(path, begins + length)], -1)
    min_positions = 3
    spans = spans[spans[:, 1] - spans[:, 0] >= min_positions]
    return spans if len(spans) else np.array([[0, len(path)]])


class _Alignment:
    """Fit of dead-reckoned paths to positions in w windows: rotation, scale and shift."""

    def __init__(self, run: Run, position: Complexes, windows: Ints, scale_guess: float) -> None:
        forward, side, wheel_difference = run.wheels.body_motion(run.wheels.count).T
        self.node, self.windows, self.scale_guess = run.node, windows, scale_guess
        self.left, self.right = forward - wheel_difference / 2, forward + wheel_difference / 2
        self.moved = forward + 1j * side
        self.count = np.diff(windows, axis=1)[:, 0]
        centred = position - position.mean()
        self.y = np.stack([centred, centred.conj()])[:, None]
        self.sum_y = self._sums(self.y)
        self.power_y = (self._sums(np.abs(centred)**2)
                        - np.abs(self.sum_y[0, 0])**2 / self.count).real

    def fit(self, log_width: float, ratios: Floats) -> tuple[Floats, Complexes, Floats]:
        """
        Return costs, (2, r) m^2, complex factors, (r, w), and headings, (r, n + 1) rad.

        The costs are of the positions and of their mirror image. A factor scales and rotates the
        path of a window onto its positions.   ratios : (r,) right over left wheel, minus 1.
        """
        half = ratios[:, None] / 2
        turn = _from_zero((1 + half) * self.right - (1 - half) * self.left)
        turn *= self.scale_guess / np.exp(log_width)
        path = _from_zero(self.moved * np.exp(1j * (turn[:, 1:] + turn[:, :-1]) / 2))[:, self.node]
        x = path - path.mean(axis=1, keepdims=True)
        sum_x = self._sums(x)
        power = (self._sums(np.abs(x)**2) - np.abs(sum_x)**2 / self.count).real
        cross = self._sums(x.conj() * self.y) - sum_x.conj() * self.sum_y / self.count
        factor = cross / np.maximum(power, 1e-30)
        return (self.power_y - np.abs(factor)**2 * power).sum(axis=-1), factor[0], turn

    def _sums(self, x: NDArray[Any]) -> NDArray[Any]:
        """Return the sums over each window, along the last axis."""
        total = _from_zero(x)
        return np.asarray(total[..., self.windows[:, 1]] - total[..., self.windows[:, 0]])


def _from_zero(steps: NDArray[Any]) -> NDArray[Any]:
    """Return the cumulative sums along the last axis, 0 first."""
    sums = np.zeros((*steps.shape[:-1], steps.shape[-1] + 1), steps.dtype)
    np.cumsum(steps, axis=-1, out=sums[..., 1:])
    return sums
