# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Reasons about clocks and filters of receiver and odometer, and a receiver's odometer."""

import numpy as np

from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.levels import FAULT_SIGMAS, REMARK_SIGMAS


def lag_reasons(square: float, sigma: float) -> tuple[Reason, ...]:
    """Return FIXES_SMOOTHED if the filter constant of the receiver, s^2, is significant."""
    worth = 0.1     # s: the age of a fix at 10 Hz is up to this
    if abs(square) <= max(REMARK_SIGMAS * sigma, worth**2):
        return ()
    what, time = ('averages its fixes', np.sqrt(square)) if square > 0 else (
        'filters position and velocity', np.sqrt(-square / 2))
    return (Reason(Code.FIXES_SMOOTHED, f'the receiver {what} with a time constant of about '
                   f'{time:.2f} s; accounted for'),)


def follows_odometer(share: float, sigma: float) -> bool:
    """Return True if the receiver has an odometer of its own, of this error."""
    worth = 5e-4    # relative: smaller ones do not change a scale by more than its sigma
    return bool(abs(share) > max(FAULT_SIGMAS * sigma, worth))


def odometer_reasons(share: float, sigma: float, log_time: float,
                     by_map: float) -> tuple[Reason, ...]:
    """Return FIXES_FOLLOW_ODOMETER if significant; by_map: sigma of ln K, 0 without a map."""
    if not follows_odometer(share, sigma):
        return ()
    return (Reason(Code.FIXES_FOLLOW_ODOMETER, 'the fixes contain an odometer with a scale error '
                   f'of {100 * share:+z.2f} % ± {100 * sigma:.2f} % (time constant '
                   f'{np.exp(log_time):.0f} s), as positions fused with a wheel speed do; '
                   'accounted for' + (f', with an uncertainty of the scale of {100 * by_map:.2g} %'
                                      if by_map else '')),)


def by_map_drift(share: float, log_time: float, duration: float) -> float:
    """
    Return the sigma of ln K by the drift of a map that is filtered together with the wheels.

    This drift is not modelled. Within a time constant of the filter it cannot be distinguished
    from the wheel error, which is therefore averaged over only duration / time constant samples.
    """
    return float(abs(share) * np.sqrt(np.exp(log_time) / duration))


def filter_reasons(square: float, sigma: float) -> tuple[Reason, ...]:
    """Return SPEED_FILTERED if the filter constant of the odometer, s^2, is significant."""
    worth = 0.1     # s: a shorter one has an effect of a centimetre, at 2 m/s^2
    if square <= max(REMARK_SIGMAS * sigma, worth**2):
        return ()
    return (Reason(Code.SPEED_FILTERED, 'the odometer speed is low-pass filtered with a time '
                   f'constant of about {np.sqrt(square):.2f} s; accounted for'),)


def clock_reasons(name: str, rate: float, sigma: float, duration: float) -> tuple[Reason, ...]:
    """Return CLOCKS_DRIFT if a rate and its effect over ``duration``, s, are significant."""
    worth = 0.01        # s: the samples of most odometers are farther apart
    if abs(rate) <= REMARK_SIGMAS * sigma or abs(rate) * duration <= worth:
        return ()
    return (Reason(Code.CLOCKS_DRIFT, f'{name} stamps: the clock is {1e6 * abs(rate):.0f} ppm (± '
                   f'{1e6 * sigma:.0f}) {"fast" if rate > 0 else "slow"} relative to the IMU, '
                   f'{abs(rate) * duration:.3f} s in this leg; accounted for'),)
