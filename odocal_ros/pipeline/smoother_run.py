# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The smoother on one leg, its paths, and the search of two wheels of patent CN104359492A."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np

from odocal_ros.calib.marks import Path
from odocal_ros.calib.result import Estimate, MethodResult, RAW_SCALE
from odocal_ros.calib.slip import slip_reasons
from odocal_ros.calib.wheel_search.parameter_sets import search_ranges
from odocal_ros.calib.wheel_search.planar import planar_leg, PlanarLeg
from odocal_ros.calib.wheel_search.search import search
from odocal_ros.data.arrays import Floats, release_mapped_memory
from odocal_ros.estimator import make_smoother_leg, smooth
from odocal_ros.nav.dead_reckoning import dead_reckon, Track
from odocal_ros.nav.rotations import quat_at, quat_conjugate, quat_from_matrix, quat_multiply
from odocal_ros.pipeline.align import attitude_of
from odocal_ros.pipeline.prepared_leg import MethodRun, PassCallback, Paths, PreparedLeg
from odocal_ros.reasons import Code
from odocal_ros.settings.config import Config


def smoother(prepared: PreparedLeg, report_pass: PassCallback) -> MethodRun:
    """Run the smoother on a leg; the times of its paths are stamps of the fixes."""
    leg = make_smoother_leg(prepared.inputs, prepared.config, prepared.origin, prepared.fixes_n,
                            prepared.standstills, prepared.rough_scale, prepared.t_fit)
    t_slip, metres = prepared.wheel_slips.uncertain_travel()
    leg = replace(leg, uncertain_t=np.append(leg.uncertain_t, t_slip),
                  uncertain_sigma=np.append(leg.uncertain_sigma, metres / prepared.rough_scale))
    passes = count(1)
    method = smooth(leg, prepared.config, lambda *state: report_pass(next(passes), state[-1]))
    if method.estimates['scale_factor'].value is None:
        return MethodRun(method)
    if prepared.config.method == 'patent':
        method = _with_search(method, prepared)
    delays = {name: method.estimates[f'{name}_delay'] for name in ('gnss', 'odometer')}
    observed_delays = {name: (e.value, e.sigma) for name, e in delays.items()
                       if e.value is not None and e.sigma is not None}
    # stamps of odometer and fixes are corrected by the estimated delays, else by the settings
    delays_s = {name: e.value or 0.0 for name, e in delays.items()}
    travel = prepared.inputs.travel
    t, q_nb = _attitude(prepared, method.details)
    track = dead_reckon(t, q_nb, replace(travel, t=travel.t - delays_s['odometer']))
    lever_b = method.details['C_bv'] @ _lever_v(method.estimates, prepared.config)
    f = method.details['f']
    raw = method.estimates.get(RAW_SCALE)
    if raw is not None:        # the travel here is the integral of the raw speed
        f = f * (raw.value or 0.0) / np.linalg.norm(f)
    before = prepared.path(prepared.configured_forward(f, method.estimates),
                           dead_reckon(t, q_nb, travel))
    # of coarse speeds the fit only uses the steps: slip is detected by this track
    odometer = slip_reasons(prepared.find_slips(track, f, (0.0, prepared.t_fit)),
                            prepared.config.odometer.time_offset) if leg.uses_speed_steps else ()
    return MethodRun(method, Paths(before, _delayed_path(track, f, lever_b, delays_s['gnss'])),
                     delays=observed_delays, odometer_reasons=odometer)


def _with_search(method: MethodResult, prepared: PreparedLeg) -> MethodResult:
    """Return the smoother's result with that of the patent's search in its details."""
    leg = planar_input(prepared, method.estimates['pitch_mounting_angle'].value or 0.0)
    if leg is None:
        return method
    alignment, wheels = prepared.alignment, prepared.config.wheels
    # the sigma of a course includes the mounting angle
    course_sigma = None if alignment.heading_separable else alignment.heading_sigma
    search_result = search(leg, search_ranges(wheels, course_sigma), wheels.robust)
    if search_result is None:
        return method
    # left and right may be separable by the gyro: the smoother reports that itself
    search_reasons = (r for r in search_result.reasons if r.code is not Code.WHEELS_NOT_SEPARABLE)
    return replace(method, reasons=(*method.reasons, *search_reasons),
                   details=method.details | {'search': search_result.as_dict()})


def _attitude(prepared: PreparedLeg, details: Mapping[str, Any]) -> tuple[Floats, Floats]:
    """Return the smoother's attitude at the IMU's rate: t (m,) s, q_nb (m, 4)."""
    t_key, C_nb = details['key_t'], details['key_C_nb']
    t, q_nb = attitude_of(prepared.inputs, prepared.origin, t_key[0], quat_from_matrix(C_nb[0]),
                          details['gyro_bias'])
    correction = quat_multiply(quat_from_matrix(C_nb), quat_conjugate(quat_at(t_key, t, q_nb)))
    return t, quat_multiply(quat_at(t, t_key, correction), q_nb)


def _delayed_path(track: Track, f: Floats, lever_b: Floats, delay: float) -> Path:
    """Return the path for stamps that are ``delay`` s late, extrapolated at the track's ends."""
    def path(t: Floats) -> Floats:
        t = t - delay
        inside = np.clip(t, track.t[0], track.t[-1])
        outside = np.clip(t - inside, -abs(delay), abs(delay))
        summed = track.P_at(inside)      # attitude summed over travel
        span = 0.2    # s at an end of the track, whose mean motion is continued for the delay
        before = track.P_at(inside - np.copysign(span, outside))
        summed = summed + (summed - before) * (np.abs(outside) / span)[..., None, None]
        release_mapped_memory()        # releases the sums before the attitudes are read
        position: Floats = summed @ f + track.C_nb_at(inside) @ lever_b
        release_mapped_memory()
        return position
    return path


def _lever_v(estimates: Mapping[str, Estimate], config: Config) -> Floats:
    """Return odometer point to antenna, as estimated, otherwise as configured: (3,) m."""
    antenna, odometer = (
        np.array([value if (e := estimates[f'{name}_lever_arm_{axis}']).value is None else e.value
                  for axis, value in zip('xyz', section.lever_arm, strict=True)])
        for name, section in (('antenna', config.gnss), ('odometer', config.odometer)))
    return np.asarray(antenna - odometer)


def planar_input(prepared: PreparedLeg, pitch: float) -> PlanarLeg | None:
    """Return a leg as input of the search, None without two wheels or a first fix; pitch: rad."""
    inputs = prepared.inputs
    if len(inputs.travels) != 2:
        return None
    left, right = inputs.travels
    times = [part.t for part in (prepared.track, left, right)]
    begin = max(0.0, *(float(t[0]) for t in times))
    end = min(prepared.t_fit, *(float(t[-1]) for t in times))
    rough_path = prepared.path(np.array([prepared.rough_scale, 0.0, 0.0]))
    start = prepared.mark(begin, rough_path, 'start')
    if start is None or end <= begin:
        return None
    between = (inputs.t_fix >= begin) & (inputs.t_fix <= end)
    scale = prepared.nominal_scale or prepared.rough_scale
    return planar_leg(dead_reckon(*prepared.epochs, left), dead_reckon(*prepared.epochs, right),
                      inputs.t_fix[between], prepared.fixes_n[between],
                      inputs.covariance_n[between], (start.t, start.position_n),
                      (scale, scale), pitch, prepared.lever_v)
