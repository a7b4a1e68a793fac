# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The planar estimator on a leg: wheels without an IMU, skid steering, mecanum, omni wheels."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from odocal_ros.calib.choice import PLANAR
from odocal_ros.calib.planar import run as planar
from odocal_ros.calib.planar.result import make_planar_result, refused_planar_result
from odocal_ros.calib.result import failure, LegResult, MethodResult, raise_on_overflow
from odocal_ros.data.arrays import Floats, Ints, running_sum
from odocal_ros.data.leg import Leg
from odocal_ros.errors import OdocalError
from odocal_ros.nav.time_series import integral_at, robust_sigma
from odocal_ros.pipeline.methods import leg_result
from odocal_ros.pipeline.prepared_leg import Stage
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.inputs import Inputs, locate_fixes, median_origin
from odocal_ros.screening.local_frame import local_frame_reasons
from odocal_ros.screening.screen import screen
from odocal_ros.settings import config as settings
from odocal_ros.settings.nominal import grade_of, nominal_scale

# judgement: s between nodes, at 1 rad/s a turn of 0.1 rad; largest number of nodes
NODE_INTERVAL, MAX_NODES = 0.1, 20_000
MIN_POSITIONS = 10       # judgement: as for other methods
# least distance for a slope, m and in sigmas of a height, judgement: longer than a room is high
SLOPE_LENGTH, HEIGHT_SIGMAS = 5.0, 30.0
# rad/sqrt(s), judgement: effect of tilt and vibration of a robot, not included in the grade
MIN_GYRO_NOISE = 1e-3
AXLE_ORDER = 'left before right of each axle from front to rear.'
# reasons about the IMU, which the planar estimator does not need
IMU_CODES = {Code.NO_IMU, Code.NO_ACCELEROMETER, Code.IMU_GAP, Code.LOCAL_FRAME}


def is_planar(leg: Leg, config: settings.Config) -> bool:
    """Return True for a leg of the planar estimator: several wheels and no IMU, or its drives."""
    has_no_imu = len(leg.wheel_slots) > 1 and not len(leg.imu.stamp_ns)
    return config.odometer.drive != settings.DIFFERENTIAL or has_no_imu


def planar_leg(leg: Leg, config: settings.Config, notes: Sequence[Reason],
               progress: Callable[[Stage], None]) -> LegResult:
    """Return the result of a leg; ``progress`` is called as in ``calibrate``."""
    inputs, screening_reasons = screen(leg, config, check_faults=False)
    reasons = [*notes, *(reason for reason in screening_reasons if reason.code not in IMU_CODES)]
    progress(Stage(PLANAR))
    run, missing = _make_run(inputs, config)
    if run is None:
        methods = {PLANAR: refused_planar_result(missing, inputs.scale_unit)}
        return leg_result(leg, inputs, (*reasons, *missing), methods, deciding=(PLANAR,))
    method, tracks = _fit_guarded(run, inputs, config, progress)
    return leg_result(leg, inputs, reasons, {PLANAR: method}, deciding=(PLANAR,), **tracks)


def _fit_guarded(run: planar.Run, inputs: Inputs, config: settings.Config,
                 progress: Callable[[Stage], None]) -> tuple[MethodResult, dict[str, Any]]:
    """Return the method's result, and tracks as fields of LegResult; an error rejects both."""
    from odocal_ros.calib.planar.fit import fit_run
    unit = inputs.scale_unit

    def unknown(reason: Reason) -> MethodResult:
        return refused_planar_result([reason], unit)
    try:
        with raise_on_overflow():
            fit = fit_run(run, known_values(run, config), lambda passes, change: progress(
                Stage(PLANAR, passes=passes, change=change)))
            method = make_planar_result(fit, unit, nominal_scale(config, unit), config,
                                        shortened_by_slopes(inputs))
            return method, _tracks(run, fit)
    except (FloatingPointError, np.linalg.LinAlgError):
        return unknown(Reason(Code.NOT_CONVERGED, f'{PLANAR} did not converge: an estimate became '
                              'infinite or NaN. Likely cause: the wheels do not belong to the '
                              'positions, or the positions are too inaccurate for a '
                              'drive without an IMU')), {}
    except (OdocalError, MemoryError):
        raise
    except Exception as error:
        return failure(unknown, PLANAR, error), {}


def _make_run(inputs: Inputs, config: settings.Config) -> tuple[planar.Run | None, list[Reason]]:
    """Return wheels, positions and gyro of a leg on common nodes; None and reasons if missing."""
    travels, kind = inputs.travels, config.odometer.drive
    if wrong_count := _wheel_count_reason(kind, len(travels)):
        return None, [wrong_count]
    begin = max(0.0, *(travel.t[0] for travel in travels))
    end = min(inputs.t_stop, *(travel.t[-1] for travel in travels))
    inside = np.flatnonzero((inputs.t_fix >= begin) & (inputs.t_fix <= end))
    if len(inside) < MIN_POSITIONS:
        return None, [Reason(Code.NO_FIX, f'{len(inside)} positions while the wheels have data; '
                             f'required: {MIN_POSITIONS}')]
    if frame_reasons := local_frame_reasons(inputs, locate_fixes(inputs, config), kind):
        return None, [*frame_reasons]
    nodes = _make_nodes(inputs.t_fix[inside])
    t, rows = nodes.t, inside[nodes.rows]
    geodetic = np.nan_to_num(inputs.geodetic[rows])
    position = median_origin(inputs.t_fix, inputs.geodetic).to_n(geodetic)[:, :2]
    covariance = inputs.covariance_n[rows]
    sigma = np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    steps = np.array([np.diff(travel.at(t)) for travel in travels])
    if kind in settings.HOLONOMIC:
        wheels = planar.Wheels(steps.T, planar.wheel_rows(
            kind, len(steps), config.odometer.wheel_offset), kind)
    else:
        wheels = planar.make_side_wheels(steps[::2].mean(axis=0), steps[1::2].mean(axis=0), kind)
    if not wheels.count.any():
        return None, [Reason(Code.ODOMETER_STILL, 'the wheels do not turn during the leg')]
    return planar.Run(t, wheels, nodes.with_position, position, sigma, _gyro_turns(inputs, t)), []


def _wheel_count_reason(kind: str, count: int) -> Reason | None:
    """Return the reason if the number of wheels with known sides does not fit the drive."""
    needed, fits, order = {
        settings.MECANUM: ('4', count == len(planar.MECANUM_ROWS), AXLE_ORDER),
        settings.OMNI: (f'{settings.MIN_OMNI_WHEELS} or more', count >= settings.MIN_OMNI_WHEELS,
                        'counter-clockwise, the first at odometer.wheel_offset.')}.get(
        kind, ('2', count >= 2 and count % 2 == 0, AXLE_ORDER))
    return None if fits else Reason(
        Code.NO_ODOMETER, f'{kind} drive: {max(count, 1)} wheels with known sides; required: '
        f'{needed}', f'Name the wheels in odometer.wheels, {order}')


def shortened_by_slopes(inputs: Inputs) -> float:
    """Return the relative shortening of the path by slopes: mean slope^2 / 2, minus its noise."""
    has_height = ~np.isnan(inputs.geodetic[:, 2])
    if has_height.sum() < MIN_POSITIONS:
        return 0.0
    geodetic = inputs.geodetic[has_height]
    position = median_origin(inputs.t_fix[has_height], geodetic).to_n(geodetic)
    # of the heights: stated, or white noise, whose third differences have 20 times its variance
    variance = max(float(np.median(inputs.covariance_n[has_height, 2, 2])),
                   robust_sigma(np.diff(position[:, 2], 3))**2 / 20)
    path = running_sum(np.hypot(*np.diff(position[:, :2], axis=0).T))
    length = max(SLOPE_LENGTH, HEIGHT_SIGMAS * float(np.sqrt(variance)))
    ends = np.searchsorted(path[:-1], np.arange(0.0, path[-1], length))
    chord = np.hypot(*np.diff(position[ends, :2], axis=0).T)
    straight = chord > length / 2      # judgement: otherwise it turned back, or is noise
    slope = np.diff(position[ends, 2])[straight] / chord[straight]
    noise = 2 * variance / np.maximum(chord[straight], 1e-9)**2
    return float(max(np.mean(slope**2 - noise), 0.0) / 2) if straight.any() else 0.0


class Nodes(NamedTuple):
    """Times at which the planar fit estimates poses."""

    t: Floats              # (n,) s
    with_position: Ints    # (k,) nodes with a position
    rows: Ints             # (k,) their rows in the positions: one in each node interval


def _make_nodes(t_fix: Floats) -> Nodes:
    """Return nodes at positions, times (n,) s, and evenly between two that are far apart."""
    interval = max(NODE_INTERVAL, float(t_fix[-1] - t_fix[0]) / MAX_NODES)
    number = np.floor((t_fix - t_fix[0]) / interval + 1e-6)
    rows = np.flatnonzero(np.diff(number, prepend=-1.0) > 0)
    kept = t_fix[rows]
    parts = np.maximum(np.ceil(np.diff(kept) / (1.5 * interval)), 1).astype(np.int64)
    node = running_sum(parts)
    share = (np.arange(parts.sum()) - np.repeat(node[:-1], parts)) / np.repeat(parts, parts)
    t = np.append(np.repeat(kept[:-1], parts) + share * np.repeat(np.diff(kept), parts), kept[-1])
    return Nodes(t, node, rows)


def _gyro_turns(inputs: Inputs, t: Floats) -> Floats:
    """Return the integral of the turn rate about up in each interval, rad; empty without IMU."""
    if not inputs.has_accelerometer or len(inputs.t_imu) < 2 or inputs.t_imu[0] > t[0] \
            or inputs.t_imu[-1] < t[-1]:
        return np.empty(0)
    rate = np.einsum('ij,j->i', inputs.w_b, inputs.up_b)       # BLAS: depends on its threads
    return np.diff(integral_at(t, inputs.t_imu, rate))


def known_values(run: planar.Run, config: settings.Config) -> planar.PriorKnowledge:
    """Return the prior knowledge of a run from the settings."""
    antenna, odometer = config.gnss.lever_arm, config.odometer.lever_arm
    grade = grade_of(config.imu)
    known = planar.PriorKnowledge(
        width=config.odometer.track_width * (run.wheels.kind not in settings.HOLONOMIC),
        offset=(antenna[0] - odometer[0], antenna[1] - odometer[1]),
        offset_sigma=max(config.gnss.lever_arm_sigma, 1e-3), delay_sigma=config.gnss.time_sigma,
        gyro_noise=max(grade.gyro_noise, MIN_GYRO_NOISE),
        gyro_scale_sigma=max(grade.gyro_scale_sigma, 1e-6),
        gyro_bias_sigma=max(grade.gyro_bias, 1e-6))
    if not config.gnss.correlation_time > 0:
        return known
    path = np.linalg.norm(np.diff(run.position, axis=0), axis=1).sum()
    return replace(known, drift_length=config.gnss.correlation_time * path / (
        run.t[-1] - run.t[0]))


def _tracks(run: planar.Run, fit: planar.Fit) -> dict[str, Any]:
    """Return path length, track and positions as fields of LegResult."""
    pose = fit.pose
    flat = np.column_stack([pose[:, :2], np.zeros(len(pose))])
    step = np.linalg.norm(np.diff(pose[:, :2], axis=0), axis=1)
    return {'distance': float(step.sum()), 'track_n': flat,
            'reference_n': np.column_stack([run.position, np.zeros(len(run.position))])}
