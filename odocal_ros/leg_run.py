"""One leg on its way through the pipeline: align, propagate, dead reckon, fit, judge."""

from dataclasses import replace

import numpy as np

from odocal_ros.align import align
from odocal_ros.calib.budget import drift_sources
from odocal_ros.calib.check import (
    against_travel,
    fix_noise_factor,
    gyro_against_course,
    mismatch,
    pieces,
    residuals,
    steady,
    track_check,
)
from odocal_ros.calib.drive import judge_drive, not_moving, uncovered
from odocal_ros.calib.judge import judge, nominal_scale
from odocal_ros.calib.marks import fix_at, MARK_WINDOW, MarkFix, standing_at
from odocal_ros.calib.result import LegResult
from odocal_ros.calib.slip import find_slips, slip_reason
from odocal_ros.calib.slow_errors import marks_no_better
from odocal_ros.calib.two_point import Chord, fit, refusal, solve, unsolved
from odocal_ros.fix_screen import origin_amid
from odocal_ros.nav.dead_reckoning import dead_reckon, rough_scale
from odocal_ros.nav.earth import earth_rate_n
from odocal_ros.nav.rotations import matrix_from_quat
from odocal_ros.nav.standstill import standstills
from odocal_ros.nav.strapdown import attitude
from odocal_ros.reasons import Code, Reason
from odocal_ros.screen import imu_gap

EPOCH_RATE = 50.0       # Hz, least rate of attitude epochs
FAR = 20.0              # times the usual distance from the track: an outlier beyond doubt
AT_MARK = 0.05          # s from a mark at which a surveyed point still holds
FEWEST_ROWS = 4         # of the Imu between the marks, for an attitude
TRACK_ROWS = 5000       # of a track kept in a result
WORTH = 0.01            # relative sigma up to which a scale gives the distance


def leg_result(leg, inputs, reasons, methods=None, **more) -> LegResult:
    """Return the result of a leg: its counts, findings and what more there is."""
    between = (inputs.t_fix >= -0.5) & (inputs.t_fix <= inputs.t_stop + 0.5)
    return LegResult(
        start_ns=leg.start_ns, stop_ns=leg.stop_ns, duration=inputs.t_stop,
        distance=more.pop('distance', 0.0), imu_samples=len(inputs.t_imu),
        pulses=len(inputs.travel.t), fixes=int(between.sum()),
        rejected_fixes=inputs.fixes_rejected, reasons=tuple(reasons), methods=methods or {},
        C_bi=inputs.C_bi, **more)


class LegRun:
    """One leg on its way through the pipeline; nothing of it outlives the call."""

    def __init__(self, leg, inputs, config, reasons, alignment, holdout=False):
        self.leg, self.inputs, self.config, self.reasons = leg, inputs, config, reasons
        self.t_fit = inputs.t_stop
        self.holdout = holdout
        self.origin = origin_amid(inputs.t_fix, inputs.geodetic)
        geodetic = inputs.geodetic.copy()
        lost = np.isnan(geodetic[:, 2])
        geodetic[lost, 2] = self.origin.height
        self.fixes_n = self.origin.to_n(geodetic)
        self.fixes_n[lost, 2] = np.nan
        self.fix_sigma = float(np.sqrt(np.median(inputs.covariance_n[:, 0, 0])))
        self.nominal = nominal_scale(config, inputs.scale_unit)
        self.rough = rough_scale(inputs.travel, inputs.t_fix, self.fixes_n,
                                 self.fix_sigma) or self.nominal
        self.alignment = alignment

    def result(self) -> LegResult:
        """Return what the leg gives, however far it carries."""
        inputs = self.inputs
        still = not_moving(inputs.travel, inputs.t_fix, self.fixes_n, self.fix_sigma,
                           inputs.t_stop)
        if still or not self.rough:
            self.reasons += still or [Reason(Code.LEG_TOO_SHORT, 'the fixes move too little for a '
                                             'scale')]
            return leg_result(self.leg, inputs, self.reasons)
        covered = (inputs.t_imu >= 0.0) & (inputs.t_imu <= inputs.t_stop)
        if covered.sum() < FEWEST_ROWS:
            self.reasons += imu_gap(inputs, 0.0, 0.0)
            return leg_result(self.leg, inputs, self.reasons)
        self.reasons += uncovered(inputs.travel, inputs.t_stop)
        self.spans = standstills(inputs.t_imu, inputs.w_b, inputs.travel, self.rough,
                                 self.config.leg.standstill)
        if self.alignment is None:
            self.alignment, why = align(inputs, self.spans, self.rough, self.fixes_n,
                                        self.origin, self.config)
            self.reasons += why
        self.reasons += imu_gap(inputs, min(self.alignment.t, 0.0), self.config.leg.max_gap)
        self.track = self._reckon()
        distance, found = judge_drive(self.track, inputs.t_stop, self.rough, self.config.leg)
        self.reasons += found
        if self.holdout:
            self.t_fit = self._four_fifths()
        chord = self._chord()
        if chord is None:
            return leg_result(self.leg, self.inputs, self.reasons, distance=distance)
        method, more = self._two_point(chord, distance)
        return leg_result(self.leg, self.inputs, self.reasons, {'two_point': method},
                          **{'distance': distance} | more)

    def _say(self, code, text):
        self.reasons.append(Reason(code, text))

    def _reckon(self):
        inputs, a = self.inputs, self.alignment
        pick = (inputs.t_imu >= a.t - 1e-9) & (inputs.t_imu <= inputs.t_stop + 1.0)
        t = inputs.t_imu[pick]
        rate = (len(t) - 1) / max(t[-1] - t[0], 1e-9)
        epochs, q_nb = attitude(t, inputs.w_b[pick] - a.gyro_bias, a.q_nb,
                                earth_rate_n(self.origin.latitude),
                                max(1, int(rate / EPOCH_RATE)))
        return dead_reckon(epochs, q_nb, inputs.travel)

    def _four_fifths(self):
        """Return when four fifths of the distance are driven, s."""
        inside = (self.track.t >= 0) & (self.track.t <= self.inputs.t_stop)
        s = self.track.s[inside]
        way = np.cumsum(np.abs(np.diff(s, prepend=s[:1])))
        return float(self.track.t[inside][np.searchsorted(way, 0.8 * way[-1])])

    def _chord(self):
        """Return the chord between the marks, or None and say why."""
        inputs, config = self.inputs, self.config
        travel = inputs.travel
        ends = (max(0.0, float(self.track.t[0]), float(travel.t[0])),
                min(self.t_fit, float(self.track.t[-1]), float(travel.t[-1])))
        forward = np.array([self.rough, 0.0, 0.0])
        lever_b = np.subtract(config.gnss.lever_arm, config.odometer.lever_arm)
        marks = [self._mark(t, forward, lever_b, self._surveyed(name, t))
                 for t, name in zip(ends, ('start', 'end'), strict=True)]
        for mark, name in zip(marks, ('start', 'end'), strict=True):
            if mark is None:
                self._say(Code.NO_FIX, f'no usable fix at the {name} mark')
        if None in marks:
            return None
        chord = Chord(self.track, self.origin, *marks, lever_b, self._velocity_change(marks),
                      self.alignment, (inputs.doubt_t, inputs.doubt_sigma))
        if not all(m.standing or m.surveyed for m in marks):     # the fit moves with the solution
            if refusal(chord, self.rough):
                return chord
            forward, _ = solve(chord, np.inf)
            marks = [m if m.surveyed else self._mark(m.t, forward, lever_b, ())
                     for m in marks]
            chord = replace(chord, start=marks[0], end=marks[1])
        return chord

    def _surveyed(self, name, t):
        """Return the reference point at a mark, () where the chord does not begin or end there."""
        t_mark = 0.0 if name == 'start' else self.inputs.t_stop
        span = standing_at(t_mark, self.spans)
        if abs(t - t_mark) <= AT_MARK or (span and span == standing_at(t, self.spans)):
            return getattr(self.config.reference, name)
        return ()

    def _mark(self, t, forward, lever_b, surveyed):
        if surveyed:
            position = np.array([np.deg2rad(surveyed[0]), np.deg2rad(surveyed[1]), surveyed[2]])
            return MarkFix(t, self.origin.to_n(position), np.eye(3) * surveyed[3]**2,
                           standing_at(t, self.spans) is not None, 0, 0, surveyed=True)
        here = self.track.at(np.array(t)) @ forward + self.track.C_nb_at(np.array(t)) @ lever_b

        def displacement_n(times):
            return (self.track.at(times) @ forward + self.track.C_nb_at(times) @ lever_b) - here

        inputs = self.inputs
        rhythm = np.median(np.diff(inputs.t_fix)) if len(inputs.t_fix) > 1 else MARK_WINDOW
        return fix_at(t, standing_at(t, self.spans),
                      (inputs.t_fix, self.fixes_n, inputs.covariance_n), displacement_n,
                      self.config.gnss.correlation_time, max(MARK_WINDOW, 2.5 * rhythm))

    def _velocity_change(self, marks):
        """Return C_nb s' at the end mark less that at the start, zero where it stands: (3, 3)."""
        change = np.zeros((3, 3))
        for mark, sign in zip(marks, (-1.0, 1.0), strict=True):
            if not mark.standing:
                low, high = np.clip([mark.t - 0.5, mark.t + 0.5], *self.track.t[[0, -1]])
                rate = np.diff(np.interp([low, high], self.track.t, self.track.s))[0]
                change += sign * self.track.C_nb_at(np.array(mark.t)) * rate / max(
                    high - low, 1e-6)
        return change

    def _two_point(self, chord, distance):
        """Return the method's result and the tracks and checks around it."""
        inputs, config = self.inputs, self.config
        refused = refusal(chord, self.rough)
        if refused:
            return unsolved(refused, inputs.scale_unit), {}
        f, _ = solve(chord, np.inf)
        between = self._between(chord, f)
        fixes = inputs.t_fix[between], self.fixes_n[between]
        before = np.array([self.nominal or self.rough, 0.0, 0.0])

        def strays(f):
            return residuals(self.track, f, chord.start, fixes, chord.lever_b)

        more, factor = {}, np.ones(3)
        if between.sum() >= 3:
            drift_n = self._drift(chord, f)
            drift = float(np.linalg.norm(drift_n))
            residual = strays(f)
            residual[:, 2] = strays(solve(chord)[0])[:, 2]     # the pitch is no noise of heights
            covariance = inputs.covariance_n[between]
            factor = self._noise_factor(residual, covariance, drift, chord)
            chord = self._with_slow_errors(chord, f, fixes[0], residual, covariance, drift_n,
                                           factor[0])
            f, _ = solve(chord, factor[2])
            more = {'before': track_check(strays(before), distance),
                    'after': track_check(strays(f), distance)}
            if self.holdout:
                more |= self._held_out(chord, before, f)
            self._judge_track(chord, f, fixes, residual, more['after'], drift, distance)
        slips = find_slips(inputs.t_imu, inputs.f_b, self.track, f, self.origin.latitude,
                           inputs.travel.quantum)
        held = (slips[0] >= chord.start.t) & (slips[0] <= chord.end.t)
        chord = replace(chord, slips=tuple(x[held] for x in slips))
        self.reasons += slip_reason(*chord.slips)
        method = fit(chord, self.nominal, inputs.scale_unit, inputs.travel.quantum, factor,
                     config)
        if not chord.alignment.heading_separable and chord.M[:2, 0] @ chord.M[:2, 0] > 0 \
                and self.track.s[-1] < self.track.s[0]:
            self._say(Code.ODOMETER_REVERSED, 'the odometer counts down over the leg: positive '
                      'counts mean backwards, or the vehicle was reversed all the way')
        method = replace(method, reasons=method.reasons + judge(
            method.estimates, self.nominal, config))
        step = max(1, len(self.track.t) // TRACK_ROWS)
        P = self.track.P[::step] - self.track.at(chord.start.t)
        scale = method.estimates['scale_factor']
        if scale.sigma < WORTH * scale.value:        # truer than the rough scale
            more['distance'] = distance * scale.value / self.rough
        more |= {'track_n': chord.start.position_n + P @ f,
                 'track_before_n': chord.start.position_n + P @ before,
                 'reference_n': fixes[1],
                 'origin': (self.origin.latitude, self.origin.longitude, self.origin.height)}
        return method, more

    def _between(self, chord, f):
        """Tell which fixes lie between the marks and not absurdly far from the corrected track."""
        inputs = self.inputs
        between = (inputs.t_fix >= chord.start.t) & (inputs.t_fix <= chord.end.t)
        if not between.any():
            return between
        off = np.hypot(*residuals(self.track, f, chord.start,
                                  (inputs.t_fix, self.fixes_n), chord.lever_b)[:, :2].T)
        usual = max(float(np.median(off[between])), self.fix_sigma)
        far = between & (off > FAR * usual)
        if far.any():
            self._say(Code.BAD_ROWS_DROPPED, f'{int(far.sum())} of {int(between.sum())} fixes lie '
                      f'more than {FAR * usual:.0f} m off the track; not used in the check')
        return between & ~far

    def _held_out(self, chord, before, f):
        """Return the check on the last fifth, from a fix at its begin, not used in the fit."""
        inputs = self.inputs
        late = (inputs.t_fix > self.t_fit) & (inputs.t_fix <= inputs.t_stop)
        if late.sum() < 3:
            return {}
        fixes = inputs.t_fix[late], self.fixes_n[late]
        begin = chord.end
        way = np.abs(np.diff(self.track.s[self.track.t >= begin.t])).sum() * self.rough

        return {name: track_check(residuals(self.track, g, begin, fixes, chord.lever_b), way)
                for name, g in (('before', before), ('after', f))}

    def _drift(self, chord, f):
        """Return how far the gyros may bend a track pinned at both ends: (3, k) m, 1 sigma."""
        keep = (self.track.t >= chord.start.t) & (self.track.t <= chord.end.t)
        D = (self.track.P[keep] - self.track.at(chord.start.t)) @ f
        sources = drift_sources(self.track.t[keep], D, matrix_from_quat(self.track.q_nb[keep]),
                                self.alignment)
        # the bow of a pinned track is a quarter of what its free end would stray
        return np.concatenate(list(sources.values()), axis=1) / 4

    def _with_slow_errors(self, chord, f, t, residual, covariance, drift_n, factor):
        """Return the chord with marks no better than the slow part of the fix errors."""
        if not np.isnan(self.config.gnss.correlation_time):
            return chord        # told, not judged
        start, end = marks_no_better(
            (chord.start, chord.end), self.spans, t, self.track.at(t) @ f, chord.M @ f,
            residual / factor, covariance, drift_n / factor)     # in sigmas as stated
        return replace(chord, start=start, end=end)

    def _noise_factor(self, residual, covariance, drift, chord):
        factor = fix_noise_factor(residual, covariance, drift, (chord.start, chord.end))
        if factor.max() > 1.0:
            self._say(Code.FIXES_NOISIER_THAN_SAID, 'the fixes stray from the track '
                      f'{factor[0]:.1f} times (in height {factor[2]:.1f} times) as far as their '
                      'covariance says')
        return factor

    def _judge_track(self, chord, f, fixes, residual, check, drift, distance):
        """Compare the corrected track with the fixes: units, signs, reversing, sanity."""
        t, p = fixes
        track_2d = ((self.track.at(t) - self.track.at(chord.start.t)) @ f)[:, :2]
        keep, sigma = steady(residual, self.fix_sigma)
        middle, direction, course = pieces(track_2d[keep], p[keep, :2], t[keep], sigma)
        C = matrix_from_quat(self.track.q_nb)
        yaw = np.unwrap(np.arctan2(C[:, 1, 0], C[:, 0, 0]))
        found = gyro_against_course(np.interp(middle, self.track.t, yaw), course)
        found += against_travel(direction, course, self.config.odometer.signed)
        self.reasons += found or mismatch(check, self.fix_sigma, drift, distance)
