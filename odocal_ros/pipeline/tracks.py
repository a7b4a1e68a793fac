"""The tracks of a leg, as configured and as calibrated, and how far they stray from the fixes."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from odocal_ros.calib.check import stray, track_check
from odocal_ros.calib.evidence import evidence
from odocal_ros.calib.per_distance import check_worse, per_distance
from odocal_ros.nav.dead_reckoning import forward_b, mounting_from_forward
from odocal_ros.reasons import Code, Reason

FEWEST_FIXES = 3        # for a check of the track
FAR = 20.0              # times the usual distance from the track: an outlier beyond doubt
TRACK_ROWS = 5000       # of a track kept in a result


class Paths(NamedTuple):
    """
    The antenna's path as configured and as calibrated: t (n,) to (n, 3) m, but for a constant.

    Both have one attitude, and the fit's angles where it determines none: they differ in what
    the calibration changes and in nothing else.
    """

    before: Callable
    after: Callable


def as_configured(run, f, estimates):
    """
    Return f = K0 d0 of the settings, (3,) m per unit of travel.

    f : as found; of its angles those are kept that ``estimates`` do not hold.
    """
    found = mounting_from_forward(f)
    told = {name for name, e in estimates.items() if e.value is not None}
    angles = [0.0 if name in told else angle for name, angle in zip(
        ('yaw_mounting_angle', 'pitch_mounting_angle'), found, strict=True)]
    return (run.nominal or run.rough) * forward_b(*angles)


def near(run, path, pin, between):
    """Tell which fixes do not lie absurdly far from a path that fits: (k,) bool."""
    if not between.any():
        return between
    off = np.hypot(*stray(path, pin, (run.inputs.t_fix, run.fixes_n))[:, :2].T)
    usual = max(float(np.median(off[between])), run.fix_sigma)
    far = off > FAR * usual
    if (far & between).any() and not any('off the track' in r.text for r in run.reasons):
        run.reasons.append(Reason(
            Code.BAD_ROWS_DROPPED, f'{int((far & between).sum())} of {int(between.sum())} fixes '
            f'lie more than {FAR * usual:.0f} m off the track; not used in the check'))
    return ~far


def tracks(run, paths) -> dict:
    """
    Return the tracks, checks and evidence of a leg as fields of its result.

    run : LegRun, aligned and reckoned; takes the reason if the correction makes it worse.
    paths : Paths
    """
    before, after = paths
    start = _start(run, after)
    if start is None:
        return {}
    t = run.track.t[::max(1, len(run.track.t) // TRACK_ROWS)]
    more = {name: start.position_n + path(t) - path(np.array(start.t))
            for name, path in (('track_before_n', before), ('track_n', after))}
    more |= {'origin': (run.origin.latitude, run.origin.longitude, run.origin.height)}
    pin, between, way = _checked(run, after, start)
    more['reference_n'] = run.fixes_n[between]
    if pin is None or between.sum() < FEWEST_FIXES:
        return more
    fixes = run.inputs.t_fix[between], run.fixes_n[between]
    more |= {name: track_check(stray(path, pin, fixes), way)
             for name, path in (('before', before), ('after', after))}
    relative = (np.interp(fixes[0], *driven(run)),
                *(stray(path, pin, fixes) for path in paths))
    more['per_distance'] = per_distance(*relative)
    run.reasons += check_worse(*relative, bool(run.nominal))
    kept = near(run, after, start, between)
    return more | {'evidence': evidence(run.leg, run.inputs, run.track, run.fixes_n, kept, start,
                                        paths, run.config, run.t_fit)}


def check_of(run, path) -> dict:
    """Return the check of a method's own path as an entry of its details, empty without one."""
    start = _start(run, path)
    pin, between, way = _checked(run, path, start) if start else (None, np.zeros(1, bool), 0.0)
    if pin is None or between.sum() < FEWEST_FIXES:
        return {}
    check = track_check(stray(path, pin, (run.inputs.t_fix[between], run.fixes_n[between])), way)
    return {'check': {name: getattr(check, name) for name in (
        'rms', 'max', 'mean', 'end', 'percent_of_distance')}}


def _start(run, path):
    return run.mark(max(0.0, float(run.track.t[0]), float(run.inputs.travel.t[0])), path, 'start')


def _checked(run, path, start):
    """Return where the path is pinned, which fixes it is held against, the way in m."""
    pin, begin, end = start, start.t, run.t_fit
    if run.holdout:
        pin, begin, end = run.mark(run.t_fit, path), run.t_fit, run.inputs.t_stop
    between = (run.inputs.t_fix >= begin) & (run.inputs.t_fix <= end)
    if pin is not None:
        between &= near(run, path, pin, between)
    a, b = np.interp([begin, end], *driven(run))
    return pin, between, b - a


def driven(run):
    """Return times of the track, s, and the way driven until then, m."""
    way = np.append(0.0, np.cumsum(np.abs(np.diff(run.track.s))))
    return run.track.t, way * run.metres_per_unit
