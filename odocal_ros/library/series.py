# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Time series of a calibration as columns: states along each leg, residuals of each sensor."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.data.arrays import Floats
from odocal_ros.errors import BadUsage
from odocal_ros.nav.dead_reckoning import forward_b, Origin
from odocal_ros.nav.rotations import quat_from_matrix, rpy_from_matrix

Series = dict[str, NDArray[Any]]    # columns of equal length, by name
NO_FIT = ('no leg has a result of the smoother, which computes this series; see the reasons, or '
          'use method auto')
# residuals of the smoother: sensor -> unit, components
SMOOTHER_SENSORS = {
    'fix': ('m', ('east', 'north', 'up')), 'odometer': ('m', ('along', 'left', 'up')),
    'gyro': ('rad/s', ('x', 'y', 'z')), 'accelerometer': ('m/s^2', ('x', 'y', 'z'))}


class LegSeries(NamedTuple):
    """The series of a leg."""

    number: int         # of the leg, from 1
    leg: LegResult
    columns: Series     # with the times t, s since the start mark


def trajectory(result: Calibration) -> Series:
    """
    Return the smoothed drive, second by second, of the legs that the smoother could fit.

    east_m, north_m, up_m : of the odometer's point, in n at the leg's origin.
    latitude_deg, longitude_deg, height_m : the same.   qx, qy, qz, qw : rotation from vehicle
    axes (forward, left, up) to n.   Raises BadUsage: no leg has a fit of the smoother.
    """
    return _stack_fits(result, _pose)


def states(result: Calibration) -> Series:
    """
    Return attitude and biases of the IMU, second by second, as the smoother estimates them.

    roll, pitch, yaw : of the vehicle in n, yaw from east.   gyro_bias_x ... : rad/s, in the body
    frame b.   accelerometer_bias_x ... : m/s^2.   Each with its sigma: gyro_bias_x_sigma ...

    Raises BadUsage: no leg has a fit of the smoother.
    """
    return _stack_fits(result, _state)


def _stack_fits(result: Calibration,
                make_columns: Callable[[LegResult, dict[str, Any]], Series]) -> Series:
    """Return the columns of all legs with a fit of the smoother, from leg and its details."""
    legs = [LegSeries(number, leg, make_columns(leg, leg.methods['smoother'].details))
            for number, leg in enumerate(result.legs, 1)
            if leg.track_n is not None
            and 'key_C_nb' in getattr(leg.methods.get('smoother'), 'details', ())]
    if not legs:
        raise BadUsage(NO_FIT)
    return stack_legs(legs)


def _at_track(smoothed: dict[str, Any], column: Floats) -> Floats:
    """Return the rows of a column by keyframe at the times of the track, all of keyframes."""
    return np.asarray(column[np.searchsorted(smoothed['key_t'], smoothed['track_t'])])


def _vehicle_attitude(leg: LegResult, smoothed: dict[str, Any]) -> Floats:
    """Return the rotations from vehicle axes to n at the rows of the track: (m, 3, 3)."""
    from odocal_ros.estimator.state import vehicle_axes
    estimates = leg.methods['smoother'].estimates
    yaw, pitch = (estimates[f'{name}_mounting_angle'].value or 0.0 for name in ('yaw', 'pitch'))
    C_nb = smoothed['key_C_nb']
    return _at_track(smoothed, C_nb) @ vehicle_axes(
        forward_b(yaw, pitch), C_nb[:, 2].mean(axis=0), smoothed['mean_roll']['value'])


def _pose(leg: LegResult, smoothed: dict[str, Any]) -> Series:
    """Return the columns of ``trajectory``."""
    track_n = smoothed['track_n']
    # a local frame has no position on the Earth
    geodetic = Origin(*leg.origin).to_geodetic(track_n) if leg.origin else np.full(
        track_n.shape, np.nan)
    latitude, longitude, height = geodetic.T
    quaternion = quat_from_matrix(_vehicle_attitude(leg, smoothed))
    return {'t': smoothed['track_t'],
            **dict(zip(('east_m', 'north_m', 'up_m'), track_n.T, strict=True)),
            'latitude_deg': np.rad2deg(latitude), 'longitude_deg': np.rad2deg(longitude),
            'height_m': height,
            **dict(zip(('qx', 'qy', 'qz', 'qw'), quaternion.T, strict=True))}


def _state(leg: LegResult, smoothed: dict[str, Any]) -> Series:
    """Return the columns of ``states``."""
    angles = rpy_from_matrix(_vehicle_attitude(leg, smoothed))
    columns = {'t': smoothed['track_t'],
               **dict(zip(('roll', 'pitch', 'yaw'), np.transpose(angles), strict=True))}
    for ending, key in (('', 'key_biases'), ('_sigma', 'key_bias_sigmas')):
        for sensor, rows in zip(('gyro', 'accelerometer'), smoothed[key], strict=True):
            columns |= {f'{sensor}_bias_{axis}{ending}': _at_track(smoothed, column)
                        for axis, column in zip('xyz', rows.T, strict=True)}
    return columns


def stack_legs(legs: list[LegSeries]) -> Series:
    """Return the series of legs one after another, with numbers, stamps and times."""
    series = []
    for number, leg, columns in legs:
        t = columns['t']
        stamp_ns = leg.start_ns + np.round(t * 1e9).astype(np.int64)
        series.append({'leg': np.full(len(t), number), 'stamp_ns': stamp_ns, 't_s': t} | columns)
    return {name: np.concatenate([columns[name] for columns in series])
            for name in series[0] if name != 't'}


@dataclass(frozen=True, eq=False)
class SensorResiduals:
    """Residuals of a sensor with c components in a leg."""

    sensor: str
    unit: str
    components: tuple[str, ...]
    t: NDArray[np.float64]           # (m,) s since the start mark
    value: NDArray[np.floating]      # (m, c)
    sigma: NDArray[np.floating]      # (m, c), NaN: no residual


def sensor_residuals(leg: LegResult) -> list[SensorResiduals]:
    """Return the residuals of each sensor in a leg, none without track and fit."""
    sensors = []
    if (evidence := leg.evidence) is not None:
        sigma = np.repeat(evidence.fix_sigma[:, None], 2, axis=1)
        sensors = [SensorResiduals(name, 'm', ('along', 'left'), evidence.t_fix, rows, sigma)
                   for name, rows in (('track', evidence.residual),
                                      ('track_before', evidence.residual_before))]
    smoothed = getattr(leg.methods.get('smoother'), 'details', {})
    for sensor, (unit, components) in SMOOTHER_SENSORS.items():
        if f'residual_{sensor}' in smoothed:      # residuals, then their sigmas
            t = smoothed['residual_fix_t'] if sensor == 'fix' else smoothed['key_t'][1:]
            sensors.append(SensorResiduals(sensor, unit, components, t,
                                           *np.hsplit(smoothed[f'residual_{sensor}'], 2)))
    return sensors


def residuals(result: Calibration) -> Series:
    """
    Return the residuals of each sensor, one row per component.

    sensor, component, value, sigma, unit : calibrated drive minus measurement, and one standard
    deviation of its modelled noise.   distance_m : path length so far.

    Sensor ``track``, components along, left: dead reckoning from the start mark with the
    calibrated values minus each fix; ``track_before`` with the configured values. If the smoother
    has a fit: ``fix`` east, north, up; over each second ``odometer`` along, left, up, and means
    of ``gyro`` and ``accelerometer`` x, y, z in the body frame b.

    Raises BadUsage: no leg has a track.
    """
    legs = [LegSeries(number, leg, _residual_rows(leg, sensor)) for number, leg in enumerate(
        result.legs, 1) for sensor in sensor_residuals(leg)]
    if not legs:
        raise BadUsage('no leg has a track to compare with its fixes; see the reasons')
    return stack_legs(legs)


def _residual_rows(leg: LegResult, residuals: SensorResiduals) -> Series:
    """Return the residuals of a sensor as columns, a row for each known component."""
    times, components = residuals.value.shape
    n = residuals.value.size
    known = np.isfinite(residuals.sigma).ravel()
    t, evidence = np.repeat(residuals.t, components), leg.evidence
    distance = np.full(n, np.nan) if evidence is None else np.interp(t, evidence.t,
                                                                     evidence.distance)
    columns = {'t': t, 'sensor': np.full(n, residuals.sensor),
               'component': np.tile(residuals.components, times),
               'value': residuals.value.ravel().astype(float),
               'sigma': residuals.sigma.ravel().astype(float),
               'unit': np.full(n, residuals.unit), 'distance_m': distance}
    return {name: column[known] for name, column in columns.items()}
