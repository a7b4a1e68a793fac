"""
Slips of one wheel that only the whole fit sees: in turns the gyro alone takes them for the turn's.

A step of one wheel's way, tried at every place against all that was fitted. Fixes, the turns
elsewhere and the gyro hold against it, each by its weight, so that a step no larger than what the
noise makes is none. What is found joins the slips of the leg, and the fit is made again.
"""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.wheels.estimate import solve
from odocal_ros.calib.wheels.slips import BLUR, TURN_DOUBT
from odocal_ros.reasons import Code, Reason

SURE = 5.5           # sigmas
APART = 5.0          # of z^2, by which one wheel is named before the other
NEAR = 30.0          # s from a slip that is known: its begin and end are no others
MOST = 4             # slips looked for
AROUND = 0.5         # s each side of a slip that may be part of it
STEP = 1.0           # s between the steps that make a slip
SIDES = ('left', 'right')


def solve_with_slips(leg, config, turn_rate=True):
    """
    Return the solution of a leg with its unseen slips in the covariance, and what they are.

    Parameters
    ----------
    leg : WheelLeg
        As ``solve`` takes it.
    config : Config
        Settings.
    turn_rate : bool
        False leaves the wheels' turn out: nothing is looked for then.

    Returns
    -------
    Solution, None where the fixes are too few; reasons.

    """
    solution, reasons = solve(leg, config, turn_rate), ()
    while turn_rate and solution and not leg.uneven and len(reasons) < MOST:
        found = unseen_slip(solution, leg.slips[0])
        if found is None:
            break
        t, size, sigma, wheel = found
        reasons += (_said(t, size, sigma, wheel),)
        bin_s = np.diff(solution.bins.edges[:2])
        more = drawn_out(t - bin_s, t + bin_s, [size])
        leg = replace(leg, slips=tuple(map(np.append, leg.slips, more)))
        solution = solve(leg, config)
    return solution, reasons


def drawn_out(begin, end, size):
    """
    Return slips as steps, s and m, that together may be any slip of that size in that time.

    begin, end, size : (k,) s, s, m.   A single step would leave half of a slip of seconds to fixes
    of centimetres, which then seem to stray.
    """
    t, steps = [], []
    for a, b, whole in zip(begin, end, size, strict=True):
        at = np.linspace(a - AROUND, b + AROUND, 2 + int(np.ceil((b - a + 2 * AROUND) / STEP)))
        t.append(at)
        steps.append(np.full(len(at), whole / np.sqrt(len(at))))
    return np.concatenate([*t, []]), np.concatenate([*steps, []])


def unseen_slip(solution, known_t=()):
    """
    Return the step of one wheel that stands out most: t s, size and sigma m, wheel; or None.

    size > 0 where the wheel ran farther than the ground.   wheel : 0 left, 1 right, -1 either.
    known_t : s, of slips that are known already.
    """
    edges, eq, fit = solution.bins.edges, solution.eq, solution.fit
    at = np.sort(np.append(edges[1:-1], (edges[:-1] + edges[1:]) / 2))
    for t in known_t:
        at = at[np.abs(at - t) > NEAR]
    if not len(at):
        return None
    columns = _columns(at, edges, eq)[fit.use]                  # (u, 2, m)
    flat = columns.reshape(len(columns), -1)
    weight = np.einsum('uk,uk->k', flat, fit.P @ flat)
    pull = fit.left @ flat
    floor = 1e-9 * weight.max()
    z = (np.sign(pull) * np.sqrt(pull**2 / np.maximum(weight, floor))).reshape(2, -1)
    size = (pull / np.maximum(weight, floor)).reshape(2, -1)
    here = np.clip(np.searchsorted(edges, at) - 1, 0, len(edges) - 2)
    turn = np.abs(eq.yaw[np.minimum(here + 2, len(edges) - 1)] - eq.yaw[np.maximum(here - 1, 0)])
    usual = SURE * np.hypot(BLUR, TURN_DOUBT * solution.state.width * turn)
    told = (np.abs(z) > SURE) & (np.abs(size) > usual)
    if not told.any():
        return None
    k, best = np.unravel_index(np.argmax(np.where(told, np.abs(z), 0.0)), z.shape)
    wheel = int(k) if z[k, best]**2 - z[1 - k, best]**2 > APART else -1
    return float(at[best]), float(size[k, best]), float(size[k, best] / z[k, best]), wheel


def _columns(at, edges, eq):
    """Return what 1 m of slip of the left and of the right wheel does, (3N, 2, m)."""
    since = np.clip((edges[1:, None] - at) / np.diff(edges)[:, None], 0.0, 1.0)
    axis = eq.forward[np.clip(np.searchsorted(edges, at) - 1, 0, len(edges) - 2)]
    level = [-since * axis[:, k] / 2 for k in (0, 1)]
    return np.stack([np.concatenate([*level, sign * since]) for sign in (1.0, -1.0)], axis=1)


def _said(t, size, sigma, wheel):
    which = 'one of the wheels parts from the other' if wheel < 0 else (
        f'the {SIDES[wheel]} wheel {"spins" if size > 0 else "slides"}')
    return Reason(Code.WHEEL_SLIP, f'{which} by {100 * abs(size):.0f} cm (+-{100 * sigma:.1f}) '
                  f'about t = {t:.0f} s, as turns and fixes before and after tell; the sigmas '
                  'hold it')
