# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Minimisation of the criterion of the search, by response surfaces and by least squares.

A response surface is a second-order polynomial fitted to a criterion. The box of fitted points
moves to its minimum and shrinks until the parameters converge; a minimum on the edge of the range
widens the range. Least squares on all fixes check it, and give condition number and correlations,
and whether positions separate left and right.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from odocal_ros.calib.wheel_search.parameter_sets import parameter_sets, Space
from odocal_ros.calib.wheel_search.planar import coefficients, inflation, loss, PlanarLeg, weights
from odocal_ros.data.arrays import Bools, Floats

STEP_LIMIT = 1e-11   # judgement: relative, rad; largest step of a converged iteration
HALVINGS = 40        # judgement: largest number of halvings of a step
DIFFERENCE = np.array([-1.0, 1.0, 0.0])    # definition: right minus left
TRACK_BEND = 1e-4    # judgement: bend of any track by gyro, slip, tyres over path length


@dataclass(frozen=True, eq=False)
class Surface:
    """A fitted polynomial: value + gradient y + y hessian y / 2, of y in [-1, 1]."""

    value: float
    gradient: Floats
    hessian: Floats
    r_squared: float    # share of the variance explained
    lack_of_fit: float  # largest residual over the range of the values


@dataclass(frozen=True, eq=False)
class SurfaceMinimum:
    """Minimum of a criterion, found by response surfaces."""

    x: Floats           # (3,) left, right (relative), heading (rad)
    value: float        # of the criterion there
    iterations: int     # number of surfaces
    converged: bool
    half_range: Floats  # (3,) of the last search range
    widened: bool       # the range was increased
    on_edge: bool       # the minimum is still on its edge
    first: Surface
    last: Surface


def fit_surface(y: Floats, values: Floats) -> Surface:
    """Fit a second-order polynomial to (m,) values at (m, n) points by least squares."""
    n = y.shape[1]
    i, j = np.triu_indices(n)
    design = np.hstack([np.ones((len(y), 1)), y, y[:, i] * y[:, j]])
    middle = values.mean()      # removed, so that its rounding is not fitted
    c = np.linalg.lstsq(design, values - middle, rcond=None)[0]      # coefficients
    residual = values - middle - design @ c
    hessian = np.zeros((n, n))
    hessian[i, j] = c[1 + n:]
    total_square, value_range = ((values - middle)**2).sum(), np.ptp(values)
    return Surface(float(c[0] + middle), c[1:1 + n], hessian + hessian.T,
                   float(1 - (residual**2).sum() / total_square) if total_square > 0 else 1.0,
                   float(np.abs(residual).max() / value_range) if value_range > 0 else 0.0)


def minimum_in_box(gradient: Floats, hessian: Floats, low: Floats, high: Floats) -> Floats:
    """
    Return the minimum of a quadratic in a box, exact for any signs of its curvature.

    It is stationary on one of the box's faces, interior and corners included: 27 for three
    parameters.
    """
    best, lowest = np.zeros(len(gradient)), np.inf     # at least a corner is found
    for face in product((None, low, high), repeat=len(gradient)):
        free = np.array([side is None for side in face])
        y = np.array([0.0 if side is None else side[k] for k, side in enumerate(face)])
        if free.any():
            slope = gradient[free] + hessian[np.ix_(free, ~free)] @ y[~free]
            y[free] = np.linalg.lstsq(hessian[np.ix_(free, free)], -slope, rcond=1e-15)[0]
            if (y < low).any() or (y > high).any():
                continue
        value = gradient @ y + y @ hessian @ y / 2
        if value < lowest:
            best, lowest = y, value
    return best


def refine(criterion: Callable[..., Any], x: Floats, width: Floats, half_range: Floats,
           space: Space, widen: bool = True) -> SurfaceMinimum:
    """
    Return the minimum of a criterion by response surfaces.

    criterion : function of (m, 3) parameters x with (m,) values.   x : (3,) first values.
    width : (3,) half width of the first box in x.   half_range : (3,) half of the search range
    about zero.   space : free parameters.   widen : double it if the minimum is on its edge.
    """
    search = _BoxSearch(criterion, space, half_range, width, x)
    first = last = search.surface()
    iterations, max_iterations = 1, 300    # surfaces; with the widest range a hundred are needed
    while True:
        converged = search.step(last)
        if converged and search.on_edge.any() and widen and search.widen():
            converged = False
        if converged or iterations == max_iterations:
            break
        last = search.surface()
        iterations += 1
    widened = bool((search.half_range > search.first_half_range).any())
    return SurfaceMinimum(space.T @ search.q, search.least, iterations, converged,
                          search.half_range, widened, bool(search.on_edge.any()), first, last)


class _BoxSearch:
    """
    State of a search: the box around the best point so far, within a range about zero.

    q, half_width : (n,) middle and half width of the box, in the coordinates of ``space``.
    half_range : (3,) half of the range of x.   least : criterion at the middle.   grid : (3^n, n)
    points of the box, in half widths from its middle.   values : (3^n,) criterion there.
    """

    def __init__(self, criterion: Callable[..., Any], space: Space, half_range: Floats,
                 width: Floats, x: Floats) -> None:
        self.criterion, self.space = criterion, space
        self.first_half_range = self.half_range = half_range
        self.first_half_width = np.abs(
            space.q_of(width) if space.ratio_is_fixed else
            np.array([width[:2].mean(), width[:2].sum(), width[2]]))     # widths add up
        self.half_width = self.first_half_width
        self.q = space.q_of(x)
        self.grid = np.array(list(product((-1.0, 0.0, 1.0), repeat=len(self.q))))
        self.on_edge = np.zeros(len(self.q), bool)
        self.least = np.inf

    def surface(self) -> Surface:
        """Return the polynomial fitted to the criterion at 3^n points of the box."""
        self.values = self.criterion((self.q + self.grid * self.half_width) @ self.space.T.T)
        self.least = float(self.values[len(self.grid) // 2])
        return fit_surface(self.grid, self.values)

    def step(self, surface: Surface) -> bool:
        """Move to the surface's minimum in the range, shrink the box; return True if converged."""
        S, bound = self.space.S, self.space.bounds(self.half_range)
        v = S @ self.q
        # y = (q - q0) / half_width; the range bounds v = S q, here in half ranges: u
        to_y = np.linalg.inv(S) / self.half_width[:, None] * bound
        low, high = -1.0 - v / bound, 1.0 - v / bound
        u = minimum_in_box(to_y.T @ surface.gradient, to_y.T @ surface.hessian @ to_y, low, high)
        self.on_edge = (u <= low) | (u >= high)
        move = np.linalg.solve(S, u * bound)
        value_there = float(self.criterion((self.space.T @ (self.q + move))[None])[0])
        step_limit = 1e-6    # share of the first half range, largest last step
        small = np.abs(S @ move) <= step_limit * self.space.bounds(self.first_half_range)
        # share of the criterion: the box is not shrunk if its curvature contributes less
        min_curvature = 1e-6
        shrinks = ~(0.5 * np.abs(np.diag(surface.hessian)) < min_curvature * self.least)
        narrow = 1e-3    # share of the first half width, box of the last surface
        is_narrow = self.half_width <= narrow * self.first_half_width
        converged = bool(small.all() and (~shrinks | is_narrow).all())
        outside = np.abs(move) > self.half_width
        rounding = 1e-12    # share of the criterion by which equal values may differ
        if value_there <= self.least * (1 + rounding):
            self.q, self.least = self.q + move, value_there
        else:
            outside = self._to_best_of_grid(bound)
        grow, shrink = 2.0, 0.25
        larger = np.minimum(grow * self.half_width, self.first_half_width)
        smaller = np.where(shrinks, shrink * self.half_width, self.half_width)
        self.half_width = np.where(outside, larger, smaller)
        return converged

    def _to_best_of_grid(self, bound: Floats) -> Bools:
        """Move to the best grid point in the range; return True where it is an end of the box."""
        points = self.q + self.grid * self.half_width
        allowed = (np.abs(points @ self.space.S.T) <= bound).all(axis=1)
        k = int(np.argmin(np.where(allowed, self.values, np.inf)))
        if not allowed[k] or self.values[k] >= self.least:
            return np.zeros(len(self.q), bool)
        self.q, self.least = points[k], float(self.values[k])
        return np.asarray(self.grid[k] != 0)

    def widen(self) -> bool:
        """Double the range where the minimum is on its edge; return False at the widest range."""
        wider = self.space.widened(self.half_range, self.on_edge)
        if np.array_equal(wider, self.half_range):
            return False
        self.half_range, self.half_width = wider, self.first_half_width
        return True


@dataclass(frozen=True, eq=False)
class SquaresMinimum:
    """Minimum of the criterion, found by least squares."""

    x: Floats                # (3,) left, right (relative), heading (rad)
    value: float             # of the criterion there
    iterations: int
    converged: bool
    covariance: Floats       # (3, 3) of x by the scatter, without errors of start, gyro, lever arm
    condition: float         # number of the Jacobian by the free relative scales and heading, rad
    sigma_difference: float  # of right minus left, relative; with a bend of the track

    @property
    def sigma(self) -> Floats:
        """Return the formal sigmas of x: (3,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Floats:
        """Return the correlations of x: (3, 3)."""
        return self.covariance / np.outer(self.sigma, self.sigma)


def least_squares(leg: PlanarLeg, x: Floats, space: Space, robust: bool = False) -> SquaresMinimum:
    """
    Return the parameters that minimise the (robust) mean square, by Gauss-Newton from x.

    leg : tracks and fixes.   x : (3,) first values: left, right (relative), heading (rad).
    space : free parameters.   robust : as in ``planar.score``.
    """
    q, iterations, converged = space.q_of(x), 0, False
    r, J = _linearise(leg, space.T @ q)
    value = _criterion(leg, r, robust)
    max_iterations = 200    # iterations; with reweighting a few are needed for each digit
    while not converged and iterations < max_iterations:
        iterations += 1
        root_weight = _root_weights(leg, r, robust)
        step = _solve(root_weight[:, None] * (J @ space.T), -root_weight * r)
        for _ in range(HALVINGS):
            r_new, J_new = _linearise(leg, space.T @ (q + step))
            new_value = _criterion(leg, r_new, robust)
            if new_value <= value:
                break
            step = step / 2
        else:
            converged = bool(np.abs(step).max() < STEP_LIMIT)
            break
        step_limit = STEP_LIMIT if new_value < value else 1e3 * STEP_LIMIT
        converged = bool(np.abs(step).max() < step_limit)
        q, r, J, value = q + step, r_new, J_new, new_value
    covariance, condition = _covariance(leg, r, J, space, robust)
    # sigma of right minus left: from the scatter, and from the bend of any track
    difference_effect = float(np.linalg.norm(J[:, 1] - J[:, 0])) / 2
    bend_sigma = TRACK_BEND * np.linalg.norm(J[:, 2]) / max(difference_effect, 1e-12)
    return SquaresMinimum(space.T @ q, value, iterations, converged, covariance, condition,
                          float(np.sqrt(DIFFERENCE @ covariance @ DIFFERENCE + bend_sigma**2)))


def _linearise(leg: PlanarLeg, x: Floats) -> tuple[Floats, Floats]:
    """Return residuals rotated by -heading, (2k,) m, and their Jacobian by x: (2k, 3)."""
    # coefficients of ``PlanarLeg.basis``, and their derivatives by left, right and heading
    c = np.zeros((4, 5))
    c[0] = coefficients(parameter_sets(leg, x))[0]
    c[1, 0], c[2, 1] = leg.scale_left / 2, leg.scale_right / 2
    c[3, 3:] = np.sin(x[2]), -np.cos(x[2])
    rows = np.hstack([c @ axis for axis in leg.basis])
    return rows[0], rows[1:].T


def _squared_distances(r: Floats) -> Floats:
    """Return squared distances of track and fixes, m^2, from residuals: (2k,) to (k,)."""
    east, north = r.reshape(2, -1)
    return east**2 + north**2


def _root_weights(leg: PlanarLeg, r: Floats, robust: bool) -> Floats:
    """Return the square roots of the weights of residuals r: (2k,)."""
    return np.sqrt(np.tile(weights(_squared_distances(r), leg.sigma, robust), 2))


def _criterion(leg: PlanarLeg, r: Floats, robust: bool) -> float:
    return float(loss(_squared_distances(r)[None], leg.sigma, robust)[0])


def _solve(A: Floats, b: Floats) -> Floats:
    """Return the least-squares solution, with columns scaled to equal size."""
    norm = np.linalg.norm(A, axis=0)
    norm = np.where(norm > 0, norm, 1.0)
    return np.linalg.lstsq(A / norm, b, rcond=1e-14)[0] / norm


def _covariance(leg: PlanarLeg, r: Floats, J: Floats, space: Space,
                robust: bool) -> tuple[Floats, float]:
    """Return the covariance of x, (3, 3), and the condition number of the Jacobian."""
    root_weight = _root_weights(leg, r, robust)
    s = np.linalg.svd(J @ space.T if space.ratio_is_fixed else J, compute_uv=False)
    condition = float(s[0] / s[-1]) if s[-1] > 1e-15 * s[0] else np.inf
    _, s, vt = np.linalg.svd(root_weight[:, None] * (J @ space.T), full_matrices=False)
    s = np.maximum(s, 1e-15 * max(s[0], 1e-300))     # unobservable: a huge sigma
    freedom = max(len(r) - len(s), 1)
    to_x = space.T @ (vt.T / s)
    rows = (root_weight * r).reshape(2, -1)
    return to_x @ to_x.T * ((rows**2).sum() / freedom * inflation(rows)), condition
