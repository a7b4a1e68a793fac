# Copyright 2026 odocal_ros maintainers
# SPDX-License-Identifier: Apache-2.0

"""The smoothed drive as a Rerun recording: track, map, attitude and biases over time."""

from pathlib import Path
from typing import Any

import numpy as np

from odocal_ros.calib.result import Calibration
from odocal_ros.library.series import Series, states, trajectory
from odocal_ros.outside.whole import whole_file

INSTALL = 'pip install rerun-sdk'


def rrd(result: Calibration, path: Path) -> None:
    """
    Write drive.rrd.

    leg_N/track LineStrips3D, m in the leg's n; leg_N/map GeoLineStrings; leg_N/vehicle Transform3D
    over time; leg_N/states/NAME Scalars over time, names and units as in states.csv.
    """
    import rerun
    recording = rerun.RecordingStream('odocal_ros')
    memory = recording.memory_recording()
    pose, state = trajectory(result), states(result)
    for leg in np.unique(pose['leg']).tolist():
        _leg(recording, f'leg_{leg}', *(
            {name: column[one['leg'] == leg] for name, column in one.items()}
            for one in (pose, state)))
    with whole_file(path) as file:
        file.write(memory.drain_as_bytes())


def _leg(recording: Any, name: str, pose: Series, state: Series) -> None:
    """Log one leg below its name."""
    import rerun
    track_n = np.stack([pose[f'{axis}_m'] for axis in ('east', 'north', 'up')], -1)
    rotations = np.stack([pose[f'q{axis}'] for axis in 'xyzw'], -1)
    places = np.stack([pose['latitude_deg'], pose['longitude_deg']], -1)
    rerun.log(f'{name}/track', rerun.LineStrips3D([track_n]), static=True, recording=recording)
    rerun.log(f'{name}/map', rerun.GeoLineStrings(lat_lon=[places]), static=True,
              recording=recording)
    times = [rerun.TimeColumn('time', timestamp=pose['stamp_ns'].astype('datetime64[ns]'))]
    rerun.send_columns(f'{name}/vehicle', times, rerun.Transform3D.columns(
        translation=track_n, quaternion=rotations), recording=recording)
    for key, column in state.items():
        if key not in ('leg', 'stamp_ns', 't_s'):
            rerun.send_columns(f'{name}/states/{key}', times, rerun.Scalars.columns(
                scalars=column), recording=recording)
