# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The two-point method on one leg: its marks, its chord, and the checks of its track."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from odocal_ros.calib import reversals, track_check
from odocal_ros.calib.budget import drift_sources
from odocal_ros.calib.drive import fix_white_noise
from odocal_ros.calib.marks import MarkFix, marks_with_slow_errors
from odocal_ros.calib.slip import slip_reasons
from odocal_ros.calib.two_point import (
    fit,
    refusal_reasons,
    refused_result,
    solve,
    solve_level,
    TwoPointInput,
)
from odocal_ros.calib.value_limits import check_limits
from odocal_ros.data.arrays import Bools, Floats
from odocal_ros.pipeline.prepared_leg import MethodRun, PassCallback, Paths, PreparedLeg
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.imu_orientation import corrected_forward_axis


def two_point(prepared: PreparedLeg, report_pass: PassCallback | None = None) -> MethodRun:
    """Run the two-point method on a leg; it is not iterative."""
    return TwoPointRun(prepared).result()


class TwoPointRun:
    """
    One run of the method on a leg; collects its reasons.

    f : (3,) scale factor times the forward axis in b.   factor : (3,) factors on the stated sigmas
    of the fixes.   reasons : on the method.   data_reasons : on the inputs.
    """

    def __init__(self, prepared: PreparedLeg) -> None:
        self.prepared, self.inputs = prepared, prepared.inputs
        self.config, self.track = prepared.config, prepared.track
        self.reasons: list[Reason] = []
        self.data_reasons: list[Reason] = []
        self.slip_reasons: tuple[Reason, ...] = ()

    def result(self) -> MethodRun:
        """Return the method's result, the paths before and after, and the reasons."""
        two_point = self._input()
        refused = tuple(self.reasons) if two_point is None else refusal_reasons(
            two_point, self.prepared.rough_scale)
        if two_point is None or refused:
            return MethodRun(refused_result(refused, self.inputs.scale_unit),
                             data_reasons=tuple(self.data_reasons))
        f = solve_level(two_point)
        t_fix = self.inputs.t_fix
        between = (t_fix >= two_point.start.t) & (t_fix <= two_point.end.t)
        is_inlier, outlier_reasons = self.prepared.find_inliers(
            self.prepared.path(f), two_point.start, between)
        between &= is_inlier
        self.data_reasons += outlier_reasons
        factor = np.ones(3)
        if between.sum() >= 3:
            two_point, factor = self._fit_noise(two_point, f, between)
        f, _ = solve(two_point, up_scale=factor[2])
        two_point = replace(two_point, slips=self._find_slips(two_point, f))
        method = fit(two_point, self.prepared.nominal_scale, self.inputs.scale_unit,
                     self.inputs.travel.quantum, factor, self.config)
        self._check_counting_direction(two_point)
        method = replace(method, reasons=(*method.reasons, *self.reasons, *check_limits(
            method.estimates, self.prepared.nominal_scale, self.config)))
        f = method.details['f']
        paths = Paths(*map(self.prepared.path,
                           (self.prepared.configured_forward(f, method.estimates), f)))
        return MethodRun(method, paths, tuple(self.data_reasons),
                         odometer_reasons=self.slip_reasons)

    def _find_slips(self, two_point: TwoPointInput, f: Floats) -> tuple[Floats, Floats]:
        """Return times, s, and sizes, m, of slips of the mean wheel; set ``slip_reasons``."""
        if not self.inputs.has_accelerometer:
            return np.empty(0), np.empty(0)
        ends = two_point.start.t, two_point.end.t
        forward = corrected_forward_axis(self.prepared.imu_orientation, f)
        slips = self.prepared.find_slips(self.track, forward, ends)
        self.slip_reasons = slip_reasons(slips, self.config.odometer.time_offset)
        wheel_slips = self.prepared.wheel_slips      # of single wheels: 1 / count in the mean
        inside = (wheel_slips.t >= ends[0]) & (wheel_slips.t <= ends[1])
        return (np.append(slips.t, wheel_slips.t[inside]),
                np.append(slips.size, wheel_slips.size[inside] / wheel_slips.count))

    def _input(self) -> TwoPointInput | None:
        """Return track and marks; None, with a reason, without fixes."""
        prepared, track = self.prepared, self.track
        path = prepared.path(np.array([prepared.rough_scale, 0.0, 0.0]))
        start = prepared.mark(prepared.time_span[0], path, 'start')
        end = prepared.mark(min(prepared.t_fit, prepared.time_span[1]), path, 'end')
        self.reasons += [Reason(Code.NO_FIX, f'no usable fix at the {name} mark')
                         for name, mark in (('start', start), ('end', end)) if mark is None]
        if start is None or end is None:
            return None
        two_point = TwoPointInput(
            track, start, end, prepared.lever_v, self._velocity_change((start, end)),
            prepared.alignment,
            (self.inputs.uncertain_t, self.inputs.uncertain_sigma))
        exact = all(m.standing or m.surveyed for m in (start, end))
        if exact or refusal_reasons(two_point, prepared.rough_scale):
            return two_point
        # marks in motion depend on the solution
        path = prepared.path(solve_level(two_point))
        return replace(two_point, start=prepared.mark(start.t, path, 'start') or start,
                       end=prepared.mark(end.t, path, 'end') or end)

    def _velocity_change(self, marks: Sequence[MarkFix]) -> Floats:
        """Return C_nb s' at the end mark minus that at the start, zero at rest: (3, 3)."""
        change = np.zeros((3, 3))
        for mark, sign in zip(marks, (-1.0, 1.0), strict=True):
            if not mark.standing:
                low, high = np.clip([mark.t - 0.5, mark.t + 0.5], *self.track.t[[0, -1]])
                rate = np.diff(np.interp([low, high], self.track.t, self.track.s))[0]
                change += sign * self.track.C_nb_at(np.array(mark.t)) * rate / max(
                    high - low, 1e-6)
        return change

    def _fit_noise(self, two_point: TwoPointInput, f: Floats,
                   between: Bools) -> tuple[TwoPointInput, Floats]:
        """Return the input with realistic marks, the factor on fix sigmas; check the track."""
        prepared = self.prepared
        fixes = self.inputs.t_fix[between], prepared.fixes_n[between]
        drift_n = self._drift(two_point, f)
        drift = float(np.linalg.norm(drift_n))
        residual = track_check.track_residuals(prepared.path(f), two_point.start, fixes)
        up = track_check.track_residuals(prepared.path(solve(two_point)[0]), two_point.start,
                                         fixes)
        residual[:, 2] = up[:, 2]              # without the error of the pitch
        covariance = self.inputs.covariance_n[between]
        factor = track_check.fix_noise_factor(residual, covariance, drift,
                                              (two_point.start, two_point.end))
        if factor.max() > 1.0:
            distance_rms = float(np.sqrt((residual[:, :2]**2).sum(axis=1).mean()))
            self.reasons.append(Reason(
                Code.FIXES_NOISIER_THAN_SAID, f'the fixes are {distance_rms:.1f} m (rms) from the '
                f'dead-reckoned track, {factor[0]:.1f} times (in height {factor[2]:.1f} times) as '
                'much as their covariance states. Likely cause: time-correlated fix errors, or '
                'gyro errors that accumulate along the track', 'Use the smoother, which estimates '
                'both, or a shorter leg. Uncertainties were increased to match the residuals.'))
        if np.isnan(self.config.gnss.correlation_time):     # else configured
            start, end = marks_with_slow_errors(
                (two_point.start, two_point.end), prepared.standstills, fixes[0],
                self.track.P_at(fixes[0]) @ f, two_point.M @ f, residual / factor[0], covariance,
                drift_n / factor[0])
            two_point = replace(two_point, start=start, end=end)
        f, _ = solve(two_point, up_scale=factor[2])
        self._check_track(two_point, f, fixes, residual, drift)
        return two_point, factor

    def _drift(self, two_point: TwoPointInput, f: Floats) -> Floats:
        """Return the bend of a track, fixed at both ends, by gyro errors: (3, k) m, 1 sigma."""
        rows = self.track.rows_between(two_point.start.t, two_point.end.t)
        D = self.track.displacement(rows, two_point.start.t, f)
        sources = drift_sources(self.track.t[rows], D, self.track.q_nb[rows],
                                self.prepared.alignment)
        # the bow of a track fixed at both ends is a quarter of the drift of a free end
        return np.concatenate(list(sources.values()), axis=1) / 4

    def _check_track(self, two_point: TwoPointInput, f: Floats, fixes: tuple[Floats, Floats],
                     residual: Floats, drift: float) -> None:
        """Collect the reasons against the track: reversing, distance from the fixes, bend."""
        prepared, (t, position_n) = self.prepared, fixes
        # track errors count as noise
        keep, _ = track_check.find_inliers(residual, prepared.fix_sigma)
        sigma = max(prepared.fix_sigma, fix_white_noise(position_n[keep]))
        sections = reversals.cut_sections(
            prepared.level_path(t[keep]), position_n[keep, :2], t[keep], sigma)
        reversed_reasons = reversals.reversal_reasons(sections, self.config.odometer.signed)
        self.data_reasons += reversed_reasons
        if reversed_reasons:
            return
        residuals = track_check.track_residuals(prepared.path(f), two_point.start, fixes)
        limits = prepared.fix_sigma, drift, prepared.distance
        distance_reasons = track_check.distance_reasons(
            track_check.track_statistics(residuals, prepared.distance), *limits)
        self.reasons += distance_reasons
        if not distance_reasons:
            self.reasons += track_check.bend_reasons(t, residuals, two_point.M @ f, *limits)

    def _check_counting_direction(self, two_point: TwoPointInput) -> None:
        """Add the reason for an odometer that counts down without a known IMU orientation."""
        counts_down = self.track.s[-1] < self.track.s[0]
        if (counts_down and self.prepared.imu_orientation is None
                and not two_point.alignment.heading_separable):
            self.data_reasons.append(Reason(
                Code.ODOMETER_REVERSED, 'the odometer counts down over the leg: positive counts '
                'mean reverse motion, or the vehicle reversed during the whole leg'))
