# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""An IMU that is moved in the vehicle during the leg: gravity or forward changes direction."""

import numpy as np

from odocal_ros.data.pieces import medians
from odocal_ros.nav.angles import wrap
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.facing import Accelerations, facing_of
from odocal_ros.screening.inputs import Inputs
from odocal_ros.screening.unit_changes import tenths

# judgement, deg: what slopes, bends and the noise of a fit do not make; of its tenths on one side
LEAST_TURN, SIDE = 45.0, 20.0
# a part driven backwards by an unsigned counter turns forward by 180 deg
MOST_YAW = 135.0
YAW_SIGMAS = 5.0    # statistical: of the two sides, beyond LEAST_TURN
DO = 'Mount the IMU firmly, or mark a leg on one side of this with --leg.'


def turned_over(inputs: Inputs) -> tuple[Reason, ...]:
    """Return IMU_AXES where gravity has one direction before, and another after, a tenth."""
    edges = tenths(inputs)
    if not len(edges):
        return ()
    up = np.array([medians(inputs.f_b[a:b]) for a, b in zip(edges[:-1], edges[1:], strict=True)])
    up /= np.maximum(np.linalg.norm(up, axis=1, keepdims=True), 1e-9)
    for k in range(1, len(up) - 1):
        sides = up[:k], up[k + 1:]
        before, after = (side.mean(axis=0) / max(float(np.linalg.norm(side.mean(axis=0))), 1e-9)
                         for side in sides)
        apart = _degrees(float(before @ after))
        if apart > LEAST_TURN and all(_degrees(float((side @ mean).min())) < SIDE for side, mean in
                                      zip(sides, (before, after), strict=True)):
            begin, end = inputs.t_imu[edges[k]], inputs.t_imu[edges[k + 1] - 1]
            return (_moved(f'gravity turns by {apart:.0f} deg', float(begin), float(end)),)
    return ()


def turned_about(found: Accelerations | None) -> tuple[Reason, ...]:
    """Return IMU_AXES where forward has one direction before, and another after, a tenth."""
    if found is None:
        return ()
    edges = np.linspace(0, len(found.t), 11).astype(int)
    seen = []
    for a, b in zip(edges[1:-2], edges[2:-1], strict=True):
        sides = facing_of(found[:a]), facing_of(found[b:])
        if sides[0] is None or sides[1] is None:
            continue
        apart = float(np.rad2deg(wrap(sides[1].yaw - sides[0].yaw)))
        sigma = float(np.rad2deg(np.hypot(sides[0].sigma, sides[1].sigma)))
        if LEAST_TURN + YAW_SIGMAS * sigma < abs(apart) < MOST_YAW:
            seen.append((sigma, -apart, float(found.t[a]), float(found.t[b])))
    if not seen:
        return ()
    sigma, apart, begin, end = min(seen)
    return (_moved(f'the forward direction turns by {apart:+.0f} ± {max(sigma, 1.0):.0f} deg',
                   begin, end),)


def _moved(what: str, begin: float, end: float) -> Reason:
    return Reason(Code.IMU_AXES, f'{what} in the IMU frame at about t = {begin:.0f} to '
                  f'{end:.0f} s: the IMU was moved in the vehicle', DO)


def _degrees(cosine: float) -> float:
    return float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))
