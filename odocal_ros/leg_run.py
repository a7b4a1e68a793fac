"""One leg on its way through the pipeline: align, propagate, dead reckon, fit, judge."""

from dataclasses import replace

import numpy as np

from odocal_ros.align import align
from odocal_ros.calib.budget import drift_sources
from odocal_ros.calib.check import (
    against_travel, fix_noise_factor, gyro_against_course, mismatch, pieces, residuals,
    track_check)
from odocal_ros.calib.judge import judge, nominal_scale
from odocal_ros.calib.marks import fix_at, MarkFix, standing_at
from odocal_ros.calib.result import LegResult
from odocal_ros.calib.two_point import Chord, fit, refusal, solve, unsolved
from odocal_ros.nav.dead_reckoning import dead_reckon, Origin, rough_scale
from odocal_ros.nav.earth import earth_rate_n
from odocal_ros.nav.rotations import matrix_from_quat
from odocal_ros.nav.standstill import standstills
from odocal_ros.nav.strapdown import attitude
from odocal_ros.reasons import Code, Reason
from odocal_ros.screen import imu_gap

EPOCH_RATE = 50.0       # Hz, least rate of attitude epochs
MARK_WINDOW = 1.0       # s, least half-window of fixes about a mark in motion
TRACK_ROWS = 5000       # of a track kept in a result


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
        near = int(np.argmin(np.abs(inputs.t_fix)))
        lat, lon, height = inputs.geodetic[near]
        self.origin = Origin(float(lat), float(lon), float(np.nan_to_num(height)))
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
        if not self.rough:
            self._say(Code.ODOMETER_STILL if self._fixes_move() else Code.LEG_TOO_SHORT,
                      'the odometer does not count' if self._fixes_move() else
                      'the vehicle did not move')
            return leg_result(self.leg, self.inputs, self.reasons)
        self.spans = standstills(self.inputs.t_imu, self.inputs.w_b, self.inputs.travel,
                                 self.rough, self.config.leg.standstill)
        if self.alignment is None:
            self.alignment, why = align(self.inputs, self.spans, self.rough, self.fixes_n,
                                        self.origin, self.config)
            self.reasons += why
        self.reasons += imu_gap(self.inputs, self.alignment.t, self.config.leg.max_gap)
        self.track = self._reckon()
        distance = self._judge_drive()
        if self.holdout:
            self.t_fit = self._four_fifths()
        chord = self._chord()
        if chord is None:
            return leg_result(self.leg, self.inputs, self.reasons, distance=distance)
        method, more = self._two_point(chord, distance)
        return leg_result(self.leg, self.inputs, self.reasons, {'two_point': method},
                       distance=distance, **more)

    def _say(self, code, text):
        self.reasons.append(Reason(code, text))

    def _fixes_move(self):
        spread = np.ptp(self.fixes_n[:, :2], axis=0)
        return bool(np.hypot(*spread) > max(20.0, 10 * self.fix_sigma))

    def _reckon(self):
        inputs, a = self.inputs, self.alignment
        pick = (inputs.t_imu >= a.t - 1e-9) & (inputs.t_imu <= inputs.t_stop + 1.0)
        t = inputs.t_imu[pick]
        rate = (len(t) - 1) / max(t[-1] - t[0], 1e-9)
        epochs, q_nb = attitude(t, inputs.w_b[pick] - a.gyro_bias, a.q_nb,
                                earth_rate_n(self.origin.latitude),
                                max(1, int(rate / EPOCH_RATE)))
        return dead_reckon(epochs, q_nb, inputs.travel)

    def _judge_drive(self):
        """Judge the drive itself; return the distance driven, m, by the rough scale."""
        leg, track = self.config.leg, self.track
        inside = (track.t >= 0) & (track.t <= self.inputs.t_stop)
        step = np.abs(np.diff(track.s[inside])) * self.rough
        dt = np.diff(track.t[inside])
        distance = float(step.sum())
        if distance < leg.min_distance:
            self._say(Code.LEG_TOO_SHORT, f'{distance:.1f} m between the marks, '
                      f'{leg.min_distance:g} m are the least')
        if not len(dt):
            return distance
        top = _top_speed(track, inside, self.rough)
        if top < leg.min_speed:
            self._say(Code.SPEED_TOO_LOW, f'the fastest second was {top:.2f} m/s, '
                      f'{leg.min_speed:g} m/s are asked')
        C = matrix_from_quat(track.q_nb[inside])
        yaw = np.unwrap(np.arctan2(C[:, 1, 0], C[:, 0, 0]))
        turning = np.abs(_rate_1s(track.t[inside], yaw)) > leg.max_yaw_rate
        share = float(step[turning[:-1]].sum() / distance) if distance else 0.0
        if share > 0.1:
            self._say(Code.LEG_NOT_STRAIGHT, f'{100 * share:.0f} % of the distance was driven in '
                      f'turns above {leg.max_yaw_rate:g} rad/s')
        return distance

    def _four_fifths(self):
        """Return when four fifths of the distance are driven, s."""
        inside = (self.track.t >= 0) & (self.track.t <= self.inputs.t_stop)
        s = self.track.s[inside]
        way = np.cumsum(np.abs(np.diff(s, prepend=s[:1])))
        return float(self.track.t[inside][np.searchsorted(way, 0.8 * way[-1])])

    def _chord(self):
        """Return the chord between the marks, or None and say why."""
        inputs, config = self.inputs, self.config
        ends = (max(0.0, float(self.track.t[0])), min(self.t_fit, float(self.track.t[-1])))
        forward = np.array([self.rough, 0.0, 0.0])
        lever_b = np.subtract(config.gnss.lever_arm, config.odometer.lever_arm)
        marks = [self._mark(t, forward, lever_b, getattr(config.reference, name))
                 for t, name in zip(ends, ('start', 'end'), strict=True)]
        for mark, name in zip(marks, ('start', 'end'), strict=True):
            if mark is None:
                self._say(Code.NO_FIX, f'no usable fix at the {name} mark')
        if None in marks:
            return None
        chord = Chord(self.track, self.origin, *marks, lever_b, self._velocity_change(marks),
                      self.alignment)
        if not all(m.standing or m.surveyed for m in marks):     # the fit moves with the solution
            if refusal(chord, self.rough):
                return chord
            forward, _ = solve(chord, np.inf)
            marks = [m if m.surveyed else self._mark(m.t, forward, lever_b, ())
                     for m in marks]
            chord = replace(chord, start=marks[0], end=marks[1])
        return chord

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
            if not (mark.standing or mark.surveyed):
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
        between = (inputs.t_fix >= chord.start.t) & (inputs.t_fix <= chord.end.t)
        fixes = inputs.t_fix[between], self.fixes_n[between]
        before = np.array([self.nominal or self.rough, 0.0, 0.0])

        def antenna_n(times):
            return (self.track.C_nb_at(times) - self.track.C_nb_at(chord.start.t)) \
                @ chord.lever_b

        def strays(f):
            return residuals(self.track, f, chord.start, fixes, antenna_n)

        more, factor = {}, np.ones(3)
        if between.sum() >= 3:
            drift = self._drift(chord, f)
            residual = strays(f)
            residual[:, 2] = strays(solve(chord)[0])[:, 2]     # the pitch is no noise of heights
            factor = self._noise_factor(residual, inputs.covariance_n[between], drift)
            f, _ = solve(chord, factor[2])
            more = {'before': track_check(strays(before), distance),
                    'after': track_check(strays(f), distance)}
            if self.holdout:
                more |= self._held_out(chord, before, f)
            self._judge_track(chord, f, fixes, more['after'], factor[0], drift, distance)
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
        more |= {'track_n': chord.start.position_n + P @ f,
                 'track_before_n': chord.start.position_n + P @ before,
                 'reference_n': fixes[1],
                 'origin': (self.origin.latitude, self.origin.longitude, self.origin.height)}
        return method, more

    def _held_out(self, chord, before, f):
        """Return the check on the last fifth, from a fix at its begin, not used in the fit."""
        inputs = self.inputs
        late = (inputs.t_fix > self.t_fit) & (inputs.t_fix <= inputs.t_stop)
        if late.sum() < 3:
            return {}
        fixes = inputs.t_fix[late], self.fixes_n[late]
        begin = chord.end
        way = np.abs(np.diff(self.track.s[self.track.t >= begin.t])).sum() * self.rough

        def antenna_n(times):
            return (self.track.C_nb_at(times) - self.track.C_nb_at(begin.t)) @ chord.lever_b

        return {name: track_check(residuals(self.track, g, begin, fixes, antenna_n), way)
                for name, g in (('before', before), ('after', f))}

    def _drift(self, chord, f):
        """Return how far the gyros may bend a track that is pinned at both ends, 1 sigma, m."""
        keep = (self.track.t >= chord.start.t) & (self.track.t <= chord.end.t)
        D = (self.track.P[keep] - self.track.at(chord.start.t)) @ f
        sources = drift_sources(self.track.t[keep], D, matrix_from_quat(self.track.q_nb[keep]),
                                self.alignment)
        # the bow of a pinned track is a quarter of what its free end would stray
        return float(np.sqrt(sum((e**2).sum() for e in sources.values()))) / 4

    def _noise_factor(self, residual, covariance, drift):
        factor = fix_noise_factor(residual, covariance, drift)
        if factor.max() > 1.0:
            self._say(Code.FIXES_NOISIER_THAN_SAID, 'the fixes stray from the track '
                      f'{factor[0]:.1f} times (in height {factor[2]:.1f} times) as far as their '
                      'covariance says')
        return factor

    def _judge_track(self, chord, f, fixes, check, factor, drift, distance):
        """Compare the corrected track with the fixes: units, signs, reversing, sanity."""
        t, p = fixes
        track_2d = ((self.track.at(t) - self.track.at(chord.start.t)) @ f)[:, :2]
        middle, direction, course = pieces(track_2d, p[:, :2], t, self.fix_sigma * factor)
        C = matrix_from_quat(self.track.q_nb)
        yaw = np.unwrap(np.arctan2(C[:, 1, 0], C[:, 0, 0]))
        found = gyro_against_course(np.interp(middle, self.track.t, yaw), course)
        found += against_travel(direction, course, self.config.odometer.signed)
        self.reasons += found or mismatch(check, self.fix_sigma, drift, distance)


def _rate_1s(t, x):
    """Return the slope of x over one second about each t."""
    low, high = np.maximum(t - 0.5, t[0]), np.minimum(t + 0.5, t[-1])
    return (np.interp(high, t, x) - np.interp(low, t, x)) / np.maximum(high - low, 1e-6)


def _top_speed(track, inside, metres_per_unit):
    return float(np.abs(_rate_1s(track.t[inside], track.s[inside])).max() * metres_per_unit)
