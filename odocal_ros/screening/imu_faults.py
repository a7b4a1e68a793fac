# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""
Detection of an IMU topic that is not one IMU, fixed in the vehicle, with one unit.

Faults: gravity or the forward direction turns in its axes during a leg, the unit changes, or the
messages of two IMUs alternate. Each function returns the reasons for one fault, () without it.
"""

from collections import Counter

import numpy as np

from odocal_ros.data.arrays import Floats, Ints, medians
from odocal_ros.data.leg import Leg
from odocal_ros.nav.rotations import wrap
from odocal_ros.reasons import Code, Reason
from odocal_ros.screening.imu_orientation import Accelerations, orientation_of
from odocal_ros.screening.inputs import Inputs
from odocal_ros.settings.config import ImuConfig
from odocal_ros.settings.nominal import G

# judgement, deg: least turn, larger than by slopes, bends and noise; largest scatter before or
# after the turn
MIN_IMU_TURN, GRAVITY_SCATTER = 45.0, 20.0
# judgement: largest ratio of gravity after a turn and before; 1.4 in a bend at 45 deg
GRAVITY_CHANGE = 1.15
# judgement, deg: a larger turn is by reversing with an unsigned counter (180 deg)
LARGEST_YAW_TURN = 135.0
YAW_SIGMAS = 5.0    # statistical: of the two sides, beyond MIN_IMU_TURN
MOVED_REMEDY = 'Mount the IMU firmly, or mark a leg before or after this with --leg.'
TENTHS, MIN_TENTH_ROWS = 10, 20       # judgement: sections of a leg; least rows of one
# judgement: limits of measured gravity over the Earth's. Units and ranges differ by a factor of 2
# at least; in a continuous bend at 1.2 g the force is 1.56 times gravity
MIN_GRAVITY_RATIO, MAX_GRAVITY_RATIO = 0.6, 1.6
MIXED_SHARE = 0.01     # judgement: share of all messages; fewer are damaged, not a second IMU
# judgement, for the test of alternating rows: rows of a block; least and largest number of blocks,
# from the end of the leg; ratio of an outlier to the median; largest share of repeated rows
BLOCK_ROWS, MIN_BLOCKS, MAX_BLOCKS, OUTLIER_RATIO, REPEATED_SHARE = 50, 40, 2000, 10.0, 0.2
# statistical: F of the regression of odd minus even rows on a constant and the signals. For one
# IMU it is 14 at most (25 zoo drives); for two with axes 3 deg apart or other biases 50 and more
MIN_F_STATISTIC = 30.0
# judgement: least explained variance, a tenth of that of white noise in a mean of a block. White
# samples in differences with the weights 1/4, 1/2, 1/4 give a mean 8/3 of the variance of a row
# over the number of rows. Smooth signals without noise are below the limit
MIN_EXPLAINED_VARIANCE = 0.1 * 8 / 3
# judgement: the difference by a vibration near half the rate changes slowly, as its phase does.
# Largest correlation of adjacent residuals, and largest share of their product in the explained
# sum of squares; two IMUs exceed at most one of them
CORRELATION_LIMIT, SLOW_SHARE_LIMIT = 0.5, 0.05


def _tenths(inputs: Inputs) -> tuple[Ints, Floats]:
    """Return the edges of tenths of the leg, (11,) rows, and their median force, (10, 3) in b."""
    edges = np.linspace(0, len(inputs.t_imu), TENTHS + 1).astype(int)
    if not inputs.has_accelerometer or edges[1] < MIN_TENTH_ROWS:
        return edges[:0], np.empty((0, 3))
    return edges, np.array([medians(inputs.f_b[begin:end])
                            for begin, end in zip(edges[:-1], edges[1:], strict=True)])


def unit_change_reasons(inputs: Inputs) -> tuple[Reason, ...]:
    """Return IMU_UNITS if gravity in a tenth of the leg differs from the Earth's."""
    edges, force = _tenths(inputs)
    gravity = np.linalg.norm(force, axis=1).tolist()
    wrong = [k for k, size in enumerate(gravity)
             if not MIN_GRAVITY_RATIO * G < size < MAX_GRAVITY_RATIO * G]
    if not wrong or len(wrong) == len(gravity):      # all tenths: the unit of the whole leg
        return ()
    begin, end = inputs.t_imu[edges[wrong[0]]], inputs.t_imu[edges[wrong[-1] + 1] - 1]
    return (Reason(Code.IMU_UNITS, f'from t = {begin:.0f} to {end:.0f} s the IMU measures a '
                   f'gravity of {gravity[wrong[0]]:.3g} m/s^2 instead of 9.8 m/s^2',
                   'Check the IMU driver for a change of unit or range during the drive, or mark '
                   'a leg before or after it with --leg.'),)


def gravity_turn_reasons(inputs: Inputs) -> tuple[Reason, ...]:
    """Return IMU_AXES if the direction of gravity changes between two tenths of the leg."""
    edges, force = _tenths(inputs)
    for k in range(1, len(force) - 1):
        sides = force[:k], force[k + 1:]
        before, after = (side.mean(axis=0) for side in sides)
        # a bend, or another unit, also changes the magnitude
        ratio = np.linalg.norm(after) / max(float(np.linalg.norm(before)), 1e-9)
        turn_deg = _angle_between(before, after)
        scatter = [_angle_between(tenth, mean) for side, mean in zip(
            sides, (before, after), strict=True) for tenth in side]
        if (turn_deg > MIN_IMU_TURN and 1 / GRAVITY_CHANGE < ratio < GRAVITY_CHANGE
                and max(scatter) < GRAVITY_SCATTER):
            begin, end = inputs.t_imu[edges[k]], inputs.t_imu[edges[k + 1] - 1]
            return (_imu_moved_reason(f'gravity turns by {turn_deg:.0f} deg', float(begin),
                                      float(end)),)
    return ()


def forward_turn_reasons(binned: Accelerations | None) -> tuple[Reason, ...]:
    """Return IMU_AXES if the forward direction changes between two tenths of the leg."""
    if binned is None:
        return ()
    edges = np.linspace(0, len(binned.t), 11).astype(int)
    # sigma and angle, deg, begin and end, s; forward turns in the IMU opposite to the yaw mounting
    turns = []
    for begin, end in zip(edges[1:-2], edges[2:-1], strict=True):
        before, after = orientation_of(binned[:begin]), orientation_of(binned[end:])
        if before is None or after is None:
            continue
        turn_deg = float(np.rad2deg(wrap(after.yaw - before.yaw)))
        sigma = float(np.rad2deg(np.hypot(before.sigma, after.sigma)))
        if MIN_IMU_TURN + YAW_SIGMAS * sigma < abs(turn_deg) < LARGEST_YAW_TURN:
            turns.append((sigma, -turn_deg, float(binned.t[begin]), float(binned.t[end])))
    if not turns:
        return ()
    sigma, turn_deg, begin_s, end_s = min(turns)      # the most certain one
    return (_imu_moved_reason(f'the forward direction turns by {turn_deg:+z.0f} '
                              f'± {max(sigma, 1.0):.0f} deg', begin_s, end_s),)


def _imu_moved_reason(observation: str, begin: float, end: float) -> Reason:
    return Reason(Code.IMU_AXES, f'{observation} in the IMU frame at about t = {begin:.0f} to '
                  f'{end:.0f} s: the IMU was moved in the vehicle', MOVED_REMEDY)


def _angle_between(first: Floats, second: Floats) -> float:
    """Return the angle between two vectors, (3,), deg; 0 if one is zero."""
    sine, cosine = np.linalg.norm(np.cross(first, second)), float(first @ second)
    return float(np.rad2deg(np.arctan2(sine, cosine)))


def other_frame_reasons(leg: Leg, imu: ImuConfig) -> tuple[Reason, ...]:
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
    return (Reason(Code.SEVERAL_IMUS, f'the IMU topic contains messages of several IMUs: '
                   f'{len(leg.imu.stamp_ns)} messages of {used!r}, {names}; only {used!r} was '
                   'used', f'Set imu.frame_id to the IMU to calibrate (imu.frame_id: {used!r}), '
                   'or publish each IMU on its own topic.'),)


def alternating_imu_reasons(w_i: Floats, f_i: Floats) -> tuple[Reason, ...]:
    """Return SEVERAL_IMUS if every second row is from another IMU; (n, 3) in i, any unit."""
    share = max(_share_of_second_imu(w_i), _share_of_second_imu(f_i))
    if not share:
        return ()
    return (Reason(Code.SEVERAL_IMUS, 'the IMU topic contains messages of two IMUs: every second '
                   f'message has other axes or biases ({100 * share:.0f} % of the differences '
                   'between odd and even messages are constant or in proportion to the signal)',
                   'Stop the second publisher, or publish each IMU on its own topic.'),)


def _share_of_second_imu(x: Floats) -> float:
    """
    Return the share of the variance of odd minus even rows that a second IMU explains; 0: none.

    Half the difference of a row and the mean of its two neighbours is averaged in blocks. A second
    IMU adds a constant (another bias) and a combination of the signals (other axes); the F test
    decides whether a fit of both is significant.   x : (n, 3) rows.
    """
    x = x[-MAX_BLOCKS * BLOCK_ROWS - 2:]
    count = (len(x) - 2) // BLOCK_ROWS
    if count < MIN_BLOCKS or (x[1:] == x[:-1]).all(axis=1).mean() > REPEATED_SHARE:
        return 0.0
    odd_minus_even = np.where(np.arange(len(x) - 2) % 2, -0.5, 0.5)[:, None] \
        * (x[1:-1] - (x[:-2] + x[2:]) / 2)
    blocks = odd_minus_even[:count * BLOCK_ROWS].reshape(count, BLOCK_ROWS, 3)
    difference = blocks.mean(axis=1)
    size = np.abs(difference).max(axis=1)
    is_usual = size <= OUTLIER_RATIO * np.median(size)
    mean = x[1:count * BLOCK_ROWS + 1].reshape(blocks.shape).mean(axis=1)[is_usual]
    # scale blocks to equal noise: one that tilts and vibrates more would dominate the fit
    blocks, design = blocks[is_usual], np.column_stack([np.ones(len(mean)), mean])
    noise = np.sqrt((blocks**2).mean(axis=(1, 2)))
    noise = np.maximum(noise, np.median(noise) or 1.0)[:, None]
    difference, design = difference[is_usual] / noise, design / noise
    return _significant_share(difference, design, ((blocks / noise[:, None])**2).mean(axis=(0, 1)))


def _significant_share(difference: Floats, design: Floats, power: Floats) -> float:
    """
    Return the largest share of the variance of an axis that a regression explains; 0: by chance.

    difference, design : (m, 3), (m, k) means of blocks, and regressors.   power : (3,) mean square
    of single rows.
    """
    freedom = len(difference) - design.shape[1]
    if freedom < MIN_BLOCKS // 2:
        return 0.0
    residual = difference - design @ np.linalg.lstsq(design, difference, rcond=None)[0]
    unexplained, total = (residual**2).sum(axis=0), (difference**2).sum(axis=0)
    lagged = (residual[1:] * residual[:-1]).sum(axis=0)
    explained = total - unexplained
    significant = (explained * freedom > MIN_F_STATISTIC * design.shape[1] * unexplained) & (
        explained / len(difference) > MIN_EXPLAINED_VARIANCE * power / BLOCK_ROWS)
    is_vibration = lagged > np.maximum(CORRELATION_LIMIT * unexplained,
                                       SLOW_SHARE_LIMIT * explained)
    if is_vibration[np.argmax(explained / np.maximum(power, 1e-300))]:
        return 0.0
    return float((explained[significant] / total[significant]).max(initial=0.0))
