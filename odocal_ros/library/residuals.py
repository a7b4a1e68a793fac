# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What is left over of each sensor along the legs of a calibration: value, sigma, unit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.errors import BadUsage
from odocal_ros.library.series import Series, stacked

# what the smoother leaves over: its sensors, their unit, their components
SMOOTHED = (('fix', 'm', ('east', 'north', 'up')), ('odometer', 'm', ('along', 'left', 'up')),
            ('gyro', 'rad/s', ('x', 'y', 'z')), ('accelerometer', 'm/s^2', ('x', 'y', 'z')))


@dataclass(frozen=True, eq=False)
class Left:
    """What is left over of a sensor in a leg: t (m,) s, value and sigma (m, c), NaN: nothing."""

    sensor: str
    unit: str
    components: tuple[str, ...]
    t: NDArray[np.float64]
    value: NDArray[np.floating]
    sigma: NDArray[np.floating]


def left_in(leg: LegResult) -> list[Left]:
    """Return the residuals of each sensor in a leg, none without track and fit."""
    found = []
    if (e := leg.evidence) is not None:
        sigma = np.repeat(e.fix_sigma[:, None], 2, axis=1)
        found = [Left(name, 'm', ('along', 'left'), e.t_fix, rows, sigma) for name, rows in (
            ('track', e.residual), ('track_before', e.residual_before))]
    smoothed = getattr(leg.methods.get('smoother'), 'details', {})
    for sensor, unit, components in SMOOTHED:
        if f'left_{sensor}' in smoothed:
            t = smoothed['left_fix_t'] if sensor == 'fix' else smoothed['key_t'][1:]
            found.append(Left(sensor, unit, components, t,
                              *np.hsplit(smoothed[f'left_{sensor}'], 2)))
    return found


def residuals(result: Calibration) -> Series:
    """
    Return the residuals of each sensor, one row per component.

    sensor, component, value, sigma, unit : the calibrated drive less what the sensor says, and one
    standard deviation of the noise it is modelled with.   distance_m : driven until then.

    ``track`` along, left: dead reckoning from the start mark less each fix, as calibrated;
    ``track_before`` as configured. By the smoother, where it could fit: ``fix`` east, north, up;
    of the second before, ``odometer`` along, left, up, and ``gyro`` and ``accelerometer`` x, y, z,
    means, in the body frame b.

    Raises
    ------
    BadUsage
        No leg has a track.

    """
    found = [(number, leg, _rows(leg, one)) for number, leg in enumerate(result.legs, 1)
             for one in left_in(leg)]
    if not found:
        raise BadUsage('no leg has a track to compare with its fixes; see the reasons')
    return stacked(found)


def _rows(leg: LegResult, left: Left) -> Series:
    m, c = left.value.shape
    known = np.isfinite(left.sigma).ravel()
    t, e = np.repeat(left.t, c), leg.evidence
    far = np.full(m * c, np.nan) if e is None else np.interp(t, e.t, e.distance)
    columns = {'t': t, 'sensor': np.full(m * c, left.sensor),
               'component': np.tile(left.components, m),
               'value': left.value.ravel().astype(float),
               'sigma': left.sigma.ravel().astype(float),
               'unit': np.full(m * c, left.unit), 'distance_m': far}
    return {name: column[known] for name, column in columns.items()}
