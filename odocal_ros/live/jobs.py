# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The computations of the worker thread, without access to the node and its state."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import Path as PathMessage
import numpy as np
from std_msgs.msg import Header

from odocal_ros.calib.carried import Carried
from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.data.arrays import Floats
from odocal_ros.data.leg import LegRecorder
from odocal_ros.live.session import LEGS_HELD
from odocal_ros.output.stored import known_imu
from odocal_ros.pipeline.automatic import fold, refusal
from odocal_ros.pipeline.calibrate import calibrate_parts, combine
from odocal_ros.pipeline.prepared import Stage
from odocal_ros.reasons import Reason
from odocal_ros.settings.config import Config

MOST_POSES = 2000    # judgement: of a path shown
Paths: TypeAlias = tuple[PathMessage, PathMessage]      # dead reckoning, reference


@dataclass(frozen=True, eq=False)
class Computed:
    """
    Result of a leg.

    results : one, or one of each part where the IMU had a gap.
    carried, folded : information of earlier legs, and how many kept legs are in it.
    """

    results: tuple[LegResult, ...]
    paths: Paths
    calibration: Calibration
    carried: Carried | None
    folded: int


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Result of an unused automatic leg, and the cause."""

    results: tuple[LegResult, ...]
    why: Reason


def compute(recorder: LegRecorder, start_ns: int, stop_ns: int,
            kept: list[tuple[LegResult, ...]], config: Config, carried: Carried | None = None,
            by_itself: bool = False, progress: Callable[[Stage], None] | None = None,
            ) -> Computed | LeftOut:
    """Return a leg's result, its combination with the legs kept, and the paths to show."""
    leg = recorder.close(start_ns, stop_ns, config.leg.preroll)
    results = tuple(calibrate_parts(leg, config, progress=progress))
    if by_itself and (why := refusal(results[0])):
        return LeftOut(results, why)
    paths = leg_paths(max(results, key=lambda one: one.distance), config)
    folded = max(0, len(kept) + 1 - LEGS_HELD) if by_itself else 0
    carried = fold([one for leg in kept[:folded] for one in leg], config, carried)
    left = [one for leg in kept[folded:] for one in leg]
    calibration = combine([*left, *results], config, carried, known_imu(config))
    return Computed(results, paths, calibration, carried, folded)


def recombine(kept: list[LegResult], config: Config, carried: Carried | None = None,
              ) -> tuple[Calibration, Paths]:
    """Return the combination of the legs left, and the paths of the last."""
    return combine(kept, config, carried, known_imu(config)), leg_paths(kept[-1], config)


def leg_paths(result: LegResult | None, config: Config) -> Paths:
    """Return the two paths of a leg, empty ones without a leg."""
    header = Header(frame_id=config.frames.local)
    if result is None:
        return PathMessage(header=header), PathMessage(header=header)
    header.stamp.sec, header.stamp.nanosec = divmod(result.stop_ns, 10**9)
    return _path(result.track_n, header), _path(result.reference_n, header)


def _path(track_n: Floats | None, header: Header) -> PathMessage:
    """Return a track, (m, 3) in n, as a Path of at most MOST_POSES, the last row included."""
    if track_n is None or not len(track_n):
        return PathMessage(header=header)
    few = min(len(track_n), MOST_POSES)
    rows = np.linspace(0, len(track_n) - 1, few).round().astype(int)
    upright = Quaternion(w=1.0)
    return PathMessage(header=header, poses=[
        PoseStamped(header=header, pose=Pose(
            position=Point(x=float(x), y=float(y), z=float(z)), orientation=upright))
        for x, y, z in track_n[rows]])
