# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Screening: from the raw samples of a leg to usable arrays on one time axis, and reasons for faults.

Times are s since the start mark. Marks are IMU stamps, so time offsets are relative to the IMU's.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Floats, map_rows, median, release_mapped_memory
from odocal_ros.data.inputs import EXTERNAL_SLOTS, INPUTS
from odocal_ros.data.leg import Leg
from odocal_ros.data.samples import LOCAL_STATUS, VelocitySamples
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.nav.time_series import integral_at
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening import clocks, glitches
from odocal_ros.screening.axles import usable_axles
from odocal_ros.screening.dead_reckoned_fixes import dead_reckoned_fixes
from odocal_ros.screening.even_imu_times import even_imu_times
from odocal_ros.screening.fix_screen import (
    rounding_variance,
    usable_fixes,
    velocity_reasons,
)
from odocal_ros.screening.imu_faults import alternating_imu_reasons, other_frame_reasons
from odocal_ros.screening.inputs import Inputs, locate_fixes, UsableRows
from odocal_ros.screening.leg_kind import with_assumed_force, without_north
from odocal_ros.screening.reversing import BY_IMU, reversed_starts, reversing_reasons
from odocal_ros.screening.row_screen import topic_gap, usable_rows
from odocal_ros.screening.wheel_travel import LegWheels, travel_of_wheels
from odocal_ros.settings.config import Config, SIDES

# judgement: of an approximate track, an hour at 146 Hz; more only take memory. 2 h at 1 kHz are
# 0.16 m wrong with it
TRACK_ROWS = 2**19


def screen(leg: Leg, config: Config,
           check_faults: bool = True) -> tuple[Inputs, tuple[Reason, ...]]:
    """
    Return the usable arrays of a leg, empty if no row is usable, and reasons.

    check_faults : False if only its motion is needed: faults of clocks, gyro and wheels are not
    tested, and orientations are unchanged.
    """
    leg, force_reasons = with_assumed_force(leg, config)
    leg, frame_reasons = without_north(leg, config)
    reasons = [*force_reasons, *frame_reasons, *other_frame_reasons(leg, config.imu)]
    reasons += _missing(leg, reasons)
    clock_differences: dict[str, float] = {}
    if check_faults:
        leg, step_reasons = clocks.without_clock_steps(leg)
        clock_differences = clocks.clock_differences(leg, config)
        reasons += [*step_reasons, *clocks.clock_reasons(clock_differences)]
    rows, wheels, row_reasons = _usable_topics(leg, config, check_faults)
    fixes, fix_reasons = _fix_fields(leg, config, rows)
    reasons += row_reasons + fix_reasons
    imu, t_imu = rows['imu']
    C_bi = matrix_from_rpy(config.imu.mounting_rpy)
    inputs = Inputs(
        t_stop=(leg.stop_ns - leg.start_ns) * 1e-9, t_imu=t_imu,
        w_b=_rotated(imu.w_i, config.imu.gyro_scale, C_bi),
        f_b=_rotated(imu.f_i, config.imu.accel_scale, C_bi),
        q_ni=imu.q_ni, yaw_variance=imu.yaw_variance, C_bi=C_bi,
        scale_unit=leg.form.scale_unit, has_accelerometer=not force_reasons,
        is_local=bool(frame_reasons), clock_differences=clock_differences,
        **_travel_fields(leg, wheels), **fixes)
    # the mean has the rows of the first wheel
    for slot, wheel in zip(leg.wheel_slots, (wheels.mean, *wheels.wheels[1:]), strict=False):
        reasons += topic_gap(slot, wheel.t)
    if check_faults:
        reasons += alternating_imu_reasons(imu.w_i, imu.f_i)
        reasons += glitches.saturation_reasons(t_imu, imu.w_i, imu.f_i, config.imu)
        reasons += glitches.frozen_gyro_reasons(t_imu, imu.w_i, wheels.mean, config.leg.max_gap)
        reasons += glitches.dead_band_reasons(t_imu, imu.w_i, wheels.mean)
        # one axle is only tested with an accelerometer
        if len(wheels.wheels) > (1 if inputs.has_accelerometer else len(SIDES)):
            wheels, axle_reasons = usable_axles(wheels, inputs.imu, inputs.t_stop)
            reasons += axle_reasons
        inputs = replace(inputs, **_travel_fields(leg, wheels))
    release_mapped_memory()
    if check_faults and not inputs.is_local:
        inputs, reckoned_reasons = _without_dead_reckoned(inputs, config)
        reasons += reckoned_reasons
    if inputs.has_accelerometer:
        inputs, direction_reasons = _without_reversing(inputs, config)
        reasons += direction_reasons
    return inputs, tuple(reasons)


def screen_aligned(leg: Leg, config: Config) -> tuple[Leg, Inputs, tuple[Reason, ...]]:
    """Return a leg with all stamps on the clock of the IMU, its inputs, and all reasons."""
    inputs, reasons = screen(leg, config)
    delay_reasons, delays = [], dict(clocks.late_clocks(inputs, locate_fixes(inputs, config)))
    for clock, delay_s in delays.items():
        slots = [slot for slot, source in INPUTS.items() if source.clock == clock]
        shift_ns = -round(delay_s * 1e9)
        leg = leg.with_rows(**{
            slot: clocks.shift_stamps(leg.rows(slot), shift_ns, leg.imu) for slot in slots})
        delay_reasons.append(Reason(
            Code.DELAY_SEEN, f'{INPUTS[slots[0]].label} stamps are about {abs(delay_s):.1f} s '
            f'{"late" if delay_s > 0 else "early"} relative to the IMU (estimated from the '
            'motion); the stamps were corrected',
            'Synchronise the clocks (PTP, PPS, chrony), or stamp all sensors with one clock.'))
    if delay_reasons:
        inputs, reasons = screen(leg, config)
        inputs = replace(inputs, clock_delays=delays)
    return leg, inputs, (*delay_reasons, *reasons)


def _missing(leg: Leg, reasons: list[Reason]) -> list[Reason]:
    """Return the reasons for topics without messages, except those with a reason already."""
    codes = {'imu': Code.NO_IMU, 'odometer': Code.NO_ODOMETER, 'fix': Code.NO_FIX}
    known = {reason.code for reason in reasons}      # NO_IMU if imu.frame_id is missing
    return [Reason(code, f'no {INPUTS[slot].label} message between the marks')
            for slot, code in codes.items()
            if not len(leg.rows(slot).stamp_ns) and code not in known]


def _usable_topics(leg: Leg, config: Config, check_faults: bool,
                   ) -> tuple[dict[str, UsableRows], LegWheels, list[Reason]]:
    """Return the usable rows of IMU, fixes and external sensors, the wheels, and reasons."""
    offset = clocks.stamp_offsets(config)

    def usable(slot: str) -> tuple[UsableRows, list[Reason]]:
        (samples, t), reasons = usable_rows(slot, leg, config, offset[slot])
        if check_faults and hasattr(samples, 'q_ni'):
            samples = glitches.without_invalid_orientations(samples)
        if slot == 'imu':
            t = even_imu_times(t, samples.w_i, samples.f_i)
        return UsableRows(samples, t), reasons

    rows, reasons = dict[str, UsableRows](), list[Reason]()
    for slot in ('imu', *EXTERNAL_SLOTS):
        rows[slot], slot_reasons = usable(slot)
        reasons += slot_reasons
    release_mapped_memory()
    wheels, wheel_reasons = travel_of_wheels(leg, config, usable)
    choices = [Reason(Code.ODOMETER_CHOSEN, form.selection_text)
               for form in (leg.form, leg.form_right) if form and form.selection_text]
    rows['fix'], fix_reasons = usable('fix')
    return rows, wheels, [*reasons, *wheel_reasons, *choices, *fix_reasons]


def _fix_fields(leg: Leg, config: Config,
                rows: dict[str, UsableRows]) -> tuple[dict[str, Any], list[Reason]]:
    """Return fixes and external sensors as fields of Inputs, and reasons for unused rows."""
    (fix, t_received), velocity = rows['fix'], rows['fix_velocity']
    origin = ' of the leg and its pre-roll' if (t_received < 0).any() else ''
    use, covariance, fix_reasons = usable_fixes(fix, len(leg.fix.stamp_ns), config.gnss, origin)
    # gaps of received fixes: a rejected fix is not a gap
    reasons = [*fix_reasons, *topic_gap('fix', t_received)]
    t_fix = t_received[use]
    # receivers without a height publish 0
    height = fix.height if fix.height.any() or (fix.status == LOCAL_STATUS).any() else np.full(
        len(fix.height), np.nan)
    geodetic = np.stack([fix.latitude, fix.longitude, height], -1)[use]
    rounding, rounding_reasons = rounding_variance(geodetic, covariance[use])
    covariance = covariance[use] + rounding[:, :, None] * np.eye(3)
    reasons += rounding_reasons
    external = {slot: rows[slot] for slot in EXTERNAL_SLOTS}
    contradiction = velocity_reasons(
        velocity.t, velocity.samples.velocity_n, t_fix, geodetic, covariance
    ) if config.gnss.use_velocity else ()
    reasons += contradiction
    if contradiction:
        external['fix_velocity'] = UsableRows(VelocitySamples.empty(), np.empty(0))
    return {'t_fix': t_fix, 'geodetic': geodetic, 'covariance_n': covariance,
            'rounding_n': rounding, 'external': external,
            'fixes_rejected': len(leg.fix.stamp_ns) - int(use.sum())}, reasons


def _travel_fields(leg: Leg, wheels: LegWheels) -> dict[str, Any]:
    """Return the travel of the wheels as fields of Inputs."""
    # of two wheels with unknown sides only the mean is defined
    several = wheels.wheels if leg.form.sides_known and len(wheels.wheels) > 1 else ()
    return {'travel': wheels.mean, 'travels': several,
            'uncertain_t': wheels.uncertain_mean.t,
            'uncertain_sigma': wheels.uncertain_mean.sigma}


def _without_reversing(inputs: Inputs, config: Config) -> tuple[Inputs, tuple[Reason, ...]]:
    """Return inputs with negative counts where the vehicle reverses, and the reason if it does."""
    spans = reversed_starts(inputs.travel, inputs.imu, inputs.t_stop)
    if not len(spans):
        return inputs, ()
    metres_per_unit = locate_fixes(inputs, config).rough_scale or None
    return inputs.mirrored(spans), reversing_reasons(
        spans, inputs.travel, metres_per_unit, BY_IMU, config.odometer.signed)


def _without_dead_reckoned(inputs: Inputs, config: Config) -> tuple[Inputs, tuple[Reason, ...]]:
    """Return inputs without fixes that the receiver has dead-reckoned, and the reason if any."""
    located = locate_fixes(inputs, config)
    if not located.rough_scale or len(inputs.t_imu) < 2 or not len(inputs.travel.t):
        return inputs, ()
    rate = map_rows(lambda w_b: w_b @ inputs.up_b, inputs.w_b)
    # the median is the bias: drives have straights, and turns to both sides
    rate -= median(rate)
    t = inputs.t_imu[::1 + len(inputs.t_imu) // TRACK_ROWS]
    heading = np.exp(1j * integral_at(t, inputs.t_imu, rate))
    x, y, _ = np.subtract(config.gnss.lever_arm, config.odometer.lever_arm)
    steps = np.diff(inputs.travel.at(t), prepend=0.0) * located.rough_scale
    track = np.cumsum(heading * steps) + heading * (x + 1j * y)
    sigma = np.sqrt(inputs.covariance_n[:, :2, :2].trace(axis1=1, axis2=2) / 2)
    dropped, reasons = dead_reckoned_fixes(inputs.t_fix, located.fixes_n, sigma,
                                           np.interp(inputs.t_fix, t, track))
    if not reasons:
        return inputs, ()
    kept = ~dropped
    inputs = replace(inputs, t_fix=inputs.t_fix[kept], geodetic=inputs.geodetic[kept],
                     covariance_n=inputs.covariance_n[kept], rounding_n=inputs.rounding_n[kept],
                     fixes_rejected=inputs.fixes_rejected + int(dropped.sum()))
    return inputs, reasons


def _rotated(vector_i: Floats, scale: float, C_bi: Floats) -> Floats:
    """Return scale * C_bi @ vector_i by row; a matrix product of (n, 3) costs 40 ns a row."""
    if np.array_equal(C_bi, np.eye(3)):
        return vector_i if scale == 1.0 else vector_i * scale
    x, y, z = vector_i.T
    return np.stack([x * a + y * b + z * c for a, b, c in scale * C_bi], -1)
