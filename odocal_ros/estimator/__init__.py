# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The GNSS / IMU / odometer smoother: a batch maximum likelihood over all samples of a leg.

``smooth`` fits a finished leg, ``GrowingFit`` a leg that grows. ``make_smoother_leg`` makes their
input from screened samples, ``missing_samples_reason`` returns the reason for missing samples, and
``cramer_rao_bound`` the covariance without a fit.
"""

from odocal_ros.estimator.growing import GrowingFit, RunningEstimate
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.prepare import make_smoother_leg
from odocal_ros.estimator.smoother import (
    cramer_rao_bound,
    missing_samples_reason,
    smooth,
    too_few_samples_reason,
)

__all__ = ['GrowingFit', 'RunningEstimate', 'SmootherLeg', 'cramer_rao_bound', 'make_smoother_leg',
           'missing_samples_reason', 'smooth', 'too_few_samples_reason']
