# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Screening: a raw leg to clean arrays on one time axis, with a sentence for each thing found.

Rows that cannot be used are dropped and counted, the rest is used. Times are seconds since the
start mark; the mark is an IMU stamp, so the IMU's time offset moves the others against it.
"""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.inputs import INPUTS
from odocal_ros.data.leg import Leg
from odocal_ros.data.mapped import let_go
from odocal_ros.data.pieces import by_step
from odocal_ros.nav.rotations import matrix_from_rpy
from odocal_ros.nav.statistics import gaps_in_rhythm
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.axles import judged_axles
from odocal_ros.screening.clocks import judge_clocks, offsets
from odocal_ros.screening.fix_screen import contradicted, reckoned, usable_fixes
from odocal_ros.screening.glitches import frozen, oriented
from odocal_ros.screening.imu_rhythm import on_rhythm
from odocal_ros.screening.inputs import Inputs, place
from odocal_ros.screening.leg_kind import with_force, without_north
from odocal_ros.screening.reversing import BY_IMU, reversed_starts, said_of
from odocal_ros.screening.row_screen import usable_rows
from odocal_ros.screening.wheel_travel import wheels
from odocal_ros.settings.config import Config, ImuConfig, SIDES

MIXED_SHARE = 0.01     # judgement: of all messages; fewer are damaged ones, not a second IMU


def screen(leg: Leg, config: Config, judged: bool = True) -> tuple[Inputs, tuple[Reason, ...]]:
    """
    Return the usable arrays of a leg, empty where nothing is left, and reasons.

    judged : False for its motion alone: clocks, gyro and wheels that fail are not looked for, and
    orientations stay as sent.
    """
    leg, unfelt = with_force(leg, config)
    leg, local = without_north(leg, config)
    found: list[Reason] = [*unfelt, *local, *_other_imus(leg, config.imu)]
    for slot in ('imu', 'odometer', 'fix'):
        if not len(getattr(leg, slot).stamp_ns):
            code = {'imu': Code.NO_IMU, 'odometer': Code.NO_ODOMETER, 'fix': Code.NO_FIX}[slot]
            if any(r.code is code for r in found):      # a frame_id that nobody sends
                continue
            found.append(Reason(code, f'no {INPUTS[slot].label} message between the marks'))
    offset = offsets(config)
    if judged:
        found += judge_clocks(leg, offset)

    def rows(slot: str) -> tuple[Any, Floats]:
        return usable_rows(slot, leg, config, offset[slot], found)

    imu, t_imu = rows('imu')
    t_imu = on_rhythm(t_imu, imu.w_i, imu.f_i)
    heading, t_heading = rows('heading')
    if judged:
        imu, heading = oriented(imu), oriented(heading)
    let_go()
    velocity, t_velocity = rows('fix_velocity')
    travelled = wheels(leg, config, rows, found)
    found += [Reason(Code.ODOMETER_CHOSEN, form.chosen)
              for form in (leg.form, leg.form_right) if form and form.chosen]
    fix, t_fix = rows('fix')
    use, covariance, why = usable_fixes(fix, len(leg.fix.stamp_ns), config.gnss)
    found += why
    _gaps('fix', t_fix, found)       # of the stream: what is screened here is no gap in it
    t_fix, geodetic = t_fix[use], np.stack([fix.latitude, fix.longitude, fix.height], -1)[use]
    unlike = contradicted(t_velocity, velocity.velocity_n, t_fix, geodetic, covariance[use]) \
        if config.gnss.use_velocity else ()
    found += unlike
    some = slice(0 if unlike else None)
    _gaps('odometer', travelled.mean.t, found)
    for slot, one in zip(leg.wheel_slots[1:], travelled.each[1:], strict=False):
        _gaps(slot, one.t, found)        # the mean stands on the first wheel's rows
    if judged:
        found += frozen(t_imu, imu.w_i, travelled.mean, config.leg.max_gap)
    C_bi = matrix_from_rpy(config.imu.mounting_rpy)
    t_stop = (leg.stop_ns - leg.start_ns) * 1e-9
    w_b = _turned(imu.w_i, config.imu.gyro_scale, C_bi)
    f_b = _turned(imu.f_i, config.imu.accel_scale, C_bi)
    if judged and (len(travelled.each) > 1 and not unfelt or len(travelled.each) > len(SIDES)):
        travelled, of_axles = judged_axles(travelled, (t_imu, w_b, f_b), (0.0, t_stop))
        found += of_axles
    let_go()
    inputs = Inputs(
        t_stop=t_stop, t_imu=t_imu, w_b=w_b, f_b=f_b,
        q_ni=imu.q_ni, yaw_variance=imu.yaw_variance, C_bi=C_bi,
        travel=travelled.mean,
        # of two wheels of unknown sides only the mean has a meaning
        travels=travelled.several if leg.form.sides else (),
        doubt_t=travelled.doubt_t, doubt_sigma=travelled.doubt_sigma,
        t_fix=t_fix, geodetic=geodetic, covariance_n=covariance[use],
        t_heading=t_heading, q_heading=heading.q_ni, heading_variance=heading.yaw_variance,
        t_velocity=t_velocity[some], velocity_n=velocity.velocity_n[some],
        velocity_variance=velocity.variance_n[some],
        fixes_rejected=len(leg.fix.stamp_ns) - int(use.sum()),
        scale_unit=leg.form.scale_unit, felt=not unfelt, local=bool(local))
    if judged and not local:
        inputs = _without_reckoned(inputs, config, found)
    if unfelt:
        return inputs, tuple(found)
    back = reversed_starts(inputs.travel, t_imu, w_b, f_b, (0.0, t_stop))
    metres = place(inputs, config).rough or None if len(back) else None
    found += said_of(back, inputs.travel, metres, BY_IMU, config.odometer.signed)
    return inputs.mirrored(back), tuple(found)


def _without_reckoned(inputs: Inputs, config: Config, found: list[Reason]) -> Inputs:
    """Return inputs without fixes that the receiver has reckoned."""
    placed = place(inputs, config)
    if not placed.rough or len(inputs.t_imu) < 2 or not len(inputs.travel.t):
        return inputs
    rate = inputs.w_b @ inputs.up_b
    # straights, and turns to both sides: the median is the bias
    angle = np.cumsum((rate[1:] - np.median(rate)) * np.diff(inputs.t_imu))
    lost, why = reckoned(inputs.t_fix, placed.fixes_n, inputs.travel.at(inputs.t_fix)
                         * placed.rough, lambda t: np.interp(t, inputs.t_imu[1:], angle))
    found += why
    return replace(inputs, t_fix=inputs.t_fix[~lost], geodetic=inputs.geodetic[~lost],
                   covariance_n=inputs.covariance_n[~lost],
                   fixes_rejected=inputs.fixes_rejected + int(lost.sum())) if why else inputs


def _turned(vector_i: Floats, scale: float, C_bi: Floats) -> Floats:
    """Return scale * C_bi @ vector_i by row; a matrix product of (n, 3) costs 40 ns a row."""
    if np.array_equal(C_bi, np.eye(3)):
        return vector_i if scale == 1.0 else vector_i * scale
    x, y, z = vector_i.T
    return np.stack([x * a + y * b + z * c for a, b, c in scale * C_bi], -1)


def _gaps(slot: str, t: Floats, found: list[Reason]) -> None:
    """Name the longest gap of odometer or fixes where it is far beyond their own rhythm."""
    gaps = gaps_in_rhythm(t)
    if len(gaps):
        begin, end = gaps[np.argmax(gaps[:, 1] - gaps[:, 0])]
        found.append(Reason(Code.TOPIC_GAP, f'{INPUTS[slot].label} gap of {end - begin:.2f} s at '
                            f't = {begin:.2f} s (median interval {np.median(np.diff(t)):.3f} s)'))


def imu_gap(t_imu: Floats, t_from: float, t_stop: float, limit: float) -> tuple[Reason, ...]:
    """Return IMU_GAP where the IMU misses more than ``limit`` s between t_from and t_stop."""
    t = t_imu[np.searchsorted(t_imu, t_from - 1e-9):
              np.searchsorted(t_imu, t_stop + 1e-9, side='right')]
    long = np.flatnonzero(by_step(lambda t: np.diff(t) > limit, t))
    ends = [(t_from, t[0]), *zip(t[long], t[long + 1], strict=True), (t[-1], t_stop)] \
        if len(t) else [(t_from, t_stop)]
    gaps = [(float(b - a), float(a)) for a, b in ends if b - a > limit]
    if not gaps:
        return ()
    length, at = max(gaps)
    return (Reason(Code.IMU_GAP, f'no IMU data for {length:.2f} s at t = {at:.2f} s ({len(gaps)} '
                   f'gap{"s" * (len(gaps) > 1)}; the limit is {limit:g} s)'),)


def _other_imus(leg: Leg, imu: ImuConfig) -> tuple[Reason, ...]:
    """Return the reasons about messages whose frame_id is not that of the IMU in use."""
    other = leg.imu_other
    count, total = len(other.stamp_ns), len(other.stamp_ns) + len(leg.imu.stamp_ns)
    if not count or (imu.frame_id and len(leg.imu.stamp_ns)):
        return ()
    frames = Counter(frame.decode(errors='replace') for frame in other.frame.tolist())
    names = ', '.join(f'{n} of {frame!r}' for frame, n in frames.most_common(3))
    used = other.used[-1].decode(errors='replace')
    if imu.frame_id:
        return (Reason(Code.NO_IMU, f'no IMU message has the frame_id {used!r} of imu.frame_id; '
                       f'received: {names}', 'Set imu.frame_id to a frame_id that is sent.'),)
    if count < MIXED_SHARE * total:
        return (Reason(Code.BAD_ROWS_DROPPED, f'{count} of {total} IMU messages have another '
                       f'frame_id than {used!r} ({names}); dropped'),)
    return (Reason(Code.SEVERAL_IMUS, f'the IMU topic carries several IMUs: '
                   f'{len(leg.imu.stamp_ns)} messages of {used!r}, {names}; only {used!r} was '
                   'used', f'Set imu.frame_id to the IMU to calibrate (imu.frame_id: {used!r}), '
                   'or publish each IMU on its own topic.'),)
