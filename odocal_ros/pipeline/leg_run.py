"""One leg on its way through the pipeline: align, propagate, dead reckon, each method, check."""

from dataclasses import replace
from functools import cached_property

import numpy as np

from odocal_ros.calib.agreement import disagreements
from odocal_ros.calib.choice import choose, deciding, passed_over
from odocal_ros.calib.drive import judge_drive, not_moving, uncovered, way_and_chord
from odocal_ros.calib.judge import nominal_scale
from odocal_ros.calib.marks import fix_at, MARK_WINDOW, MarkFix, standing_at
from odocal_ros.calib.mounting import with_axes
from odocal_ros.calib.result import LegResult
from odocal_ros.calib.turning import gyro_reasons, turn_ratio
from odocal_ros.calib.wheels.slips import NO_SLIPS, wheel_faults
from odocal_ros.data.samples import let_go
from odocal_ros.nav.dead_reckoning import dead_reckon, rough_scale
from odocal_ros.nav.earth import earth_rate_n
from odocal_ros.nav.integral import by_row, medians
from odocal_ros.nav.standstill import standstills
from odocal_ros.nav.strapdown import attitude
from odocal_ros.pipeline.align import align
from odocal_ros.pipeline.coarse_odometer import coarse_reasons
from odocal_ros.pipeline.methods import METHODS, run_method
from odocal_ros.pipeline.tracks import check_of, tracks
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.facing import axes_reasons, facing
from odocal_ros.screening.fix_screen import origin_amid
from odocal_ros.screening.screen import imu_gap

# methods that begin with the alignment: what it had to say is said of them
ALIGNED = ('two_point', 'wheels')
EPOCH_RATE = 50.0       # Hz, least rate of attitude epochs
FEWEST_ROWS = 4         # of the Imu between the marks, for an attitude
BROKEN = {Code.WHEEL_DEAD, Code.WHEEL_REVERSED}
BY_SCALE = {Code.LEG_TOO_SHORT, Code.SPEED_TOO_LOW}     # what is judged in metres
AT_MARK = 0.05          # s from a mark at which a surveyed point still holds
WORTH = 0.05            # relative sigma up to which a scale gives the distance
# of the time that methods take, and of the tracks after them
EFFORT = {'two_point': 1, 'wheels': 8, 'smoother': 20}
TRACKS = 2
USUAL_PASSES = 6.0      # of a fit, in which it comes to two thirds of its way: 10 are usual


def leg_result(leg, inputs, reasons, methods=None, **more) -> LegResult:
    """Return the result of a leg: its counts, findings and what more there is."""
    between = (inputs.t_fix >= -0.5) & (inputs.t_fix <= inputs.t_stop + 0.5)
    if 'distance' not in more:
        more['distance'] = _way_of(inputs.t_fix[between], inputs.geodetic[between])
    return LegResult(
        start_ns=leg.start_ns, stop_ns=leg.stop_ns, duration=inputs.t_stop,
        imu_samples=len(inputs.t_imu),
        pulses=len(inputs.travel.t), fixes=int(between.sum()),
        rejected_fixes=inputs.fixes_rejected, reasons=tuple(reasons), methods=methods or {},
        C_bi=inputs.C_bi, **more)


def _way_of(t_fix, geodetic):
    """Return the way by the fixes, m: what is known of a leg that is refused."""
    if not len(t_fix):
        return 0.0
    fixes_n = origin_amid(t_fix, geodetic).to_n(np.nan_to_num(geodetic))
    return way_and_chord(t_fix, fixes_n)[0]


class LegRun:
    """
    One leg on its way through the pipeline; nothing of it outlives the call.

    What methods read: leg, inputs, config, origin, fixes_n (k, 3) m, fix_sigma m, nominal and
    rough (scale, 0 or None unknown), lever_b (3,) m, spans (standstills), alignment, track,
    distance m, t_fit s (fixes after it are held out), facing (of the Imu, None unseen);
    ``reasons`` takes what they find of the data, ``progress(share, stage)`` how far they are.
    """

    def __init__(self, leg, inputs, config, reasons, alignment, holdout=False):
        self.leg, self.inputs, self.config, self.reasons = leg, inputs, config, reasons
        self.t_fit = inputs.t_stop
        self.holdout = holdout
        self.progress = lambda share, stage: None
        self._part = 0.0, 0.0, ''       # where the method at work begins, what it takes, its name
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
        self.metres_per_unit = self.rough       # until a method knows it better
        self.alignment, self.about_alignment, self.of_ends = alignment, (), ()
        self.facing = None
        self.lever_b = np.subtract(config.gnss.lever_arm, config.odometer.lever_arm)

    def result(self) -> LegResult:
        """Return what the leg gives, however far it carries."""
        if not self.examine():
            return leg_result(self.leg, self.inputs, self.reasons)
        methods, paths = {}, {}
        asked = self._asked()
        whole, done = sum(EFFORT[name] for name in asked) + TRACKS, 0.0
        for name in asked:
            self._part = done, EFFORT[name] / whole, name
            self.progress(done, name)
            done += EFFORT[name] / whole
            let_go(*vars(self.leg.imu).values())
            method, paths[name] = run_method(name, self)
            about = self.about_alignment if name in ALIGNED else ()
            about += self.of_ends if name == 'two_point' else ()
            methods[name] = replace(method, reasons=(*about, *method.reasons))
        self.progress(done, 'tracks')
        self.reasons += disagreements(methods)
        self.reasons += passed_over(methods, self.config.method, {r.code for r in self.reasons})
        estimates, _ = choose(methods, self.config.method)
        scale = estimates.get('scale_factor')
        if scale is None or paths.get(scale.method) is None:
            return leg_result(self.leg, self.inputs, self.reasons, methods,
                              distance=self.distance, deciding=deciding(self.config.method))
        if scale.value and scale.sigma < WORTH * scale.value:        # truer than the rough scale
            self._judge_by(scale.value)
        shown = tracks(self, paths[scale.method])
        methods = {name: m if path is None else replace(
            m, details=m.details | check_of(self, path.after))
            for (name, m), path in zip(methods.items(), paths.values(), strict=True)}
        return leg_result(self.leg, self.inputs, self.reasons, methods,
                          distance=self.distance, deciding=deciding(self.config.method), **shown)

    def passed(self, passes: int) -> None:
        """Tell that a method has made so many passes of as many as it takes."""
        begin, width, name = self._part
        self.progress(begin + width * (1 - float(np.exp(-passes / USUAL_PASSES))), name)

    def examine(self) -> bool:
        """Say all of the leg that needs no method; return whether methods can be run."""
        let_go(*vars(self.leg.imu).values())
        if not (self._moves() and self._faces_forward() and self._turns_with_course()):
            return False
        self._prepare()
        return True

    def _asked(self):
        """Return the methods to run: those asked for, of auto those that the leg can carry."""
        wanted = deciding(self.config.method, shown=True)
        # without an accelerometer it serves one counter too
        one_counter = (self.inputs.travel_right is None and self.inputs.felt
                       and self.config.method == 'auto')
        return [name for name in METHODS if name in wanted
                and not (name == 'wheels' and one_counter)]

    def path(self, f, track=None):
        """Return the path of the antenna, t (n,) to (n, 3) m but for a constant, for f = K d."""
        track = self.track if track is None else track

        def at(t):
            path = track.at(t) @ f
            return path + track.C_nb_at(t) @ self.lever_b if np.any(self.lever_b) else path
        return at

    def mark(self, t, path, name=''):
        """
        Return the antenna's position at t, None without any.

        By the fixes about it, or the surveyed point of the mark 'start' or 'end'.
        """
        point = self._surveyed(name, t)
        if point:
            position = np.array([np.deg2rad(point[0]), np.deg2rad(point[1]), point[2]])
            return MarkFix(t, self.origin.to_n(position), np.eye(3) * point[3]**2,
                           standing_at(t, self.spans) is not None, 0, 0, surveyed=True)
        inputs, here = self.inputs, path(np.array(t))
        rhythm = np.median(np.diff(inputs.t_fix)) if len(inputs.t_fix) > 1 else MARK_WINDOW
        return fix_at(t, standing_at(t, self.spans),
                      (inputs.t_fix, self.fixes_n, inputs.covariance_n),
                      lambda times: path(times) - here,
                      self.config.gnss.correlation_time, max(MARK_WINDOW, 2.5 * rhythm))

    def _surveyed(self, name, t):
        """Return the reference point at a mark, () where the way does not begin or end there."""
        if not name:
            return ()
        t_mark = 0.0 if name == 'start' else self.inputs.t_stop
        span = standing_at(t_mark, self.spans)
        if abs(t - t_mark) <= AT_MARK or (span and span == standing_at(t, self.spans)):
            return getattr(self.config.reference, name)
        return ()

    def _moves(self):
        """Tell whether there is a drive to speak of, and say what is not."""
        inputs = self.inputs
        still = not_moving(inputs.travel, inputs.t_fix, self.fixes_n, self.fix_sigma,
                           inputs.t_stop)
        if still or not self.rough:
            self.reasons += still or [Reason(Code.LEG_TOO_SHORT, 'the fixes move too little for a '
                                             'scale')]
            return False
        covered = (inputs.t_imu >= 0.0) & (inputs.t_imu <= inputs.t_stop)
        if covered.sum() < FEWEST_ROWS:
            self.reasons += imu_gap(inputs.t_imu, 0.0, inputs.t_stop, 0.0)
            return False
        self.reasons += uncovered(inputs.travel, inputs.t_stop)
        return True

    def _faces_forward(self):
        """Tell whether the body frame is near enough to forward-left-up, and say where not."""
        inputs = self.inputs
        if inputs.felt:
            self.facing = facing(inputs.t_imu, inputs.w_b, inputs.f_b, inputs.travel, self.rough)
        found = axes_reasons(self.facing, self.config.imu.nominal_yaw)
        self.reasons += with_axes(found, inputs)
        return Code.IMU_AXES not in {r.code for r in found}

    def _turns_with_course(self):
        """Tell whether the gyro turns with the course of the fixes, and say how where not."""
        inputs = self.inputs
        up_b = medians(inputs.f_b)
        up_b /= np.linalg.norm(up_b)
        ratio = turn_ratio(inputs.t_imu, by_row(lambda w_b: w_b @ up_b, inputs.w_b),
                           inputs.t_fix, self.fixes_n, self.fix_sigma)
        found = gyro_reasons(ratio, self.config.imu.gyro_scale)
        self.reasons += found
        return not found

    def _prepare(self):
        """Align, reckon and judge the drive."""
        inputs, config = self.inputs, self.config
        self.spans = standstills(inputs.t_imu, inputs.w_b, inputs.travel, self.rough,
                                 config.leg.standstill)
        if self.alignment is None:
            self.alignment, self.about_alignment = align(
                inputs, self.spans, self.rough, self.fixes_n, self.origin, config)
        let_go(*vars(self.leg.imu).values())
        self.reasons += imu_gap(inputs.t_imu, min(self.alignment.t, 0.0), inputs.t_stop,
                                config.leg.max_gap)
        self.track = self.reckon(inputs.travel)
        self.reasons += coarse_reasons(self)
        self.wheel_slips = self._faults()
        self.distance, found = judge_drive(self.track, inputs.t_stop, self.rough, config.leg)
        # turns are what the others live on
        self.of_ends = tuple(r for r in found if r.code is Code.LEG_NOT_STRAIGHT)
        self.reasons += [r for r in found if r not in self.of_ends]
        if self.holdout:
            self.t_fit = self._four_fifths()

    def _judge_by(self, scale):
        """Judge way and speed by a scale that is known better than the rough one."""
        self.metres_per_unit = scale
        self.distance, found = judge_drive(self.track, self.inputs.t_stop, scale, self.config.leg)
        self.reasons = [r for r in self.reasons if r.code not in BY_SCALE] + [
            r for r in found if r.code in BY_SCALE]

    def _faults(self):
        """Say what is wrong with two wheels beside each other; return where one slipped."""
        inputs, odometer = self.inputs, self.config.odometer
        unseen = inputs.travel_right is None or not inputs.felt
        if unseen or BROKEN & {r.code for r in self.reasons}:
            return NO_SLIPS
        found, slips = wheel_faults(
            inputs.travel_left, inputs.travel_right, (inputs.t_imu, inputs.w_b, inputs.f_b),
            (0.0, inputs.t_stop), self.track, self.origin.latitude, self.rough,
            odometer.track_width, inputs.doubt_t, odometer.max_scale_deviation)
        self.reasons += found
        return slips

    def reckon(self, travel):
        """Return the track of a travel (of the mean of the wheels, or of one) as aligned."""
        return dead_reckon(*self.epochs, travel)

    @cached_property
    def epochs(self):
        """Return the attitude through the leg as aligned: t (m,) s, q_nb (m, 4)."""
        return self.attitude_from(self.alignment.t, self.alignment.q_nb, self.alignment.gyro_bias)

    def attitude_from(self, t_begin, q_nb, gyro_bias):
        """Return the attitude from a time, s, on: t (m,) s, q_nb (m, 4); bias in b, rad/s."""
        inputs = self.inputs
        rows = slice(np.searchsorted(inputs.t_imu, t_begin - 1e-9),
                     np.searchsorted(inputs.t_imu, inputs.t_stop + 1.0, side='right'))
        t = inputs.t_imu[rows]
        rate = (len(t) - 1) / max(t[-1] - t[0], 1e-9)
        return attitude(t, inputs.w_b[rows], q_nb, earth_rate_n(self.origin.latitude),
                        max(1, int(rate / EPOCH_RATE)), gyro_bias)

    def _four_fifths(self):
        """Return when four fifths of the distance are driven, s."""
        inside = (self.track.t >= 0) & (self.track.t <= self.inputs.t_stop)
        s = self.track.s[inside]
        way = np.cumsum(np.abs(np.diff(s, prepend=s[:1])))
        return float(self.track.t[inside][np.searchsorted(way, 0.8 * way[-1])])
