"""
The accelerometer's scale error: none, or as large as its grade allows; the drive says which.

Most drives tell it well enough to see that there is none; where they do not, the sigma of the
scale must hold it. Two beliefs are weighed by what the drive makes of them (their evidence), and
the constants' priors become those whose posterior has the mean square of both.

Where fixes err slowly, metres come from the accelerometer, and its scale error is the odometer's.
There no drive tells an error of a third of the grade from none: that of the grade is believed.
"""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.smoother.estimate import Fit, fit
from odocal_ros.calib.smoother.problem import NO_SCALE
from odocal_ros.calib.smoother.state import ACCEL_SCALE
from odocal_ros.grades import grade_of

# that an accelerometer has the scale error of its grade: makers of the better ones take it out
BELIEF = {'consumer': 0.5, 'industrial': 0.5, 'tactical': 0.2, 'navigation': 0.2}
NO_MATTER = 0.01     # relative change of the scale's sigma that is no matter
TAKEN = 0.5          # weight from which a scale error is there
FEW = 6              # passes to bring it in


def believed(covariance, found, sigma, belief, prior=NO_SCALE):
    """
    Return how large the scale errors are to be taken for.

    Parameters
    ----------
    covariance : (2, 2) array
        Of both scale errors, made with a belief of ``prior``.
    found : (2,) array, optional
        The errors with that belief; None: as they scatter where there are none.
    sigma, belief : float
        That of the grade, relative, and how likely it is.
    prior : (2,) array or float
        Sigmas.

    Returns
    -------
    (2,) array of sigmas, NO_SCALE to ``sigma``, and the weight of the grade's belief.

    """
    both = np.linalg.inv(covariance)
    data = both - np.eye(2) / prior**2
    data = (data + data.T) / 2 + np.eye(2) * 1e-3 / sigma**2
    wide = np.linalg.inv(data + np.eye(2) / sigma**2)
    pull = data if found is None else np.outer(both @ found, both @ found)
    log = 0.5 * (np.trace(wide @ pull) - np.linalg.slogdet(np.eye(2) + sigma**2 * data)[1])
    weight = 1 / (1 + (1 - belief) / belief * np.exp(-np.clip(log, -500.0, 500.0)))
    mean_square = np.diag(wide @ pull @ wide)
    square = weight * np.diag(wide) + weight * (1 - weight) * mean_square
    alone = 1 / np.diag(np.linalg.inv(data))          # what the data tell of each
    rest = 1 / square - alone
    taken = np.where(rest > 1 / sigma**2, 1 / np.maximum(rest, 1e-300), sigma**2)
    return np.sqrt(np.maximum(taken, NO_SCALE**2)), float(weight)


def scale_priors(now: Fit, found, config):
    """
    Return a fit's priors with what is to be believed of the scale errors; the grade's weight.

    That there are none where it is no matter. ``found`` as for ``believed``.
    """
    sigma = grade_of(config.imu).accel_scale_error
    if sigma <= NO_SCALE:
        return now.priors, 0.0
    if now.levels.correlation_time:
        return with_scales(now.priors, np.full(2, sigma)), 1.0
    C, last = now.solved.covariance, now.priors.constants[ACCEL_SCALE]
    prior, weight = believed(C[ACCEL_SCALE, ACCEL_SCALE], found, sigma,
                             BELIEF[config.imu.grade], last)

    def variance(sigmas):
        other = np.zeros(len(C))
        other[ACCEL_SCALE] = 1 / sigmas**2 - 1 / last**2
        return np.diag(np.linalg.inv(np.linalg.inv(C) + np.diag(other)))[:3]

    # the same data with this belief and with that of none
    if np.sqrt(variance(prior) / variance(NO_SCALE)).max() < 1 + NO_MATTER and weight < TAKEN:
        prior = np.full(2, NO_SCALE)
    same = (prior == last).all()
    return (now.priors if same else with_scales(now.priors, prior)), weight


def judge_running(now: Fit, config) -> Fit:
    """Return a fit with what it tells of the scale errors believed: where the next sets out."""
    priors, _ = scale_priors(now, now.state.constants[ACCEL_SCALE], config)
    return _with_beliefs(now, priors)


def _with_beliefs(now, priors):
    return replace(now, priors=priors,
                   first=with_scales(now.first, priors.constants[ACCEL_SCALE]))


def with_scales(priors, sigmas):
    """Return priors with these sigmas of the scale errors, (2,)."""
    constants = priors.constants.copy()
    constants[ACCEL_SCALE] = sigmas
    return replace(priors, constants=constants)


def judge_scale(problem, now: Fit, config, trace=None) -> Fit:
    """
    Return a fit whose sigmas hold the accelerometer's scale error.

    now : made with the belief that there is none.   trace : as for ``fit``.
    """
    priors, weight = scale_priors(now, now.state.constants[ACCEL_SCALE], config)
    if priors is now.priors:
        return now
    about = _with_beliefs(now, priors)
    # noise judged with a scale error that was not taken for one is to be judged again
    taken = weight >= TAKEN
    last = fit(problem, now.state, now.levels, 2 * FEW if taken else FEW, about=about,
               frozen=not taken, trace=trace)
    return replace(last, iterations=now.iterations + last.iterations)
