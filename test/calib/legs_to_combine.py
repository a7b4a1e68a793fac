# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Legs to combine: linear legs with a known batch solution, and legs of the smoother."""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.marginal_information import MarginalInformation
from odocal_ros.calib.result import LegResult
from odocal_ros.reasons import Reason

NAMES = ('k', 'z0', 'z1', 'z2', 'z3')
LEGS, STATES, ROWS = 5, 80, 130
TRUTH = np.array([0.1, 0.3, -0.2, 0.05, 0.4])
PRIOR = np.array([np.inf, 2.0, 0.5, 0.5, 1.0])
STEPS = np.array([0.02, 0.0, 0.05, 0.01])


class Toy:
    """Legs of linear rows with unit variance: b = A (states) + B (constants) + noise."""

    def __init__(self, rng, legs=LEGS, states=STATES, rows=ROWS):
        self.A = rng.standard_normal((legs, rows, states))
        self.B = rng.standard_normal((legs, rows, len(NAMES)))
        self.B[:, :, 0] *= 100.0          # much information about ln K
        # one leg does not observe z0 and z1 - z2, another does not observe k
        self.B[1, :, 1] = 0.0
        self.B[1, :, 3] = -self.B[1, :, 2]
        self.B[2, :, 0] = 0.0
        self.draw(rng)

    def draw(self, rng, constants=None):
        """Draw the noise and arbitrary states."""
        constants = np.tile(TRUTH, (len(self.A), 1)) if constants is None else constants
        self.b = np.einsum('jrc,jc->jr', self.B, constants) + rng.standard_normal(self.B.shape[:2])
        return self

    def walk(self, rng, change=0.0, since=3):
        """Draw a random walk of the first constant, with one additional step change."""
        constants = np.tile(TRUTH, (len(self.A), 1))
        constants[1:, 0] += np.cumsum(STEPS * rng.standard_normal(len(STEPS)))
        constants[since:, 0] += change
        return self.draw(rng, constants)

    def marginal(self, j, about=None):
        """Return the marginal information of a leg at a linearisation point."""
        A, B, b = self.A[j], self.B[j], self.b[j]
        about = TRUTH + 0.1 * j if about is None else about
        free = B - A @ np.linalg.lstsq(A, B, rcond=None)[0]
        return MarginalInformation(NAMES, np.array(about, float), free.T @ free,
                                   free.T @ (b - B @ about), np.zeros(len(NAMES)), PRIOR, PRIOR)

    def marginals(self):
        return [self.marginal(j) for j in range(len(self.A))]

    def batch(self, steps=STEPS, leg_errors=()):
        """
        Return value and covariance of the constants of the last leg by one dense fit of all rows.

        leg_errors : (index, sigma) of constants with a separate error in each leg.
        """
        J, R, n = self.A.shape
        z, k, d = J * n, J * n + len(NAMES) - 1, J * n + len(NAMES) - 1 + J
        whole = np.zeros((J * R, d + J * len(leg_errors)))
        for j in range(J):
            rows = slice(j * R, (j + 1) * R)
            whole[rows, j * n:(j + 1) * n] = self.A[j]
            whole[rows, z:k] = self.B[j, :, 1:]
            whole[rows, k + j] = self.B[j, :, 0]
            for i, (which, _) in enumerate(leg_errors):
                whole[rows, d + j * len(leg_errors) + i] = self.B[j, :, which]
        more = np.zeros((len(PRIOR) - 1 + J - 1 + J * len(leg_errors), whole.shape[1]))
        more[range(4), range(z, k)] = 1 / PRIOR[1:]
        for j, step in enumerate(np.maximum(steps, 1e-7)):
            more[4 + j, [k + j, k + j + 1]] = -1 / step, 1 / step
        last = np.arange(J * len(leg_errors))
        more[4 + J - 1 + last, d + last] = 1 / np.tile([s for _, s in leg_errors], J)
        whole = np.concatenate([whole, more])
        Q, T = np.linalg.qr(whole)
        inverse = np.linalg.inv(T)
        x = inverse @ (Q.T @ np.concatenate([self.b.ravel(), np.zeros(len(more))]))
        at = [k + J - 1, *range(z, k)]
        return x[at], (inverse @ inverse.T)[np.ix_(at, at)]


def largest_deviation(a, b, covariance):
    """Return the largest difference between two solutions, in sigmas."""
    return np.abs((a - b) / np.sqrt(np.diag(covariance))).max()


NO_SCATTER = 1e-9, 1e-9, 1e-9       # sigma of the change of ln K, yaw and pitch between legs


def moved(result, name, by):
    marginal = result.marginal
    at = np.arange(len(marginal.names)) == marginal.names.index(name)
    return replace(result, marginal=replace(marginal, point=marginal.point + by * at))


def leg_result(method, number, *codes):
    return LegResult(number * 10**12, number * 10**12 + 10**11, 1e3, 100.0, 1, 1, 1, 0,
                     tuple(Reason(c, c.name) for c in codes), {'smoother': method},
                     C_bi=np.eye(3))
