# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
What a good vehicle has not: none of it, or as much as is usual; the drive says which.

An Imu with scale errors, axes that are not at right angles, a gyro that feels force; a receiver
that smooths; tyres that grow; a body that leans. A leg is fitted with all of them, as large as
the grade of the Imu and the road's experience have them. Most drives then tell which are there:
of each kind two priors (none; as usual) are weighed by their evidence, and the constants' priors
become those whose posterior has the mean square of both: docs/method.md (S28), (S29).

Where fixes err slowly, metres come from the accelerometer, and its scale error is the odometer's.
There no drive tells an error of a third of the grade from none: the prior of all is as usual.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from odocal_ros.calib.border import Border
from odocal_ros.calib.linked_legs import LinkedLegs
from odocal_ros.calib.smoother.estimate import AGAIN_PASSES, Fit, fit, Trace
from odocal_ros.calib.smoother.problem import imperfect_sigmas, NO_ERROR, Problem
from odocal_ros.calib.smoother.state import CONSTANTS, IMPERFECT, KINDS, LN_K, Priors
from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.settings.grades import Grade

SAME_SIGMAS = 1e-3      # judgement: relative change of prior sigmas that is none


def mixture_prior(data: Floats, pull: Floats, odds: float = 0.5) -> tuple[Floats, float]:
    """
    Return prior variances of one kind of errors by their evidence: docs/method.md (S28), (S29).

    Parameters
    ----------
    data : (k, k) array
        What a drive tells of the errors: information, in units of the usual sigmas.
    pull : (k, k) array
        Outer square of the gradient at no error, of the same; ``data`` where there are none.
    odds : float
        Prior probability that they are there; more costs where they are not (docs/decisions/0008).

    Returns
    -------
    (k,) array of prior variances, 1e-6 (as good as no error) to 1, and the weight of the usual
    ones.

    """
    one = np.eye(len(data))
    wide = np.linalg.inv(data + one)
    log = 0.5 * (np.trace(wide @ pull) - np.linalg.slogdet(data + one)[1])
    weight = 1 / (1 + (1 - odds) / odds * np.exp(-np.clip(log, -500.0, 500.0)))
    mean_square = np.diag(wide @ pull @ wide)
    square = weight * np.diag(wide) + weight * (1 - weight) * mean_square
    rest = 1 / square - 1 / np.diag(np.linalg.inv(data))     # less what the data tell of each
    taken = np.where(rest > 1.0, 1 / np.maximum(rest, 1e-300), 1.0)
    return np.clip(taken, 1e-3**2, 1.0), float(weight)


def weigh_kinds(data: Floats, gradient: Floats | None,
                kinds: Sequence[Bools | slice]) -> Floats:
    """
    Return prior variances of all errors, each kind weighed with the others' priors as last.

    data : (k, k) information in units of the usual sigmas.   gradient : (k,) at no error, or None
    for errors that are not there.   kinds : slices.
    """
    prior = np.ones(len(data))
    for _ in range(20):     # rounds over the kinds, at most
        before = prior.copy()
        for kind in kinds:
            own = np.arange(len(data))[kind]
            rest = np.setdiff1d(np.arange(len(data)), own)
            gain = np.linalg.solve(data[np.ix_(rest, rest)] + np.diag(1 / prior[rest]),
                                   data[np.ix_(rest, own)]).T
            D = data[np.ix_(own, own)] - gain @ data[np.ix_(rest, own)]
            if gradient is None:
                pull = D
            else:
                g = gradient[own] - gain @ gradient[rest]
                pull = np.outer(g, g)
            prior[own], _ = mixture_prior(D, pull)
        if np.abs(np.log(prior / before)).max() < SAME_SIGMAS:
            break
    return prior


def judged_priors(now: Fit, grade: Grade, found: bool = True) -> Priors:
    """
    Return a fit's priors with those of imperfections by evidence.

    grade : Grade, that the Imu is taken for.   found : False: as where there are none, whatever
    the fit's values.
    """
    usual = imperfect_sigmas(grade, now.state.t[-1] - now.state.t[0])
    there = np.flatnonzero(usual > 0)
    sigma, last = usual[there], now.priors.constants[IMPERFECT][there]
    if now.levels.correlation_time or not len(there):
        return now.priors
    pick = IMPERFECT.start + there
    both = np.linalg.inv(now.solved.covariance[np.ix_(pick, pick)]
                         / np.multiply.outer(sigma, sigma))
    data = both - np.diag((sigma / last)**2)
    data = (data + data.T) / 2 + 1e-3 * np.eye(len(sigma))
    kinds = [np.isin(there, np.arange(len(usual))[kind]) for kind in KINDS]
    prior = weigh_kinds(data, both @ (now.state.constants[pick] / sigma) if found else None,
                        [kind for kind in kinds if kind.any()])
    taken = _taken(prior, last, sigma)
    if np.abs(np.log(taken / last)).max() < SAME_SIGMAS:
        return now.priors
    sigmas = np.full(len(usual), NO_ERROR)
    sigmas[there] = taken
    return with_imperfect(now.priors, sigmas)


def _taken(prior: Floats, last: Floats, sigma: Floats) -> Floats:
    """
    Return prior sigmas of variances in units of the usual ones: (k,) each.

    What is there may be more than usual: then the prior has given way, and stays so.
    """
    return np.where(prior > 0.98, np.maximum(last, sigma), np.sqrt(prior) * sigma)


def weighed_together(borders: list[Border], steps: Floats) -> list[Border]:
    """
    Return borders of one vehicle with priors of imperfections by the evidence of all of them.

    By itself a leg that does not determine a kind has it as usual, another none of it.
    Those whose fixes err slowly have no say.

    borders : by time.   steps : (J - 1,) sigmas by which the scale walks between them.
    """
    legs = LinkedLegs(borders, CONSTANTS[LN_K], steps)
    telling = [j for j, b in enumerate(legs.borders) if b.usual.any()]
    if not telling or len(borders) < 2:
        return borders
    walked = np.append(0.0, np.cumsum(np.square(steps)))[telling]
    of = LinkedLegs([legs.borders[j] for j in telling], CONSTANTS[LN_K],
                    np.sqrt(np.diff(walked)))
    at = np.flatnonzero(of.usual > 0)
    data, gradient = of.evidence(at)
    sigma = of.usual[at]
    data = data * np.multiply.outer(sigma, sigma)
    kind = [np.isin(at, [of.names.index(n) for n in CONSTANTS[IMPERFECT][own]]) for own in KINDS]
    prior = weigh_kinds(data + 1e-3 * np.eye(len(at)), gradient * sigma,
                        [own for own in kind if own.any()])
    taken = _taken(prior, of.used[at], sigma)
    return legs.with_priors(at, taken)


def judge_running(now: Fit, grade: Grade) -> Fit:
    """Return a fit with priors of imperfections by its evidence: where the next sets out."""
    priors = judged_priors(now, grade)
    if priors is now.priors:
        return now
    return replace(now, priors=priors,
                   first=with_imperfect(now.first, priors.constants[IMPERFECT]))


def with_imperfect(priors: Priors, sigmas: Floats) -> Priors:
    """Return priors with these sigmas of what is imperfect, (k,)."""
    constants = priors.constants.copy()
    constants[IMPERFECT] = sigmas
    return replace(priors, constants=constants)


def judge_imperfect(problem: Problem, now: Fit, trace: Trace | None = None) -> Fit:
    """
    Return a fit whose sigmas hold the imperfections that there may be, and no more.

    now : made with the usual ones.   trace : as for ``fit``.
    """
    about = judge_running(now, problem.grade)
    if about is now:
        return now
    outline = about.outline()
    del now, about      # the equations of one fit at a time
    last = fit(problem, outline.state, outline.levels, AGAIN_PASSES, about=outline, frozen=True,
               trace=trace)
    return replace(last, iterations=outline.iterations + last.iterations)
