# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The result of a leg that is refused: reasons, and estimates without values."""

from collections.abc import Iterable

from odocal_ros.calib.budget import PARAMETERS
from odocal_ros.calib.result import Estimate, MethodResult, unknown_values
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.result.remarks import IMU_SCALES
from odocal_ros.estimator.result.wheel_result import unknown_wheels
from odocal_ros.estimator.state import CONSTANTS, HEADING, ODO_ARM
from odocal_ros.nav.odometer import Travel
from odocal_ros.reasons import Code, Reason

UNITS = dict.fromkeys(CONSTANTS, 'm') | {'yaw_mounting_angle': 'rad',
                                         'pitch_mounting_angle': 'rad', 'odometer_delay': 's',
                                         'gnss_delay': 's'}
# estimated if the drive determines them: lever arms and delays
OPTIONAL = range(ODO_ARM.start, HEADING)


def refused(reasons: Iterable[Reason], scale_unit: str,
            wheels: Iterable[Travel] = ()) -> MethodResult:
    """Return the result of a leg that the method refuses: every value unknown."""
    found = unknown(scale_unit) | unknown_wheels((one.name for one in wheels), scale_unit)
    return MethodResult('smoother', tuple(reasons), found, PARAMETERS)


def no_imu(fit: Fit) -> list[Reason]:
    """Return the reasons against implausible errors of the IMU, [] if there are none."""
    c = fit.state.constants
    worst = max(IMU_SCALES, key=lambda i: abs(c[i]))
    if abs(c[worst]) <= 0.2:        # twenty times the error of a consumer IMU
        return []
    return [Reason(Code.NOT_CONVERGED, 'the fit converged to '
                   f'{CONSTANTS[worst].replace("_", " ")} {100 * c[worst]:+z.0f} %, impossible '
                   'for an IMU: a local minimum, or wrong units, axes or time offsets')]


def unknown(scale_unit: str) -> dict[str, Estimate]:
    """Return the estimates of a leg, each without a value."""
    units = {f'gyro_bias_{axis}': 'rad/s' for axis in 'xyz'} | {
        CONSTANTS[i]: UNITS[CONSTANTS[i]] for i in OPTIONAL}
    return unknown_values(scale_unit) | {
        name: Estimate(None, None, unit) for name, unit in units.items()}
