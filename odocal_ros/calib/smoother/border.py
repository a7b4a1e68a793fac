"""What the data of a leg tell of its constants, the states and what was believed taken out."""

import numpy as np

from odocal_ros.calib.border import Border
from odocal_ros.calib.smoother.priors import PriorRows
from odocal_ros.calib.smoother.state import CONSTANTS


def border_of(fit, configured) -> Border:
    """
    Return the border of a fit, at its last linearisation.

    The normal matrix with the states eliminated, less what was believed of the constants: the
    elimination leaves their corner's prior as it is.

    configured : (M,) values of the settings that constants are corrections to.
    """
    at, priors = fit.weighted.state.constants, fit.weighted[PriorRows].priors
    weight = 1 / priors.constants**2
    return Border(
        CONSTANTS, at + configured, fit.solved.reduced - np.diag(weight),
        fit.solved.g_reduced + weight * (at - priors.centre), priors.centre + configured,
        fit.first.constants, priors.constants)
