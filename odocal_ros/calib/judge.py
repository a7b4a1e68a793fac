"""Judging values against the asked limits; run on a leg and again on a combination."""

import numpy as np

from odocal_ros.reasons import Code, Reason


def judge(estimates, nominal_scale, config) -> tuple[Reason, ...]:
    """Return what the asked sigmas and the nominal values say of estimates."""
    reasons = []
    scale, yaw = estimates['scale_factor'], estimates['yaw_mounting_angle']
    if scale.value is not None:
        relative = scale.sigma / scale.value
        if relative > config.verdict.max_scale_sigma:
            reasons.append(Reason(Code.SCALE_SIGMA_TOO_LARGE, f'scale sigma {share(relative)}, '
                                  f'{share(config.verdict.max_scale_sigma)} asked'))
        if nominal_scale:
            off = scale.value / nominal_scale - 1
            if abs(off) > config.odometer.max_scale_deviation:
                reasons.append(Reason(Code.SCALE_FAR_FROM_NOMINAL, f'scale {scale.value:.6g} '
                                      f'{scale.unit} is {100 * off:+.1f} % from the nominal '
                                      f'{nominal_scale:.6g}'))
    if yaw.value is not None and yaw.sigma > config.verdict.max_yaw_sigma:
        sigma, asked = np.rad2deg([yaw.sigma, config.verdict.max_yaw_sigma])
        reasons.append(Reason(Code.YAW_SIGMA_TOO_LARGE, f'yaw sigma {sigma:.3f} deg, {asked:.3f} '
                              'deg asked'))
    return tuple(reasons)


def share(relative, sign='') -> str:
    """Return a relative figure as people say it: in ppm, or in per cent from one on."""
    return f'{100 * relative:{sign}.1f} %' if abs(relative) >= 0.01 else (
        f'{1e6 * relative:{sign}.0f} ppm')


def nominal_scale(config, unit) -> float:
    """Return K0: as configured, from the wheel's size, or 1 for speeds; 0 unknown."""
    if config.odometer.nominal_scale:
        return config.odometer.nominal_scale
    wheels = config.wheels
    if unit == 'm/pulse' and wheels.radius and wheels.pulses_per_revolution:
        return 2 * np.pi * wheels.radius / wheels.pulses_per_revolution
    if unit == 'm/rad' and wheels.radius:
        return wheels.radius
    return 1.0 if unit == '1' else 0.0
