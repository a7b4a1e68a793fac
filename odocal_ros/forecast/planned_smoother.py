# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What the smoother will make of a planned drive: its own covariance, at what is true."""

import numpy as np

from odocal_ros.calib.result import MethodResult
from odocal_ros.calib.smoother.chain import NotPositive, solve
from odocal_ros.calib.smoother.equations import Equations
from odocal_ros.calib.smoother.estimate import Fit
from odocal_ros.calib.smoother.imu_noise import sensor_noise
from odocal_ros.calib.smoother.level_steps import SLIPPING
from odocal_ros.calib.smoother.noise import Levels
from odocal_ros.calib.smoother.outcome import outcome
from odocal_ros.calib.smoother.problem import Problem, SPACING
from odocal_ros.calib.smoother.refusal import refused
from odocal_ros.calib.smoother.slow_error import WHITE_SHARE
from odocal_ros.calib.smoother.smoother import too_little
from odocal_ros.calib.smoother.state import M
from odocal_ros.forecast.ideal_samples import Ideal, ideal
from odocal_ros.forecast.planned_drive import PlannedDrive
from odocal_ros.forecast.predict import Sigmas
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.grades import grade_of

WIDEST_SPACING = 5.0    # s, judgement: between keyframes of a planned drive
SWAY_RATE = 10.0        # Hz, definition: of the white noise that sigmas.sway is said for


def predict_smoother(drive: PlannedDrive, sigmas: Sigmas,
                     spacing: float | None = None) -> MethodResult:
    """
    Return the prediction of the smoother for a drive, covariance only.

    The rows are those of ``smooth`` at the true states of ideal samples, the levels those of
    ``planned_levels``, and what is said of the outcome is said by the code that says it of a fit.

    drive, sigmas : as for ``predict``.   spacing : s between keyframes; as ``spacing_for`` has it.

    Returns
    -------
    MethodResult named ``smoother``; scale 1, angles 0, sigmas and budget as they will be.

    """
    few = too_little(int(drive.duration * sigmas.fix_rate), drive.duration)
    if few:
        return refused([few], '1')
    made = ideal(drive, sigmas, spacing_for(drive) if spacing is None else spacing)
    problem = Problem.of(made.leg, sigmas.config, made.imu)
    levels = planned_levels(problem, sigmas, made.fixes_in_one)
    try:
        fit = _fit(problem, made, levels)
    except (NotPositive, np.linalg.LinAlgError) as error:
        return refused([Reason(Code.NOT_CONVERGED, f'the equations cannot be solved: {error}')],
                       '1')
    return outcome(made.leg, problem, fit, sigmas.config)


def spacing_for(drive: PlannedDrive) -> float:
    """Return the seconds between keyframes that a drive is predicted with."""
    # keyframes lie farther apart in longer drives: sigmas come out 5 to 10 % too large at
    # WIDEST_SPACING, more beyond two hours, longer than a live leg may last; never too small
    enough_intervals, most_intervals = 600, 1440
    usual = np.clip(drive.duration / enough_intervals, SPACING, WIDEST_SPACING)
    return float(max(usual, drive.duration / most_intervals))


def planned_levels(problem: Problem, sigmas: Sigmas, fixes_in_one: float = 1.0) -> Levels:
    """
    Return the noise that a drive is planned with, where a fit would estimate it.

    IMU by its grade; wheels that slip by ``sigmas.slip``, slide and bounce by ``sigmas.sway``;
    fixes of the stated sigma, white, or white to WHITE_SHARE of it besides a time-correlated part
    for the correlation time. Never less than the smoother's own bounds.
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
    # that of a fix is for each, not for those that one stands for
    least |= {name: least[name] / fixes_in_one for name in ('fix', 'fix_up')}
    return problem.first_levels.but(
        correlation_time=tau, **{k: max(v, least[k]) for k, v in values.items()})


def _fit(problem: Problem, made: Ideal, levels: Levels) -> Fit:
    """Return the fit that stands where it is: no step is taken."""
    state, priors = made.state, problem.priors
    weighted = Equations(problem, state, priors).at(levels)
    return Fit(state, levels, priors, priors, np.ones((len(state.t) - 1, 3)), True, False, 0,
               np.nan, weighted, solve(weighted.normal()), np.zeros((M, 0)))     # none estimated
