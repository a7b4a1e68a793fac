"""
Slow errors of fixes: whether there are any, how large, how long they stay.

A receiver's error wanders over a minute or so. Taken for white it would be averaged as if each fix
brought news, and the sigma would be a fraction of the error. Where the residuals of neighbouring
seconds are alike, or the fixes of a short leg scatter less than they say, a Gauss-Markov part is
estimated beside the white one; its time by likelihood.
"""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.smoother.estimate import Fit, fit

BIN = 2.0                      # s over which residuals are averaged
ALIKE, SURE = 0.15, 4.0        # correlation of neighbouring bins; its sigmas
SMOOTHED = 0.2                 # of the stated sigma: a fix so much better was filtered
TOLD = 90.0                    # s of fixes in which errors that stay for a minute show as alike
TIMES = (15.0, 60.0, 240.0)    # s, tried
SLOW_SHARE, WHITE_SHARE = 0.9, 0.2    # of the variance, to start from
FIRST, TRIAL = 5, 3            # iterations with the middle time, with each other


def correlation(t, residual):
    """
    Return the correlation of neighbouring bins of residuals and its sigma, were they white.

    t : (m,) s.   residual : (m, c) in sigmas.
    """
    if len(t) < 4:
        return 0.0, 1.0
    cell = np.floor((t - t[0]) / BIN).astype(int)
    at, first = np.unique(cell, return_index=True)
    count = np.diff(np.append(first, len(t)))
    mean = np.add.reduceat(residual, first, axis=0) / np.sqrt(count)[:, None]
    beside = np.flatnonzero(np.diff(at) == 1)
    power = (mean**2).mean()
    if len(beside) < 5 or power == 0:
        return 0.0, 1.0
    return (float((mean[beside] * mean[beside + 1]).mean() / power),
            float(1 / np.sqrt(residual.shape[1] * len(beside))))


def are_slow(problem, first: Fit, asked: float) -> bool:
    """
    Tell whether the errors of the fixes stay for a while.

    asked : ``gnss.correlation_time``, s: 0 white, NaN judge by the residuals of a first fit.
    """
    if not np.isnan(asked):
        return asked > 0.0
    if first.levels['fix'] < SMOOTHED**2:
        return True
    t = problem.leg.t_fix[problem.use]
    alike, sigma = correlation(t, first.weighted['fixes'].r[:, :2])
    return alike > max(ALIKE, SURE * sigma) or _hidden(t, first.levels['fix'])


def _hidden(t, level) -> bool:
    """
    Tell whether the fixes of a short leg scatter less than they say.

    In less than TOLD a slow error passes for another scale and heading, and what is left of it
    is hardly alike: what a receiver says of its errors and does not show as scatter is slow.

    t : (m,) s.   level : variance of the scatter, of the stated; good to 1 / sqrt(m) of itself,
    two components each.
    """
    return t[-1] - t[0] < TOLD and level < 1 - SURE / np.sqrt(len(t))


def with_slow_errors(problem, first: Fit, asked: float, trace=None) -> Fit:
    """
    Return the fit with slow fix errors beside the white ones.

    Parameters
    ----------
    problem : Problem
        The leg.
    first : Fit
        A first, rough fit with white fix errors.
    asked : float
        ``gnss.correlation_time``, s; NaN: the likeliest.
    trace : callable, optional
        As for ``fit``.

    """
    sigma2, sigma2_up = (float(np.median(problem.leg.covariance_n[:, i, i])) for i in (0, 2))
    levels = problem.first_levels.but(
        correlation_time=TIMES[1] if np.isnan(asked) else asked,
        **problem.shaken,
        slow=SLOW_SHARE * first.levels['fix'] * sigma2,
        slow_up=SLOW_SHARE * first.levels['fix_up'] * sigma2_up,
        fix=WHITE_SHARE * first.levels['fix'], fix_up=WHITE_SHARE * first.levels['fix_up'])
    if not np.isnan(asked):
        return fit(problem, first.state, levels, trace=trace)
    best = fit(problem, first.state, levels, FIRST, trace=trace).outline()
    tries = {TIMES[1]: best}
    for tau in (TIMES[0], TIMES[2]):
        power = {k: best.levels[k] * min(2.0, (tau / TIMES[1])**0.5) for k in ('slow', 'slow_up')}
        tries[tau] = fit(problem, best.state, best.levels.but(correlation_time=tau, **power),
                         TRIAL, about=best, trace=trace).outline()
    tau = _peak([np.log(x) for x in TIMES], [tries[x].likelihood for x in TIMES])
    start = min(tries.items(), key=lambda item: abs(np.log(item[0]) - tau))[1]
    last = fit(problem, start.state, start.levels.but(correlation_time=float(np.exp(tau))),
               about=start, trace=trace)
    done = sum(f.iterations for f in (*tries.values(), last))
    return replace(last, iterations=first.iterations + done)


def _peak(x, y):
    """Return where a parabola through three points is highest, within their ends."""
    curve = np.polyfit(x, y, 2)
    if curve[0] >= 0:
        return x[int(np.argmax(y))]
    return float(np.clip(-curve[1] / (2 * curve[0]), x[0], x[-1]))
