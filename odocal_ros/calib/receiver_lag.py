"""What is said of a receiver that smooths its fixes."""

import numpy as np

from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import REMARK_SIGMAS

LAG_WORTH = 0.1    # s that are worth a word


def lag_reasons(square, sigma) -> tuple[Reason, ...]:
    """Return FIXES_SMOOTHED, where so; of the square of its time constant and sigma, s^2."""
    if square <= max(REMARK_SIGMAS * sigma, LAG_WORTH**2):
        return ()
    return (Reason(Code.FIXES_SMOOTHED, 'the receiver smooths its fixes over about '
                   f'{np.sqrt(square):.2f} s; the values allow for it'),)
