# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Detection of several IMUs on one topic: by their frame_ids, or by alternating rows."""

from collections import Counter

import numpy as np

from odocal_ros.data.arrays import Floats
from odocal_ros.data.leg import Leg
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import ImuConfig

MIXED_SHARE = 0.01     # judgement: of all messages; fewer are damaged ones, not a second IMU
# judgement, of rows that may alternate: rows of a mean; least number of means, and largest, at the
# end of the leg; ratio of an outlier to the median; share of rows that repeat
MEAN_ROWS, FEWEST_MEANS, MOST_MEANS, OUTLYING, REPEATED = 50, 40, 2000, 10.0, 0.2
# statistical: F of a constant and the signals in the differences of odd and even rows. For one IMU
# it is 14 at most (25 zoo drives); for two with axes 3 deg apart or other biases 50 and more
SURE_F = 30.0
# judgement: least explained variance, in variances of a mean of white noise; 8/3 is that of a mean
# over that of a row. Smooth signals without noise are below it
LEAST_POWER = 0.1 * 8 / 3
# judgement: a vibration near half the rate changes its size and phase. Correlation of adjacent
# residuals, and the slow part of them over the explained part; two IMUs are below one of them
MOST_CORRELATED, MOST_SLOW = 0.5, 0.05


def other_imus(leg: Leg, imu: ImuConfig) -> tuple[Reason, ...]:
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


def alternating(w_i: Floats, f_i: Floats) -> tuple[Reason, ...]:
    """Return SEVERAL_IMUS if every second row is from another IMU; (n, 3) in any unit."""
    share = max(_share_of_two(w_i), _share_of_two(f_i))
    if not share:
        return ()
    return (Reason(Code.SEVERAL_IMUS, 'the IMU topic carries two IMUs: every second message has '
                   f'other axes or biases ({100 * share:.0f} % of the differences between odd and '
                   'even messages are constant or in proportion to the signal)',
                   'Stop the second publisher, or publish each IMU on its own topic.'),)


def _share_of_two(x: Floats) -> float:
    """Return the share of odd minus even rows that a second IMU explains, 0: none; x (n, 3)."""
    x = x[-MOST_MEANS * MEAN_ROWS - 2:]
    count = (len(x) - 2) // MEAN_ROWS
    if count < FEWEST_MEANS or (x[1:] == x[:-1]).all(axis=1).mean() > REPEATED:
        return 0.0
    rows = np.where(np.arange(len(x) - 2) % 2, -0.5, 0.5)[:, None] \
        * (x[1:-1] - (x[:-2] + x[2:]) / 2)
    parts = rows[:count * MEAN_ROWS].reshape(count, MEAN_ROWS, 3)
    off = parts.mean(axis=1)
    size = np.abs(off).max(axis=1)
    good = size <= OUTLYING * np.median(size)
    mean = x[1:count * MEAN_ROWS + 1].reshape(parts.shape).mean(axis=1)[good]
    # a section that tilts and vibrates more would explain its own noise: equal noise of all means
    parts, A = parts[good], np.column_stack([np.ones(len(mean)), mean])
    noise = np.sqrt((parts**2).mean(axis=(1, 2)))
    noise = np.maximum(noise, np.median(noise) or 1.0)[:, None]
    off, A, parts = off[good] / noise, A / noise, parts / noise[:, None]
    free = len(off) - A.shape[1]
    if free < FEWEST_MEANS // 2:
        return 0.0
    rest = off - A @ np.linalg.lstsq(A, off, rcond=None)[0]
    left, total = (rest**2).sum(axis=0), (off**2).sum(axis=0)
    slow = (rest[1:] * rest[:-1]).sum(axis=0)
    explained, power = total - left, (parts**2).mean(axis=(0, 1))
    sure = (explained * free > SURE_F * A.shape[1] * left) & (
        explained / len(off) > LEAST_POWER * power / MEAN_ROWS)
    vibrating = slow > np.maximum(MOST_CORRELATED * left, MOST_SLOW * explained)
    if vibrating[np.argmax(explained / np.maximum(power, 1e-300))]:
        return 0.0
    return float((explained[sure] / total[sure]).max(initial=0.0))
