"""A leg made ready for the smoother: keyframes, priors, first noise levels, sums over samples."""

from dataclasses import dataclass

import numpy as np

from odocal_ros.calib.sanity import G
from odocal_ros.calib.smoother.equations import Priors
from odocal_ros.calib.smoother.fixes import whitener
from odocal_ros.calib.smoother.leg import SmootherLeg
from odocal_ros.calib.smoother.noise import Levels
from odocal_ros.calib.smoother.outside_rows import first_values, used
from odocal_ros.calib.smoother.preintegrate import ImuRows, Intervals, Points, preintegrate
from odocal_ros.calib.smoother.slide import least_slide, SIDEWAYS, turned
from odocal_ros.calib.smoother.start import standing
from odocal_ros.calib.smoother.state import (
    ACCEL,
    ACCEL_AXIS,
    ACCEL_SIGNAL,
    GNSS_ARM,
    GNSS_DELAY,
    GYRO,
    GYRO_AXIS,
    GYRO_SCALE,
    GYRO_SIGNAL,
    HEADING,
    IMPERFECT,
    M,
    ODO_ARM,
    ODO_DELAY,
    State,
)
from odocal_ros.grades import grade_of

# how near to the last pass over the samples a state must lie to do without another: first order
# leaves out 5e-9 rad/s, 3 mm of a counter's steps (they are not smooth), 10 um of a fix
NEAR_GYRO, NEAR_ACCEL, NEAR_FORWARD = 1e-4, 1e-2, 1e-3       # rad/s, m/s^2, 1
NEAR_ODO_TIME, NEAR_GNSS_TIME = 3e-4, 3e-3                   # s
LEAST_REST = 15      # second differences over 1 s at rest, to know a noise by
SPACING = 1.0        # s between keyframes
ROAD = 0.01          # m/sqrt(s), what slip and slide are believed to be at first
LEAST_ROAD = 2e-4    # m/sqrt(s) along
LEAST_FIX = 0.005    # m
# noises of the Imu, a tenth of navigation grade: settings may say 0, and an Imu with a dead band
# (or a simulator's) is silent at rest
LEAST_SENSOR = {'gyro': 3e-8, 'accel': 1e-5, 'gyro_walk': 2e-11, 'accel_walk': 1e-7}
NO_ERROR = 1e-12     # of what there is none of
WARMING = 600.0      # s


@dataclass(eq=False)
class Problem:
    """A leg made ready: rows, whitening, priors; what stays the same from pass to pass."""

    leg: SmootherLeg
    imu: ImuRows
    priors: Priors
    use: np.ndarray          # (k,) bool, fixes within the keyframes
    root: np.ndarray         # (m, 3, 3) inverse roots of the stated covariances
    still: np.ndarray        # (N,) bool
    travel_floor: float
    least: dict
    first_levels: Levels
    shaken: dict             # levels of gyro and accelerometer to come down from
    outside: dict            # velocity and heading within the keyframes, where there are any
    thin: dict               # of each, how many of its errors are one and the same
    turned: float            # rad, in turns
    kept: 'Sums | None' = None    # the last, which the next fit may do with

    @classmethod
    def of(cls, leg, config, imu=None):
        """Return the problem of a leg; ``imu``: its rows, with keyframes of one's own."""
        imu = ImuRows.of(leg, SPACING) if imu is None else imu
        t = imu.t[imu.key]
        still = standing(leg, t)
        use = (leg.t_fix >= t[0]) & (leg.t_fix <= t[-1])
        grade = grade_of(config.imu)
        covariance = leg.covariance_n[use]
        fix_sigma = np.sqrt(np.median(covariance[:, 0, 0]))
        root = whitener(covariance, np.isnan(leg.fixes_n[use, 2]))
        q = leg.travel.quantum
        floor = max(q**2 / 12, (1e-3 / leg.rough_scale)**2)
        values = {name: sigma**2 for name, sigma in sensor_noise(grade).items()}
        values |= {'along': ROAD**2, 'along_hard': ROAD**2, 'travel': floor, 'fix': 1.0,
                   'fix_up': 1.0, 'slow': fix_sigma**2, 'slow_up': 4 * fix_sigma**2}
        angle = turned(leg, imu)
        slide = least_slide(angle)**2
        values |= dict.fromkeys(SIDEWAYS, max(ROAD**2, slide))
        values |= at_rest(imu, leg, still)
        least = {k: v for k, v in values.items() if k in ('gyro', 'accel')}
        least |= {k: v for k, v in values.items() if k in ('gyro_walk', 'accel_walk', 'travel')}
        least |= dict.fromkeys(('along', 'along_hard'), LEAST_ROAD**2)
        least |= dict.fromkeys(SIDEWAYS, slide)
        least |= dict.fromkeys(('fix', 'fix_up'), (LEAST_FIX / fix_sigma)**2)
        least |= dict.fromkeys(('slow', 'slow_up'), LEAST_FIX**2)
        outside = used(leg, t)
        more, more_least = first_values(outside)
        return cls(leg, imu, _priors(config, grade, leg), use, root, still, floor,
                   least | more_least, Levels(values | more),
                   {k: max(v, values[k]) for k, v in shaken(imu).items()}, outside, {}, angle)

    def sums_near(self, state: State) -> 'Sums':
        """Return the last sums where they were made near a state, else those about it."""
        if self.kept is None or not self.kept.hold_at(state):
            self.kept = self.sums(state)
        return self.kept

    def sums(self, state: State) -> 'Sums':
        """Return the preintegrated sums about a state."""
        leg, c = self.leg, state.constants
        delay = c[ODO_DELAY]
        times = [leg.t_fix[self.use] - c[GNSS_DELAY]]
        times += [x.t - c[GNSS_DELAY] * x.from_fixes for x in self.outside.values()]
        all_t = np.concatenate(times)
        order = np.argsort(all_t, kind='stable')
        intervals, points = preintegrate(
            self.imu, state.gyro_bias[:-1], state.accel_bias[:-1],
            lambda t: leg.travel.at(t + delay), state.scale * state.forward, all_t[order], c)
        if not self.outside:
            return Sums(state, intervals, points, {})
        points = points.take(np.argsort(order, kind='stable'))
        ends = np.cumsum([len(t) for t in times])
        own = [points.take(slice(a, b)) for a, b in zip(ends[:-1], ends[1:], strict=True)]
        return Sums(state, intervals, points.take(slice(0, ends[0])),
                    dict(zip(self.outside, own, strict=True)))


@dataclass(frozen=True, eq=False)
class Sums:
    """Preintegrated sums with the state they were made about."""

    about: State
    intervals: Intervals
    points: Points
    outside: dict[str, Points]

    def _apart(self, state):
        a, b = state, self.about
        c = a.constants - b.constants
        gyro = (a.gyro_bias - b.gyro_bias)[:-1]
        gyro = np.concatenate([gyro, np.broadcast_to(c[GYRO], (len(gyro), len(c[GYRO])))], axis=1)
        return gyro, (a.accel_bias - b.accel_bias)[:-1], c

    def near(self, state):
        """Return intervals for a state nearby, and what they leave to be taken in."""
        gyro, accel, c = self._apart(state)
        if not (gyro.any() or accel.any() or c[ACCEL].any()):
            return self.intervals, 0.0, c[ODO_DELAY], c[GNSS_DELAY]
        return self.intervals.shifted(gyro, accel, c[ACCEL]), gyro, c[ODO_DELAY], c[GNSS_DELAY]

    def hold_at(self, state) -> bool:
        """Tell whether a state is near enough for first order."""
        gyro, accel, c = self._apart(state)
        rate, force = self.intervals.mean_rate, self.intervals.mean_force
        signals = np.concatenate([rate, force], axis=1)
        gyro = gyro[:, :3] + _errors(signals, c[GYRO], GYRO_AXIS, GYRO_SIGNAL)
        accel = accel + _errors(force, c[ACCEL], ACCEL_AXIS, ACCEL_SIGNAL)
        return bool(np.abs(gyro).max() < NEAR_GYRO and np.abs(accel).max() < NEAR_ACCEL
                    and abs(c[ODO_DELAY]) < NEAR_ODO_TIME
                    and abs(c[GNSS_DELAY]) < NEAR_GNSS_TIME
                    and np.abs(c[:3]).max() < NEAR_FORWARD)


def _errors(signals, constants, axes, by):
    """Return what constants make of signals (K, s) on each axis: (K, 3)."""
    matrix = np.zeros((3, signals.shape[1]))
    matrix[axes, by] = constants
    return signals @ matrix.T


def imperfect_sigmas(config, duration):
    """
    Return the sigmas of IMPERFECT, 0 for none: (k,).

    Those of the Imu by its grade and the settings. A receiver that smooths does so over a second.
    Tyres change by 0.2 % from 5 to 25 m/s, and by 0.25 % as they warm within ten minutes or so;
    a body pitches by 1.7 deg/g, a car's rear axle drifts by 0.3 deg per m/s^2.
    """
    grade = grade_of(config.imu)
    axes = np.sqrt(2) * grade.misalignment     # two angles, since one of three turns the frame
    imu = np.repeat([grade.gyro_scale_error, grade.gyro_by_force, grade.accel_scale_error, axes],
                    [2, 6, 2, 2])
    return np.r_[imu, 1.0, 1e-4, 2.5e-3 / max(duration, WARMING), 3e-3, 5e-3]


def sensor_noise(grade) -> dict[str, float]:
    """Return the roots of the Imu's noise levels by its grade, SI: white ones and walks."""
    stated = {'gyro': grade.gyro_noise, 'accel': grade.accel_noise,
              'gyro_walk': grade.gyro_bias_walk, 'accel_walk': grade.accel_bias_walk}
    return {name: max(sigma, LEAST_SENSOR[name]) for name, sigma in stated.items()}


def at_rest(imu, leg, still) -> dict:
    """Return white noise levels of gyro and accelerometer as standstills show them."""
    turn = np.add.reduceat(imu.turn, imu.key[:-1])
    dt = np.diff(imu.t)[:, None]
    force = np.add.reduceat((imu.f_b[:-1] + imu.f_b[1:]) / 2 * dt, imu.key[:-1])
    T = np.diff(imu.t[imu.key])[:, None]
    inside = still[:-1] & still[1:]
    rest = np.flatnonzero(inside)
    runs = np.split(rest, np.flatnonzero(np.diff(rest) > 1) + 1)
    sums, freedom = np.zeros(2), 0
    for run in runs:
        if len(run) < 3:
            continue
        # the second difference knows no bias, no drift; its variance is six times that of one
        for i, x in enumerate((turn, force)):
            d = np.diff((x / T)[run], n=2, axis=0) * np.sqrt(T[run][1:-1] / 6)
            sums[i] += (d**2).sum() / 3
        freedom += len(run) - 2
    if freedom < LEAST_REST:
        return {}
    return {name: max(float(total / freedom), LEAST_SENSOR[name]**2)
            for name, total in zip(('gyro', 'accel'), sums, strict=True)}


def shaken(imu) -> dict:
    """
    Return white noise levels of gyro and accelerometer as neighbouring samples show them.

    What a vehicle shakes is in them, and much of it does not add up over a second: levels to come
    down from.
    """
    dt = np.diff(imu.t)
    rate = imu.turn / dt[:, None]
    out = {}
    for name, x in (('gyro', rate), ('accel', imu.f_b)):
        jump = np.median((np.diff(x, axis=0)**2).sum(axis=1)) / 2.366     # of chi2 with 3
        out[name] = float(jump / 2 * np.median(dt))
    return out


def _priors(config, grade, leg) -> Priors:
    sigma = np.full(M, np.inf)
    sigma[ODO_ARM] = sigma[GNSS_ARM] = max(config.gnss.lever_arm_sigma, 1e-4)
    sigma[ODO_DELAY] = max(config.odometer.time_sigma, 1e-5)
    sigma[GNSS_DELAY] = max(config.gnss.time_sigma, 1e-5)
    sigma[HEADING] = leg.heading.sigma
    sigma[GYRO_SCALE] = max(grade.gyro_scale_error, NO_ERROR)
    sigma[IMPERFECT] = np.maximum(imperfect_sigmas(config, leg.t_stop - leg.t_begin), NO_ERROR)
    # what gravity makes of axes and scale is a bias
    level = np.sqrt(2) * G * grade.misalignment
    accel_bias = np.hypot(max(grade.accel_bias, 1e-6), [level, level, grade.accel_scale_error * G])
    return Priors(np.full(3, max(grade.gyro_bias, 1e-9)), accel_bias, sigma, np.zeros(M))
