# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""What leaves the node besides status and parameters: paths and result files."""

from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import datetime, UTC
import os
from pathlib import Path
from typing import Any

from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from nav_msgs.msg import Path as PathMessage
import numpy as np
from std_msgs.msg import Header

from odocal_ros.calib.result import Calibration, LegResult
from odocal_ros.errors import OdocalError
from odocal_ros.live.result_folders import ResultFolders
from odocal_ros.outside.whole import new_folder
from odocal_ros.settings.config import Config

MOST_POSES = 2000    # judgement: of a path shown


def path_message(track_n: np.ndarray | None, header: Header) -> PathMessage:
    """Return a track, (m, 3) in n, as a Path of at most 2000 poses, the last row included."""
    if track_n is None or not len(track_n):
        return PathMessage(header=header)
    few = min(len(track_n), MOST_POSES)
    rows = np.linspace(0, len(track_n) - 1, few).round().astype(int)
    upright = Quaternion(w=1.0)
    return PathMessage(header=header, poses=[
        PoseStamped(header=header, pose=Pose(
            position=Point(x=float(x), y=float(y), z=float(z)), orientation=upright))
        for x, y, z in track_n[rows]])


def paths(result: LegResult | None, header: Header) -> tuple[PathMessage, PathMessage]:
    """Return dead reckoning and reference of a leg; without a leg two empty paths."""
    if result is None:
        return path_message(None, header), path_message(None, header)
    return path_message(result.track_n, header), path_message(result.reference_n, header)


def iso(stamp_ns: int) -> str:
    """Return a stamp as ISO 8601, UTC, seconds."""
    return f'{datetime.fromtimestamp(stamp_ns // 10**9, UTC):%Y-%m-%dT%H:%M:%SZ}'


def output_root(config: Config, node: str) -> Path:
    """Return the folder of results: the setting, else the node's own folder in the ROS home."""
    home = os.environ.get('ROS_HOME') or '~/.ros'
    own = Path(home) / 'odocal' / node.lstrip('/')
    return Path(config.output.directory or own).expanduser()


def save(calibration: Calibration, config: Config, inputs: list[dict[str, Any]], imu_frame: str,
         now_ns: int, folders: ResultFolders, force: bool,
         ) -> tuple[Path, str, Callable[[], str] | None]:
    """
    Write the result files into a folder named by the time, and point ``latest`` at it.

    ``inputs`` name the node. ``imu_frame`` is that of the IMU's headers, for a ``frames.imu``
    left empty. Returns the folder, why ``latest`` stays where it was, empty when it does not
    (``force`` moves it), and what adds the report, which takes long to draw.

    Raises
    ------
    OdocalError
        The folder cannot be written.

    """
    from odocal_ros.output.files import Results
    from odocal_ros.output.ros_files import framed
    calibration, config = framed(calibration, config, imu_frame)
    root = output_root(config, inputs[0]['node'])
    name = f'{datetime.fromtimestamp(now_ns // 10**9, UTC):%Y-%m-%dT%H-%M-%SZ}'
    try:
        folder = new_folder(root, name)
        try:
            results = Results(calibration, config, folder, inputs, iso(now_ns))
            results.write()
        except OdocalError:
            with suppress(OSError):
                folder.rmdir()      # empty: its name was only reserved
            raise
        stays = folders.file(folder, marks(calibration.legs), force)
        if config.leg.automatic:
            folders.prune(folder, config.output.automatic_kept)
    except OSError as error:
        raise OdocalError(f'results cannot be written to {root}: {error.strerror}; set '
                          'output.directory to a writable folder') from None
    return folder, stays, results.draw if results.has_report else None


def marks(legs: Iterable[LegResult]) -> frozenset[int]:
    """Return the start marks of legs, ns: by them a session knows its legs."""
    return frozenset(leg.start_ns for leg in legs)
