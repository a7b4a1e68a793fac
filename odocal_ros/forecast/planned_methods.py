# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Predicted results of the methods for a planned drive: sigmas, reasons, verdict.

The prediction of the smoother is its covariance at the true states, with ideal samples of the
drive: IMU, odometer and fixes without errors.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.choice import choose, deciding_methods, relevant_reasons
from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.data.arrays import Floats, Ints
from odocal_ros.estimator.chain import NotPositive
from odocal_ros.estimator.equations import Equations, WeightedEquations
from odocal_ros.estimator.factors.factor import VARIANCE_FACTOR_COUNT
from odocal_ros.estimator.factors.heading import CONFIGURED_NOISE, Heading
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.imu import ImuSteps, keyframe_samples, sensor_noise
from odocal_ros.estimator.leg import BEFORE_MARK, EXTERNAL_RATE, ExternalSamples, SmootherLeg
from odocal_ros.estimator.level_steps import SLIP_LEVELS
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.prepare import make_problem, SPACING
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.result.estimates import refused_result
from odocal_ros.estimator.result.outcome import make_result
from odocal_ros.estimator.smoother import too_few_samples_reason
from odocal_ros.estimator.state import M, State
from odocal_ros.forecast.planned_drive import PlannedDrive
from odocal_ros.forecast.predict import EXTERNAL_SOURCES, predict, Prediction, Sigmas
from odocal_ros.nav.alignment import HEADING_LIMIT
from odocal_ros.nav.dead_reckoning import gravity_n, Origin
from odocal_ros.nav.geodesy import earth_rate_n
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import matrix_from_rpy, transpose
from odocal_ros.nav.time_series import interpolated, running_integral
from odocal_ros.reasons import Code, Reason, rejecting, Verdict, verdict_of
from odocal_ros.settings.config import Config
from odocal_ros.settings.nominal import grade_of

WIDEST_SPACING = 5.0    # s, judgement: between keyframes of a planned drive
WHITE_SIGMA_SHARE = 0.2    # judgement: white part of time-correlated fix errors, over their sigma
SWAY_RATE = 10.0        # Hz, definition: of the white noise of sigmas.sway


@dataclass(frozen=True, eq=False)
class IdealSamples:
    """A planned drive as input of the smoother, free of errors."""

    leg: SmootherLeg        # at most one fix and one heading for each keyframe
    imu: ImuSteps           # with keyframes
    state: State            # true state at the keyframes
    fixes_per_row: float    # number of planned fixes that each fix of the leg stands for


class _Motion(NamedTuple):
    """Motion of the IMU, and travel of the odometer."""

    t: Floats         # (m,) s
    C_nb: Floats      # (m, 3, 3) attitude
    p_n: Floats       # (m, 3) m, position
    v_n: Floats       # (m, 3) m/s
    f_b: Floats       # (m, 3) m/s^2, specific force
    w_b: Floats       # (m, 3) rad/s, with the Earth's rate
    travel: Floats    # (m,) m


def ideal_samples(drive: PlannedDrive, sigmas: Sigmas, spacing: float) -> IdealSamples:
    """
    Return the samples of a drive without any error.

    Mounting angles are zero, the scale is 1: sigmas do not depend on them.

    sigmas : with lever arms, fix rate and sigma, size of a count, external heading.   spacing : s
    between keyframes.
    """
    config = sigmas.config
    spans = np.array(drive.standstills(config.leg.standstill)).reshape(-1, 2)
    # the samples begin with the standstill at the start mark, within the pre-roll
    start_rests = [begin for begin, end in spans.tolist() if begin <= 0.5 and end >= -BEFORE_MARK]
    t_begin = max(min(0.0, start_rests[-1]), -config.leg.preroll) if start_rests else 0.0
    origin = Origin(drive.latitude, drive.longitude, drive.height)
    highest_rate = 20.0    # Hz: the noise of a second does not depend on the sample rate
    samples_per_interval = 50    # enough between keyframes that lie far apart
    rate = min(highest_rate, samples_per_interval / spacing)
    t = np.linspace(t_begin, drive.duration, max(2, round((drive.duration - t_begin) * rate) + 1))
    motion = _imu_motion(drive, t, origin, config)
    t_fix = _sample_times(t_begin, drive.duration, sigmas.fix_rate, spacing)
    antenna = motion.p_n + motion.C_nb @ np.subtract(config.gnss.lever_arm, config.imu.lever_arm)
    leg = SmootherLeg(
        origin=origin, t_begin=t_begin, t_stop=drive.duration, t_imu=t, w_b=motion.w_b,
        f_b=motion.f_b, travel=Travel(t, motion.travel, sigmas.quantum), t_fix=t_fix,
        fixes_n=interpolated(t_fix, t, antenna),
        covariance_n=np.tile(sigmas.covariance_n, (len(t_fix), 1, 1)), standstills=spans,
        rough_scale=1.0, nominal_scale=1.0, scale_unit='1',
        imu_arm=np.array(config.imu.lever_arm, float),
        odometer_arm=np.array(config.odometer.lever_arm, float),
        antenna_arm=np.array(config.gnss.lever_arm, float),
        external=_heading(drive, config, t_begin, spacing))
    keyframes = keyframe_samples(leg, spacing)
    return IdealSamples(leg, ImuSteps.between(leg, keyframes), _true_state(motion, keyframes),
                        max(1.0, (drive.duration - t_begin) * sigmas.fix_rate / len(t_fix)))


def _imu_motion(drive: PlannedDrive, t: Floats, origin: Origin, config: Config) -> _Motion:
    """Return the motion of the IMU in the frame n."""
    speed, yaw, slope = (np.interp(t, drive.t, x) for x in (drive.speed, drive.yaw, drive.slope))
    C_nb = matrix_from_rpy(np.stack([np.zeros_like(yaw), -slope, yaw], -1))
    yaw_rate, slope_rate = np.gradient(yaw, t), np.gradient(slope, t)
    w_nb = np.stack([yaw_rate * np.sin(slope), -slope_rate, yaw_rate * np.cos(slope)], -1)
    arm = np.subtract(config.imu.lever_arm, config.odometer.lever_arm)
    wheel_n = C_nb[:, :, 0] * speed[:, None]
    p_n = running_integral(t, wheel_n) + (C_nb - C_nb[0]) @ arm
    v_n = wheel_n + (C_nb @ np.cross(w_nb, arm)[:, :, None])[:, :, 0]
    earth_n = earth_rate_n(origin.latitude)
    f_n = np.gradient(v_n, t, axis=0) + 2 * np.cross(earth_n, v_n) - gravity_n(p_n, origin)
    C_bn = transpose(C_nb)
    return _Motion(t, C_nb, p_n, v_n, np.einsum('kij,kj->ki', C_bn, f_n), w_nb + C_bn @ earth_n,
                   running_integral(t, speed))


def _sample_times(begin: float, end: float, rate: float, spacing: float) -> Floats:
    """Return times at a rate, at most one for each keyframe, in the middle of their intervals."""
    count = max(1, round((end - begin) * min(rate, 1 / spacing)))
    return begin + (np.arange(count) + 0.5) * (end - begin) / count


def _heading(drive: PlannedDrive, config: Config, t_begin: float, spacing: float
             ) -> dict[str, ExternalSamples]:
    """Return the external heading of the settings; none for a course or a gyrocompass."""
    source, sigma = config.alignment.source, config.alignment.heading_sigma
    if source == 'fixed':
        t, noise = np.zeros(1), CONFIGURED_NOISE
    elif source in EXTERNAL_SOURCES and sigma <= HEADING_LIMIT:
        t = _sample_times(t_begin, drive.duration, EXTERNAL_RATE, spacing)
        noise = sigma * np.sqrt(len(t) / max(1.0, (drive.duration - t_begin) * EXTERNAL_RATE))
    else:
        return {}
    yaw = np.interp(t, drive.t, drive.yaw)
    return {'heading': Heading(t, np.full(len(t), noise), yaw, sigma, source)}


def _true_state(motion: _Motion, rows: Ints) -> State:
    """Return the state at the keyframes, rows of the motion, with all errors and biases zero."""
    N = len(rows)
    return State(motion.t[rows], motion.p_n[rows], motion.v_n[rows], motion.C_nb[rows],
                 np.zeros((N, 3)), np.zeros((N, 3)), np.zeros(N), np.zeros((N, 3)),
                 np.zeros(M)).with_mean_up()


def predict_smoother(drive: PlannedDrive, sigmas: Sigmas,
                     spacing: float | None = None) -> MethodResult:
    """
    Return the prediction of the smoother: its result at the true states of ideal samples.

    The scale is 1, angles are 0; sigmas, budget and reasons are computed as after a fit.
    spacing : s between keyframes; default: ``keyframe_spacing``.
    """
    too_few = too_few_samples_reason(int(drive.duration * sigmas.fix_rate), drive.duration)
    if too_few:
        return refused_result([too_few], '1')
    ideal = ideal_samples(drive, sigmas, keyframe_spacing(drive) if spacing is None else spacing)
    problem = make_problem(ideal.leg, sigmas.config, ideal.imu)
    levels = planned_noise_levels(problem, sigmas, ideal.fixes_per_row)
    try:
        fit = fit_at_truth(problem, ideal, levels)
    except (NotPositive, np.linalg.LinAlgError) as error:
        reason = Reason(Code.NOT_CONVERGED, f'no uncertainty can be predicted: {error}. Likely '
                        'cause: the planned drive has too few fixes or too little motion')
        return refused_result([reason], '1')
    return make_result(ideal.leg, problem, fit, sigmas.config)


def keyframe_spacing(drive: PlannedDrive) -> float:
    """
    Return the time between keyframes for the prediction of a drive, s.

    It grows with the duration. Sigmas are 5 to 10 % too large at WIDEST_SPACING, more beyond two
    hours, longer than a live leg may last; never too small.
    """
    enough_intervals, max_intervals = 600, 1440
    usual = np.clip(drive.duration / enough_intervals, SPACING, WIDEST_SPACING)
    return float(max(usual, drive.duration / max_intervals))


def planned_noise_levels(problem: Problem, sigmas: Sigmas, fixes_per_row: float = 1.0) -> Levels:
    """
    Return the noise levels of a planned drive, which a fit would estimate.

    IMU: by its grade. Wheel slip: ``sigmas.slip``. Sideways and vertical motion: ``sigmas.sway``.
    Fixes: the stated sigma, white, or with a correlation time WHITE_SIGMA_SHARE of it white and
    the rest time-correlated. No level is below the lower bound of the smoother.
    """
    grade = grade_of(sigmas.config.imu)
    road = dict.fromkeys(SLIP_LEVELS, sigmas.sway**2 / SWAY_RATE)
    road |= dict.fromkeys(('along', 'along_hard'), sigmas.slip**2)
    tau = sigmas.correlation_time
    white, up = WHITE_SIGMA_SHARE**2 if tau else 1.0, sigmas.covariance_n[2, 2]
    values = road | {name: sigma**2 for name, sigma in sensor_noise(grade).items()} | {
        name: 2 / max(tau, 1.0) * (1 - white) * variance
        for name, variance in (('slow', sigmas.fix**2), ('slow_up', up))}
    values |= dict.fromkeys(('fix', 'fix_up'), white / fixes_per_row)
    minimum = {name: problem.min_levels.get(name, 0.0) for name in values}
    # the bound is for one fix, not for those that a row stands for
    minimum |= {name: minimum[name] / fixes_per_row for name in ('fix', 'fix_up')}
    return problem.initial_levels.replaced(correlation_time=tau, **{
        name: max(value, minimum[name]) for name, value in values.items()})


def fit_at_truth(problem: Problem, ideal: IdealSamples, levels: Levels) -> Fit:
    """Return the fit at the true state, without any iteration; no level is estimated."""
    state, priors = ideal.state, problem.priors
    weighted = WeightedEquations(Equations(problem, state, priors), levels)
    return Fit(state, levels, priors, priors, np.ones((len(state.t) - 1, VARIANCE_FACTOR_COUNT)),
               converged=True, weighted=weighted, solution=weighted.solve(),
               by_levels=np.zeros((M, 0)))


@dataclass(frozen=True, eq=False)
class Plan:
    """The prediction of a drive with all configured methods."""

    two_point: Prediction               # with alignment, path length and reasons of the drive
    methods: dict[str, MethodResult]    # predicted result by name of the method
    estimates: dict[str, Estimate]      # each from the method that will give it, as in a result
    deciding: tuple[str, ...]           # names of the methods that may give a parameter

    def sigma(self, parameter: str) -> float | None:
        """Return the sigma that will be stated, relative or rad; None: not determined."""
        return self.estimates[parameter].sigma

    def method_of(self, parameter: str) -> str:
        """Return the name of the method that will give a parameter, empty: none."""
        estimate = self.estimates[parameter]
        return estimate.method if estimate.value is not None else ''

    @property
    def methods_used(self) -> tuple[str, ...]:
        """Return the names of the methods that will give scale, yaw or pitch."""
        names = (self.method_of(parameter) for parameter in self.two_point.method.parameters)
        return tuple(dict.fromkeys(name for name in names if name))

    @property
    def verdict(self) -> Verdict:
        """Return the predicted verdict: the worse one of the drive and of the best method."""
        order = list(Verdict)
        best = min((verdict_of(self.reasons_of(name)) for name in self.deciding), key=order.index)
        return Verdict.worst([verdict_of(self.two_point.drive_reasons), best])

    def reasons_of(self, name: str) -> tuple[Reason, ...]:
        """Return the predicted reasons of a method; for two_point also those of its alignment."""
        if name != 'two_point':
            return self.methods[name].reasons
        return tuple(reason for reason in self.two_point.reasons
                     if reason not in self.two_point.drive_reasons)

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """
        Return the reasons of the prediction.

        All reasons of the drive, the smoother, and methods that give a parameter; only refusals of
        the other methods.
        """
        reasons = list(self.two_point.drive_reasons)
        for name in self.methods:
            relevant = relevant_reasons(self.reasons_of(name), name, self.estimates)
            if name == 'smoother':
                relevant = tuple(reason for reason in self.reasons_of(name) if reason in relevant
                                 or reason.code.name.endswith('_NOT_DETERMINED'))
            elif name not in self.methods_used:
                relevant = tuple(rejecting(relevant))
            reasons += [reason for reason in relevant if reason not in reasons]
        return tuple(reasons)


def plan_methods(drive: PlannedDrive, sigmas: Sigmas, spacing: float | None = None) -> Plan:
    """Return the predictions of the configured methods; arguments as ``predict_smoother``."""
    deciding = deciding_methods(sigmas.config.method)
    two_point = predict(drive, sigmas)
    methods = {'two_point': two_point.method}
    if 'smoother' in deciding:
        methods = {'smoother': predict_smoother(drive, sigmas, spacing)} | methods
    estimates, _ = choose({name: methods[name] for name in deciding}, deciding)
    return Plan(two_point, methods, estimates, deciding)
