# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
The GNSS / IMU / odometer smoother: a batch maximum likelihood over all samples of a leg.

``smooth`` takes a leg that is over, ``GrowingFit`` one that grows; ``smoother_leg`` makes either
of screened samples, where ``too_little_of`` says no. ``bound`` is the covariance without a fit.
"""

from odocal_ros.estimator.growing import GrowingFit, Running
from odocal_ros.estimator.leg import SmootherLeg
from odocal_ros.estimator.prepare import smoother_leg
from odocal_ros.estimator.smoother import (
    bound,
    keyframe_times,
    smooth,
    too_little,
    too_little_of,
)

__all__ = ['GrowingFit', 'Running', 'SmootherLeg', 'bound', 'keyframe_times', 'smooth',
           'smoother_leg', 'too_little', 'too_little_of']
