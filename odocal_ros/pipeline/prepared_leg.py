# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Input and output of the calibration methods, and the comparison of their tracks with the fixes.

``PreparedLeg`` is the input of each method, ``MethodRun`` its output. ``track_results`` compares
the dead-reckoned tracks before and after calibration with the fixes.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from math import nan
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from odocal_ros.calib import track_check
from odocal_ros.calib.evidence import KEPT_ROWS, make_evidence
from odocal_ros.calib.marks import fix_at, MARK_WINDOW, MarkFix, Path, standing_at
from odocal_ros.calib.result import Estimate, MethodResult
from odocal_ros.calib.scale_variation import counter_change_reasons
from odocal_ros.calib.slip import count_size, find_slips, SLIP_WINDOW, Slips, WheelSlips
from odocal_ros.data.arrays import Bools, Floats, map_rows, running_sum
from odocal_ros.data.leg import Leg
from odocal_ros.nav import dead_reckoning
from odocal_ros.nav.alignment import Alignment
from odocal_ros.nav.time_series import integral_at
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.imu_orientation import ImuOrientation
from odocal_ros.screening.inputs import Inputs, LocatedFixes
from odocal_ros.settings.config import Config

# called after each pass of a fit with the number of passes so far, and ``Stage.change``
PassCallback = Callable[[int, float], None]
SHOWN_WITHOUT_DECIMALS = 10.0     # judgement: sigmas, for changes of this size or larger
MIN_TRACK_FIXES = 3    # judgement: least number of fixes for a check of the track


class Paths(NamedTuple):
    """The path as configured and as calibrated; undetermined angles are equal in both."""

    before: Path
    after: Path


class MethodRun(NamedTuple):
    """A method's result and its other findings."""

    result: MethodResult
    paths: Paths | None = None                # None: no estimates
    data_reasons: tuple[Reason, ...] = ()     # on the data, independent of the method
    # 'gnss' or 'odometer' to delay, s, and sigma; None from a method that estimates none
    delays: dict[str, tuple[float, float]] | None = None
    # on slip or delay of the odometer relative to the IMU; None: not checked
    odometer_reasons: tuple[Reason, ...] | None = None


@dataclass(frozen=True)
class Stage:
    """A stage of the work on a leg."""

    name: str = ''         # the running method, or 'tracks'; empty before the first
    done: float = 0.0      # share of the work in earlier stages; that of a fit is unknown
    passes: int = 0        # passes of its fit so far
    change: float = nan    # sigmas, largest change of a constant in the last pass; NaN: none yet

    def as_text(self) -> str:
        """Return the stage as text."""
        if not self.passes:
            return self.name
        decimals = 0 if self.change >= SHOWN_WITHOUT_DECIMALS else 2
        return (f'{self.name}, {self.passes} pass{"es" * (self.passes > 1)} done, remaining '
                f'change {self.change:.{decimals}f} sigma')


@dataclass(frozen=True, eq=False)
class PreparedLeg(LocatedFixes):
    """Input of all methods. They do not change it, so their order has no effect."""

    leg: Leg                             # raw
    inputs: Inputs                       # screened
    config: Config
    imu_orientation: ImuOrientation | None    # None: not determined
    lever_v: NDArray[np.float64]         # (3,) m, from the odometer's point to the antenna
    standstills: NDArray[np.float64]     # (s, 2) s, begin and end
    alignment: Alignment
    alignment_reasons: tuple[Reason, ...]
    epochs: tuple[Floats, Floats]        # attitude after alignment, t (m,) s and q_nb (m, 4)
    track: dead_reckoning.Track          # from these and the mean of the wheels
    wheel_slips: WheelSlips              # of one wheel relative to the other
    metres_per_unit: float               # approximate, until a method estimates a better one
    distance: float                      # m, path length by ``metres_per_unit``
    t_fit: float                         # s, end of the data that a fit uses
    holdout: bool                        # True: fixes after ``t_fit`` check the result
    reasons: tuple[Reason, ...]          # on the leg, for all methods
    end_point_reasons: tuple[Reason, ...]      # for methods that only use its end points

    def path(self, f: Floats, track: dead_reckoning.Track | None = None) -> Path:
        """Return the path of the antenna for f, (3,) scale times forward axis in b."""
        track = self.track if track is None else track
        lever_b = dead_reckoning.axes_from_forward(f) @ self.lever_v

        def path_at(t: Floats) -> Floats:
            path = track.P_at(t) @ f
            return path + track.C_nb_at(t) @ lever_b if np.any(lever_b) else path
        return path_at

    def level_path(self, t: Floats) -> Floats:
        """Return travel along the gyro's heading on level ground, up to a rotation: (n, 2)."""
        inputs, epochs = self.inputs, self.track.t
        turn = integral_at(epochs, inputs.t_imu, map_rows(
            lambda w_b: (w_b - self.alignment.gyro_bias) @ inputs.up_b, inputs.w_b))
        path = dead_reckoning.level_track(self.track.s, turn)
        return np.stack([np.interp(t, epochs, axis) for axis in path.T], -1)

    @property
    def time_span(self) -> tuple[float, float]:
        """Return begin and end of the time that track and odometer cover, s."""
        times = self.track.t, self.inputs.travel.t
        return max(0.0, *(float(t[0]) for t in times)), min(float(t[-1]) for t in times)

    @cached_property
    def path_ratio(self) -> float | None:
        """Return metres per unit of travel from fixes and ``level_path``, None if they stand."""
        t, travel = self.inputs.t_fix, self.inputs.travel
        inside = (t >= max(travel.t[0], self.track.t[0])) & (
            t <= min(travel.t[-1], self.track.t[-1]))
        return dead_reckoning.section_ratio(
            travel.at(t[inside]), self.level_path(t[inside]), self.fixes_n[inside, :2],
            max(self.inputs.min_motion, 8 * self.fix_sigma))

    def path_length_over_time(self) -> tuple[Floats, Floats]:
        """Return times of the track, s, and path length up to them, m."""
        path_length = running_sum(np.abs(np.diff(self.track.s)))
        return self.track.t, path_length * self.metres_per_unit

    def configured_forward(self, f: Floats, estimates: Mapping[str, Estimate]) -> Floats:
        """
        Return f of the settings, (3,) m per unit of travel; without a scale, with the path ratio.

        f : as estimated; its angles are kept if ``estimates`` has no value of them.
        """
        determined = {name for name, e in estimates.items() if e.value is not None}
        angles = [0.0 if name in determined else angle for name, angle in zip(
            ('yaw_mounting_angle', 'pitch_mounting_angle'),
            dead_reckoning.mounting_from_forward(f), strict=True)]
        scale = self.nominal_scale or self.path_ratio or self.rough_scale
        return scale * dead_reckoning.forward_b(*angles)

    def find_inliers(self, path: Path, anchor: MarkFix,
                     selected: Bools) -> tuple[Bools, tuple[Reason, ...]]:
        """
        Return a mask of fixes that are no gross outliers from a fitted path, (k,), and reasons.

        anchor : mark whose position the path is set to.   selected : (k,) fixes that are tested.
        """
        if not selected.any():
            return selected, ()
        fixes = self.inputs.t_fix, self.fixes_n
        residuals = track_check.track_residuals(path, anchor, fixes)
        distances = np.hypot(*residuals[:, :2].T)
        # 20 times the usual distance from the track: a certain outlier
        limit_m = 20.0 * max(float(np.median(distances[selected])), self.fix_sigma)
        is_outlier = distances > limit_m
        count = int((is_outlier & selected).sum())
        return ~is_outlier, (Reason(
            Code.BAD_ROWS_DROPPED, f'{count} of {int(selected.sum())} fixes are more than '
            f'{limit_m:.0f} m from the track; not used in the check',
            'Check the receiver and its sky view, or the localisation.'),) * bool(count)

    def find_slips(self, track: dead_reckoning.Track, f: Floats,
                   interval: tuple[float, float]) -> Slips:
        """Return the slips of the mean wheel in an interval, s, without those of one wheel."""
        if not self.inputs.has_accelerometer:
            return Slips(np.empty(0), np.empty(0))
        slips = find_slips(self.inputs.t_imu, self.inputs.f_b, track, f,
                           self.origin.latitude, count_size(self.inputs.travel))
        is_single_wheel = (np.abs(slips.t[:, None] - self.wheel_slips.t) < SLIP_WINDOW).any(axis=1)
        kept = (slips.t >= interval[0]) & (slips.t <= interval[1]) & ~is_single_wheel
        return Slips(slips.t[kept], slips.size[kept], slips.delay, slips.travel_error_sign[kept])

    def mark(self, t: float, path: Path, name: str = '') -> MarkFix | None:
        """Return the antenna's position at t from fixes or a surveyed mark, None without them."""
        point, span = self._surveyed_point(name, t), standing_at(t, self.standstills)
        if point:
            latitude, longitude, height, sigma = point      # deg, deg, m, m
            position = np.array([np.deg2rad(latitude), np.deg2rad(longitude), height])
            return MarkFix(t, self.origin.to_n(position), np.eye(3) * sigma**2, span is not None,
                           0, surveyed=True)
        inputs, at_mark_n = self.inputs, path(np.array(t))
        interval = np.median(np.diff(inputs.t_fix)) if len(inputs.t_fix) > 1 else MARK_WINDOW
        return fix_at(t, span, (inputs.t_fix, self.fixes_n, inputs.covariance_n),
                      lambda times: path(times) - at_mark_n,
                      self.config.gnss.correlation_time, max(MARK_WINDOW, 2.5 * interval))

    def _surveyed_point(self, name: str, t: float) -> tuple[float, ...]:
        """Return the setting reference.start or .end; () if it does not apply at t."""
        if not name or self.origin.is_local:      # surveyed points are geodetic
            return ()
        t_mark = 0.0 if name == 'start' else self.inputs.t_stop
        span = standing_at(t_mark, self.standstills)
        at_mark = 0.05    # s, largest distance from a mark for its surveyed point
        is_there = abs(t - t_mark) <= at_mark or (
            span and span == standing_at(t, self.standstills))
        point: tuple[float, ...] = getattr(self.config.reference, name)
        return point if is_there else ()


def track_results(prepared: PreparedLeg, paths: Paths) -> tuple[dict[str, Any],
                                                                tuple[Reason, ...]]:
    """Return tracks, checks and evidence of a leg as fields of its result, and reasons."""
    before, after = paths
    start = prepared.mark(prepared.time_span[0], after, 'start')
    if start is None:
        return {}, ()
    t = prepared.track.t[::max(1, len(prepared.track.t) // KEPT_ROWS)]
    fields: dict[str, Any] = {
        name: start.position_n + path(t) - path(np.array(start.t))
        for name, path in (('track_before_n', before), ('track_n', after))}
    if not prepared.origin.is_local:       # else the position on the Earth is unknown
        fields |= {'origin': (prepared.origin.latitude, prepared.origin.longitude,
                              prepared.origin.height)}
    section = _compare(prepared, paths, start)
    fields['reference_n'] = prepared.fixes_n[section.used]
    if not section.residuals:
        return fields, section.reasons
    for name, residuals in zip(('before', 'after'), section.residuals, strict=True):
        fields[name] = track_check.track_statistics(residuals, section.path_length)
    t_fix = prepared.inputs.t_fix[section.used]
    path_lengths = np.interp(t_fix, *prepared.path_length_over_time())
    fields['per_distance'], worse_reasons = track_check.compare_sections(
        path_lengths, section.residuals[0], section.residuals[1], bool(prepared.nominal_scale))
    kept, outlier_reasons = prepared.find_inliers(after, start, section.used)
    evidence = make_evidence(prepared.leg, prepared.inputs, prepared.track, prepared.fixes_n, kept,
                             start, paths, prepared.config, prepared.t_fit, prepared.time_span)
    return fields | {'evidence': evidence}, (
        *section.reasons, *worse_reasons, *outlier_reasons, *counter_change_reasons(
            evidence.sections, evidence.t_fix, evidence.fix_distance))


def path_check(prepared: PreparedLeg, path: Path) -> tuple[dict[str, Any], tuple[Reason, ...]]:
    """Return the check of a method's own path as an entry of its details, and reasons."""
    start = prepared.mark(prepared.time_span[0], path, 'start')
    if start is None:
        return {}, ()
    section = _compare(prepared, [path], start)
    checks = [asdict(track_check.track_statistics(residuals, section.path_length))
              for residuals in section.residuals]
    return {'check': checks[0]} if checks else {}, section.reasons


class Comparison(NamedTuple):
    """Comparison of paths with the fixes of the leg, or of its part that the fit does not use."""

    used: Bools                # (k,) fixes that are compared
    residuals: list[Floats]    # (n, 3) m of each path, minus fixes; empty with too few fixes
    path_length: float         # m
    reasons: tuple[Reason, ...]


def _compare(prepared: PreparedLeg, paths: Sequence[Path], start: MarkFix) -> Comparison:
    """Return the comparison of paths; start: mark at which the last path and the fixes agree."""
    anchor: MarkFix | None = start
    begin, end = start.t, prepared.t_fit
    reasons: tuple[Reason, ...] = ()
    if prepared.holdout:
        anchor = prepared.mark(prepared.t_fit, paths[-1])
        begin, end = prepared.t_fit, prepared.inputs.t_stop
    end = min(end, prepared.time_span[1])
    used = (prepared.inputs.t_fix >= begin) & (prepared.inputs.t_fix <= end)
    residuals = []
    if anchor is not None:
        inside, reasons = prepared.find_inliers(paths[-1], anchor, used)
        used &= inside
        fixes = prepared.inputs.t_fix[used], prepared.fixes_n[used]
        residuals = [track_check.track_residuals(path, anchor, fixes) for path in paths] \
            if used.sum() >= MIN_TRACK_FIXES else []
    begin_m, end_m = np.interp([begin, end], *prepared.path_length_over_time())
    return Comparison(used, residuals, end_m - begin_m, reasons)
