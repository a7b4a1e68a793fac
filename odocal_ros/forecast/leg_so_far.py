# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
A leg while it is recorded: its faults, its profile of speed and yaw, and its running estimate.

Faults are found by the functions that check a finished leg, in cell means, every few seconds in
the worker thread of the node. IMU gaps are found in the stamps at once, and are kept. Sigmas are
predicted from the profile.
"""

from collections.abc import Callable, Iterable
from functools import lru_cache, reduce
import math
import time

import numpy as np

from odocal_ros.data.arrays import Bools, Floats, running_sum
from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import ImuSamples
from odocal_ros.errors import BadData
from odocal_ros.estimator import (
    GrowingFit,
    make_smoother_leg,
    missing_samples_reason,
    RunningEstimate,
    SmootherLeg,
    too_few_samples_reason,
)
from odocal_ros.forecast.forecast import LegEnded
from odocal_ros.forecast.planned_drive import DRIVE_STEP, PlannedDrive, REST_SPEED
from odocal_ros.nav.dead_reckoning import Origin
from odocal_ros.nav.time_series import running_integral
from odocal_ros.pipeline.calibrate import find_faults, screen_leg, ScreenedLeg
from odocal_ros.reasons import Reason
from odocal_ros.screening import imu_orientation
from odocal_ros.screening.inputs import Inputs, locate_fixes, LocatedFixes
from odocal_ros.screening.row_screen import imu_gap
from odocal_ros.settings.config import Config, SETTINGS, with_settings

SILENT_TIME = 0.9    # s; judgement: delay of rows out of order; reported within a second


class ImuGaps:
    """The IMU stamps of a leg, reduced to those around its gaps."""

    def __init__(self, start_ns: int, limit_s: float) -> None:
        self._start_ns, self._limit_s = start_ns, limit_s
        self._newest_ns = start_ns
        self._edges_ns: list[int] = []      # stamps before and after each gap

    def feed(self, block: ImuSamples) -> int:
        """Take IMU rows; return the stamp after the last gap among them, 0 without a gap."""
        stamps = block.stamp_ns[block.stamp_ns > self._newest_ns]
        if not len(stamps):
            return 0
        stamps = np.append(self._newest_ns, np.sort(stamps))
        gaps = np.flatnonzero(np.diff(stamps) > self._limit_s * 1e9)
        for k in gaps:
            self._edges_ns += stamps[k:k + 2].tolist()
        self._newest_ns = int(stamps[-1])
        return self._edges_ns[-1] if len(gaps) else 0

    def reasons(self, silent_s: float = 0.0) -> tuple[Reason, ...]:
        """Return IMU_GAP if there was one; ``silent_s``: time without IMU messages."""
        t = (np.array([*self._edges_ns, self._newest_ns]) - self._start_ns) * 1e-9
        t = np.concatenate([[0.0], t])
        # the sections between gaps are filled with times closer than the limit
        filled = np.concatenate([np.arange(a, b, self._limit_s / 2) for a, b in t.reshape(-1, 2)])
        end = t[-1] + (silent_s if silent_s > SILENT_TIME else 0.0)
        return imu_gap(np.union1d(filled, t), 0.0, float(end), self._limit_s)


@lru_cache(maxsize=1)      # faults and running estimate of one update use the same leg
def screen_thinned(leg: Leg, config: Config) -> ScreenedLeg:
    """Return the inputs of a thinned leg; its IMU rows are means over cells of time."""
    return screen_leg(leg, _with_gap_limit(leg, config))


def find_thinned_faults(leg: Leg, config: Config) -> tuple[Reason, ...]:
    """Return the faults of a thinned leg."""
    return find_faults(screen_thinned(leg, config), _with_gap_limit(leg, config))


def _with_gap_limit(leg: Leg, config: Config) -> Config:
    """Return config with an IMU gap limit that cells do not exceed."""
    cell_s = float(np.median(np.diff(leg.imu.stamp_ns))) * 1e-9 if len(leg.imu.stamp_ns) > 1 \
        else 0.0
    limit_s = min(config.leg.max_gap + 2 * cell_s, SETTINGS['leg.max_gap'].high or math.inf)
    return with_settings(config, {'leg.max_gap': limit_s})


def drive_profile(inputs: Inputs, config: Config) -> PlannedDrive:
    """
    Return a leg as a drive: speed by the odometer, direction by the gyro, first course by fixes.

    Raises BadData: IMU, odometer or fixes are missing. Raises BadUsage: the vehicle did not move.
    """
    if not (len(inputs.t_imu) > 3 and len(inputs.travel.t) > 1 and len(inputs.t_fix)):
        raise BadData('a profile needs IMU, odometer and fixes between the marks; check the bag '
                      'with odocal inspect')
    located = _locate_or_raise(inputs, config)
    origin, scale = located.origin, located.rough_scale
    first, last = max(inputs.t_imu[0], inputs.travel.t[0]), min(
        inputs.t_stop, inputs.t_imu[-1], inputs.travel.t[-1])
    step = max(DRIVE_STEP, (last - first) / 5e4)
    t = np.linspace(first, last, max(2, int((last - first) / step)))
    spans = inputs.standstills(scale, config)
    resting = _within(t, spans)
    profile_window = 0.5    # s on each side, of the mean speed
    travel = inputs.travel.at(t + profile_window) - inputs.travel.at(t - profile_window)
    speed = np.where(resting, 0.0, travel * scale / (2 * profile_window))
    speed[~resting & (np.abs(speed) <= REST_SPEED)] = 2 * REST_SPEED   # too short to count as rest
    yaw = _yaw(inputs, spans, t)
    first_course = _first_course(t, speed, yaw, inputs.t_fix, located.fixes_n)
    return PlannedDrive(t, speed, yaw + first_course, np.zeros_like(t), origin.latitude,
                        origin.longitude, origin.height)


def _locate_or_raise(inputs: Inputs, config: Config) -> LocatedFixes:
    """Return the fix positions and the metres per count; raise BadData without them."""
    located = locate_fixes(inputs, config)
    if not located.rough_scale:
        raise BadData('the scale is not known yet: the fixes moved too little and '
                      'odometer.nominal_scale is not set')
    return located


def _yaw(inputs: Inputs, spans: Floats, t: Floats) -> Floats:
    """Return the angle turned about the z axis of b, rad, without the rate at rest: (m,)."""
    t_imu, w = inputs.t_imu, inputs.w_b[:, 2]
    at_rest = _within(t_imu, spans)
    w = w - (w[at_rest].mean() if at_rest.any() else 0.0)
    return np.interp(t, t_imu, running_integral(t_imu, w))


def _within(t: Floats, spans: Floats) -> Bools:
    """Return a mask of the times within spans, (k, 2) s."""
    return reduce(np.logical_or, [(t >= a) & (t <= b) for a, b in spans], np.zeros(len(t), bool))


def _first_course(t: Floats, speed: Floats, yaw: Floats, t_fix: Floats, fixes_n: Floats) -> float:
    """Return the angle that rotates the track of speed and yaw onto the fixes, rad."""
    step = speed[:-1] * np.diff(t)
    track = running_sum(step * np.exp(1j * yaw[:-1]))
    inside = (t_fix >= t[0]) & (t_fix <= t[-1])
    if inside.sum() < 2:
        return 0.0
    times = t_fix[inside]
    dead_reckoned = np.interp(times, t, track.real) + 1j * np.interp(times, t, track.imag)
    measured = fixes_n[inside, 0] + 1j * fixes_n[inside, 1]
    return float(np.angle(np.sum((measured - measured.mean())
                                 * np.conj(dead_reckoned - dead_reckoned.mean()))))


def fix_and_count_accuracy(inputs: Inputs, config: Config) -> dict[str, float]:
    """Return accuracy and rate of the fixes, and the size of one count, as in ``Sigmas``."""
    inside = (inputs.t_fix >= 0) & (inputs.t_fix <= inputs.t_stop)
    if inside.sum() < 2:
        raise BadData('fewer than two usable fixes between the marks')
    variance = np.median(np.diagonal(inputs.covariance_n[inside], axis1=1, axis2=2), axis=0)
    return {'fix': float(np.sqrt((variance[0] + variance[1]) / 2)),
            'fix_up': float(np.sqrt(variance[2])),
            'fix_rate': float(1 / np.median(np.diff(inputs.t_fix[inside]))),
            'quantum': inputs.travel.quantum * _locate_or_raise(inputs, config).rough_scale}


class SmootherSoFar:
    """The smoother on one leg while it grows."""

    def __init__(self) -> None:
        self._growing = GrowingFit(time.thread_time)
        self._origin: Origin | None = None

    @property
    def cold_start_cpu_s(self) -> float:
        """Return the CPU time of the last fit if it was a cold start, s; these become rarer."""
        return self._growing.cold_start_cpu_s

    def update(self, leg: Leg, config: Config,
               is_needed: Callable[[], bool] = lambda: True) -> RunningEstimate:
        """
        Return the running estimate.

        leg : the data so far, including those of the last call.   config : settings at the leg's
        start.   is_needed : called between passes; LegEnded is raised if it returns False.

        Raises OdocalError: too few data, or no fit; the next update is a cold start.
        """
        def trace(*_: object) -> None:
            if not is_needed():
                raise LegEnded

        try:
            smoother_leg = self._smoother_leg(leg, config)
        except BaseException:
            self._growing.forget()
            raise
        return self._growing.fit(smoother_leg, config, trace)

    def _smoother_leg(self, leg: Leg, config: Config) -> SmootherLeg:
        """Return the inputs of the smoother; raise BadData if they are not sufficient yet."""
        screened = screen_thinned(leg, config)
        inputs = screened.inputs
        if len(inputs.t_imu) < 4 or len(inputs.travel.t) < 2:
            raise BadData('the smoother needs IMU and odometer samples')
        reason = too_few_samples_reason(
            len(inputs.t_fix), float(inputs.t_imu[-1] - inputs.t_imu[0]))
        if reason:
            raise BadData(reason.text)
        _raise_if_unusable(screened.reasons)
        located = _locate_or_raise(inputs, config)
        orientation = imu_orientation.estimate_orientation(inputs, located.rough_scale)
        _raise_if_unusable(imu_orientation.orientation_reasons(
            orientation, config.imu.nominal_yaw))
        if vars(located.origin) != (self._origin and vars(self._origin)):
            self._origin = located.origin
            self._growing.forget()
        spans = inputs.standstills(located.rough_scale, config)
        # travel beyond the last odometer row would be a slip
        t_stop = min(inputs.t_stop, float(inputs.travel.t[-1]))
        smoother_leg = make_smoother_leg(
            inputs, config, located.origin, located.fixes_n, spans, located.rough_scale, t_stop)
        reason = missing_samples_reason(smoother_leg)
        if reason:
            raise BadData(reason.text)
        return smoother_leg


def _raise_if_unusable(reasons: Iterable[Reason]) -> None:
    for reason in reasons:
        if reason.code in imu_orientation.UNUSABLE:
            raise BadData(reason.text)
