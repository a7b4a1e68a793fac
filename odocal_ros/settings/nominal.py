# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The nominal scale and yaw mounting angle, from the settings."""

from math import isnan, tau

from odocal_ros.settings.config import Config


def nominal_scale(config: Config, unit: str) -> float:
    """Return K0: as configured, from the wheel's size, or 1 for speeds; 0 unknown."""
    if config.odometer.nominal_scale:
        return config.odometer.nominal_scale
    wheels = config.wheels
    if unit == 'm/pulse' and wheels.radius and wheels.pulses_per_revolution:
        return tau * wheels.radius / wheels.pulses_per_revolution
    if unit == 'm/rad' and wheels.radius:
        return wheels.radius
    return 1.0 if unit == '1' else 0.0


def nominal_yaw(config: Config) -> float:
    """Return the yaw mounting angle as set, 0 where it is not, rad."""
    yaw = config.imu.nominal_yaw
    return 0.0 if isnan(yaw) else yaw
