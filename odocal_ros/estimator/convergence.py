# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Convergence of a fit: its limits, and its state from pass to pass (used by ``fit``)."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.estimator import state as layout
from odocal_ros.estimator.chain import Solution
from odocal_ros.estimator.factors.factor import PARAMETER_COUNT


@dataclass(frozen=True)
class Convergence:
    """
    Limits of convergence. Steps are those of the constants in the last pass, in sigmas.

    Judgement: the remaining change is then far below the stated sigma. Measured: with ``max_step``
    of 0.03, results differ by 0.02 sigma (rms of 29 drives; at most 0.08), passes are 1.11 times
    as many. With ``max_sigma_change`` of 0.05, some sigmas are up to 19 % too large. Without
    ``max_last_sigma_change``, those of 3 of 21 motorways with RTK at 1 Hz are 3 to 6 times too
    large. A change that grows has not converged: one sigma of a gyro without its y axis was 25 %
    too large, for 1.01 times the passes (60 drives).
    """

    # largest step below which derivatives use the fitted signal (signals.py), and above which
    # they use the measured one again
    fitted_below: float = 1.0
    measured_above: float = 4.0
    max_step: float = 0.08         # of any constant
    other_weight: float = 0.3      # in ``max_step``, of constants other than scale and mounting
    max_final_step: float = 0.1    # of scale and mounting, after the last allowed pass
    # the same, for a fit that converges slowly: its values are reported with larger sigmas
    max_slow_step: float = 0.5
    max_sigma_change: float = 0.02    # relative, of the sigmas of scale and mounting
    # the same, one pass earlier: a single small change may be between a rise and a fall
    max_last_sigma_change: float = 0.06
    # rad, sigma of an angle whose step does not count: it drifts where the cost is flat, and its
    # value is refused
    flat_angle: float = 0.1


CONVERGENCE = Convergence()
# definition: weights of the steps of the constants, and sigmas above which a step does not count
STEP_WEIGHTS = np.where(np.arange(layout.M) < PARAMETER_COUNT, 1.0, CONVERGENCE.other_weight)
FLAT_SIGMAS = np.full(layout.M, np.inf)
FLAT_SIGMAS[[layout.YAW, layout.PITCH]] = CONVERGENCE.flat_angle


class Progress:
    """Convergence of a fit from pass to pass."""

    def __init__(self, fitted: bool, frozen: bool, min_passes: int) -> None:
        """Start; fitted : use fitted signals.   frozen : levels are kept."""
        self.fitted = self.was_fitted = fitted      # in the next pass, in the last pass
        self.frozen, self.min_passes, self.converged = frozen, min_passes, False
        # scale and mounting: sigmas, largest change of the logarithms of these, larger of this
        # change and of the largest step in sigmas
        self.sigma, self.change, self.largest_change = np.ones(PARAMETER_COUNT), np.inf, np.inf
        self.largest_step = np.inf      # weighted, of all constants, in sigmas
        self.previous_step = np.zeros(layout.M)     # of the constants, for ``damp_step``

    def update(self, count: int, solution: Solution) -> None:
        """Update the state of convergence from the steps and sigmas of pass ``count``."""
        sigma = np.sqrt(np.diag(solution.covariance))
        step = np.abs(solution.step_constants / sigma)
        self.largest_step = float((step * np.where(sigma < FLAT_SIGMAS, STEP_WEIGHTS, 0.0)).max())
        before, self.sigma, last_change = self.sigma, sigma[:PARAMETER_COUNT], self.change
        self.change = np.abs(np.log(self.sigma / before)).max()
        self.largest_change = max(step[:PARAMETER_COUNT].max(), self.change)
        is_steady = count > self.min_passes and last_change < CONVERGENCE.max_last_sigma_change \
            and self.change < min(CONVERGENCE.max_sigma_change, last_change)
        self.converged = bool(self.fitted and self.largest_step < CONVERGENCE.max_step
                              and (self.frozen or is_steady))
        is_first_fitted, self.was_fitted = self.fitted and not self.was_fitted, self.fitted
        self.fitted = is_first_fitted or self.largest_step < (
            CONVERGENCE.measured_above if self.fitted else CONVERGENCE.fitted_below)
        # a first step with the fitted signal is never shortened: it corrects the error that noise
        # in the measured signal caused
        next_is_first = self.fitted and not self.was_fitted
        self.previous_step = np.zeros(layout.M) if next_is_first else solution.step_constants
