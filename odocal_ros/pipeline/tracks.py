# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Tracks of a leg, as configured and as calibrated: deviation from the fixes, slips, checks."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

import numpy as np

from odocal_ros.calib.check import check_worse, per_distance, track_check, track_residuals
from odocal_ros.calib.evidence import evidence, KEPT_ROWS
from odocal_ros.calib.marks import MarkFix, Path
from odocal_ros.calib.result import Estimate
from odocal_ros.calib.sections import counter_change
from odocal_ros.calib.slip import find_slips, rounding, Slips, SPIN_WINDOW
from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.nav.dead_reckoning import forward_b, mounting_from_forward, Track
from odocal_ros.pipeline.prepared import Paths, PreparedLeg
from odocal_ros.reasons import Code, Reason

FEWEST_TRACK_FIXES = 3    # judgement: for a check of the track


def as_configured(ready: PreparedLeg, f: Floats, estimates: Mapping[str, Estimate]) -> Floats:
    """
    Return f = K0 d0 of the settings, (3,) m per unit of travel; without K0 the path ratio's.

    f : as estimated; its angles are kept if ``estimates`` has no value of them.
    """
    found = mounting_from_forward(f)
    determined = {name for name, e in estimates.items() if e.value is not None}
    angles = [0.0 if name in determined else angle for name, angle in zip(
        ('yaw_mounting_angle', 'pitch_mounting_angle'), found, strict=True)]
    return (ready.nominal or ready.path_ratio or ready.rough) * forward_b(*angles)


def near(ready: PreparedLeg, path: Path, pin: MarkFix,
         between: Bools) -> tuple[Bools, tuple[Reason, ...]]:
    """Return a mask of fixes, (k,), without gross outliers from a fitted path, and reasons."""
    if not between.any():
        return between, ()
    off = np.hypot(*track_residuals(path, pin, (ready.inputs.t_fix, ready.fixes_n))[:, :2].T)
    usual = max(float(np.median(off[between])), ready.fix_sigma)
    track_outlier = 20.0    # times the usual distance from the track: a certain outlier
    far = off > track_outlier * usual
    found = (Reason(
        Code.BAD_ROWS_DROPPED, f'{int((far & between).sum())} of {int(between.sum())} fixes are '
        f'more than {track_outlier * usual:.0f} m from the track; not used in the check'),)
    return ~far, found if (far & between).any() else ()


def tracks(ready: PreparedLeg, paths: Paths) -> tuple[dict[str, Any], tuple[Reason, ...]]:
    """Return the tracks, checks and evidence of a leg as fields of its result, and reasons."""
    before, after = paths
    start = _start(ready, after)
    if start is None:
        return {}, ()
    t = ready.track.t[::max(1, len(ready.track.t) // KEPT_ROWS)]
    more: dict[str, Any] = {
        name: start.position_n + path(t) - path(np.array(start.t))
        for name, path in (('track_before_n', before), ('track_n', after))}
    if not ready.origin.local:       # else the position on the Earth is unknown
        more |= {'origin': (ready.origin.latitude, ready.origin.longitude, ready.origin.height)}
    pin, between, path_length, found = _checked(ready, after, start)
    more['reference_n'] = ready.fixes_n[between]
    if pin is None or between.sum() < FEWEST_TRACK_FIXES:
        return more, found
    fixes = ready.inputs.t_fix[between], ready.fixes_n[between]
    more |= {name: track_check(track_residuals(path, pin, fixes), path_length)
             for name, path in (('before', before), ('after', after))}
    path_at = np.interp(fixes[0], *driven(ready))
    off_before, off_after = (track_residuals(path, pin, fixes) for path in paths)
    more['per_distance'] = per_distance(path_at, off_before, off_after)
    kept, far = near(ready, after, start, between)
    found += (*check_worse(path_at, off_before, off_after, bool(ready.nominal)), *far)
    seen = evidence(ready.leg, ready.inputs, ready.track, ready.fixes_n, kept, start, paths,
                    ready.config, ready.t_fit, ready.covered)
    found += counter_change(seen.sections, seen.t_fix, seen.fix_distance)
    return more | {'evidence': seen}, found


def check_of(ready: PreparedLeg, path: Path) -> tuple[dict[str, Any], tuple[Reason, ...]]:
    """Return the check of a method's own path as an entry of its details, and reasons."""
    start = _start(ready, path)
    if start is None:
        return {}, ()
    pin, between, path_length, found = _checked(ready, path, start)
    if pin is None or between.sum() < FEWEST_TRACK_FIXES:
        return {}, found
    fixes = ready.inputs.t_fix[between], ready.fixes_n[between]
    return {'check': asdict(track_check(track_residuals(path, pin, fixes), path_length))}, found


def _start(ready: PreparedLeg, path: Path) -> MarkFix | None:
    return ready.mark(ready.covered[0], path, 'start')


def _checked(ready: PreparedLeg, path: Path,
             start: MarkFix) -> tuple[MarkFix | None, Bools, float, tuple[Reason, ...]]:
    """Return the pin of the path, a mask of fixes to compare, path length, m, and reasons."""
    pin: MarkFix | None = start
    begin, end = start.t, ready.t_fit
    found: tuple[Reason, ...] = ()
    if ready.holdout:
        pin, begin, end = ready.mark(ready.t_fit, path), ready.t_fit, ready.inputs.t_stop
    end = min(end, ready.covered[1])
    between = (ready.inputs.t_fix >= begin) & (ready.inputs.t_fix <= end)
    if pin is not None:
        inside, found = near(ready, path, pin, between)
        between &= inside
    a, b = np.interp([begin, end], *driven(ready))
    return pin, between, b - a, found


def driven(ready: PreparedLeg) -> tuple[Floats, Floats]:
    """Return times of the track, s, and the path length up to them, m."""
    path_length = np.append(0.0, np.cumsum(np.abs(np.diff(ready.track.s))))
    return ready.track.t, path_length * ready.metres_per_unit


def slip_check(ready: PreparedLeg, track: Track, f: Floats, between: tuple[float, float]) -> Slips:
    """Return the slips of the mean wheel between two times, s, except those of one wheel."""
    if not ready.inputs.has_accelerometer:
        return Slips(np.empty(0), np.empty(0))
    slips = find_slips(ready.inputs.t_imu, ready.inputs.f_b, track, f, ready.origin.latitude,
                       rounding(ready.inputs.travel))
    known = (np.abs(slips.t[:, None] - ready.wheel_slips.t) < SPIN_WINDOW).any(axis=1)
    held = (slips.t >= between[0]) & (slips.t <= between[1]) & ~known
    return slips._replace(t=slips.t[held], size=slips.size[held], unforced=slips.unforced[held])
