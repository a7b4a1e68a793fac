# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Predicted sigmas of a planned run of a small robot.

In: a pattern of moves and rests on a level floor, the robot and its position reference. Out: the
result of its estimator (planar, or the smoother for two wheels with an IMU), computed once at the
true states of samples without errors. Scale factors are 1, angles 0: sigmas do not depend on them.
"""

from dataclasses import dataclass, replace

import numpy as np

from odocal_ros.calib.planar.fit import fit_at, LEVELS, MIN_LEVEL, priors
from odocal_ros.calib.planar.result import make_planar_result, refused_planar_result
from odocal_ros.calib.planar.run import make_side_wheels, Run, wheel_rows, Wheels
from odocal_ros.calib.result import MethodResult
from odocal_ros.data.arrays import Bools, Floats, Ints, running_sum
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.result.outcome import make_result
from odocal_ros.forecast import planned_methods
from odocal_ros.forecast.planned_drive import drive_from_rates
from odocal_ros.forecast.predict import Sigmas
from odocal_ros.forecast.robot_motion import MOTION_STEP, RobotMotion
from odocal_ros.nav.geodesy import rate_without_north
from odocal_ros.pipeline.planar_run import known_values
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings import config as settings

# m^2/m, judgement: usual in fits of robots without sideways slip, 0.3 mm in a metre
NO_SIDE_SLIP = 1e-7
MAX_POSITION_RATE = 10.0       # Hz, definition: of positions used by the planar estimator


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Robot and reference of a run."""

    drive: str                      # as odometer.drive
    imu: bool                       # the robot has an IMU
    # m, track width; skid steering: in turns on the spot; HOLONOMIC: twice the rotation lever
    width: float
    straight_width: float = 0.0     # m, track width of skid steering on a straight
    wheels: int = 2
    slip: float = 1e-3              # m/sqrt(s) of each wheel while it moves
    position_sigma: float = 0.02    # m, white error of the positions
    position_rate: float = 10.0     # Hz
    drift_sigma: float = 0.0        # m, stationary sigma of their correlated error
    drift_length: float = 10.0      # m of path, its correlation length
    at_rests: bool = False          # positions in the rests only


def _wheels(increments: Floats, robot: Robot) -> tuple[Wheels, list[float]]:
    """Return the wheels of body increments, (n, 3), and the constants that only this drive has."""
    if robot.drive in settings.HOLONOMIC:
        rows = wheel_rows(robot.drive, robot.wheels)
        count = (increments * [1.0, 1.0, robot.width / 2]) @ rows.T
        return Wheels(count, rows, robot.drive), [1.0] * (robot.drive == settings.MECANUM)
    forward, turn = increments[:, 0], increments[:, 2]
    half_difference = turn * robot.width / 2      # of the wheel paths
    if robot.drive != settings.SKID:
        return make_side_wheels(forward - half_difference, forward + half_difference,
                                robot.drive), []
    arc = 1 / robot.straight_width - 1 / robot.width
    for _ in range(51):      # fixed-point iteration: the width depends on the paths
        wheels = make_side_wheels(forward - half_difference, forward + half_difference,
                                  robot.drive)
        half_difference = turn / (1 / robot.width + arc * wheels.straightness) / 2
    return wheels, [arc]


def _position_nodes(motion: RobotMotion, robot: Robot) -> Ints:
    """Return the indices of the times with a position; at rests, within 0.5 s of their middle."""
    step = max(1, round(1 / (min(robot.position_rate, MAX_POSITION_RATE) * MOTION_STEP)))
    node = np.arange(0, len(motion.t), step)
    if robot.at_rests:
        from_middle = np.abs(motion.t[node][:, None] - motion.rests.mean(axis=1))
        node = node[(from_middle <= 0.5).any(axis=1)]
    return node


def predict_planar(motion: RobotMotion, robot: Robot, config: settings.Config) -> MethodResult:
    """Return the prediction of the planar estimator: covariance of its fit at the truth."""
    increments = motion.increments
    wheels, drive_constants = _wheels(increments, robot)
    # of the wheels; then 0: lever arm and delay of the reference, scale error and bias of the gyro
    constants = np.array([*np.ones(wheels.count.shape[1]), 1 / robot.width, *drive_constants,
                          *[0.0] * (3 + 2 * robot.imu)])
    turn = increments[:, 2]
    heading = running_sum(turn)
    chord = (increments[:, 0] + 1j * increments[:, 1]) * np.sinc(turn / (2 * np.pi))
    position = running_sum(chord * np.exp(1j * (heading[1:] + heading[:-1]) / 2))
    no_drift = np.zeros((len(heading), 2))
    state = np.column_stack([position.real, position.imag, heading, no_drift])
    node = _position_nodes(motion, robot)
    run = Run(motion.t, wheels, node, state[node, :2], np.full(len(node), robot.position_sigma),
              turn if robot.imu else np.empty(0))
    known = replace(known_values(run, config), drift_length=robot.drift_length)
    _, prior = priors(run, known, left=1.0, right=1.0, width=robot.width)
    fit = fit_at(run, known, state, constants, _levels(motion, robot, run.wheels),
                 first_gains=np.array([1.0, 1.0, 1 / robot.width]), prior=prior)
    return make_planar_result(fit, '1', 0.0, config)


def _levels(motion: RobotMotion, robot: Robot, wheels: Wheels) -> dict[str, float]:
    """Return the noise levels that a fit would estimate, as the LEVELS of ``calib.planar.fit``."""
    forward, left, turn = motion.increments.T
    straight, turning = np.hypot(forward, left), np.abs(turn) * robot.width / 2
    path = straight + turning
    moving = path > 0
    on_spot = moving & (straight < turning)

    def level(rows: Bools) -> float:
        """Return the variance of the slip of one wheel per metre of its path."""
        metres = (path[rows] + 0.1 * MOTION_STEP).sum() if rows.any() else 1.0
        return float(robot.slip**2 * max(rows.sum(), 1) * MOTION_STEP / metres)
    # variance of the body motion over that of a wheel path
    along, side, turn_gain = (
        (wheels.wheels_to_body**2).sum(1) * len(wheels.rows) / robot.wheels).tolist()
    levels = {'along': level(moving) * along, 'turn': level(moving & ~on_spot) * turn_gain,
              'spin': level(on_spot) * turn_gain, 'drift': robot.drift_sigma**2,
              'side': level(moving) * side if robot.drive in settings.HOLONOMIC else NO_SIDE_SLIP,
              'white': 0.0 if robot.at_rests else 1.0, 'gyro': 1.0}
    return {name: max(value, MIN_LEVEL * LEVELS[name]) for name, value in levels.items()}


def predict_with_imu(motion: RobotMotion, robot: Robot, config: settings.Config) -> MethodResult:
    """Return the prediction of the smoother for two wheels: covariance of its fit at the truth."""
    speed = motion.distance / float(motion.t[-1])
    drifts = robot.drift_sigma > 0 and not robot.at_rests
    tau = robot.drift_length / max(speed, 1e-3) if drifts else 0.0
    config = settings.with_settings(config.in_local_frame(), {'gnss.correlation_time': tau})
    sigmas = Sigmas(config=config, fix=robot.position_sigma, fix_up=robot.position_sigma,
                    fix_rate=robot.position_rate,
                    sway=float(robot.slip * np.sqrt(planned_methods.SWAY_RATE)),
                    slip=float(robot.slip / np.sqrt(robot.wheels)))
    drive = drive_from_rates(motion.t, motion.speed, motion.yaw_rate)
    ideal = planned_methods.ideal_samples(drive, sigmas, planned_methods.keyframe_spacing(drive))
    leg = ideal.leg
    half_difference = np.interp(leg.t_imu, drive.t, drive.yaw - drive.yaw[0]) * robot.width / 2
    used = np.arange(len(leg.t_fix))
    if robot.at_rests:      # fixes nearest to the middle of each rest; t is 0 at the first move
        t_middle = motion.rests.mean(axis=1) - motion.t[np.argmax(motion.moving) - 1]
        used = np.abs(leg.t_fix[:, None] - t_middle).argmin(axis=0)
    leg = replace(
        leg, t_fix=leg.t_fix[used], fixes_n=leg.fixes_n[used],
        covariance_n=leg.covariance_n[used],
        wheels=tuple(replace(leg.travel, s=leg.travel.s + sign * half_difference, name=side)
                     for sign, side in zip((-1, 1), settings.SIDES, strict=True)),
        origin=replace(leg.origin, local_earth_rate=rate_without_north(leg.origin.latitude)))
    # the positions of a rest share one error
    ideal = replace(ideal, leg=leg, fixes_per_row=1.0 if robot.at_rests else ideal.fixes_per_row)
    problem = make_problem(leg, config, ideal.imu)
    white = 1 / ideal.fixes_per_row
    slow = 2 / max(tau, 1.0) * robot.drift_sigma**2 * drifts      # driving noise of the drift
    levels = planned_methods.planned_noise_levels(problem, sigmas, ideal.fixes_per_row).replaced(
        fix=white, fix_up=white, slow=slow, slow_up=slow)
    fit = planned_methods.fit_at_truth(problem, ideal, levels)
    return _with_slip(make_result(leg, problem, fit, config), motion, robot)


def _with_slip(method: MethodResult, motion: RobotMotion, robot: Robot) -> MethodResult:
    """
    Return a prediction of the smoother with the slip of two wheels in ratio and width.

    Ideal wheels have no noise from which the smoother could estimate slip. Least squares: right
    minus left wheel path is ratio times path plus width times turn.
    """
    path_and_turn = motion.increments[motion.moving[1:], ::2]      # (n, 2) m, rad
    covariance = np.linalg.pinv(path_and_turn.T @ path_and_turn) * 2 * robot.slip**2 * MOTION_STEP
    ratio, width = np.sqrt(np.diag(covariance))
    estimates = dict(method.estimates)
    for name, slip_sigma in (('scale_factor_left', ratio / 2), ('scale_factor_right', ratio / 2),
                             ('track_width', width)):
        if (sigma := estimates[name].sigma) is not None:
            estimates[name] = replace(estimates[name], sigma=float(np.hypot(sigma, slip_sigma)))
    return replace(method, estimates=estimates, details=method.details | {
        'ratio_sigma': float(ratio)})


def predict_robot(motion: RobotMotion, robot: Robot, config: settings.Config) -> MethodResult:
    """Return the prediction of the method that calibrates this robot."""
    by_smoother = robot.imu and robot.drive == settings.DIFFERENTIAL
    try:
        return (predict_with_imu if by_smoother else predict_planar)(motion, robot, config)
    except np.linalg.LinAlgError:
        return refused_planar_result([Reason(
            Code.SCALE_NOT_DETERMINED, 'scale factor: the positions of this run do not determine '
            'it', 'Plan a run with straights, or positions in motion.')], '1')
