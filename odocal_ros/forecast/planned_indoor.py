# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Forecast of a run of a small robot: the information of its estimator at the true states.

The planar estimator for wheels without an IMU, skid steering and robots that move sideways; the
smoother for two wheels with an IMU. Scale 1, angles 0: sigmas do not depend on them.
"""

from dataclasses import dataclass, replace

import numpy as np

from odocal_ros.calib.planar.fit import fit_at, LEAST, LEVELS, priors
from odocal_ros.calib.planar.result import result_of
from odocal_ros.calib.planar.run import of_sides, rows_of, Run, Wheels
from odocal_ros.calib.result import MethodResult
from odocal_ros.data.arrays import Bools, Floats, Ints
from odocal_ros.estimator.prepare import problem_of
from odocal_ros.estimator.result.outcome import make_result
from odocal_ros.forecast import planned_methods
from odocal_ros.forecast.ideal_samples import ideal
from odocal_ros.forecast.indoor_motion import MOTION_STEP, RobotMotion
from odocal_ros.forecast.planned_drive import from_rates
from odocal_ros.forecast.predict import Sigmas
from odocal_ros.forecast.smoother_forecast import relative
from odocal_ros.nav.earth import rate_without_north
from odocal_ros.pipeline.planar_run import known_of
from odocal_ros.settings import config as settings

# m^2/m, judgement: usual in fits of robots without sideways slip, 0.3 mm in a metre
NO_SIDE_SLIP = 1e-7
FASTEST_NODES = 10.0       # Hz, definition: of positions that the planar estimator uses


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Robot and reference of a run."""

    drive: str                      # as odometer.drive
    imu: bool                       # it has one
    width: float                    # m, of skid steering on the spot; of HOLONOMIC twice the lever
    straight_width: float = 0.0     # m, of skid steering straight on
    wheels: int = 2
    slip: float = 1e-3              # m/sqrt(s) of each wheel while it moves
    white: float = 0.02             # m, white error of the positions
    rate: float = 10.0              # Hz, of the positions
    drift: float = 0.0              # m, stationary sigma of their correlated error
    drift_length: float = 10.0      # m of path, its correlation length
    at_rests: bool = False          # positions in the rests only


def planar_run(motion: RobotMotion, robot: Robot) -> tuple[Run, Floats, Floats]:
    """Return the run of a motion without errors, true states (n + 1, 5) and constants (w,)."""
    d = motion.increments
    wheels, more = _wheels(d, robot)
    own = [*np.ones(wheels.count.shape[1]), 1 / robot.width, *more]
    heading = np.append(0.0, np.cumsum(d[:, 2]))
    chord = (d[:, 0] + 1j * d[:, 1]) * np.sinc(d[:, 2] / (2 * np.pi))
    z = np.append(0.0, np.cumsum(chord * np.exp(1j * (heading[1:] + heading[:-1]) / 2)))
    state = np.column_stack([z.real, z.imag, heading, 0 * heading, 0 * heading])
    node = _measured(motion, robot)
    gyro = d[:, 2] if robot.imu else np.empty(0)
    run = Run(motion.t, wheels, node, state[node, :2], np.full(len(node), robot.white), gyro)
    return run, state, np.array([*own, *[0.0] * (3 + 2 * robot.imu)])


def _wheels(d: Floats, robot: Robot) -> tuple[Wheels, list[float]]:
    """Return the wheels of body increments, (n, 3), and the constants after the curvature."""
    if robot.drive in settings.HOLONOMIC:
        rows = rows_of(robot.drive, robot.wheels)
        count = (d * [1.0, 1.0, robot.width / 2]) @ rows.T
        return Wheels(count, rows, robot.drive), [1.0] * (robot.drive == settings.MECANUM)
    apart = d[:, 2] * robot.width
    arc = 1 / (robot.straight_width or robot.width) - 1 / robot.width

    def of(apart: Floats) -> Wheels:
        return of_sides(d[:, 0] - apart / 2, d[:, 0] + apart / 2, robot.drive)
    for _ in range(50 * (robot.drive == settings.SKID)):      # the width depends on the paths
        apart = d[:, 2] / (1 / robot.width + arc * of(apart).straightness)
    return of(apart), [arc] * (robot.drive == settings.SKID)


def _measured(motion: RobotMotion, robot: Robot) -> Ints:
    """Return the nodes with a position."""
    every = max(1, round(1 / (min(robot.rate, FASTEST_NODES) * MOTION_STEP)))
    node = np.arange(0, len(motion.t), every)
    if robot.at_rests:
        t = motion.t[node]
        middle = motion.rests.mean(axis=1)
        node = node[(np.abs(t[:, None] - middle) <= 0.5).any(axis=1)]
    return node


def predict_planar(motion: RobotMotion, robot: Robot, config: settings.Config) -> MethodResult:
    """Return the prediction of the planar estimator: covariance of its fit at the truth."""
    run, state, constants = planar_run(motion, robot)
    known = replace(known_of(run, config), drift_length=robot.drift_length)
    _, prior = priors(run, known, 1.0, 1.0, robot.width)
    first = np.array([1.0, 1.0, 1 / robot.width])
    found = fit_at(run, known, state, constants, _levels(motion, robot, run), first, prior)
    return result_of(found, '1', 0.0, config)


def _levels(motion: RobotMotion, robot: Robot, run: Run) -> dict[str, float]:
    """Return the noise levels that a fit would estimate, at the mean path of a wheel."""
    d = motion.increments
    path = np.hypot(d[:, 0], d[:, 1]) + np.abs(d[:, 2]) * robot.width / 2
    moving = path > 0
    spins = moving & (np.hypot(d[:, 0], d[:, 1]) < np.abs(d[:, 2]) * robot.width / 2)

    def level(of: Bools) -> float:
        """Return the variance of the slip of one wheel per metre of its path."""
        metres = (path[of] + 0.1 * MOTION_STEP).sum() if of.any() else 1.0
        return float(robot.slip**2 * max(of.sum(), 1) * MOTION_STEP / metres)
    table = (run.wheels.table**2).sum(1) * len(run.wheels.rows) / robot.wheels
    side = level(moving) * table[1] if robot.drive in settings.HOLONOMIC else NO_SIDE_SLIP
    found = {'along': level(moving) * table[0], 'turn': level(moving & ~spins) * table[2],
             'spin': level(spins) * table[2], 'drift': robot.drift**2, 'side': side,
             'white': 0.0 if robot.at_rests else 1.0, 'gyro': 1.0}
    return {name: max(value, LEAST * LEVELS[name]) for name, value in found.items()}


def predict_with_imu(motion: RobotMotion, robot: Robot, config: settings.Config) -> MethodResult:
    """Return the prediction of the smoother for two wheels: covariance of its fit at the truth."""
    speed = motion.distance / float(motion.t[-1])
    drifts = robot.drift > 0 and not robot.at_rests
    correlated = robot.drift_length / max(speed, 1e-3) if drifts else 0.0
    config = settings.with_settings(config.in_local_frame(), {'gnss.correlation_time': correlated})
    sigmas = Sigmas(config=config, fix=robot.white, fix_up=robot.white, fix_rate=robot.rate,
                    sway=float(robot.slip * np.sqrt(planned_methods.SWAY_RATE)),
                    slip=float(robot.slip / np.sqrt(robot.wheels)))
    drive = from_rates(motion.t, motion.speed, motion.rate)
    made = ideal(drive, sigmas, planned_methods.spacing_for(drive))
    leg = made.leg
    turned = np.interp(leg.t_imu, drive.t, drive.yaw - drive.yaw[0]) * robot.width / 2
    used = _at_rests(leg.t_fix, motion) if robot.at_rests else slice(None)
    leg = replace(
        leg, t_fix=leg.t_fix[used], fixes_n=leg.fixes_n[used],
        covariance_n=leg.covariance_n[used],
        wheels=tuple(replace(leg.travel, s=leg.travel.s + side * turned, name=name)
                     for side, name in zip((-1, 1), settings.SIDES, strict=True)),
        origin=replace(leg.origin, local=rate_without_north(leg.origin.latitude)))
    # the positions of a mark share one error
    made = replace(made, leg=leg, fixes_in_one=1.0 if robot.at_rests else made.fixes_in_one)
    problem = problem_of(leg, config, made.imu)
    white = 1 / made.fixes_in_one
    slow = 2 / max(correlated, 1.0) * robot.drift**2 * drifts
    levels = planned_methods.planned_levels(problem, sigmas, made.fixes_in_one).but(
        fix=white, fix_up=white, slow=slow, slow_up=slow)
    fit = planned_methods.fit_at(problem, made, levels)
    return _with_slip(make_result(leg, problem, fit, config), motion, robot)


def _with_slip(method: MethodResult, motion: RobotMotion, robot: Robot) -> MethodResult:
    """
    Return a prediction of the smoother with the slip of two wheels in ratio and width.

    Ideal wheels have no noise from which the smoother could estimate slip. Least squares: right
    minus left wheel path is ratio times path plus width times turn.
    """
    d = motion.increments[motion.moving[1:], ::2]
    covariance = np.linalg.pinv(d.T @ d) * 2 * robot.slip**2 * MOTION_STEP
    ratio, width = np.sqrt(np.diag(covariance))
    estimates = dict(method.estimates)
    for name, more in (('scale_factor_left', ratio / 2), ('scale_factor_right', ratio / 2),
                       ('track_width', width)):
        one = estimates[name]
        if one.sigma is not None:
            estimates[name] = replace(one, sigma=float(np.hypot(one.sigma, more)))
    return replace(method, estimates=estimates, details=method.details | {
        'ratio_sigma': float(ratio)})


def _at_rests(t_fix: Floats, motion: RobotMotion) -> Ints:
    """Return the fix nearest to the middle of each rest, one for each mark."""
    middle = motion.rests.mean(axis=1) - motion.t[np.argmax(motion.moving) - 1]
    out: Ints = np.abs(t_fix[:, None] - middle).argmin(axis=0)
    return out


def predict_robot(motion: RobotMotion, robot: Robot, config: settings.Config) -> MethodResult:
    """Return the prediction of the method that calibrates this robot."""
    by_smoother = robot.imu and robot.drive == settings.DIFFERENTIAL
    return (predict_with_imu if by_smoother else predict_planar)(motion, robot, config)


def ratio_sigma(method: MethodResult) -> float | None:
    """Return the sigma of right over left wheel, relative; None: not determined."""
    if 'ratio_sigma' in method.details:
        return float(method.details['ratio_sigma'])
    left, right = (method.estimates.get(f'scale_factor_{side}') for side in settings.SIDES)
    rho = method.details['correlation'].get('scale_factor_left,scale_factor_right')
    a, b = (relative(one) if one else None for one in (left, right))
    if a is None or b is None or rho is None:
        return None
    return float(np.sqrt(a**2 + b**2 - 2 * rho * a * b))
