# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The GNSS / IMU / odometer smoother: a batch maximum likelihood over all samples of a leg.

``smooth`` fits a finished leg, ``GrowingFit`` a leg that grows. ``smoother_leg`` makes their input
from screened samples, ``too_little_of`` returns the samples that are missing, and ``bound`` the
covariance without a fit.
"""

from odocal_ros.estimator.growing import GrowingFit, Running
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.prepare import smoother_leg
from odocal_ros.estimator.smoother import bound, smooth, too_little, too_little_of

__all__ = ['GrowingFit', 'Running', 'SmootherLeg', 'bound', 'smooth', 'smoother_leg', 'too_little',
           'too_little_of']
