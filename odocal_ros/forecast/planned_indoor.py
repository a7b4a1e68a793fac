# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Predicted sigmas of a planned run of a small robot.

The motion is a pattern with rests on a level floor. Its estimator is evaluated once, at the true
states of samples without errors: the planar estimator, or the smoother for two wheels with an IMU.
Scale factors are 1, angles 0: sigmas do not depend on them.
"""

from dataclasses import dataclass, replace
import math

import numpy as np

from odocal_ros.calib.planar.fit import fit_at, LEVELS, MIN_LEVEL, priors
from odocal_ros.calib.planar.result import make_planar_result, refused_planar_result
from odocal_ros.calib.planar.run import make_side_wheels, Run, wheel_rows, Wheels
from odocal_ros.calib.result import MethodResult
from odocal_ros.data.arrays import Bools, Floats, Ints, running_sum
from odocal_ros.errors import BadUsage
from odocal_ros.estimator.prepare import make_problem
from odocal_ros.estimator.result.outcome import make_result
from odocal_ros.forecast import planned_methods
from odocal_ros.forecast.planned_drive import drive_from_rates
from odocal_ros.forecast.predict import Sigmas
from odocal_ros.nav.geodesy import rate_without_north
from odocal_ros.nav.time_series import running_integral
from odocal_ros.pipeline.planar_run import known_values
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings import config as settings

MOTION_STEP = 0.1              # s, definition: time step of a motion
FULL_TURN = 2 * math.pi        # definition, rad
# judgement: of a small robot: m/s^2, rad/s, rad/s^2; s at rest after a move, and at the start and
# the end
ACCELERATION, TURN_RATE, TURN_ACCELERATION = 0.5, 0.8, 2.0
REST, END_REST = 3.0, 5.0
PATTERNS = 'straight', 'square', 'figure_eight', 'spot'
Move = tuple[float, float, float]      # simultaneously m forward, m to the left, rad to the left
# m^2/m, judgement: usual in fits of robots without sideways slip, 0.3 mm in a metre
NO_SIDE_SLIP = 1e-7
FASTEST_NODES = 10.0       # Hz, definition: highest rate of positions used by the planar estimator


@dataclass(frozen=True, eq=False)
class RobotMotion:
    """Motion of the centre of the wheels."""

    t: Floats           # (n + 1,) s
    speed: Floats       # (n + 1,) m/s forward
    side: Floats        # (n + 1,) m/s to the left
    rate: Floats        # (n + 1,) rad/s
    rests: Floats       # (r, 2) s, begin and end of the rests after moves

    @property
    def increments(self) -> Floats:
        """Return m forward, m to the left and rad in each interval: (n, 3)."""
        return np.diff([running_integral(self.t, x) for x in (
            self.speed, self.side, self.rate)], axis=1).T

    @property
    def moving(self) -> Bools:
        """Return True where the robot moves: (n + 1,)."""
        return np.asarray((self.speed != 0) | (self.side != 0) | (self.rate != 0))

    @property
    def distance(self) -> float:
        """Return the path length, m."""
        return float(np.hypot(*self.increments[:, :2].T).sum())


def pattern_motion(name: str, size: float, rounds: int, drive: str,
                   speed: float = 0.5) -> RobotMotion:
    """
    Return the motion of a pattern.

    name : of PATTERNS.   size : m, length of a straight.   rounds : how often it is driven.
    drive : as odometer.drive; a robot of HOLONOMIC also moves sideways by half of each straight.
    speed : m/s.

    Raises BadUsage: a value is out of range.
    """
    for flag, value in (('--size', size), ('--speed', speed), ('--rounds', rounds)):
        if not (math.isfinite(value) and value > 0):
            raise BadUsage(f'{flag} {value:g}: required: a number above 0')
    side = 1.0
    moves = []
    for move in _pattern_moves(name, size) * rounds:
        moves.append(move)
        if drive in settings.HOLONOMIC and not move[2]:
            moves.append((0.0, side * size / 2, 0.0))
            side = -side
    longest_move = 36_000.0 / len(moves)      # s, judgement: ten hours, as in other planned drives
    if size / speed > longest_move:
        raise BadUsage(f'--size {size:g} at --speed {speed:g}: more than ten hours')
    return _drive_moves(moves, speed)


def _drive_moves(moves: list[Move], speed: float) -> RobotMotion:
    """Return the motion of moves one after another, with rests; speed: largest, m/s."""
    first, rest = round(END_REST / MOTION_STEP), np.zeros((round(REST / MOTION_STEP), 3))
    velocity, rests = [np.zeros((first, 3))], [(first - len(rest), first)]
    for forward, left, turn in moves:
        length = math.hypot(forward, left)
        profile = _speed_profile(length, speed, ACCELERATION) if length else _speed_profile(
            abs(turn), TURN_RATE, TURN_ACCELERATION)
        begin = sum(map(len, velocity)) + len(profile)
        velocity += [profile[:, None] * [forward, left, turn], rest]
        rests.append((begin, begin + len(rest)))
    velocity.append(np.zeros((round((END_REST - REST) / MOTION_STEP) + 1, 3)))
    rows = np.concatenate(velocity)
    t: Floats = MOTION_STEP * np.arange(len(rows), dtype=float)
    return RobotMotion(t, rows[:, 0], rows[:, 1], rows[:, 2], MOTION_STEP * np.array(rests))


def _speed_profile(length: float, top: float, acceleration: float) -> Floats:
    """Return the trapezoidal speed of a move as share of its length, 1/s: (n,)."""
    top = min(top, math.sqrt(length * acceleration))
    ramp, duration = top / acceleration, length / top + top / acceleration
    t = MOTION_STEP * np.arange(1, max(2, math.ceil(duration / MOTION_STEP)) + 1)
    share_of_top = np.clip(np.minimum(t / ramp, (t[-1] + MOTION_STEP - t) / ramp), 0, 1)
    return np.asarray(share_of_top / (share_of_top.sum() * MOTION_STEP))


def _pattern_moves(name: str, size: float) -> list[Move]:
    """Return the moves of one round of a pattern, of straights of ``size`` m."""
    if name == 'square':
        return [move for side in (1, -1) for _ in range(4)
                for move in ((size, 0, 0), (0, 0, side * math.pi / 2))]
    if name == 'figure_eight':
        radius = size / 4
        return [(FULL_TURN * radius, 0, side * FULL_TURN) for side in (1, -1)]
    turn = math.pi if name == 'straight' else FULL_TURN + math.pi
    return [(size, 0, 0), (0, 0, turn), (size, 0, 0), (0, 0, -turn)]


@dataclass(frozen=True, kw_only=True)
class Robot:
    """Robot and reference of a run."""

    drive: str                      # as odometer.drive
    imu: bool                       # it has an IMU
    # m, track width; skid steering: in turns on the spot; HOLONOMIC: twice the rotation lever
    width: float
    straight_width: float = 0.0     # m, track width of skid steering on a straight
    wheels: int = 2
    slip: float = 1e-3              # m/sqrt(s) of each wheel while it moves
    white: float = 0.02             # m, white error of the positions
    rate: float = 10.0              # Hz, of the positions
    drift: float = 0.0              # m, stationary sigma of their correlated error
    drift_length: float = 10.0      # m of path, its correlation length
    at_rests: bool = False          # positions in the rests only


def ideal_planar_run(motion: RobotMotion, robot: Robot) -> tuple[Run, Floats, Floats]:
    """
    Return the run of a motion without errors, true states (n + 1, 5) and constants (w,).

    States are position, m, heading, rad, and position drift, m. Constants are those of the
    wheels, then 0: lever arm and delay of the reference, scale error and bias of the gyro.
    """
    increments = motion.increments
    wheels, drive_constants = _wheels(increments, robot)
    constants = [*np.ones(wheels.count.shape[1]), 1 / robot.width, *drive_constants,
                 *[0.0] * (3 + 2 * robot.imu)]
    turn = increments[:, 2]
    heading = running_sum(turn)
    chord = (increments[:, 0] + 1j * increments[:, 1]) * np.sinc(turn / (2 * np.pi))
    position = running_sum(chord * np.exp(1j * (heading[1:] + heading[:-1]) / 2))
    no_drift = np.zeros((len(heading), 2))
    state = np.column_stack([position.real, position.imag, heading, no_drift])
    node = _position_nodes(motion, robot)
    gyro = turn if robot.imu else np.empty(0)
    run = Run(motion.t, wheels, node, state[node, :2], np.full(len(node), robot.white), gyro)
    return run, state, np.array(constants)


def _wheels(increments: Floats, robot: Robot) -> tuple[Wheels, list[float]]:
    """Return the wheels of body increments, (n, 3), and the constants after the inverse width."""
    if robot.drive in settings.HOLONOMIC:
        rows = wheel_rows(robot.drive, robot.wheels)
        count = (increments * [1.0, 1.0, robot.width / 2]) @ rows.T
        return Wheels(count, rows, robot.drive), [1.0] * (robot.drive == settings.MECANUM)
    forward, turn = increments[:, 0], increments[:, 2]
    half_difference = turn * robot.width / 2      # of the wheel paths
    arc = 1 / (robot.straight_width or robot.width) - 1 / robot.width

    def side_wheels() -> Wheels:
        return make_side_wheels(forward - half_difference, forward + half_difference, robot.drive)
    for _ in range(50 * (robot.drive == settings.SKID)):      # the width depends on the paths
        half_difference = turn / (1 / robot.width + arc * side_wheels().straightness) / 2
    return side_wheels(), [arc] * (robot.drive == settings.SKID)


def _position_nodes(motion: RobotMotion, robot: Robot) -> Ints:
    """Return the indices of the times with a position; at rests, within 0.5 s of their middle."""
    every = max(1, round(1 / (min(robot.rate, FASTEST_NODES) * MOTION_STEP)))
    node = np.arange(0, len(motion.t), every)
    if robot.at_rests:
        from_middle = np.abs(motion.t[node][:, None] - motion.rests.mean(axis=1))
        node = node[(from_middle <= 0.5).any(axis=1)]
    return node


def predict_planar(motion: RobotMotion, robot: Robot, config: settings.Config) -> MethodResult:
    """Return the prediction of the planar estimator: covariance of its fit at the truth."""
    run, state, constants = ideal_planar_run(motion, robot)
    known = replace(known_values(run, config), drift_length=robot.drift_length)
    _, prior = priors(run, known, 1.0, 1.0, robot.width)
    first = np.array([1.0, 1.0, 1 / robot.width])
    fit = fit_at(run, known, state, constants, _levels(motion, robot, run), first, prior)
    return make_planar_result(fit, '1', 0.0, config)


def _levels(motion: RobotMotion, robot: Robot, run: Run) -> dict[str, float]:
    """Return the noise levels that a fit would estimate, at the mean path of a wheel."""
    forward, left, turn = motion.increments.T
    straight, turning = np.hypot(forward, left), np.abs(turn) * robot.width / 2
    path = straight + turning
    moving = path > 0
    spins = moving & (straight < turning)

    def level(rows: Bools) -> float:
        """Return the variance of the slip of one wheel per metre of its path."""
        metres = (path[rows] + 0.1 * MOTION_STEP).sum() if rows.any() else 1.0
        return float(robot.slip**2 * max(rows.sum(), 1) * MOTION_STEP / metres)
    table = (run.wheels.wheels_to_body**2).sum(1) * len(run.wheels.rows) / robot.wheels
    side = level(moving) * table[1] if robot.drive in settings.HOLONOMIC else NO_SIDE_SLIP
    levels = {'along': level(moving) * table[0], 'turn': level(moving & ~spins) * table[2],
              'spin': level(spins) * table[2], 'drift': robot.drift**2, 'side': side,
              'white': 0.0 if robot.at_rests else 1.0, 'gyro': 1.0}
    return {name: max(value, MIN_LEVEL * LEVELS[name]) for name, value in levels.items()}


def predict_with_imu(motion: RobotMotion, robot: Robot, config: settings.Config) -> MethodResult:
    """Return the prediction of the smoother for two wheels: covariance of its fit at the truth."""
    speed = motion.distance / float(motion.t[-1])
    drifts = robot.drift > 0 and not robot.at_rests
    tau = robot.drift_length / max(speed, 1e-3) if drifts else 0.0
    config = settings.with_settings(config.in_local_frame(), {'gnss.correlation_time': tau})
    sigmas = Sigmas(config=config, fix=robot.white, fix_up=robot.white, fix_rate=robot.rate,
                    sway=float(robot.slip * np.sqrt(planned_methods.SWAY_RATE)),
                    slip=float(robot.slip / np.sqrt(robot.wheels)))
    drive = drive_from_rates(motion.t, motion.speed, motion.rate)
    ideal = planned_methods.ideal_samples(drive, sigmas, planned_methods.keyframe_spacing(drive))
    leg = ideal.leg
    half_difference = np.interp(leg.t_imu, drive.t, drive.yaw - drive.yaw[0]) * robot.width / 2
    used = _fixes_at_rests(leg.t_fix, motion) if robot.at_rests else slice(None)
    leg = replace(
        leg, t_fix=leg.t_fix[used], fixes_n=leg.fixes_n[used],
        covariance_n=leg.covariance_n[used],
        wheels=tuple(replace(leg.travel, s=leg.travel.s + sign * half_difference, name=side)
                     for sign, side in zip((-1, 1), settings.SIDES, strict=True)),
        origin=replace(leg.origin, local_earth_rate=rate_without_north(leg.origin.latitude)))
    # the positions of a rest share one error
    ideal = replace(ideal, leg=leg, fixes_in_one=1.0 if robot.at_rests else ideal.fixes_in_one)
    problem = make_problem(leg, config, ideal.imu)
    white = 1 / ideal.fixes_in_one
    slow = 2 / max(tau, 1.0) * robot.drift**2 * drifts      # driving noise of the drift
    levels = planned_methods.planned_noise_levels(problem, sigmas, ideal.fixes_in_one).replaced(
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
        estimate = estimates[name]
        if estimate.sigma is not None:
            estimates[name] = replace(estimate, sigma=float(np.hypot(estimate.sigma, slip_sigma)))
    return replace(method, estimates=estimates, details=method.details | {
        'ratio_sigma': float(ratio)})


def _fixes_at_rests(t_fix: Floats, motion: RobotMotion) -> Ints:
    """Return the indices of the fixes nearest to the middle of each rest; t_fix from the start."""
    middle = motion.rests.mean(axis=1) - motion.t[np.argmax(motion.moving) - 1]
    return np.asarray(np.abs(t_fix[:, None] - middle).argmin(axis=0))


def predict_robot(motion: RobotMotion, robot: Robot, config: settings.Config) -> MethodResult:
    """Return the prediction of the method that calibrates this robot."""
    by_smoother = robot.imu and robot.drive == settings.DIFFERENTIAL
    try:
        return (predict_with_imu if by_smoother else predict_planar)(motion, robot, config)
    except np.linalg.LinAlgError:
        return refused_planar_result([Reason(
            Code.SCALE_NOT_DETERMINED, 'scale factor: the positions of this run do not determine '
            'it', 'Plan a run with straights, or positions in motion.')], '1')
