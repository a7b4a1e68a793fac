# Copyright 2026 odocal_ros maintainers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0
# Unless required by applicable law or agreed to in writing, software distributed under the License
# is distributed on an "AS IS" BASIS, WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express
# or implied. See the License for the specific language governing permissions and limitations under
# the License.

"""The method ``wheels`` on one leg: the estimate and, where asked for, the patent's search."""

from dataclasses import replace
from functools import partial

import numpy as np

from odocal_ros.calib.judge import judge
from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.calib.wheels.leg import positions, WheelLeg
from odocal_ros.calib.wheels.result import fit_wheels, refused
from odocal_ros.calib.wheels.unseen import drawn_out
from odocal_ros.nav.angles import arctan2
from odocal_ros.nav.dead_reckoning import dead_reckon, Track
from odocal_ros.nav.odometer import Travel
from odocal_ros.nav.rotations import matrix_from_quat, quat_from_rotvec, quat_multiply
from odocal_ros.pipeline.method_run import MethodRun, Passed, Paths
from odocal_ros.pipeline.patent_run import search_of
from odocal_ros.pipeline.prepared import PreparedLeg
from odocal_ros.pipeline.tracks import as_configured
from odocal_ros.reasons import Code, Reason

ONE_COUNTER = Reason(Code.NO_METHOD, 'method wheels needs the counts of two wheels: odometer.left '
                     'and odometer.right name them')
OF_TWO = {Code.WHEELS_NOT_SEPARABLE, Code.TRACK_WIDTH_NOT_DETERMINED}
UNEVEN = {Code.WHEEL_DEAD, Code.WHEEL_REVERSED, Code.WHEELS_SWAPPED}


def wheels(ready: PreparedLeg, passed: Passed | None = None) -> MethodRun:
    """
    Run the method on a leg.

    ready : PreparedLeg.   passed : not called, the passes are few.
    """
    two = ready.inputs.travel_right is not None
    if not two and ready.inputs.felt:
        return MethodRun(refused(ready.inputs, ONE_COUNTER))
    leg = wheel_leg(ready)
    if leg is None:
        return MethodRun(refused(ready.inputs, Reason(
            Code.NO_FIX, 'no usable fix at the start mark')))
    method = fit_wheels(leg, ready.config) if two else _of_one(
        fit_wheels(leg, ready.config, False))
    if method.estimates['scale_factor'].value is None:
        return MethodRun(method)
    asked = two and ready.config.method == 'patent'
    found = search_of(ready, leg, method.details['pitch']['value']) if asked else None
    more = {} if found is None else {'search': found.as_dict()}
    # what positions alone cannot tell, the gyro may have: of that the estimate speaks itself
    reasons = tuple(r for r in (found.reasons if found else ())
                    if r.code is not Code.WHEELS_NOT_SEPARABLE)
    own = tuple(r for r in method.reasons       # why the track is far off, the leg has said
                if r.code is not Code.TRACK_MISMATCH or not _uneven(ready))
    method = replace(method, details=method.details | more, reasons=(
        *own, *reasons, *judge(method.estimates, ready.nominal, ready.config)))
    return MethodRun(method, _paths(ready, leg, method), delays={'gnss': (
        method.details['fix_latency_seen'], method.details['fix_latency_sigma'])},
        slips=method.details['slips'])


def wheel_leg(ready: PreparedLeg) -> WheelLeg | None:
    """Return a prepared leg as two wheels see it, None without a fix at its start."""
    inputs = ready.inputs
    left, right = inputs.travel_left or inputs.travel, inputs.travel_right or inputs.travel
    ends = (max(0.0, float(ready.track.t[0]), float(left.t[0]), float(right.t[0])),
            min(ready.t_fit, float(ready.track.t[-1]), float(left.t[-1]), float(right.t[-1])))
    start = ready.mark(ends[0], ready.path(np.array([ready.rough, 0.0, 0.0])), 'start')
    if start is None or ends[1] <= ends[0]:
        return None
    between = (inputs.t_fix >= ends[0]) & (inputs.t_fix <= ends[1])
    slips = ready.wheel_slips
    return WheelLeg(
        origin=ready.origin, left=ready.reckon(left), right=ready.reckon(right),
        quantum=max(left.quantum, right.quantum), t_fix=inputs.t_fix[between],
        fixes_n=ready.fixes_n[between], covariance_n=inputs.covariance_n[between], start=start,
        t_start=ends[0], t_stop=ends[1], alignment=ready.alignment, lever_b=ready.lever_b,
        nominal=ready.nominal, rough=ready.rough, scale_unit=inputs.scale_unit,
        interval=float(np.median(np.diff(left.t))), doubt=(inputs.doubt_t, inputs.doubt_sigma),
        slips=drawn_out(slips.begin, slips.end, slips.size),
        uneven=bool(slips.change) or _uneven(ready))


def _of_one(method: MethodResult) -> MethodResult:
    """Return what the method says of one counter, that stood for both: nothing of two wheels."""
    width = Estimate(None, None, 'm')       # left and right are not stated without their turn
    return replace(method, estimates=method.estimates | {'track_width': width}, reasons=tuple(
        r for r in method.reasons if r.code not in OF_TWO))


def _uneven(ready: PreparedLeg) -> bool:
    return bool(UNEVEN & {r.code for r in ready.reasons})


def _paths(ready: PreparedLeg, leg: WheelLeg, method: MethodResult) -> Paths:
    """Return the paths that wheels dead reckon with the corrected heading and gyro."""
    e, f = method.estimates, method.details['f']
    k_left, k_right = (e[f'scale_factor_{side}'].value for side in ('left', 'right'))
    if k_left is None or k_right is None:
        return Paths(*map(ready.path, (as_configured(ready, f, e), f)))
    drift = 0.0 if e['gyro_bias_z'].value is None else (
        e['gyro_bias_z'].value - ready.alignment.gyro_bias[2])
    error = method.details['gyro_scale_seen']['value']      # 0 where the leg tells nothing of it
    if drift or error:
        since = leg.start.t if ready.alignment.heading_source == 'fixed' else ready.alignment.t
        left, right = (_straightened(ready, travel or ready.inputs.travel, drift, error, since)
                       for travel in (ready.inputs.travel_left, ready.inputs.travel_right))
        leg = replace(leg, left=left, right=right)
    # heading and mounting error are one: they hold for both
    angles = {'heading_error': e['heading_error'].value, 'pitch': method.details['pitch']['value']}
    nominal = ready.nominal or ready.rough
    return Paths(partial(positions, leg, k_left=nominal, k_right=nominal, **angles),
                 partial(positions, leg, k_left=k_left, k_right=k_right, **angles))


def _straightened(ready: PreparedLeg, travel: Travel, drift: float, error: float,
                  since: float) -> Track:
    """Return the track of a wheel without drift, rad/s, and scale error of the gyro."""
    t, q_nb = ready.epochs
    x = matrix_from_quat(q_nb)[..., 0]
    yaw = np.unwrap(arctan2(x[:, 1], x[:, 0]))
    turn = np.zeros((len(t), 3))
    turn[:, 2] = -drift * (t - since) - error / (1 + error) * (
        yaw - np.interp(since, t, yaw))
    return dead_reckon(t, quat_multiply(quat_from_rotvec(turn), q_nb), travel)
