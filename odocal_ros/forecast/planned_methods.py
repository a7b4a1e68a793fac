# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Predictions of the methods for a planned drive; of the smoother, its covariance at the truth."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.choice import choose, deciding, relevant_reasons
from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.estimator.chain import NotPositive
from odocal_ros.estimator.equations import Equations
from odocal_ros.estimator.factors.factor import SPREAD
from odocal_ros.estimator.factors.slow_error import WHITE_SHARE
from odocal_ros.estimator.fit import Fit
from odocal_ros.estimator.imu import sensor_noise
from odocal_ros.estimator.level_steps import SLIPPING
from odocal_ros.estimator.levels import Levels
from odocal_ros.estimator.prepare import problem_of, SPACING
from odocal_ros.estimator.problem import Problem
from odocal_ros.estimator.result.estimates import refused_result
from odocal_ros.estimator.result.outcome import make_result
from odocal_ros.estimator.smoother import too_little
from odocal_ros.estimator.state import M
from odocal_ros.forecast.ideal_samples import Ideal, ideal
from odocal_ros.forecast.planned_drive import PlannedDrive
from odocal_ros.forecast.predict import predict, Prediction, Sigmas
from odocal_ros.reasons import Code, Reason, Verdict, verdict_of
from odocal_ros.settings.nominal import grade_of

WIDEST_SPACING = 5.0    # s, judgement: between keyframes of a planned drive
SWAY_RATE = 10.0        # Hz, definition: of the white noise of sigmas.sway


def predict_smoother(drive: PlannedDrive, sigmas: Sigmas,
                     spacing: float | None = None) -> MethodResult:
    """
    Return the prediction of the smoother for a drive, covariance only.

    The equations are those of ``smooth`` at the true states of ideal samples; reasons are from the
    same code as for a fit. Scale is 1, angles are 0; sigmas and budget are the predicted ones.
    spacing : s between keyframes; default: ``spacing_for``.
    """
    few = too_little(int(drive.duration * sigmas.fix_rate), drive.duration)
    if few:
        return refused_result([few], '1')
    made = ideal(drive, sigmas, spacing_for(drive) if spacing is None else spacing)
    problem = problem_of(made.leg, sigmas.config, made.imu)
    levels = planned_levels(problem, sigmas, made.fixes_in_one)
    try:
        fit = fit_at(problem, made, levels)
    except (NotPositive, np.linalg.LinAlgError) as error:
        reason = Reason(Code.NOT_CONVERGED, f'the equations cannot be solved: {error}. '
                        'Likely cause: too little data for the unknowns')
        return refused_result([reason], '1')
    return make_result(made.leg, problem, fit, sigmas.config)


def spacing_for(drive: PlannedDrive) -> float:
    """Return the time between keyframes for the prediction of a drive, s."""
    # keyframes lie farther apart in longer drives: sigmas are 5 to 10 % too large at
    # WIDEST_SPACING, more beyond two hours, longer than a live leg may last; never too small
    enough_intervals, most_intervals = 600, 1440
    usual = np.clip(drive.duration / enough_intervals, SPACING, WIDEST_SPACING)
    return float(max(usual, drive.duration / most_intervals))


def planned_levels(problem: Problem, sigmas: Sigmas, fixes_in_one: float = 1.0) -> Levels:
    """
    Return the noise levels of a planned drive, which a fit would estimate.

    IMU: by its grade. Wheel slip: ``sigmas.slip``. Sideways and vertical motion: ``sigmas.sway``.
    Fixes: the stated sigma, white, or with a correlation time WHITE_SHARE of it white and the rest
    time-correlated. No level is below the lower bound of the smoother.
    """
    grade = grade_of(sigmas.config.imu)
    road = dict.fromkeys(SLIPPING, sigmas.sway**2 / SWAY_RATE)
    road |= dict.fromkeys(('along', 'along_hard'), sigmas.slip**2)
    tau = sigmas.correlation_time
    white, up = WHITE_SHARE**2 if tau else 1.0, sigmas.covariance_n[2, 2]
    values = road | {name: sigma**2 for name, sigma in sensor_noise(grade).items()} | {
        name: 2 / max(tau, 1.0) * (1 - white) * variance
        for name, variance in (('slow', sigmas.fix**2), ('slow_up', up))}
    values |= dict.fromkeys(('fix', 'fix_up'), white / fixes_in_one)
    least = {name: problem.least.get(name, 0.0) for name in values}
    # the bound is for one fix, not for the fixes that it replaces
    least |= {name: least[name] / fixes_in_one for name in ('fix', 'fix_up')}
    return problem.first_levels.but(
        correlation_time=tau, **{k: max(v, least[k]) for k, v in values.items()})


def fit_at(problem: Problem, made: Ideal, levels: Levels) -> Fit:
    """Return the fit at the true state, without any step."""
    state, priors = made.state, problem.priors
    weighted = Equations(problem, state, priors).at(levels)
    return Fit(state, levels, priors, priors, np.ones((len(state.t) - 1, SPREAD)), True, False, 0,
               np.nan, weighted, weighted.solved(), np.zeros((M, 0)))     # none estimated


@dataclass(frozen=True, eq=False)
class Plan:
    """The prediction of a drive."""

    two_point: Prediction               # between the operator's marks, with alignment and drive
    methods: dict[str, MethodResult]    # name -> predicted result
    estimates: dict[str, Estimate]      # each from the method that will provide it, as in a result
    deciding: tuple[str, ...]           # the methods that may give a parameter

    def sigma(self, parameter: str) -> float | None:
        """Return the sigma that will be stated, relative or rad; None: not determined."""
        return self.estimates[parameter].sigma

    def by(self, parameter: str) -> str:
        """Return the method that will give a parameter, empty: none."""
        estimate = self.estimates[parameter]
        return estimate.method if estimate.value is not None else ''

    @property
    def giving(self) -> tuple[str, ...]:
        """Return the methods that will give any parameter of interest."""
        names = (self.by(p) for p in self.two_point.method.parameters)
        return tuple(dict.fromkeys(name for name in names if name))

    @property
    def verdict(self) -> Verdict:
        """Return the predicted verdict: of the drive and the best method."""
        order = list(Verdict)
        best = min((verdict_of(self.reasons_of(name)) for name in self.deciding), key=order.index)
        return Verdict.worst([verdict_of(self.two_point.of_drive), best])

    def reasons_of(self, name: str) -> tuple[Reason, ...]:
        """Return the predicted reasons of a method; for two_point also those of its alignment."""
        if name != 'two_point':
            return self.methods[name].reasons
        return tuple(r for r in self.two_point.reasons if r not in self.two_point.of_drive)

    @property
    def reasons(self) -> tuple[Reason, ...]:
        """
        Return the reasons of the prediction.

        Those of the drive, of the smoother, and of methods that give a parameter; of the other
        methods the refusals only.
        """
        said = list(self.two_point.of_drive)
        for name in self.methods:
            own = relevant_reasons(self.reasons_of(name), name, self.estimates)
            if name == 'smoother':
                own = tuple(r for r in self.reasons_of(name) if r in own
                            or r.code.name.endswith('_NOT_DETERMINED'))
            elif name not in self.giving:
                own = tuple(r for r in own if r.code.severity is Verdict.REJECTED)
            said += [r for r in own if r not in said]
        return tuple(said)


def plan_methods(drive: PlannedDrive, sigmas: Sigmas, spacing: float | None = None) -> Plan:
    """Return the predictions of the configured methods; arguments as ``predict_smoother``."""
    asked = sigmas.config.method
    two_point = predict(drive, sigmas)
    methods = {'two_point': two_point.method}
    if 'smoother' in deciding(asked):
        methods = {'smoother': predict_smoother(drive, sigmas, spacing)} | methods
    may_give = deciding(asked)
    estimates, _ = choose({name: methods[name] for name in may_give}, may_give)
    return Plan(two_point, methods, estimates, may_give)
