# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Plot data of a leg for the report: tracks, residuals, speed, scale by section, fixes."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib.drive import rate_over_second
from odocal_ros.calib.marks import MarkFix, Path
from odocal_ros.calib.scale_variation import NO_WINDOWS, Sections, sections, window_scale
from odocal_ros.calib.speed_scale import NO_BINS, speed_scale, SpeedScale
from odocal_ros.data.arrays import Bools, chunks, Complexes, Floats, Ints, map_rows, running_sum
from odocal_ros.data.leg import Leg
from odocal_ros.nav.dead_reckoning import Track
from odocal_ros.nav.rotations import yaw_from_quat
from odocal_ros.nav.time_series import gaps_in_rhythm, gaps_longer
from odocal_ros.screening.clocks import without_clock_steps
from odocal_ros.screening.fix_screen import sigma_limit
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import Config

KEPT_ROWS = 5000       # judgement: of each series, more than a screen has columns


@dataclass(frozen=True, eq=False)
class Evidence:
    """
    Plot data of one leg; t are seconds since the start mark, positions are in n.

    Residuals are dead-reckoned minus fixed positions, along the vehicle's forward axis and left.
    """

    t: Floats                          # (m,) of the track, at most KEPT_ROWS of its epochs
    distance: Floats                   # (m,) m driven since the start mark
    speed: Floats                      # (m,) m/s, below zero when reversing
    yaw_rate: Floats                   # (m,) rad/s, counter-clockwise
    track_n: Floats                    # (m, 3) of the antenna, as calibrated
    track_before_n: Floats             # (m, 3) as configured
    t_fix: Floats                      # (k,)
    fix_distance: Floats               # (k,) m driven
    fix_n: Floats                      # (k, 3) NaN up: none
    fix_sigma: Floats                  # (k,) m, horizontal per axis
    fix_status: Ints                   # (k,) NavSatStatus
    residual: Floats                   # (k, 2) m along, across, as calibrated
    residual_before: Floats            # (k, 2) as configured
    sections: Sections
    t_excluded: Floats                 # (x,) fixes not used
    excluded_because: tuple[str, ...]  # (x,)
    fixes: int                         # number of fixes before decimation
    excluded: int                      # number of fixes not used, before decimation
    gaps: tuple[tuple[str, float, float], ...] = ()  # 'IMU' or 'odometer', begin and end, s
    t_fit: float = np.inf              # later data are held out of the fit
    by_speed: SpeedScale = SpeedScale(NO_BINS)  # of the uncorrected odometer
    by_window: Floats = field(default_factory=lambda: NO_WINDOWS)     # (w, 4) ``window_scale``


def make_evidence(leg: Leg, inputs: Inputs, track: Track, fixes_n: Floats, kept: Bools,
                  anchor: MarkFix, paths: tuple[Path, Path], config: Config, t_fit: float = np.inf,
                  odometer_span: tuple[float, float] = (0.0, np.inf)) -> Evidence:
    """
    Return the plot data of a leg, at most KEPT_ROWS of each series.

    leg, inputs : raw and screened.   fixes_n : (k, 3) m, at inputs.t_fix.   kept : (k,) fixes
    without gross errors; those within the time of the track are shown.   anchor : mark whose
    position the paths are set to.   paths : as configured and as calibrated.   t_fit : end of the
    fitted data, s.   odometer_span : begin and end of the time with an odometer, s.
    """
    inside = (track.t >= odometer_span[0]) & (track.t <= min(inputs.t_stop, odometer_span[1]))
    t = track.t[inside]
    span = (t[0], t[-1]) if len(t) else (0.0, -1.0)
    kept = kept & (inputs.t_fix >= span[0]) & (inputs.t_fix <= span[1])
    t_fix, fix_n, covariance = inputs.t_fix[kept], fixes_n[kept], inputs.covariance_n[kept]
    before, after = (_anchored_path(path, anchor) for path in paths)
    after_n, fixed_n = after(t), after(t_fix)
    yaw = np.unwrap(map_rows(yaw_from_quat, track.q_nb[inside]))
    sign = np.where(rate_over_second(t, track.s[inside]) < 0, -1.0, 1.0)
    distance = running_sum(np.hypot(*np.diff(after_n[:, :2], axis=0).T))[:len(t)]
    forward = _forward_directions(t_fix, t, after_n, sign)
    fix_distance = np.interp(t_fix, t, distance)
    sigma = np.sqrt((covariance[:, 0, 0] + covariance[:, 1, 1]) / 2)
    status, t_excluded, causes = _fix_states(leg, inputs, kept, span, config)

    # shown rows of track, fixes and excluded fixes
    m, k, x = (_decimated_rows(n) for n in (len(t), len(t_fix), len(causes)))
    return Evidence(
        t=t[m], distance=distance[m], speed=(rate_over_second(t, distance) * sign)[m],
        yaw_rate=rate_over_second(t, yaw)[m], track_n=after_n[m], track_before_n=before(t[m]),
        t_fix=t_fix[k], fix_distance=fix_distance[k], fix_n=fix_n[k], fix_sigma=sigma[k],
        fix_status=status[k], residual=_along_and_across(fixed_n - fix_n, forward)[k],
        residual_before=_along_and_across(before(t_fix) - fix_n, forward)[k],
        sections=sections(fix_distance, fixed_n, fix_n, sigma),
        t_excluded=t_excluded[x], excluded_because=tuple(causes[i] for i in x),
        fixes=len(t_fix), excluded=len(causes), gaps=_gaps(inputs, span, config),
        t_fit=t_fit, by_speed=speed_scale(
            t_fix, fix_n, fixed_n, fix_distance, inputs.travel),
        by_window=window_scale(t_fix, fix_n, fixed_n))


def _gaps(inputs: Inputs, span: tuple[float, float],
          config: Config) -> tuple[tuple[str, float, float], ...]:
    """Return the gaps of IMU and odometer while the vehicle moves: (which, begin, end)."""
    travel = inputs.travel
    gaps = [('IMU', *gap) for gap in gaps_longer(inputs.t_imu, config.leg.max_gap).tolist()]
    gaps += [('odometer', begin, end) for begin, end in gaps_in_rhythm(travel.t).tolist()
             if travel.at(begin) != travel.at(end)]      # some counters send nothing at rest
    return tuple(gap for gap in gaps if gap[1] < span[1] and gap[2] > span[0])


def _anchored_path(path: Path, anchor: MarkFix) -> Path:
    """Return a path shifted so that it has the position of a mark at the time of the mark."""
    at_mark = path(np.array(anchor.t))

    def anchored(t: Floats) -> Floats:
        positions = np.empty((len(t), 3))
        for rows in chunks(len(t)):       # a path needs a 3 x 3 matrix for each row
            positions[rows] = anchor.position_n + path(t[rows]) - at_mark
        return positions
    return anchored


def _fix_states(leg: Leg, inputs: Inputs, kept: Bools, span: tuple[float, float],
                config: Config) -> tuple[Ints, NDArray[Any], list[str]]:
    """Return the status of kept fixes, the times of the others, and why those are excluded."""
    leg, _ = without_clock_steps(leg)      # as in the screening: inputs have these stamps
    fix, gnss = leg.fix, config.gnss
    offset = gnss.time_offset - config.imu.time_offset
    t = np.asarray(fix.stamp_ns - leg.start_ns) * 1e-9 + offset
    is_excluded = (t >= span[0]) & (t <= span[1])
    row_at = {time: row for row, time in enumerate(t.tolist())}
    rows = np.array([row_at[time] for time in inputs.t_fix[kept].tolist()], int)
    is_excluded[rows] = False
    usable = np.isin(t, inputs.t_fix)
    sigma = np.sqrt(fix.covariance_n[:, :2, :2].diagonal(axis1=1, axis2=2).max(axis=1, initial=0))
    limit = sigma_limit(sigma[fix.status >= gnss.min_status], gnss.max_sigma)
    excluded = np.flatnonzero(is_excluded)
    causes = [
        f'status below {gnss.min_status}' if fix.status[row] < gnss.min_status else
        f'sigma above {limit:.3g} m' if limit < sigma[row] else
        'far off the track' if usable[row] and row_at[t[row]] == row else
        'implausible stamp or position' for row in excluded]
    status: Ints = fix.status[rows]
    return status, t[excluded], causes


def _forward_directions(t_new: Floats, t: Floats, track_n: Floats, sign: Floats) -> Complexes:
    """Return the forward direction at times t_new as complex numbers; at rest the last: (k,)."""
    velocity = (rate_over_second(t, track_n[:, 0])
                + 1j * rate_over_second(t, track_n[:, 1])) * sign
    # below 0.2 m/s noise of the track (rounding to counts) dominates the direction
    moving = np.flatnonzero(np.abs(velocity) > 0.2)
    if not len(moving):
        return np.ones(len(t_new), complex)
    last_moving = np.searchsorted(moving, np.arange(len(t)), side='right') - 1
    angle = np.unwrap(np.angle(velocity[moving[np.maximum(last_moving, 0)]]))
    return np.asarray(np.exp(1j * np.interp(t_new, t, angle)))


def _along_and_across(offset_n: Floats, forward: Complexes) -> Floats:
    """Return horizontal offsets, (k, 3) in n, as components forward and left: (k, 2)."""
    rotated = (offset_n[:, 0] + 1j * offset_n[:, 1]) * np.conj(forward)
    return np.stack([rotated.real, rotated.imag], -1)


def _decimated_rows(n: int) -> Ints:
    """Return at most KEPT_ROWS row numbers, first and last included."""
    return np.unique(np.linspace(0, n - 1, min(n, KEPT_ROWS)).round().astype(int)) if n else \
        np.empty(0, int)
