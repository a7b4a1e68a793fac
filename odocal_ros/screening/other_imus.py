# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""Messages of other IMUs on the IMU topic: the leg is rejected unless one is chosen."""

from collections import Counter

from odocal_ros.data.leg import Leg
from odocal_ros.reasons import Code, Reason
from odocal_ros.settings.config import ImuConfig

MIXED_SHARE = 0.01     # judgement: of all messages; fewer are damaged ones, not a second IMU


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
