# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""
Slips of one wheel that only the whole fit sees: in turns the gyro alone takes them for the turn's.

A slip of one wheel, tried at every place against all that was fitted. Fixes, the turns
elsewhere and the gyro hold against it, each by its weight, so that one no larger than what the
noise makes is none. What is found joins the slips of the leg, and the fit is made again.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from odocal_ros.calib.wheels.estimate import solve
from odocal_ros.calib.wheels.least_squares import Fit
from odocal_ros.calib.wheels.leg import WheelLeg
from odocal_ros.calib.wheels.slips import TURN_DOUBT, TYRE_BLUR
from odocal_ros.calib.wheels.solution import Solution
from odocal_ros.data.arrays import Floats
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.wheel_faults import SIDES
from odocal_ros.settings.config import Config

Found = tuple[tuple[float, float], float, float, int]      # as unseen_slip returns it
# s, judgement: of the slips looked for; those between are seen too
SLIP_LENGTHS = (0.0, 8.0, 20.0, 45.0)
# statistical: sigmas from which a slip is seen, of 1000 places looked at: once in 25 000 legs
UNSEEN_SIGMAS = 5.5


def solve_with_slips(leg: WheelLeg, config: Config, turn_rate: bool = True,
                     ) -> tuple[Solution | None, tuple[Reason, ...], tuple[dict[str, Any], ...]]:
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
    Solution, None where the fixes are too few; reasons; the slips for calibration.json.

    """
    solution = solve(leg, config, turn_rate)
    seen: list[Found] = []
    # four at most: a leg with more slips all the time, and its noise says so
    while turn_rate and solution and not leg.uneven and len(seen) < 4:
        found = unseen_slip(solution, leg.slips[0])
        if found is None:
            break
        (begin, end), size, _, _ = found
        seen.append(found)
        bin_s = float(solution.bins.edges[1] - solution.bins.edges[0])
        more = drawn_out([begin - bin_s], [end + bin_s], [size])
        t, size_m = (np.append(*pair) for pair in zip(leg.slips, more, strict=True))
        leg = replace(leg, slips=(t, size_m))
        solution = solve(leg, config)
    return solution, tuple(_said(*found) for found in seen), tuple(map(_slip, sorted(seen)))


def drawn_out(begin: Sequence[float] | Floats, end: Sequence[float] | Floats,
              size: Sequence[float] | Floats) -> tuple[Floats, Floats]:
    """
    Return slips as steps, s and m, that together may be any slip of that size in that time.

    begin, end, size : (k,) s, s, m.   A single step would leave half of a slip of seconds to fixes
    of centimetres, which then seem to stray.
    """
    t, steps = [], []
    for a, b, whole in zip(begin, end, size, strict=True):
        around = 0.5 + 0.15 * (b - a)     # s each side: it was seen from a tenth to nine tenths
        n = 2 + int(b - a + 2 * around)     # a step each second
        at = np.linspace(a - around, b + around, n)
        t.append(at)
        steps.append(np.full(len(at), whole / np.sqrt(len(at))))
    return np.concatenate([*t, []]), np.concatenate([*steps, []])


def unseen_slip(solution: Solution, known_t: Sequence[float] | Floats = ()) -> Found | None:
    """
    Return the slip of one wheel that stands out most: (begin, end) s, size and sigma m, wheel.

    size > 0 where the wheel ran farther than the ground.   wheel : 0 left, 1 right, -1 either.
    known_t : s, of slips that are known already.   None where nothing stands out.
    """
    best: tuple[float, Found] | None = None
    for length in SLIP_LENGTHS:
        ramps = _ramps(solution, length)
        if ramps is None:
            continue
        spans, columns, turn = ramps
        far = np.ones(len(spans), bool)
        for t in known_t:
            # 30 s from one that is known: its begin and end are no others
            far &= (spans[:, 1] < t - 30.0) | (spans[:, 0] > t + 30.0)
        z, size = _scores(solution.fit, columns)
        usual = UNSEEN_SIGMAS * np.hypot(TYRE_BLUR, TURN_DOUBT * solution.state.width * turn)
        sure = far & (np.abs(z) > UNSEEN_SIGMAS) & (np.abs(size) > usual)
        score = np.where(sure, np.abs(z), 0.0)
        k, j = np.unravel_index(np.argmax(score), score.shape)
        if score[k, j] > (best[0] if best else 0.0):
            # twice the log odds, 12 to 1, at which one wheel is named before the other
            wheel = int(k) if z[k, j]**2 - z[1 - k, j]**2 > 5.0 else -1
            best = (float(score[k, j]), ((float(spans[j, 0]), float(spans[j, 1])),
                                         float(size[k, j]), float(size[k, j] / z[k, j]), wheel))
    return best[1] if best else None


def _scores(fit: Fit, columns: Floats) -> tuple[Floats, Floats]:
    """Return the size of each slip by all observations, in sigmas and m: (2, m) each."""
    flat = columns[fit.use].reshape(fit.use.sum(), -1)
    weight = np.einsum('uk,uk->k', flat, fit.P @ flat)
    weight = np.maximum(weight, 1e-9 * weight.max() + 1e-30)
    pull = fit.left @ flat
    return ((pull / np.sqrt(weight)).reshape(2, -1), (pull / weight).reshape(2, -1))


def _ramps(solution: Solution, length: float) -> tuple[Floats, Floats, Floats] | None:
    """
    Return the slips of a length, s, that grow with the way, and what 1 m of each does.

    Returns
    -------
    (m, 2) s, begin and end; (3N, 2, m) of the left and of the right wheel; (m,) rad turned there.
    None where the leg is too short for them.

    """
    edges, eq = solution.bins.edges, solution.eq
    half = (edges[1] - edges[0]) / 2
    at = edges[0] + half * np.arange(1, 2 * (len(edges) - 1))
    n = max(1, round(length / half))                        # steps that make a ramp
    if n > len(at) // 3:
        return None
    here = np.clip(((at - edges[0]) / (2 * half)).astype(int), 0, len(edges) - 2)
    way = np.maximum(eq.length[here], 1e-6)
    total = np.append(0.0, np.cumsum(way))
    since = np.clip((edges[1:, None] - at) / (2 * half), 0.0, 1.0)
    level = [-since * eq.forward[here, k] / 2 for k in (0, 1)]
    steps = np.stack([np.concatenate([*level, sign * since]) for sign in (1.0, -1.0)], axis=1)
    summed = np.concatenate([np.zeros((*steps.shape[:2], 1)), np.cumsum(steps * way, -1)], -1)
    columns = (summed[..., n:] - summed[..., :-n]) / (total[n:] - total[:-n])
    spans = np.stack([at[:len(at) - n + 1], at[n - 1:]], -1)
    yaw = np.append(0.0, np.cumsum(np.abs(np.diff(eq.yaw))))
    turn = np.interp(spans[:, 1] + 2 * half, edges, yaw) - np.interp(
        spans[:, 0] - 2 * half, edges, yaw)
    return spans, columns, turn


def _slip(found: Found) -> dict[str, Any]:
    (begin, end), size, sigma, wheel = found
    return {'t': begin, 'duration': end - begin, 'metres': size, 'sigma': sigma,
            'wheel': (*SIDES, 'one of them')[wheel]}


def _said(span: tuple[float, float], size: float, sigma: float, wheel: int) -> Reason:
    which = 'one of the wheels parts from the other' if wheel < 0 else (
        f'the {SIDES[wheel]} wheel {"spins" if size > 0 else "slides"}')
    # of less than 5 s begin and end are not separable
    when = f'about t = {span[0]:.0f} s' if span[1] - span[0] < 5.0 else (
        f'between t = {span[0]:.0f} and {span[1]:.0f} s')
    return Reason(Code.WHEEL_SLIP, f'{which} by {100 * abs(size):.0f} cm (+-{100 * sigma:.1f}) '
                  f'{when}, as turns and fixes before and after tell; the sigmas hold it')
