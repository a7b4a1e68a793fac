"""The tracks of a leg, as configured and as calibrated, and how far they stray from the fixes."""

import numpy as np

from odocal_ros.calib.check import stray, track_check
from odocal_ros.calib.evidence import evidence
from odocal_ros.reasons import Code, Reason

FEWEST_FIXES = 3        # for a check of the track
FAR = 20.0              # times the usual distance from the track: an outlier beyond doubt
TRACK_ROWS = 5000       # of a track kept in a result


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


def tracks(run, after) -> dict:
    """
    Return the tracks, checks and evidence of a leg as fields of its result.

    run : LegRun, aligned and reckoned.   after : the path as calibrated, t (n,) to (n, 3) m.
    """
    before = run.path(np.array([run.nominal or run.rough, 0.0, 0.0]))
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
    kept = near(run, after, start, between)
    return more | {'evidence': evidence(run.leg, run.inputs, run.track, run.fixes_n, kept, start,
                                        (before, after), run.config)}


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
    on_way = (run.track.t >= begin) & (run.track.t <= end)
    return pin, between, np.abs(np.diff(run.track.s[on_way])).sum() * run.rough
