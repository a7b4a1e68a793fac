"""The method ``wheels`` on one leg: the estimate, and beside it the search of source B."""

from dataclasses import replace

import numpy as np

from odocal_ros.calib.judge import judge
from odocal_ros.calib.result import Estimate
from odocal_ros.calib.wheels.leg import positions, WheelLeg
from odocal_ros.calib.wheels.result import fit_wheels, refused
from odocal_ros.calib.wheels.unseen import drawn_out, with_unseen
from odocal_ros.nav.angles import arctan2
from odocal_ros.nav.dead_reckoning import dead_reckon
from odocal_ros.nav.rotations import matrix_from_quat, quat_from_rotvec, quat_multiply
from odocal_ros.patent.planar import planar_leg
from odocal_ros.patent.ranges import ranges_of
from odocal_ros.patent.search import search
from odocal_ros.pipeline.delay_note import note_delays
from odocal_ros.pipeline.tracks import as_configured, Paths
from odocal_ros.reasons import Code, Reason

ONE_COUNTER = Reason(Code.NO_METHOD, 'method wheels needs the counts of two wheels: odometer.left '
                     'and odometer.right name them')
OF_TWO = {Code.WHEELS_NOT_SEPARABLE, Code.TRACK_WIDTH_NOT_DETERMINED}
UNEVEN = {Code.WHEEL_DEAD, Code.WHEEL_REVERSED, Code.WHEELS_SWAPPED}


def wheels(run):
    """
    Run the method on a leg.

    run : LegRun, aligned and reckoned.

    Returns
    -------
    MethodResult, and the antenna's Paths; None where refused.

    """
    two = run.inputs.travel_right is not None
    if not two and run.inputs.felt:
        return refused(run.inputs, ONE_COUNTER), None
    leg = _leg(run)
    if leg is None:
        return refused(run.inputs, Reason(Code.NO_FIX, 'no usable fix at the start mark')), None
    method = fit_wheels(leg, run.config) if two else _of_one(fit_wheels(leg, run.config, False))
    if method.estimates['scale_factor'].value is None:
        return method, None
    # the methods that follow hold them too
    run.wheel_slips = with_unseen(run.wheel_slips, method.details['slips'])
    note_delays(run, {'gnss': (method.details['fix_latency_seen'],
                               method.details['fix_latency_sigma'])},
                method.estimates['scale_factor'].value)
    found = _search(run, leg, method.details['pitch']['value']) if two else None
    more = {} if found is None else {'search': found.as_dict()}
    # what positions alone cannot tell, the gyro may have: of that the estimate speaks itself
    reasons = tuple(r for r in (found.reasons if found else ())
                    if r.code is not Code.WHEELS_NOT_SEPARABLE)
    own = tuple(r for r in method.reasons       # why the track is far off, the leg has said
                if r.code is not Code.TRACK_MISMATCH or not _uneven(run))
    method = replace(method, details=method.details | more, reasons=(
        *own, *reasons, *judge(method.estimates, run.nominal, run.config)))
    return method, _paths(run, leg, method)


def _leg(run) -> WheelLeg | None:
    inputs = run.inputs
    left = right = inputs.travel
    if inputs.travel_right is not None:
        left, right = inputs.travel_left, inputs.travel_right
    ends = (max(0.0, float(run.track.t[0]), float(left.t[0]), float(right.t[0])),
            min(run.t_fit, float(run.track.t[-1]), float(left.t[-1]), float(right.t[-1])))
    start = run.mark(ends[0], run.path(np.array([run.rough, 0.0, 0.0])), 'start')
    if start is None or ends[1] <= ends[0]:
        return None
    between = (inputs.t_fix >= ends[0]) & (inputs.t_fix <= ends[1])
    slips = run.wheel_slips
    return WheelLeg(
        origin=run.origin, left=run.reckon(left), right=run.reckon(right),
        quantum=max(left.quantum, right.quantum), t_fix=inputs.t_fix[between],
        fixes_n=run.fixes_n[between], covariance_n=inputs.covariance_n[between], start=start,
        t_start=ends[0], t_stop=ends[1], alignment=run.alignment, lever_b=run.lever_b,
        nominal=run.nominal, rough=run.rough, scale_unit=inputs.scale_unit,
        interval=float(np.median(np.diff(left.t))), doubt=(inputs.doubt_t, inputs.doubt_sigma),
        slips=drawn_out(slips.begin, slips.end, slips.size),
        uneven=bool(slips.change) or _uneven(run))


def _of_one(method):
    """Return what the method says of one counter, that stood for both: nothing of two wheels."""
    width = Estimate(None, None, 'm')       # left and right are not stated without their turn
    return replace(method, estimates=method.estimates | {'track_width': width}, reasons=tuple(
        r for r in method.reasons if r.code not in OF_TWO))


def _uneven(run) -> bool:
    return bool(UNEVEN & {r.code for r in run.reasons})


def _search(run, leg, pitch):
    """Return what source B finds: array, response surface, least squares by positions alone."""
    a, wheels = run.alignment, run.config.wheels
    start = run.nominal or run.rough
    planar = planar_leg(leg.left, leg.right, leg.t_fix, leg.fixes_n, leg.covariance_n,
                        (leg.start.t, leg.start.position_n), (start, start), pitch, leg.lever_b)
    course = None if a.heading_separable else a.heading_sigma     # holds the mounting angle too
    return search(planar, ranges_of(wheels, course), wheels.robust)


def _paths(run, leg, method):
    """Return the paths that wheels dead reckon with the corrected heading and gyro."""
    e, f = method.estimates, method.details['f']
    if e['scale_factor_left'].value is None:
        return Paths(*map(run.path, (as_configured(run, f, e), f)))
    drift = 0.0 if e['gyro_bias_z'].value is None else (
        e['gyro_bias_z'].value - run.alignment.gyro_bias[2])
    error = method.details['gyro_scale_seen']['value']      # 0 where the leg tells nothing of it
    if drift or error:
        since = leg.start.t if run.alignment.heading_source == 'fixed' else run.alignment.t
        leg = replace(leg, **{side: _straightened(run, travel, drift, error, since)
                              for side, travel in (('left', run.inputs.travel_left),
                                                   ('right', run.inputs.travel_right))})
    # heading and mounting error are one: they hold for both
    angles = e['heading_error'].value, method.details['pitch']['value']
    both = (run.nominal or run.rough,) * 2, tuple(
        e[f'scale_factor_{side}'].value for side in ('left', 'right'))
    return Paths(*(lambda t, scales=scales: positions(leg, t, *scales, *angles)
                   for scales in both))


def _straightened(run, travel, drift, error, since):
    """Return the track of a wheel without drift, rad/s, and scale error of the gyro."""
    t, q_nb = run.epochs
    x = matrix_from_quat(q_nb)[..., 0]
    yaw = np.unwrap(arctan2(x[:, 1], x[:, 0]))
    turn = np.zeros((len(t), 3))
    turn[:, 2] = -drift * (t - since) - error / (1 + error) * (
        yaw - np.interp(since, t, yaw))
    return dead_reckon(t, quat_multiply(quat_from_rotvec(turn), q_nb), travel)
